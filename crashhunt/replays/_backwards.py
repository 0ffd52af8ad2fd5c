"""Backwards in the debugger: before each of the last steps, a copy of the process waits for somebody to come back.

The process goes on in a fork, and waits for its end; it has the terminal again when that ends to go back. So whoever
goes back finds everything as it was, and nothing of what came after.
"""

from __future__ import annotations

import fcntl
import os
import random
import signal
import stat
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from crashhunt.base.forks import threads
from crashhunt.base.processes import die_with
from crashhunt.episode import Observer

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.replays._debugger import _Stop
    from crashhunt.world import Scene

__all__ = ["Backwards", "OneLine"]

_MOST = 50  # steps; what has changed since is kept for each
_BACK = 78  # exit code
_TARGET = "back"


class Backwards(Observer):
    """Leaves a copy behind before each of the last steps before the debugger stops; it comes before what stops.

    Args:
        stop: what stops.
        step: in which it does; 0 for none.
        folder: where the copies tell each other how far to go back.
    """

    def __init__(self, stop: _Stop, step: int, folder: Path) -> None:
        self._stop = stop
        self._last = step
        self._file = folder / _TARGET
        self._first = 0  # step to which somebody may go back; 0 for none

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        if max(1, self._last - _MOST) <= step + 1 < self._last:
            self._leave_behind(step + 1)

    def go(self, step: int) -> str:
        """Go back to a step; return why not, where that cannot be."""
        if not self._first or step < self._first:
            how = f"to step {self._first} at most" if self._first else "nowhere from here"
            return f"it goes back {how}"
        self._file.write_text(str(step), encoding="ascii")
        sys.stdout.flush()
        os._exit(_BACK)

    def _leave_behind(self, step: int) -> None:
        """Go on in a copy of this process; come back from here only if somebody goes back to this step."""
        torch = sys.modules.get("torch")
        if len(threads()) > 1 or (torch is not None and torch.cuda.is_initialized()):
            self._first = 0  # they have no copy, and what was left behind before is not missed by anybody
            return
        places, drawn, here = _places(), random.getstate(), os.getpid()
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            random.setstate(drawn)  # Python seeds it anew in whatever is forked
            die_with(here)
            self._first = self._first or step
            return
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for whoever has the terminal
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        signal.signal(signal.SIGINT, before)
        if code != _BACK:
            _end_with(code)
        target = int(self._file.read_text(encoding="ascii"))
        if target != step:
            os._exit(_BACK)
        for descriptor, place in places.items():  # which the copy has read further
            with suppress(OSError):
                os.lseek(descriptor, place, os.SEEK_SET)
        self._stop.stop_at(step)
        self._last = step


class OneLine:
    """Standard input that is read a line at a time, so that the rest is there for whoever has it next."""

    encoding = "utf-8"

    def readline(self) -> str:
        """Return the next line; nothing at the end."""
        line = b""
        while not line.endswith(b"\n") and (byte := os.read(0, 1)):
            line += byte
        return line.decode("utf-8", "replace")


def _places() -> dict[int, int]:
    """Where this process is in the files that it reads."""
    found = {}
    for name in os.listdir("/proc/self/fd") if sys.platform == "linux" else ():  # noqa: PTH208 - names are enough
        with suppress(OSError):
            read = fcntl.fcntl(int(name), fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY
            if int(name) > 2 and read and stat.S_ISREG(os.fstat(int(name)).st_mode):
                found[int(name)] = os.lseek(int(name), 0, os.SEEK_CUR)
    return found


def _end_with(code: int) -> NoReturn:
    """End as the copy did."""
    if code < 0:
        with suppress(OSError, ValueError):
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)
