"""Processes of programs: one that a trial starts, and one that drives in one trial after another (``reuse``).

The zygote of a slot starts a reused program. Each trial opens its two named pipes. The program is kept only if the
trial has received the answer to each message; otherwise the next trial finds a new process.
"""

from __future__ import annotations

import os
import resource
import select
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final, Protocol

from crashhunt.base import layout
from crashhunt.base.processes import descendants_of, kill

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MAX_FILE_BYTES: Final = 64 << 20  # of each file that the program writes, such as its log
_LOOK_EVERY_S: Final = 0.002  # whether a process has ended of which this one is not the parent
_CLOSING_S: Final = 1.0
_CHUNK_BYTES: Final = 1 << 16
_EXIT_CODE_FIELD: Final = -1  # of /proc/PID/stat, see proc(5)


class ProgramProcess(Protocol):
    """What a trial needs of the process of a program; a `subprocess.Popen` has it."""

    pid: int
    returncode: int | None
    stdin: IO[bytes] | None
    stdout: IO[bytes] | None

    def wait(self, timeout: float | None = None) -> int: ...
    def terminate(self) -> None: ...
    def kill(self) -> None: ...


def launch(
    command: Sequence[str], folder: Path, log: int, libraries: str, pipes: tuple[int, int] = (-1, -1)
) -> subprocess.Popen[bytes]:
    """Start a program.

    The folder is created. ``libraries`` is a folder with copies of the libraries that the program loads; empty if there
    are none. Without ``pipes``, its standard input and output are new pipes.

    Raises:
        OSError: the operating system cannot run the program.
    """
    folder.mkdir(parents=True, exist_ok=True)
    made = subprocess.Popen(
        command, cwd=folder, stdin=pipes[0], stdout=pipes[1], stderr=log, bufsize=0, env=_environment(libraries)
    )
    with suppress(OSError, ValueError, AttributeError):  # it has ended already, or the system has no such call
        soft, hard = resource.prlimit(made.pid, resource.RLIMIT_FSIZE)
        if soft == resource.RLIM_INFINITY or soft > MAX_FILE_BYTES:
            resource.prlimit(made.pid, resource.RLIMIT_FSIZE, (MAX_FILE_BYTES, hard))
    return made


def _environment(libraries: str) -> dict[str, str]:
    # Python would write its caches next to the modules of the snapshot. A replay imports from the snapshot's code,
    # and a program in Python must find the same modules there as in the hunt.
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if not _is_of_snapshot(path)]
    found = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": os.pathsep.join(paths)}
    if libraries:
        found["LD_LIBRARY_PATH"] = ":".join(filter(None, [libraries, os.environ.get("LD_LIBRARY_PATH")]))
    return found


def _is_of_snapshot(path: str) -> bool:
    code = layout.PACKAGE.parent
    return code.name == layout.CODE and (code.parent / layout.MANIFEST).exists() and Path(path).is_relative_to(code)


class ReusedProgram:
    """The process of a program that drives in one trial after another, in the zygote that starts it.

    Args:
        command: the program and its words.
        folder: a folder for the pipes, the log and the files of the program.
        libraries: folder with copies of the libraries that the program loads; empty if there are none.
    """

    def __init__(self, command: Sequence[str], folder: Path, libraries: str) -> None:
        self.folder = folder
        self._command, self._libraries = command, libraries
        self._process: subprocess.Popen[bytes] | None = None
        self._ends: tuple[int, ...] = ()  # of the pipes, which stay open between trials

    @property
    def pid(self) -> int:
        """Process id of the program; 0 if it does not run."""
        return 0 if self._process is None else self._process.pid

    def prepare(self) -> None:
        """Start the program before a trial, unless it runs and has answered every message of the last trial.

        A program that cannot be started is started by the trial itself, which reports the reason.
        """
        idle = self.folder / _IDLE
        if self._process is not None and self._process.poll() is None and idle.exists():
            idle.unlink()
            return
        self.end()
        with suppress(OSError):
            self._start()

    def _start(self) -> None:
        self.folder.mkdir(parents=True)
        for name in (_INPUT, _OUTPUT):
            os.mkfifo(self.folder / name)
        # The order matters: a pipe without a reader cannot be opened for writing.
        program_in = os.open(self.folder / _INPUT, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        our_out = os.open(self.folder / _OUTPUT, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        our_in = os.open(self.folder / _INPUT, os.O_WRONLY | os.O_CLOEXEC)
        program_out = os.open(self.folder / _OUTPUT, os.O_WRONLY | os.O_CLOEXEC)
        log = os.open(self.folder / _LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        self._ends = our_in, our_out
        os.set_blocking(program_in, True)
        try:
            pipes = program_in, program_out
            self._process = launch(self._command, self.folder / "home", log, self._libraries, pipes)
            (self.folder / _PID).write_text(str(self._process.pid), encoding="ascii")
        finally:
            for descriptor in (program_in, program_out, log):
                os.close(descriptor)

    def forget(self) -> None:
        """Close the ends of the zygote in the present process, which runs a trial."""
        for end in self._ends:
            os.close(end)
        self._ends = ()

    def move_log(self, to: Path) -> None:
        """Append what the program has written during a trial to the log of the trial."""
        log = self.folder / _LOG
        with suppress(OSError):
            if log.stat().st_size:
                with log.open("r+b") as written, to.open("ab") as target:
                    shutil.copyfileobj(written, target)
                    written.truncate(0)

    def end(self) -> None:
        """End the program with all processes that it has started, and remove its folder."""
        process, self._process = self._process, None
        if process is not None:
            below = descendants_of(process.pid)
            if (self.folder / _IDLE).exists():
                with suppress(OSError):
                    os.set_blocking(self._ends[0], False)
                    os.write(self._ends[0], _close_message(read_format(self.folder)))
                self.forget()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_CLOSING_S)
            for pid in below:
                kill(pid)
            process.kill()
            process.wait()
        self.forget()
        shutil.rmtree(self.folder, ignore_errors=True)


_INPUT, _OUTPUT, _LOG, _PID, _IDLE, _FORMAT = "in", "out", "log", "pid", "idle", "format"  # files of a reused program


def read_format(folder: Path) -> str:
    """Return the format of messages that a reused program has chosen: ``json`` or ``msgpack``."""
    try:
        return (folder / _FORMAT).read_text(encoding="ascii")
    except OSError:
        return "json"


def _close_message(form: str) -> bytes:
    if form == "json":
        return b'{"type":"close"}\n'
    import msgpack

    data: bytes = msgpack.packb({"type": "close"})
    return len(data).to_bytes(4, "little") + data


_reused: dict[str, ReusedProgram] = {}
"""The reused program of each vehicle whose program the zygote has started; it is filled before trials are forked."""


def offer_reused(programs: Mapping[str, ReusedProgram]) -> None:
    """Let the trials in forks of this process use programs that are running, by vehicle."""
    _reused.clear()
    _reused.update(programs)


def reused_folder(agent: str) -> Path | None:
    """Return the folder of the reused program that drives a vehicle; None if the trial starts a program of its own."""
    found = _reused.get(agent)
    return found.folder if found is not None and (found.folder / _PID).exists() else None


class AttachedProgram:
    """A reused program in the process of a trial, which is not its parent.

    Raises:
        OSError: the program has ended.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.has_answered = (folder / _FORMAT).exists()  # in an earlier trial
        self.pid = int((folder / _PID).read_text(encoding="ascii"))
        self.returncode: int | None = None
        output = os.open(folder / _OUTPUT, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        os.set_blocking(output, True)
        self.stdout: IO[bytes] | None = os.fdopen(output, "rb", 0)
        self.stdin: IO[bytes] | None = os.fdopen(
            os.open(folder / _INPUT, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC), "wb", 0
        )
        self.log = os.open(folder / _LOG, os.O_RDONLY | os.O_CLOEXEC)

    def keep_format(self, form: str) -> None:
        """Record the format of messages for the next trials."""
        (self.folder / _FORMAT).write_text(form, encoding="ascii")

    def detach(self, *, is_idle: bool) -> None:
        """Close the pipes of this trial.

        An idle program has answered every message, so that it can drive in the next trial.
        """
        assert self.stdin is not None
        assert self.stdout is not None
        if is_idle and not select.select([self.stdout], [], [], 0)[0]:  # otherwise it has sent more, or has ended
            (self.folder / _IDLE).touch()
        self.stdin.close()
        self.stdout.close()
        os.close(self.log)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end of the program, and return its exit code; the zygote is its parent and reaps it later."""
        until = time.monotonic() + (timeout or 0.0)
        while self.returncode is None:
            try:
                fields = Path(f"/proc/{self.pid}/stat").read_bytes().rpartition(b")")[2].split()
            except OSError:
                self.returncode = -signal.SIGKILL  # it has been reaped, and its exit code is lost
                break
            if fields[0] in (b"Z", b"X"):
                self.returncode = os.waitstatus_to_exitcode(int(fields[_EXIT_CODE_FIELD]))
            elif time.monotonic() > until:
                raise subprocess.TimeoutExpired("program", timeout or 0.0)
            else:
                time.sleep(_LOOK_EVERY_S)
        return self.returncode

    def terminate(self) -> None:
        """Send SIGTERM to the program."""
        os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL to the program."""
        kill(self.pid)
