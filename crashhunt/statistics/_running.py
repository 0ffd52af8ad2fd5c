"""The rate of a running hunt: its certain interval after every trial, and the decision about a threshold.

Cost: constant for each trial. A new interval takes milliseconds, so it is computed only for display, and only in a
small share of the time.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from crashhunt.base.text import format_percent
from crashhunt.statistics._units import MAX_INVALID_SHARE, RateCounter, UnitSequence, facts_of, facts_of_plain

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.ledger import RunningRate, UntilRate
    from crashhunt.statistics._anytime_interval import Interval, RateTest
    from crashhunt.statistics._units import CountingRule, Per, TrialFacts, Unit
    from crashhunt.trial import TrialResult

WHY_NOT_UNTIL_RATE = "--until-rate ends the hunt by its crashes, so crashes by trials would be biased"
"""Why a hunt that is compared with a threshold has no estimate."""

_MAX_SHARE_OF_TIME = 0.05  # that running intervals may take
_LONGEST_PAUSE_S = 10.0  # the first interval takes long, because it imports SciPy
_MAX_FACTORS = 64  # per trial there are two different units
_EQUAL_TOLERANCE = (
    0.2  # relative difference from a bar that counts as none; it takes some 300 crashes to be certain of it
)

T = TypeVar("T")


class Paced(Generic[T]):
    """Caches a value that is expensive to compute, and computes it again only in a small share of the time.

    Args:
        make: function that computes the value.
    """

    def __init__(self, make: Callable[[], T]) -> None:
        self._make = make
        self._made: tuple[object, T] | None = None
        self._due = 0.0

    def __call__(self, version: object, *, now: bool = False) -> T:
        """Return the value, which may be out of date.

        Args:
            version: version of the data from which the value is computed.
            now: whether an outdated value is not sufficient.
        """
        began = time.monotonic()
        if self._made is not None and (self._made[0] == version or (began < self._due and not now)):
            return self._made[1]
        found = self._make()
        ended = time.monotonic()
        self._made = version, found
        self._due = ended + min((ended - began) / _MAX_SHARE_OF_TIME, _LONGEST_PAUSE_S)
        return found


class RateWatch:
    """Counts the trials of a running hunt, and returns the certain interval at any time.

    Args:
        rule: rule by which trials count.
        per: the unit of exposure to which the rate refers.
        crash_on: the outcomes that count as a crash.
        alpha: maximum probability that the interval ever excludes the rate.
    """

    def __init__(self, rule: CountingRule, per: Per, crash_on: Sequence[str], alpha: float = 0.05) -> None:
        self.rule, self.per, self.alpha = rule, per, alpha
        self._crash_on = crash_on
        self.sequence, self.counter = UnitSequence(rule), RateCounter(rule, per)
        self._paced: Paced[RunningRate] = Paced(self._running)

    def add(self, result: TrialResult | Mapping[str, Any]) -> None:
        """Add a finished trial, as a result or as data from a ledger; the order of trials does not matter."""
        make = facts_of_plain if isinstance(result, dict) else facts_of
        self.add_facts(make(result, self._crash_on))  # type: ignore[arg-type]

    def add_facts(self, trial: TrialFacts) -> None:
        """Add the facts of a finished trial."""
        for unit in self.sequence.add(trial):
            self._count(unit)

    def _count(self, unit: Unit) -> tuple[float, float] | None:
        """Count a unit; return its crashes and exposure, or None if it does not count."""
        return self.counter.add(unit)

    def interval(self) -> Interval | None:
        """Return the interval that is valid at any time; None if there is no unit, or if an exposure is unknown."""
        return self.counter.interval(self.alpha)

    def running(self, *, now: bool = False) -> RunningRate:
        """Return the current rate of the hunt.

        Args:
            now: whether the rate must be up to date; otherwise a rate some moments old is returned if computing a new
                rate takes too long.
        """
        sequence = self.sequence
        # A trial that waits for one of a lower number changes no count, but the reason why there is no rate.
        counted = sequence.valid + sequence.invalid + sequence.not_random + sequence.trained_on
        version = counted, sequence.excluded > 0
        return self._paced(version, now=now)

    def _running(self) -> RunningRate:
        counter, sequence = self.counter, self.sequence
        why = counter.why_not or ("" if counter.units else sequence.why_empty)
        if not why and sequence.invalid_share > MAX_INVALID_SHARE:
            why = f"{sequence.invalid} of {sequence.invalid + sequence.valid} trials are invalid"
        found = None if why else self.interval()
        high = None if found is None or not math.isfinite(found.high) else found.high
        rate: RunningRate = {
            "method": "plain",
            "per": self.per,
            "confidence": 100 * (1 - self.alpha),
            "units": counter.units,
            "trials": counter.trials,
            "crashes": counter.crashes,
            "origin": self.rule.plain_origin,
            "certain": None if found is None else {"low": found.low, "high": high},
            "estimate": None,
            "estimated": None,
            "why_not": why,
            "bar": None,
            "verdict": "",
        }
        if sequence.trained_on:
            rate["trained_on"] = sequence.trained_on
        return rate


class BarWatch(RateWatch):
    """Watches a hunt until its rate is certainly below or above a threshold, or until more trials are of no use.

    The evidence against the threshold is updated after each unit, at constant cost. After a decision, later units do
    not count. Decision, interval and estimate therefore do not depend on the number of workers.

    The watch ends undecided if the rate is certainly within 20 % of the threshold, because a rate equal to the
    threshold would never be decided. The watch also ends undecided if too many trials are invalid, or if trials have no
    exposure.

    Args:
        rule: rule by which trials count.
        bar: threshold with which the rate is compared.
        per: the unit of exposure to which the threshold refers.
        crash_on: the outcomes that count as a crash.
        alpha: maximum probability of a wrong decision.
    """

    def __init__(self, rule: CountingRule, bar: float, per: Per, crash_on: Sequence[str], alpha: float = 0.05) -> None:
        super().__init__(rule, per, crash_on, alpha)
        self.bar = bar
        # Against the bar, and against the ends of what counts as equal to it.
        self._rates = (bar, bar * (1 - _EQUAL_TOLERANCE), bar * (1 + _EQUAL_TOLERANCE))
        self._log_capitals: list[Any] = [0.0, 0.0, 0.0]
        self._log_factors: dict[tuple[float, float], list[Any]] = {}  # of the units so far
        self.verdict: Literal["below", "above", "undecided"] = "undecided"
        self.why_undecided = ""
        self.decided_at: int | None = None

    def add_facts(self, trial: TrialFacts) -> None:
        """Add the facts of a finished trial."""
        if self.decided_at is not None:
            return
        for unit in self.sequence.add(trial):
            if self.sequence.hopeless_at is None:
                self._count(unit)
            if self.decided_at is not None or self.sequence.hopeless_at is not None:
                break
        if self.decided_at is None and self.sequence.hopeless_at is not None:
            self.decided_at = self.sequence.hopeless_at
            self.why_undecided = "too many trials are invalid, so more of them do not help"

    def _count(self, unit: Unit) -> tuple[float, float] | None:
        found = super()._count(unit)
        test = self.counter.test
        if self.counter.why_not:
            self.decided_at, self.why_undecided = unit[-1].number, self.counter.why_not
        if found is None or test is None or self.counter.why_not:
            return found
        for place, factors in enumerate(self._factors(found, test)):
            self._log_capitals[place] = self._log_capitals[place] + factors
        if self.sequence.invalid_share > MAX_INVALID_SHARE:
            return found
        if self._rejects(0, test):
            self.verdict = "below" if test.events < self.bar * test.exposure else "above"
            self.decided_at = unit[-1].number
        elif self._is_at_bar(test):
            self.decided_at = unit[-1].number
            within = format_percent(_EQUAL_TOLERANCE)
            self.why_undecided = f"the rate certainly is within {within} of the bar, so more trials do not help"
        return found

    def _factors(self, found: tuple[float, float], test: RateTest) -> list[Any]:
        """Return the logarithms by which a unit multiplies the capitals, for the threshold and its two bounds."""
        import numpy as np

        factors = self._log_factors.get(found)
        if factors is None:
            events, exposure = found
            factors = [np.log1p(test.bets.stakes(rate) * (events - rate * exposure)) for rate in self._rates]
            if len(self._log_factors) < _MAX_FACTORS:
                self._log_factors[found] = factors
        return factors

    def _rejects(self, place: int, test: RateTest) -> bool:
        return test.bets.log_evidence(self._log_capitals[place]) >= -math.log(self.alpha)

    def _is_at_bar(self, test: RateTest) -> bool:
        _, low, high = self._rates
        if not low * test.exposure < test.events < high * test.exposure:
            return False
        is_below = high >= 1 and self.per == "trial"  # no rate per trial is greater
        return self._rejects(1, test) and (is_below or self._rejects(2, test))

    def noted(self) -> UntilRate:
        """Return the facts that the ledger records about the comparison."""
        return {"bar": f"{self.bar!r}/{self.per}", "decided_at": self.decided_at, "verdict": self.verdict}

    def _running(self) -> RunningRate:
        found = super()._running()
        found["bar"], found["verdict"] = self.bar, self.verdict
        return found
