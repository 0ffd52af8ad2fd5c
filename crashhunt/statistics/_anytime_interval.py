"""Intervals for a rate that are valid at any time.

Each unit has Y events (0 to b) and an exposure D (above 0, at most Dmax). The rate is E[Y] / E[D]. For each possible
rate r, the module computes the capital of bets against r. The interval consists of the rates whose capital is below 1
/ alpha:

    E(r) = sum_j w_j prod_i (1 + k_j(r) (Y_i - r D_i)),    k_j(r) = clip(q_j / r - 1, -0.999 / b, 0.999 / (r Dmax)).

Component j bets as if the rate were q_j. More than half of the weight is on q = 0, because most agents crash rarely.
Without an event, the upper end of the interval is at about 3.5 / n. The upper end of Clopper and Pearson's interval is
at 3.7 / n, and is valid only at one fixed n. The other weight is on a grid of 162 rates, each 10 % above the rate
before. A coarser grid makes an interval of many events wider than necessary. Most of this weight is between 1e-4 and
0.1, because a hunt of 100,000 trials can have 30 events at such rates.

Invariant: at the true rate each factor is positive and has mean 1 given the past. So E is a non-negative martingale
that begins at 1. By Ville's inequality, the probability that E ever reaches 1 / alpha is at most alpha. You may
therefore look at the interval after every trial, and stop because of the result. The units must be independent, of one
distribution, and in an order that does not depend on their results. The numbers b, Dmax, w and q must be fixed before
the first unit.

Why components below 1 do not count: each component is at most 1 at the observed rate, because log(1 + x) <= x. On
either side of that rate, a component that exceeds 1 keeps growing. The sum over the components above 1 therefore grows
to both sides, and bisection finds the rate at which the sum crosses 1 / alpha. The sum is smaller than E, so the
interval stays valid.

Sources: Ville, Étude critique de la notion de collectif (1939). Robbins, Statistical methods related to the law of the
iterated logarithm (1970), for mixtures. Waudby-Smith and Ramdas, Estimating means of bounded random variables by
betting, JRSS B 86(1), 2024, for the bets. Grünwald, de Heide and Koolen, Safe testing, JRSS B 86(5), 2024, for
e-values.

Cost: a unit increments a counter. The computation of a capital needs one logarithm for each component and each kind of
unit. With trials as exposure, there are two kinds of units. Many different exposures are spread over a fixed grid. A
unit between two grid points counts partly at each of the two points, with the same sum. The logarithm of each factor is
concave in the exposure, so the grid increases no capital, and the interval stays valid.
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from crashhunt.base.text import format_number

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

_WEIGHT_OF_ZERO = 0.535
_LEAST_RATE, _GREATEST_RATE = 1e-7, 0.98  # of the grid, in events per greatest exposure
_COMPONENTS = 162  # between them, evenly spaced in the logarithm
_GREATEST_UNBOUNDED_RATE = 1e3  # of the grid where a unit may have less than the greatest exposure
# Weight of a component by its rate, linear in the logarithm between these, up to a common factor.
_RATES = (1e-7, 6.3e-5, 1.26e-4, 0.063, 0.158, 0.98, 1e3)
_WEIGHTS = (0.6, 1.0, 6.0, 6.0, 2.0, 2.0, 0.5)
_SHARE_AT_STAKE = 0.999  # of the capital in one bet, at most
_PRECISION = 1e-9  # relative, of both ends
_MAX_EXPOSURES = 512  # different ones; more are spread over the grid
_MAX_EVENTS = 8  # different numbers of events where exposures are spread
_GRID_PARTS = 256  # parts of the greatest exposure


BarVerdict = Literal["below", "above", "undecided"]


class Interval(NamedTuple):
    """The rates that are compatible with the counted units."""

    low: float  # the least rate
    high: float  # the greatest rate; infinite if there is no exposure

    def as_difference(self) -> str:
        """Return the interval of a difference as text.

        >>> Interval(-0.0174, 0.1942).as_difference()
        '-0.0174 to +0.194'
        >>> Interval(0.0000042, 3.25).as_difference()
        '+4.2e-6 to +3.25'
        """
        ends = [format_number(end) for end in self]
        signed = [f"+{text}" if 0 < end < math.inf else text for end, text in zip(self, ends, strict=True)]
        return " to ".join(signed)


def log_of_sum(logs: NDArray[np.float64]) -> float:
    """Return the logarithm of the sum of numbers that are given by their logarithms."""
    top = float(logs.max())
    return top + math.log(float(np.exp(logs - top).sum()))


class Bets:
    """The bets against each possible rate, fixed before the first unit.

    Args:
        most_events: maximum number of events of a unit.
        most_exposure: maximum exposure of a unit, in the unit of measurement to which rates refer.
        fixed_exposure: whether every unit has the maximum exposure and at most one event, as trials do.
    """

    def __init__(
        self, most_events: float = 1.0, most_exposure: float = 1.0, *, fixed_exposure: bool | None = None
    ) -> None:
        if not (0 < most_events < math.inf and 0 < most_exposure < math.inf):
            raise ValueError(
                f"most_events is {most_events} and most_exposure is {most_exposure}; both must be finite and above 0"
            )
        self.most_events, self.most_exposure = float(most_events), float(most_exposure)
        self.fixed_exposure = most_events == most_exposure == 1.0 if fixed_exposure is None else fixed_exposure
        ratio = (_GREATEST_RATE / _LEAST_RATE) ** (1 / (_COMPONENTS - 1))
        count = _COMPONENTS
        if not self.fixed_exposure:
            count += math.ceil(math.log(_GREATEST_UNBOUNDED_RATE / _GREATEST_RATE) / math.log(ratio))
        grid = _LEAST_RATE * ratio ** np.arange(count)
        self._alternatives = np.concatenate(([0.0], grid)) / self.most_exposure
        weights = np.interp(np.log(grid), np.log(_RATES), _WEIGHTS)
        shares = np.concatenate(([_WEIGHT_OF_ZERO], weights / weights.sum() * (1 - _WEIGHT_OF_ZERO)))
        self._log_weights: NDArray[np.float64] = np.log(shares)

    def stakes(self, rate: float) -> NDArray[np.float64]:
        """Return the share of its capital that each component bets on more events than the given rate."""
        least = -_SHARE_AT_STAKE / self.most_events
        most = _SHARE_AT_STAKE / (rate * self.most_exposure)
        found: NDArray[np.float64] = np.clip(self._alternatives / rate - 1.0, least, most)
        return found

    def log_evidence(self, log_capitals: NDArray[np.float64]) -> float:
        """Return the logarithm of the sum of the components above 1; minus infinity if there are none."""
        won = log_capitals > 0
        if not won.any():
            return -math.inf
        return log_of_sum((self._log_weights + log_capitals)[won])

    def log_mixture(self, log_capitals: NDArray[np.float64]) -> float:
        """Return the logarithm of the sum of all components, which is the martingale."""
        return log_of_sum(self._log_weights + log_capitals)


class RateTest:
    """Counts units, and returns at any time the rates that are compatible with them."""

    def __init__(self, bets: Bets | None = None) -> None:
        self.bets = bets or Bets()
        self.count, self.events, self.exposure = 0, 0.0, 0.0
        self._units: dict[tuple[float, float], float] = defaultdict(float)
        self._spreads = False
        self._as_arrays: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None = None

    def add(self, events: float, exposure: float = 1.0, times: int = 1) -> None:
        """Add a number of equal units.

        Events and exposure are those of each unit, from 0 to the maximum of the bets.

        Raises:
            ValueError: a unit exceeds the bounds on which the bets rely.
        """
        bets = self.bets
        if not (0 <= events <= bets.most_events and 0 <= exposure <= bets.most_exposure * (1 + _PRECISION)):
            raise ValueError(
                f"one trial has {events:g} events and exposure {exposure:g}; allowed are at most {bets.most_events:g} "
                f"events and exposure {bets.most_exposure:g}"
            )
        if times:
            self.count += times
            self.events += events * times
            self.exposure += exposure * times
            self._as_arrays = None
            self._count(float(events), float(exposure), times)
            many = not self._spreads and len(self._units) > _MAX_EXPOSURES
            if many and len({events for events, _ in self._units}) <= _MAX_EVENTS:  # they differ in their exposures
                self._spreads = True
                units, self._units = self._units, defaultdict(float)
                for (some, over), count in units.items():
                    self._count(some, over, count)

    def _count(self, events: float, exposure: float, times: float) -> None:
        """Count units, or distribute them over the two grid points around their exposure."""
        if not self._spreads:
            self._units[events, exposure] += times
            return
        part = self.bets.most_exposure / _GRID_PARTS
        place = min(int(exposure / part), _GRID_PARTS - 1)
        upper = exposure / part - place  # above 1 by rounding only
        for point, share in ((place, 1.0 - upper), (place + 1, upper)):
            if share > 0:
                self._units[events, point * part] += share * times

    def extend(self, units: Iterable[tuple[float, float]]) -> None:
        """Add units, each given as (events, exposure)."""
        for events, exposure in units:
            self.add(events, exposure)

    @property
    def observed(self) -> float | None:
        """Events divided by exposure; None if there is no exposure."""
        return self.events / self.exposure if self.exposure > 0 else None

    def log_capitals(self, rate: float) -> NDArray[np.float64]:
        """Return the logarithm of the capital of each component that bets against a rate."""
        if self._as_arrays is None:
            units = np.array(list(self._units), float).reshape(-1, 2)
            self._as_arrays = units[:, 0], units[:, 1], np.array(list(self._units.values()), float)
        events, exposure, times = self._as_arrays
        found: NDArray[np.float64] = np.log1p(np.outer(self.bets.stakes(rate), events - rate * exposure)) @ times
        return found

    def log_evidence(self, rate: float) -> float:
        """Return the logarithm of the evidence against a rate."""
        return self.bets.log_evidence(self.log_capitals(rate))

    def interval(self, alpha: float = 0.05) -> Interval:
        """Return the rates with less evidence against them than 1 / alpha.

        The probability that the interval ever excludes the true rate, after any number of units, is at most `alpha`.
        """
        greatest = 1 / self.bets.most_exposure if self.bets.fixed_exposure else math.inf
        if self.exposure <= 0:
            return Interval(0.0, greatest)
        threshold = -math.log(alpha)
        observed = self.events / self.exposure
        low = self._crossing(observed, 0.5, threshold) if self.events > 0 else 0.0
        high = self._crossing(observed or 1e-3 / self.exposure, 2.0, threshold, greatest)
        return Interval(low, high)

    def _crossing(self, inside: float, factor: float, threshold: float, bound: float = math.inf) -> float:
        """Return the rate at which the evidence reaches a threshold, found by a search from a given rate outwards."""
        outside = inside * factor
        while self.log_evidence(min(outside, bound)) < threshold:
            if outside >= bound:
                return bound
            inside, outside = outside, outside * factor
        outside = min(outside, bound)
        while abs(outside - inside) > _PRECISION * outside:
            middle = math.sqrt(inside * outside)
            if self.log_evidence(middle) < threshold:
                inside = middle
            else:
                outside = middle
        return outside

    def verdict(self, bar: float, alpha: float = 0.05) -> BarVerdict:
        """Return ``below`` or ``above`` if the interval lies on one side of a threshold, else ``undecided``."""
        if self.exposure <= 0 or self.log_evidence(bar) < -math.log(alpha):
            return "undecided"
        return "below" if self.events < bar * self.exposure else "above"
