"""Judging a collision: its trial is run again, overruled or with something left out, to see what avoids it."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError, RecorderError, UsageError
from crashhunt.crashes import INTERRUPTED, ending_of, last_escape, overruled_trial, slowing, visible_from
from crashhunt.replays._avoiding import CannotError, Search, Tried
from crashhunt.replays._prepare import ReplayOptions, prepare
from crashhunt.replays._warm import NotUnderstoodError, Reruns, StoppedError
from crashhunt.replays._why import find_why
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from crashhunt.base.watching import Watch
    from crashhunt.crashes import Bundle, Judgement
    from crashhunt.recording import Recording
    from crashhunt.replays._warm import Ended
    from crashhunt.trial import TrialResult

__all__ = ["judge"]

_GUESS = 4.5  # m/s², to begin the search somewhere


def judge(
    bundle: Bundle,
    options: ReplayOptions | None = None,
    *,
    runs: int = 60,
    why: int = 0,
    parallel: int = 1,
    watch: Watch | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Judgement:
    """Return until when a collision could have been avoided, how, and what it hangs on, by running its trial again.

    The agent is overruled after some step: it brakes as hard as its vehicle can, or changes lanes and brakes; the
    others react as they then do. The search begins where a calculation guesses it, bisects, and then runs the steps
    after the last one that helped, as many as it may: that it is too late after one step does not say that it is too
    late after the next. What it hangs on is found by leaving one thing out at a time.

    Args:
        bundle: of a collision.
        options: of the replays; only whose code drives, and whether it is trusted.
        runs: the most trials to run to avoid it.
        why: the most trials to run for what it hangs on; 0 leaves that out.
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
        reruns = Reruns(rerun, Path(folder), parallel=parallel, stopped=stopped)

        def tell(done: int) -> None:
            if watch is not None:
                watch(done, runs + why)

        trials = _Trials(result, rerun.recorded, reruns, tell)
        start = result.steps - 1 if guess is None else guess
        search = Search(result.steps, start, trials.run, runs=runs, parallel=parallel)
        found = None
        try:
            search.all()
            if why > 0:
                found = find_why(rerun, reruns, most=why, tell=lambda done: tell(trials.done + done))
        except StoppedError:
            search.why_not = INTERRUPTED
        finally:
            reruns.close()
    return replace(search.judgement(), why=found, visible_step=visible_from(rerun.recorded, hit.agent, hit.other))


@dataclass(slots=True)
class _Trials:
    """Runs the trial of a collision with its agent overruled."""

    result: TrialResult
    recorded: Recording
    reruns: Reruns
    tell: Callable[[int], None]
    done: int = 0

    def run(self, manoeuvre: str, steps: list[int]) -> Iterator[Tried]:
        """Yield what comes of a manoeuvre after each of some steps, as it ends.

        Raises:
            CannotError: the vehicle cannot do it.
            CrashhuntError: the trials could not be run.
        """
        made = [overruled_trial(self.result, self.recorded, step, None, manoeuvre) for step in steps]
        try:
            for ended in self.reruns.run(made):
                yield self._tried(steps[ended.place], ended)
        except NotUnderstoodError as error:
            raise CannotError(error.message) from error
        except (RecorderError, CannotError):
            raise
        except CrashhuntError as error:
            if manoeuvre == "brake":
                raise
            raise CannotError(str(error)) from error  # the crashhunt of an older snapshot knows braking only

    def _tried(self, step: int, ended: Ended) -> Tried:
        result, recording = ended.result, ended.recording
        if result.outcome is Outcome.INVALID:
            raise CannotError(result.failure.message if result.failure else "its trial could not be set up")
        self.done += 1
        self.tell(self.done)
        assert self.result.collision is not None
        if recording is None:
            return Tried(step, "unclear")
        ending = ending_of(self.result, self.recorded, step, result, recording)
        return Tried(step, ending, slowing(self.result.collision.agent, step, result, recording))
