"""What the episode consists of: the agents with the shapes of their arrays, the step length. JSON; always the first."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypedDict

from crashhunt.base.tolerance import known_values
from crashhunt.recording.records._type import RecordType, TextForm

if TYPE_CHECKING:
    from crashhunt.base.plain import Plain
    from crashhunt.recording._reading import Reading

__all__ = ["TYPE", "AgentChannel", "Prologue"]


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
        """Rebuild what `encode` returned; what a later version has added is left out."""
        data: _Said = json.loads(payload)
        agents = tuple(AgentChannel(**_columns(agent)) for agent in data["agents"])
        return cls(agents, data["step_length_s"])


class _Said(TypedDict):
    agents: list[Plain]
    step_length_s: float


def _columns(agent: Plain) -> dict[str, Any]:
    known = known_values(AgentChannel, agent)
    return {name: tuple(value) if isinstance(value, list) else value for name, value in known.items()}


def _read(_reading: Reading, _aux: int, _payload: bytes) -> None:
    raise ValueError("it begins twice")


TYPE = RecordType(1, "prologue", "/prologue", TextForm(), _read)
