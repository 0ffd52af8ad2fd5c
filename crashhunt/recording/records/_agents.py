"""Records of agents: the prologue, which lists them with the shapes of their arrays, their observations and actions."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from crashhunt.base.tolerance import known_values
from crashhunt.recording._divergence import Divergence, first_difference
from crashhunt.recording.records._type import Form, RecordType, TextForm

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from crashhunt.base.json_types import Plain
    from crashhunt.recording._reading import Reading, StepRecord
    from crashhunt.recording.records._type import Fields, Message


__all__ = [
    "ACTION",
    "OBSERVATION",
    "PROLOGUE",
    "AgentChannel",
    "ArrayForm",
    "Prologue",
    "array_difference",
    "message_of",
]


# What the episode consists of: the agents with the shapes of their arrays, the step length. JSON; always the first.


@dataclass(frozen=True, slots=True)
class AgentChannel:
    """What the arrays of one agent look like.

    Args:
        id: the agent, which is also the id of its vehicle among the actors.
        observation_dtype: as NumPy writes it, such as ``<f4``.
        observation_shape: of one observation.
        action_dtype: likewise.
        action_shape: of one action.
        action_names: what the elements of an action are.
        observation_names: what the columns of an observation are.
    """

    id: str
    observation_dtype: str
    observation_shape: tuple[int, ...]
    action_dtype: str
    action_shape: tuple[int, ...]
    action_names: tuple[str, ...] = ()
    observation_names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Prologue:
    """What an episode consists of.

    Args:
        agents: in the order of their numbers.
        step_length_s: in s of simulation time.
    """

    agents: tuple[AgentChannel, ...]
    step_length_s: float

    def encode(self) -> bytes:
        """Return the payload of the record."""
        agents = [{name: getattr(agent, name) for name in AgentChannel.__slots__} for agent in self.agents]
        return json.dumps({"agents": agents, "step_length_s": self.step_length_s}, sort_keys=True).encode()

    @classmethod
    def decode(cls, payload: bytes) -> Prologue:
        """Rebuild what `encode` returned; additions of later versions are ignored."""
        data: _Said = json.loads(payload)
        agents = tuple(AgentChannel(**_columns_prologue(agent)) for agent in data["agents"])
        return cls(agents, data["step_length_s"])


class _Said(TypedDict):
    agents: list[Plain]
    step_length_s: float


def _columns_prologue(agent: Plain) -> dict[str, Any]:
    known = known_values(AgentChannel, agent)
    return {name: tuple(value) if isinstance(value, list) else value for name, value in known.items()}


def _read_prologue(_reading: Reading, _aux: int, _payload: bytes) -> None:
    raise ValueError("it begins twice")


PROLOGUE = RecordType(1, "prologue", "/prologue", TextForm(), _read_prologue)


# Arrays of one agent: raw bytes in the black box, numbers in the log.


class ArrayForm(Form):
    """Arrays of the type that the prologue says.

    Args:
        what: the field of the agent's channel that has the type.
    """

    messages: Mapping[str, Mapping[str, str]] = {
        "FloatArray": {"values": "float*"},
        "DoubleArray": {"values": "double*"},
        "IntArray": {"values": "int64*"},
    }

    def __init__(self, what: str) -> None:
        self._what = what

    def to_message(self, payload: bytes, prologue: Prologue, aux: int) -> tuple[str, Fields]:
        """Return the numbers, in the message that holds those of this type without losing a bit."""
        dtype = getattr(prologue.agents[aux], self._what)
        return message_of(dtype), {"values": np.frombuffer(payload, dtype).tolist()}

    def to_payload(self, message: Message, prologue: Prologue | None, aux: int) -> bytes:
        """Return their bytes."""
        if prologue is None:
            raise ValueError("an array comes before the beginning")
        return np.array(list(message.values), getattr(prologue.agents[aux], self._what)).tobytes()


def message_of(dtype: str) -> str:
    """Return the name of the message that holds arrays of a NumPy type, such as ``<f4``, without losing a bit."""
    kind, size = dtype[1], int(dtype[2:])
    if kind == "f" and size in (4, 8):
        return "FloatArray" if size == 4 else "DoubleArray"
    if kind in "iub":
        return "IntArray"
    raise TypeError(f"arrays of {dtype} cannot be recorded")


def array_difference(
    step: int,
    agent: str,
    kind: str,
    columns: tuple[str, ...],
    was: NDArray[np.generic] | None,
    now: NDArray[np.generic] | None,
) -> Divergence | None:
    """Return the first difference between two arrays of an agent, either of which may be missing."""
    if was is None and now is None:
        return None
    if was is None or now is None:
        return Divergence(step, agent, kind, _plain(was), _plain(now))
    if was.tobytes() == now.tobytes():
        return None
    where = first_difference(was, now)
    name = ", ".join((*map(str, where[:-1]), columns[where[-1]] if columns else str(where[-1]))) if where else ""
    field = f"{kind}[{name}]" if name else kind
    return Divergence(step, agent, field, was[where].item(), now[where].item(), (kind, where))


def _plain(array: NDArray[np.generic] | None) -> object:
    return None if array is None else array.tolist()


# What an agent is shown, as raw bytes; ``aux`` is its number.


def _read_observation(reading: Reading, aux: int, payload: bytes) -> None:
    channel = reading.prologue.agents[aux]
    array = np.frombuffer(payload, channel.observation_dtype).reshape(channel.observation_shape)
    reading.current.observations[channel.id] = array


def _difference_observation(left: StepRecord, right: StepRecord, agent: AgentChannel | None) -> Divergence | None:
    if agent is None:
        return None
    was, now = left.observations.get(agent.id), right.observations.get(agent.id)
    return array_difference(left.step, agent.id, "observation", agent.observation_names, was, now)


def _value_observation(step: StepRecord, agent: str, index: tuple[int, ...]) -> object:
    array = step.observations.get(agent)
    return None if array is None else array[index].item()


OBSERVATION = RecordType(
    4,
    "observation",
    "/agents/{agent}/observation",
    ArrayForm("observation_dtype"),
    _read_observation,
    _difference_observation,
    _value_observation,
)


# What an agent answers, as raw bytes; ``aux`` is its number.


def _read_action(reading: Reading, aux: int, payload: bytes) -> None:
    channel = reading.prologue.agents[aux]
    array = np.frombuffer(payload, channel.action_dtype).reshape(channel.action_shape)
    reading.current.actions[channel.id] = array


def _difference_action(left: StepRecord, right: StepRecord, agent: AgentChannel | None) -> Divergence | None:
    if agent is None:
        return None
    was, now = left.actions.get(agent.id), right.actions.get(agent.id)
    return array_difference(left.step, agent.id, "action", agent.action_names, was, now)


def _value_action(step: StepRecord, agent: str, index: tuple[int, ...]) -> object:
    array = step.actions.get(agent)
    return None if array is None else array[index].item()


ACTION = RecordType(
    5,
    "action",
    "/agents/{agent}/action",
    ArrayForm("action_dtype"),
    _read_action,
    _difference_action,
    _value_action,
)
