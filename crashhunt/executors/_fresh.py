"""A new process for every trial: slower than a pool, but independent of everything that ran before."""

from __future__ import annotations

import gc
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.codec import prepare
from crashhunt.base.errors import CrashhuntError, WorkerError
from crashhunt.base.processes import children_of, die_with
from crashhunt.base.reaper import Kept
from crashhunt.base.signals import describe_death, is_sent_from_outside
from crashhunt.episode import WorkerSettings, answer_file, require_origin, scratch_of, seal
from crashhunt.executors._fork_server import be_zygote
from crashhunt.executors._host_conditions import HostConditions
from crashhunt.executors._postmortem import TrialAttempt, hung, result_of_death, where_it_is
from crashhunt.executors._preparation import import_nothing, import_parts
from crashhunt.executors._protocol import Answer, FreshJob, Notes
from crashhunt.executors._supervisor import LostTrialError, Supervisor, UnfitZygoteError, with_escape
from crashhunt.executors._time_limits import (
    START_UP_S,
    ImportKilledError,
    PauseMeter,
    await_imports,
    has_hung,
    import_died,
)
from crashhunt.executors._worker_environment import snapshot_environment
from crashhunt.trial import TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from crashhunt.recording import BlackBoxHeader


_LOOK_EVERY_S = 0.01  # starting one takes thirty times as long
_FULL_BYTES = 1 << 20  # with less free space, a recording cannot be made
_ESCAPE_S = 60.0  # for what is found out about a crash after its own trial has ended


@dataclass(slots=True)
class _Running:
    attempt: TrialAttempt
    kept: Kept
    answer: Path
    began: float
    killed: bool = False
    pauses: PauseMeter = field(default_factory=PauseMeter)


class FreshProcessExecutor:
    """Runs every trial, and the code that the settings name, in a new process.

    Args:
        settings: settings of the hunt.
        parallel: number of processes at a time.
    """

    def __init__(self, settings: WorkerSettings, *, parallel: int = 1) -> None:
        self._settings = settings
        self.capacity = parallel
        self._notes = Notes(settings.scratch)
        self._waiting: deque[TrialAttempt] = deque()
        self._running: dict[int, _Running] = {}

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial."""
        self._waiting.append(TrialAttempt(spec))
        self._start()

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended; wait at most ``timeout_s`` for the first one."""
        deadline = time.monotonic() + timeout_s
        while True:
            found = [result for number in list(self._running) if (result := self._poll_process(number)) is not None]
            self._start()
            yield from found
            if found or time.monotonic() >= deadline:
                return
            time.sleep(_LOOK_EVERY_S)

    def cancel(self, *, above: int = -1) -> None:
        """Cancel all trials whose number is greater than ``above``, at once."""
        self._waiting = deque(attempt for attempt in self._waiting if attempt.spec.number <= above)
        for number in [number for number in self._running if number > above]:
            self._running.pop(number).kept.end()

    def where(self) -> dict[int, BlackBoxHeader]:
        """Return the progress of each running trial, for the status screen."""
        found = {number: where_it_is(self._settings.scratch, number) for number in self._running}
        return {number: header for number, header in found.items() if header is not None}

    def notes(self) -> list[str]:
        """Return new notices for the user."""
        return self._notes.fresh()

    def close(self) -> None:
        """Kill every process, including all processes that it has started."""
        self.cancel()

    def _start(self) -> None:
        while self._waiting and len(self._running) < self.capacity:
            if any(running.attempt.alone for running in self._running.values()):
                return
            if self._waiting[0].alone and self._running:
                return
            attempt = self._waiting.popleft()
            number = attempt.spec.number
            answer = answer_file(self._settings.scratch, number)
            answer.unlink(missing_ok=True)
            job, log_file = self._job(number), self._log(number)
            content: FreshJob = {
                "settings": self._settings.to_json(),
                "spec": attempt.spec.to_json(),
                "answer": str(answer),
            }
            job.write_text(json.dumps(content), encoding="utf-8")
            with log_file.open("wb") as log:
                kept = Kept(
                    "crashhunt.executors._fresh",
                    [str(job)],
                    environment=snapshot_environment(self._settings),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                )
            self._running[number] = _Running(attempt=attempt, kept=kept, answer=answer, began=time.monotonic())

    def _poll_process(self, number: int) -> TrialResult | None:
        running = self._running[number]
        exit_code = running.kept.process.poll()
        if exit_code is not None:
            del self._running[number]
            running.kept.end()
            return self._result(running, exit_code)
        limit_s, paused_s = self._settings.timeout_s, running.pauses.paused_s()
        if running.answer.exists():  # what is left to do is to find its escape, in trials that have limits of their own
            limit_s = _ESCAPE_S + 2 * limit_s
        header = where_it_is(self._settings.scratch, number)
        # A supervisor begins the recording before the process of the trial does. It ends that process, or its own
        # imports, where they hang; so what is left for this one is a supervisor that hangs itself.
        supervised = header is None or header.pid in children_of(running.kept.process.pid)
        limit_s += paused_s + (START_UP_S if supervised else 0.0)
        has_words = partial(_has_words, scratch_of(self._settings.scratch, number) / layout.STACK)
        if has_hung(header, begun=not supervised, given_at=running.began, limit_s=limit_s, has_words=has_words):
            running.killed = True
            running.kept.end()
        return None

    def _result(self, running: _Running, exit_code: int) -> TrialResult | None:
        scratch, spec = self._settings.scratch, running.attempt.spec
        if running.killed and not running.answer.exists():
            return hung(spec, scratch, self._settings.timeout_s)
        try:
            answer: Answer = json.loads(running.answer.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            if exit_code > 0 and where_it_is(scratch, spec.number) is None:
                raise _not_started(spec.number, self._log(spec.number), exit_code) from None
            return self._account_for_end(running, exit_code)
        # The answer is there, so that what was killed is the search for the escape: without it the answer is half.
        why_no_escape = ""
        if self._settings.find_escapes and not running.killed and is_sent_from_outside(exit_code):
            if why := running.attempt.again(scratch, exit_code):
                self._notes.add(why)
                self._waiting.appendleft(running.attempt)
                return None
            why_no_escape = f"the process that searched {describe_death(exit_code)}, {len(running.attempt.ends)} times"
        for file in (running.answer, self._job(spec.number), self._log(spec.number)):
            file.unlink(missing_ok=True)  # a hunt has a million trials
        if "error" in answer:
            raise WorkerError.from_json(answer)  # or an InternalError
        if "lost" in answer:
            return self._account_for_end(running, answer["lost"], answer.get("importing", ""))
        result = TrialResult.from_json(answer["result"])
        return replace(result, why_no_escape=why_no_escape) if why_no_escape and result.escape is None else result

    def _account_for_end(self, running: _Running, exit_code: int, importing: str = "") -> TrialResult | None:
        """Determine the result of a trial whose process has ended, or run the trial again.

        Raises:
            CrashhuntError: a module ends its process at every import.
        """
        if why := running.attempt.again(self._settings.scratch, exit_code):
            self._notes.add(why)
            self._waiting.appendleft(running.attempt)
            return None
        if importing:
            raise import_died(importing, exit_code, times=len(running.attempt.ends))
        return result_of_death(running.attempt, self._settings.scratch, exit_code)

    def _job(self, number: int) -> Path:
        return self._settings.scratch / layout.numbered(number, layout.JOB)

    def _log(self, number: int) -> Path:
        return self._settings.scratch / f"start-{number:06d}.log"


def _has_words(stack: Path) -> bool:
    try:
        return stack.stat().st_size > 0
    except OSError:
        return False


def main() -> None:
    """Run the trial that a job file describes, and write its result to another file."""
    # A KeyboardInterrupt would end this process, and the forks that import agents, with 1, as if an import had failed.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    job: FreshJob = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    temporary = Path(f"{job['answer']}.part")

    def answer(content: Answer) -> None:
        temporary.write_text(json.dumps(content), encoding="utf-8")
        temporary.replace(job["answer"])

    code = 1
    try:
        code = _run(job, answer)
    finally:
        os._exit(code)


def _run(job: FreshJob, answer: Callable[[Answer], None]) -> int:
    spec = TrialSpec.from_json(job["spec"])
    try:
        settings = WorkerSettings.from_json(job["settings"])
        require_origin("crashhunt", settings.code)
        seal(settings)
        conditions = HostConditions(settings)
        try:
            supervisor = Supervisor(settings, fork_zygote(settings), conditions)
            ended = supervisor.run(spec)
        except UnfitZygoteError:
            supervisor = Supervisor(settings, fork_zygote(settings, late=True), conditions)
            ended = supervisor.run(spec)
        answer({"result": ended.result.to_json()})  # which counts, whatever becomes of what follows
        found = with_escape(supervisor, settings, ended)
        if found is not ended.result:
            answer({"result": found.to_json()})
    except LostTrialError as error:
        answer({"lost": error.exit_code})
    except ImportKilledError as error:
        answer({"lost": error.exit_code, "importing": error.importing})
    except CrashhuntError as error:
        answer(error.to_json())
    return 0


def fork_zygote(settings: WorkerSettings, *, late: bool = False, rehearses: bool = False) -> socket.socket:
    """Fork a zygote that imports the modules that trials need; return a socket to it. The zygote ends with the socket.

    With ``late``, each trial imports its agents itself.

    Raises:
        ImportKilledError: the zygote was killed during its imports, by a signal that may come from outside.
        CrashhuntError: an import takes too long, or has ended the zygote.
    """
    ours, theirs = socket.socketpair()
    reports, reported = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    prepare(TrialResult)
    gc.freeze()
    parent, pid = os.getpid(), os.fork()
    if pid == 0:
        try:
            ours.close()
            reports.close()
            die_with(parent)
            _import_for_zygote(theirs, reported, settings, late=late, rehearses=rehearses)
        finally:
            os._exit(1)
    theirs.close()
    reported.close()
    with reports:
        await_imports(reports, pid, settings.timeout_s)
    return ours


def _import_for_zygote(
    control: socket.socket, reported: socket.socket, settings: WorkerSettings, *, late: bool, rehearses: bool
) -> None:
    def report(importing: str) -> None:
        with suppress(OSError):  # the parent listens until everything has been imported, and no longer
            reported.send(json.dumps(importing).encode())

    try:
        imported = import_nothing(settings) if late else import_parts(settings, report, rehearses=rehearses)
    except CrashhuntError as error:
        control.sendall(json.dumps(error.to_json()).encode() + b"\n")
        imported = None
    else:
        if imported is None:
            control.sendall(json.dumps({"unfit": True}).encode() + b"\n")
    report("")
    reported.close()
    if imported is not None:
        be_zygote(control, settings, imported)


def _not_started(number: int, log: Path, exit_code: int) -> WorkerError:
    """Return the error for a trial whose process ended before the trial began.

    The log is empty if the disk is full.
    """
    what = f"the process of trial {number} could not start"
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    if lines:
        return WorkerError(f"{what}: {lines[-1]}", fix="read its log", where=str(log))
    if shutil.disk_usage(log.parent).free < _FULL_BYTES:
        fix = "free some space there, or set TMPDIR to a folder on another disk"
        return WorkerError(f"{what}: the disk is full", fix=fix, where=str(log.parent))
    fix = "run the same command again"
    return WorkerError(f"{what}: it exited with {exit_code} without output", fix=fix, where=str(log.parent))
