"""Robustness probes: at intervals, forks of a running episode search for the mildest disturbance that causes a crash.

Each fork continues with one disturbance and ends after some seconds. Only disturbances milder than the mildest known
crash are tried, so most searches need only one fork.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal, cast

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.foreign_code import supports
from crashhunt.episode._forks import ForkRunner
from crashhunt.simulators import SupportsDisturbances
from crashhunt.trial import KINDS, SENSOR_KINDS, Disturbance, Outcome, Stress, steps_of

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Mapping, Sequence

    from crashhunt.base.forks import NoAnswer
    from crashhunt.base.json_types import Plain
    from crashhunt.episode._episode import Episode
    from crashhunt.trial import TrialResult

BUDGET: Final = 4
"""Steps that copies may take for each step of their trial."""
BUDGET_BESIDE: Final = 1
"""The same where the trial branches as well, which finds crashes in fewer steps."""
_STRENGTH_DIGITS = 9
_MIN_STRENGTH = 1e-9
_HORIZON_S = 5.0  # of simulation time, for which a copy is followed
_STRENGTH_LEVELS = 16  # of the worst, to which the mildest is found
_HALF_STRENGTH = 0.5
_PATIENCE_S = 30.0  # of wall time, for a copy
_STEPS_TO_ONSET = 2  # steps on: what an agent sees late is noticed a step before


@dataclass(frozen=True, slots=True)
class Probed:
    """A kind of disturbance that probes try, and the order in which its strengths are tried."""

    what: str  # kind of the disturbance
    who: tuple[str, ...]  # the places around the agent at which an actor is disturbed, tried in this order
    most: float  # the strongest plausible value, in the unit of the kind
    how_long: float  # the longest duration, in s
    least: float = 0.0  # the greatest value that has no effect, in the unit of the kind
    # the property that varies: strength or duration. If neither varies, the disturbance happens or not, and a crash
    # counts as half the maximum strength.
    grade: Literal["strength", "length", "whether"] = "strength"

    def shares(self, step_length_s: float) -> tuple[float, ...]:
        """Return the strengths to try, as shares of the maximum, from the mildest on, in steps of a sixteenth.

        For durations, only shares that differ in whole steps are tried. With steps of 1 s, for example, no delay can be
        a sixteenth of a second. The maximum itself has the share 15/16.
        """
        if self.grade == "whether":
            return (_HALF_STRENGTH,)
        sixteenths = tuple(number / _STRENGTH_LEVELS for number in range(1, _STRENGTH_LEVELS))
        is_time = self.grade == "length" or KINDS[self.what].unit == "s"
        if not is_time:
            return sixteenths
        worst = self.how_long if self.grade == "length" else self.most
        steps = dict.fromkeys(steps_of(share * worst, step_length_s) for share in sixteenths)
        shares = (one * step_length_s / worst for one in steps)
        return tuple(min(share, sixteenths[-1]) for share in shares if share <= 1 + _MIN_STRENGTH)

    def disturbance(self, share: float, who: str, agent: str, step: int) -> Disturbance:
        """Return a disturbance of this kind.

        Args:
            share: share of the plausible maximum, from 0 to 1.
            who: the place of the disturbed actor relative to the agent, such as ``ahead``; ``itself`` for the agent.
            agent: Identifier of the agent to which the place in ``who`` is relative.
            step: the step in which the disturbance begins.
        """
        strong = self.least + share * (self.most - self.least) if self.grade == "strength" else self.most
        long = share * self.how_long if self.grade == "length" else self.how_long
        strong, long = round(strong, _STRENGTH_DIGITS), round(long, _STRENGTH_DIGITS)  # of 3 steps of 0.1 s, 0.3 s
        return Disturbance(step=step, who=who, what=self.what, how_strong=strong, how_long=long, agent=agent)


_SIDE_PLACES = ("left ahead", "right ahead", "left", "right")

PROBED: Final = (
    Probed(what="brake", who=("ahead",), most=6.0, how_long=3.0),
    Probed(what="stop", who=("ahead",), most=6.0, how_long=8.0),
    Probed(what="late_action", who=("itself",), most=1.0, how_long=3.0),
    Probed(what="late_observation", who=("itself",), most=1.0, how_long=3.0),
    Probed(what="noisy_observation", who=("itself",), most=0.2, how_long=3.0),
    Probed(what="cut_in", who=_SIDE_PLACES, most=0.0, how_long=4.0, grade="whether"),
    Probed(what="unseen", who=("ahead", *_SIDE_PLACES), most=1.0, how_long=4.0, grade="length"),
    Probed(what="ignore_priority", who=_SIDE_PLACES, most=1.0, how_long=5.0, grade="length"),
    Probed(what="late_merge", who=_SIDE_PLACES, most=5.0, how_long=10.0, least=50.0),
    Probed(what="step_out", who=("right ahead", "left ahead"), most=1.4, how_long=6.0, grade="whether"),
    Probed(what="dawdle", who=("ahead",), most=0.5, how_long=10.0),
    Probed(what="speed", who=("behind",), most=0.5, how_long=10.0),
)
"""All that come with crashhunt, as strong and as long as the models draw them at most."""


@dataclass(frozen=True, slots=True)
class _Question:
    kind: Probed
    who: str
    agent: str


class Prober:
    """Runs the probes of one episode after another.

    Args:
        every_s: time between two probes, in s of simulation time.
        crash_on: the outcomes that count as a crash.
        delay: function called with the wall time that forks have taken, in s.
        budget: maximum number of steps of forks for each step of their trial.
        tell: function called with texts for the user.
        refused: kinds of disturbances that do not fit the actions of an agent, by identifier of the agent.
    """

    def __init__(
        self,
        every_s: float,
        crash_on: Sequence[Outcome],
        delay: Callable[[float], None],
        budget: int = BUDGET,
        tell: Callable[[str], None] = lambda _: None,
        refused: Mapping[str, Container[str]] = MappingProxyType({}),
    ) -> None:
        self._every_s, self._refused = every_s, refused
        self._budget = budget
        self._crashes = frozenset(map(str, crash_on))
        self._delay = delay
        self.fork_runner = ForkRunner("probes", tell)  # object that runs the forks, and counts those without a result
        self._stress = Stress(1.0)
        self._moment = 0  # of those at which there was something to ask
        self._goes_on = False  # without any disturbance, from the present moment on: that is asked once

    def is_due(self, episode: Episode) -> bool:
        """Return whether probes run after the completed step."""
        return episode.steps > 0 and episode.steps % steps_of(self._every_s, episode.simulator.step_length_s) == 0

    def ask(self, episode: Episode) -> None:
        """For each kind, search for a disturbance that soon crashes the episode and is milder than any found before."""
        before = self.fork_runner.unanswered
        self._ask(episode)
        asked = self.fork_runner.unanswered == before
        stress = self._stress
        self._stress = replace(stress, moments=stress.moments + 1, moments_asked=stress.moments_asked + asked)

    def _ask(self, episode: Episode) -> None:
        self._goes_on = False
        if self._find_mildest <= 1 / _STRENGTH_LEVELS:
            return
        if self.fork_runner.is_over:
            self.fork_runner.skip()
            return
        try:
            asked = self._questions_at(episode)
            turn = self._moment % max(1, len(asked))  # if the budget is too small, each moment skips other questions
            self._moment += 1
            for question in asked[turn:] + asked[:turn]:
                if self.fork_runner.is_over:
                    return
                if self._is_spent(episode):
                    self._stress = replace(self._stress, left_out=self._stress.left_out + 1)
                elif not self._mildest(episode, question):
                    return
        except CrashhuntError as error:
            self.fork_runner.stop(error.message)
            self.fork_runner.skip()

    @property
    def _find_mildest(self) -> float:
        """Return the least strength with which a probe has crashed, as a share; 1 if no probe has crashed."""
        assert self._stress.margin is not None
        return self._stress.margin

    def _is_spent(self, episode: Episode) -> bool:
        return self._stress.steps >= self._budget * episode.steps

    def _questions_at(self, episode: Episode) -> list[_Question]:
        """Return the probes that have a target vehicle, which is looked up in a fork."""
        simulator = episode.simulator
        kinds = simulator.disturbing_kinds if supports(simulator, SupportsDisturbances) else ()
        every = [
            _Question(kind, who, episode.names[number])
            for kind in PROBED
            if kind.what in kinds or kind.what in SENSOR_KINDS
            for who in kind.who
            for number in episode.acting
            if kind.what not in self._refused.get(episode.names[number], ())
        ]
        others = [] if self._is_spent(episode) else [one for one in every if one.kind.what not in SENSOR_KINDS]

        def look(copy: Episode) -> Plain:
            who = [one.kind.disturbance(1.0, one.who, one.agent, copy.steps + 1) for one in others]
            return {
                "there": [bool(copy.simulator.resolve_target(one)) for one in who]
                if supports(copy.simulator, SupportsDisturbances)
                else []
            }

        there = self._in_copy(episode, look).get("there", []) if others else []
        if others and not self.fork_runner.has_answer:
            return []
        absent = {one for one, is_there in zip(others, cast("list[bool]", there), strict=False) if not is_there}
        return [one for one in every if one not in absent]

    def result(self, result: TrialResult) -> TrialResult:
        """Return the result of the trial with the results of its forks, and begin the next trial."""
        stress, self._stress, self._moment = self._stress, Stress(1.0), 0
        why, may_be_answered = self.fork_runner.why_unanswered, self.fork_runner.may_be_answered
        self.fork_runner.begin_trial()
        if str(result.outcome) in self._crashes:
            stress = replace(stress, margin=0.0, disturbance=None, outcome="", step=0)
        elif stress.moments_asked < stress.moments:
            stress = replace(
                stress,
                margin=None,
                margin_upper_bound=stress.margin,
                why_unasked=why,
                may_be_asked_again=may_be_answered,
            )
        elif not stress.probes:
            return result  # no probe could run, so there is no result
        return replace(result, stress=stress)

    def _mildest(self, episode: Episode, question: _Question) -> bool:
        """Search for the mildest strength of one kind; return whether other kinds need to be tried."""
        kind, step = question.kind, episode.steps + _STEPS_TO_ONSET
        every = kind.shares(episode.simulator.step_length_s)
        shares = [share for share in every if share < self._find_mildest - _MIN_STRENGTH]
        low, high = -1, len(shares)  # so many of them do no harm, and from here on they do
        at = high - 1
        while at > low:
            disturbance = kind.disturbance(shares[at], question.who, question.agent, step)
            outcome, ended = self._copy(episode, disturbance)
            if not self.fork_runner.has_answer:
                break
            if not outcome:
                low = at
            elif not self._goes_on and self._copy(episode, None)[0]:
                return False  # it is about to crash anyway
            elif not self.fork_runner.has_answer:
                break  # it may be about to crash anyway
            else:
                self._goes_on, high = True, at
                self._stress = replace(
                    self._stress, margin=shares[at], disturbance=disturbance, outcome=outcome, step=ended
                )
            if low == high - 1:
                break
            at = (low + high) // 2
        return self._find_mildest > 1 / _STRENGTH_LEVELS

    def _copy(self, episode: Episode, disturbance: Disturbance | None) -> tuple[str, int]:
        """Return the outcome and the step of a crashed probe; empty if it did not crash or has no result."""
        horizon = _STEPS_TO_ONSET + steps_of(_HORIZON_S, episode.simulator.step_length_s)

        def follow(copy: Episode) -> Plain:
            began = copy.steps
            if disturbance is not None:
                copy.disturb(disturbance)
            while copy.result is None and copy.steps < began + horizon:
                copy.step()
                if disturbance is not None and copy.steps == disturbance.step and not copy.takes_place(disturbance):
                    break  # no vehicle was at the place
            outcome = str(copy.result.outcome) if copy.result is not None else ""
            return {"steps": copy.steps - began, "step": copy.steps, "outcome": outcome}

        answer = self._in_copy(episode, follow)
        if not answer:
            return "", 0
        steps, outcome = cast(int, answer["steps"]), str(answer["outcome"])
        self._stress = replace(self._stress, probes=self._stress.probes + 1, steps=self._stress.steps + steps)
        crashed = outcome in self._crashes and outcome != Outcome.SIMULATOR_ERROR
        return (outcome, cast(int, answer["step"])) if crashed else ("", 0)

    def _in_copy(self, episode: Episode, work: Callable[[Episode], Plain]) -> Plain:
        """Return the result of a fork; empty if no fork returns a result."""

        def attempt() -> tuple[Plain | None, NoAnswer | None]:
            began = time.monotonic()
            try:
                asked = episode.fork(work, observed=False)
                return asked.answer(_PATIENCE_S), asked.no_answer
            finally:
                self._delay(time.monotonic() - began)

        return self.fork_runner.run(attempt) or {}
