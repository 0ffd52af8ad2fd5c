"""Runs of the trial of a crash with changes: several at a time, each compared with the recording.

This module runs the trials of all analyses that change a crash: `what_if`, the search for the last avoidable
step, the search for causes, and the minimization. A change is a changed `TrialSpec`. Each caller decides
which specifications to run next and what the results mean.

Invariant: a run is identified by the index of its specification. The order in which runs end, and the number of runs at
a time, change no result.

Cost: with the current crashhunt, each run is a fork of a process that has imported the agents. If the traffic stays the
same, a run is a fork of a simulator that has already been set up. A snapshot with another crashhunt needs a new Python
process for each run.
"""

from __future__ import annotations

import itertools
import json
import shutil
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.episode import scratch_of
from crashhunt.executors import FreshProcessExecutor, PoolExecutor, run_trials
from crashhunt.recording import Recording, read_black_box
from crashhunt.replays import is_current_code

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.executors import Executor
    from crashhunt.replays import Rerun
    from crashhunt.trial import TrialResult, TrialSpec


__all__ = ["EndedRun", "NotUnderstoodError", "Reruns", "StoppedError"]

_SUSPENDED_SETUPS = 2  # suspended set-ups of each worker: most runs begin as the crash did


class StoppedError(Exception):
    """The user has stopped the runs."""


class NotUnderstoodError(CrashhuntError):
    """The crashhunt in a snapshot ignored a part of a specification, and therefore ran another trial."""


@dataclass(frozen=True, slots=True)
class EndedRun:
    """A run that has ended, with its recording.

    Args:
        place: index of the run's specification among the specifications of the call.
        result: result of the trial.
        recording: recording of the trial; None if it was not requested, or if the process died before it could record.
        folder: folder with the files of the trial; it exists until the next run is requested.
        entered: ids of all actors that entered, if the specification requested them (`EVERYBODY`).
        responses: responses of the reference driver, if the specification has one; None if the trial reported none.
    """

    place: int
    result: TrialResult
    recording: Recording | None
    folder: Path
    entered: tuple[str, ...] = ()
    responses: tuple[JsonObject, ...] | None = None


class Reruns:
    """Runs trials that differ from the trial of a crash.

    Args:
        rerun: the crash whose trial is changed.
        scratch: folder for the files of the workers.
        parallel: number of trials at a time.
        stopped: function called before each wait for results, about twice a second; it returns whether to stop, or
            raises an exception.
        keep_all: whether trials without a crash are recorded as well.
        warm_copies: number of suspended simulators for each worker, which have already been set up.
        todays: whether trials run with the current crashhunt and not with the snapshot's; None to determine it.
    """

    def __init__(
        self,
        rerun: Rerun,
        scratch: Path,
        *,
        parallel: int,
        stopped: Callable[[], bool],
        keep_all: bool = True,
        warm_copies: int = _SUSPENDED_SETUPS,
        todays: bool | None = None,
    ) -> None:
        self._scratch, self._stopped = scratch, stopped
        worker = replace(rerun.worker, scratch=scratch, keep_trials=keep_all, warm_copies=warm_copies)
        kind = PoolExecutor if (is_current_code(rerun) if todays is None else todays) else FreshProcessExecutor
        self._executor: Executor = kind(worker, parallel=parallel)
        self._keep_all = keep_all
        self._numbers = itertools.count(1)  # folders of their own

    def run(
        self, specs: Sequence[TrialSpec], *, recorded: bool = True, needed: Callable[[int], bool] = lambda _: True
    ) -> Iterator[EndedRun]:
        """Yield trials as they end; if the caller stops the iteration, the unfinished trials are cancelled.

        Args:
            specs: specifications of the trials.
            recorded: whether their recordings are needed.
            needed: function that returns whether a trial is still needed, as in `run_trials`.

        Raises:
            StoppedError: the user has stopped the runs.
            NotUnderstoodError: the crashhunt that runs the trials does not know a part of a specification.
            CrashhuntError: the trials could not be run.
        """
        numbered = [replace(spec, number=number) for spec, number in zip(specs, self._numbers, strict=False)]
        for place, result in run_trials(self._executor, numbered, stopped=self._raise_stop, needed=needed):
            folder = scratch_of(self._scratch, result.spec.number)
            try:
                _require_same_trial(specs[place], result.spec)
                yield self._ended(place, result, folder, recorded=recorded)
            finally:
                if self._keep_all or result.kept:  # otherwise the worker removes its folder
                    shutil.rmtree(folder, ignore_errors=True)

    def close(self) -> None:
        """End all processes of the workers."""
        self._executor.close()

    def _raise_stop(self) -> bool:
        if self._stopped():
            raise StoppedError
        return False

    def _ended(self, place: int, result: TrialResult, folder: Path, *, recorded: bool) -> EndedRun:
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
        return EndedRun(
            place=place,
            result=result,
            recording=recording,
            folder=folder,
            entered=tuple(entered),
            responses=responses,
        )


def _require_same_trial(asked: TrialSpec, run: TrialSpec) -> None:
    """Check that the specification of a trial came back unchanged, because early versions ignore unknown keys.

    Raises:
        NotUnderstoodError: a part of the specification was ignored.
    """
    named = attrgetter("overruled", "disturbances", "only", "handover", "reseeding")
    if named(asked) != named(run):
        raise NotUnderstoodError("the snapshot contains a version of crashhunt that is too old for this command")
