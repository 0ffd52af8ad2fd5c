"""The rate of a running hunt: the trials that count, its certain interval, the decision about a bar, and rare mode.

Cost: constant for each trial. A new interval takes milliseconds, so it is computed only for display, and only in a
small share of the time. A resumed hunt reads the number and the outcome of each earlier trial once.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.base.errors import UsageError
from crashhunt.base.pacing import Paced
from crashhunt.base.text import format_percent
from crashhunt.disturbances import first_forcing
from crashhunt.plans import rate_of, share_of
from crashhunt.results import CodeVersions
from crashhunt.statistics._counted_trials import (
    MAX_INVALID_SHARE,
    CountingRule,
    RateCounter,
    TrialFacts,
    UnitSequence,
    facts_of_plain,
)
from crashhunt.statistics._rare import BLOCK, TRIALS_PER_ROOT, RareCounter, is_root, learn_forcing, root_of, with_plain
from crashhunt.statistics._rate_report import make_rate
from crashhunt.trial import Forcing, Outcome

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.ledger import Facts, Ledger, RunningRate, UntilRate
    from crashhunt.plans import HuntSettings
    from crashhunt.statistics._anytime_interval import Interval, RateTest
    from crashhunt.statistics._counted_trials import Per, Unit
    from crashhunt.statistics._rare import RareEstimate
    from crashhunt.statistics._rate_report import CrashRate
    from crashhunt.training import HeldOutTraffics
    from crashhunt.trial import Forced, ForcedCopy, TrialResult


WHY_NOT_UNTIL_RATE = "--until-rate ends the hunt by its crashes, so crashes by trials would be biased"
"""Why a hunt that is compared with a threshold has no estimate."""

_LONGEST_PAUSE_S = 10.0  # the first interval takes long, because it imports SciPy
_MAX_FACTORS = 64  # per trial there are two different units
_EQUAL_TOLERANCE = (
    0.2  # relative difference from a bar that counts as none; it takes some 300 crashes to be certain of it
)


class RateWatch:
    """Counts the trials of a running hunt, and returns the certain interval at any time.

    ``alpha`` is the maximum probability that the interval ever excludes the rate.
    """

    def __init__(self, rule: CountingRule, per: Per, crash_on: Sequence[str], alpha: float = 0.05) -> None:
        self.rule, self.per, self.alpha = rule, per, alpha
        self._crash_on = crash_on
        self.sequence, self.counter = UnitSequence(rule), RateCounter(rule, per)
        self._paced: Paced[RunningRate] = Paced(_LONGEST_PAUSE_S)

    def add(self, result: TrialResult | Mapping[str, Any]) -> None:
        """Add a finished trial, as a result or as data from a ledger; the order of trials does not matter."""
        data = result if isinstance(result, dict) else result.to_json()  # type: ignore[union-attr]
        self.add_facts(facts_of_plain(data, self._crash_on))

    def add_facts(self, trial: TrialFacts) -> None:
        """Add the facts of a finished trial."""
        for unit in self.sequence.add(trial):
            self.counter.add(unit)

    def interval(self) -> Interval | None:
        """Return the interval that is valid at any time; None if there is no unit, or if an exposure is unknown."""
        return self.counter.interval(self.alpha)

    def running(self, *, now: bool = False) -> RunningRate:
        """Return the current rate of the hunt.

        Unless ``now``, a rate some moments old is returned if computing a new rate takes too long.
        """
        sequence = self.sequence
        # A trial that waits for one of a lower number changes no count, but the reason why there is no rate.
        counted = sequence.valid + sequence.invalid + sequence.not_random + sequence.trained_on
        version = counted, sequence.excluded > 0
        return self._paced(version, self._running, now=now)

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
    exposure. ``alpha`` is the maximum probability of a wrong decision.
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

    def _count(self, unit: Unit) -> None:
        found, test = self.counter.add(unit), self.counter.test
        if self.counter.why_not:
            self.decided_at, self.why_undecided = unit[-1].number, self.counter.why_not
        if found is None or test is None or self.counter.why_not:
            return
        for place, factors in enumerate(self._factors(found, test)):
            self._log_capitals[place] = self._log_capitals[place] + factors
        if self.sequence.invalid_share > MAX_INVALID_SHARE:
            return
        if self._rejects(0, test):
            self.verdict = "below" if test.events < self.bar * test.exposure else "above"
            self.decided_at = unit[-1].number
        elif self._is_at_bar(test):
            self.decided_at = unit[-1].number
            within = format_percent(_EQUAL_TOLERANCE)
            self.why_undecided = f"the rate certainly is within {within} of the bar, so more trials do not help"

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


# The trials that count, and the watches of a hunt that runs.


def counting_rule(settings: HuntSettings, facts: Facts, held_out: HeldOutTraffics | None = None) -> CountingRule:
    """Return the rule by which the trials of a hunt count.

    ``held_out`` is None if the caller excludes the traffic on which agents were trained.
    """
    independent = bool(facts.get("independent", settings.sampler == "random"))
    origin = "" if independent or settings.seeds else facts.get("plain_origin") or ""
    return CountingRule(
        max_steps=settings.max_steps,
        agents=max(1, len(settings.agents)),
        plain_origin=origin,
        traffics=settings.seeds,
        planned=settings.trials,
        is_held_out=held_out.has if held_out is not None and held_out.records else None,
        first=CodeVersions.of(facts).first,
    )


def refuse_training_traffic(settings: HuntSettings, held_out: HeldOutTraffics) -> None:
    """Refuse a hunt that ends with a rate, if the training of its agents makes such a rate impossible.

    Raises:
        UsageError: an agent was trained on the traffic of the hunt.
    """
    fix = "give another --seed"
    if settings.rare and any(settings.seed in record.hunt_seeds for record in held_out.records):
        raise UsageError(f"--rare: an agent was trained on traffics of --seed {settings.seed}", fix=fix)
    if settings.run.until_rate and held_out.is_empty:
        raise UsageError(f"--until-rate: an agent was trained on all traffics of --seed {settings.seed}", fix=fix)


def why_no_interval(settings: HuntSettings, facts: Facts) -> str:
    """Return the reason why the trials of a hunt give no rate; empty if they give a rate."""
    if settings.rare:
        return "in rare mode, one of five trials runs without disturbances; crashhunt status reports the rate"
    if settings.seeds:
        if settings.sampler != "random":
            return f"the sampler {settings.sampler} does not draw trials independently"
        if settings.trials < settings.seeds:
            return "no number of trials was fixed ahead for each traffic (--seeds): TRIALS must be at least --seeds"
        if facts.get("replanned"):
            return "TRIALS was changed after results were known, and with --seeds it decides what counts as a unit"
        return ""
    if facts.get("independent", settings.sampler == "random") or facts.get("plain_origin"):
        return ""
    return f"the sampler {settings.sampler} does not draw trials independently"


def bar_watch(settings: HuntSettings, ledger: Ledger, held_out: HeldOutTraffics, first: int = 0) -> BarWatch | None:
    """Return an object that compares the rate with the threshold, with earlier trials added; None without threshold."""
    if not settings.run.until_rate:
        return None
    bar, per = rate_of(settings.run.until_rate)
    rule = replace(counting_rule(settings, {"independent": True}, held_out), first=first)
    watch = BarWatch(rule, bar, per, settings.crash_on)
    for data in ledger.plain_results():
        watch.add(data)
    return watch


def rate_of_bar(directory: Path, watch: BarWatch | None) -> CrashRate | None:
    """Return the final crash rate of a hunt that compares its rate with a threshold; None without a threshold."""
    if watch is None:
        return None
    found = make_rate(
        str(directory), watch.per, watch.counter, watch.sequence, confidence=100 * (1 - watch.alpha),
        why_no_estimate=WHY_NOT_UNTIL_RATE, bar=watch.bar,
    )  # fmt: skip
    excluded = found.excluded
    if watch.decided_at is not None:  # which later trials have ended depends on the workers
        excluded = {reason: count for reason, count in excluded.items() if reason != "after_unfinished"}
    return replace(found, excluded=excluded, verdict=watch.verdict, why_undecided=watch.why_undecided)


def rate_watch(settings: HuntSettings, ledger: Ledger, held_out: HeldOutTraffics) -> RateWatch | None:
    """Return an object that computes the rate per trial, with earlier trials added; None if there is no rate."""
    facts = ledger.facts()
    if why_no_interval(settings, facts):
        return None
    watch = RateWatch(counting_rule(settings, facts, held_out), "trial", settings.crash_on)
    for number, seed, outcome, origin, was_killed in ledger.endings():
        trial = TrialFacts(
            number=number,
            has_ended=not was_killed,
            valid=outcome != Outcome.INVALID,
            crashed=outcome in settings.crash_on,
            origin=origin,
            seed=seed,
        )
        watch.add_facts(trial)
    return watch


# Rare mode of a hunt: every fifth trial is a root, whose copies have forced first onsets; the others are plain trials.
#
# The forcing of a root depends on its number and on the results of earlier blocks alone. So the roots are the same with
# any number of workers, and after the hunt was killed and resumed.
#
# ``--until-error`` ends the hunt at the first full block at which the interval is narrow enough. Roots above that block
# may have ended by then. They do not count, because that they have ended depends on the number of workers.

_MAX_VERIFIED_ROOTS = 5  # roots; a crash of a copy is a crash only where it comes again from the start


class Forcings:
    """Chooses the forcing of each root, from the results of the blocks of roots before the previous block."""

    def __init__(self, settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler) -> None:
        self._ledger = ledger
        self._start = first_forcing(sampler, settings.max_steps)
        self._earlier: list[Forced] = []
        self._known = 0  # trials that the earlier results are of
        self._current = self._start

    @staticmethod
    def needed(number: int) -> int:
        """Return the number of trials, from number 0 on, that must have ended before the given trial begins."""
        if not is_root(number):
            return 0
        return max(0, number // TRIALS_PER_ROOT // BLOCK - 1) * BLOCK * TRIALS_PER_ROOT

    def of(self, number: int) -> Forcing | None:
        """Return the forcing of a root; None for a plain trial. Call this method in the order of trial numbers."""
        if not is_root(number):
            return None
        needed = self.needed(number)
        if self._known < needed:
            for earlier in range(self._known, needed, TRIALS_PER_ROOT):
                result = self._ledger.result(earlier)
                if result is not None and result.forced is not None and not result.forced.unanswered:
                    self._earlier.append(result.forced)
            self._known = needed
            self._current = learn_forcing(self._earlier, self._start)
        return self._current


class RareWatch:
    """Reads trials in the order of their numbers, and finds the block after which the hunt may end.

    A root counts after its plain trials have ended as well.
    """

    def __init__(self, settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler) -> None:
        # the greatest weights of roots with a crashed copy, in descending order
        self.weightiest: list[TrialResult] = []
        self.is_met = False  # whether the interval is narrow enough; no further trial is then read
        self.is_replanned = False  # whether TRIALS was changed after results were known
        self._settings, self._ledger = settings, ledger
        self._hazard = len(sampler.agents) * math.fsum(sampler.chance(name) for name in sampler.models)
        self._counter = RareCounter(min(1.0, self._hazard * settings.max_steps))
        self._until = share_of(settings.run.until_error) if settings.run.until_error else 0.0
        self._read = 0  # trials
        self._group: list[TrialResult] = []  # the last root that was read, and its plain trials
        self._paced: Paced[RunningRate] = Paced(_LONGEST_PAUSE_S)

    @property
    def roots(self) -> int:
        """The number of roots that were read together with their plain trials."""
        return self._counter.roots + self._counter.excluded

    def read(self, finished: int | None = None) -> None:
        """Read the finished trials, up to the first trial that has not finished.

        By default, the number of finished trials is read from the ledger.
        """
        while not self.is_met and (finished is None or self._read < finished):
            result = self._ledger.result(self._read)
            if result is None:
                return
            self._read += 1
            self._group.append(result)
            if self._read % TRIALS_PER_ROOT == 0:
                self._count(*self._group)
                self._group.clear()

    def _count(self, first: TrialResult, *plain: TrialResult) -> None:
        root = root_of(first, self._settings.crash_on, self._hazard)
        if root is None:
            valid = [one for one in plain if one.outcome is not Outcome.INVALID]
            crashed = [one.outcome in self._settings.crash_on for one in valid]
            self._counter.add(None, crashed, len(plain) - len(valid))
        else:
            self._counter.add(with_plain(root, plain, self._settings.crash_on))
            if any(crashed_copies(first)):
                self.weightiest.append(first)
                self.weightiest.sort(key=greatest_weight, reverse=True)
                del self.weightiest[_MAX_VERIFIED_ROOTS:]
        if self._until and self.roots % BLOCK == 0:
            self.is_met = self.estimate().relative_error <= self._until

    def estimate(self) -> RareEstimate:
        """Return the estimate from the trials that were read.

        If TRIALS was changed after results were known, it may have been changed because of a crash. An interval needs
        many crashes, so only an estimate with an interval remains.
        """
        found = self._counter.estimate()
        if not found.estimate or found.estimated is not None or not self.is_replanned:
            return found
        return replace(
            found, estimate=None, why_not=f"TRIALS was changed after results were known, and {found.why_not}"
        )

    def running(self, *, now: bool = False) -> RunningRate:
        """Return the current crash rate.

        Unless ``now``, the rate may be some moments old.
        """
        return self._paced(self._read // TRIALS_PER_ROOT, lambda: self.estimate().running(), now=now)


def forcings_of(settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler | None) -> Forcings | None:
    """Return the object that determines the forcing of roots; None if the hunt is not in rare mode."""
    if not settings.rare:
        return None
    assert sampler is not None
    return Forcings(settings, ledger, sampler)


def rare_watch(settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler | None) -> RareWatch | None:
    """Return the object that estimates the crash rate; None if the hunt is not in rare mode."""
    if not settings.rare:
        return None
    assert sampler is not None
    watch = RareWatch(settings, ledger, sampler)
    watch.is_replanned = bool(ledger.facts().get("replanned"))
    return watch


def crashed_copies(result: TrialResult) -> Iterator[ForcedCopy]:
    """Return the copies of a root that crashed."""
    return (copy for copy in result.forced.copies if copy.crash) if result.forced is not None else iter(())


def greatest_weight(result: TrialResult) -> float:
    """Return the greatest weight among the crashed copies of a root with at least one crashed copy."""
    return max(copy.weight for copy in crashed_copies(result))
