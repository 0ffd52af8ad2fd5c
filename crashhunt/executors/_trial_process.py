"""Runs one trial in its own process, which is a fork of a process that has run no trial."""

from __future__ import annotations

import io
import json
import logging
import os
import signal
import sys
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from crashhunt.base import layout
from crashhunt.base.agent_locators import is_native
from crashhunt.base.errors import CrashhuntError, HostError, RecorderError
from crashhunt.base.exceptions import INSTALLED_FOLDERS, is_users
from crashhunt.base.foreign_code import supports
from crashhunt.base.forks import copying, watchdog
from crashhunt.base.opened_files import OpenedFiles
from crashhunt.base.shared_memory import begin_records, end_records
from crashhunt.base.shared_state import SharedState
from crashhunt.base.signals import block_signals
from crashhunt.base.text import command_line
from crashhunt.episode import (
    BUDGET,
    BUDGET_BESIDE,
    Brancher,
    CompetentDriver,
    FirstCopy,
    HandedOver,
    LightRecorder,
    OnsetForcer,
    Parts,
    Prober,
    ReferenceCorrection,
    are_functions_replaced,
    has_users_code,
    internal_error,
    overruled_agent,
    ready_recorder,
    run_episode,
)
from crashhunt.executors._native_stack import record_native_stack, record_stack
from crashhunt.executors._protocol import FaultReport, Job, Report, encode_report
from crashhunt.recording import BlackBox
from crashhunt.simulators import (
    HasMap,
    HasObstacles,
    PreparesProcess,
    ReportsNotices,
    RestoresState,
    SupportsExclusion,
    SupportsFullBraking,
)
from crashhunt.snapshots import Snapshot, describe_unsaved
from crashhunt.trial import Outcome, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.agents import Agent
    from crashhunt.episode import ForkRunner, Reset, WorkerSettings
    from crashhunt.simulators import Simulator
    from crashhunt.trial import TrialResult, Value

EXCLUDED_WORDS = " are left out: "
"""Text of a notice between "probes" or "branches" and the reason why they are disabled."""
_EXCLUDED_FROM_HERE_WORDS = " are left out from here on: "

# Bound here, before any agent is imported that could replace them.
_dumps, _leave, _open, _dup2, _close = json.dumps, os._exit, os.open, os.dup2, os.close


class TrialProcess:
    """Runs one trial in a fork of the process that created this object.

    Creating this object redirects the standard output and the signals of the process.

    Args:
        settings: settings of the hunt.
        parts: the imported agents and simulator; None to import them in the process of each trial.
    """

    def __init__(self, settings: WorkerSettings, parts: Parts | None) -> None:
        self._settings = settings
        self._parts = parts
        self._simulator: Simulator | None = None
        self._box: BlackBox | None = None
        self._pid = 0
        self._has_begun = False
        self._shared: SharedState | None = None
        self._home = Path.cwd()
        self._notices: list[str] = []
        self._modules = frozenset(sys.modules)
        self._made_at = time.time()
        self._opened: OpenedFiles | None = None
        self._reference: ReferenceCorrection | CompetentDriver | None = None
        self._lights: LightRecorder | None = None
        self._fork_runners: tuple[ForkRunner, ...] = ()  # of copies of the trial
        # Line by line, so that what a dying process printed last is in the file.
        sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb", 0, closefd=False), "utf-8", "replace", write_through=True)
        sys.stderr = io.TextIOWrapper(os.fdopen(2, "wb", 0, closefd=False), "utf-8", "replace", write_through=True)
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(name)s: %(message)s")
        self._stack = Path(os.devnull).open("a", encoding="utf-8")  # noqa: SIM115 - open as long as the process
        os.register_at_fork(after_in_child=self._stop_recording)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole terminal; the hunt decides
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # ends a simulator that does not return to Python as well

    def make_simulator(self) -> Simulator:
        """Create the simulator and all other objects that the processes of trials share.

        Raises:
            CrashhuntError: the simulator cannot be created.
        """
        if self._parts is None:
            self._parts = Parts(self._settings)
            self._parts.load()
        if self._simulator is None:
            self._simulator = self._parts.simulator()
            if supports(self._simulator, RestoresState):
                self._simulator.tidy()
            if supports(self._simulator, PreparesProcess):
                self._simulator.ready_process()
                ready_recorder(self._simulator)
        return self._simulator

    def record_shared_state(self, control: int) -> str:
        """Record the files and memory of which each trial's process needs its own copy.

        Trials have no connection to the supervisor, which is ``control``.

        Returns:
            The resources that trials would share, as text; empty if there are none.
        """
        self._shared = SharedState(known={0, 1, 2, self._stack.fileno(), control})
        return self._shared.remaining

    def run(self, job: Job, reset: Reset | None = None) -> NoReturn:
        """Run a trial, write its report to the black box, and end this process.

        If the simulator has already been reset, ``reset`` replaces its `reset`.
        """
        code = 1
        try:
            code = self._run(job, reset)
        except BaseException as error:  # a fault of crashhunt, or something that this process needs is damaged
            for attempt in (1, 2, 3):  # an agent's signal handler may raise here too, whenever a function is called
                try:
                    block_signals()
                    if self._box is not None:
                        if attempt == 1 and (
                            self._is_mistake(error) or not (has_users_code(error) or are_functions_replaced())
                        ):
                            self._report_fault(error, job)
                        else:
                            self._box.announce_damage()
                    code = 0
                    break
                except BaseException:
                    continue
        finally:
            _leave(code)

    def _run(self, job: Job, reset: Reset | None) -> int:
        settings, folder = self._settings, job["folder"]  # a text: `Path` would copy 50 more pages of memory
        self._pid = os.getpid()
        begin_records()
        os.setsid()  # what a trial sends to its whole process group is for itself
        if self._shared is not None and reset is None:
            self._shared.separate()
        self._redirect(folder)
        spec = TrialSpec.from_json(job["spec"])
        if job["tries_copy"] and settings.code and settings.sealed is None:  # later trials pay nothing
            self._opened = OpenedFiles()
        self._box = box = BlackBox(f"{folder}/{layout.BLACK_BOX}", begun=job["reserved"])
        self._enter_home()
        began = time.monotonic()
        try:
            simulator = self.make_simulator()
            assert self._parts is not None
            self._has_begun = True
            # From here on the trial's time runs; imports that each trial makes itself do not count.
            box.begin(pid=self._pid, trial=spec.number, started=time.monotonic())
            # Writes down where every thread is, without needing the interpreter; then the supervisor ends the process.
            watchdog.arm(settings.timeout_s, self._stack)
            made = time.monotonic()
            copies = self._copies()
            first = [FirstCopy(self._cannot_copy)] if job["tries_copy"] and self._fork_runners else []
            if settings.find_escapes and spec.overruled is None:
                self._lights = LightRecorder()
            result = run_episode(
                spec,
                simulator=simulator,
                make_agent=partial(self._other_agent, spec) if spec.overruled or spec.handover else self._parts.agent,
                box=box,
                oracles=self._parts.oracles(),
                crash_on=settings.crash_on,
                observers=[self._lights] if self._lights is not None else [],
                reset=reset,
                asking=[*first, *copies],
            )
        except RecorderError:
            box.announce_no_room()
            return 0
        finally:
            if os.getpid() != self._pid:  # this is a fork that an agent made, and it has ended
                _leave(0)
        block_signals()  # whose handlers are those of agents, and the episode is over
        end_records()
        for runner in self._fork_runners:
            if runner.why_not:
                self._notices.append(f"{runner.what}{_EXCLUDED_FROM_HERE_WORDS}{runner.why_not}")
        wall_s, setup_s = time.monotonic() - began, made - began + result.setup_s
        report = self._report(replace(result, wall_s=wall_s, setup_s=setup_s), simulator, job)
        box.report(encode_report(report, dumps=_dumps))
        return 0

    def _enter_home(self) -> None:
        """Enter the folder in which the process was after its imports; an import may have changed it."""
        try:
            os.chdir(self._home)
        except OSError as error:
            raise HostError(
                f"the folder in which trials run cannot be entered: {error.strerror}",
                fix="restore it, and run the same command again",
                where=str(self._home),
            ) from error

    def _is_mistake(self, error: BaseException) -> bool:
        """Return whether an error is a mistake in the scenario, which appears before the trial begins."""
        return not self._has_begun and issubclass(type(error), CrashhuntError)

    def _report_fault(self, error: BaseException, job: Job) -> None:
        """Report that crashhunt itself failed, which ends the hunt."""
        assert self._box is not None
        number = job["spec"]["number"]
        said: CrashhuntError = internal_error(error, number)
        if self._is_mistake(error) and isinstance(error, CrashhuntError):
            said = error
        fault: FaultReport = {"fault": said.to_json()}
        if not self._has_begun:
            self._box.begin(pid=self._pid, trial=number, started=time.monotonic())
        self._box.report(encode_report(fault, dumps=_dumps))

    def _redirect(self, folder: str) -> None:
        """Redirect the output, and the stack of a dying process, into the folder of the trial."""
        output = _open(f"{folder}/{layout.RUN_LOG}", os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        _dup2(output, 1)
        _dup2(output, 2)
        _close(output)
        stack = _open(f"{folder}/{layout.STACK}", os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        _dup2(stack, self._stack.fileno(), inheritable=False)
        _close(stack)
        record_stack(self._stack)
        if any(is_native(setup.agent) for setup in self._settings.scenario.agents.values()):
            record_native_stack(self._stack.fileno())

    def _report(self, result: TrialResult, simulator: Simulator, job: Job) -> Report:
        settings = self._settings
        data: dict[str, object] = {**result.to_json()}
        del data["spec"]  # which the supervisor knows
        report: Report = {"result": data, "notices": self._notices}
        report["notices"] += simulator.notices if supports(simulator, ReportsNotices) else ()
        for agent in self._parts.reporting_agents if self._parts is not None else ():
            report["notices"] += agent.notices
        report["notices"] += notices_of_late_imports(self._modules, settings.code)
        if self._opened is not None:
            with suppress(Exception):  # the code of a trial may have replaced any function
                snapshot = Snapshot(Path(settings.code[0]).parent)
                scratch = f"{settings.scratch.resolve()}{os.sep}"  # with what was extracted from files of the snapshot
                opened = [path for path in self._opened.paths() if not path.startswith(scratch)]
                report["notices"] += describe_unsaved(opened, snapshot, since=self._made_at)
        kept = settings.keeps(result)
        wants_map = (kept or job["wants_map"]) and result.outcome is not Outcome.INVALID
        if wants_map and supports(simulator, HasMap):
            obstacles = simulator.obstacles() if supports(simulator, HasObstacles) else ()
            report["map"] = _dumps([[one.id, one.width, one.shape] for one in (*simulator.lanes(), *obstacles)])
        if kept and result.spec.only is not None and supports(simulator, SupportsExclusion):
            report["entered"] = list(simulator.entered)
        if kept and self._reference is not None:
            report["responses"] = self._reference.responses
        if settings.find_escapes and result.collision is not None and supports(simulator, SupportsFullBraking):
            braking = simulator.full_braking(result.collision.agent)
            said: dict[str, object] | None = None
            if braking is not None:
                said = {"how": braking.how, "deceleration": braking.deceleration}
            report["braking"] = said
        if kept and self._lights is not None and (lights := self._lights.data()) is not None:
            report["lights"] = lights
        return report

    def _copies(self) -> list[Prober | Brancher | OnsetForcer]:
        settings = self._settings
        found: list[Prober | Brancher | OnsetForcer] = []
        tell = self._notices.append
        if settings.probe_s:
            budget = BUDGET_BESIDE if settings.branch else BUDGET
            refused = {name: setup.refused_disturbances for name, setup in settings.scenario.agents.items()}
            found.append(Prober(settings.probe_s, settings.crash_on, self._delay, budget, tell, refused))
        if settings.branch:
            found.append(Brancher(settings.branch, settings.crash_on, self._delay, tell))
        if settings.force:
            found.append(OnsetForcer(settings.force, settings.crash_on, settings.timeout_s, self._delay, tell))
        self._fork_runners = tuple(each.fork_runner for each in found)
        return found

    def _cannot_copy(self, why_not: str) -> None:
        for runner in self._fork_runners:
            runner.stop(why_not)
            self._notices.append(f"{runner.what}{EXCLUDED_WORDS}{why_not}")
        self._fork_runners = ()

    def _delay(self, wall_s: float) -> None:
        """Add the time spent in forks to the trial's time limit."""
        assert self._box is not None
        self._box.delay(wall_s)
        watchdog.extend(wall_s)

    def _stop_recording(self) -> None:
        """Prevent a fork that an agent makes from writing into the recording."""
        if self._box is not None and not copying():
            self._box.detach()

    def _other_agent(self, spec: TrialSpec, agent: str, simulator: Simulator, arguments: Mapping[str, Value]) -> Agent:
        assert self._parts is not None
        made = self._parts.agent(agent, simulator, arguments)
        if spec.handover is not None and spec.handover.agent == agent:
            made = HandedOver(made, spec.handover)
        if spec.overruled is not None and spec.overruled.agent == agent:
            made = overruled_agent(made, simulator, spec.overruled)
            self._reference = made if isinstance(made, ReferenceCorrection | CompetentDriver) else None
        return made


def _late_modules(before: frozenset[str]) -> list[str]:
    """Return the names of modules that have been imported since then.

    New modules come last. To look at the names of all modules would copy 250 pages of memory in each trial. An earlier
    module may come last as well, if the agent has removed it and imported it again.
    """
    found: list[str] = []
    more = len(sys.modules) - len(before)
    for name in reversed(sys.modules):
        if name not in before:
            found.append(name)
        elif len(found) >= more:
            break
    return found


def notices_of_late_imports(before: frozenset[str], code: Sequence[str]) -> list[str]:
    """Return a notice for each module that a trial has imported from a user's folder and not from the snapshot.

    A snapshot contains the modules that are imported with an agent. If an agent imports a module only while it drives,
    a replay would run today's code of this module. Without a snapshot, there are no notices.
    """
    found = []
    with suppress(Exception):  # the code of a trial may have put anything into `sys.modules`
        for name in sorted(_late_modules(before)) if code else ():
            file = getattr(sys.modules[name], "__file__", None)
            if "." in name or not isinstance(file, str) or not is_users(file):
                continue
            path = Path(file).resolve()
            if INSTALLED_FOLDERS.isdisjoint(path.parts) and not any(path.is_relative_to(folder) for folder in code):
                folder = path.parent.parent if path.stem == "__init__" else path.parent
                found.append(
                    f"the module {name!r} is not in the snapshot, because it is imported only during a trial: replays "
                    f"run its code of today; add {command_line('--snapshot-root', folder)}"
                )
    return found
