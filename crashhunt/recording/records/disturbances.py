"""A disturbance as it takes place, as JSON: who turned out to be meant is part of the episode, and of its digest."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from crashhunt.recording._divergence import Divergence
from crashhunt.recording.records._type import RecordType, TextForm
from crashhunt.trial import Disturbance

if TYPE_CHECKING:
    from crashhunt.recording._reading import Reading, StepRecord
    from crashhunt.recording.records.prologue import AgentChannel

__all__ = ["TYPE", "encode_disturbance"]

_NAME = "disturbance"
_NOTHING = "nothing"


def encode_disturbance(disturbance: Disturbance) -> bytes:
    """Return the payload that says what takes place."""
    return json.dumps({"vehicle": "", **disturbance.to_json()}).encode()


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    found = Disturbance.from_json(json.loads(payload))
    reading.current.more.setdefault(_NAME, []).append(found)


def _difference(left: StepRecord, right: StepRecord, _: AgentChannel | None) -> Divergence | None:
    each = [step.more.get(_NAME, ()) for step in (left, right)]
    exact = [str([one.to_json() for one in some]) for some in each]
    if exact[0] == exact[1]:
        return None
    was, now = ["; ".join(f"{one.words} ({one.place})" for one in some) or _NOTHING for some in each]
    if was == now:  # such as two strengths that are rounded alike
        was, now = exact
    return Divergence(left.step, "", _NAME, was, now)


TYPE = RecordType(12, _NAME, "/disturbances", TextForm(), _read, _difference)
