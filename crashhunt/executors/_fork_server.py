"""The fork server of a pool: it starts supervisors and, separately, zygotes, the processes whose forks run trials.

::

    hunt -- keeper -- fork server -+- supervisor, one a slot              (no foreign code)
                                   +- template -- zygote, one a slot -- process of a trial

The fork server and the supervisors are forked before any foreign code is imported. The template imports the agents and
runs no trial. A zygote is a fork of the template that has created the simulator. Every trial runs in a fork of its
slot's zygote. The process of a trial ends with the trial, so a trial cannot be affected by another trial. A zygote
carries out the requests of its supervisor, which are to fork, to kill, and to report how a process ended.
"""

from __future__ import annotations

import gc
import json
import os
import select
import shutil
import signal
import socket
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, cast

from crashhunt.agents import ProgramFactory, offer_reused
from crashhunt.base import layout
from crashhunt.base.agent_locators import is_native
from crashhunt.base.codec import prepare
from crashhunt.base.errors import DISK, CrashhuntError
from crashhunt.base.exceptions import message_of
from crashhunt.base.forks import ended
from crashhunt.base.plugins import locate
from crashhunt.base.processes import adopt_orphans, die_with, end_descendants, exit_as, kill, resume
from crashhunt.base.resources import limit_behind
from crashhunt.base.shared_memory import SharedMemoryWatch
from crashhunt.base.signals import is_sent_from_outside
from crashhunt.episode import WorkerSettings, require_origin, seal, stage_of
from crashhunt.executors._host_conditions import HostConditions
from crashhunt.executors._preparation import Imported, import_nothing, import_parts
from crashhunt.executors._supervisor import be_supervisor
from crashhunt.executors._time_limits import ImportWatch, import_died
from crashhunt.executors._trial_process import TrialProcess
from crashhunt.executors._warm_traffics import WarmTraffics
from crashhunt.trial import TrialResult

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.agents import ReusedProgram
    from crashhunt.base.json_types import ErrorData
    from crashhunt.executors._protocol import ForkServerJob, FromForkServer, FromZygote, Job, KillTrial, ToForkServer

_MAX_MESSAGE_BYTES = 1 << 16  # bytes; an order to start a supervisor is some hundred
_ORPHANS_EVERY_S = 0.5  # looking for what dead trials left behind walks all of /proc
_LOOK_EVERY_S = 0.02  # where the kernel does not report when a process ends
_END_EVERY_S = 0.005  # the same, of the process of a trial
_CHUNK_BYTES = 1 << 16  # bytes at a time
_SEGMENTS_EVERY_S = 0.1  # whether the trial uses new shared memory, which its death would hide
_NATIVE_STACK_S = 2.0  # in which a process that hangs writes its native stack
# These signals are meant for the hunt; the process of a trial dies of them as any process does.
_IGNORED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


def main() -> None:
    """Run the fork server; it logs to standard error."""
    control = socket.socket(fileno=int(sys.argv[1]))
    job: ForkServerJob = json.loads(Path(sys.argv[2]).read_text(encoding="utf-8"))
    if job["sys_path"]:
        sys.path[:] = job["sys_path"]
    for number in _IGNORED_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    adopt_orphans()
    try:
        settings = WorkerSettings.from_json(job["settings"])
        if not job["sys_path"]:
            require_origin("crashhunt", settings.code)
        seal(settings)
    except CrashhuntError as error:
        _send(control, error.to_json())
        return
    conditions = HostConditions(settings)
    prepare(TrialResult)  # here, or the processes of each trial do it again
    gc.freeze()
    orders, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    server, template = os.getpid(), os.fork()
    if template == 0:
        try:
            control.close()
            orders.close()
            die_with(server)
            _be_template(theirs, settings, late=job["late"])
        finally:
            os._exit(1)
    theirs.close()
    _Server(control, orders, template, settings, conditions).serve()


class _Server:
    """Starts supervisors, and reports how they ended."""

    def __init__(
        self,
        control: socket.socket,
        orders: socket.socket,
        template: int,
        settings: WorkerSettings,
        conditions: HostConditions,
    ) -> None:
        self._conditions = conditions
        self._control, self._orders, self._template, self._settings = control, orders, template, settings
        self._slots: dict[int, int] = {}  # process to slot
        self._ends: dict[int, int] = {}  # process to the descriptor by which the kernel reports its end
        self._watch = ImportWatch(settings.timeout_s)

    def serve(self) -> None:
        """Carry out the requests of the pool until the pool or the template has ended."""
        while True:
            wait_s = _LOOK_EVERY_S if len(self._ends) < len(self._slots) else _ORPHANS_EVERY_S
            watched = [self._control.fileno(), self._orders.fileno(), *self._ends.values()]
            ready, _, _ = select.select(watched, [], [], wait_s)
            if self._control.fileno() in ready and not self._handle_request():
                return  # the keeper ends every process
            if self._orders.fileno() in ready and not self._forward_template_messages():
                self._exit_as(os.waitstatus_to_exitcode(os.waitpid(self._template, 0)[1]))
            if self._watch.has_hung:
                _send(self._control, self._watch.hung().to_json())
                kill(self._template)
                return
            if self._reap():
                return
            for pid in (self._template, *self._slots):
                resume(pid)  # which an agent may have stopped
            # Other children were left behind by a template or a supervisor that died.
            end_descendants(frozenset(self._slots) | {self._template})

    def _forward_template_messages(self) -> bool:
        """Forward the messages of the template; return whether the template is still running."""
        while True:
            try:
                data = self._orders.recv(_MAX_MESSAGE_BYTES, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return True
            except OSError:
                data = b""
            if not data:
                return False
            said = _parse_message(data)
            if "importing" in said:
                self._watch.begin(said["importing"])
            else:
                self._watch.begin("")
                _send(self._control, said)

    def _handle_request(self) -> bool:
        """Carry out a request of the pool; return whether the pool is still connected."""
        data, descriptors, _, _ = socket.recv_fds(self._control, _MAX_MESSAGE_BYTES, 1)
        if not data:
            return False
        message: ToForkServer = json.loads(data)
        if "kill" in message:
            for pid in [pid for pid, slot in self._slots.items() if slot == message["kill"]]:
                kill(pid)
            return True
        pool = socket.socket(fileno=descriptors[0])
        zygote, theirs = socket.socketpair()
        with pool, zygote, theirs:
            try:
                socket.send_fds(self._orders, [b"zygote"], [theirs.fileno()])
            except ConnectionError:  # a supervisor without a zygote would lose its trial
                self._forward_template_messages()  # what it said before it ended
                self._exit_as(os.waitstatus_to_exitcode(os.waitpid(self._template, 0)[1]))
            server, pid = os.getpid(), os.fork()
            if pid == 0:
                for descriptor in self._ends.values():
                    os.close(descriptor)
                self._control.close()
                self._orders.close()
                theirs.close()
                for number in _IGNORED_SIGNALS:
                    signal.signal(number, signal.SIG_DFL)
                signal.signal(signal.SIGINT, signal.SIG_IGN)
                be_supervisor(pool, zygote, self._settings, self._conditions, server)
        self._slots[pid] = message["slot"]
        with suppress(OSError):
            self._ends[pid] = os.pidfd_open(pid)
        return True

    def _reap(self) -> bool:
        """Report which supervisors have ended; return whether the template has ended."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return True
            if pid == 0:
                return False
            if pid in self._ends:
                os.close(self._ends.pop(pid))
            code = os.waitstatus_to_exitcode(status)
            if pid in self._slots:
                _send(self._control, {"slot": self._slots.pop(pid), "pid": pid, "exit_code": code})
            elif pid == self._template:
                self._forward_template_messages()  # what it said before it ended
                self._exit_as(code)

    def _exit_as(self, code: int) -> NoReturn:
        """Exit with the exit status of the template, which the parent process interprets."""
        if self._watch.importing and is_sent_from_outside(code):
            _send(self._control, {"importing": self._watch.importing})
        elif self._watch.importing:
            _send(self._control, import_died(self._watch.importing, code).to_json())
        if code < 0:
            end_descendants()
        exit_as(code)


def _be_template(orders: socket.socket, settings: WorkerSettings, *, late: bool) -> None:
    """Import the modules that trials need, and fork a zygote whenever the fork server requests one."""
    adopt_orphans()
    try:
        report = lambda importing: _send(orders, {"importing": importing})  # noqa: E731
        imported = import_nothing(settings) if late else import_parts(settings, report)
    except CrashhuntError as error:
        _send(orders, error.to_json())
        return
    if imported is None:
        _send(orders, {"unfit": True})
        return
    gc.collect()
    gc.freeze()
    _send(orders, {"ready": os.getpid()})
    zygotes: set[int] = set()
    while True:
        ready, _, _ = select.select([orders], [], [], _ORPHANS_EVERY_S)
        if ready:
            data, descriptors, _, _ = socket.recv_fds(orders, _MAX_MESSAGE_BYTES, 1)
            if not data:
                os._exit(0)
            control = socket.socket(fileno=descriptors[0])
            template, pid = os.getpid(), os.fork()
            if pid == 0:
                orders.close()
                die_with(template)
                for number in _IGNORED_SIGNALS:
                    signal.signal(number, signal.SIG_DFL)
                os.setsid()
                be_zygote(control, settings, imported)
            control.close()
            zygotes.add(pid)
        with suppress(ChildProcessError):
            while (pid := os.waitpid(-1, os.WNOHANG)[0]) != 0:
                zygotes.discard(pid)
        end_descendants(frozenset(zygotes))


def _parse_message(data: bytes) -> FromForkServer:
    """Return the message of the template; empty if an imported agent has written other data to the connection."""
    said: FromForkServer = {}
    with suppress(ValueError, KeyError, TypeError):
        message = json.loads(data)
        if "error" in message:
            words = message["error"]
            said["error"] = {name: str(words[name]) for name in ("message", "fix", "where")}  # type: ignore[typeddict-item]
        elif message.get("unfit") is True:
            said["unfit"] = True
        elif "ready" in message:
            said["ready"] = int(message["ready"])
        elif "importing" in message:
            said["importing"] = str(message["importing"])
    return said


def _send(control: socket.socket, message: FromForkServer | ErrorData) -> None:
    with suppress(OSError):  # the receiver has ended, which is detected elsewhere
        control.send(json.dumps(message).encode())


# The zygote of a slot: every trial runs in a fork of the zygote, which ends with the trial. The zygote runs no trial.


def be_zygote(control: socket.socket, settings: WorkerSettings, imported: Imported) -> NoReturn:
    """Fork a process for each trial that the supervisor requests; this function does not return."""
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
            shared = f"a module shares {remaining} with every one of them"
            self._notices.append(f"trials are not wholly apart: {shared}; if it is yours, open this in reset instead")
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
        except OSError:
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
                time.sleep(_END_EVERY_S)
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
            ready, _, _ = select.select(watched, [], [], _END_EVERY_S if end is None else _SEGMENTS_EVERY_S)
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
