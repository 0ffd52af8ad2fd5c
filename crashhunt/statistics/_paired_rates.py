"""Interval of the difference of two crash rates per hour or per 1,000 km, from pairs in equal traffic, at any time.

Unit i has events a_i and exposure d_i of the first agent, and events b_i and exposure e_i of the second. The rates are
r = E[a] / E[d] and r + x = E[b] / E[e]. For the upper end of the difference x, each component bets that

    Z_i = b_i - a_i - r (e_i - d_i) - x e_i,    which has mean 0 at the true r and x,

has a mean below 0, with a share of its maximum stake:

    E(r, x) = sum_j w_j prod_i (1 - s_j Z_i / (m + r D)),    with at most m events and exposure D in a unit.

Each factor is positive, has mean 1 at the true r and x, and grows with x. The rate r itself is unknown. Each end has
half of the error probability. An interval of r, from the units of the first agent, has a tenth of that half, because r
has little influence. The bets have the rest. The upper end is the greatest over the interval of r. The lower end is the
upper end with the agents exchanged. Where both agents drive equally far in a unit, r has no influence.

If the result of a trial is unknown, each sum counts its unit at the worst possible Z.

Sources: those of `_paired_test`.

Cost: about 5,000 logarithms for each unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.statistics._anytime_interval import Bets, Interval, RateTest, log_of_sum
from crashhunt.statistics._counted_pairs import Pair, failures_of
from crashhunt.statistics._counted_trials import CountingRule, Per, exposure_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


_NODES = 16  # of the shares from 0 to 1
_SHARES: NDArray[np.float64] = np.append(np.cos(np.pi * (np.arange(_NODES) + 0.5) / (2 * _NODES)), 0.5)
_LOG_WEIGHTS: NDArray[np.float64] = np.log(np.append(np.full(_NODES, 0.5 / _NODES), 0.5))
_GRID = 5  # rates of the first agent, over their interval
_SHARE_OF_RATE = 0.1  # of the error probability
_PRECISION = 1e-6  # relative to the greatest rate


@dataclass(frozen=True, slots=True)
class _Side:
    """Events and exposure of one agent in each unit; `lost` units have an unknown result."""

    events: NDArray[np.float64]
    exposure: NDArray[np.float64]
    lost: NDArray[np.bool_]
    bets: Bets

    def interval(self, alpha: float) -> Interval:
        """Return the interval of the agent's rate, which is valid for every result of the lost units."""
        known = list(zip(self.events[~self.lost], self.exposure[~self.lost], strict=True))
        ends = []
        for worst in ((0.0, self.bets.most_exposure), (self.bets.most_events, 0.0)):
            test = RateTest(self.bets)
            test.extend(known)
            test.add(*worst, times=int(self.lost.sum()))
            ends.append(test.interval(alpha))
        return Interval(ends[0].low, ends[1].high)


def difference_of_rates(
    pairs: Sequence[Pair], rules: tuple[CountingRule, CountingRule], per: Per, alpha: float = 0.05
) -> Interval | str:
    """Return the interval of the difference, second minus first agent, or the reason why there is none.

    The probability that the interval ever excludes the true difference, after any number of pairs, is at most `alpha`.
    The pairs are in the order of their numbers.
    """
    trials = [one for pair in pairs for both in pair for one in both]
    step_length_s = next((one.step_length_s for one in trials if one.step_length_s), None)
    if step_length_s is None:
        return "no trial has a driven distance and time"
    sides = []
    for number, rule in enumerate(rules):
        own = [[both[number] for both in pair] for pair in pairs]
        if unknown := next((one for unit in own for one in unit if one.valid and exposure_of(one, per) is None), None):
            return f"trial {unknown.number} has no driven distance and time"
        sides.append(
            _Side(
                events=np.array([sum(failures_of(one)[0] for one in unit) for unit in own], float),
                exposure=np.array([math.fsum(exposure_of(one, per) or 0.0 for one in unit) for unit in own], float),
                lost=np.array([any(len({*failures_of(one)}) > 1 for one in unit) for unit in own], bool),
                bets=rule.bets(per, step_length_s),
            )
        )
    first, second = sides
    return Interval(-_upper_end(second, first, alpha / 2), _upper_end(first, second, alpha / 2))


def _upper_end(first: _Side, second: _Side, alpha: float) -> float:
    """Return the greatest difference of the rates, second minus first; the error probability is `alpha`."""
    if not second.exposure.sum() > 0:
        return math.inf
    rates = first.interval(_SHARE_OF_RATE * alpha)
    if not math.isfinite(rates.high):
        return math.inf
    least = max(rates.low, 1e-3 * rates.high)
    rest = (1 - _SHARE_OF_RATE) * alpha
    return max(_end_at(rate, first, second, rest) for rate in (rates.low, *np.geomspace(least, rates.high, _GRID)))


def _end_at(rate: float, first: _Side, second: _Side, alpha: float) -> float:
    """Return the difference at which the evidence reaches 1 / alpha, for a given rate of the first agent."""
    lost = first.lost | second.lost
    bound = max(first.bets.most_events, second.bets.most_events) + rate * first.bets.most_exposure
    known = (second.events - first.events - rate * (second.exposure - first.exposure))[~lost]
    exposure = second.exposure[~lost]

    def is_excluded(difference: float) -> bool:
        bets = np.log1p(-np.outer(_SHARES, (known - difference * exposure) / bound)).sum(axis=1)
        return log_of_sum(bets + _LOG_WEIGHTS + lost.sum() * np.log1p(-_SHARES)) >= -math.log(alpha)

    inside = max(float(known.sum()) / max(float(exposure.sum()), 1e-300), -rate)  # no rate is negative
    step = bound / max(float(exposure.sum()), 1e-300)
    while not is_excluded(inside + step):
        inside, step = inside + step, 2 * step
        if not math.isfinite(step):
            return math.inf
    outside = inside + step
    while outside - inside > _PRECISION * max(abs(outside), step):
        middle = (inside + outside) / 2
        inside, outside = (inside, middle) if is_excluded(middle) else (middle, outside)
    return outside
