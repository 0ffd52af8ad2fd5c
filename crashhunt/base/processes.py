"""Trees of processes: that none outlives whoever asked for it, whatever becomes of either.

An agent may start programs, and these may leave their session, their group and their parent. On Linux, a process can
be made the one to whom every orphan below it is handed (a *subreaper*): so the whole tree can be found and ended.
Elsewhere, what an agent has started stays.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

__all__ = ["adopt_orphans", "children_of", "die_with", "end_descendants", "has_child", "is_alive", "kill", "resume"]

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36  # of <sys/prctl.h>
_libc = ctypes.CDLL(None) if sys.platform == "linux" else None  # looked up once, and not in every copy of this process
_PATIENCE_S = 2.0  # for processes that do not die at once; those of another user never do


def adopt_orphans() -> None:
    """Have every process below this one whose parent ends handed to this one, as its child."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def die_with(parent: int) -> None:
    """Have the kernel end this process when its parent does, whatever it is doing; ends it where that has happened.

    What counts is the *thread* that started this process, so that has to be one that stays.
    """
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before the kernel had been told
        os._exit(1)


def children_of(pid: int) -> list[int]:
    """Return the children of a process; none where nobody can say."""
    found: list[int] = []
    try:
        for thread in Path(f"/proc/{pid}/task").iterdir():
            found += map(int, (thread / "children").read_text().split())
    except FileNotFoundError:
        if Path(f"/proc/{pid}").exists() and not Path("/proc/self/task", str(os.getpid()), "children").exists():
            return _children_by_search(pid)  # a kernel without CONFIG_PROC_CHILDREN
    except OSError:
        pass  # it ended meanwhile
    return found


def end_descendants(spared: frozenset[int] = frozenset()) -> bool:
    """Kill every process below this one, which has called `adopt_orphans`, and reap it.

    Args:
        spared: children that stay, with all that is below them.

    Returns:
        Whether there was one.
    """
    found = False
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        if not spared and not has_child():
            return found
        doomed = [pid for pid in children_of(os.getpid()) if pid not in spared]
        if not doomed:
            return found
        for pid in doomed:
            with suppress(ChildProcessError):  # whoever started it has reaped it meanwhile
                if os.waitpid(pid, os.WNOHANG)[0] == 0:
                    found = True
                    _kill_below(pid)
        time.sleep(0.001)
    return found


def kill(pid: int) -> None:
    """Kill a process, if it is there."""
    with suppress(ProcessLookupError, PermissionError):
        os.kill(pid, signal.SIGKILL)


def resume(pid: int) -> None:
    """Resume a process that was stopped, as by SIGSTOP; nothing happens where it runs."""
    with suppress(OSError, IndexError):
        if Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[0] == b"T":
            os.kill(pid, signal.SIGCONT)


def is_alive(pid: int) -> bool:
    """Whether there is such a process; one that has ended and was not reaped counts."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _kill_below(pid: int) -> None:
    """Kill a process and all below it; what forks meanwhile is handed upwards, and found in the next round."""
    below = children_of(pid)
    kill(pid)
    for child in below:
        _kill_below(child)


def has_child() -> bool:
    """Whether this process has a child; one that has ended and was not reaped counts."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


def _children_by_search(pid: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, IndexError, ValueError):
            if int(stat.read_text(errors="replace").rpartition(")")[2].split()[1]) == pid:
                found.append(int(stat.parent.name))
    return found


def _prctl(option: int, value: int) -> None:
    if _libc is not None:
        _libc.prctl(option, value, 0, 0, 0)
