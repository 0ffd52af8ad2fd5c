"""What a crash leaves behind: who hit whom, what a program did wrong, and when braking would still have helped."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from crashhunt.base.plain import finite
from crashhunt.base.text import encodable
from crashhunt.base.tolerance import known_values

if TYPE_CHECKING:
    from crashhunt.base.plain import Plain
    from crashhunt.trial._data import CollisionData, EscapeData, FailureData

__all__ = ["KILLED", "Collision", "Escape", "Failure"]

KILLED: Final = "killed from outside"
"""Kind of the failure of a trial whose processes were killed from outside until no attempt was left."""


@dataclass(frozen=True, slots=True)
class Collision:
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
    x: float = math.nan
    y: float = math.nan
    lane: str = ""
    collider_speed: float = math.nan
    victim_speed: float = math.nan
    time_s: float = math.nan

    @classmethod
    def from_json(cls, data: Plain) -> Collision:
        """Rebuild it from plain data, in which null stands for a number that nobody knows."""
        known = known_values(cls, data, null=math.nan)
        return cls(**known | {"seen_by": tuple(known.get("seen_by", ()))})

    def to_json(self) -> CollisionData:
        """Return plain data, in which null stands for a number that nobody knows."""
        return {
            "agent": self.agent,
            "role": self.role,
            "collider": self.collider,
            "victim": self.victim,
            "seen_by": self.seen_by,
            "kind": self.kind,
            "x": finite(self.x),
            "y": finite(self.y),
            "lane": self.lane,
            "collider_speed": finite(self.collider_speed),
            "victim_speed": finite(self.victim_speed),
            "time_s": finite(self.time_s),
        }

    @property
    def other(self) -> str:
        """The other party; empty where the agent was alone."""
        if self.role == "alone":
            return ""
        return self.victim if self.role == "collider" else self.collider


@dataclass(frozen=True, slots=True)
class Escape:
    """Until when the agent's brakes would have avoided a collision, found out by running the trial again.

    Args:
        step: braking as hard as it can after this step avoids the collision; None where no such step was found.
        too_late: after this step it does not; it is the next one, unless there is no such step.
        braking: the greatest deceleration of those runs, in m/s²; None where it never slowed down.
        how: how it brakes, in words; one of `FullBraking`.
    """

    step: int | None
    too_late: int | None
    braking: float | None
    how: str

    @classmethod
    def from_json(cls, data: EscapeData) -> Escape:
        """Rebuild it from plain data."""
        return cls(data.get("step"), data.get("too_late"), data.get("braking"), data.get("how", ""))

    def to_json(self) -> EscapeData:
        """Return plain data."""
        return {"step": self.step, "too_late": self.too_late, "braking": self.braking, "how": self.how}


@dataclass(frozen=True, slots=True)
class Failure:
    """What a program did wrong.

    Args:
        kind: the exception's type, ``exit code``, ``signal``, ``timeout`` or ``killed from outside``.
        message: in one line.
        traceback: of the exception, or the stack of the stuck thread.
        agent: the agent in whose code it happened; empty where it was not an agent's.
        exit_code: of a process that died; negative for a signal, as in `subprocess`.
        last_output: what the process printed last.
    """

    kind: str
    message: str
    traceback: str = ""
    agent: str = ""
    exit_code: int | None = None
    last_output: str = ""

    @classmethod
    def from_json(cls, data: Plain) -> Failure:
        """Rebuild it from plain data."""
        return cls(**{"kind": "", "message": "", **known_values(cls, data)})

    def to_json(self) -> FailureData:
        """Return plain data."""
        return {
            "kind": self.kind,
            "message": self.message,
            "traceback": self.traceback,
            "agent": self.agent,
            "exit_code": self.exit_code,
            "last_output": self.last_output,
        }

    def __post_init__(self) -> None:
        # It goes into JSON, a log and onto terminals, and what an exception says may be no valid text.
        for name in ("kind", "message", "traceback", "last_output"):
            object.__setattr__(self, name, encodable(getattr(self, name)))
