"""Records of the events of a step: contacts, vehicles off the road, disturbances, traffic events."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, TypedDict

from crashhunt.recording._reading import Divergence
from crashhunt.recording.records._type import RecordType, TextForm, scene_texts
from crashhunt.trial import Disturbance
from crashhunt.world import Contact, Event

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.recording._reading import AgentChannel, Reading, StepRecord
    from crashhunt.world import Scene


# What touched, and who left the road, as JSON; only where anything did.

_EVENTS_FIELDS = len(Contact.__slots__)


class _Events(TypedDict, total=False):
    contacts: list[list[Any]]
    off_road: list[str]


def encode_events(scene: Scene) -> bytes:
    """Return the payload with the contacts, and with the vehicles that left the road."""
    contacts = [[getattr(contact, name) for name in Contact.__slots__] for contact in scene.contacts]
    return json.dumps({"contacts": contacts, "off_road": list(scene.off_road)}).encode()


def _read_events(reading: Reading, _aux: int, payload: bytes) -> None:
    events: _Events = json.loads(payload)
    # What a later version has added to a contact stands at its end.
    reading.scene["contacts"] = tuple(Contact(*entry[:_EVENTS_FIELDS]) for entry in events.get("contacts", ()))
    reading.scene["off_road"] = tuple(events.get("off_road", ()))


EVENTS = RecordType(
    tag=8,
    name="events",
    topic="/events",
    form=TextForm(),
    read=_read_events,
    difference=scene_texts("contacts", "off_road"),
)


# Traffic events, as JSON. What we conclude from an episode is no part of it, nor of its digest; nor is it compared.


def encode_notes(events: Iterable[Event]) -> bytes:
    """Return the payload with the traffic events."""
    return json.dumps([event.to_json() for event in events]).encode()


def _read_notes(reading: Reading, _aux: int, payload: bytes) -> None:
    reading.events = tuple(Event.from_json(note) for note in json.loads(payload))


NOTES = RecordType(tag=11, name="notes", topic="/traffic_events", form=TextForm(), read=_read_notes)


# A disturbance as it takes place, as JSON: who turned out to be meant is part of the episode, and of its digest.

_DISTURBANCES_NAME = "disturbance"
_DISTURBANCES_NOTHING = "nothing"


def encode_disturbance(disturbance: Disturbance) -> bytes:
    """Return the payload of an active disturbance."""
    return json.dumps({"vehicle": "", **disturbance.to_json()}).encode()


def _read_disturbances(reading: Reading, _aux: int, payload: bytes) -> None:
    found = Disturbance.from_json(json.loads(payload))
    reading.current.more.setdefault(_DISTURBANCES_NAME, []).append(found)


def _difference_disturbances(left: StepRecord, right: StepRecord, _: AgentChannel | None) -> Divergence | None:
    each = [step.more.get(_DISTURBANCES_NAME, ()) for step in (left, right)]
    exact = [str([one.to_json() for one in some]) for some in each]
    if exact[0] == exact[1]:
        return None
    was, now = ["; ".join(f"{one.words} ({one.place})" for one in some) or _DISTURBANCES_NOTHING for some in each]
    if was == now:  # such as two strengths that are rounded alike
        was, now = exact
    return Divergence(step=left.step, agent="", field=_DISTURBANCES_NAME, recorded=was, replayed=now)


DISTURBANCES = RecordType(
    tag=12,
    name=_DISTURBANCES_NAME,
    topic="/disturbances",
    form=TextForm(),
    read=_read_disturbances,
    difference=_difference_disturbances,
)
