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


def encode_disturbance(disturbance: Disturbance) -> bytes:
    """Return the payload that says what takes place."""
    return json.dumps({"vehicle": "", **disturbance.to_json()}).encode()


def _read(reading: Reading, _aux: int, payload: bytes) -> None:
    found = Disturbance.from_json(json.loads(payload))
    reading.current.more.setdefault(_NAME, []).append(found)


def _difference(left: StepRecord, right: StepRecord, _: AgentChannel | None) -> Divergence | None:
    was, now = (str([one.to_json() for one in step.more.get(_NAME, ())]) for step in (left, right))
    return Divergence(left.step, "", _NAME, was, now) if was != now else None


TYPE = RecordType(12, _NAME, "/disturbances", TextForm(), _read, _difference)
