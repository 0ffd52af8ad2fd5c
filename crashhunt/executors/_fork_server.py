"""The fork server of a pool: it starts supervisors and, separately, the processes whose forks run trials.

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
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from crashhunt.base.codec import prepare
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.processes import adopt_orphans, die_with, end_descendants, kill, resume
from crashhunt.base.signals import is_sent_from_outside
from crashhunt.episode import WorkerSettings, require_origin, seal
from crashhunt.executors._host_conditions import HostConditions
from crashhunt.executors._supervisor import be_supervisor
from crashhunt.executors._time_limits import ImportWatch, import_died
from crashhunt.executors._zygote import be_zygote, import_nothing, import_parts
from crashhunt.trial import TrialResult

if TYPE_CHECKING:
    from crashhunt.base.json_types import ErrorData
    from crashhunt.executors._protocol import ForkServerJob, FromForkServer, ToForkServer

_MAX_MESSAGE_BYTES = 1 << 16  # bytes; an order to start a supervisor is some hundred
_ORPHANS_EVERY_S = 0.5  # looking for what dead trials left behind walks all of /proc
_LOOK_EVERY_S = 0.02  # where the kernel does not report when a process ends
# These signals are meant for the hunt; the process of a trial dies of them as any process does.
_IGNORED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


def main() -> None:
    """Run the fork server; it logs to standard error."""
    control = socket.socket(fileno=int(sys.argv[1]))
    job: ForkServerJob = json.loads(Path(sys.argv[2]).read_text(encoding="utf-8"))
    if job["sys_path"]:
        sys.path[:] = job["sys_path"]
    _ignore_signals()
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
    """Starts supervisors, and reports how they ended.

    Args:
        control: connection to the pool.
        orders: connection to the template.
        template: process of the template.
        settings: settings of the hunt.
        conditions: the conditions under which trials can run, as they were before the first trial.
    """

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
            said = _parse_request(data)
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
        with suppress(AttributeError, OSError):
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
            signal.signal(-code, signal.SIG_DFL) if -code not in (signal.SIGKILL, signal.SIGSTOP) else None
            os.kill(os.getpid(), -code)
        os._exit(code)


def _be_template(orders: socket.socket, settings: WorkerSettings, *, late: bool) -> None:
    """Import the modules that trials need, and fork a zygote whenever the fork server requests one."""
    adopt_orphans()
    try:
        report = lambda importing: _send(orders, {"importing": importing})  # noqa: E731
        imported = import_nothing(settings) if late else import_parts(settings, report, rehearses=True)
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


def _parse_request(data: bytes) -> FromForkServer:
    """Return the message of the template; None if an imported agent has written other data to the connection."""
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


def _ignore_signals() -> None:
    for number in _IGNORED_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _send(control: socket.socket, message: FromForkServer | ErrorData) -> None:
    with suppress(OSError):  # the receiver has ended, which is detected elsewhere
        control.send(json.dumps(message).encode())
