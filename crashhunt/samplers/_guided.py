"""A portfolio: strategies have as many trials as they earn, and what they do not earn goes to an even search.

What a strategy earns is measured against trials that nothing guides, by rank alone: of a trial that is more dangerous
than a share of 1 - q of those, the payoff is -log q, which is 1 on the average where there is nothing to learn. So
strategies that follow a danger that says nothing get nothing but probes.

That danger grows does not yet mean that it leads to a crash, which nobody knows before the first one. There are two
signs that it does not: strategies leave all unguided trials behind, and then come no nearer; or they never come near,
as dangers from 0 to 1 are measured. Then they have little, so that a hunt is never much worse than an even search.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.draws import one_of
from crashhunt.samplers._cross_entropy import CrossEntropy
from crashhunt.samplers._elites import Elites
from crashhunt.samplers._low_discrepancy import HaltonSampler
from crashhunt.samplers._mutation import Mutation
from crashhunt.samplers._strategy import Draft

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.samplers._cube import Cube
    from crashhunt.samplers._protocol import HuntFacts, Space
    from crashhunt.samplers._strategy import Strategy
    from crashhunt.samplers._told import Told

__all__ = ["Portfolio"]

_EVEN = "halton"
_FIRST = 10  # unguided trials before anybody is measured against them
_CLIMBING, _STUCK = 0.7, 0.1  # the share of the hunt's trials that strategies have at most
_FAR, _NEAR = 0.35, 0.5  # at most the first, as long as no danger has been above the second
_PROBING = 0.05  # what each has at least: what it earned before is no longer what it would
_OF_OURS = 0.8  # the share of trials that the portfolio is asked for at all
_PATIENCE, _PATIENCE_PER_ARGUMENT = 8, 3  # trials of strategies without a greater danger until they count as stuck
_NEARER = 0.85  # of what was missing to a crash is missing now, or less: else it is no greater danger
_AHEAD = 0.4  # as many of the strategies' trials are above all unguided ones, lately: else they are not stuck
_LATELY = 0.1  # what the last one counts in that
_CREDIT = 3.0  # trials with a payoff of 2, which everybody begins with
_FORGET = 0.96  # of what a strategy has earned, at each of its trials
_REMEMBERED = 200  # trials from which strategies begin anew after a crash
_AROUND = 0.1  # of a crash, times the square root of the dimensions: there, nothing more is looked for
_WIDER, _WIDEST = 1.5, 0.45  # so many times that, where strategies find only what is just outside, up to so much
_CRASHES = 32  # around which nothing more is looked for
_TRIES = 4


class Portfolio:
    """Cross-entropy and mutation, beside Halton's sequence.

    Args:
        cube: of the arguments.
        space: the same as distributions.
        hunt: whose seed scrambles the sequence.
    """

    def __init__(self, cube: Cube, space: Space, hunt: HuntFacts) -> None:
        self._cube = cube
        self._even = HaltonSampler(space, hunt=hunt)
        self._patience = _PATIENCE + _PATIENCE_PER_ARGUMENT * cube.dimensions
        self._unguided: list[float] = []  # scores, in order
        self._best = Elites(_REMEMBERED)
        self._crashes: deque[_Known] = deque(maxlen=_CRASHES)
        self._earned = dict.fromkeys(
            ("cross-entropy", "mutation"), (2.0 * _CREDIT, _CREDIT)
        )  # sum and count, both forgotten slowly
        self._begin()

    def _begin(self) -> None:
        """Make the strategies anew, from everything that is not near to a crash that is known."""
        self._strategies: dict[str, Strategy] = {
            "cross-entropy": CrossEntropy(self._cube), "mutation": Mutation(self._cube),
        }  # fmt: skip
        self._record, self._without_record = -1.0, 0  # the greatest danger, and for how many trials
        self._top = np.zeros(self._cube.dimensions)  # where that was
        self._rival = 0.0  # the greatest danger of an unguided trial
        self._ahead = 0.0  # how many of the strategies' trials are above all unguided ones, lately
        best, self._best = self._best, Elites(_REMEMBERED)
        for told in sorted(best, key=lambda told: told.number):
            if not self._is_known(told.point):
                self._best.add(told)
                self._tell_strategies(told)

    def tell(self, told: Told) -> None:
        """Account for a trial, and let the strategies know of it."""
        if told.origin in self._strategies:
            total, count = self._earned[told.origin]
            self._earned[told.origin] = (total * _FORGET + self._payoff(told.score), count * _FORGET + 1.0)
        else:
            insort(self._unguided, told.score)
        if self._is_known(told.point):
            return
        if told.crashed:  # a hunt that goes on is after other crashes, and not after this one again and again
            self._crashes.append(_Known(told.point, _AROUND * math.sqrt(len(told.point))))
            self._begin()
            return
        self._best.add(told)
        self._tell_strategies(told)
        if self._crashes and self._without_record >= self._patience:
            self._widen()

    def propose(self, number: int, rng: np.random.Generator) -> Draft:
        """Return what one of the strategies proposes, or the next point of the even search."""
        shares = self._shares()
        if len(self._unguided) >= _FIRST and rng.random() < sum(shares.values()) / _OF_OURS:
            name = one_of(shares, rng)
            for _ in range(_TRIES):
                draft = self._strategies[name].propose(number, rng)
                if draft is not None and not self._is_known(draft.point):
                    return Draft(draft.point, draft.seed, draft.parent, origin=name)
        return Draft(self._even.point(number), origin=_EVEN)

    def _tell_strategies(self, told: Told) -> None:
        for strategy in self._strategies.values():
            strategy.tell(told)
        if 1.0 - told.score < _NEARER * (1.0 - self._record):
            self._record, self._top, self._without_record = told.score, told.point, 0
        elif told.origin in self._strategies:
            self._without_record += 1
        if told.origin in self._strategies:
            self._ahead += _LATELY * ((told.score > self._rival) - self._ahead)
        else:
            self._rival = max(self._rival, told.score)

    def _payoff(self, score: float) -> float:
        below, at_most = bisect_left(self._unguided, score), bisect_right(self._unguided, score)
        above = len(self._unguided) - at_most + 0.5 * (at_most - below)
        return math.log((len(self._unguided) + 1.0) / (above + 0.5))

    def _shares(self) -> dict[str, float]:
        """Of all trials of the hunt, which share a strategy has."""
        gains = {name: max(total / count - 1.0, 0.05) ** 2 for name, (total, count) in self._earned.items()}
        most = _STUCK if self._is_stuck else _CLIMBING if self._record > _NEAR else _FAR
        whole = most * min(1.0, max(gains.values()))
        return {name: max(whole * gain / sum(gains.values()), _PROBING) for name, gain in gains.items()}

    @property
    def _is_stuck(self) -> bool:
        return self._without_record >= self._patience and self._ahead > _AHEAD

    def _widen(self) -> None:
        """Keep further away from a crash, if it is the same again: what danger still leads to is just beside it."""
        nearest = min(self._crashes, key=lambda crash: crash.away(self._top) / crash.radius)
        if nearest.away(self._top) < _WIDER * nearest.radius:
            wider, size = nearest.radius * _WIDER, math.sqrt(self._cube.dimensions)
            nearest.radius = wider if wider < _WIDEST * size else _AROUND * size
            self._begin()

    def _is_known(self, point: NDArray[np.float64]) -> bool:
        """Whether a crash is known near to it."""
        return any(crash.away(point) < crash.radius for crash in self._crashes)


@dataclass(slots=True, eq=False)
class _Known:
    """A crash around which nothing more is looked for."""

    point: NDArray[np.float64]
    radius: float

    def away(self, point: NDArray[np.float64]) -> float:
        return float(np.linalg.norm(self.point - point))
