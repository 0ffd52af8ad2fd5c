"""The zygote of a slot: every trial runs in a fork of it, which ends with the trial. The zygote itself runs none."""

from __future__ import annotations

import gc
import json
import os
import select
import shutil
import sys
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NoReturn, cast

from crashhunt.base.errors import DISK, CrashhuntError
from crashhunt.base.forks import ended
from crashhunt.base.limits import limit_behind
from crashhunt.base.plugins import locate, registered
from crashhunt.base.processes import adopt_orphans, die_with, end_descendants, kill
from crashhunt.episode import stage_of, words_of
from crashhunt.executors._trial_process import TrialProcess, loaded
from crashhunt.executors._warm import WarmTraffics

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from crashhunt.episode import Parts, WorkerSettings
    from crashhunt.executors._messages import FromZygote, KillTrial
    from crashhunt.executors._trial_process import Job

__all__ = ["Imported", "be_zygote", "import_nothing", "import_parts"]

_RECEIVED = 1 << 16  # bytes at a time
_LOOK_EVERY_S = 0.005  # where the kernel does not report when a process ends


@dataclass(frozen=True, slots=True)
class Imported:
    """What the processes of trials need not do again, as it was done before they were forked.

    Args:
        parts: what has been imported; None where each trial imports its agents itself.
        makes_simulator: whether the zygote makes the simulator; if not, each trial makes its own.
    """

    parts: Parts | None
    makes_simulator: bool


_EACH_ITSELF: Final = Imported(None, makes_simulator=False)


def import_parts(settings: WorkerSettings) -> Imported | None:
    """Import what trials need, and find out whether the simulator may be made in a zygote.

    Returns:
        None where this process cannot be forked any more.

    Raises:
        CrashhuntError: something cannot be imported.
    """
    parts = loaded(settings)
    if not _can_be_forked():
        return None
    if settings.scenario.backend.forkable:
        return Imported(parts, makes_simulator=True)
    return Imported(parts, makes_simulator=_is_forkable_with(parts))


def import_nothing(settings: WorkerSettings) -> Imported:
    """Import the library of the simulator alone, where trials import their agents themselves.

    Raises:
        CrashhuntError: it cannot be imported.
    """
    if settings.scenario.simulator in registered("simulators"):
        locate("simulators", settings.scenario.simulator)
    return _EACH_ITSELF


def _is_forkable_with(parts: Parts) -> bool:
    """Whether a process that has made the simulator can still be forked, as a fork of this one finds out.

    An environment may start threads, which a fork does not have.
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
    """Whether what has been imported allows it: a thread does not come along, and neither does a graphics card."""
    try:
        threads = len(os.listdir("/proc/self/task"))  # noqa: PTH208 - how many is enough
    except OSError:
        threads = len(sys._current_frames())
    torch = sys.modules.get("torch")
    return threads == 1 and not (torch is not None and torch.cuda.is_initialized())


def be_zygote(control: socket.socket, settings: WorkerSettings, imported: Imported) -> NoReturn:
    """Fork a process for each trial that the supervisor asks for; does not return.

    Args:
        control: to the supervisor.
        settings: of the hunt.
        imported: what has been done already.
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

    def serve(self) -> None:
        """Do what the supervisor says until it is gone."""
        try:
            if self._makes_simulator:
                simulator = self._trial.make_simulator()
                if self._warm is not None:
                    self._warm.prepare(self._trial, simulator)
        except BaseException as error:
            self._say(_why_not(error))
            return
        self._staged = self._changed_at()
        if remaining := self._trial.record_shared_state():
            self._notices.append(f"trials are not wholly apart: a module shares {remaining} with every one of them")
        gc.freeze()  # a collection in a fork would copy the page of every object
        self._say({"ready": os.getpid()})
        while (message := self._next()) is not None:
            if "spec" in message:  # else it is about a trial that has ended meanwhile
                pid, code = self._run(cast("Job", message))
                said: FromZygote = {"ended": code, "pid": pid, "unfit": self._changed_at() != self._staged}
                if self._notices:
                    said["notices"] = self._notices[:]
                    self._notices.clear()
                self._say(said)

    def _changed_at(self) -> int:
        """When a file of the simulator was last added or removed, in ns; 0 where its folder is gone."""
        try:
            return self._stage.stat().st_mtime_ns
        except OSError:
            return 0

    def _run(self, job: Job) -> tuple[int, int]:
        """Return the process that ran a trial, and its exit code, negative for a signal."""
        spared = frozenset[int]()
        if self._warm is not None:
            found = self._warm.run(job, self._wait)
            spared = self._warm.processes
            if found is not None:
                end_descendants(spared)
                return found
        zygote, pid = os.getpid(), os.fork()
        if pid == 0:
            die_with(zygote)
            os.close(self._control.detach())
            if self._warm is not None:
                self._warm.forget()
            self._trial.run(job)
        killed = lambda: kill(pid)  # noqa: E731
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
        end_descendants(spared)
        if not self._makes_simulator:
            shutil.rmtree(stage_of(self._scratch, pid), ignore_errors=True)
        return pid, code

    def _wait(self, end: int | None, kill_trial: Callable[[], None]) -> None:
        """Wait until something can be read from a descriptor; a moment where there is none."""
        while True:
            watched = [self._control.fileno(), *([end] if end is not None else [])]
            ready, _, _ = select.select(watched, [], [], _LOOK_EVERY_S if end is None else None)
            if self._control.fileno() in ready:
                message = self._next()
                if message is None:  # the supervisor is gone
                    kill_trial()
                    end_descendants()
                    self._leave(0)
                elif "kill" in message:
                    kill_trial()
            if end is None or end in ready:
                return

    def _next(self) -> Job | KillTrial | None:
        """Return the next message; None where the supervisor is gone."""
        while b"\n" not in self._received:
            try:
                data = self._control.recv(_RECEIVED)
            except OSError:
                data = b""
            if not data:
                return None
            self._received += data
        line, _, rest = bytes(self._received).partition(b"\n")
        self._received = bytearray(rest)
        message: Job | KillTrial = self._loads(line)
        return message

    def _say(self, message: FromZygote) -> None:
        with suppress(OSError):  # the supervisor is gone, which the next call sees
            self._control.sendall(self._dumps(message).encode() + b"\n")


def _why_not(error: BaseException) -> FromZygote:
    """Return why no trial can run."""
    if isinstance(error, CrashhuntError):
        return {"error": error.to_json()["error"]}
    full = isinstance(error, OSError) and error.errno in DISK
    fix = limit_behind(error) or ("free some space" if full else "see to what it needs")
    fix = f"{fix}, and run the same command again"
    said = f"{type(error).__name__}: {words_of(error)}"
    return {"error": CrashhuntError(f"the simulator cannot be made: {said}", fix=fix).to_json()["error"]}
