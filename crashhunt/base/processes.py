"""Process trees that end together with the process that owns them.

An agent may start programs, and these may leave their session, their group and their parent. A process can adopt all
orphans below it (*subreaper*, prctl(2)), so `end_descendants` finds and ends the whole tree.
"""

from __future__ import annotations

import ctypes
import os
import signal
import time
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from crashhunt.base.signals import blocked_signals

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterator, Sequence

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36  # of <sys/prctl.h>
_libc = ctypes.CDLL(None)  # looked up once, not in every fork
_PATIENCE_S = 2.0  # for processes that do not die at once; processes of another user never do


def adopt_orphans() -> None:
    """Make this process the new parent of every process below it whose parent ends."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def die_with(parent: int, number: int = signal.SIGKILL) -> None:
    """Make the kernel end this process when its parent ends; exit at once if the parent has already ended.

    The kernel watches the *thread* that started this process, so this thread must stay alive.
    """
    _prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:  # it died before the prctl call
        os._exit(1)


@contextmanager
def running(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """Yield the process of a program, which ends at the end of the context or of this process.

    ``options`` are those of `subprocess.Popen`. Signals have their default effect on the program.
    """
    import subprocess  # here, because most commands start no program

    begin = partial(_begin, os.getpid(), signal.pthread_sigmask(signal.SIG_BLOCK, ()))
    child: subprocess.Popen[Any] | None = None
    try:
        with blocked_signals():  # Python drops a KeyboardInterrupt that comes in its own hooks around a fork
            child = subprocess.Popen(command, preexec_fn=begin, **options)
        yield child
    finally:
        if child is not None:
            child.kill()
            child.wait()
            for pipe in filter(None, (child.stdout, child.stderr)):
                pipe.close()


def _begin(parent: int, mask: set[signal.Signals | int]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    die_with(parent)


@contextmanager
def exits_refused() -> Iterator[None]:
    """Return a context in which `os._exit` raises `SystemExit` in this process.

    If foreign code could end a command, the command would look complete. A fork of this process may still end itself.
    """
    leave, owner = os._exit, os.getpid()

    def refuse(status: int) -> NoReturn:
        if os.getpid() != owner:
            leave(status)
        raise SystemExit(f"os._exit({status})")

    os._exit = refuse
    try:
        yield
    finally:
        os._exit = leave


def exit_as(code: int) -> NoReturn:
    """End this process with the exit code of another one; a negative code is the signal that ended it."""
    if code < 0:
        import resource

        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # that of the other process, if there is one, is enough
        if -code not in (signal.SIGKILL, signal.SIGSTOP):
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code & 0xFF)


def outlive_parent() -> None:
    """Undo `die_with`: this process continues when its parent ends."""
    _prctl(_PR_SET_PDEATHSIG, 0)


def children_of(pid: int) -> list[int]:
    """Return the process ids of the children of a process; empty if the system does not report them."""
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


def descendants_of(pid: int) -> list[int]:
    """Return the process ids of all processes below a process; empty if the system does not report them."""
    found = children_of(pid)
    return [*found, *(below for child in found for below in descendants_of(child))]


def end_descendants(spared: frozenset[int] = frozenset()) -> None:
    """Kill and reap every process below this process, which must have called `adopt_orphans`.

    Args:
        spared: process ids of children that are not killed, nor the processes below them.
    """
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        if not spared and not has_child():
            return
        doomed = [pid for pid in children_of(os.getpid()) if pid not in spared]
        if not doomed:
            return
        for pid in doomed:
            with suppress(ChildProcessError):  # its parent code has reaped it in the meantime
                if os.waitpid(pid, os.WNOHANG)[0] == 0:
                    _kill_below(pid)
        time.sleep(0.001)


def kill(pid: int) -> None:
    """Kill a process if it exists."""
    with suppress(ProcessLookupError, PermissionError):
        os.kill(pid, signal.SIGKILL)


def resume(pid: int) -> None:
    """Resume a stopped process, for example after SIGSTOP; a running process is not affected."""
    with suppress(OSError, IndexError):
        if Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[0] == b"T":
            os.kill(pid, signal.SIGCONT)


def is_alive(pid: int) -> bool:
    """Return whether a process exists; a zombie counts as existing."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _kill_below(pid: int) -> None:
    """Kill a process and all processes below it; those forked in the meantime become orphans for the next round."""
    below = children_of(pid)
    kill(pid)
    for child in below:
        _kill_below(child)


def has_child() -> bool:
    """Return whether this process has a child process; a zombie counts."""
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
    _libc.prctl(option, value, 0, 0, 0)
