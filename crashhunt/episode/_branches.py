"""Branches: forks of an episode that continue with other disturbances, when other actors are near.

In every second of simulation with a near actor, the episode leaves a suspended fork. At intervals, the fork of a step
continues immediately, with all possible disturbances at their greatest strength. If the fork does not crash, milder
disturbances would hardly cause a crash either, so one branch replaces many. If the branch crashes, disturbances are
removed one by one while it still crashes.

The criticality of a step is known only some seconds later. The forks of a critical step, and of some seconds before,
then run with disturbances from the usual distributions.
"""

from __future__ import annotations

import math
import os
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, cast

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.foreign_code import supports
from crashhunt.base.forks import NoAnswer, NoProcessError, SuspendedFork
from crashhunt.base.json_types import Plain, finite
from crashhunt.base.resources import FREE, free_memory
from crashhunt.base.text import format_percent
from crashhunt.disturbances import disturber_of, parse_fixed, parse_rates
from crashhunt.episode._forks import ForkRunner
from crashhunt.episode._observers import ObservedEpisode, Observer
from crashhunt.simulators import SupportsDisturbances
from crashhunt.trial import SENSOR_KINDS, Branch, Branches, Disturbance, Outcome, in_turn, steps_of
from crashhunt.world import approaches, dangers

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.episode._episode import Episode
    from crashhunt.trial import TrialResult
    from crashhunt.world import Frame, Scene

BRANCHED: Final = 4
"""Steps that branches may take for each step of their trial."""
_DRAWN_SHARE_OF_STEPS = 1  # of these steps, the part for branches with drawn disturbances
_STRONGEST_S = 2  # time between two branches with all disturbances
_AT_ONCE_S = 1.0  # all disturbances of such a branch begin within this time
_NEAR_DANGER = 0.2  # criticality: 1.9 s behind a vehicle, or 2.4 m/s² needed; see `crashhunt guide forks`
_MAX_SUSPENDED_FORKS = 8  # number of suspended forks, one per second; the oldest is discarded
_SEEN_S = 3  # simulation time after which the criticality of a moment is known
_BEFORE_S = (0, 1, 3)  # branches start at these times before a critical moment
_REST_S = 3  # shortest time between two such moments
_SOON_S = 2.0  # the first disturbance of a branch begins within this time
_HORIZON_S = 6.0  # length of a branch
_WINDOW_S = 10  # length of the scenes that determine the criticality of a moment
_PATIENCE_S = 30.0  # wall-time limit of a branch
_STEPS_TO_FIRST_ONSET = 2  # steps until the first disturbance: a late observation takes effect one step earlier


@dataclass(frozen=True, slots=True)
class _StoredFork:
    step: int
    copy: SuspendedFork


@dataclass(frozen=True, slots=True)
class _Crashed:
    """A branch that crashed, with its disturbances."""

    took_place: tuple[Disturbance, ...]  # the disturbances of the branch that took place
    branched: int  # the step after which the branch began
    outcome: str  # outcome of the branch
    step: int  # step at which the branch ended
    log_likelihood: float | None  # log-likelihood of the disturbances, as in `Branch`


class Brancher(Observer):
    """Runs branches of one episode after another.

    Args:
        words: The rates of disturbances, each as ``NAME=RATE``, or disturbances in given steps.
        crash_on: The outcomes that count as a crash.
        delay: Function called with the wall time that branches have taken, in s.
        tell: Function called with texts for the user.
    """

    def __init__(
        self,
        words: Sequence[str],
        crash_on: Sequence[Outcome],
        delay: Callable[[float], None],
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._tell = tell
        self._owner = os.getpid()
        self._words = tuple(words)
        self._crashes = frozenset(map(str, crash_on))
        self._delay = delay
        self.fork_runner = ForkRunner("branches", tell)  # object that runs the forks, and counts those without a result
        self._branches = Branches()
        self._asleep: deque[_StoredFork] = deque()
        self._disturber: DisturbanceSampler | None = None
        self._any = False  # whether there might have been any

    def begin(self, episode: ObservedEpisode) -> None:
        """Begin the next episode, and compute the number of steps per second."""
        self._second = steps_of(1.0, episode.simulator.step_length_s)
        self._frames: deque[Frame] = deque(maxlen=_WINDOW_S * self._second + 1)
        self._branches, self._draws, self._drawn_steps = Branches(), 0, 0
        self._rests_until = 0
        self._strongest_at = 0  # the step from which all disturbances at once are tried again
        self.fork_runner.begin_trial()
        self._owner = os.getpid()
        self._any = False

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Store the last scenes of the episode."""
        self._frames.append(scene.frame)

    def is_due(self, episode: Episode) -> bool:
        """Return whether to leave a suspended fork after the last step."""
        return episode.steps > 0 and episode.steps % self._second == 0

    def ask(self, episode: Episode) -> None:
        """Leave a suspended fork if an actor is near, and run the due branches of this fork and of earlier forks."""
        began = time.monotonic()
        try:
            self._ask(episode)
        except CrashhuntError as error:
            self.fork_runner.stop(error.message)
            self.fork_runner.skip()
        finally:
            self._delay(time.monotonic() - began)

    def _ask(self, episode: Episode) -> None:
        while self._asleep and self._asleep[0].step <= episode.steps - _MAX_SUSPENDED_FORKS * self._second:
            self._asleep.popleft().copy.end()
        self._any = True
        near = self._is_near(episode)
        if self.fork_runner.is_over:
            if near:
                self.fork_runner.skip()
            return
        if near and free_memory() < FREE:
            self._tell(f"less than {format_percent(FREE)} of the memory is free: trials branch less than they might")
            self.fork_runner.skip(f"less than {format_percent(FREE)} of the memory was free")
        else:
            sleeper = self._suspend_fork(episode) if near else None
            if sleeper is not None and episode.steps >= self._strongest_at:
                self._ask_for_everything(episode, sleeper)
        if not self.fork_runner.is_over:
            self._ask_dangerous_moment(episode, episode.steps)

    def _suspend_fork(self, episode: Episode) -> _StoredFork | None:
        """Leave a suspended fork after the last step; return None if that is impossible now."""
        try:
            self._asleep.append(_StoredFork(episode.steps, episode.suspend_fork(self._run_branch)))
        except NoProcessError as error:
            self.fork_runner.miss(NoAnswer(f"could not be made: {error.message}", is_from_outside=True))
            return None
        return self._asleep[-1]

    def close(self) -> None:
        """End all forks, except in a process that an agent has forked, because the forks are not its children."""
        while self._asleep and os.getpid() == self._owner:
            self._asleep.pop().copy.end()

    def result(self, result: TrialResult) -> TrialResult:
        """Return the result of the trial, with the results of its forks added."""
        if not self._any:
            return result  # no branch could run, so there is no result
        if str(result.outcome) in self._crashes:
            return replace(result, branches=replace(self._branches, crashes=()))  # it needed no other
        runner = self.fork_runner
        branches = replace(
            self._branches,
            unanswered=runner.unanswered,
            why_unanswered=runner.why_unanswered,
            may_be_asked_again=runner.may_be_answered,
        )
        return replace(result, branches=branches)

    def _draws_of(self, episode: Episode) -> DisturbanceSampler:
        names, dt = episode.names, episode.simulator.step_length_s
        if self._disturber is None or (self._disturber.agents, self._disturber.step_length_s) != (names, dt):
            rates, fixed = parse_rates(self._words), parse_fixed(self._words, names)
            self._disturber = disturber_of(rates, agents=names, step_length_s=dt, fixed=fixed)
        return self._disturber

    def _is_near(self, episode: Episode) -> bool:
        """Return whether a disturbance may soon have an effect: an actor is within 50 m, or on a collision course."""
        frames = [self._frames[-1]]
        found = (approaches(frames, name)[:2] for name in episode.names)
        return any(math.isfinite(float(measured[-1])) for both in found for measured in both)

    def _is_spent(self, episode: Episode) -> bool:
        if self._branches.steps < BRANCHED * episode.steps:
            return False
        self._branches = replace(self._branches, left_out=self._branches.left_out + 1)
        return True

    def _ask_for_everything(self, episode: Episode, sleeper: _StoredFork) -> None:
        """Run a branch with all disturbances at once; while it crashes, repeat it with one disturbance less."""
        self._strongest_at = episode.steps + _STRONGEST_S * self._second
        if self._is_spent(episode):
            return
        draws, begins, until = self._draws_of(episode), *self._span(sleeper)
        self._branches = replace(self._branches, moments=self._branches.moments + 1)
        choices = draws.draw_strongest(episode.spec.seed, self._draws, begins, round(_AT_ONCE_S * self._second))
        self._draws += 1
        fixed = [(one,) for one in draws.fixed if begins < one.step <= until]
        found = self._branch(episode, sleeper, [*choices, *fixed], until)
        if found is None:
            return
        anyway = self._branch(episode, sleeper, fixed, min(until, found.step + self._second))
        if anyway is not None or not self.fork_runner.has_answer:
            return  # it is about to crash anyway, or may be
        first = not self._branches.crashes  # of which one that is likelier is looked for whatever it takes
        self._record_crash(episode, found)
        kept = [one for one in found.took_place if one not in draws.fixed]
        for one in kept:
            fewer = [other for other in kept if other is not one]
            if not fewer or self.fork_runner.is_over or (not first and self._is_spent(episode)):
                return
            found = self._branch(episode, sleeper, [*((other,) for other in fewer), *fixed], until)
            if found is not None:
                kept = fewer
                self._record_crash(episode, found)

    def _ask_dangerous_moment(self, episode: Episode, now: int) -> None:
        """Run branches from a step whose criticality is high, and higher than that of the steps around it."""
        second = self._second
        if not self._asleep or now < self._rests_until:
            return
        found, _ = dangers(list(self._frames), episode.names, episode.simulator.step_length_s)
        ends = len(found) - _SEEN_S * second
        if ends < second:
            return
        moment, after = (float(found[ends + n * second :][:second].max()) for n in (-1, 0))
        if moment < _NEAR_DANGER or moment < after:  # in the second case it is the next one that is asked
            return
        self._rests_until = now + _REST_S * second
        self._branches = replace(self._branches, moments=self._branches.moments + 1)
        step = now - (_SEEN_S + 1) * second
        froms = [next((one for one in self._asleep if one.step >= step - ago * second), None) for ago in _BEFORE_S]
        for sleeper in dict.fromkeys(filter(None, froms)):
            if self._drawn_steps >= _DRAWN_SHARE_OF_STEPS * episode.steps:
                self._branches = replace(self._branches, left_out=self._branches.left_out + 1)
            elif not self._is_spent(episode):
                self._draw(episode, sleeper)
            if self.fork_runner.is_over:
                return

    def _draw(self, episode: Episode, sleeper: _StoredFork) -> None:
        """Run a branch with disturbances from the usual distributions."""
        begins, until = self._span(sleeper)
        soon, before = round(_SOON_S * self._second), self._branches.steps
        drawn = self._draws_of(episode).draw_another(episode.spec.seed, self._draws, begins, soon, until)
        self._draws += 1
        found = self._branch(episode, sleeper, [(one,) for one in drawn], until)
        self._drawn_steps += self._branches.steps - before
        if found is not None:
            self._record_crash(episode, found)

    def _span(self, sleeper: _StoredFork) -> tuple[int, int]:
        """Return the step after which the disturbances of a branch begin, and the step in which the branch ends."""
        return sleeper.step + _STEPS_TO_FIRST_ONSET - 1, sleeper.step + round(_HORIZON_S * self._second)

    def _branch(
        self, episode: Episode, sleeper: _StoredFork, choices: Sequence[Sequence[Disturbance]], until: int
    ) -> _Crashed | None:
        """Run a branch with other disturbances: the first disturbance of each choice that has a target vehicle.

        Returns:
            The crashed branch; None if the branch has not crashed, or has no result.
        """
        job: Plain = {"choices": [[one.to_json() for one in some] for some in choices], "until": until}

        def attempt() -> tuple[Plain | None, NoAnswer | None]:
            copy = self._usable(episode, sleeper)
            return copy.ask(job, _PATIENCE_S), copy.no_answer

        answer = self.fork_runner.run(attempt, lambda: sleeper.step == episode.steps or sleeper.copy.is_usable)
        if answer is None:
            return None
        before, steps = self._branches, cast(int, answer["steps"])
        self._branches = replace(before, asked=before.asked + 1, steps=before.steps + steps)
        outcome, step = str(answer["outcome"]), cast(int, answer["step"])
        if outcome not in self._crashes or outcome == Outcome.SIMULATOR_ERROR:
            return None
        there = cast("list[JsonObject]", answer["there"])
        likely = cast("float | None", answer["log_likelihood"])
        return _Crashed(
            took_place=tuple(map(Disturbance.from_json, there)),
            branched=sleeper.step,
            outcome=outcome,
            step=step,
            log_likelihood=likely,
        )

    def _usable(self, episode: Episode, sleeper: _StoredFork) -> SuspendedFork:
        """Return the suspended fork of a step; a killed fork is replaced if the trial is still at that step."""
        copy = next((one.copy for one in self._asleep if one.step == sleeper.step), sleeper.copy)
        if copy.is_usable or sleeper.step != episode.steps:
            return copy
        copy.end()
        self._asleep = deque(one for one in self._asleep if one.copy is not copy)
        self._asleep.append(_StoredFork(sleeper.step, episode.suspend_fork(self._run_branch)))
        return self._asleep[-1].copy

    def _record_crash(self, episode: Episode, found: _Crashed) -> None:
        """Add a crashed branch to the result, with a specification that repeats it from the start."""
        begun = [one for one in episode.spec.disturbances if one.step <= found.branched + _STEPS_TO_FIRST_ONSET - 1]
        planned = in_turn([*begun, *found.took_place])
        branch = Branch(
            disturbances=planned,
            branched=found.branched,
            outcome=found.outcome,
            step=found.step,
            log_likelihood=found.log_likelihood,
        )
        self._branches = replace(self._branches, crashes=(*self._branches.crashes, branch))

    def _run_branch(self, copy: Episode, job: Plain) -> Plain:
        choices = cast("list[list[JsonObject]]", job["choices"])
        until, began = cast(int, job["until"]), copy.steps
        chosen = [_choice(copy, list(map(Disturbance.from_json, some))) for some in choices]
        planned = in_turn(one for one in chosen if one is not None)
        copy.replan(planned)
        fixed = self._draws_of(copy).fixed  # these also take place in the trial, so they do not justify a branch
        other = [one for one in planned if one not in fixed]
        first = min((one.step for one in other), default=until)
        soon = [one for one in other if one.step <= first + self._second]
        if None in chosen and not other:
            until = began
        while copy.result is None and copy.steps < until:
            copy.step()
            if soon and copy.steps == soon[-1].step and not any(map(copy.takes_place, soon)):
                break  # no vehicle was at the place
        outcome, likely = "", None
        if copy.result is not None:
            outcome, found = str(copy.result.outcome), self._draws_of(copy).log_likelihood_of(copy.result)
            likely = finite(found) if found is not None else None
        took_place = [one.to_json() for one in planned if one in fixed or copy.takes_place(one)]
        return {
            "steps": copy.steps - began, "step": copy.steps, "outcome": outcome, "there": took_place,
            "log_likelihood": likely,
        }  # fmt: skip


def _choice(copy: Episode, some: Sequence[Disturbance]) -> Disturbance | None:
    """Return the first disturbance that has a target vehicle; a single disturbance is returned without a check."""
    simulator = copy.simulator
    if len(some) == 1 or not supports(simulator, SupportsDisturbances):
        return some[0]
    return next((one for one in some if one.what in SENSOR_KINDS or simulator.resolve_target(one)), None)
