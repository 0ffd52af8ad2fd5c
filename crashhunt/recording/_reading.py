"""What has been read of an episode so far, to which every type of record adds its part."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypedDict

from crashhunt.world import Roster

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.recording.records._agents import Prologue
    from crashhunt.world import Actor, Contact, Event, Scene, Spine

__all__ = ["Reading", "SceneParts", "StepRecord"]


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
