"""What a crash leaves behind: who hit whom, what a program did wrong, and when braking would still have helped."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from crashhunt.base.codec import Serializable, null_is
from crashhunt.base.text import encodable

__all__ = ["KILLED", "Collision", "Escape", "Failure"]

KILLED: Final = "killed from outside"
"""Kind of the failure of a trial whose processes were killed from outside until no attempt was left."""


@dataclass(frozen=True, slots=True)
class Collision(Serializable):
    """Who hit whom, or who left the road.

    Args:
        agent: the controlled vehicle that it happened to.
        role: its part: ``collider`` (it drove into the other), ``victim``, or ``alone``.
        collider: the actor that drove into the other.
        victim: the actor that was hit; empty where there was none.
        seen_by: the oracles that saw it, in order of their names. Where one of the simulator's own
            report and the overlap of outlines is missing, the two disagree.
        kind: the simulator's word for it, such as ``collision`` or ``junction``.
        x: of the controlled vehicle's front bumper, in m.
        y: likewise.
        lane: where the controlled vehicle was.
        collider_speed: at the first contact, in m/s.
        victim_speed: likewise.
        time_s: simulation time of the first contact, which lies within the step; NaN where nobody knows.
    """

    agent: str
    role: str
    collider: str
    victim: str = ""
    seen_by: tuple[str, ...] = ()
    kind: str = ""
    x: float = field(default=math.nan, metadata=null_is(math.nan))
    y: float = field(default=math.nan, metadata=null_is(math.nan))
    lane: str = ""
    collider_speed: float = field(default=math.nan, metadata=null_is(math.nan))
    victim_speed: float = field(default=math.nan, metadata=null_is(math.nan))
    time_s: float = field(default=math.nan, metadata=null_is(math.nan))

    @property
    def other(self) -> str:
        """The other party; empty where the agent was alone."""
        if self.role == "alone":
            return ""
        return self.victim if self.role == "collider" else self.collider


@dataclass(frozen=True, slots=True)
class Escape(Serializable):
    """Until when the agent's brakes would have avoided a collision, found out by running the trial again.

    Args:
        step: braking as hard as it can after this step avoids the collision; None where no such step was found.
        too_late: after this step it does not; it is the next one, unless there is no such step.
        braking: the greatest deceleration of those runs, in m/s²; None where it never slowed down.
        how: how it brakes, in words; one of `FullBraking`.
    """

    step: int | None = None
    too_late: int | None = None
    braking: float | None = None
    how: str = ""


@dataclass(frozen=True, slots=True)
class Failure(Serializable):
    """What a program did wrong.

    Args:
        kind: the exception's type, ``exit code``, ``signal``, ``timeout`` or ``killed from outside``.
        message: in one line.
        traceback: of the exception, or the stack of the stuck thread.
        agent: the agent in whose code it happened; empty where it was not an agent's.
        exit_code: of a process that died; negative for a signal, as in `subprocess`.
        last_output: what the process printed last.
    """

    kind: str = ""
    message: str = ""
    traceback: str = ""
    agent: str = ""
    exit_code: int | None = None
    last_output: str = ""

    def __post_init__(self) -> None:
        # It goes into JSON, a log and onto terminals, and what an exception says may be no valid text.
        for name in ("kind", "message", "traceback", "last_output"):
            object.__setattr__(self, name, encodable(getattr(self, name)))
