"""Trials that run again: which specifications, with which code, where, within which limits, and what each run left.

Every analysis that runs a recorded trial again uses this module. The parts of a rerun are:

- **What**: specifications of trials (`TrialSpec`). A change of a trial is a changed specification. A change that begins
  at a step (`overruled`, `disturbances`, `handover`, `reseeding`) leaves the steps before as recorded. They are
  simulated again. The caller chooses which specifications run next.
- **Where** (`Where`): ``current`` forks processes that have imported the current crashhunt. ``snapshot`` does the same
  with the crashhunt of a snapshot, in a new Python process. `SharedReruns` serves several threads.
- **Limits**: `Budget` decides about a stop of the user and the wall time. The caller limits the number of runs,
  because only the caller knows which of the runs count.
- **Comparison**: an `EndedRun` has the outcome, the recording and the files of a run. Bit-identical runs have the same
  digest (`TrialResult.is_identical_run`), and `first_divergence` finds where two recordings differ. A crash type
  (`signature_of`) belongs to a bundle, which `write_bundle` writes from the folder of the run.

Invariant: a run is identified by the index of its specification. The order in which runs end, and the number of runs at
a time, change no result. If the caller stops the iteration, the unfinished runs are cancelled.

Cost: with the current crashhunt, each run is a fork of a process that has imported the agents. If the traffic stays the
same, a run is a fork of a simulator that has already been set up. A new Python process takes 0.3 s to start.
"""

from __future__ import annotations

import itertools
import json
import shutil
import threading
import time
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.base.temporary import TemporaryFolder
from crashhunt.episode import scratch_of
from crashhunt.executors import PoolExecutor, read_map
from crashhunt.recording import Recording, read_black_box

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.episode import WorkerSettings
    from crashhunt.trial import TrialResult, TrialSpec
    from crashhunt.world import Lane

T = TypeVar("T")
R = TypeVar("R")

Where = Literal["current", "snapshot"]
"""The processes that run trials again; see the text of this module."""

_STOP_CHECK_INTERVAL_S = 0.1  # how late a request to stop may be


class StoppedError(Exception):
    """The user has stopped the runs."""


class OutOfTimeError(StoppedError):
    """The wall-time limit of the runs has been reached."""


class NotUnderstoodError(CrashhuntError):
    """The crashhunt in a snapshot ignored a part of a specification, and therefore ran another trial."""


class Budget:
    """Decides whether runs must stop, and keeps the reason.

    Args:
        stopped: function that returns whether the user requests a stop; called repeatedly.
        time_s: wall-time limit from now on, in s; None for no limit.
    """

    def __init__(self, stopped: Callable[[], bool], time_s: float | None = None) -> None:
        self.why = ""  # the reason for the stop, as the user reads it; empty while the runs may continue
        self._stopped = stopped
        self._until = None if time_s is None else time.monotonic() + time_s

    def require(self) -> bool:
        """Return False if the runs may continue; so this function can serve as ``stopped`` of `Reruns`.

        Raises:
            OutOfTimeError: the time limit has been reached.
            StoppedError: the user requests a stop.
        """
        if self._stopped():
            self.why = "stopped"
            raise StoppedError
        if self._until is not None and time.monotonic() >= self._until:
            self.why = "the time is over"
            raise OutOfTimeError
        return False


@dataclass(frozen=True, slots=True)
class EndedRun:
    """A run that has ended, with its recording."""

    place: int  # index of the run's specification among the specifications of the call
    result: TrialResult
    # recording of the trial; None if it was not requested, or if the process died before it could record
    recording: Recording | None
    folder: Path  # folder with the files of the trial; it exists until the next run is requested
    entered: tuple[str, ...] = ()  # ids of all actors that entered, if the specification requested them (`EVERYBODY`)
    # responses of the reference driver, if the specification has one; None if the trial reported none
    responses: tuple[JsonObject, ...] | None = None
    # contents of `layout.LIGHTS`; empty if the run was not to read the lights, or its simulator has none
    lights: bytes = b""

    @property
    def lanes(self) -> list[Lane]:
        """The lanes of the run's map, as `write_bundle` needs them; empty without a map."""
        return read_map(self.folder.parent, self.folder)


class Reruns:
    """Runs trials again, several at a time.

    Args:
        worker: settings of the trials. The files of the runs are in ``worker.scratch``, or in a temporary folder if
            this path is empty.
        where: the processes that run the trials.
        parallel: number of trials at a time.
        stopped: function called before each wait for results; it returns whether to stop, or raises an exception.
        numbered: whether the runs get numbers, and thus folders, of their own: the specifications may then repeat a
            number. Otherwise the numbers of the specifications of a call must be different and ascending.
        shared: whether several threads run trials. Then a run that is no longer awaited is not cancelled, because the
            other runs would be cancelled as well.
    """

    def __init__(
        self,
        worker: WorkerSettings,
        where: Where,
        *,
        parallel: int = 1,
        stopped: Callable[[], bool] = lambda: False,
        numbered: bool = False,
        shared: bool = False,
    ) -> None:
        self._folder = TemporaryFolder("rerun") if worker.scratch == Path() else None
        if self._folder is not None:
            worker = replace(worker, scratch=self._folder.path)
        self._worker, self._stopped, self._shared = worker, stopped, shared
        self._executor = PoolExecutor(worker, parallel=parallel, snapshot=where == "snapshot")
        self._numbers = itertools.count(1) if numbered else None
        self._lock = threading.Lock()
        self._ended: dict[int, TrialResult] = {}
        self._error: Exception | None = None

    def run(
        self,
        specs: Sequence[TrialSpec],
        *,
        recorded: bool = True,
        needed: Callable[[int], bool] = lambda _: True,
        stopped: Callable[[], bool] | None = None,
    ) -> Iterator[EndedRun]:
        """Yield trials as they end; if the caller stops the iteration, the unfinished trials are cancelled.

        Args:
            specs: specifications of the trials.
            recorded: whether their recordings are needed.
            needed: function that returns whether the trial at an index is still needed, called after each result. If a
                trial is not needed, the trials after it are not needed either.
            stopped: function to call instead of that of the constructor.

        Raises:
            StoppedError: the user has stopped the runs.
            NotUnderstoodError: the crashhunt that runs the trials does not know a part of a specification.
            CrashhuntError: the trials could not be run.
        """
        stopped = stopped or self._stopped
        places = self._submit(specs)
        try:
            while places:
                if stopped():
                    raise StoppedError
                for result in self._received(places):
                    number = result.spec.number
                    if number not in places:
                        continue  # no longer needed
                    place = places.pop(number)
                    folder = scratch_of(self._worker.scratch, number)
                    try:
                        yield self._ended_run(place, specs[place], result, folder, recorded=recorded)
                    finally:
                        if self._worker.keep_trials or result.kept:  # otherwise the worker removes its folder
                            shutil.rmtree(folder, ignore_errors=True)
                    needless = min((number for number, other in places.items() if not needed(other)), default=None)
                    if needless is not None:
                        self._executor.cancel(above=needless - 1)
                        places = {number: other for number, other in places.items() if number < needless}
        finally:
            if places and not self._shared:
                self._executor.cancel()

    def close(self) -> None:
        """End all processes, and remove the temporary folder."""
        self._executor.close()
        if self._folder is not None:
            self._folder.remove()

    def _submit(self, specs: Sequence[TrialSpec]) -> dict[int, int]:
        """Submit trials; return the index of each trial by its number."""
        with self._lock:
            numbers = [spec.number for spec in specs] if self._numbers is None else [*islice(self._numbers, len(specs))]
            if self._error is None:
                for number, spec in zip(numbers, specs, strict=True):
                    self._executor.submit(replace(spec, number=number))
        return {number: place for place, number in enumerate(numbers)}

    def _received(self, places: Mapping[int, int]) -> list[TrialResult]:
        """Return the results of some trials that have ended, or wait for results of any trials.

        An executor that can run no trial reports this error only once. The error is stored for all threads, which would
        otherwise wait forever.
        """
        with self._lock:
            if not self._ended.keys() & places.keys():
                if self._error is not None:
                    raise self._error
                try:
                    for result in self._executor.completed(_STOP_CHECK_INTERVAL_S):
                        self._ended[result.spec.number] = result
                except Exception as error:
                    self._error = error if self._shared else None
                    raise
            found = [self._ended.pop(number) for number in [*self._ended] if number in places]
            if not self._shared:
                self._ended.clear()  # of cancelled trials
        return found

    def _ended_run(
        self, place: int, asked: TrialSpec, result: TrialResult, folder: Path, *, recorded: bool
    ) -> EndedRun:
        _require_same_trial(asked, result.spec)
        recording = None
        if recorded:
            with suppress(BundleError):  # its process died
                recording = Recording(read_black_box(folder / layout.BLACK_BOX))
        entered: list[str] = []
        if result.spec.only is not None:
            with suppress(OSError, ValueError):
                entered = json.loads((folder / layout.ENTERED).read_text(encoding="utf-8"))
        responses = None
        if result.spec.overruled is not None and result.spec.overruled.reference:
            with suppress(OSError, ValueError):
                responses = tuple(json.loads((folder / layout.RESPONSES).read_text(encoding="utf-8")))
        lights = b""
        with suppress(OSError):
            lights = (folder / layout.LIGHTS).read_bytes()
        return EndedRun(
            place=place,
            result=replace(result, spec=replace(result.spec, number=asked.number)),
            recording=recording,
            folder=folder,
            entered=tuple(entered),
            responses=responses,
            lights=lights,
        )


def _require_same_trial(asked: TrialSpec, run: TrialSpec) -> None:
    """Check that the specification of a trial came back unchanged, because an earlier crashhunt ignores unknown keys.

    Raises:
        NotUnderstoodError: a part of the specification was ignored.
    """
    named = attrgetter("overruled", "disturbances", "only", "handover", "reseeding", "digest_of_changes")
    if named(asked) != named(run):
        raise NotUnderstoodError("the snapshot contains a version of crashhunt that is too old for this command")


def run_alone(
    worker: WorkerSettings, spec: TrialSpec, stopped: Callable[[], bool] = lambda: False
) -> Iterator[EndedRun]:
    """Yield one run in a new Python process; its files exist until the iteration continues.

    Raises:
        StoppedError: the user has stopped the run.
        CrashhuntError: the trial could not be run.
    """
    with closing(Reruns(worker, "snapshot", stopped=stopped)) as runs:
        yield from runs.run([spec])


class SharedReruns:
    """Reruns for several threads, each of which waits for its own trial; trials with equal settings share processes."""

    def __init__(self, scratch: Path, *, parallel: int) -> None:
        self._scratch, self._parallel = scratch, parallel
        self._lock = threading.Lock()
        self._runs: dict[str, Reruns] = {}

    def run(self, worker: WorkerSettings, spec: TrialSpec, stopped: Callable[[], bool] = lambda: False) -> EndedRun:
        """Run one trial with the crashhunt of its snapshot, and wait for its end.

        Raises:
            StoppedError: the user has stopped the run.
            CrashhuntError: the trial could not be run.
        """
        key = json.dumps(replace(worker, scratch=self._scratch).to_json(), sort_keys=True)
        with self._lock:
            if key not in self._runs:
                worker = replace(worker, scratch=self._scratch / f"shared-{len(self._runs)}")
                worker.scratch.mkdir(parents=True)
                self._runs[key] = Reruns(worker, "snapshot", parallel=self._parallel, numbered=True, shared=True)
            runs = self._runs[key]
        (ended,) = runs.run([spec], stopped=stopped)
        return ended

    def close(self) -> None:
        """End all processes."""
        for runs in self._runs.values():
            runs.close()


def call_in_threads(
    function: Callable[[T], R],
    items: Sequence[T],
    parallel: int,
    *,
    ended: Callable[[R], None] = lambda _: None,
    tick: Callable[[], None] = lambda: None,
    over: threading.Event | None = None,
) -> list[R]:
    """Call a function for each item in threads that wait for processes; return the results in item order.

    Args:
        function: function to call in a thread.
        items: arguments of the calls, one for each call.
        parallel: number of threads.
        ended: function called with each result, in the thread of the caller.
        tick: function called about ten times a second, in the thread of the caller.
        over: event that is set if an exception, such as Ctrl-C, ends the wait; running functions then return early.
    """
    with ThreadPoolExecutor(parallel) as threads:
        futures = [threads.submit(function, item) for item in items]
        pending = dict.fromkeys(futures)
        try:
            while pending:
                first = list(islice(pending, 8 * parallel))  # a wait for 10,000 futures takes longer than a tick
                for future in wait(first, timeout=_STOP_CHECK_INTERVAL_S, return_when=FIRST_COMPLETED).done:
                    del pending[future]
                    ended(future.result())
                tick()
        except BaseException:
            if over is not None:
                over.set()
            raise
        return [future.result() for future in futures]
