"""Time limits of trials and imports, including the time to write a stack before a kill."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.signals import describe_death

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.recording import BlackBoxHeader


START_UP_S = 60.0  # for Python and the agent to be imported and the simulator to be made, before a trial's time runs
_PAUSE_S = 2.0  # without a look, after which a process was suspended; a busy machine delays it less
_LAST_WORDS_S = 0.2  # after its time limit, for a hung process to write down where it is stuck
_NO_WORDS_S = 3.0  # the same, on a machine that has no time for it at once


class PauseMeter:
    """Measures how long this process, and with it every process of the hunt, was suspended.

    A container or a batch system suspends all processes of a job at once. This time does not count for time limits. The
    owner calls `paused_s` many times a second, so a longer time between two calls is a suspension.
    """

    def __init__(self) -> None:
        self._looked_at = time.monotonic()
        self._paused_s = 0.0

    def paused_s(self) -> float:
        """Return the total time for which this process was suspended, in s."""
        now = time.monotonic()
        if now - self._looked_at > _PAUSE_S:
            self._paused_s += now - self._looked_at
        self._looked_at = now
        return self._paused_s


def has_hung(
    header: BlackBoxHeader | None, *, begun: bool, given_at: float, limit_s: float, has_words: Callable[[], bool]
) -> bool:
    """Return whether a trial exceeds its time limit.

    Args:
        header: header of the trial's black box; None if there is none.
        begun: whether the process of the trial itself wrote the header. If the process has not written it, `START_UP_S`
            is added to the limit.
        given_at: time at which the process received the trial, on the clock `time.monotonic`.
        limit_s: wall-time limit of the trial from its beginning on, in s.
        has_words: function that returns whether the process has written its stack.
    """
    now, began, allowed_s = time.monotonic(), given_at, limit_s
    if header is None or not begun:
        allowed_s += START_UP_S
    elif given_at <= header.started <= now:  # later than it began by what copies of it took; an agent may forge it
        began = header.started
    over_s = now - began - allowed_s
    return over_s > _LAST_WORDS_S and (over_s > _NO_WORDS_S or has_words())


# The time limit for importing what trials need, and the errors that name the module at which an import hung or died.
#
# A process imports the agents, and reports each module before it begins. Another process, without foreign code, keeps
# an `ImportWatch`, as only that one is left to report when a module hangs or ends its process.

_MAX_MESSAGE_CHARACTERS = 200  # characters of a message; foreign code may write its own
_IMPORT_FIX = "see what the module does when it is imported"


class ImportWatch:
    """Records what a process is importing, and detects imports that take too long.

    Args:
        timeout_s: wall-clock limit of a trial, in s; imports may take `START_UP_S` longer.
    """

    def __init__(self, timeout_s: float) -> None:
        # the error to report if the process never reports again, such as "the module 'planner' of agent ego cannot be
        # imported"; empty if all imports are complete
        self.importing = "what trials need cannot be imported"
        self._limit_s = START_UP_S + timeout_s
        self._ends_at = time.monotonic() + self._limit_s
        self._pauses = PauseMeter()

    def begin(self, importing: object) -> None:
        """Record the import that the process begins."""
        self.importing = str(importing)[:_MAX_MESSAGE_CHARACTERS]

    @property
    def has_hung(self) -> bool:
        """Return whether the imports take too long."""
        return bool(self.importing) and time.monotonic() > self._ends_at + self._pauses.paused_s()

    def hung(self) -> CrashhuntError:
        """Return the error of an import that takes too long."""
        return CrashhuntError(
            f"{self.importing}: it takes more than {self._limit_s:g} s",
            fix=f"{_IMPORT_FIX}, or give it more time with --timeout",
        )


def import_died(importing: str, exit_code: int, *, times: int = 1) -> CrashhuntError:
    """Return the error of an import that ended its process.

    ``importing`` describes the failed import, as in `ImportWatch`. The exit code is negative for a signal.
    """
    again = f", {times} times" if times > 1 else ""
    return CrashhuntError(
        f"{importing}: its process {describe_death(exit_code)} meanwhile{again}",
        fix=f"{_IMPORT_FIX}, or raise the limits on memory (ulimit -v) and processes (ulimit -u)",
    )
