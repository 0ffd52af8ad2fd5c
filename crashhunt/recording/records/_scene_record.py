"""Records of the scene: the present actors with their positions, heights, shapes and lanes."""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from crashhunt.recording._reading import Divergence, StepRecord, first_difference
from crashhunt.recording.records._type import SCENE, Form, RecordType, TextForm, scene_texts
from crashhunt.trial import Disturbance
from crashhunt.world import Actor, Contact, Event, Roster, Scene

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from crashhunt.recording._reading import AgentChannel, Prologue, Reading, SceneParts
    from crashhunt.recording.records._type import Fields, Message
    from crashhunt.world import Spine


# Actors that were not seen before, as JSON; each is numbered in order of appearance.

_ACTORS_FIELDS = len(Actor.__slots__)
_ALWAYS_WRITTEN = 4  # fields; the later ones, which have defaults, are written up to the last that differs


def encode_actors(actors: Iterable[Actor]) -> bytes:
    """Return the payload that introduces actors."""
    known = []
    for actor in actors:
        entry = [actor.id, actor.kind, actor.length, actor.width, actor.height, actor.parked]
        while len(entry) > _ALWAYS_WRITTEN and not entry[-1]:
            del entry[-1]
        known.append(entry)
    return json.dumps(known).encode()


def _read_actors(reading: Reading, _aux: int, payload: bytes) -> None:
    # What a later version has added stands at the end.
    reading.actors.extend(Actor(*entry[:_ACTORS_FIELDS]) for entry in json.loads(payload))


ACTORS = RecordType(tag=2, name="actors", topic="/scene/actor_definitions", form=TextForm(), read=_read_actors)


# The numbers of the actors that are present from here on, as uint32[].


def encode_roster(numbers: list[int]) -> bytes:
    """Return the payload with the numbers of the present actors."""
    return struct.pack(f"<{len(numbers)}I", *numbers)  # faster than NumPy for so few


class _RosterForm(Form):
    messages: Mapping[str, Mapping[str, str]] = {"Roster": {"actors": "uint32*"}}

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        return "Roster", {"actors": np.frombuffer(payload, "<u4").tolist()}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        return encode_roster(message.actors)


def _read_roster(reading: Reading, _aux: int, payload: bytes) -> None:
    actors = reading.actors
    reading.roster = Roster(tuple([actors[number] for number in np.frombuffer(payload, "<u4").tolist()]))


def roster_difference(step: int, left: Roster, right: Roster) -> Divergence | None:
    """Return the first difference between the actors of two scenes."""
    if left.actors == right.actors:
        return None
    for was, now in zip(left.actors, right.actors, strict=False):
        if was != now:
            if was.id == now.id:
                return Divergence(step=step, agent=was.id, field="actor", recorded=str(was), replayed=str(now))
            break
    missing = [actor.id for actor in left.actors if actor.id not in right.index]
    if missing:
        return Divergence(step=step, agent=missing[0], field="presence", recorded=1, replayed=0)
    extra = [actor.id for actor in right.actors if actor.id not in left.index]
    if extra:
        return Divergence(step=step, agent=extra[0], field="presence", recorded=0, replayed=1)
    return Divergence(
        step=step, agent="", field="order of actors", recorded=[a.id for a in left.actors][:5], replayed="another"
    )


# It is compared with the step, whose values stand in the order of the roster.
ROSTER = RecordType(tag=3, name="roster", topic="/scene/roster", form=_RosterForm(), read=_read_roster)


# A step that is complete: int64 step, float64 time in s, float64 reward of each agent, and the values of the scene.
#
# These are, of all actors of the roster, x and y alternating, then all headings, then all speeds.

_STEP_HEAD = struct.Struct("<qd")


def time_of(payload: bytes) -> float:
    """Return the simulation time of a step from its payload, in s."""
    time_s: float = _STEP_HEAD.unpack_from(payload)[1]
    return time_s


class _StepForm(Form):
    messages: Mapping[str, Mapping[str, str]] = {
        "Step": {
            "step": "int64",
            "time_s": "double",
            "rewards": "double*",
            "positions": "double*",
            "headings": "double*",
            "speeds": "double*",
        }
    }

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        step, time_s = _STEP_HEAD.unpack_from(payload)
        values = np.frombuffer(payload, "<f8", offset=_STEP_HEAD.size).tolist()
        agents = len(prologue.agents)
        rewards, scene = values[:agents], values[agents:]
        count = len(scene) // 4
        return "Step", {
            "step": step,
            "time_s": time_s,
            "rewards": rewards,
            "positions": scene[: 2 * count],
            "headings": scene[2 * count : 3 * count],
            "speeds": scene[3 * count :],
        }

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        values = np.array([*message.rewards, *message.positions, *message.headings, *message.speeds], "<f8")
        return _STEP_HEAD.pack(message.step, message.time_s) + values.tobytes()


def _read_step(reading: Reading, _aux: int, payload: bytes) -> None:
    agents, steps, current = reading.prologue.agents, reading.steps, reading.current
    step, time_s = _STEP_HEAD.unpack_from(payload)
    values = np.frombuffer(payload, "<f8", offset=_STEP_HEAD.size).tolist()
    rewards, values = values[: len(agents)], values[len(agents) :]
    count = len(reading.roster)
    if step != current.step or len(rewards) != len(agents) or len(values) != 4 * count:
        raise ValueError(
            f"the scene of step {step} follows that of step {current.step - 1}, but steps must be consecutive"
        )
    points = list(zip(values[: 2 * count : 2], values[1 : 2 * count : 2], strict=True))
    headings, speeds = values[2 * count : 3 * count], values[3 * count :]
    parts: SceneParts = {"heights": [], "grades": [], **reading.scene}
    scene = current.scene = Scene(time_s, reading.roster, points, headings, speeds, **parts)
    if len(scene.heights) not in (0, count) or any(row >= count for row in scene.spines):
        raise ValueError(f"the scene of step {step} has data of more actors than the recording lists")
    scene.events = reading.events
    scene.previous = steps[-1].scene if steps else None
    current.rewards = {agent.id: reward for agent, reward in zip(agents, rewards, strict=True)}
    steps.append(current)
    reading.current, reading.scene, reading.events = StepRecord(step + 1), {}, ()


def _difference_step(left: StepRecord, right: StepRecord, _: AgentChannel | None) -> Divergence | None:
    step, was, now = left.step, left.scene, right.scene
    if was is None or now is None:
        return (
            None
            if was is now
            else Divergence(step=step, agent="", field=SCENE, recorded=was and "present", replayed=now and "present")
        )
    for name in left.rewards:
        if np.float64(left.rewards[name]).tobytes() != np.float64(right.rewards[name]).tobytes():
            return Divergence(
                step=step, agent=name, field="reward", recorded=left.rewards[name], replayed=right.rewards[name]
            )
    if was.time_s != now.time_s:
        return Divergence(step=step, agent="", field="time_s", recorded=was.time_s, replayed=now.time_s)
    other = roster_difference(step, was.roster, now.roster)
    if other is not None:
        return other
    was_data, now_data = was.data, now.data
    if was_data.tobytes() == now_data.tobytes():
        return None
    row, column = first_difference(was_data, now_data)
    name = ("x", "y", "heading", "speed")[column]
    values = float(was_data[row, column]), float(now_data[row, column])
    return Divergence(step, was.roster.actors[row].id, f"scene.{name}", *values, (SCENE, (column,)))


def _value_step(step: StepRecord, actor: str, index: tuple[int, ...]) -> object:
    if step.scene is None or actor not in step.scene.roster.index:
        return None
    return float(step.scene.data[step.scene.roster.index[actor], index[0]])


STEP = RecordType(
    tag=6, name=SCENE, topic="/scene", form=_StepForm(), read=_read_step, difference=_difference_step, value=_value_step
)


# How high everybody is, then how steep it is there, as float64[]; only where the map is not flat.


def encode_heights(scene: Scene) -> bytes:
    """Return the payload with the height of each actor and the slope of its road."""
    return np.array([*scene.heights, *scene.grades], "<f8").tobytes()


class _HeightsForm(Form):
    messages: Mapping[str, Mapping[str, str]] = {"Heights": {"heights": "double*", "grades": "double*"}}

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        heights, grades = np.frombuffer(payload, "<f8").reshape(2, -1).tolist()
        return "Heights", {"heights": heights, "grades": grades}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        return np.array([*message.heights, *message.grades], "<f8").tobytes()


def _read_heights(reading: Reading, _aux: int, payload: bytes) -> None:
    heights, grades = np.frombuffer(payload, "<f8").reshape(2, -1).tolist()
    reading.scene["heights"], reading.scene["grades"] = heights, grades


HEIGHTS = RecordType(
    tag=9,
    name="heights",
    topic="/scene/heights",
    form=_HeightsForm(),
    read=_read_heights,
    difference=scene_texts("heights", "grades"),
)


# Of each long vehicle that is bent: uint32 row, uint32 points, and float64 x, y and z of each point, in m.

_SPINES_HEAD = struct.Struct("<II")


def encode_spines(scene: Scene) -> bytes:
    """Return the payload with the centre lines of long vehicles in bends."""
    return _encode_spines(scene.spines)


def _encode_spines(spines: Mapping[int, Spine | NDArray[np.float64]]) -> bytes:
    return b"".join(
        _SPINES_HEAD.pack(row, len(spine)) + np.array(spine, "<f8").tobytes() for row, spine in spines.items()
    )


def _decode_spines(payload: bytes) -> dict[int, Spine]:
    found, offset = {}, 0
    while offset < len(payload):
        row, count = _SPINES_HEAD.unpack_from(payload, offset)
        offset += _SPINES_HEAD.size
        points = np.frombuffer(payload, "<f8", 3 * count, offset).reshape(-1, 3).tolist()
        found[row] = tuple((x, y, z) for x, y, z in points)
        offset += 24 * count
    return found


class _SpinesForm(Form):
    messages: Mapping[str, Mapping[str, str]] = {
        "Spines": {"rows": "uint32*", "points": "uint32*", "coordinates": "double*"}
    }

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        spines = _decode_spines(payload)
        coordinates = [value for spine in spines.values() for point in spine for value in point]
        points = [len(spine) for spine in spines.values()]
        return "Spines", {"rows": list(spines), "points": points, "coordinates": coordinates}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        values = np.array(list(message.coordinates), "<f8").reshape(-1, 3)
        ends = np.cumsum(list(message.points))[:-1]
        return _encode_spines(dict(zip(message.rows, np.split(values, ends), strict=True)))


def _read_spines(reading: Reading, _aux: int, payload: bytes) -> None:
    reading.scene["spines"] = _decode_spines(payload)


SPINES = RecordType(
    tag=10,
    name="spines",
    topic="/scene/spines",
    form=_SpinesForm(),
    read=_read_spines,
    difference=scene_texts("spines"),
)


# The lane of each actor of the roster, as text, one a line; only in steps that looked.


def encode_lanes(lanes: Iterable[str]) -> bytes:
    """Return the payload with the lane of each actor."""
    return "\n".join(lanes).encode()


def _read_lanes(reading: Reading, _aux: int, payload: bytes) -> None:
    reading.scene["lanes"] = tuple(payload.decode().split("\n"))


LANES = RecordType(
    tag=7, name="lanes", topic="/scene/lanes", form=TextForm(), read=_read_lanes, difference=scene_texts("lanes")
)


def step_of(payload: bytes) -> int:
    """Return the number of a step from its payload."""
    step: int = _STEP_HEAD.unpack_from(payload)[0]
    return step


def points_of(payload: bytes, agents: int) -> NDArray[np.float64]:
    """Return the positions of the actors in the payload of a step, in m, shape (actors, 2)."""
    values = np.frombuffer(payload, "<f8", offset=_STEP_HEAD.size)[agents:]
    return values[: len(values) // 2].reshape(-1, 2)


def select_actors(tag: int, payload: bytes, mask: NDArray[np.bool_], agents: int) -> bytes:
    """Return the payload of a record, reduced to some actors of its roster; other types are unchanged.

    The payload covers all actors of the roster, and so does the mask.
    """
    if tag == STEP.tag:
        values = np.frombuffer(payload, "<f8", offset=_STEP_HEAD.size)
        rewards, scene = values[:agents], values[agents:]
        count = len(mask)
        points = scene[: 2 * count].reshape(-1, 2)[mask].ravel()
        columns = (rewards, points, scene[2 * count : 3 * count][mask], scene[3 * count :][mask])
        return payload[: _STEP_HEAD.size] + np.concatenate(columns).astype("<f8").tobytes()
    if tag == HEIGHTS.tag:
        return np.ascontiguousarray(np.frombuffer(payload, "<f8").reshape(2, -1)[:, mask]).tobytes()
    if tag == LANES.tag:
        return encode_lanes(np.array(payload.decode().split("\n"), object)[mask].tolist())
    if tag == SPINES.tag:
        rows = np.cumsum(mask) - 1
        return _encode_spines({int(rows[row]): spine for row, spine in _decode_spines(payload).items() if mask[row]})
    return payload


# Records of the events of a step: contacts, vehicles off the road, disturbances, traffic events.


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
