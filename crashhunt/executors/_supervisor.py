"""The supervisor of a slot: it gives trials to a zygote, and determines their results.

A supervisor never runs foreign code.

The supervisor owns the socket to the hunt, the black box, the scratch folder of the trial and its result.
`_trial_report` checks the report and the recording that the process of a trial leaves.
"""

from __future__ import annotations

import json
import os
import select
import signal
import time
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, NoReturn

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, HostError, RecorderError, remedy
from crashhunt.base.processes import die_with, resume
from crashhunt.base.resources import limit_behind
from crashhunt.base.signals import is_sent_from_outside
from crashhunt.episode import internal_error, scratch_of
from crashhunt.executors._escape_search import with_escape
from crashhunt.executors._postmortem import EndedTrial, damaged, died, hung, read_ends
from crashhunt.executors._time_limits import START_UP_S, PauseMeter, has_hung
from crashhunt.executors._trial_attempts import LostTrialError
from crashhunt.executors._trial_folder import TrialFolder
from crashhunt.executors._trial_report import check_report
from crashhunt.trial import TrialResult, TrialSpec

if TYPE_CHECKING:
    import socket
    from collections.abc import Iterator
    from pathlib import Path

    from crashhunt.episode import WorkerSettings
    from crashhunt.executors._host_conditions import HostConditions
    from crashhunt.executors._protocol import Answer, Done, FromZygote, Job, KillTrial, Report
    from crashhunt.recording import BlackBoxFile


_LOOK_EVERY_S = 0.1  # whether a trial hangs
_CHUNK_BYTES = 1 << 16  # bytes at a time


class Supervisor:
    """Makes a zygote run one trial after another, each in a new process.

    Args:
        settings: settings of the hunt.
        zygote: connection to the zygote of this slot.
        conditions: the conditions under which trials can run, as they were before the first trial; None to skip the
            check of these conditions.
    """

    def __init__(
        self, settings: WorkerSettings, zygote: socket.socket, conditions: HostConditions | None = None
    ) -> None:
        self._settings = settings
        self._conditions = conditions
        self._zygote = zygote
        self._received = bytearray()
        self._zygote_pid = 0  # once it is ready
        self.retires = False  # whether the zygote may run no further trial
        self._folder = TrialFolder(settings.scratch, self._check_host)
        self._trials = 0

    def run(self, spec: TrialSpec) -> EndedTrial:
        """Run a trial, and return its result. The scratch folder of the trial remains if the trial is kept.

        Raises:
            LostTrialError: the process of the trial was killed from outside, or its zygote has ended.
            HostError: the trial failed, and a folder that it needs was deleted, or the disk is full.
            CrashhuntError: the disk is full, or the simulator cannot be created.
        """
        try:
            ended = self._run(spec)
        except (LostTrialError, CrashhuntError, OSError) as error:
            self._check_host(error)
            raise
        if ended.result.failure is not None:
            self._check_host()
        return ended

    def _check_host(self, cause: Exception | None = None) -> None:
        """Raise a `HostError` if trials can no longer run on this machine, so that their failures are no results."""
        try:
            if self._conditions is not None:
                self._conditions.check()
        except HostError as error:
            raise error from cause

    def _run(self, spec: TrialSpec) -> EndedTrial:
        self._await_zygote()
        box, folder = self._folder.prepare(spec.number)
        given_at = time.monotonic()
        self._trials += 1
        job: Job = {
            "spec": spec.to_json(),
            "folder": str(folder),
            "reserved": box.reserved,
            "wants_map": not (self._settings.scratch / layout.MAP).exists(),
            "tries_copy": self._trials == 1,
        }
        self._send(job)
        said, was_killed = self._wait(box, given_at)
        self.retires = self.retires or said.get("unfit", False)
        ended = self._judge(spec, box, said, was_killed=was_killed)
        notices = (*ended.notices, *said.get("notices", ()))
        wall_s = max(ended.result.wall_s, time.monotonic() - given_at)
        result = replace(ended.result, worker=os.getpid(), wall_s=wall_s)
        if result.kept:
            self._folder.release()
        return replace(ended, result=result, notices=notices)

    def _judge(self, spec: TrialSpec, box: BlackBoxFile, said: FromZygote, *, was_killed: bool) -> EndedTrial:
        """Determine the result of a trial whose process has ended."""
        scratch, code, pid = self._settings.scratch, said["ended"], said["pid"]
        is_there = self._folder.is_whole(scratch_of(scratch, spec.number))
        self._folder.restore(spec.number)
        header = box.header()
        report = box.read_report(header) if header is not None else b""
        is_whole = box.is_reusable()
        if was_killed and not (code == 0 and report):
            return EndedTrial(hung(spec, scratch, self._settings.timeout_s))
        if not is_whole:
            return EndedTrial(self._damaged(spec, "its recording was truncated", recorded=False))
        if header is None or header.trial != spec.number or not box.has(header):
            return EndedTrial(self._damaged(spec, "its recording was overwritten", recorded=False))
        if code == 0 and box.had_no_room:
            box.require_room()
            raise LostTrialError(-signal.SIGKILL)  # there is room again
        if not is_there and header.pid == os.getpid():  # another trial has deleted the folder before this one began
            raise LostTrialError(-signal.SIGKILL)
        if report is None:
            return EndedTrial(self._damaged(spec, "the process could not report the result, as it is damaged"))
        if code != 0 or not report:
            if is_sent_from_outside(code):
                raise LostTrialError(code)
            return EndedTrial(died(spec, scratch, code, self._modules()))
        found = check_report(report, spec=spec, header=header, records=box.read_records(header), pid=pid)
        if isinstance(found, str):
            return EndedTrial(self._damaged(spec, f"the process damaged its result: {found}"))
        return self._keep(*found)

    def _modules(self) -> dict[str, str]:
        """Return for each agent the modules that only this agent uses."""
        scenario = self._settings.scenario
        others = {*scenario.modules()}
        found = {name: setup.agent.partition(":")[0] for name, setup in scenario.agents.items() if ":" in setup.agent}
        return {name: module for name, module in found.items() if module not in others}

    def _damaged(self, spec: TrialSpec, message: str, *, recorded: bool = True) -> TrialResult:
        """Return the result of a trial that damaged its process or its recording, which only agents do."""
        agents = list(self._settings.scenario.agents)
        agent = agents[0] if len(agents) == 1 else ""
        return damaged(spec, self._settings.scratch, message, agent=agent, recorded=recorded)

    def _keep(self, result: TrialResult, report: Report) -> EndedTrial:
        """Write the files of a kept trial that the hunt expects."""
        settings, folder = self._settings, scratch_of(self._settings.scratch, result.spec.number)
        kept = settings.keeps(result)
        self._write_map(report.get("map"), folder if kept else None)
        failure = result.failure
        if kept:
            if failure is not None:
                failure = replace(failure, last_output=read_ends(folder / layout.RUN_LOG))
                if failure.traceback:
                    (folder / layout.ERROR_LOG).write_text(failure.traceback, encoding="utf-8", errors="replace")
            if (entered := report.get("entered")) is not None:
                (folder / layout.ENTERED).write_text(json.dumps(entered), encoding="utf-8")
            if (responses := report.get("responses")) is not None:
                (folder / layout.RESPONSES).write_text(json.dumps(responses), encoding="utf-8")
            if (lights := report.get("lights")) is not None:
                (folder / layout.LIGHTS).write_text(json.dumps(lights, separators=(",", ":")), encoding="utf-8")
        result = replace(result, kept=kept, failure=failure)
        return EndedTrial(result, tuple(map(str, report["notices"])), report.get("braking"))

    def _write_map(self, text: str | None, kept: Path | None) -> None:
        """Write the map once for all trials; if an argument changes the map, write it for each kept trial."""
        if text is None:
            return
        path = self._settings.scratch / layout.MAP
        try:
            # Another slot may write its map at this moment. It must not replace the map on which a kept trial relies.
            with path.open("x", encoding="utf-8") as file:
                file.write(text)
        except FileExistsError:
            if kept is not None and path.read_text(encoding="utf-8") != text:
                (kept / layout.MAP).write_text(text, encoding="utf-8")

    def _wait(self, box: BlackBoxFile, given_at: float) -> tuple[FromZygote, bool]:
        """Wait for the end of a trial's process, and kill it if it hangs; return whether it hung."""
        was_killed, pauses = False, PauseMeter()
        while True:
            message = self._next(_LOOK_EVERY_S)
            paused_s = pauses.paused_s()
            if message is not None and "ended" in message:
                return message, was_killed
            if message is None:
                resume(self._zygote_pid)  # which an agent may have stopped
            if not was_killed and self._has_hung(box, given_at, paused_s):
                was_killed = True
                self._send({"kill": True})

    def _has_hung(self, box: BlackBoxFile, given_at: float, paused_s: float = 0.0) -> bool:
        header = box.header()
        begun = header is not None and header.pid != os.getpid()
        limit_s = self._settings.timeout_s + paused_s
        has_words = lambda: self._folder.has_stack  # noqa: E731
        return has_hung(header, begun=begun, given_at=given_at, limit_s=limit_s, has_words=has_words)

    def _await_zygote(self) -> None:
        deadline, pauses = time.monotonic() + START_UP_S + self._settings.timeout_s, PauseMeter()
        while not self._zygote_pid:
            message = self._next(_LOOK_EVERY_S)
            if message is not None and "error" in message:
                raise CrashhuntError.from_json({"error": message["error"]})
            self._zygote_pid = message.get("ready", 0) if message is not None else 0
            if not self._zygote_pid and time.monotonic() > deadline + pauses.paused_s():
                raise CrashhuntError(
                    f"the simulator cannot be created: its start takes more than "
                    f"{START_UP_S + self._settings.timeout_s:g} s",
                    fix="find out why it waits, or raise --timeout",
                )

    def _send(self, message: Job | KillTrial) -> None:
        with suppress(OSError):  # it is gone, which the next message shows
            self._zygote.sendall(json.dumps(message).encode() + b"\n")

    def _next(self, timeout_s: float) -> FromZygote | None:
        """Return the next message of the zygote; None if no message has arrived.

        Raises:
            LostTrialError: the zygote has ended.
        """
        if b"\n" not in self._received:
            ready, _, _ = select.select([self._zygote], [], [], timeout_s)
            if not ready:
                return None
            try:
                data = self._zygote.recv(_CHUNK_BYTES)
            except OSError:
                data = b""
            if not data:
                self.retires = True
                raise LostTrialError(-signal.SIGKILL)
            self._received += data
            if b"\n" not in self._received:
                return None
        line, _, rest = bytes(self._received).partition(b"\n")
        self._received = bytearray(rest)
        message: FromZygote = json.loads(line)
        return message


def be_supervisor(
    pool: socket.socket, zygote: socket.socket, settings: WorkerSettings, conditions: HostConditions, parent: int
) -> NoReturn:
    """Run trials until the pool has no more trials; this function does not return.

    This process ends when its ``parent`` ends.
    """
    code = 1
    try:
        os.setsid()  # what a terminal or a batch system sends to everybody is for the hunt
        die_with(parent)
        supervisor = Supervisor(settings, zygote, conditions)
        with pool.makefile("rb") as specs:
            for line in specs:
                answer: Answer = {"lost": 0}
                for answer in _answers(supervisor, settings, TrialSpec.from_json(json.loads(line))):
                    pool.sendall(json.dumps(answer).encode() + b"\n")
                if supervisor.retires or "result" not in answer:
                    break
        code = 0
    finally:
        os._exit(code)


def _answers(supervisor: Supervisor, settings: WorkerSettings, spec: TrialSpec) -> Iterator[Answer]:
    """Run a trial, and yield what the pool receives; the last answer counts."""
    try:
        ended = supervisor.run(spec)
        result = ended.result
        if settings.find_escapes and result.collision is not None and not supervisor.retires:
            yield {"result": result.to_json(), "searches": True}  # whatever becomes of the search
            result = with_escape(supervisor, settings, ended)
        answer: Done = {"result": result.to_json(), "retires": supervisor.retires}
        if ended.notices:
            answer["notices"] = list(ended.notices)
        yield answer
    except LostTrialError as error:
        yield {"lost": error.exit_code}
    except CrashhuntError as error:
        yield error.to_json()
    except FileNotFoundError:  # another trial has removed the scratch folder meanwhile
        yield {"lost": -signal.SIGKILL}
    except OSError as error:
        limit, fix = limit_behind(error), remedy(error)
        said = RecorderError(
            f"the trial cannot be kept: {limit or error.strerror}", fix="" if limit else fix,
            where=str(error.filename or ""),
        )  # fmt: skip
        yield (said if limit or fix else internal_error(error, spec.number)).to_json()
