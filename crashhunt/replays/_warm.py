"""Running a crash's trial many times over, each time with a change: on warm workers, where today's code runs it."""

from __future__ import annotations

import itertools
import shutil
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.episode import scratch_of
from crashhunt.executors import FreshProcessExecutor, PoolExecutor
from crashhunt.recording import Recording, read_black_box
from crashhunt.replays._todays import is_todays

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from crashhunt.executors import Executor
    from crashhunt.replays._prepare import Rerun
    from crashhunt.trial import TrialResult, TrialSpec

__all__ = ["Ended", "NotUnderstoodError", "Reruns", "StoppedError"]

_LOOK_EVERY_S = 0.5  # how late Ctrl-C may be
_WARM_COPIES = 2  # of each worker: most runs begin as the crash did


class StoppedError(Exception):
    """Somebody has asked to give up."""


class NotUnderstoodError(CrashhuntError):
    """What ran the trial has left out what it does not know of it, and so has run another one."""


@dataclass(frozen=True, slots=True)
class Ended:
    """A trial that has been run.

    Args:
        place: among those that were asked for.
        result: of it.
        recording: of it; None where nobody asked, or its process died before there was any.
    """

    place: int
    result: TrialResult
    recording: Recording | None


class Reruns:
    """Runs trials like that of a crash.

    Args:
        rerun: the crash.
        scratch: a folder for the workers.
        parallel: trials at a time.
        stopped: asked now and then whether to give up.
    """

    def __init__(self, rerun: Rerun, scratch: Path, *, parallel: int, stopped: Callable[[], bool]) -> None:
        self._scratch, self._stopped = scratch, stopped
        worker = replace(rerun.worker, scratch=scratch, keep_trials=True, warm_copies=_WARM_COPIES)
        kind = PoolExecutor if is_todays(rerun) else FreshProcessExecutor
        self._executor: Executor = kind(worker, parallel=parallel)
        self._numbers = itertools.count(1)  # folders of their own

    def run(self, specs: Sequence[TrialSpec], *, recorded: bool = True) -> Iterator[Ended]:
        """Yield what comes of trials as they end; what has not ended when nobody asks any more is given up.

        Args:
            specs: the trials.
            recorded: whether their recordings are wanted.

        Raises:
            StoppedError: somebody has asked for it.
            NotUnderstoodError: the crashhunt that runs them does not know what is asked.
            CrashhuntError: the trials could not be run.
        """
        asked = {number: (place, spec) for (place, spec), number in zip(enumerate(specs), self._numbers, strict=False)}
        try:
            for number, (_, spec) in asked.items():
                self._executor.submit(replace(spec, number=number))
            while asked:
                for result in list(self._executor.completed(_LOOK_EVERY_S)):
                    if result.spec.number in asked:  # else it is of what has been given up
                        place, spec = asked.pop(result.spec.number)
                        _see_that_it_was_run(spec, result.spec)
                        yield self._ended(place, result, recorded=recorded)
                if asked and self._stopped():
                    raise StoppedError
        finally:
            self._executor.cancel()

    def close(self) -> None:
        """End every process."""
        self._executor.close()

    def _ended(self, place: int, result: TrialResult, *, recorded: bool) -> Ended:
        folder = scratch_of(self._scratch, result.spec.number)
        recording = None
        if recorded:
            with suppress(BundleError):  # its process died
                recording = Recording(read_black_box(folder / layout.BLACK_BOX))
        shutil.rmtree(folder, ignore_errors=True)
        return Ended(place, result, recording)


def _see_that_it_was_run(asked: TrialSpec, run: TrialSpec) -> None:
    """See that what determines a trial came back as it was asked: early versions leave out what they do not know.

    Raises:
        NotUnderstoodError: something did not.
    """
    if (asked.overruled, asked.disturbances, asked.only) != (run.overruled, run.disturbances, run.only):
        raise NotUnderstoodError("the crashhunt in its snapshot is too old for that")
