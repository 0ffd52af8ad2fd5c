"""Counterfactual analysis of a crash: reruns its trial with an overruled agent, or without one cause at a time."""

from __future__ import annotations

import itertools
import os
from contextlib import closing, nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.analysis._causes import find_why, lanes_around_crash
from crashhunt.analysis._driver_runs import PREVENTABILITY_RUNS, find_preventability
from crashhunt.analysis._omissions import find_omission
from crashhunt.base.errors import CrashhuntError, RecorderError, UsageError
from crashhunt.base.text import command_line
from crashhunt.crashes import (
    INTERRUPTED,
    Attempt,
    Judgement,
    LaneMap,
    StepBisection,
    changes_of,
    changing,
    ending_of,
    judgement_of,
    last_avoiding,
    last_escape,
    overruled_trial,
    slowing,
    visible_from,
    with_judgement,
)
from crashhunt.replays import ReplayOptions, prepare, reruns_of
from crashhunt.trial import Outcome
from crashhunt.trial_reruns import EndedRun, NotUnderstoodError, Reruns, StoppedError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from crashhunt.base.progress import Watch
    from crashhunt.crashes import Bundle, Ending
    from crashhunt.recording import Recording
    from crashhunt.replays import Rerun
    from crashhunt.trial import TrialResult


# The search for the last step from which a manoeuvre avoids a collision: which runs it asks for, and in what order.

_BRAKING_SHARE_OF_RUNS = 0.6  # of the runs; the rest is for changing lanes
_MIN_DECELERATION_MPS2 = 0.1  # m/s²
_NO_RUNS_LEFT = "no runs were left for changing lanes"


class CannotError(Exception):
    """The vehicle cannot carry out a manoeuvre."""


@dataclass(frozen=True, slots=True)
class Tried:
    """One run with the agent overruled."""

    step: int  # the step after which the agent was overruled
    ending: Ending  # what happened to the collision
    deceleration: float = 0.0  # the greatest deceleration of the agent, in m/s²
    changed: tuple[str, ...] = ()  # further differences in the agent's behaviour, in addition to the manoeuvre


class _Enough(Exception):  # noqa: N818 - no error
    """All runs have been used, or further runs would give no new information."""


@dataclass(slots=True)
class _Tries:
    """A manoeuvre, and the results of its runs."""

    manoeuvre: str
    most: int
    endings: dict[int, Ending] = field(default_factory=dict)
    decelerations: list[float] = field(default_factory=list)
    changed: dict[int, tuple[str, ...]] = field(default_factory=dict)

    @property
    def last(self) -> int | None:
        """The last step from which the manoeuvre avoids the crash."""
        return last_avoiding(self.endings)


class AvoidanceSearch:
    """Search for the last step from which a manoeuvre of the agent avoids a crash.

    The search bisects. After the bisection, the search runs the manoeuvre from steps after the last step that avoided
    the crash. The reason is that a later step may avoid the crash even if an earlier step does not.

    Args:
        end: number of the step of the crash.
        start: the step at which the search begins.
        run: runs a manoeuvre after each of some steps and yields the results; it may raise `CannotError`.
        runs: maximum number of runs, of which ``parallel`` run at a time.
    """

    def __init__(
        self, end: int, start: int, run: Callable[[str, list[int]], Iterator[Tried]], *, runs: int, parallel: int = 1
    ) -> None:
        self.why_not = ""
        self._end, self._start, self._run = end, start, run
        self._left, self._runs, self._parallel = runs, runs, max(1, parallel)
        self._tries: list[_Tries] = []

    def all(self) -> None:
        """Try braking, and then whether lane changes avoid the crash from a later step."""
        if self._end < 1:
            self.why_not = "it crashed in its first step"
            return
        start = min(max(0, self._start), self._end - 1)
        last = self._try("brake", int(self._runs * _BRAKING_SHARE_OF_RUNS) or 1, start, 0)
        first = 0 if last is None else last + 1
        if last == self._end - 1:
            return  # nothing can help any longer
        for side, share in (("left", 2), ("right", 1)):
            if self.why_not:
                return
            if self._left > 0:
                self._try(side, self._left // share or 1, self._end - 1, first)
            elif all(tries.last is None for tries in self._tries):  # else it would read as if nothing could help
                self.why_not = _NO_RUNS_LEFT

    def judgement(self) -> Judgement:
        """Return the results of all runs as a judgement."""
        attempts = [
            Attempt(
                manoeuvre=tried.manoeuvre,
                end=self._end,
                endings=dict(tried.endings),
                deceleration=max(
                    (value for value in tried.decelerations if value > _MIN_DECELERATION_MPS2), default=None
                ),
                changed=tried.changed.get(tried.last, ()) if tried.last is not None else (),
            )
            for tried in self._tries
            if tried.endings
        ]
        return Judgement(tuple(attempts), self.why_not)

    def _try(self, manoeuvre: str, most: int, start: int, first: int) -> int | None:
        """Search for the last step from which a manoeuvre avoids the crash; return it, or None if none was found."""
        tries = _Tries(manoeuvre, most)
        self._tries.append(tries)
        try:
            self._find(tries, start, first)
            self._run_later_steps(tries, first)
        except _Enough:
            pass
        except CannotError as error:
            if manoeuvre == "brake":
                self.why_not = str(error)
        return tries.last

    def _find(self, tries: _Tries, start: int, first: int) -> None:
        """Bisect between a step that avoids the crash and a step that does not."""
        bisection = StepBisection(first, start, self._end, parallel=self._parallel)
        while steps := bisection.next_steps(tries.endings):
            self._run_after_steps(tries, steps)

    def _run_later_steps(self, tries: _Tries, first: int) -> None:
        """Run the steps after the last step that avoided the crash, the latest first."""
        while True:
            above = first - 1 if tries.last is None else tries.last
            left = [step for step in range(self._end - 1, above, -1) if step not in tries.endings]
            if not left:
                return
            self._run_after_steps(tries, left[: self._parallel])

    def _run_after_steps(self, tries: _Tries, steps: Iterable[int]) -> None:
        """Run the manoeuvre after each of some steps.

        Raises:
            _Enough: no further runs are allowed.
        """
        new = sorted(step for step in steps if step not in tries.endings)
        new = new[: max(0, min(self._left, tries.most - len(tries.endings)))]
        if not new:
            raise _Enough
        for tried in self._run(tries.manoeuvre, new):
            self._left -= 1
            tries.endings[tried.step] = tried.ending
            tries.decelerations.append(tried.deceleration)
            tries.changed[tried.step] = tried.changed
            if tried.ending == "diverged":
                self.why_not = f"the trial was not the same up to step {tried.step} when it was run again"
                raise _Enough


_ASSUMED_DECELERATION_MPS2 = 4.5  # m/s², to begin the search somewhere


def judge(
    bundle: Bundle,
    options: ReplayOptions | None = None,
    *,
    runs: int = 60,
    why: int = 0,
    reference: int = 0,
    drivers: bool = False,
    parallel: int = 1,
    watch: Watch | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Judgement:
    """Return until when and how a collision could have been avoided, and the causes of the crash, by running it again.

    The agent is overruled after some step: it brakes as hard as its vehicle can, or changes lanes and brakes. The other
    vehicles react freely. The search begins at a calculated step and bisects. The search then runs the steps after the
    last step that avoided the crash, as far as the number of runs allows. The reason is that a later step may avoid the
    crash even if an earlier step does not. Causes are found by removing one candidate at a time. The arguments are
    those of `judge_bundle`. Without a collision partner, only the runs for causes are possible. After a stop, the
    results of the finished runs are returned.

    Raises:
        UsageError: the crash is a near miss or a hang, no run is possible, or ``runs`` is below 1.
        BundleError: the bundle is damaged.
        CrashhuntError: the trials could not be run.
    """
    if runs < 1:
        raise UsageError(f"--runs is {runs}", fix="give at least 1")
    result = bundle.result
    hit = result.collision
    of_two = result.outcome is Outcome.COLLISION and hit is not None and bool(hit.other)
    _require_judgeable(bundle, of_two=of_two, why=why)
    rerun = prepare(bundle, options or ReplayOptions())

    finished = itertools.count(1)

    def tell() -> None:
        if watch is not None:
            watch(next(finished), runs + why + reference + (PREVENTABILITY_RUNS if drivers and of_two else 0))

    with closing(reruns_of(rerun, parallel=parallel, stopped=stopped)) as reruns:
        lanes = lanes_around_crash(rerun)
        trials = _Trials(result=result, recorded=rerun.recorded, reruns=reruns, lanes=lanes, tell=tell)
        search = AvoidanceSearch(result.steps, _start(rerun) if of_two else 0, trials.run, runs=runs, parallel=parallel)
        found = None
        try:
            if of_two:
                search.all()
            if why > 0:
                found = find_why(rerun, reruns, most=why, tell=tell)
        except StoppedError:
            search.why_not = INTERRUPTED
    omitted = None
    if reference > 0 and result.outcome in (Outcome.COLLISION, Outcome.OFF_ROAD) and search.why_not != INTERRUPTED:
        omitted = find_omission(rerun, most=reference, parallel=parallel, stopped=stopped, tell=tell)
    prevented = None
    if drivers and of_two and search.why_not != INTERRUPTED:
        prevented = find_preventability(rerun, parallel=parallel, stopped=stopped, tell=tell)
    visible = visible_from(rerun.recorded, hit.agent, hit.other) if of_two and hit is not None else None
    return replace(search.judgement(), why=found, visible_step=visible, reference=omitted, drivers=prevented)


def check_numbers(*, runs: int, why: int, reference: int, parallel: int) -> None:
    """Refuse numbers of `judge_bundle` that are out of their range.

    Raises:
        UsageError: a number is too small.
    """
    if runs < 1:
        raise UsageError(f"--runs is {runs}", fix="give at least 1")
    for option, number, meaning in (
        ("--why", why, "do not search for the causes"),
        ("--reference", reference, "no reference driver"),
        ("--parallel", parallel, "one per core"),
    ):
        if number < 0:
            raise UsageError(f"{option} is {number}", fix=f"give at least 0 (0: {meaning})")


def judge_bundle(
    bundle: Bundle,
    options: ReplayOptions | None = None,
    *,
    runs: int = 60,
    why: int = 80,
    reference: int = 20,
    drivers: bool = True,
    parallel: int = 0,
    write: bool = True,
    watch: Watch | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Bundle:
    """Judge a crash, write the judgement to its ``crash.json``, and return the bundle with the judgement.

    Parts that this call does not compute keep the answers of earlier calls. If the call is stopped, its answers do not
    replace earlier ones. Another process may judge the same crash at the same time. The maximum numbers of trials are
    those of `crashhunt.judge`. Of the options, only the code that drives and its trust are used.

    Raises:
        UsageError: a number is out of its range, or no run is possible.
        CrashhuntError: the trials could not be run, or the bundle is damaged or cannot be written.
    """
    check_numbers(runs=runs, why=why, reference=reference, parallel=parallel)
    found = judge(
        bundle, options, runs=runs, why=why, reference=reference, drivers=drivers,
        parallel=parallel or len(os.sched_getaffinity(0)), watch=watch, stopped=stopped,
    )  # fmt: skip
    with changing(bundle) if write else nullcontext(bundle) as stored:
        known = judgement_of(stored)
        ran = found.runs or (found.why is not None and found.why.runs) or found.reference is not None
        if known is not None:
            kept = {name: getattr(known, name) for name in ("why", "reference", "drivers")}
            found = replace(found, **{name: value for name, value in kept.items() if getattr(found, name) is None})
        judged = with_judgement(stored, found)
        if write and ran and (known is None or not stopped()):
            judged.write()
    return judged


def _require_judgeable(bundle: Bundle, *, of_two: bool, why: int) -> None:
    """Check that some run of the analysis is possible.

    Raises:
        UsageError: no run is possible.
    """
    outcome = bundle.result.outcome
    if bundle.is_near_miss:
        raise UsageError(f"{bundle.id} is a near miss, not a crash", fix="give a crash")
    if outcome is Outcome.HANG:
        raise UsageError(
            f"{bundle.id} is a hang, so every run would reach the time limit",
            fix=f"find where it hangs with: {command_line('crashhunt', 'show', bundle.path)}",
        )
    if not of_two and why == 0:
        raise UsageError(
            f"{bundle.id} is not a collision with another actor, so only its causes can be analysed",
            fix="omit --why, or give --why at least 1",
        )


def _start(rerun: Rerun) -> int:
    """Return the step after which braking might just have avoided the crash, according to a calculation."""
    hit, end = rerun.bundle.result.collision, rerun.bundle.result.steps
    assert hit is not None
    guess = last_escape(rerun.recorded, hit.agent, hit.other, braking=_ASSUMED_DECELERATION_MPS2)
    return end - 1 if guess is None else guess


@dataclass(slots=True)
class _Trials:
    """Runs the trial of a collision with its agent overruled."""

    result: TrialResult
    recorded: Recording
    reruns: Reruns
    lanes: LaneMap
    tell: Callable[[], None]

    def run(self, manoeuvre: str, steps: list[int]) -> Iterator[Tried]:
        """Yield the result of a manoeuvre after each of some steps, in the order in which the runs end.

        Raises:
            CannotError: the vehicle cannot carry out the manoeuvre.
            CrashhuntError: the trials could not be run.
        """
        made = [overruled_trial(self.result, self.recorded, step, None, manoeuvre) for step in steps]
        try:
            for ended in self.reruns.run(made):
                yield self._tried(manoeuvre, steps[ended.place], ended)
        except NotUnderstoodError as error:
            raise CannotError(error.message) from error
        except (RecorderError, CannotError):
            raise
        except CrashhuntError as error:
            if manoeuvre == "brake":
                raise
            raise CannotError(str(error)) from error  # the crashhunt of an older snapshot knows braking only

    def _tried(self, manoeuvre: str, step: int, ended: EndedRun) -> Tried:
        result, recording = ended.result, ended.recording
        if result.outcome is Outcome.INVALID:
            raise CannotError(result.failure.message if result.failure else "its trial could not be set up")
        self.tell()
        assert self.result.collision is not None
        if recording is None:
            return Tried(step, "unclear")
        ending = ending_of(self.result, self.recorded, step, result, recording)
        agent = self.result.collision.agent
        changed = changes_of(self.recorded, recording, agent, self.lanes, step) if manoeuvre == "brake" else ()
        # What the simulator did with the vehicle in a run that does not count is no deceleration of the vehicle.
        deceleration = slowing(agent, step, result, recording) if ending == "avoided" else 0.0
        return Tried(step=step, ending=ending, deceleration=deceleration, changed=changed)
