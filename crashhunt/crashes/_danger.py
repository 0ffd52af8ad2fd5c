"""How dangerous a recorded trial was from step to step: for the agent, and by those behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.world import DangerMeter, dangers, followers_danger

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.recording import Recording
    from crashhunt.world import DangerousMoment

__all__ = ["DangerCourse", "danger_course", "most_dangerous"]

_UNKNOWN_S = 4.0  # before the end: whoever would have been met later is not in the recording


@dataclass(frozen=True, slots=True)
class DangerCourse:
    """The danger of a recorded trial over time, measured after the fact.

    A danger is not a number in steps in which the agent is not there, and where it would be 0 within the last 4 s: it
    is measured by what came afterwards, and that was not recorded.

    Args:
        agent: whose.
        steps: that have a scene.
        own: the danger of each of them that is the agent's own: towards whoever is ahead or crosses its way.
        behind: that of each by those who close in on the agent from behind, on its way.
        greatest: the moment of the greatest own danger.
        greatest_behind: likewise of those behind; ``other`` is who.
        own_total: the integral over the trial, from 0 to below 1: for a trial without a crash and with one agent that
            is what trials are ranked by.
        behind_total: likewise.
    """

    agent: str
    steps: tuple[int, ...]
    own: NDArray[np.float64]
    behind: NDArray[np.float64]
    greatest: DangerousMoment
    greatest_behind: DangerousMoment
    own_total: float
    behind_total: float

    def of_step(self, step: int) -> tuple[float, float] | None:
        """The own danger of a step and that by those behind; None where it has no scene."""
        if step not in self.steps:
            return None
        place = self.steps.index(step)
        return float(self.own[place]), float(self.behind[place])


def danger_course(recording: Recording, agent: str) -> DangerCourse | None:
    """Return the danger of a trial over time; None where the agent is in no scene."""
    steps = tuple(step.step for step in recording.all_steps if step.scene is not None)
    frames = [scene.frame for scene in recording.scenes()]
    if not any(agent in frame.roster.index for frame in frames):
        return None
    dt = recording.prologue.step_length_s
    own, greatest = dangers(frames, [agent], dt)
    meter = DangerMeter([agent], dt)
    meter.add(frames)
    behind, greatest_behind, behind_total = followers_danger(frames, agent, dt)
    there = np.flatnonzero([agent in frame.roster.index for frame in frames])
    known = np.zeros(len(steps), bool)
    known[there] = True
    unsure = np.arange(len(steps)) > there[-1] - _UNKNOWN_S / dt
    return DangerCourse(
        agent,
        steps,
        np.where(known & ((own > 0) | ~unsure), own, np.nan),
        np.where(known & ((behind > 0) | ~unsure), behind, np.nan),
        greatest._replace(step=steps[greatest.step]),
        greatest_behind._replace(step=steps[greatest_behind.step]),
        meter.danger or 0.0,
        behind_total,
    )


def most_dangerous(recording: Recording) -> DangerousMoment | None:
    """Return when which of the controlled vehicles was in the greatest danger; None where none ever was in any."""
    steps = [step.step for step in recording.all_steps if step.scene is not None]
    frames = [scene.frame for scene in recording.scenes()]
    if not frames:
        return None
    _, most = dangers(frames, recording.agents, recording.prologue.step_length_s)
    return most._replace(step=steps[most.step]) if most.danger > 0 else None
