"""What an agent is shown, as raw bytes; ``aux`` is its number."""

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
    array = np.frombuffer(payload, channel.observation_dtype).reshape(channel.observation_shape)
    reading.current.observations[channel.id] = array


def _difference(left: StepRecord, right: StepRecord, agent: AgentChannel | None) -> Divergence | None:
    if agent is None:
        return None
    was, now = left.observations.get(agent.id), right.observations.get(agent.id)
    return _arrays.difference(left.step, agent.id, "observation", agent.observation_names, was, now)


def _value(step: StepRecord, agent: str, index: tuple[int, ...]) -> object:
    array = step.observations.get(agent)
    return None if array is None else array[index].item()


TYPE = RecordType(
    4,
    "observation",
    "/agents/{agent}/observation",
    _arrays.ArrayForm("observation_dtype"),
    _read,
    _difference,
    _value,
)
