"""A portfolio: strategies have as many trials as they earn, and what they do not earn goes to an even search.

What a strategy earns is measured against trials that nothing guides, by rank alone: of a trial that is more dangerous
than a share of 1 - q of those, the payoff is -log q, which is 1 on the average where there is nothing to learn. So
strategies that follow a danger that says nothing get nothing but probes.

That danger grows does not yet mean that it leads to a crash, which nobody knows before the first one. There are two
signs that it does not: strategies leave the unguided trials behind, and then come no nearer; or they never come near,
as dangers from 0 to 1 are measured. Then they have little, so that a hunt is never much worse than an even search, and
a part of that little goes to other peaks of danger than the highest.

After the first crash, what counts is other kinds of crashes: the fewer of them a trial strategies have found than
chance has, the less they have.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.draws import one_of
from crashhunt.samplers._elites import Elites
from crashhunt.samplers._known import KnownCrashes
from crashhunt.samplers._low_discrepancy import HaltonSampler
from crashhunt.samplers._model import Model
from crashhunt.samplers._mutation import Mutation
from crashhunt.samplers._niches import Niches
from crashhunt.samplers._strategy import Draft

if TYPE_CHECKING:
    from crashhunt.samplers._cube import Cube
    from crashhunt.samplers._protocol import HuntFacts, Space
    from crashhunt.samplers._strategy import Strategy
    from crashhunt.samplers._told import Told

__all__ = ["Portfolio"]

_EVEN, _MODEL, _MUTATION, _NICHE = "halton", "model", "mutation", "niche"
_FIRST = 10  # unguided trials before anybody is measured against them
_OF_OURS = 0.8  # the share of a hunt's trials that the portfolio is asked for at all; of all are the shares below
_CLIMBING, _STUCK = 0.7, 0.05  # what strategies have at most
_FAR, _NEAR = 0.35, 0.5  # at most the first, as long as no danger has been above the second
_PROBING = 0.02  # what each has at least: what it earned before is no longer what it would
_OTHER_PEAKS, _CLIMBING_THERE = 0.08, 0.15  # what the search for other peaks has, where strategies are stuck
_PATIENCE, _PATIENCE_PER_ARGUMENT = 8, 3  # trials of strategies without a greater danger until they may be stuck
_NEARER = 0.85  # of what was missing to a crash is missing now, or less: else it is no greater danger
_AHEAD = 0.4  # as many of the strategies' trials are above all unguided ones, lately: so they are stuck, or
_FAR_AHEAD = 2.5  # this is what one of them earns, and it comes no nearer
_LATELY = 0.1  # what the last one counts in that
_CREDIT = 3.0  # trials with a payoff of 2, which everybody begins with
_FORGET = 0.96  # of what a strategy has earned, at each of its trials
_INHERITED = 0.3  # what a trial counts that has its danger from the seed of its parent
_KINDS, _TRIALS = 0.5, 25.0  # so many new kinds in so many trials everybody begins with
_REMEMBERED = 200  # trials from which strategies begin anew after a crash
_TRIES = 4


class Portfolio:
    """A model of danger and mutation, beside Halton's sequence.

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
        self._known = KnownCrashes(cube.dimensions)
        self._earned = dict.fromkeys((_MODEL, _MUTATION), (2.0 * _CREDIT, _CREDIT))  # sum and count, forgotten slowly
        self._kinds = {True: (_KINDS, _TRIALS), False: (_KINDS, _TRIALS)}  # new ones and trials: guided, and not
        self._model = Model(cube)
        self._begin()

    def _begin(self) -> None:
        """Make the strategies anew, from everything that is not near to a crash that is known."""
        best, self._best = sorted(self._best, key=lambda told: told.number), Elites(_REMEMBERED)
        kept = self._known.outside(best)
        self._model, mutation = Model(self._cube, like=self._model), Mutation(self._cube)
        self._model.remember(kept)
        self._strategies: dict[str, Strategy] = {_MODEL: self._model, _MUTATION: mutation}
        self._niches = Niches(self._cube, self._model)
        self._record, self._without_record = -1.0, 0  # the greatest danger, and for how many trials
        self._top = np.zeros(self._cube.dimensions)  # where that was
        self._rival = 0.0  # the greatest danger of an unguided trial
        self._ahead = 0.0  # how many of the strategies' trials are above all unguided ones, lately
        for told in kept:
            self._best.add(told)
            mutation.tell(told)
            self._measure(told)

    def tell(self, told: Told) -> None:
        """Account for a trial, and let the strategies know of it."""
        if told.origin in self._strategies:
            total, count = self._earned[told.origin]
            payoff, weight = (1.0, _INHERITED) if self._is_inherited(told) else (self._payoff(told.score), 1.0)
            self._earned[told.origin] = (total * _FORGET + payoff * weight, count * _FORGET + weight)
        elif told.origin != _NICHE:
            insort(self._unguided, told.score)
        is_guided = told.origin in self._strategies or told.origin == _NICHE
        kinds, trials = self._kinds[is_guided]
        self._kinds[is_guided] = (kinds + (told.crashed and self._known.is_new(told)), trials + 1.0)
        if told.crashed:
            if self._known.add(told):
                self._begin()
            return
        if self._known.cover(told.point, told.seed):
            return
        self._best.add(told)
        for strategy in self._strategies.values():
            strategy.tell(told)
        self._measure(told)
        self._niches.tell(told)
        if self._is_stuck:
            self._niches.begin()
        if self._known and self._without_record >= self._patience and self._known.widen(self._top):
            self._begin()

    def propose(self, place: int, rng: np.random.Generator) -> Draft:
        """Return what one of the strategies proposes, or the next point of the even search."""
        if len(self._unguided) >= _FIRST:
            for name in self._drawn(rng):
                for _ in range(_TRIES):
                    strategy = self._niches if name == _NICHE else self._strategies[name]
                    draft = strategy.propose(place, rng)
                    if draft is not None and not self._known.cover(draft.point, draft.seed):
                        return Draft(draft.point, draft.seed, draft.parent, origin=name)
        return Draft(self._even.point(place), origin=_EVEN)

    def _drawn(self, rng: np.random.Generator) -> list[str]:
        """Return whose turn it is; that of none where it is the even search's."""
        names = []
        elsewhere = _CLIMBING_THERE if self._niches.climbs else _OTHER_PEAKS
        if self._is_stuck and rng.random() < elsewhere / _OF_OURS:
            names.append(_NICHE)
        shares = self._shares()
        if rng.random() < sum(shares.values()) / _OF_OURS:
            names.append(one_of(shares, rng))
        return names

    def _measure(self, told: Told) -> None:
        """See whether it is a greater danger, and from whom."""
        if 1.0 - told.score < _NEARER * (1.0 - self._record):
            self._record, self._top, self._without_record = told.score, told.point, 0
        elif told.origin in self._strategies:
            self._without_record += 1
        if told.origin in self._strategies:
            self._ahead += _LATELY * ((told.score > self._rival) - self._ahead)
        elif told.origin != _NICHE:
            self._rival = max(self._rival, told.score)

    def _is_inherited(self, told: Told) -> bool:
        """Whether it has the seed of its parent and is no more dangerous: that much may be the traffic's."""
        parent = next((one for one in self._best if one.number == told.parent), None)
        return parent is not None and parent.seed == told.seed and told.score <= parent.score

    def _payoff(self, score: float) -> float:
        below, at_most = bisect_left(self._unguided, score), bisect_right(self._unguided, score)
        above = len(self._unguided) - at_most + 0.5 * (at_most - below)
        return math.log((len(self._unguided) + 1.0) / (above + 0.5))

    def _shares(self) -> dict[str, float]:
        """Of all trials of the hunt, which share a strategy has."""
        gains = {name: max(total / count - 1.0, 0.05) ** 2 for name, (total, count) in self._earned.items()}
        most = _STUCK if self._is_stuck else _CLIMBING if self._record > _NEAR else _FAR
        whole = most * min(1.0, max(gains.values()))
        if self._known:
            (ours, of), (theirs, among) = self._kinds[True], self._kinds[False]
            whole *= min(1.0, ours * among / (theirs * of)) ** 2
        return {name: max(whole * gain / sum(gains.values()), _PROBING) for name, gain in gains.items()}

    @property
    def _is_stuck(self) -> bool:
        if self._without_record < self._patience:
            return False
        return self._ahead > _AHEAD or max(total / count for total, count in self._earned.values()) > _FAR_AHEAD
