"""The numbers of the actors that are present from here on, as uint32[]."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.recording._divergence import Divergence
from crashhunt.recording.records._type import Form, RecordType
from crashhunt.world import Roster

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.recording._reading import Reading
    from crashhunt.recording.records._type import Fields, Message
    from crashhunt.recording.records.prologue import Prologue

__all__ = ["TYPE", "difference", "encode_roster"]


def encode_roster(numbers: list[int]) -> bytes:
    """Return the payload that says who is present, by the numbers of the actors."""
    return np.array(numbers, "<u4").tobytes()


class _RosterForm(Form):
    messages: Mapping[str, Mapping[str, str]] = {"Roster": {"actors": "uint32*"}}

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        return "Roster", {"actors": np.frombuffer(payload, "<u4").tolist()}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        return encode_roster(message.actors)


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    actors = reading.actors
    reading.roster = Roster(tuple([actors[number] for number in np.frombuffer(payload, "<u4").tolist()]))


def difference(step: int, left: Roster, right: Roster) -> Divergence | None:
    """Return the first difference between the actors of two scenes."""
    if left.actors == right.actors:
        return None
    for was, now in zip(left.actors, right.actors, strict=False):
        if was != now:
            if was.id == now.id:
                return Divergence(step, was.id, "actor", str(was), str(now))
            break
    missing = [actor.id for actor in left.actors if actor.id not in right.index]
    if missing:
        return Divergence(step, missing[0], "presence", 1, 0)
    extra = [actor.id for actor in right.actors if actor.id not in left.index]
    if extra:
        return Divergence(step, extra[0], "presence", 0, 1)
    return Divergence(step, "", "order of actors", [a.id for a in left.actors][:5], "another")


# It is compared with the step, whose values stand in the order of the roster.
TYPE = RecordType(3, "roster", "/scene/roster", _RosterForm(), _read)
