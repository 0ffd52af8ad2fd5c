"""A portfolio: strategies have as many trials as they earn, and what they do not earn goes to an even search.

What a strategy earns is measured against trials that nothing guides, by rank alone: of a trial that is more dangerous
than a share of 1 - q of those, the payoff is -log q, which is 1 on the average where there is nothing to learn. So what
a danger is in numbers does not matter, and strategies that follow one that says nothing get nothing but probes.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

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
_WHOLE = 150  # of those until strategies have their whole share: what crashes often is found without them
# The share of the hunt's trials that strategies have, as long as they come nearer to a crash and when they no longer
# do. Climbing may lead nowhere, so that never more than half of a hunt is at stake.
_CLIMBING, _STUCK, _PROBING = 0.5, 0.3, 0.06
_OF_OURS = 0.8  # the share of trials that the portfolio is asked for at all
_PATIENCE, _PATIENCE_PER_ARGUMENT = 10, 4  # trials of strategies without a greater danger until they count as stuck
_NEARER = 0.9  # of what was missing to a crash is missing now, or less: else it is no greater danger
_FORGET = 0.96  # of what a strategy has earned, at each of its trials
_REMEMBERED = 200  # trials from which strategies begin anew after a crash
_AROUND = 0.1  # of a crash, times the square root of the dimensions: there, nothing more is looked for
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
        self._crashes: deque[NDArray[np.float64]] = deque(maxlen=_CRASHES)
        self._earned = {"cross-entropy": (2.0, 1.0), "mutation": (2.0, 1.0)}  # sum and count, both forgotten slowly
        self._begin()

    def _begin(self) -> None:
        """Make the strategies anew, from everything that is not near to a crash that is known."""
        self._strategies: dict[str, Strategy] = {
            "cross-entropy": CrossEntropy(self._cube), "mutation": Mutation(self._cube),
        }  # fmt: skip
        self._record, self._without_record = -1.0, 0  # the greatest danger, and for how many trials
        for told in sorted(self._best, key=lambda told: told.number):
            if not self._is_known(told.point):
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
            self._crashes.append(told.point)
            self._begin()
            return
        self._best.add(told)
        self._tell_strategies(told)

    def propose(self, number: int, rng: np.random.Generator) -> Draft:
        """Return what one of the strategies proposes, or the next point of the even search."""
        shares = self._shares()
        if len(self._unguided) >= _FIRST and rng.random() < sum(shares.values()) / _OF_OURS:
            name = self._drawn(shares, rng)
            for _ in range(_TRIES):
                draft = self._strategies[name].propose(number, rng)
                if draft is not None and not self._is_known(draft.point):
                    return Draft(draft.point, draft.seed, draft.parent, origin=name)
        return Draft(self._even.point(number), origin=_EVEN)

    def _tell_strategies(self, told: Told) -> None:
        for strategy in self._strategies.values():
            strategy.tell(told)
        if 1.0 - told.score < _NEARER * (1.0 - self._record):
            self._record, self._without_record = told.score, 0
        elif told.origin in self._strategies:
            self._without_record += 1

    def _payoff(self, score: float) -> float:
        below, at_most = bisect_left(self._unguided, score), bisect_right(self._unguided, score)
        above = len(self._unguided) - at_most + 0.5 * (at_most - below)
        return math.log((len(self._unguided) + 1.0) / (above + 0.5))

    def _shares(self) -> dict[str, float]:
        """Of all trials of the hunt, which share a strategy has."""
        gains = {name: max(total / count - 1.0, 0.05) for name, (total, count) in self._earned.items()}
        most = _STUCK if self._without_record >= self._patience else _CLIMBING
        most *= min(1.0, len(self._unguided) / _WHOLE)
        whole = max(most * min(1.0, max(gains.values())), _PROBING)
        return {name: whole * gain / sum(gains.values()) for name, gain in gains.items()}

    def _is_known(self, point: NDArray[np.float64]) -> bool:
        """Whether a crash is known near to it."""
        if not self._crashes:
            return False
        distances = np.linalg.norm(np.array(self._crashes) - point, axis=1)
        return bool((distances < _AROUND * math.sqrt(len(point))).any())

    @staticmethod
    def _drawn(shares: dict[str, float], rng: np.random.Generator) -> str:
        at = rng.random() * sum(shares.values())
        for name, share in shares.items():
            at -= share
            if at < 0.0:
                return name
        return next(reversed(shares))
