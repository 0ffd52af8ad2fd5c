"""An episode as it was recorded: the agents and their arrays, and the steps that were read."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypedDict

from crashhunt.base.tolerance import known_values
from crashhunt.world import Roster

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.base.json_types import Plain
    from crashhunt.world import Actor, Contact, Event, Scene, Spine

__all__ = ["AgentChannel", "Prologue", "Reading", "SceneParts", "StepRecord"]


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
        """Rebuild what `encode` returned; keys that a later version has added are skipped."""
        data: _Said = json.loads(payload)
        agents = tuple(AgentChannel(**_columns_prologue(agent)) for agent in data["agents"])
        return cls(agents, data["step_length_s"])


class _Said(TypedDict):
    agents: list[Plain]
    step_length_s: float


def _columns_prologue(agent: Plain) -> dict[str, Any]:
    known = known_values(AgentChannel, agent)
    return {name: tuple(value) if isinstance(value, list) else value for name, value in known.items()}


@dataclass(slots=True)
class StepRecord:
    """What was recorded of one step.

    Args:
        step: 0 is the start of the episode, before the first action.
        scene: after the step.
        rewards: agent id to reward.
        observations: what each agent was shown before this step; nothing at step 0.
        actions: what each agent answered.
        more: what further types of records say of the step, by their names.
        whole: False where the process ended inside the step, so that there is no scene after it.
    """

    step: int
    scene: Scene | None = None
    rewards: dict[str, float] = field(default_factory=dict)
    observations: dict[str, NDArray[np.generic]] = field(default_factory=dict)
    actions: dict[str, NDArray[np.generic]] = field(default_factory=dict)
    more: dict[str, Any] = field(default_factory=dict)

    @property
    def whole(self) -> bool:
        """Whether the step was completed."""
        return self.scene is not None


class SceneParts(TypedDict, total=False):
    """What a scene has besides what a step says itself; see `Scene`."""

    contacts: tuple[Contact, ...]
    off_road: tuple[str, ...]
    lanes: tuple[str, ...]
    heights: list[float]
    grades: list[float]
    spines: dict[int, Spine]


@dataclass(slots=True)
class Reading:
    """What has been read of an episode so far.

    Args:
        prologue: what it consists of.
        actors: all that were introduced, in the order of their numbers.
        steps: those that are complete.
        current: the step that is being read.
        roster: the actors of the next scene.
        scene: further arguments of the next scene, by their names; a step takes them and leaves none.
        events: what else happened in it.
    """

    prologue: Prologue
    actors: list[Actor] = field(default_factory=list)
    steps: list[StepRecord] = field(default_factory=list)
    current: StepRecord = field(default_factory=lambda: StepRecord(0))
    roster: Roster = field(default_factory=lambda: Roster(()))
    scene: SceneParts = field(default_factory=SceneParts)
    events: tuple[Event, ...] = ()
