"""What runs in a worker: one simulator, kept warm, and trial after trial; what they print is caught and cut here."""

from __future__ import annotations

import faulthandler
import gc
import io
import json
import logging
import os
import shutil
import signal
import sys
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import DISK, RecorderError
from crashhunt.base.faculties import offers
from crashhunt.base.files import whole_file
from crashhunt.base.forks import copying, watchdog
from crashhunt.base.processes import adopt_orphans, end_descendants
from crashhunt.episode import (
    BUDGET,
    BUDGET_BESIDE,
    Brancher,
    FirstCopy,
    Parts,
    Prober,
    WorkerSettings,
    generators,
    overruled_agent,
    run_episode,
    scratch_of,
    set_generators,
)
from crashhunt.executors._baseline import Baseline
from crashhunt.executors._warm import WarmCopies
from crashhunt.recording import BlackBox
from crashhunt.simulators import BrakesFully, CountsSetUp, HasMap, LeavesOut, TellsNotices, Tidies
from crashhunt.trial import Outcome
from crashhunt.world import Lane

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from crashhunt.agents import Agent
    from crashhunt.episode import Reset
    from crashhunt.simulators import FullBraking, Info, Observations, Options, Simulator
    from crashhunt.trial import Overruled, TrialResult, TrialSpec, Value

__all__ = ["LEFT_OUT", "Worker", "loaded", "read_map", "read_tail"]

LEFT_OUT = " are left out: "
"""Stands in a notice between what there has never been any of, probes or branches, and why."""
_FROM_HERE_ON = " are left out from here on: "
_TAIL = 4000  # bytes


class Worker:
    """Runs the trials of one hunt in this process, and takes the process over: its output, its signals.

    Args:
        settings: of the hunt.
        parts: what has been imported already.
        warm_copies: for how many traffics it keeps a copy of itself asleep.

    Attributes:
        change: what the last trial has changed in this process, in words. Where there is something, the next trial
            belongs into another process.
        used: whether an agent has run here.
    """

    def __init__(self, settings: WorkerSettings, parts: Parts | None = None, *, warm_copies: int = 0) -> None:
        self.change = ""
        self._noticed: set[str] = set()
        self._without: set[str] = set()  # probes or branches
        self.used = False
        self._pid = os.getpid()
        self._is_copy = False
        budget = BUDGET_BESIDE if settings.branch else BUDGET
        self._prober = Prober(settings.probe_s, settings.crash_on, self._delay, budget) if settings.probe_s else None
        about = settings.branch, settings.crash_on, self._delay, self._notice
        self._brancher = Brancher(*about) if settings.branch else None
        self._first_copy = FirstCopy(self._no_copies) if settings.probe_s or settings.branch else None
        self._settings = settings
        self._simulator: Simulator | None = None
        self._box: BlackBox | None = None
        self._folder: Path | None = None
        self._lanes: Sequence[Lane] | None = None  # of the map that all workers share
        self._fresh = 0
        self._warm = WarmCopies(warm_copies, self._notice) if warm_copies else None
        self._home = Path.cwd()
        adopt_orphans()
        # Ctrl-C reaches the whole terminal; the hunt decides what becomes of its workers. A request to end must work
        # even while the simulator does not return to Python.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        # Line by line, so that what a dying process printed last is in the file.
        sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb", 0, closefd=False), "utf-8", "replace", write_through=True)
        sys.stderr = io.TextIOWrapper(os.fdopen(2, "wb", 0, closefd=False), "utf-8", "replace", write_through=True)
        os.register_at_fork(after_in_child=self._stand_aside)
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(name)s: %(message)s")
        self._parts = parts if parts is not None else loaded(settings)
        self._baseline: Baseline | None = None
        gc.freeze()  # what is loaded by now is never garbage

    def run(self, spec: TrialSpec) -> TrialResult:
        """Run a trial, and end every process that it has started. Its scratch folder stays where it is ``kept``.

        Raises:
            CrashhuntError: the disk is full, or the simulator cannot be made at all.
        """
        os.chdir(self._home)  # from wherever the last agent has gone
        box, folder = self._prepare(spec)
        if self._warm is not None:
            self.used = True
            known = self._warm.run(spec, box.reserved)
            if known is not None:
                self.change = "which processes run" if self._end_strangers() else ""
                self._folder = None if known.kept else self._folder
                return known
        return self._carry_out(spec, box, folder)

    def _carry_out(self, spec: TrialSpec, box: BlackBox, folder: Path, reset: Reset | None = None) -> TrialResult:
        """Run a trial in this process.

        Args:
            spec: the trial.
            box: which records it.
            folder: of its own.
            reset: what resets the simulator, where it has been reset already.
        """
        # Writes down where every thread is, without needing the interpreter; then it is the hunt's turn to act. It
        # counts, as the hunt does, from here on, with what the first trial of a worker has to make.
        watchdog.arm(self._settings.timeout_s, self._stack)
        began = time.monotonic()
        simulator = self._simulator
        if simulator is None:
            simulator = self._simulator = self._parts.simulator()
        if self._baseline is None:
            _tidy(simulator)
            scenario = self._settings.scenario
            files = [scenario.folder / name for name in scenario.files()]
            watched = scenario.backend.watched
            self._baseline = Baseline(self._settings.code, self._settings.scratch, files, watched)
        if reset is None:
            self._baseline.begin()
            reset = self._reset_of(spec, simulator)
        self.used = True
        made = time.monotonic()
        try:
            result = run_episode(
                spec,
                simulator=simulator,
                make_agent=self._parts.agent if spec.overruled is None else partial(self._overruled, spec.overruled),
                box=box,
                oracles=self._parts.oracles(),
                crash_on=self._settings.crash_on,
                reset=reset,
                prober=self._prober,
                brancher=self._brancher,
                first_copy=self._first_copy,
            )
        finally:
            if os.getpid() != self._pid:  # an agent has forked, and this is the copy, which has come to the end
                os._exit(0)
        with _undisturbed(self):
            watchdog.cancel()
            self.change = self._changed(simulator)
            self._tell(simulator)
            self._tell_why_not(_FROM_HERE_ON)
            result = self._kept(result, simulator, folder)
        wall_s, setup_s = time.monotonic() - began, made - began + result.setup_s
        return replace(result, worker=os.getpid(), wall_s=wall_s, setup_s=setup_s)

    def _reset_of(self, spec: TrialSpec, simulator: Simulator) -> Reset | None:
        """What resets the simulator, and leaves a copy of this process asleep there for further trials."""
        warm = self._warm
        if warm is None:
            return None

        def reset(*, seed: int, options: Options) -> tuple[Observations, Info]:
            began = time.monotonic()
            begun = simulator.reset(seed=seed, options=options)
            took_s = time.monotonic() - began
            drawn = generators()

            def again(**_given: object) -> tuple[Observations, Info]:
                set_generators(drawn)
                if offers(simulator, CountsSetUp):
                    simulator.setup_steps = 0  # they are the first trial's
                return begun

            warm.keep(spec, partial(self._go_on, again), took_s=took_s)
            assert self._baseline is not None
            self._baseline.begin()  # the files by which it talks to the copy
            return begun

        return reset

    def _go_on(self, reset: Reset, spec: TrialSpec, reserved: int) -> TrialResult:
        """Run a trial in a copy of this process, whose simulator has been reset; it runs no other."""
        self._pid = os.getpid()
        self._warm, self._is_copy = None, True
        folder = scratch_of(self._settings.scratch, spec.number)
        self._box = BlackBox(folder / layout.BLACK_BOX, begun=reserved)
        self._write_into(folder)
        self._folder = folder
        result = self._carry_out(spec, self._box, folder, reset)
        with Path(os.devnull).open("wb") as nothing:  # what threads still print is not of the next trial
            os.dup2(nothing.fileno(), 1)
            os.dup2(nothing.fileno(), 2)
        return result

    def _tell(self, simulator: Simulator) -> None:
        """Write down what the simulator wants people to know, for the hunt to tell them once."""
        for notice in simulator.notices if offers(simulator, TellsNotices) else ():
            self._notice(notice)

    def _no_copies(self, why_not: str) -> None:
        """Do without copies from the first step on; the hunt is told at once."""
        if self._prober is not None:
            self._prober.why_not = why_not
        if self._brancher is not None:
            self._brancher.why_not = why_not
        self._tell_why_not(LEFT_OUT)

    def _tell_why_not(self, how: str) -> None:
        for asks, what in ((self._prober, "probes"), (self._brancher, "branches")):
            if asks is not None and asks.why_not and what not in self._without:
                self._without.add(what)
                self._notice(f"{what}{how}{asks.why_not}")

    def _notice(self, notice: str) -> None:
        if notice not in self._noticed:
            self._noticed.add(notice)
            with (self._settings.scratch / layout.NOTICES).open("a", encoding="utf-8") as file:
                file.write(f"{notice}\n")

    def _delay(self, wall_s: float) -> None:
        """Count the time of copies as not the trial's own."""
        assert self._box is not None
        self._box.delay(wall_s)
        watchdog.extend(wall_s)

    def _stand_aside(self) -> None:
        """Keep the copy of this process that an agent forks from writing into the recording."""
        if self._box is not None and not copying():
            self._box.detach()

    def _kept(self, result: TrialResult, simulator: Simulator, folder: Path) -> TrialResult:
        """Keep what a trial has left behind, where somebody wants it."""
        settings = self._settings
        kept = settings.keep_trials or result.outcome in settings.crash_on or result.failure is not None
        kept = kept or settings.is_audited(result)
        if result.outcome is not Outcome.INVALID:
            self._draw_map(simulator, folder if kept else None)
        failure = result.failure and replace(result.failure, last_output=read_tail(folder / layout.RUN_LOG))
        if kept:
            # The next trial gets a folder of its own; this one now belongs to the hunt.
            self._folder = None
            if result.spec.only is not None and offers(simulator, LeavesOut):
                (folder / layout.ENTERED).write_text(json.dumps(list(simulator.entered)), encoding="utf-8")
            if result.failure is not None and result.failure.traceback:
                (folder / layout.ERROR_LOG).write_text(result.failure.traceback, encoding="utf-8", errors="replace")
        return replace(result, kept=kept, failure=failure)

    def _changed(self, simulator: Simulator) -> str:
        """End what the trial has started; return what else is not as before it."""
        assert self._baseline is not None
        if self._end_strangers() and not self._is_copy:
            return "which processes run"
        if self._is_copy:
            return ""  # nobody comes after it
        if not os.path.samestat(os.fstat(1), self._output) or not os.path.samestat(os.fstat(2), self._output):
            return "standard output"
        _tidy(simulator)
        return self._baseline.change()

    def _end_strangers(self) -> bool:
        """End what a trial has started; return whether there was anything."""
        ours = self._warm.processes if self._warm is not None else frozenset()
        return end_descendants(ours | (self._baseline.children if self._baseline is not None else frozenset()))

    def full_braking(self, agent: str) -> FullBraking | None:
        """Return how a vehicle of the last trial brakes as hard as it can, where its simulator says."""
        return self._simulator.full_braking(agent) if offers(self._simulator, BrakesFully) else None

    def _overruled(
        self, overruled: Overruled, agent: str, simulator: Simulator, arguments: Mapping[str, Value]
    ) -> Agent:
        made = self._parts.agent(agent, simulator, arguments)
        return overruled_agent(made, simulator, overruled) if agent == overruled.agent else made

    def _draw_map(self, simulator: Simulator, kept: Path | None) -> None:
        """Write the map down, once for all workers; for a trial that is kept, where an argument has made it another."""
        path = self._settings.scratch / layout.MAP
        if not offers(simulator, HasMap) or (path.exists() and kept is None):
            return
        lanes = simulator.lanes()
        if lanes is self._lanes:  # of a simulator whose map is always the same
            return
        text = json.dumps([[lane.id, lane.width, lane.shape] for lane in lanes])
        if not path.exists():
            with whole_file(path, lasting=False, noted=False) as temporary:
                temporary.write_text(text, encoding="utf-8")
        elif kept is not None and path.read_text(encoding="utf-8") != text:
            (kept / layout.MAP).write_text(text, encoding="utf-8")
            return
        self._lanes = lanes

    def _prepare(self, spec: TrialSpec) -> tuple[BlackBox, Path]:
        """Give the trial its scratch folder: that of the last one, whose pages are warm, or a new one."""
        folder = scratch_of(self._settings.scratch, spec.number)
        if folder.exists():
            shutil.rmtree(folder)  # of an earlier attempt at the same trial
        if self._folder is None:
            self._fresh += 1
            made = self._settings.scratch / f"new-{os.getpid()}-{self._fresh}"
            made.mkdir()
            if self._box is not None:
                self._box.close()
            self._box = BlackBox(made / layout.BLACK_BOX)
            self._write_into(made)
            self._folder = made
        assert self._box is not None
        self._box.begin(pid=os.getpid(), trial=spec.number, started=time.monotonic())
        os.ftruncate(1, 0)
        os.ftruncate(self._stack.fileno(), 0)
        os.rename(self._folder, folder)  # noqa: PTH104 - Path.rename builds a path for nothing
        self._folder = folder
        return self._box, folder

    def _write_into(self, folder: Path) -> None:
        """Have what is printed, and where this process is when it dies, written down there."""
        output = os.open(folder / layout.RUN_LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.close(output)
        self._output = os.fstat(1)
        self._stack = (folder / layout.STACK).open("a")
        faulthandler.enable(self._stack)
        faulthandler.register(signal.SIGUSR1, self._stack)


def read_map(scratch: Path, trial: Path) -> list[Lane]:
    """Return the map of a trial that is kept, or that of its hunt; nothing where none has been written down."""
    for folder in (trial, scratch):
        with suppress(OSError, ValueError):
            data = json.loads((folder / layout.MAP).read_text(encoding="utf-8"))
            return [Lane(name, width, tuple(map(tuple, shape))) for name, width, shape in data]
    return []


def read_tail(path: Path) -> str:
    """Return the last few thousand characters of a file; nothing where there is none."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - _TAIL))
            return file.read().decode("utf-8", "replace")
    except OSError:
        return ""


def loaded(settings: WorkerSettings) -> Parts:
    """Import everything that trials need.

    Raises:
        CrashhuntError: something cannot be imported.
    """
    parts = Parts(settings)
    parts.load()
    return parts


def _tidy(simulator: Simulator) -> None:
    """Have a simulator undo what its episodes change beyond itself, where it can."""
    if offers(simulator, Tidies):
        simulator.tidy()


@contextmanager
def _undisturbed(worker: Worker) -> Iterator[None]:
    """Finish a trial in whatever state it has left the process in; a result is not lost for what comes after it."""
    try:
        yield
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in DISK:
            raise RecorderError(
                f"the trial cannot be kept: {error.strerror}",
                fix="free some space and run the same command again",
                where=str(error.filename or ""),
            ) from error
        worker.change = f"what Python itself needs ({type(error).__name__})"
