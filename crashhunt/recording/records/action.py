"""What an agent answers, as raw bytes; ``aux`` is its number."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.recording.records import _arrays
from crashhunt.recording.records._type import RecordType

if TYPE_CHECKING:
    from crashhunt.recording._divergence import Divergence
    from crashhunt.recording._reading import Reading, StepRecord
    from crashhunt.recording.records.prologue import AgentChannel

__all__ = ["TYPE"]


def _read(reading: Reading, aux: int, payload: bytes) -> None:
    channel = reading.prologue.agents[aux]
    array = np.frombuffer(payload, channel.action_dtype).reshape(channel.action_shape)
    reading.current.actions[channel.id] = array


def _difference(left: StepRecord, right: StepRecord, agent: AgentChannel | None) -> Divergence | None:
    if agent is None:
        return None
    was, now = left.actions.get(agent.id), right.actions.get(agent.id)
    return _arrays.difference(left.step, agent.id, "action", agent.action_names, was, now)


def _value(step: StepRecord, agent: str, index: tuple[int, ...]) -> object:
    array = step.actions.get(agent)
    return None if array is None else array[index].item()


TYPE = RecordType(
    5,
    "action",
    "/agents/{agent}/action",
    _arrays.ArrayForm("action_dtype"),
    _read,
    _difference,
    _value,
)
