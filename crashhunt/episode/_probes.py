"""Probes: every so often, copies of a running episode are asked how little it would take for it to crash.

Each copy goes on with a disturbance, and is over after some seconds. Only what is milder than the mildest that has made
the trial crash so far is asked for, so that most questions need one copy.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, cast

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.faculties import offers
from crashhunt.simulators import Disturbs
from crashhunt.trial import OF_AGENT, Disturbance, Outcome, Stress, steps_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.base.plain import Plain
    from crashhunt.episode._episode import Episode
    from crashhunt.trial import TrialResult

__all__ = ["BUDGET", "PROBED", "Probed", "Prober"]

BUDGET: Final = 4
"""Steps that copies may take for each step of their trial."""
_HORIZON_S = 5.0  # of simulation time, for which a copy is followed
_SHARES = 16  # of the strongest, to which the mildest is found
_PATIENCE_S = 30.0  # of wall time, for a copy
_BEGINS = 2  # steps on: what an agent sees late is noticed a step before


@dataclass(frozen=True, slots=True)
class Probed:
    """A kind of disturbance that copies are asked for.

    Args:
        what: the kind.
        who: the place in the grid around the agent.
        most: the strongest that is plausible, in the unit of its kind.
        how_long: in s.
    """

    what: str
    who: str
    most: float
    how_long: float


PROBED: Final = (
    Probed("brake", "ahead", 6.0, 3.0),
    Probed("stop", "ahead", 6.0, 8.0),
    Probed("late_action", "itself", 1.0, 3.0),
    Probed("late_observation", "itself", 1.0, 3.0),
    Probed("noisy_observation", "itself", 0.2, 3.0),
)
"""Those whose strength begins at nothing, as strong as the models draw them at most."""


class Prober:
    """Asks copies of one episode after another.

    Args:
        every_s: how often, in s of simulation time.
        crash_on: what counts as a crash.
        delay: called with the wall time that copies have taken, in s.

    Attributes:
        why_not: why copies cannot be asked any more, in words; empty where they can.
    """

    def __init__(self, every_s: float, crash_on: Sequence[Outcome], delay: Callable[[float], None]) -> None:
        self._every_s = every_s
        self._crashes = frozenset(map(str, crash_on))
        self._delay = delay
        self.why_not = ""
        self._stress = Stress(1.0)
        self._moment = 0
        self._goes_on = False  # without any disturbance, from the present moment on: that is asked once

    def is_due(self, episode: Episode) -> bool:
        """Whether copies are to be asked after the step that has just been taken."""
        return not self.why_not and episode.steps % steps_of(self._every_s, episode.simulator.step_length_s) == 0

    def ask(self, episode: Episode) -> None:
        """Find the mildest disturbance of each kind with which the episode crashes soon, if there is a milder one."""
        simulator = episode.simulator
        able = (*(simulator.disturbing_kinds if offers(simulator, Disturbs) else ()), *OF_AGENT)
        asked = [(kind, episode.names[number]) for kind in PROBED if kind.what in able for number in episode.acting]
        turn = self._moment % max(1, len(asked))  # where the budget does not last, others are left out each time
        self._moment += 1
        self._goes_on = False
        try:
            for kind, agent in asked[turn:] + asked[:turn]:
                if self._stress.steps >= BUDGET * episode.steps:
                    self._stress = replace(self._stress, left_out=self._stress.left_out + 1)
                elif not self._mildest(episode, kind, agent):
                    return
        except CrashhuntError as error:
            self.why_not = error.message

    def result(self, result: TrialResult) -> TrialResult:
        """Return the result of the trial with what has been found out; the next one begins."""
        stress, self._stress, self._moment = self._stress, Stress(1.0), 0
        if str(result.outcome) in self._crashes:
            stress = replace(stress, margin=0.0, disturbance=None, outcome="", step=0)
        elif not stress.probes:
            return result  # nobody was asked, which says nothing
        return replace(result, stress=stress)

    def _mildest(self, episode: Episode, kind: Probed, agent: str) -> bool:
        """Ask for one kind; return whether there is any point in asking for another."""
        low, high = 0, round(self._stress.margin * _SHARES)
        strength = high - 1
        while strength > low:
            disturbance = Disturbance(
                episode.steps + _BEGINS, kind.who, kind.what, kind.most * strength / _SHARES, kind.how_long, agent
            )
            outcome, step = self._copy(episode, disturbance)
            if not outcome:
                low = strength
            elif not self._goes_on and self._copy(episode, None)[0]:
                return False  # it is about to crash anyway
            else:
                self._goes_on, high = True, strength
                self._stress = replace(
                    self._stress, margin=high / _SHARES, disturbance=disturbance, outcome=outcome, step=step
                )
            if self.why_not or low == high - 1:
                break
            strength = (low + high) // 2
        return not self.why_not and self._stress.margin > 1 / _SHARES

    def _copy(self, episode: Episode, disturbance: Disturbance | None) -> tuple[str, int]:
        """Return how a copy crashed, and at which step; nothing where it did not."""
        horizon = _BEGINS + steps_of(_HORIZON_S, episode.simulator.step_length_s)

        def follow(copy: Episode) -> Plain:
            began = copy.steps
            if disturbance is not None:
                copy.disturb(disturbance)
            while copy.result is None and copy.steps < began + horizon:
                copy.step()
                if disturbance is not None and copy.steps == disturbance.step and not copy.takes_place(disturbance):
                    break  # nobody was there
            outcome = str(copy.result.outcome) if copy.result is not None else ""
            return {"steps": copy.steps - began, "step": copy.steps, "outcome": outcome}

        began = time.monotonic()
        try:
            asked = episode.fork(follow, observed=False)
            answer = asked.answer(_PATIENCE_S)
        finally:
            self._delay(time.monotonic() - began)
        if answer is None:
            self.why_not = asked.raised or "a copy died, or hung"
            return "", 0
        steps, outcome = cast(int, answer["steps"]), str(answer["outcome"])
        self._stress = replace(self._stress, probes=self._stress.probes + 1, steps=self._stress.steps + steps)
        crashed = outcome in self._crashes and outcome != Outcome.SIMULATOR_ERROR
        return (outcome, cast(int, answer["step"])) if crashed else ("", 0)
