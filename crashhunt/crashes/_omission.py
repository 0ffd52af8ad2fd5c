"""Results of runs with a reference driver: what the agent failed to do, since when, and for which actor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from crashhunt.base.codec import Serializable

Without = Literal["same", "other", "none", "unclear"]
"""What became of the collision: the same two again, another crash, none, or something that does not say it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRun(Serializable):
    """One run in which a reference driver controls a part of the agent's driving.

    Args:
        faculty: the controlled part: ``longitudinal``, ``lateral`` or ``both``.
        step: the step after which the reference driver takes control.
        ending: what happened to the crash: ``none``, ``same``, ``other`` or ``unclear``.
        changed: further differences from the recorded crash, such as ``ego does not change lanes``.
    """

    faculty: str
    step: int
    ending: Without
    changed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Omission(Serializable):
    """An omission: something that the agent failed to do. In every run without the omission, there is no crash.

    Args:
        faculty: the part of the driving with which a reference driver avoids the crash: ``longitudinal``, ``lateral``
            or ``both``.
        kind: what the agent disregarded. On its path: ``vehicle``, ``red light`` or ``crossing`` (an actor with a
            crossing path). In a lane change: ``ahead``, ``behind``, ``alongside`` or ``no lane``, followed by the side.
        actor: identifier of the disregarded actor; empty for a red light and for a missing lane.
        step: the step after which the omission began.
        instead: what the agent did instead: ``sped up``, ``kept its speed``, ``braked too little`` or ``changed
            lanes``. Whether it sped up is decided over the last 2 s before the crash.
        speed_mps: speed of the agent after that step, in m/s.
        actor_speed_mps: speed of the disregarded actor, in m/s; None if there is no such actor.
        gap_m: gap between the agent and the actor or stop line, in m; negative if the vehicles are side by side. The
            gap is None if there is neither an actor nor a stop line.
        safe: the safe speed for that gap, in m/s; for a lane change, the safe gap in m; None for a missing lane.
        visible_step: the step after which an observation first contained the actor; None if the step is unknown.
        last_speed_mps: speed of the agent just before the crash, in m/s; None for a lane change, or if it is unknown.
        kept_s: time until the crash over which the agent's speed stayed within 0.5 m/s of the last speed, in s. It does
            not exceed the time since the omission began. None for a lane change, or if it is unknown.
    """

    faculty: str
    kind: str
    actor: str
    step: int
    instead: str
    speed_mps: float
    actor_speed_mps: float | None = None
    gap_m: float | None = None
    safe: float | None = None
    visible_step: int | None = None
    last_speed_mps: float | None = None
    kept_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference(Serializable):
    """The results of the runs with a reference driver.

    Args:
        omission: the omission that caused the crash; None if the runs show none.
        runs: all runs in which a reference driver acted.
        why_not: why the result is missing or incomplete; empty if it is complete.
    """

    omission: Omission | None = None
    runs: tuple[ReferenceRun, ...] = ()
    why_not: str = ""

    @property
    def deciding(self) -> tuple[ReferenceRun, ...]:
        """The runs on which the omission rests: of the same part of the driving, from its step or up to 1 s earlier."""
        omission = self.omission
        if omission is None:
            return ()
        return tuple(run for run in self.runs if run.faculty == omission.faculty and run.step <= omission.step)
