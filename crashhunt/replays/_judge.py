"""Judging a crash: its trial is run again, overruled or with something left out, to see what avoids it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError, RecorderError, UsageError
from crashhunt.base.temporary import temporary_folder
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
    from crashhunt.replays._prepare import Rerun
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
    """Return until when a collision could have been avoided, how, and what a crash hangs on, by running it again.

    The agent is overruled after some step: it brakes as hard as its vehicle can, or changes lanes and brakes; the
    others react as they then do. The search begins where a calculation guesses it, bisects, and then runs the steps
    after the last one that helped, as many as it may: that it is too late after one step does not say that it is too
    late after the next. What it hangs on is found by leaving one thing out at a time.

    Args:
        bundle: of a crash; of one that is no collision with somebody, only what it hangs on is run.
        options: of the replays; only whose code drives, and whether it is trusted.
        runs: the most trials to run to avoid it.
        why: the most trials to run for what it hangs on; 0 leaves that out.
        parallel: how many at a time.
        watch: called with how many have been run, and the most.
        stopped: asked now and then whether to give up; what has been found by then is returned.

    Raises:
        UsageError: it is a near miss or a hang, there is nothing to run, or ``runs`` is below 1.
        BundleError: the bundle is damaged.
        CrashhuntError: the trials could not be run.
    """
    if runs < 1:
        raise UsageError(f"--runs is {runs}", fix="give at least 1")
    result = bundle.result
    hit = result.collision
    of_two = result.outcome is Outcome.COLLISION and hit is not None and bool(hit.other)
    _see_that_it_can_be_judged(bundle, of_two=of_two, why=why)
    rerun = prepare(bundle, options or ReplayOptions())
    with temporary_folder("judge") as scratch:
        reruns = Reruns(rerun, scratch, parallel=parallel, stopped=stopped)

        def tell(done: int) -> None:
            if watch is not None:
                watch(done, runs + why)

        trials = _Trials(result, rerun.recorded, reruns, tell)
        search = Search(result.steps, _start(rerun) if of_two else 0, trials.run, runs=runs, parallel=parallel)
        found = None
        try:
            if of_two:
                search.all()
            if why > 0:
                found = find_why(rerun, reruns, most=why, tell=lambda done: tell(trials.done + done))
        except StoppedError:
            search.why_not = INTERRUPTED
        finally:
            reruns.close()
    visible = visible_from(rerun.recorded, hit.agent, hit.other) if of_two and hit is not None else None
    return replace(search.judgement(), why=found, visible_step=visible)


def _see_that_it_can_be_judged(bundle: Bundle, *, of_two: bool, why: int) -> None:
    """See that there is something to run.

    Raises:
        UsageError: there is not.
    """
    outcome = bundle.result.outcome
    if bundle.is_near_miss:
        raise UsageError(f"{bundle.id} is a near miss, and nothing crashes in it", fix="give a crash")
    if outcome is Outcome.HANG:
        raise UsageError(
            f"{bundle.id} is a hang, and every run of it would take its time limit",
            fix=f"look where it hangs: crashhunt show {bundle.path}",
        )
    if not of_two and why == 0:
        raise UsageError(
            f"{bundle.id} is no collision with somebody else, so that only what it hangs on can be run",
            fix="leave --why out, or give at least 1",
        )


def _start(rerun: Rerun) -> int:
    """The step after which braking may just have helped, as far as a calculation says it."""
    hit, end = rerun.bundle.result.collision, rerun.bundle.result.steps
    assert hit is not None
    guess = last_escape(rerun.recorded, hit.agent, hit.other, braking=_GUESS)
    return end - 1 if guess is None else guess


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
