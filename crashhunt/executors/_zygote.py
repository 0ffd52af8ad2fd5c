"""The zygote of a slot: every trial runs in a fork of the zygote, which ends with the trial.

The zygote runs no trial.
"""

from __future__ import annotations

import gc
import json
import os
import select
import shutil
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn, cast

from crashhunt.agents import ProgramFactory, offer_reused
from crashhunt.base import layout
from crashhunt.base.errors import DISK, CrashhuntError
from crashhunt.base.exceptions import message_of
from crashhunt.base.forks import ended
from crashhunt.base.plugins import locate, registered
from crashhunt.base.processes import adopt_orphans, die_with, end_descendants, kill
from crashhunt.base.programs import is_native
from crashhunt.base.resources import limit_behind
from crashhunt.base.temporary import SharedMemoryWatch
from crashhunt.episode import Parts, stage_of
from crashhunt.executors._rehearsal import rehearse_trial
from crashhunt.executors._trial_process import TrialProcess
from crashhunt.executors._warm_traffics import WarmTraffics

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from crashhunt.agents import ReusedProgram
    from crashhunt.episode import WorkerSettings
    from crashhunt.executors._protocol import FromZygote, KillTrial
    from crashhunt.executors._trial_process import Job


_CHUNK_BYTES = 1 << 16  # bytes at a time
_SEGMENTS_EVERY_S = 0.1  # whether the trial uses new shared memory, which its death would hide
_NATIVE_STACK_S = 2.0  # in which a process that hangs writes its native stack
_LOOK_EVERY_S = 0.005  # where the kernel does not report when a process ends


@dataclass(frozen=True, slots=True)
class Imported:
    """The result of the preparation that is made once, before the processes of trials are forked.

    Args:
        parts: the imported parts; None if each trial imports its agents itself.
        makes_simulator: whether the zygote creates the simulator; if not, each trial creates its own simulator.
    """

    parts: Parts | None
    makes_simulator: bool


_NOTHING_IMPORTED: Final = Imported(None, makes_simulator=False)


def import_parts(
    settings: WorkerSettings, report: Callable[[str], None], *, rehearses: bool = False
) -> Imported | None:
    """Import the modules that trials need, and check whether a zygote may create the simulator.

    Args:
        settings: settings of the hunt.
        report: function called before each import, as in `Parts.load`, and with an empty text at the end.
        rehearses: whether to rehearse a trial, which is worth its 20 ms if many trials follow.

    Returns:
        The result; None if this process can no longer be forked.

    Raises:
        CrashhuntError: a module cannot be imported.
    """
    parts = Parts(settings)
    if rehearses:
        rehearse_trial(settings.scratch, report)
    parts.load(report)
    if not _can_be_forked():
        return None
    report("the simulator cannot be made")
    makes_simulator = settings.scenario.backend.forkable or _is_forkable_with(parts)
    report("")
    return Imported(parts, makes_simulator=makes_simulator)


def import_nothing(settings: WorkerSettings) -> Imported:
    """Import only the library of the simulator, because trials import their agents themselves.

    Raises:
        CrashhuntError: the library cannot be imported.
    """
    if settings.scenario.simulator in registered("simulators"):
        locate("simulators", settings.scenario.simulator)
    return _NOTHING_IMPORTED


def _is_forkable_with(parts: Parts) -> bool:
    """Return whether a process can still be forked after it has created the simulator; a fork of this process tries it.

    The check is needed because an environment may start threads, which a fork does not have.
    """
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            parts.simulator()
            code = 0 if _can_be_forked() else 1
        finally:
            os._exit(code)
    forkable = ended(pid) == 0
    end_descendants()
    return forkable


def _can_be_forked() -> bool:
    """Return whether this process can be forked after its imports: it has no other threads and uses no GPU."""
    try:
        threads = len(os.listdir("/proc/self/task"))  # noqa: PTH208 - how many is enough
    except OSError:
        threads = len(sys._current_frames())
    torch = sys.modules.get("torch")
    return threads == 1 and not (torch is not None and torch.cuda.is_initialized())


def be_zygote(control: socket.socket, settings: WorkerSettings, imported: Imported) -> NoReturn:
    """Fork a process for each trial that the supervisor requests; this function does not return.

    Args:
        control: connection to the supervisor.
        settings: settings of the hunt.
        imported: the completed preparation.
    """
    try:
        _Zygote(control, settings, imported).serve()
    finally:
        os._exit(1)


class _Zygote:
    def __init__(self, control: socket.socket, settings: WorkerSettings, imported: Imported) -> None:
        self._control = control
        self._received = bytearray()
        self._dumps, self._loads, self._leave = json.dumps, json.loads, os._exit
        adopt_orphans()
        self._trial = TrialProcess(settings, imported.parts)
        self._notices: list[str] = []
        self._warm = WarmTraffics(settings.warm_copies, self._notices.append) if settings.warm_copies else None
        self._scratch = settings.scratch
        self._stage = stage_of(settings.scratch, os.getpid())
        self._staged = 0  # when the folder was last changed
        self._makes_simulator = imported.makes_simulator
        self._settings = settings
        self._reused: list[ReusedProgram] = []  # programs that drive in one trial after another
        self._segments = SharedMemoryWatch()

    def serve(self) -> None:
        """Carry out the requests of the supervisor until it has ended."""
        try:
            if self._makes_simulator:
                simulator = self._trial.make_simulator()
                if self._warm is not None:
                    self._warm.prepare(self._trial, simulator)
        except BaseException as error:
            self._report(_why_not(error))
            return
        self._staged = self._changed_at()
        self._offer_reused()
        if remaining := self._trial.record_shared_state(self._control.fileno()):
            self._notices.append(f"trials are not wholly apart: a module shares {remaining} with every one of them")
        gc.freeze()  # a collection in a fork would copy the page of every object
        self._report({"ready": os.getpid()})
        while (message := self._next()) is not None:
            if "spec" in message:  # else it is about a trial that has ended meanwhile
                pid, code = self._run(cast("Job", message))
                said: FromZygote = {"ended": code, "pid": pid, "unfit": self._changed_at() != self._staged}
                if self._notices:
                    said["notices"] = self._notices[:]
                    self._notices.clear()
                self._report(said)
        for program in self._reused:
            program.end()

    def _offer_reused(self) -> None:
        """Prepare the programs of agents that drive in one trial after another; the first trial starts them."""
        scenario, files, programs = self._settings.scenario, self._settings.argument_files, {}
        for agent in self._settings.reuses:
            factory = locate("agents", scenario.agents[agent].agent)
            if isinstance(factory, ProgramFactory):
                programs[agent] = factory.reused(self._scratch / f"program-{os.getpid()}-{agent}", files)
        offer_reused(programs)
        self._reused = [*programs.values()]

    def _changed_at(self) -> int:
        """Return when a file of the simulator was last added or removed, in ns; 0 if its folder was deleted."""
        try:
            return self._stage.stat().st_mtime_ns
        except OSError:
            return 0

    def _run(self, job: Job) -> tuple[int, int]:
        """Run a trial, and return its process and the exit code, which is negative for a signal."""
        for program in self._reused:
            program.prepare()
        try:
            return self._run_trial(job, frozenset(program.pid for program in self._reused) - {0})
        finally:
            for program in self._reused:
                program.move_log(Path(job["folder"]) / layout.RUN_LOG)

    def _run_trial(self, job: Job, spared: frozenset[int]) -> tuple[int, int]:
        self._segments = SharedMemoryWatch()
        if self._warm is not None:
            found = self._warm.run(job, self._wait)
            spared |= self._warm.processes
            if found is not None:
                self._end_descendants(spared)
                return found
        zygote, pid = os.getpid(), os.fork()
        if pid == 0:
            die_with(zygote)
            os.close(self._control.detach())
            if self._warm is not None:
                self._warm.forget()
            for program in self._reused:
                program.forget()
            self._trial.run(job)
        killed = partial(self._kill, pid)
        try:
            end = os.pidfd_open(pid)
        except (AttributeError, OSError):
            while (found_pid := os.waitpid(pid, os.WNOHANG))[0] == 0:
                self._wait(None, killed)
            code = os.waitstatus_to_exitcode(found_pid[1])
        else:
            self._wait(end, killed)
            os.close(end)
            code = ended(pid)
        self._end_descendants(spared)
        if not self._makes_simulator:
            shutil.rmtree(stage_of(self._scratch, pid), ignore_errors=True)
        return pid, code

    def _kill(self, pid: int) -> None:
        """Kill a trial that hangs; if native code of an agent may be the reason, its process writes its stack first."""
        if any(is_native(setup.agent) for setup in self._settings.scenario.agents.values()):
            with suppress(OSError):
                os.kill(pid, signal.SIGABRT)
            until = time.monotonic() + _NATIVE_STACK_S
            while time.monotonic() < until and os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
                time.sleep(_LOOK_EVERY_S)
        kill(pid)

    def _end_descendants(self, spared: frozenset[int]) -> None:
        """Kill the processes that a trial has left behind, and remove their shared memory."""
        self._segments.look()
        end_descendants(spared)
        self._segments.remove()

    def _wait(self, end: int | None, kill_trial: Callable[[], None]) -> None:
        """Wait until a descriptor can be read; without a descriptor, wait a moment."""
        while True:
            watched = [self._control.fileno(), *([end] if end is not None else [])]
            ready, _, _ = select.select(watched, [], [], _LOOK_EVERY_S if end is None else _SEGMENTS_EVERY_S)
            self._segments.look()
            if self._control.fileno() in ready:
                message = self._next()
                if message is None:  # the supervisor is gone
                    kill_trial()
                    for program in self._reused:
                        program.end()
                    self._end_descendants(frozenset())
                    self._leave(0)
                elif "kill" in message:
                    kill_trial()
            if end is None or end in ready:
                return

    def _next(self) -> Job | KillTrial | None:
        """Return the next message of the supervisor; None if the supervisor has ended."""
        while b"\n" not in self._received:
            try:
                data = self._control.recv(_CHUNK_BYTES)
            except OSError:
                data = b""
            if not data:
                return None
            self._received += data
        line, _, rest = bytes(self._received).partition(b"\n")
        self._received = bytearray(rest)
        message: Job | KillTrial = self._loads(line)
        return message

    def _report(self, message: FromZygote) -> None:
        with suppress(OSError):  # the supervisor is gone, which the next call sees
            self._control.sendall(self._dumps(message).encode() + b"\n")


def _why_not(error: BaseException) -> FromZygote:
    """Return the message to the supervisor for an error that prevents all trials."""
    if isinstance(error, CrashhuntError):
        return {"error": error.to_json()["error"]}
    full = isinstance(error, OSError) and error.errno in DISK
    fix = limit_behind(error) or ("free some space" if full else "see to what it needs")
    fix = f"{fix}, and run the same command again"
    said = f"{type(error).__name__}: {message_of(error)}"
    return {"error": CrashhuntError(f"the simulator cannot be made: {said}", fix=fix).to_json()["error"]}
