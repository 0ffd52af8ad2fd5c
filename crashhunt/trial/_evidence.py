"""The evidence of a crash: the collision, the software fault, and the last step at which braking avoids it."""

from __future__ import annotations

import errno
import math
import re
from dataclasses import dataclass, field
from typing import Final

from crashhunt.base.codec import OMIT_DEFAULT, Serializable, null_is
from crashhunt.base.signals import is_sent_from_outside
from crashhunt.base.text import encodable

KILLED: Final = "killed from outside"
"""Kind of the failure of a trial whose processes were killed from outside until no attempt was left."""
UNUSABLE_VALUE: Final = "unusable value"
"""Kind of the failure of a trial in which a value of the user's code is neither a bool nor a number."""
_OF_SURROUNDINGS: Final = frozenset({
    errno.EAGAIN, errno.ECONNREFUSED, errno.ECONNRESET, errno.EDQUOT, errno.EHOSTUNREACH, errno.EIO, errno.EMFILE,
    errno.ENETUNREACH, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.EROFS, errno.ESTALE, errno.ETIMEDOUT,
})  # fmt: skip
_ERROR_NUMBER: Final = re.compile(r"\[Errno (\d+)\]")
_USERS: Final = ("agent", "environment", "oracle")


@dataclass(frozen=True, slots=True)
class Collision(Serializable):
    """A collision, or a departure from the road.

    Args:
        agent: The controlled vehicle that collided or left the road.
        role: The agent's role: ``collider`` (it drove into the other actor), ``victim``, or ``alone``.
        collider: Identifier of the actor that drove into the other actor.
        victim: Identifier of the actor that was hit; empty if there was none.
        seen_by: The oracles that detected the collision, sorted by name. If the simulator's report or the overlap of
            outlines is missing here, the two oracles disagree.
        kind: The simulator's type of the collision, such as ``collision`` or ``junction``.
        x: x of the controlled vehicle's front bumper, in m.
        y: y of the controlled vehicle's front bumper, in m.
        lane: The lane of the controlled vehicle.
        collider_speed: Speed of the collider at the first contact, in m/s.
        victim_speed: Speed of the victim at the first contact, in m/s.
        time_s: Simulation time of the first contact, which lies within the step, in s; NaN if it is unknown.
        cell: For a simulator without scenes, the flags and short texts that describe the state after the collision.
            Samplers search for crashes with different cells. The cell does not belong to the crash type, because one
            fault may end in several cells.
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
    cell: str = field(default="", metadata=OMIT_DEFAULT)

    @property
    def other(self) -> str:
        """The collision partner of the agent; empty if the agent was alone."""
        if self.role == "alone":
            return ""
        return self.victim if self.role == "collider" else self.collider


@dataclass(frozen=True, slots=True)
class Escape(Serializable):
    """The last step at which full braking avoids a collision, found by counterfactual runs.

    Args:
        step: Full braking after this step avoids the collision; None if no such step was found.
        too_late: Full braking after this step does not avoid the collision. If ``step`` exists, ``too_late`` is the
            next step.
        braking: The greatest deceleration in these runs, in m/s²; None if the vehicle never slowed down.
        how: A description of the braking, as in `FullBraking`.
        why_not: The reason why neither `step` nor `too_late` is known; empty if one of them is known.
        changed: Further differences of the agent in the run that avoids the collision, such as ``ego does not change
            lanes``.
    """

    step: int | None = None
    too_late: int | None = None
    braking: float | None = None
    how: str = ""
    why_not: str = field(default="", metadata=OMIT_DEFAULT)
    changed: tuple[str, ...] = field(default=(), metadata=OMIT_DEFAULT)


@dataclass(frozen=True, slots=True)
class Failure(Serializable):
    """The evidence of a software fault.

    Args:
        kind: The exception's type, ``exit code``, ``signal``, ``timeout``, ``unusable value`` or ``killed from
            outside``.
        message: The message of the exception or failure, in one line.
        traceback: The traceback of the exception, or the stack of the stuck thread.
        agent: The agent whose code failed; empty if the code was not an agent's.
        party: The owner of the code that failed: ``agent``, ``environment``, ``simulator`` or ``oracle``; empty if it
            is unknown.
        place: The purpose for which this code was called, such as ``act``, ``step`` or ``space conversion``; empty if
            unknown.
        exit_code: The exit code of a process that died; negative for a signal, as in `subprocess`.
        last_output: The last output of the process.
    """

    kind: str = ""
    message: str = ""
    traceback: str = ""
    agent: str = ""
    exit_code: int | None = None
    last_output: str = ""
    party: str = field(default="", metadata=OMIT_DEFAULT)
    place: str = field(default="", metadata=OMIT_DEFAULT)

    def __post_init__(self) -> None:
        # The texts are written to JSON, logs and terminals, but an exception's message may contain invalid characters.
        for name in ("kind", "message", "traceback", "last_output"):
            object.__setattr__(self, name, encodable(getattr(self, name)))

    @property
    def is_of_users_code(self) -> bool:
        """Whether code of the user certainly failed, and not its surroundings: memory, disk, network or a signal.

        A failure of the simulator itself is not certain either: what the user asked of it may be the cause.
        """
        if self.exit_code is not None:
            return self.exit_code >= 0 or not is_sent_from_outside(self.exit_code)
        number = _ERROR_NUMBER.search(self.message)
        lacks = self.kind.endswith("MemoryError") or (number is not None and int(number[1]) in _OF_SURROUNDINGS)
        return not lacks and (bool(self.agent) or self.party in _USERS)
