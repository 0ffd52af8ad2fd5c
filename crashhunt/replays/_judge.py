"""Judging a collision: its trial is run again with the agent overruled from many a step on, to see what avoids it."""

from __future__ import annotations

import itertools
import shutil
import tempfile
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError, RecorderError, UsageError
from crashhunt.crashes import INTERRUPTED, ending_of, last_escape, overruled_trial, slowing
from crashhunt.episode import scratch_of
from crashhunt.executors import FreshProcessExecutor
from crashhunt.recording import Recording, read_black_box
from crashhunt.replays._avoiding import CannotError, Search, Tried
from crashhunt.replays._prepare import ReplayOptions, prepare
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from crashhunt.base.watching import Watch
    from crashhunt.crashes import Bundle, Judgement
    from crashhunt.trial import TrialResult

__all__ = ["judge"]

_LOOK_EVERY_S = 0.5  # how late Ctrl-C may be
_GUESS = 4.5  # m/s², to begin the search somewhere


def judge(
    bundle: Bundle,
    options: ReplayOptions | None = None,
    *,
    runs: int = 60,
    parallel: int = 1,
    watch: Watch | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Judgement:
    """Return until when a collision could have been avoided, and how, by running its trial again.

    The agent is overruled after some step: it brakes as hard as its vehicle can, or changes lanes and brakes; the
    others react as they then do. The search begins where a calculation guesses it, bisects, and then runs the steps
    after the last one that helped, as many as it may: that it is too late after one step does not say that it is too
    late after the next.

    Args:
        bundle: of a collision.
        options: of the replays; only whose code drives, and whether it is trusted.
        runs: the most trials to run; each is one process.
        parallel: how many at a time.
        watch: called with how many have been run, and the most.
        stopped: asked now and then whether to give up; what has been found by then is returned.

    Raises:
        UsageError: it is no collision with somebody, or ``runs`` is below 1.
        BundleError: the bundle is damaged.
        CrashhuntError: the trials could not be run.
    """
    if runs < 1:
        raise UsageError(f"--runs is {runs}", fix="give at least 1")
    result = bundle.result
    hit = result.collision
    if result.outcome is not Outcome.COLLISION or hit is None or not hit.other:
        raise UsageError(f"{bundle.id} is no collision with somebody else", fix="give one that is")
    rerun = prepare(bundle, options or ReplayOptions())
    guess = last_escape(rerun.recorded, hit.agent, hit.other, braking=_GUESS)
    with tempfile.TemporaryDirectory(prefix="crashhunt-judge-") as folder:
        executor = FreshProcessExecutor(replace(rerun.worker, scratch=Path(folder)), parallel=parallel)
        trials = _Trials(result, rerun.recorded, executor, Path(folder), stopped, lambda done: _tell(watch, done, runs))
        start = result.steps - 1 if guess is None else guess
        search = Search(result.steps, start, trials.run, runs=runs, parallel=parallel)
        try:
            search.all()
        except _StoppedError:
            search.why_not = INTERRUPTED
        finally:
            executor.close()
    return search.judgement()


def _tell(watch: Watch | None, done: int, most: int) -> None:
    if watch is not None:
        watch(done, most)


class _StoppedError(Exception):
    pass


@dataclass(slots=True)
class _Trials:
    """Runs the trial of a collision with its agent overruled."""

    result: TrialResult
    recorded: Recording
    executor: FreshProcessExecutor
    scratch: Path
    stopped: Callable[[], bool]
    tell: Callable[[int], None]
    done: int = 0
    _numbers: itertools.count[int] = field(default_factory=lambda: itertools.count(1))  # folders of their own

    def run(self, manoeuvre: str, steps: list[int]) -> Iterator[Tried]:
        """Yield what comes of a manoeuvre after each of some steps, as it ends.

        Raises:
            CannotError: the vehicle cannot do it.
            CrashhuntError: the trials could not be run.
        """
        made = [overruled_trial(self.result, self.recorded, step, None, manoeuvre) for step in steps]
        asked = {number: spec for spec, number in zip(made, self._numbers, strict=False)}
        try:
            for number, spec in asked.items():
                self.executor.submit(replace(spec, number=number))
            while asked:
                for result in self._completed(manoeuvre):
                    overruled = asked.pop(result.spec.number).overruled
                    assert overruled is not None
                    yield self._tried(overruled.after, result)
                if self.stopped():
                    raise _StoppedError
        finally:
            self.executor.cancel()  # where enough is known before all have ended

    def _completed(self, manoeuvre: str) -> list[TrialResult]:
        try:
            return list(self.executor.completed(_LOOK_EVERY_S))
        except RecorderError:
            raise
        except CrashhuntError as error:
            if manoeuvre == "brake":
                raise
            raise CannotError(str(error)) from error  # the crashhunt of an older snapshot knows braking only

    def _tried(self, step: int, result: TrialResult) -> Tried:
        if result.outcome is Outcome.INVALID:
            raise CannotError(result.failure.message if result.failure else "its trial could not be set up")
        self.done += 1
        self.tell(self.done)
        assert self.result.collision is not None
        folder = scratch_of(self.scratch, result.spec.number)
        try:
            with suppress(BundleError):  # its process died
                recording = Recording(read_black_box(folder / layout.BLACK_BOX))
                ending = ending_of(self.result, self.recorded, step, result, recording)
                return Tried(step, ending, slowing(self.result.collision.agent, step, result, recording))
            return Tried(step, "unclear")
        finally:
            shutil.rmtree(folder, ignore_errors=True)
