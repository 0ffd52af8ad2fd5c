"""Results of runs with a reference driver: what the agent omitted, since when, and for which actor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from crashhunt.base.codec import Serializable

__all__ = ["Omission", "Reference", "ReferenceRun", "Without"]

Without = Literal["same", "other", "none", "unclear"]
"""What became of the collision: the same two again, another crash, none, or something that does not say it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRun(Serializable):
    """One run in which a reference driver takes a faculty over.

    Args:
        faculty: ``longitudinal``, ``lateral`` or ``both``.
        step: the step after which the reference driver takes over.
        ending: what became of the crash: ``none``, ``same``, ``other`` or ``unclear``.
        changed: further differences from the recorded crash, such as ``ego does not change lanes``.
    """

    faculty: str
    step: int
    ending: Without
    changed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Omission(Serializable):
    """An omission of an agent. Without the omission there is no crash, in every run.

    Args:
        faculty: faculty with which a reference driver avoids the crash: ``longitudinal``, ``lateral`` or ``both``.
        kind: what the agent disregarded. On its path: ``vehicle``, ``red light`` or ``crossing``, an actor whose path
            crosses. In a lane change: ``ahead``, ``behind``, ``alongside`` or ``no lane``, followed by the side.
        actor: the actor that it disregarded; empty for a red light and a missing lane.
        step: the step after which the omission began.
        instead: what the agent did: ``sped up``, ``kept its speed``, ``braked too little`` or ``changed lanes``.
        speed_mps: speed of the agent after that step, in m/s.
        actor_speed_mps: actor speed of the actor, in m/s; None without an actor.
        gap_m: gap between them, in m; negative alongside each other; None without an actor or a stop line.
        safe: the safe speed for that gap in m/s; in a lane change the safe gap in m; None for a missing lane.
        visible_step: the step after which an observation first had the actor; None if that is unknown.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference(Serializable):
    """The results of the runs with a reference driver.

    Args:
        omission: the cause; None if no run says so.
        runs: all runs with a reference driver that acts.
        why_not: why the result is missing or incomplete; empty if it is complete.
    """

    omission: Omission | None = None
    runs: tuple[ReferenceRun, ...] = ()
    why_not: str = ""

    @property
    def deciding(self) -> tuple[ReferenceRun, ...]:
        """The runs on which the omission rests: those with its faculty, from its step or up to 1 s earlier."""
        omission = self.omission
        if omission is None:
            return ()
        return tuple(run for run in self.runs if run.faculty == omission.faculty and run.step <= omission.step)
