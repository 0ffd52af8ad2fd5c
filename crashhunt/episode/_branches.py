"""Branches: where an episode comes near to a crash, copies of it go on with other disturbances.

Every second of simulation, a copy is left asleep. How near it was is only known some seconds later, when it is seen
what has become of it: then the copies from that moment, and from some seconds before, are asked.
"""

from __future__ import annotations

import os
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, cast

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.memory import FREE, free_memory
from crashhunt.base.plain import finite
from crashhunt.disturbances import disturber_of, parse_fixed, parse_rates
from crashhunt.episode._observer import Observer
from crashhunt.trial import Branch, Branches, Disturbance, Outcome, in_turn, steps_of
from crashhunt.world import dangers

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.base.asleep import Asleep
    from crashhunt.base.plain import Plain
    from crashhunt.disturbances import Disturber
    from crashhunt.episode._episode import Episode
    from crashhunt.trial import DisturbanceData, TrialResult
    from crashhunt.world import Frame, Scene

__all__ = ["BRANCHED", "Brancher"]

BRANCHED: Final = 2
"""Steps that branches may take for each step of their trial."""
_NEAR = 0.2  # danger: 1.9 s behind somebody, or 2.4 m/s² needed of a blind agent; see `crashhunt guide probes`
_KEPT = 8  # copies asleep, one a second
_SEEN_S = 3  # of simulation time, after which it is seen how near a moment was
_BEFORE_S = (0, 1, 3)  # before that moment, from where copies go on
_REST_S = 3  # at least, between such moments
_EACH = 3  # copies, from each of these
_SOON_S = 2.0  # in which the first disturbance of a branch begins
_HORIZON_S = 6.0  # for which a branch is followed
_WINDOW_S = 10  # of scenes, by which a moment is judged
_PATIENCE_S = 30.0  # of wall time, for a copy
_BEGINS = 2  # steps on, at the earliest: what an agent sees late is noticed a step before


@dataclass(frozen=True, slots=True)
class _Sleeper:
    step: int
    copy: Asleep


class Brancher(Observer):
    """Has copies of one episode after another go on with other disturbances.

    Args:
        words: how often what disturbs, ``NAME=RATE`` each, or what does in which step.
        crash_on: what counts as a crash.
        delay: called with the wall time that copies have taken, in s.
        tell: called with what people should know.

    Attributes:
        why_not: why there are no branches any more, in words; empty where there are.
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
        self.why_not = ""
        self._branches = Branches()
        self._asleep: deque[_Sleeper] = deque()
        self._frames: deque[Frame] = deque()
        self._disturber: Disturber | None = None
        self._second = 1  # in steps
        self._draws = 0
        self._rests_until = 0
        self._any = False  # whether any copy has been left asleep

    def begin(self, episode: Episode) -> None:
        """Note how long a second is; the next episode begins."""
        self._second = steps_of(1.0, episode.simulator.step_length_s)
        self._frames = deque(maxlen=_WINDOW_S * self._second + 1)
        self._branches, self._draws, self._rests_until = Branches(), 0, 0
        self._owner = os.getpid()
        self._any = False

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Keep the last scenes."""
        self._frames.append(scene.frame)

    def is_due(self, episode: Episode) -> bool:
        """Whether a copy is to be left asleep after the step that has just been taken."""
        return not self.why_not and episode.steps % self._second == 0

    def ask(self, episode: Episode) -> None:
        """Leave a copy asleep; where the episode was near to a crash some seconds ago, ask those from then."""
        began = time.monotonic()
        try:
            while len(self._asleep) >= _KEPT:
                self._asleep.popleft().copy.end()
            if free_memory() >= FREE:
                copy = episode.leave_asleep(self._go_on)
                self._any = True
                self._asleep.append(_Sleeper(episode.steps, copy))
            else:
                self._tell(f"less than {FREE:.0%} of the memory is free: trials branch less than they might")
            self._look(episode, episode.steps)
        except CrashhuntError as error:
            self.why_not = error.message
        finally:
            self._delay(time.monotonic() - began)

    def close(self) -> None:
        """End all copies, unless an agent has forked, and this is what it has forked: they are not its own."""
        while self._asleep and os.getpid() == self._owner:
            self._asleep.pop().copy.end()

    def result(self, result: TrialResult) -> TrialResult:
        """Return the result of the trial with what has been found out."""
        if not self._any:
            return result  # nobody could be asked, which says nothing
        if str(result.outcome) in self._crashes:
            return replace(result, branches=replace(self._branches, crashes=()))  # it needed no other
        return replace(result, branches=self._branches)

    def _draws_of(self, episode: Episode) -> Disturber:
        names, dt = episode.names, episode.simulator.step_length_s
        if self._disturber is None or (self._disturber.agents, self._disturber.step_length_s) != (names, dt):
            rates, fixed = parse_rates(self._words), parse_fixed(self._words, names)
            self._disturber = disturber_of(rates, agents=names, step_length_s=dt, fixed=fixed)
        return self._disturber

    def _look(self, episode: Episode, now: int) -> None:
        """Ask the copies from a moment that was near, and nearer than those around it."""
        second = self._second
        found, _ = dangers(list(self._frames), episode.names, episode.simulator.step_length_s)
        ends = len(found) - _SEEN_S * second
        if ends < second or now < self._rests_until:
            return
        moment, after = (float(found[ends + n * second :][:second].max()) for n in (-1, 0))
        if moment < _NEAR or moment < after:  # in the second case it is the next one that is asked
            return
        self._rests_until = now + _REST_S * second
        self._branches = replace(self._branches, moments=self._branches.moments + 1)
        step = now - (_SEEN_S + 1) * second
        froms = [next((one for one in self._asleep if one.step >= step - ago * second), None) for ago in _BEFORE_S]
        for sleeper in [*dict.fromkeys(filter(None, froms))] * _EACH:
            if self._branches.steps >= BRANCHED * episode.steps:
                self._branches = replace(self._branches, left_out=self._branches.left_out + 1)
            else:
                self._branch(episode, sleeper)
            if self.why_not:
                return

    def _branch(self, episode: Episode, sleeper: _Sleeper) -> None:
        """Have a copy go on with other disturbances."""
        second, begins = self._second, sleeper.step + _BEGINS - 1
        until = sleeper.step + round(_HORIZON_S * second)
        drawn = self._draws_of(episode).draw_another(
            episode.spec.seed, self._draws, begins, round(_SOON_S * second), until
        )
        self._draws += 1
        answer = sleeper.copy.ask({"disturbances": [one.to_json() for one in drawn], "until": until}, _PATIENCE_S)
        if answer is None:
            self.why_not = sleeper.copy.raised or "a copy died, or hung"
            return
        found = self._branches
        outcome, step, steps = str(answer["outcome"]), cast(int, answer["step"]), cast(int, answer["steps"])
        self._branches = replace(found, asked=found.asked + 1, steps=found.steps + steps)
        if outcome in self._crashes and outcome != Outcome.SIMULATOR_ERROR:
            begun = [one for one in episode.spec.disturbances if one.step <= begins]
            planned = in_turn([*begun, *drawn])
            likely = cast("float | None", answer["log_likelihood"])
            branch = Branch(planned, sleeper.step, outcome, step, likely)
            self._branches = replace(self._branches, crashes=(*found.crashes, branch))

    def _go_on(self, copy: Episode, job: Plain) -> Plain:
        drawn = [Disturbance.from_json(one) for one in cast("list[DisturbanceData]", job["disturbances"])]
        until, began = cast(int, job["until"]), copy.steps
        copy.replan(drawn)
        fixed = self._draws_of(copy).fixed  # these take place in the trial as well, so they are no reason to go on
        first = next((one for one in drawn if one not in fixed), drawn[0])
        while copy.result is None and copy.steps < until:
            copy.step()
            if copy.steps == first.step and not copy.takes_place(first):
                break  # nobody was there
        outcome, likely = "", None
        if copy.result is not None:
            outcome, found = str(copy.result.outcome), self._draws_of(copy).log_likelihood_of(copy.result)
            likely = finite(found) if found is not None else None
        return {"steps": copy.steps - began, "step": copy.steps, "outcome": outcome, "log_likelihood": likely}
