"""Copies of this process, made by fork: each goes on exactly where it is, writes to nothing of it, and ends with it.

A file that is being read has its place in common with whoever else has it open: SUMO reads a long file of routes bit by
bit. So a copy opens it anew, at the same place. What is written to is replaced by something of the copy's own. What a
copy cannot have is refused: threads, devices, connections to other processes, memory that is shared with them.
"""

from __future__ import annotations

import faulthandler
import fcntl
import gc
import json
import os
import random
import select
import signal
import stat
import sys
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from crashhunt.base.answers import NoAnswer, explain_silence, parse_answer, took_longer
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.processes import adopt_orphans, children_of, die_with, end_descendants, has_child, kill

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping
    from typing import TextIO

    from crashhunt.base.plain import Plain

__all__ = [
    "MEMORY",
    "CannotForkError",
    "Copy",
    "Held",
    "NoProcessError",
    "Watchdog",
    "children_now",
    "copying",
    "end_orphans",
    "ended",
    "ends",
    "fork",
    "held",
    "shared_memory",
    "threads",
    "watchdog",
]

MEMORY = "crashhunt-copy"
"""What memory is called that is a copy's own, and that a copy of it gets anew from whoever knows what it is."""
_FILE = "crashhunt-file"
_HARMLESS = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/tty", "/dev/pts/")
_LARGEST = 16 << 20  # bytes of a file that is written and read again
_RECEIVED = 1 << 16
_copying = False
ends: set[int] = set()
"""Descriptors by which copies of this process are talked to, and it to what it is a copy of; a copy has none."""
_alive: set[int] = set()  # copies of this process

# Kept apart from what an agent may put in their place.
_fork, _leave, _dumps = os.fork, os._exit, json.dumps


class CannotForkError(CrashhuntError):
    """This process cannot be copied."""


class NoProcessError(CannotForkError):
    """The system does not start another process now: too many, or too little memory. It may do so later."""


class Watchdog:
    """Writes down where a process is at a time limit; its thread stands back while the process is copied.

    Attributes:
        file: where to; None where nobody counts.
        threads: its own.
    """

    def __init__(self) -> None:
        self.file: TextIO | None = None
        self.threads: frozenset[str] = frozenset()
        self._until = 0.0

    def arm(self, limit_s: float, file: TextIO) -> None:
        """Begin to count, in s of wall time."""
        self.file, self._until = file, time.monotonic() + limit_s
        before = threads()
        faulthandler.dump_traceback_later(limit_s, file=file)
        # The kernel may show it for a while after it was told to end.
        self.threads = (self.threads & before) | (threads() - before)

    def cancel(self) -> None:
        """Let it be."""
        self.file = None
        faulthandler.cancel_dump_traceback_later()

    def extend(self, wall_s: float) -> None:
        """Count so much longer, in s."""
        if self.file is not None:
            left, file = self._until - time.monotonic() + wall_s, self.file
            self.cancel()
            self.arm(max(left, 1e-3), file)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Count no further; whoever comes out of it goes on counting: this process alone, and no copy."""
        if self.file is None:
            yield
            return
        faulthandler.cancel_dump_traceback_later()
        left, owner = self._until - time.monotonic(), os.getpid()
        try:
            yield
        finally:
            if os.getpid() == owner and self.file is not None:
                self.arm(max(left, 1e-3), self.file)


def threads() -> frozenset[str]:
    """Return the ids of the threads of this process; none elsewhere than on Linux."""
    try:
        return frozenset(os.listdir("/proc/self/task"))  # noqa: PTH208 - names are enough
    except OSError:
        return frozenset()


watchdog = Watchdog()
"""That of this process: there is one."""


@dataclass(frozen=True, slots=True)
class Held:
    """What this process has open before somebody's code runs in it: that is nobody's business in a copy.

    Args:
        files: descriptor to what it is.
        children: processes.
        shared: names of memory that is shared with others; None where that is not looked at, which takes milliseconds.
    """

    files: Mapping[int, str] = field(default_factory=dict)
    children: frozenset[int] = frozenset()
    shared: frozenset[str] | None = frozenset()


def held(shared: frozenset[str] | None = None) -> Held:
    """Return what this process has open now.

    Args:
        shared: as `Held` has it, where somebody knows already.
    """
    if sys.platform != "linux":
        return Held()
    return Held(_open(), children_now(), shared)


def shared_memory() -> frozenset[str]:
    """Return the names of the memory that this process shares with whoever else has it, and writes to."""
    if sys.platform != "linux":
        return frozenset()
    with Path("/proc/self/maps").open("rb") as lines:
        names = [line.split(maxsplit=5)[-1] for line in lines if b" rw-s " in line]
    return frozenset(os.fsdecode(name.strip()) for name in names if MEMORY.encode() not in name)


def copying() -> bool:
    """Whether the fork that takes place is one of these; for handlers that look after forks of an agent's."""
    return _copying


class Copy:
    """A copy that does something, and says what came of it.

    Args:
        work: what the copy does; what it returns is expressible as JSON.
        known: what was open before somebody's code ran.

    Raises:
        CannotForkError: this process cannot be copied.

    Attributes:
        pid: its process.
        raised: the exception that has ended it, in words; empty where there was none.
        no_answer: why `answer` has returned None.
    """

    def __init__(self, work: Callable[[], Plain], known: Held | None = None) -> None:
        self.raised, self._children = "", children_now()
        self.no_answer: NoAnswer | None = None
        self._end, theirs = os.pipe()
        ends.add(self._end)

        def answer() -> None:
            try:
                said: Plain = {"answer": work()}
            except BaseException as error:
                said = {"raised": f"{type(error).__name__}: {error}"}
            end_descendants()
            text = _dumps(said).encode() + b"\n"
            while text:
                text = text[os.write(theirs, text) :]

        try:
            self.pid = fork(answer, known, keeps=(theirs,))
        except BaseException:
            self._close()
            raise
        finally:
            os.close(theirs)

    def answer(self, timeout_s: float) -> Plain | None:
        """Wait for what came of it, and end it; None where it raised something, died, or took longer.

        Args:
            timeout_s: wall time that it has, in s.
        """
        received, deadline = bytearray(), time.monotonic() + timeout_s
        try:
            while not received.endswith(b"\n"):
                ready, _, _ = select.select([self._end], [], [], max(0.0, deadline - time.monotonic()))
                data = os.read(self._end, _RECEIVED) if ready else b""
                if not data:
                    self.no_answer = explain_silence(self.pid) if ready else took_longer(timeout_s)
                    return None
                received += data
            answer, self.raised, self.no_answer = parse_answer(received)
            return answer
        finally:
            self.end()
            if self.no_answer is not None:
                end_orphans(self._children)

    def end(self) -> None:
        """End it, whatever it is doing; may be called twice."""
        if self._end >= 0:
            kill(self.pid)
            ended(self.pid)
            self._close()

    def _close(self) -> None:
        ends.discard(self._end)
        os.close(self._end)
        self._end = -1


def end_orphans(children: frozenset[int]) -> None:
    """End what a killed copy has left to this process, which cannot be copied with it; older children stay."""
    end_descendants(children | _alive)


def ended(pid: int) -> int:
    """Wait for the end of a copy; return its exit code, negative for a signal."""
    _alive.discard(pid)
    with suppress(ChildProcessError):
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return 0


def fork(work: Callable[[], object], known: Held | None = None, *, keeps: Collection[int] = ()) -> int:
    """Copy this process; the copy does something, and is over.

    Args:
        work: what the copy does. It has no output, and what it raises is lost.
        known: what was open before somebody's code ran; None where nobody knows, and then it may be anybody's.
        keeps: descriptors that it needs, such as an end of a pipe.

    Returns:
        The process, which whoever called has to wait for.

    Raises:
        CannotForkError: this process cannot be copied.
    """
    global _copying
    if sys.platform != "linux":
        raise CannotForkError("processes are copied on Linux only")
    parent = os.getpid()
    with watchdog.paused():
        replaced, drawn = _replacements(known or Held(), keeps), random.getstate()
        _copying = True
        try:
            pid = _fork()
        except OSError as error:
            raise NoProcessError(f"no process could be started: {error.strerror}") from error
        finally:
            _copying = False
        if pid == 0:
            random.setstate(drawn)  # Python seeds it anew in whatever is forked
            _be_copy(parent, work, replaced, keeps)
    _alive.add(pid)
    return pid


def _be_copy(
    parent: int, work: Callable[[], object], replaced: list[tuple[int, int, int]], keeps: Collection[int]
) -> NoReturn:
    code = 1
    try:
        die_with(parent)
        adopt_orphans()
        gc.freeze()  # walking what was there before would make pages of the copy's own of it
        watchdog.file = None
        faulthandler.disable()
        faulthandler.unregister(signal.SIGUSR1)
        _replace(replaced)
        _alive.clear()
        ends.clear()
        ends.update(keeps)
        work()
        code = 0
    finally:
        _leave(code)


_CLOSE, _NOTHING, _READ, _OWN = range(4)  # what becomes of a descriptor in a copy


def _replacements(known: Held, keeps: Collection[int]) -> list[tuple[int, int, int]]:
    """What is to become of each descriptor in a copy, and where in it this process is.

    Raises:
        CannotForkError: one of them, or something else, has no copy.
    """
    others = len(threads() - watchdog.threads) - 1
    if others > 0:
        raise CannotForkError(f"threads have no copy, and {others} run{'s' * (others == 1)} besides the first")
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        raise CannotForkError("a graphics card has no copy, and PyTorch uses one")
    if children_now() - known.children - _alive:
        raise CannotForkError("a process that was started has no copy")
    for name in shared_memory() - known.shared if known.shared is not None else ():
        raise CannotForkError(f"memory that is shared with others has no copy: {name}")
    return [
        (descriptor, *_replacement(descriptor, what, known))
        for descriptor, what in _open().items()
        if descriptor not in keeps
    ]


def _replacement(descriptor: int, what: str, known: Held) -> tuple[int, int]:
    flags = fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE
    mode = os.fstat(descriptor).st_mode
    ours = descriptor in ends or known.files.get(descriptor) == what
    if descriptor in (1, 2):
        return _NOTHING, 0
    if stat.S_ISREG(mode):
        place = os.lseek(descriptor, 0, os.SEEK_CUR)
        if flags == os.O_RDONLY:
            return _READ, place
        if flags == os.O_WRONLY or ours or MEMORY in what:
            return _NOTHING, 0
        if os.fstat(descriptor).st_size > _LARGEST:
            raise CannotForkError(f"a file that is written and read has no copy when it is so large: {what}")
        return _OWN, place
    if stat.S_ISDIR(mode) or what.startswith(_HARMLESS):
        return _READ if stat.S_ISDIR(mode) else _NOTHING, 0
    if ours:
        return _NOTHING if descriptor == 0 else _CLOSE, 0
    kind = "a device" if stat.S_ISCHR(mode) or stat.S_ISBLK(mode) else "a connection to others"
    raise CannotForkError(f"{kind} has no copy: {what}")


def _replace(replaced: list[tuple[int, int, int]]) -> None:
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor, how, place in replaced:
        if how == _CLOSE:
            os.close(descriptor)
            continue
        new = nothing
        if how == _READ:
            new = os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY)
        elif how == _OWN:
            new = os.memfd_create(_FILE)
            os.sendfile(new, descriptor, 0, _LARGEST)
        if new != nothing:
            os.lseek(new, place, os.SEEK_SET)
        os.dup2(new, descriptor, inheritable=os.get_inheritable(descriptor))
        if new != nothing:
            os.close(new)
    os.close(nothing)


def children_now() -> frozenset[int]:
    """Return the children of this process."""
    return frozenset(children_of(os.getpid())) if has_child() else frozenset()


def _open() -> dict[int, str]:
    found = {}
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names are enough
        with suppress(OSError):  # the one that was listed by
            found[int(name)] = os.readlink(f"/proc/self/fd/{name}")  # noqa: PTH115
    return found
