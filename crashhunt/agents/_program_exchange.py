"""Exchanges messages with the process of a program: starts it, frames messages, waits for answers, and ends it.

A message is one line of JSON, or MessagePack after its length. If the program ends instead of answering, the error has
the signal or the exit code, and the reason in the program's log.
"""

from __future__ import annotations

import os
import select
import stat
import subprocess
import time
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Any, Final

from pydantic_core import from_json, to_json

from crashhunt.agents._program_logs import reason_in
from crashhunt.agents._program_processes import AttachedProgram, ProgramProcess, launch, read_format
from crashhunt.base import forks
from crashhunt.base.errors import ProgramError
from crashhunt.base.processes import descendants_of, kill
from crashhunt.base.signals import signal_name
from crashhunt.base.text import one_line

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from crashhunt.base.program_message_types import ProgramRequest

_ANSWERS: Final = {"hello": "ready", "reset": "ok", "observe": "act"}
_LENGTH_BYTES: Final = 4  # before each message of MessagePack
_CHUNK_BYTES: Final = 1 << 16
_MAX_MESSAGE_BYTES: Final = 16 << 20
_MAX_REPEATED_BYTES: Final = 256 << 20  # of the observations that a fork of the trial sends again
_MAX_SHOWN_CHARACTERS: Final = 80
_CLOSING_S: Final = 1.0  # from `close` to the end of the program
_TERMINATION_S: Final = 0.2  # from SIGTERM to SIGKILL
_LOGS_FIX = "write only messages to standard output, {}, and logs to standard error"
_inherited: list[ProgramProcess] = []
"""Programs of the process of which this one is a fork. Their pipes are closed here, so nothing may close them again."""


class ProgramExchange:
    """The process of a program, with its standard input and output.

    Args:
        command: the program and its words.
        folder: the folder in which the program runs; it is created.
        log: file descriptor for its standard error; None for that of this process.
        libraries: folder with copies of the libraries that the program loads; empty if there are none.
        is_forked: whether this process is forked while the program runs. A fork then starts the program again.
    """

    def __init__(
        self, command: Sequence[str], folder: Path, log: int | None = None, *, libraries: str = "",
        is_forked: bool = False,
    ) -> None:  # fmt: skip
        self._command = command
        self._libraries = libraries
        self._folder = folder
        self._log = 2 if log is None else log
        self._log_begin: int | None = None  # where the program's log begins; None if it cannot be read
        self._received = bytearray()
        self._packer: Any = None  # of MessagePack; None as long as messages are lines of JSON
        self._unpack: Any = None
        self._process: ProgramProcess | None = None
        self._attached: AttachedProgram | None = None  # that same process, if it drives in several trials
        self._is_idle = False  # whether the program has answered every message
        self._owner = 0  # the process that has started the program
        self._is_forked = is_forked
        # each observation that was sent, and the action in its answer; empty if this process is not forked
        self.exchanges: list[tuple[bytes, Any]] = []
        self._exchanged_bytes = 0

    @property
    def is_inherited(self) -> bool:
        """Return whether this process is a fork of the process that has started the program."""
        return self._process is not None and self._owner != os.getpid()

    @property
    def is_started(self) -> bool:
        """Whether the process has been started."""
        return self._process is not None

    @property
    def is_reused(self) -> bool:
        """Whether the program has answered in an earlier trial."""
        return self._attached is not None and self._attached.has_answered

    def start(self) -> None:
        """Start the program.

        Raises:
            ProgramError: the operating system cannot run it.
        """
        folder = self._folder
        if self._process is not None:  # of the process of which this one is a fork, which uses its pipes
            _inherited.append(self._process)
            folder = folder.with_name(f"{folder.name}-{os.getpid()}")
        self._owner, self._received, self._packer, self._unpack = os.getpid(), bytearray(), None, None
        self.exchanges, self._exchanged_bytes, self._attached = [], 0, None
        with suppress(OSError):
            status = os.fstat(self._log)
            self._log_begin = status.st_size if stat.S_ISREG(status.st_mode) else None
        try:
            self._process = process = launch(
                self._command, folder, self._log, self._libraries, (subprocess.PIPE, subprocess.PIPE)
            )
        except OSError as error:
            fix = "make it executable here: with #! in its first line if it is a script, and for this machine"
            raise ProgramError(f"the program does not start: {error.strerror}: {self._command[0]}", fix=fix) from None
        assert process.stdin is not None
        os.set_blocking(process.stdin.fileno(), False)
        if self._is_forked:
            forks.withhold(process.pid, self._descriptors())

    def attach(self, folder: Path) -> None:
        """Use a program that has driven in earlier trials, if it still runs; otherwise start the program.

        Raises:
            ProgramError: the program does not run, and cannot be started.
        """
        try:
            self._process = attached = AttachedProgram(folder)
        except (OSError, ValueError):
            self._process = None
            self.start()
            return
        self._owner, self._attached, self._log_begin = os.getpid(), attached, 0
        if read_format(folder) == "msgpack":
            self._use_msgpack()
        if self._is_forked:
            forks.withhold(attached.pid, self._descriptors())

    def ask(self, message: ProgramRequest, shown: str, limit_s: float | None = None) -> dict[str, Any]:
        """Send a message, and return the program's answer to it.

        ``shown`` names the message in errors, such as ``observe of step 3``. Without ``limit_s``, the time limit of the
        trial applies.

        Raises:
            ProgramError: the program has ended, or its answer is not the one that the protocol defines.
        """
        data, expected = self._encoded(message), _ANSWERS[message["type"]]
        answer = self.exchange(data, expected, shown, limit_s)
        if expected == "ready":
            if answer.get("format") == "msgpack":
                self._use_msgpack()
            if self._attached is not None and not self._attached.has_answered:
                self._attached.keep_format("json" if self._packer is None else "msgpack")
        elif expected == "act" and self._is_forked:
            self._keep(data, answer.get("action"))
        return answer

    @property
    def _logs_fix(self) -> str:
        return _LOGS_FIX.format("each in one line" if self._packer is None else "each after its length in 4 bytes")

    def _use_msgpack(self) -> None:
        import msgpack

        self._packer, self._unpack = msgpack.Packer(), msgpack.unpackb

    def exchange(self, data: bytes, expected: str, shown: str, limit_s: float | None) -> dict[str, Any]:
        """Send an encoded message, and return the answer, which must be of the expected type; see `ask`."""
        if self._received:
            raise ProgramError(
                f"it has sent something before {shown}: {excerpt_of(self._received)}", fix=self._logs_fix
            )
        deadline = None if limit_s is None else time.monotonic() + limit_s
        self._is_idle = False
        try:
            self._write(data, shown, deadline)
            received = self._read(shown, deadline)
        except TimeoutError:
            raise ProgramError(f"it has not answered {shown} within {limit_s:g} s") from None
        answer = self._decoded(received, shown)
        if not isinstance(answer, dict) or answer.get("type") != expected:
            fix = f'send {{"type": "{expected}", …}}'
            raise ProgramError(f"its answer to {shown} is not of type {expected!r}: {excerpt_of(received)}", fix=fix)
        self._is_idle = not self._received
        return answer

    def _keep(self, data: bytes, action: Any) -> None:
        """Keep an observation for forks; without it, this process can no longer be forked while the program runs."""
        self.exchanges.append((data, action))
        self._exchanged_bytes += len(data)
        if self._exchanged_bytes > _MAX_REPEATED_BYTES:
            assert self._process is not None
            forks.stop_withholding(self._process.pid, self._descriptors())
            self._is_forked, self.exchanges = False, []

    def _descriptors(self) -> list[int]:
        """Return the descriptors of the pipes to the program."""
        assert self._process is not None
        return [stream.fileno() for stream in (self._process.stdin, self._process.stdout) if stream is not None]

    def close(self) -> None:
        """Send ``close``, wait for the end of the program, and kill what is left of it."""
        if self.is_inherited:
            return
        if self._is_forked and self._process is not None:
            forks.stop_withholding(self._process.pid, self._descriptors())
        process, self._process = self._process, None
        if process is None:
            return
        if self._attached is not None:
            self._attached.detach(is_idle=self._is_idle)
            return
        assert process.stdin is not None
        assert process.stdout is not None
        below = descendants_of(process.pid)
        with suppress(OSError):
            os.write(process.stdin.fileno(), self._encoded({"type": "close"}))
        with suppress(OSError):
            process.stdin.close()
        if not self._ends_within(process, _CLOSING_S):
            with suppress(OSError):
                process.terminate()
            self._ends_within(process, _TERMINATION_S)
        for pid in {*below, *(descendants_of(process.pid) if process.returncode is None else ())}:
            kill(pid)
        if process.returncode is None:
            process.kill()
            process.wait()
        process.stdout.close()

    def _encoded(self, message: ProgramRequest) -> bytes:
        if self._packer is None:
            return to_json(message) + b"\n"
        data: bytes = self._packer.pack(message)
        return len(data).to_bytes(_LENGTH_BYTES, "little") + data

    def _decoded(self, data: bytes, shown: str) -> Any:
        try:
            if self._unpack is not None:
                return self._unpack(data, strict_map_key=False)
            return from_json(data)
        except ValueError:
            form = "JSON" if self._unpack is None else "MessagePack"
            said = excerpt_of(data) or "an empty message"
            raise ProgramError(f"its answer to {shown} is not {form}: {said}", fix=self._logs_fix) from None

    def _write(self, data: bytes, shown: str, deadline: float | None) -> None:
        """Write a message, as fast as the program reads it."""
        process = self._process
        assert process is not None
        assert process.stdin is not None
        left = memoryview(data)
        while left:
            try:
                left = left[os.write(process.stdin.fileno(), left) :]
            except BlockingIOError:
                _await(process.stdin, deadline, writing=True)
            except OSError:
                raise self._ended(shown) from None

    def _read(self, shown: str, deadline: float | None) -> bytes:
        """Return the next message of the program, without its frame."""
        received, searched = self._received, 0
        while True:
            if self._packer is None:
                begin, end = 0, received.find(b"\n", searched)
                searched = len(received)
            else:
                begin, end = _LENGTH_BYTES, _LENGTH_BYTES + int.from_bytes(received[:_LENGTH_BYTES], "little")
            if max(len(received), end) > _MAX_MESSAGE_BYTES:
                said = f"longer than {_MAX_MESSAGE_BYTES >> 20} MB: {excerpt_of(received)}"
                raise ProgramError(f"its answer to {shown} is {said}", fix=self._logs_fix)
            if begin <= end <= len(received) and len(received) >= begin:
                data = bytes(received[begin:end])
                del received[: end + (self._packer is None)]
                return data
            self._receive(shown, deadline)

    def _receive(self, shown: str, deadline: float | None) -> None:
        process = self._process
        assert process is not None
        assert process.stdout is not None
        if deadline is not None:
            _await(process.stdout, deadline)
        data = os.read(process.stdout.fileno(), _CHUNK_BYTES)
        if not data:
            raise self._ended(shown)
        self._received += data

    def _ended(self, shown: str) -> ProgramError:
        """Return the error for a program that has closed one of its ends."""
        process = self._process
        assert process is not None
        half = f", in the middle of a message: {excerpt_of(self._received)}" if self._received else ""
        if not self._ends_within(process, _CLOSING_S):
            for pid in (*descendants_of(process.pid), process.pid):  # it cannot receive `close`, or answer
                kill(pid)
            return ProgramError(
                f"the program has closed its end instead of answering {shown}{half}, and is still running"
            )
        code = process.returncode or 0
        end = f"died of {signal_name(code)}" if code < 0 else f"exited with {code}"
        reason = ""
        if self._log_begin is not None:
            reason = reason_in(self._log if self._attached is None else self._attached.log, self._log_begin)
        return ProgramError(f"the program {end} instead of answering {shown}{half}{reason}")

    @staticmethod
    def _ends_within(process: ProgramProcess, limit_s: float) -> bool:
        """Return whether a process ends within a time limit; its output is read, so that it can end."""
        assert process.stdout is not None
        until = time.monotonic() + limit_s
        while (left := until - time.monotonic()) > 0:
            if select.select([process.stdout], [], [], left)[0] and not os.read(process.stdout.fileno(), _CHUNK_BYTES):
                break
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            return False
        return True


def _await(stream: IO[bytes], deadline: float | None, *, writing: bool = False) -> None:
    """Return as soon as a stream can be read or written.

    Raises:
        TimeoutError: the deadline has passed.
    """
    left = None if deadline is None else max(0.0, deadline - time.monotonic())
    ready = select.select([] if writing else [stream], [stream] if writing else [], [], left)
    if not any(ready):
        raise TimeoutError


def excerpt_of(value: object) -> str:
    """Return a value for a message, on one line and cut."""
    text = (
        bytes(value[: 4 * _MAX_SHOWN_CHARACTERS]).decode("utf-8", "replace")
        if isinstance(value, bytes | bytearray)
        else to_json(value, bytes_mode="base64", fallback=repr).decode()
    )
    text = one_line(text)
    return text if len(text) <= _MAX_SHOWN_CHARACTERS else f"{text[:_MAX_SHOWN_CHARACTERS]}…"
