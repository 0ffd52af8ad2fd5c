"""Agents that are programs: ``exec:PROGRAM``, in lock-step over standard input and output (protocol 1).

Each message is one JSON object on one line, or after ``ready`` MessagePack if the program asks for it. crashhunt
sends ``hello``, ``reset``, ``observe`` and ``close``. The program answers with ``ready``, ``ok`` and ``act``, and ends
after ``close``. Anything else is an error of the agent.
"""

from __future__ import annotations

import os
import re
import select
import stat
import subprocess
import tempfile
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
from pydantic_core import from_json, to_json

from crashhunt.agents._program_processes import (
    MAX_FILE_BYTES,
    AttachedProgram,
    ReusedProgram,
    launch,
    read_format,
    reused_folder,
)
from crashhunt.agents._protocol import ForeignFactory, shown_space
from crashhunt.base import forks
from crashhunt.base.errors import ArgumentError, ProgramError
from crashhunt.base.foreign_code import supports
from crashhunt.base.processes import descendants_of, kill
from crashhunt.base.programs import command_of, is_path, library_path, words_of
from crashhunt.base.signals import signal_name
from crashhunt.base.text import one_line
from crashhunt.simulators import NamesMetaActions, ObservesParts, ProvidesRoadMaps
from crashhunt.trial import Argument, Constant, Signature, kind_of, parse_spec
from crashhunt.world import describe_road_map

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from gymnasium import Space

    from crashhunt.agents._program_processes import ProgramProcess
    from crashhunt.base.program_messages import Hello, Observe, ProgramRequest, Reset, SpaceDescription
    from crashhunt.panels import Panel
    from crashhunt.simulators import ActionForm, Simulator
    from crashhunt.trial import Kind, Value

PROTOCOL: Final = 1
_ANSWERS: Final = {"hello": "ready", "reset": "ok", "observe": "act"}
_FORMATS: Final = ("json", "msgpack")
_LENGTH_BYTES: Final = 4  # before each message of MessagePack
_CHUNK_BYTES: Final = 1 << 16
_MAX_MESSAGE_BYTES: Final = 16 << 20
_MAX_REPEATED_BYTES: Final = 256 << 20  # of the observations that a fork of the trial sends again
_MAX_SHOWN_CHARACTERS: Final = 80
_DESCRIPTION_S: Final = 60.0  # as long as a module may take to import
_CLOSING_S: Final = 1.0  # from `close` to the end of the program
_TERMINATION_S: Final = 0.2  # from SIGTERM to SIGKILL
_MAX_REPORT_BYTES: Final = 1 << 20  # of the end of the log, which may have the report of a sanitizer
_MAX_REASON_CHARACTERS: Final = 300
_MAX_REVISION_CHARACTERS: Final = 100
_REASONS: Final = tuple(
    re.compile(pattern, re.MULTILINE)
    for pattern in (
        r"^SUMMARY: (\w+Sanitizer: .+)$",
        r"^(.+: runtime error: .+)$",  # of the sanitizer for undefined behaviour
        r"^(.+: Assertion .+ failed\.)$",
        r"^terminate called after throwing an instance of '(.+)'\n {2}what\(\): +(.+)$",
        r"^(terminate called .+)$",
        r"^(\*\*\* .+ \*\*\*: terminated)$",  # of glibc, as the next one
        r"^(double free or corruption.*|(?:free|malloc|realloc|munmap_chunk)\(\): .+|corrupted size vs\. .+)$",
    )
)
"""What the log of a program names as the reason of its end: sanitizers, assert, exceptions of C++, a damaged heap."""
_UNITS: Final = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "heading": "rad", "target_speed": "m/s"}
_DECLARATION_KEYS: Final = ("range", "unit", "default")

_inherited: list[ProgramProcess] = []
"""Programs of the process of which this one is a fork. Their pipes are closed here, so nothing may close them again."""


class ProgramFactory(ForeignFactory):
    """Creates the agents of one ``exec:`` locator: one process per trial and vehicle.

    Args:
        locator: the locator, such as ``exec:./planner --mode test``.
    """

    def __init__(self, locator: str) -> None:
        self._locator = locator
        words_of(locator)  # refuses what is not a command line

    def declared_signature(
        self, agent: str = "", simulator: Simulator | None = None, *, limit_s: float = 0.0
    ) -> Signature:
        """Run the program once, and return the arguments that it declares in its first answer.

        The program receives ``hello`` without arguments, and then ``close``. Without a simulator, ``hello`` has no
        spaces.
        """
        command = command_of(self._locator)
        with tempfile.TemporaryDirectory(prefix="crashhunt-agent-") as folder, tempfile.TemporaryFile() as log:
            program = _Process(command, Path(folder), log.fileno())
            try:
                program.start()
                limit = max(limit_s, _DESCRIPTION_S)
                return _signature_in(program.ask(_hello(agent, simulator, {}), "hello", limit))
            except ProgramError as error:
                raise ProgramError(f"{error.message}{_last_line(log)}", fix=error.fix) from None
            finally:
                program.close()

    def agent(
        self, name: str, simulator: Simulator, arguments: Mapping[str, Value], *, folder: Path,
        files: Mapping[str, str], limit_s: float | None = None, is_forked: bool = False,
    ) -> ProgramAgent:  # fmt: skip
        """Return the agent of a vehicle; its program runs in a folder of its own."""
        given = {key: _absolute(value) for key, value in arguments.items()}
        hello = _hello(name, simulator, given)
        is_scalar = simulator.actions[name].space.shape == ()
        process = _Process(
            command_of(self._locator, files), folder / f"agent-{name}", libraries=library_path(self._locator, files),
            is_forked=is_forked,
        )  # fmt: skip
        return ProgramAgent(
            process, hello, partial(write_road_map, folder, simulator, name), is_scalar=is_scalar, limit_s=limit_s,
            reused=reused_folder(name),
        )  # fmt: skip

    def reused(self, folder: Path, files: Mapping[str, str]) -> ReusedProgram:
        """Return the program for several trials, which has not been started.

        Args:
            folder: the folder for the files of the program.
            files: file of the snapshot by the word that names the original file.
        """
        return ReusedProgram(command_of(self._locator, files), folder, library_path(self._locator, files))


class ProgramAgent:
    """An agent whose actions a program computes.

    The program starts in the first step. Therefore a program that does not start is an error of the agent, with a
    recorded trial, as in any other step.

    Args:
        process: the process of the program, which has not been started.
        hello: the first message.
        write_map: function that writes the road map, and returns its path; None if there is none.
        is_scalar: whether an action is one number, which the program sends as a list of one.
        limit_s: time limit for the answer to each observation, in s; None if only that of the trial applies.
        reused: folder of a program that has been started for several trials; None to start a program of its own.
    """

    def __init__(
        self, process: _Process, hello: Hello, write_map: Callable[[], str | None], *, is_scalar: bool,
        limit_s: float | None, reused: Path | None = None,
    ) -> None:  # fmt: skip
        self._process = process
        self._write_map = write_map
        self._reads_map = False
        self._map: str | None = None
        self._reused = reused
        self._limit_s = limit_s
        self._hello = hello
        self._is_scalar = is_scalar
        self._step_length_s = float(hello["step_length_s"])
        self._panels: Any = None
        self._seed = 0
        self._step = 0

    def reset(self, seed: int) -> None:
        """Begin an episode; the program receives the seed in the first step."""
        self._seed, self._step = int(seed), 0

    def act(self, observation: Any) -> Any:
        """Return the action that the program sends for an observation.

        Raises:
            ProgramError: the program has failed, or has sent something that the protocol does not contain.
        """
        try:
            return self._act(observation)
        except ProgramError as error:
            raise ProgramError(f"{self._hello['agent']}: {error.message}", fix=error.fix) from None

    def _act(self, observation: Any) -> Any:
        process, step = self._process, self._step
        if step == 0:
            self._begin()
        elif process.is_inherited:
            self._repeat()
        message: Observe = {
            "type": "observe", "step": step, "time_s": round(step * self._step_length_s, 9),
            "observation": _plain(observation),
        }  # fmt: skip
        answer = process.ask(message, f"observe of step {step}", self._limit_s)
        if "action" not in answer:
            raise ProgramError(
                f"its answer to observe of step {step} has no action", fix='send {"type": "act", "action": […]}'
            )
        self._step, self._panels = step + 1, answer.get("panels")
        action = answer["action"]
        return action[0] if self._is_scalar and isinstance(action, list) and len(action) == 1 else action

    def _begin(self, *, again: bool = False) -> None:
        """Start the program unless it runs, and begin the episode.

        Args:
            again: whether this is a fork of a trial, in which the road map has been written.
        """
        process = self._process
        if not process.is_started or process.is_inherited:
            if self._reused is None or process.is_inherited:
                process.start()
            else:
                process.attach(self._reused)
            try:
                ready = process.ask(self._hello, "hello")
                _signature_in(ready)
            except ProgramError as error:
                fix = "answer hello before each reset, or omit reuse" if process.is_reused else error.fix
                raise ProgramError(error.message, fix=fix) from None
            self._reads_map = bool(ready.get("map"))
        message: Reset = {"type": "reset", "seed": self._seed}
        if self._reads_map:
            self._map = message["map"] = self._map if again else self._write_map()
        process.ask(message, "reset")

    def _repeat(self) -> None:
        """Start the program for this fork of the trial, and have it answer all earlier observations again.

        A fork whose program answers otherwise ends without an answer, because it is no copy of the trial.
        """
        exchanges = self._process.exchanges
        try:
            self._begin(again=True)
            for step, (data, action) in enumerate(exchanges):
                answer = self._process.exchange(data, "act", f"observe of step {step}", self._limit_s)
                if answer.get("action") != action:
                    raise ProgramError(
                        f"it answered observe of step {step} with {_shown(answer.get('action'))}, and before with "
                        f"{_shown(action)}"
                    )
        except ProgramError as error:
            forks.abandon(f"could not repeat the program of {self._hello['agent']}: {error.message}")

    def panels(self) -> dict[str, Panel]:
        """Return the panels in the last answer of the program; see `panels_in`."""
        from crashhunt.agents._program_panels import panels_in

        return panels_in(self._panels)

    def close(self) -> None:
        """Send ``close`` to the program, and end it with all processes that it has started."""
        self._process.close()


class _Process:
    """The process of a program, with its standard input and output.

    Args:
        command: the program and its words.
        folder: the folder in which the program runs; it is created.
        log: file descriptor for its standard error; None for that of this process.
        libraries: folder with copies of the libraries that the program loads; empty if there are none.
        is_forked: whether this process is forked while the program runs. A fork then starts the program again.

    Attributes:
        exchanges: each observation that was sent, and the action in its answer; empty if this process is not forked.
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

        Args:
            folder: the folder of the reused program.

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

        Args:
            message: the message.
            shown: the message in errors, such as ``observe of step 3``.
            limit_s: time limit for the answer, in s; None if the time limit of the trial applies.

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

    def _use_msgpack(self) -> None:
        import msgpack

        self._packer, self._unpack = msgpack.Packer(), msgpack.unpackb

    def exchange(self, data: bytes, expected: str, shown: str, limit_s: float | None) -> dict[str, Any]:
        """Send an encoded message, and return the answer, which must be of the expected type; see `ask`."""
        if self._received:
            raise ProgramError(f"it has sent something before {shown}: {_shown(self._received)}", fix=_LOGS_FIX)
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
            raise ProgramError(f"its answer to {shown} is not of type {expected!r}: {_shown(received)}", fix=fix)
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
            raise ProgramError(f"its answer to {shown} is not {form}: {_shown(data)}", fix=_LOGS_FIX) from None

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
                fix = "end each message with a line break" if self._packer is None else "send the length first"
                raise ProgramError(f"its answer to {shown} is longer than {_MAX_MESSAGE_BYTES >> 20} MB", fix=fix)
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
        half = f", in the middle of a message: {_shown(self._received)}" if self._received else ""
        if not self._ends_within(process, _CLOSING_S):
            for pid in (*descendants_of(process.pid), process.pid):  # it cannot receive `close`, or answer
                kill(pid)
            return ProgramError(
                f"the program has closed its end instead of answering {shown}{half}, and is still running"
            )
        code = process.returncode or 0
        end = f"died of {signal_name(code)}" if code < 0 else f"exited with {code}"
        return ProgramError(f"the program {end} instead of answering {shown}{half}{self._reason()}")

    def _reason(self) -> str:
        """Return the reason that the program has written to its standard error, after a colon; empty if it has none."""
        if self._log_begin is None:
            return ""
        source = self._log if self._attached is None else self._attached.log
        with suppress(OSError), open(f"/proc/self/fd/{source}", "rb") as log:
            size = log.seek(0, os.SEEK_END)
            if size >= MAX_FILE_BYTES:
                return f": its log has reached {MAX_FILE_BYTES >> 20} MB"
            log.seek(max(self._log_begin, size - _MAX_REPORT_BYTES))
            text = log.read(_MAX_REPORT_BYTES).decode("utf-8", "replace")
            found = next((match for pattern in _REASONS if (match := pattern.search(text))), None)
            return f": {one_line(': '.join(found.groups()))[:_MAX_REASON_CHARACTERS]}" if found else ""
        return ""

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


_PARTS_FIX = "see crashhunt list observations"
_LOGS_FIX = "write only messages to standard output, each in one line, and logs to standard error"


def write_road_map(folder: Path, simulator: Simulator, agent: str) -> str | None:
    """Write the road map and the data of a vehicle into a folder as JSON, and return the path of the file.

    Without road maps in the simulator, return None.
    """
    if not supports(simulator, ProvidesRoadMaps):
        return None
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"map-{agent}.json"
    file.write_bytes(to_json(describe_road_map(simulator.road_map(agent), simulator.vehicle_data(agent))))
    return str(file)


def _hello(agent: str, simulator: Simulator | None, arguments: Mapping[str, Value]) -> Hello:
    found: Hello = {
        "type": "hello", "protocol": PROTOCOL, "agent": agent, "arguments": dict(arguments), "observation": {},
        "action": {"shape": [], "columns": [], "units": []}, "step_length_s": 0.0,
    }  # fmt: skip
    if simulator is not None:
        layouts = simulator.observation_layouts if supports(simulator, ObservesParts) else {}
        layout = layouts.get(agent)
        found["observation"] = (
            layout.describe() if layout is not None else _described_observation(*shown_space(simulator, agent))
        )
        found["action"] = _described_action(simulator.actions[agent])
        found["step_length_s"] = simulator.step_length_s
    return found


def _check_ready(ready: Mapping[str, Any]) -> None:
    """Refuse the first answer of a program that wants another protocol.

    Raises:
        ProgramError: the program wants another protocol or format.
    """
    protocol, form = ready.get("protocol", PROTOCOL), ready.get("format", "json")
    if protocol != PROTOCOL:
        raise ProgramError(
            f"its protocol is {_shown(protocol)} (allowed: {PROTOCOL})", fix=f'send "protocol": {PROTOCOL}'
        )
    if form not in _FORMATS:
        allowed = " or ".join(_FORMATS)
        raise ProgramError(f"its format is {_shown(form)} (allowed: {allowed})", fix='send "format": "json"')


def _signature_in(ready: Mapping[str, Any]) -> Signature:
    """Return what a program declares; a program that declares no arguments accepts any.

    Raises:
        ProgramError: the program wants another protocol, or does not declare ranges, units and defaults.
    """
    _check_ready(ready)
    declared = ready.get("arguments") or {}
    if not isinstance(declared, dict):
        raise ProgramError(f"its arguments are {_shown(declared)}, not an object")
    arguments = {name: _argument(name, facts) for name, facts in declared.items()}
    required = tuple(name for name, one in arguments.items() if one.default is None)
    observation, action = ready.get("observation") or [], ready.get("action") or ""
    revision = ready.get("revision") or ""
    if not isinstance(revision, str):
        raise ProgramError(f"its revision is {_shown(revision)}, not a text")
    if not isinstance(ready.get("map", False), bool):
        raise ProgramError(f"its map is {_shown(ready['map'])} (allowed: true, false)", fix='send "map": true')
    if not isinstance(observation, list) or not all(isinstance(part, str) for part in observation):
        raise ProgramError(f"its observation is {_shown(observation)}, not a list of names", fix=_PARTS_FIX)
    if not isinstance(action, str):
        raise ProgramError(f"its action is {_shown(action)}, not a name", fix="see crashhunt list actions")
    return Signature(
        arguments=arguments, open=not arguments, given=(), required=required, action=action,
        observation=tuple(observation), revision=one_line(revision)[:_MAX_REVISION_CHARACTERS],
    )  # fmt: skip


def _argument(name: str, facts: object) -> Argument:
    if not isinstance(facts, dict) or (odd := sorted(facts.keys() - set(_DECLARATION_KEYS))):
        said = _shown(facts) if not isinstance(facts, dict) else ", ".join(odd)
        raise ProgramError(f"its argument {name} has {said} (allowed: {', '.join(_DECLARATION_KEYS)})")
    default, unit, text = facts.get("default"), facts.get("unit") or "", facts.get("range")
    if not (default is None or isinstance(default, bool | int | float | str)) or not isinstance(unit, str):
        raise ProgramError(f"its argument {name} has the default {_shown(default)} and the unit {_shown(unit)}")
    # JSON does not tell 12 from 12.0, so whether an argument takes whole numbers follows from the texts of its values.
    kind: Kind | None = None if default is None or type(default) is int else kind_of(default)
    try:
        distribution = None if text is None else parse_spec(str(text), kind)
        if isinstance(distribution, Constant) and ":" in str(distribution.value):
            raise ArgumentError(f"{_shown(text)} is not a range", fix='write it as "5:40", "a|b|c" or "log:1e-3:1"')
    except ArgumentError as error:
        raise ProgramError(f"its argument {name}: {error.message}", fix=error.fix) from None
    return Argument(name=name, kind=kind, default=default, distribution=distribution, unit=unit)


def _absolute(value: Value) -> Value:
    """Return a value; one that names a file of the current folder becomes its absolute path."""
    is_file = isinstance(value, str) and is_path(value) and os.path.isfile(value)  # noqa: PTH113
    return str(Path(str(value)).absolute()) if is_file else value


def _described_observation(space: Space[object], names: Sequence[str]) -> dict[str, SpaceDescription]:
    """Return the shape, columns and units of each part of an observation."""
    from gymnasium.spaces import Dict

    if isinstance(space, Dict):
        return {str(part): _described_space(one, ()) for part, one in space.spaces.items()}
    return {"kinematics" if names else "observation": _described_space(space, names)}


def _described_action(form: ActionForm) -> SpaceDescription:
    """Return the shape, columns, units and bounds of an action."""
    found = _described_space(form.space, form.names)
    if supports(form.space, NamesMetaActions):
        found["meanings"] = list(form.space.meanings)
    return found


def _described_space(space: Space[object], names: Sequence[str]) -> SpaceDescription:
    from gymnasium.spaces import Box, Tuple

    shape = [int(length) for length in space.shape or ()]
    units = [_UNITS.get(name, "") for name in names]
    found: SpaceDescription = {"shape": shape, "columns": list(names), "units": units}
    if isinstance(space, Tuple):
        found |= {"shape": [len(space.spaces)], "bounds": [_bounds(one) for one in space.spaces]}
    elif isinstance(space, Box) and len(shape) == 1:
        found["bounds"] = [_ends(low, high) for low, high in zip(space.low, space.high, strict=True)]
    elif (bounds := _bounds(space)) is not None:
        found["bounds"] = [bounds]
    return found


def _bounds(space: Space[object]) -> list[float | None] | None:
    """Return the least and the greatest value of a space of single numbers; None for other spaces."""
    from gymnasium.spaces import Box, Discrete

    if isinstance(space, Discrete):
        return [int(space.start), int(space.start + space.n) - 1]
    return _ends(space.low, space.high) if isinstance(space, Box) and space.shape == () else None


def _ends(low: Any, high: Any) -> list[float | None]:
    return [float(end) if np.isfinite(end) else None for end in (low, high)]


def _plain(value: Any) -> Any:
    """Return an observation as nested lists and objects of JSON."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def _shown(value: object) -> str:
    """Return a value for a message, on one line and cut."""
    text = (
        bytes(value[: 4 * _MAX_SHOWN_CHARACTERS]).decode("utf-8", "replace")
        if isinstance(value, bytes | bytearray)
        else to_json(value, bytes_mode="base64", fallback=repr).decode()
    )
    text = one_line(text)
    return text if len(text) <= _MAX_SHOWN_CHARACTERS else f"{text[:_MAX_SHOWN_CHARACTERS]}…"


def _last_line(log: Any) -> str:
    """Return the last line that a program has written to its standard error, in brackets; empty if there is none."""
    size = log.seek(0, os.SEEK_END)
    log.seek(max(0, size - 4000))
    lines = log.read().decode("utf-8", "replace").split("\n")
    last = next((line for line in reversed(lines) if line.strip()), "")
    return f" (its last output: {one_line(last)[:300]})" if last else ""
