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
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn, TypedDict, cast

from crashhunt.agents import ProgramFactory, offer_reused
from crashhunt.base import forks, layout
from crashhunt.base.capabilities import supports
from crashhunt.base.errors import DISK, CrashhuntError
from crashhunt.base.exceptions import message_of
from crashhunt.base.forks import ended
from crashhunt.base.plugins import locate, registered
from crashhunt.base.processes import adopt_orphans, children_of, die_with, end_descendants, kill
from crashhunt.base.programs import is_native
from crashhunt.base.resources import FREE, free_memory, limit_behind
from crashhunt.base.temporary import SharedMemoryWatch
from crashhunt.base.text import format_percent
from crashhunt.episode import Parts, generators, options_of, seed_everything, set_generators, stage_of
from crashhunt.executors._rehearsal import rehearse_trial
from crashhunt.executors._trial_process import TrialProcess
from crashhunt.simulators import CountsSetUp
from crashhunt.trial import TrialSpec

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from crashhunt.agents import ReusedProgram
    from crashhunt.episode import WorkerSettings
    from crashhunt.executors._protocol import FromZygote, KillTrial
    from crashhunt.executors._trial_process import Job
    from crashhunt.simulators import Info, Observations, Simulator

    Wait = Callable[[int | None, Callable[[], None]], None]


# Warming up once: forks of a zygote that have reset the simulator, for trials that begin in the same traffic.
#
# The zygote of a slot keeps some such processes suspended. A trial with the same seed and scenario arguments runs in a
# fork of one of them, with the random generators as the reset left them: nothing in its digest shows the difference.

_CHUNK_BYTES = 1 << 16  # bytes at a time
_MIN_WARM_UP_S = 0.02  # a fork of a fork costs some ten milliseconds, half of them for its end
_TRIALS_UNTIL_STALE = 8  # a copy makes room after this many trials per copy without one in its traffic

# Bound here, before any agent is imported that could replace them.
_dumps, _loads, _write = json.dumps, json.loads, os.write


class _Answer(TypedDict, total=False):
    """A report of a suspended process: the duration of its reset, its failure, or how the process of a trial ended."""

    took_s: float
    unfit: str
    pid: int
    ended: int


class WarmTraffics:
    """The suspended processes of a zygote: one for each traffic, in which the simulator has been reset.

    Args:
        limit: maximum number of suspended processes.
        notify: function called with texts for the user.
        worth_s: a suspended process is kept only if its warm-up took at least this wall time, in s.
    """

    def __init__(self, limit: int, notify: Callable[[str], None], *, worth_s: float = _MIN_WARM_UP_S) -> None:
        self._worth_s = worth_s
        self._limit = limit
        self._notify = notify
        self._suspended: OrderedDict[str, _Suspended] = OrderedDict()  # the most recently used is the last
        self._trials = 0
        self._trial: TrialProcess | None = None
        self._simulator: Simulator | None = None

    def prepare(self, trial: TrialProcess, simulator: Simulator) -> None:
        """Store the objects with which trials run."""
        self._trial, self._simulator = trial, simulator

    @property
    def processes(self) -> frozenset[int]:
        """The suspended processes, by traffic."""
        return frozenset(one.pid for one in self._suspended.values())

    def forget(self) -> None:
        """Close the pipes to the suspended processes in the present process, which runs a trial."""
        for one in self._suspended.values():
            one.close()
        self._suspended.clear()

    def run(self, job: Job, wait: Wait) -> tuple[int, int] | None:
        """Run a trial in a fork of the suspended process for its traffic; create that process if it is missing.

        Args:
            job: the job of the trial.
            wait: function that waits until a descriptor can be read; its second argument is a function that kills the
                process.

        Returns:
            The process that ran the trial and its exit code; None if the trial has to run in a fork of the zygote.
        """
        if self._trial is None or self._limit == 0:
            return None
        self._trials += 1
        spec = TrialSpec.from_json(job["spec"])
        key = _traffic_key(spec)
        found = self._suspended.get(key) or self._make(key, spec, wait)
        if found is None:
            return None
        self._suspended.move_to_end(key)
        found.used = self._trials
        said = found.ask(_dumps(job).encode() + b"\n", wait)
        if said is None:  # it was killed, and the trial with it
            code = self._drop(key)
            return found.pid, code or -9
        if "unfit" in said:
            self._stop(said["unfit"])
            self._drop(key)
            return None
        return said["pid"], said["ended"]

    def _make(self, key: str, spec: TrialSpec, wait: Wait) -> _Suspended | None:
        if not self._make_room():
            return None
        wakes, ours = os.pipe()
        theirs, says = os.pipe()
        assert self._trial is not None
        assert self._simulator is not None
        be_suspended = partial(_be_suspended, wakes, says, self._trial, self._simulator, spec)
        try:
            pid = forks.fork(be_suspended, forks.held(), keeps=(wakes, says))
        except forks.CannotForkError as error:
            self._stop(error.message)
            os.close(ours)
            os.close(theirs)
            return None
        finally:
            os.close(wakes)
            os.close(says)
        made = self._suspended[key] = _Suspended(pid=pid, asks=ours, says=theirs, used=self._trials)
        said = made.ask(b"", wait)
        if said is not None and said.get("took_s", 0.0) >= self._worth_s:
            return made
        self._drop(key)
        if said is not None and "took_s" in said:
            self._limit = 0  # no warm-up here is worth it
        return None

    def _drop(self, key: str) -> int:
        return self._suspended.pop(key).end()

    def _stop(self, why: str) -> None:
        self._limit = 0
        self._notify(f"trials in the same traffic do not share its warm-up: {why}")

    def _make_room(self) -> bool:
        if free_memory() < FREE:
            self._notify(
                f"less than {format_percent(FREE)} of the memory is free: "
                "fewer warmed-up copies are kept than there might be"
            )
            return False
        if len(self._suspended) < self._limit:
            return True
        key, oldest = next(iter(self._suspended.items()))
        # Where trials take turns in more traffics than there are copies, the oldest one is the next to be used.
        if self._trials - oldest.used < _TRIALS_UNTIL_STALE * self._limit:
            return False
        self._drop(key)
        return True


@dataclass(slots=True, eq=False)
class _Suspended:
    """A suspended process and the pipes to it, as the zygote stores them.

    Args:
        pid: process id of the suspended process.
        asks: the pipe for requests to the process.
        says: the pipe for answers from the process.
        used: number of the last trial that used the process.
    """

    pid: int
    asks: int
    says: int
    used: int

    def ask(self, text: bytes, wait: Wait) -> _Answer | None:
        """Send a request to the process, and return its answer; None if the process has ended."""
        try:
            while text:
                text = text[_write(self.asks, text) :]
        except BrokenPipeError:
            return None
        received = bytearray()
        while not received.endswith(b"\n"):
            wait(self.says, self._kill)
            data = os.read(self.says, _CHUNK_BYTES)
            if not data:
                return None
            received += data
        said: _Answer = _loads(received)
        return said

    def _kill(self) -> None:
        """Kill the trial, or the process itself if it is still resetting the simulator."""
        for pid in children_of(self.pid) or [self.pid]:
            kill(pid)

    def close(self) -> None:
        """Close the pipes to the process."""
        os.close(self.asks)
        os.close(self.says)

    def end(self) -> int:
        """Kill the process, and return its exit code."""
        for child in children_of(self.pid):
            kill(child)
        kill(self.pid)
        code = forks.ended(self.pid)
        self.close()
        return code


def _be_suspended(wakes: int, says: int, trial: TrialProcess, simulator: Simulator, spec: TrialSpec) -> None:
    """Reset the simulator, and then run each requested trial in a fork."""
    adopt_orphans()
    began = time.monotonic()
    try:
        seed_everything(spec.seed)
        begun = simulator.reset(seed=spec.seed, options=options_of(spec, simulator))
    except BaseException:  # the trial itself will report it
        _report(says, {})
        return
    _report(says, {"took_s": time.monotonic() - began})
    drawn = generators()

    def again(**_given: object) -> tuple[Observations, Info]:
        set_generators(drawn)
        return begun

    with os.fdopen(wakes, "rb", closefd=False) as jobs:
        for line in jobs:
            try:
                pid = forks.fork(partial(_run, trial, line, again), forks.held())
            except forks.CannotForkError as error:
                _report(says, {"unfit": error.message})
                continue
            code = forks.ended(pid)
            end_descendants()
            if supports(simulator, CountsSetUp):
                simulator.setup_steps = 0  # they have been counted, with the first trial
            _report(says, {"pid": pid, "ended": code})


def _run(trial: TrialProcess, line: bytes, again: Callable[..., tuple[Observations, Info]]) -> None:
    trial.run(_loads(line), again)


def _report(says: int, said: _Answer) -> None:
    text = _dumps(said).encode() + b"\n"
    with suppress(BrokenPipeError):
        while text:
            text = text[_write(says, text) :]


def _traffic_key(spec: TrialSpec) -> str:
    """Return the key of a trial's traffic: its seed and the scenario's arguments."""
    script = None if spec.script is None else spec.script.to_json()
    return json.dumps([spec.seed, dict(spec.scenario_arguments), spec.only, script], sort_keys=True)


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
