"""Forks of this process that continue at its current step, cannot change its files, and end with it.

The kernel copies the memory for a fork. This module handles all other resources, which fork(2) leaves shared.

Invariant: a fork changes no file or pipe through a descriptor that it has inherited, and does not outlive its parent.
Every open descriptor is therefore handled in one of four ways before the work begins (`_replacement`):

- A file that this process reads is opened again at the same position. Parent and fork otherwise share one position, and
  SUMO reads long route files in parts.
- A file that this process writes is replaced by ``/dev/null`` in the fork. A file that this process both writes and
  reads is replaced by a private copy in memory.
- A file descriptor of crashhunt itself is closed.
- Threads, devices, connections and shared memory cannot be copied, so the fork is refused (`CannotForkError`).

Reason for forks instead of saved states of the simulator: after SUMO's `loadState`, a run differs from the original
run, even with saved random generators. A fork copies the whole memory, including that of libraries and of the agent.

Cost: the kernel copies page tables, and later every page that parent or fork writes. ``gc.freeze`` prevents
Python's garbage collector from writing to all other pages. Sources: fork(2), prctl(2), proc(5).
"""

from __future__ import annotations

import faulthandler
import fcntl
import gc
import json
import math
import os
import random
import select
import signal
import stat
import sys
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TextIO

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.processes import adopt_orphans, children_of, die_with, end_descendants, has_child, kill
from crashhunt.base.signals import describe_death, is_sent_from_outside

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

    from crashhunt.base.json_types import Plain


# Answers of forks of this process, and reasons why an answer is missing.

_ENDS_S = 1.0  # wall time within which a process with a closed pipe ends
_LOOK_EVERY_S = 0.002  # between two checks of whether a process has ended
_CHECK_EVERY_S = 0.2  # the same, of one whose answer is awaited


@dataclass(frozen=True, slots=True)
class NoAnswer:
    """The reason why a fork returned no answer."""

    why: str  # the reason as a clause without a subject, such as "was killed by SIGKILL"
    # whether another process or the system may be the cause, so that another fork may return an answer
    is_from_outside: bool = False


def parse_answer(received: bytes | bytearray) -> tuple[Plain | None, str, NoAnswer | None]:
    """Parse the data that a fork has sent: return its answer, the text of its exception, and why an answer is missing.

    Code of the agent may have written to the same pipe, so the data may contain anything.
    """
    try:
        said = json.loads(received)
        found, raised, abandoned = said.get("answer"), str(said.get("raised", "")), str(said.get("abandoned", ""))
    except (ValueError, AttributeError):
        return None, "", NoAnswer("sent data that are no answer")
    if abandoned:
        return None, raised, NoAnswer(abandoned)
    if not isinstance(found, dict):
        return None, raised, NoAnswer(f"raised {raised}" if raised else "sent data that are no answer")
    return found, raised, None


def took_longer(timeout_s: float) -> NoAnswer:
    """Return the reason for a missing answer after a time limit, in s of wall time."""
    return NoAnswer(f"took longer than {timeout_s:g} s")


def write_all(file: int, data: bytes) -> None:
    """Write data to a pipe, which may take only a part of them at a time."""
    while data:
        data = data[_write(file, data) :]


def explain_silence(pid: int) -> NoAnswer:
    """Return why a fork with a closed pipe has sent no answer; the caller still has to end its process."""
    deadline = time.monotonic() + _ENDS_S
    try:
        while (end := os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG)) is None:
            if time.monotonic() > deadline:
                return NoAnswer("closed its connection to the trial")
            time.sleep(_LOOK_EVERY_S)
    except ChildProcessError:
        return NoAnswer("ended, and code of the agent has taken its exit code")
    exit_code = end.si_status if end.si_code == os.CLD_EXITED else -end.si_status
    return NoAnswer(describe_death(exit_code), is_sent_from_outside(exit_code))


MEMORY = "crashhunt-copy"
"""Prefix of the names of memory files that belong to one fork. A fork of a fork replaces such a file explicitly."""
_COPIED_FILE_NAME = "crashhunt-file"
_SHAREABLE_DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/tty", "/dev/pts/")
_MAX_COPIED_FILE_BYTES = (
    16 << 20
)  # bytes: a larger file that is both written and read is not copied, because copying takes too long
_PIPE_CHUNK_BYTES = 1 << 16  # bytes per read: the capacity of a pipe on Linux
_copying = False
ends: set[int] = set()
"""Descriptors of pipes to the forks of this process and, inside a fork, to its parent. Forks do not inherit them."""
_alive: set[int] = set()  # copies of this process, and processes that its copies do without
_answers_to: list[int] = []  # the pipe to the process that awaits the answer of this fork

# Keep references: an agent may replace these functions.
_fork, _leave, _dumps, _loads, _write = os.fork, os._exit, json.dumps, json.loads, os.write


class CannotForkError(CrashhuntError):
    """This process cannot be forked."""


class NoProcessError(CannotForkError):
    """The system cannot start another process at present, because of the number of processes or the memory."""


class Watchdog:
    """Writes the traceback of a process after a time limit. The thread of the watchdog is stopped during a fork."""

    def __init__(self) -> None:
        self.file: TextIO | None = None  # the file to which the traceback is written; None while no time limit is set
        self.threads: frozenset[str] = frozenset()  # ids of the watchdog's own threads
        self._until = 0.0

    def arm(self, limit_s: float, file: TextIO) -> None:
        """Start the time limit, in s of wall time."""
        self.file, self._until = file, time.monotonic() + limit_s
        before = threads()
        faulthandler.dump_traceback_later(limit_s, file=file)
        # The kernel may list the previous thread for a while after its cancellation.
        self.threads = (self.threads & before) | (threads() - before)

    def cancel(self) -> None:
        """Stop the time limit."""
        self.file = None
        faulthandler.cancel_dump_traceback_later()

    def extend(self, wall_s: float) -> None:
        """Extend the time limit by a number of seconds of wall time."""
        if self.file is not None:
            left, file = self._until - time.monotonic() + wall_s, self.file
            self.cancel()
            self.arm(max(left, 1e-3), file)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Return a context in which the time limit is paused.

        The time limit resumes only in this process, not in a fork.
        """
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
    """Return the ids of the threads of this process."""
    return frozenset(os.listdir("/proc/self/task"))  # noqa: PTH208 - names are enough


watchdog = Watchdog()
"""The only watchdog of this process."""


@dataclass(frozen=True, slots=True)
class Held:
    """Resources that this process held before user code ran in it. Forks need no private copy of such resources."""

    files: Mapping[int, str] = field(default_factory=dict)  # target of each open file descriptor
    children: frozenset[int] = frozenset()  # process ids of child processes
    # names of memory shared with other processes; None to skip this check, which takes milliseconds
    shared: frozenset[str] | None = frozenset()
    threads: frozenset[str] = frozenset()  # ids of threads


def held(shared: frozenset[str] | None = None) -> Held:
    """Return the resources that this process currently holds.

    Args:
        shared: names of shared memory, if the caller already knows them; see `Held`.
    """
    return Held(_open(), children_now(), shared)


def shared_memory() -> frozenset[str]:
    """Return the names of writable memory that this process shares with other processes."""
    with Path("/proc/self/maps").open("rb") as lines:
        names = [line.split(maxsplit=5)[-1] for line in lines if b" rw-s " in line]
    return frozenset(os.fsdecode(name.strip()) for name in names if MEMORY.encode() not in name)


def withhold(pid: int, descriptors: Collection[int]) -> None:
    """Allow forks of this process although a child process runs; a fork does not inherit the pipes to that process."""
    _alive.add(pid)
    ends.update(descriptors)


def stop_withholding(pid: int, descriptors: Collection[int]) -> None:
    """Undo `withhold`: as long as the child process runs, this process cannot be forked."""
    _alive.discard(pid)
    ends.difference_update(descriptors)


def abandon(why: str) -> NoReturn:
    """End this fork without an answer.

    Args:
        why: the reason as a clause without a subject, such as "could not start the planner".
    """
    end_descendants()
    for pipe in _answers_to:
        os.write(pipe, _dumps({"abandoned": why}).encode() + b"\n")
    _leave(0)


def copying() -> bool:
    """Return whether this module is currently forking; fork handlers then ignore the fork."""
    return _copying


class Copy:
    """A fork that runs one function and returns its result.

    Args:
        work: the function; its return value must be expressible as JSON.
        known: resources that were held before user code ran.
        keeps: file descriptors that the function needs.

    Raises:
        CannotForkError: this process cannot be forked.

    Attributes:
        pid: process id of the fork.
        raised: text of the exception that ended the function; empty if there was none.
        no_answer: reason why `answer` returned None.
    """

    def __init__(self, work: Callable[[], Plain], known: Held | None = None, *, keeps: Collection[int] = ()) -> None:
        self.raised, self._children = "", children_now()
        self.no_answer: NoAnswer | None = None
        self._end, theirs = os.pipe()
        ends.add(self._end)

        def answer() -> None:
            _answers_to[:] = [theirs]
            try:
                said: Plain = {"answer": work()}
            except BaseException as error:
                said = {"raised": f"{type(error).__name__}: {error}"}
            end_descendants()
            write_all(theirs, _dumps(said).encode() + b"\n")

        try:
            self.pid = fork(answer, known, keeps=(theirs, *keeps))
        except BaseException:
            self._close()
            raise
        finally:
            os.close(theirs)

    def answer(self, timeout_s: float = math.inf) -> Plain | None:
        """Wait for the answer, then end the fork; return None if the work failed, died or exceeded the time limit."""
        received, deadline = bytearray(), time.monotonic() + timeout_s
        try:
            while not received.endswith(b"\n"):
                left_s = deadline - time.monotonic()
                ready, _, _ = select.select([self._end], [], [], max(0.0, min(left_s, _CHECK_EVERY_S)))
                data = os.read(self._end, _PIPE_CHUNK_BYTES) if ready else b""
                received += data
                if ready and not data:
                    self.no_answer = explain_silence(self.pid)
                elif not ready and left_s <= 0:
                    self.no_answer = took_longer(timeout_s)
                elif not ready and _has_ended(self.pid) and not select.select([self._end], [], [], 0)[0]:
                    self.no_answer = explain_silence(self.pid)  # a process that it has started keeps the pipe open
                if self.no_answer is not None:
                    return None
            answer, self.raised, self.no_answer = parse_answer(received)
            return answer
        finally:
            self.end()
            if self.no_answer is not None:
                end_orphans(self._children)

    def end(self) -> None:
        """Kill the fork; a second call does nothing."""
        if self._end >= 0:
            kill(self.pid)
            ended(self.pid)
            self._close()

    def _close(self) -> None:
        ends.discard(self._end)
        os.close(self._end)
        self._end = -1


def _has_ended(pid: int) -> bool:
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None
    except ChildProcessError:
        return True


def end_orphans(children: frozenset[int]) -> None:
    """End the child processes that this process inherited from a killed fork, because they would prevent further forks.

    Child processes that are older than the fork are not ended.
    """
    end_descendants(children | _alive)


def ended(pid: int) -> int:
    """Wait for the end of a fork; return its exit code, which is negative for a signal."""
    _alive.discard(pid)
    with suppress(ChildProcessError):
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return 0


def fork(work: Callable[[], object], known: Held | None = None, *, keeps: Collection[int] = ()) -> int:
    """Fork this process; the fork runs a function and exits.

    Args:
        work: the function to run. Output and exceptions of the function are discarded.
        known: resources that were held before user code ran; None if they are unknown, so that every resource may be
            the user's.
        keeps: file descriptors that the function needs, such as an end of a pipe.

    Returns:
        The process id of the fork; the caller has to wait for it.

    Raises:
        CannotForkError: this process cannot be forked.
    """
    global _copying
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
            random.setstate(drawn)  # Python reseeds its generator after every fork
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
        gc.freeze()  # a garbage collection would write to all inherited pages, and so copy them
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


_CLOSE, _NOTHING, _READ, _OWN = range(4)  # what a fork does with a descriptor: close, /dev/null, reopen, private copy


def _replacements(known: Held, keeps: Collection[int]) -> list[tuple[int, int, int]]:
    """Return for each file descriptor what a fork does with it, and the current file position.

    Raises:
        CannotForkError: a file descriptor, a thread, a child process or shared memory cannot be copied.
    """
    own = {str(threading.get_native_id())}
    others = len(threads() - watchdog.threads - known.threads - own)
    if others > 0:
        count = f"{others} further thread{' runs' if others == 1 else 's run'}"
        raise CannotForkError(f"a process with several threads cannot be forked: {count}")
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        raise CannotForkError("a process in which PyTorch uses a graphics card cannot be forked")
    if children_now() - known.children - _alive:
        raise CannotForkError("a process with child processes cannot be forked")
    for name in shared_memory() - known.shared if known.shared is not None else ():
        raise CannotForkError(f"a process that shares memory with other processes cannot be forked: {name}")
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
        if os.fstat(descriptor).st_size > _MAX_COPIED_FILE_BYTES:
            raise CannotForkError(f"a fork cannot copy a large file that is open for reading and writing: {what}")
        return _OWN, place
    if stat.S_ISDIR(mode) or what.startswith(_SHAREABLE_DEVICES):
        return _READ if stat.S_ISDIR(mode) else _NOTHING, 0
    if ours:
        return _NOTHING if descriptor == 0 else _CLOSE, 0
    kind = "a device" if stat.S_ISCHR(mode) or stat.S_ISBLK(mode) else "a connection to others"
    raise CannotForkError(f"a fork cannot copy {kind}: {what}")


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
            new = os.memfd_create(_COPIED_FILE_NAME)
            os.sendfile(new, descriptor, 0, _MAX_COPIED_FILE_BYTES)
        if new != nothing:
            os.lseek(new, place, os.SEEK_SET)
        os.dup2(new, descriptor, inheritable=os.get_inheritable(descriptor))
        if new != nothing:
            os.close(new)
    os.close(nothing)


def children_now() -> frozenset[int]:
    """Return the process ids of this process's children."""
    return frozenset(children_of(os.getpid())) if has_child() else frozenset()


def _open() -> dict[int, str]:
    found = {}
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names are enough
        with suppress(OSError):  # the descriptor of this listing is closed already
            found[int(name)] = os.readlink(f"/proc/self/fd/{name}")  # noqa: PTH115
    return found


# A suspended fork of this process, which answers each job from the same state.

_MORE_S = 1.0  # beyond the time limit of a job, for the suspended fork to report that there is no answer


class SuspendedFork:
    """A suspended fork, which runs each job in a fork of its own, so that its state never changes.

    Args:
        work: function that computes the answer to a job; both must be expressible as JSON.
        known: resources that were held before user code ran.

    Raises:
        CannotForkError: this process cannot be forked.

    Attributes:
        pid: process id of the suspended fork.
        raised: text of the exception that ended the last job; empty if there was none.
        no_answer: reason why `ask` returned None.
        is_usable: whether the suspended fork accepts another job.
    """

    def __init__(self, work: Callable[[Plain], Plain], known: Held | None = None) -> None:
        self.raised = ""
        self.no_answer: NoAnswer | None = None
        self.is_usable = True
        jobs, self._jobs = os.pipe()
        self._answers, answers = os.pipe()
        ends.update((self._jobs, self._answers))
        try:
            self.pid = fork(lambda: _serve_jobs(jobs, answers, work, known), known, keeps=(jobs, answers))
        except BaseException:
            self._close()
            raise
        finally:
            os.close(jobs)
            os.close(answers)

    def ask(self, job: Plain, timeout_s: float) -> Plain | None:
        """Return the answer to a job; None if the work failed, died or exceeded the time limit (see `no_answer`)."""
        if not self.is_usable:
            return None
        children = children_now()
        try:
            return self._ask(job, timeout_s)
        finally:
            if not self.is_usable:
                end_orphans(children)

    def _ask(self, job: Plain, timeout_s: float) -> Plain | None:
        received, deadline = bytearray(), time.monotonic() + timeout_s + _MORE_S
        try:
            write_all(self._jobs, _dumps([job, timeout_s]).encode() + b"\n")
        except BrokenPipeError:
            self._record_end(explain_silence(self.pid))
            return None
        while not received.endswith(b"\n"):
            ready, _, _ = select.select([self._answers], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                self._record_end(took_longer(timeout_s))
                return None
            data = os.read(self._answers, _PIPE_CHUNK_BYTES)
            if not data:
                self._record_end(explain_silence(self.pid))
                return None
            received += data
        answer: Plain | None
        try:
            answer, self.raised, why = _loads(received)
        except (ValueError, TypeError):
            self._record_end(NoAnswer("sent data that are no answer"))
            return None
        if answer is None:
            self.no_answer = NoAnswer(*why)
        return answer

    def _record_end(self, why: NoAnswer) -> None:
        self.no_answer, self.is_usable = why, False

    def end(self) -> None:
        """Kill the suspended fork and its own forks; a second call does nothing."""
        if self._jobs >= 0:
            kill(self.pid)
            ended(self.pid)
            self._close()

    def _close(self) -> None:
        ends.difference_update((self._jobs, self._answers))
        os.close(self._jobs)
        os.close(self._answers)
        self._jobs = self._answers = -1


def _serve_jobs(requests: int, answers: int, work: Callable[[Plain], Plain], known: Held | None) -> None:
    with os.fdopen(requests, "rb", closefd=False) as lines:
        for line in lines:
            job, timeout_s = _loads(line)
            answer: Plain | None = None
            raised, why = "", NoAnswer("")
            try:
                copy = Copy(partial(work, job), known)
                answer, raised, why = copy.answer(timeout_s), copy.raised, copy.no_answer or why
            except CannotForkError as error:
                raised = error.message
                why = NoAnswer(f"could not be made: {raised}", isinstance(error, NoProcessError))
            write_all(answers, _dumps([answer, raised, [why.why, why.is_from_outside]]).encode() + b"\n")
