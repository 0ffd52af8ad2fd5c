"""Estimator of rare crashes: the crash probability from root trials and forks with a forced first disturbance.

A root is a trial from which copies are forked. In every copy, the first disturbance is forced to begin (its *onset*) at
a drawn step. The value of a root is the sum of the weighted crashes of its copies. If the root itself crashes, the
probability that no disturbance begins is added. The values are independent, given the allocation of copies, and
unbiased (see `crashhunt.disturbances.FirstOnsets`). The estimate is the mean of the values. Crashes affected by a
disturbance and other crashes are summed separately.

Plain trials: each root is followed by four trials that are drawn as ``run`` without ``--rare`` draws them. Together
they take about as many steps as the root and its copies. The number of a trial determines whether it is a root. Plain
trials have two purposes. First, copies give no additional information on undisturbed crashes, so the undisturbed part
of a root's value is the mean over the root and its plain trials. Second, plain trials bound the probability of crashes
that no copy has met.

Learning: the forcing of a block of 32 roots depends only on the blocks before the previous block. The forcing is
therefore independent of the number of workers, and no worker waits for the end of a block. The proposal distribution
consists of two parts. Of the probability, 10 % is the law of the disturbances, and 90 % is this law times the square
root of each cell's smoothed crash share. This proposal minimizes the variance for independent copies of equal cost; the
10 % bound all weights.

The estimated interval combines two parts. Undisturbed crashes of roots and plain trials are counted, so their share has
Clopper and Pearson's interval, which is valid for any number of crashes. The part with weights has Student's t interval
with Hall's correction for skewness. Few roots have large values, so without the correction the interval would too often
be too low. The estimated interval is reported only under two conditions. The effective sample size and the number of
roots with a crash are at least 20, and no root contributes more than 20 % of the sum. The distances of both intervals
from their estimates are added as squares. No interval from weighted copies can exclude a failure mode that no copy has
met. The estimated interval does not include undisturbed crashes before the first undisturbed crash occurs.

The certain interval covers such failure modes as well. The certain interval comes from
`_anytime_interval`, so it is valid at any number of roots. A plain trial is a unit with 0 or 1 crashes
and exposure 1. A root is a unit with the value V, which is at most B. The forcing fixes B before the root begins. V / B
therefore counts as events and 1 / B as exposure, and the ratio of their means is the rate. A root without a crash
counts as 1 / B of a trial. The lower end has a second source, the copies alone. The value of the copies is bounded by
their weights, so the bound is far below 1 if disturbances are rare. The crash probability in the copies is a part of
the whole crash probability, so its lower bound is also a lower bound of the whole. By Bonferroni's inequality, both
intervals together have the given confidence. The first interval has three quarters of the error probability, the second
a quarter.

Sources: Owen, Monte Carlo theory, methods and examples, 2013, chapters 8 to 9, for the estimator. Kish, Survey
sampling, 1965, for the effective sample size. Hall, On the removal of skewness by transformation, JRSS B 54(1), 1992,
and Clopper and Pearson, Biometrika 26(4), 1934, for the intervals. Zou and Donner, Construction of confidence limits
about effect measures, Statistics in Medicine 27(10), 2008, for the sum of two parts.

Cost: constant for each root. The certain interval takes milliseconds for each hundred roots with different values.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from crashhunt.base.codec import JsonObject, Serializable, plain
from crashhunt.base.text import format_number, format_percent
from crashhunt.disturbances import COPIES_PER_ROOT, SECONDS_PER_COPY
from crashhunt.statistics._anytime_interval import Bets, Interval, RateTest
from crashhunt.statistics._counted_trials import why_too_many_invalid
from crashhunt.trial import Forcing, Outcome

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from crashhunt.ledger import RunningRate
    from crashhunt.trial import Forced, TrialResult

BLOCK: Final = 32
"""Roots with the same forcing."""
PLAIN_PER_ROOT: Final = 4
TRIALS_PER_ROOT: Final = 1 + PLAIN_PER_ROOT
"""A root, and the plain trials after it."""
PLAIN_SHARE: Final = 0.1
"""Share of the proposal that is the law itself: no weight is above 10 times that of the law."""
_PRIOR_COPIES: Final = 4.0  # weight of the common crash share in that of a cell
MAX_SHARE_UNFORCED: Final = 0.05
"""Share of the crashes that may come after a second onset which is not forced. Such crashes are few with large weights,
so an estimate that has not met one is too low by this share, and looks precise."""
_PILOT_ROOTS: Final = 128  # after so many without such a cell, no copy has forced second onsets any more
_MAX_SECONDS_FACTOR: Final = 8  # times as many as the first forcing would have: a copy may be long, and others short
MIN_EFFECTIVE: Final = 20.0
MIN_ROOTS_WITH_CRASH: Final = 20
MAX_SHARE: Final = 0.2
_RISK_OF_COPIES: Final = 0.25  # share of the risk that the certain lower end by copies alone takes
_RUNNING_KEYS: Final = ("origin", "bar", "verdict")  # which an estimate does not have
MAX_EXCLUDED: Final = 0.05
"""Share of roots without a complete result above which nothing is estimated."""


@dataclass(frozen=True, slots=True)
class Root:
    """The estimates from one root, which is a trial from which copies were forked."""

    undisturbed: float  # estimate of the probability of a crash on which no disturbance had an effect
    disturbed: float  # estimate of the probability of all other crashes
    counted: float = 0.0  # the part of ``undisturbed`` that is a share of trials and contains no copies
    own: float = 0.0  # the part of the sum of both estimates that comes from the root itself, from 0 to 1
    # the part of ``disturbed`` that comes from copies, by cell (a model of disturbances with one strength)
    by: Mapping[str, float] = field(default_factory=dict)
    steps: int = 0  # number of simulated steps of the root and its copies
    own_steps: int = 0  # number of simulated steps of the root itself
    bound: float = math.inf  # upper bound of the part that comes from copies, known before the root begins
    crashed: bool = False  # whether the root itself crashed undisturbed
    copies: float = 0.0  # the part of the estimates that comes from copies, from 0 to `bound`
    plain: int = 0  # number of valid plain trials after the root
    invalid: int = 0  # number of invalid plain trials after the root, which do not count
    plain_crashes: int = 0  # number of valid plain trials after the root that crashed
    plain_undisturbed: int = 0  # number of valid plain trials after the root that crashed undisturbed
    plain_steps: int = 0  # number of simulated steps of the valid plain trials after the root

    @property
    def value(self) -> float:
        """The root's estimate of the crash probability."""
        return self.undisturbed + self.disturbed


@dataclass(frozen=True, slots=True)
class Estimated(Serializable):
    """An estimated interval, and the figures that show its reliability."""

    low: float  # lower end of the interval
    high: float  # upper end of the interval
    effective: float  # effective sample size of the weighted part of the estimate, as a number of roots
    largest_share: float  # share of the root with the greatest value in the sum of the weighted part, 0 to 1
    roots_with_crash: int  # number of roots with a value above 0 in the weighted part


@dataclass(frozen=True, slots=True)
class RareEstimate:
    """The crash probability per trial, estimated from roots and their copies."""

    roots: int  # number of roots
    estimate: float | None  # estimated crash probability per trial, from 0 to 1; None if there is no root
    undisturbed: float  # the part of the estimate from crashes on which no disturbance had an effect
    disturbed: float  # the part of the estimate from all other crashes
    estimated: Estimated | None  # interval of ``estimate``; None if the roots do not allow an interval
    estimated_disturbed: Estimated | None  # interval of ``disturbed``; None if the roots do not allow an interval
    why_not: str  # reason why ``estimate`` has no interval; empty if it has an interval
    why_not_disturbed: str  # reason why ``disturbed`` has no interval; empty if it has an interval
    # number of further roots that ``estimated`` probably needs; None if that cannot be predicted
    more_roots: int | None
    # interval that is valid even for crashes that no copy has met; None if it was not requested
    certain: tuple[float, float] | None
    excluded: int  # number of roots without a complete result
    parts: Mapping[str, float]  # the part of ``disturbed`` for each cell, to which the first disturbance belongs
    undisturbed_crashes: int  # number of roots and plain trials that crashed undisturbed
    plain: int  # number of plain trials that count
    plain_crashes: int  # number of plain trials that crashed
    steps: int  # number of simulated steps
    plain_steps: int  # number of simulated steps of plain trials
    # number of steps that plain trials would need for the same standard error. None if there is no standard error, or
    # if the estimate is 1.
    plain_equivalent_steps: float | None
    confidence: float  # confidence of all intervals, in (0, 1)

    @property
    def relative_error(self) -> float:
        """Half the width of the estimated interval, divided by the estimate; infinite without an interval."""
        if self.estimated is None or not self.estimate:
            return math.inf
        return (self.estimated.high - self.estimated.low) / 2 / self.estimate

    def to_json(self) -> JsonObject:
        """Return the estimate as JSON-compatible data without NaN."""
        shared = {key: value for key, value in self.running().items() if key not in _RUNNING_KEYS}
        return {
            **shared,
            "estimated": plain(self.estimated),
            "more_roots": self.more_roots,
            "left_out": self.excluded,
            "parts": {
                "undisturbed": {"estimate": self.undisturbed, "crashes": self.undisturbed_crashes},
                "disturbed": {
                    "estimate": self.disturbed,
                    "estimated": plain(self.estimated_disturbed),
                    "why_not": self.why_not_disturbed,
                    "by": dict(self.parts),
                },
            },
            "steps": self.steps,
            "plain_steps": self.plain_steps,
            "plain_equivalent_steps": self.plain_equivalent_steps,
        }

    def running(self) -> RunningRate:
        """Return the rate in the form that ``status`` reports."""
        one = self.estimated
        return {
            "method": "rare",
            "per": "trial",
            "confidence": 100 * self.confidence,
            "units": self.roots,
            "trials": self.plain,
            "crashes": self.plain_crashes,
            "origin": "",
            "certain": None if self.certain is None else {"low": self.certain[0], "high": self.certain[1]},
            "estimate": self.estimate,
            "estimated": None if one is None else {"low": one.low, "high": one.high},
            "why_not": self.why_not,
            "bar": None,
            "verdict": "",
        }


def is_root(number: int) -> bool:
    """Return whether a trial in rare mode is a root; all other trials are plain trials."""
    return number % TRIALS_PER_ROOT == 0


def with_plain(root: Root, trials: Iterable[TrialResult], crash_on: Sequence[Outcome]) -> Root:
    """Return a root, combined with the plain trials that follow it.

    Invalid trials do not count.
    """
    trials = list(trials)
    valid = [trial for trial in trials if trial.outcome is not Outcome.INVALID]
    crashed = [trial for trial in valid if trial.outcome in crash_on]
    undisturbed = sum(not trial.disturbed for trial in crashed)
    return replace(
        root,
        undisturbed=(root.undisturbed + undisturbed) / (1 + len(valid)),
        counted=(root.counted + undisturbed) / (1 + len(valid)),
        plain=len(valid),
        invalid=len(trials) - len(valid),
        plain_crashes=len(crashed),
        plain_undisturbed=undisturbed,
        plain_steps=sum(trial.steps + (trial.setup_steps or 0) for trial in valid),
    )


def root_of(result: TrialResult, crash_on: Sequence[Outcome], hazard: float) -> Root | None:
    """Return the estimates from a root; None if the root has no complete result.

    ``hazard`` is the sum of the start probabilities of disturbances per step, over all models and agents.
    """
    forced = result.forced
    if forced is None or forced.unanswered or result.outcome is Outcome.INVALID or result.spec.forcing is None:
        return None
    crashed = result.outcome in crash_on
    own = forced.survival if crashed else 0.0
    undisturbed, disturbed = (0.0, own) if result.disturbed else (own, 0.0)
    by: defaultdict[str, float] = defaultdict(float)
    copies = 0.0
    for copy in forced.copies:
        if copy.crash and copy.disturbed:
            disturbed += copy.weight
            by[copy.cell] += copy.weight
        elif copy.crash:
            undisturbed += copy.weight
        copies += copy.weight if copy.crash else 0.0
    return Root(
        undisturbed=undisturbed,
        disturbed=disturbed,
        counted=0.0 if result.disturbed else own,
        own=own,
        by=by,
        steps=result.steps + result.other_steps,
        own_steps=result.steps + (result.setup_steps or 0),
        bound=_bound(result.spec.forcing, hazard * result.spec.max_steps),
        crashed=crashed and not result.disturbed,
        copies=copies,
    )


def _bound(forcing: Forcing, hazard: float) -> float:
    """Return an upper bound of the sum of the weights of a root's copies.

    Args:
        forcing: forcing of the root's disturbances.
        hazard: sum of all start probabilities in a trial, an upper bound of the probability that any disturbance
            begins.
    """
    ratios = (1.0, *forcing.ratios.values())
    most_proposed = min(1.0, hazard) * max(ratios)
    # The probabilities of no second onset and of all second onsets have the sum 1, and one more may be forced.
    most_within = 1.0 + forcing.second_spacing
    return (most_proposed + forcing.spacing) / min(ratios) * most_within


def learn_forcing(earlier: Iterable[Forced], start: Forcing) -> Forcing:
    """Return the forcing of disturbances that minimizes the variance according to earlier roots.

    ``start`` is the forcing of the first roots. It stays as long as earlier roots have no crashes.
    """
    learned = _Learned()
    roots = 0
    for one in earlier:
        roots += 1
        learned.add(one)
    masses = learned.masses
    total = math.fsum(masses.values())
    if not roots or total <= 0.0:
        return start
    common = (math.fsum(learned.squares.values()) + 0.5) / (learned.copies.total() + 1.0)
    spreads = {
        cell: math.sqrt((learned.squares[cell] + _PRIOR_COPIES * common) / (learned.copies[cell] + _PRIOR_COPIES))
        for cell in sorted(masses)
    }
    mean = math.fsum(masses[cell] / total * spread for cell, spread in spreads.items())
    ratios = {cell: PLAIN_SHARE + (1.0 - PLAIN_SHARE) * spread / mean for cell, spread in spreads.items()}
    second = learned.cells_with_seconds()
    least = start.second_spacing / _MAX_SECONDS_FACTOR
    second_spacing = max(least, learned.second_mass / SECONDS_PER_COPY) if learned.second_mass else start.second_spacing
    if not second and roots >= _PILOT_ROOTS:
        second_spacing = 0.0
    return Forcing(total / roots / COPIES_PER_ROOT, ratios, second=second, second_spacing=second_spacing)


class _Learned:
    """The statistics of the copies of earlier roots, by the cell of their first disturbance."""

    def __init__(self) -> None:
        self.masses: Counter[str] = Counter()  # probability of the first disturbance, summed over roots
        self.copies: Counter[str] = Counter()  # number of copies of earlier roots
        # sum of the squared crash probabilities that the copies estimate. Each probability is conditional on the first
        # disturbance, and is estimated from one copy and the copies forked from this copy.
        self.squares: defaultdict[str, float] = defaultdict(float)
        self._values: defaultdict[str, float] = defaultdict(float)
        # Of copies that could have a second onset, and on which these were forced: their number, and the crash
        # probability after a second onset.
        self._forced: Counter[str] = Counter()
        self._greatest: defaultdict[str, float] = defaultdict(float)  # probability that one second onset represents
        self._after_second: defaultdict[str, float] = defaultdict(float)
        self._mass = 0.0

    def add(self, one: Forced) -> None:
        """Add the copies of a root to the statistics."""
        self.masses.update(one.masses)
        for first, *seconds in one.by_first_onset():
            cell, alone = first.cell, first.within if first.crash else 0.0
            after_second = math.fsum(copy.within for copy in seconds if copy.crash)
            self.copies[cell] += 1
            self._values[cell] += alone + after_second
            self.squares[cell] += (alone + after_second) ** 2
            if first.within < 1.0:
                self._forced[cell] += 1
                self._mass += 1.0 - first.within
                self._after_second[cell] += after_second
                self._greatest[cell] = max(self._greatest[cell], *(copy.within for copy in seconds), 0.0)

    @property
    def second_mass(self) -> float:
        """Return the mean probability that a second disturbance begins after the first; 0 if none was forced."""
        return self._mass / self._forced.total() if self._forced else 0.0

    def cells_with_seconds(self) -> tuple[str, ...]:
        """Return the cells whose copies get further copies with a forced second disturbance.

        The other cells together have few crashes after a second disturbance, even if one additional crash is counted
        for each cell. As long as no copy has crashed, all known cells are returned.
        """
        total = math.fsum(self.masses[cell] * self._values[cell] / count for cell, count in self.copies.items())
        after = {
            cell: self.masses[cell] * (self._after_second[cell] + self._greatest[cell]) / count
            for cell, count in self._forced.items()
        }
        unforced, found = 0.0, set(after)
        for cell in sorted(after, key=lambda cell: (after[cell], cell)):
            unforced += after[cell]
            if not total or unforced > MAX_SHARE_UNFORCED * total:
                break
            found.remove(cell)
        return tuple(sorted(found))


class RareCounter:
    """Counts roots with their plain trials, and returns the estimate at any time.

    Args:
        least_bound: lower limit of every `Root.bound`, fixed before the first root; None for no certain interval.
        confidence: confidence of all intervals, in (0, 1).
    """

    def __init__(self, least_bound: float | None = None, confidence: float = 0.95) -> None:
        self.confidence = confidence
        self.excluded = 0
        self.roots = 0
        self._whole, self._weighted, self._disturbed = _Sums(), _Sums(), _Sums()
        self._undisturbed = self._counted = 0.0
        self._trials = 0  # in which undisturbed crashes are counted
        self._parts: defaultdict[str, float] = defaultdict(float)
        self._counts: Counter[str] = Counter()
        self._tests = None
        if least_bound is not None:
            self._tests = RateTest(), RateTest(Bets(1.0, 1.0 / least_bound, fixed_exposure=False))

    def add(self, root: Root | None, plain: Iterable[bool] = (), invalid: int = 0) -> None:
        """Add the estimates from a root.

        Args:
            root: root with its plain trials; None if the root has no complete result.
            plain: for a root without a complete result, whether each valid plain trial after it crashed; they count for
                the certain interval.
            invalid: for a root without a complete result, number of invalid plain trials after it.
        """
        if root is None:
            self.excluded += 1
            self._counts["invalid"] += invalid
            self._add_plain(list(plain))
            return
        self.roots += 1
        self._whole.add(root.value)
        self._weighted.add(root.undisturbed - root.counted + root.disturbed)
        self._counted += root.counted
        self._trials += 1 + root.plain
        self._disturbed.add(root.disturbed)
        self._undisturbed += root.undisturbed
        for cell, weight in root.by.items():
            self._parts[cell] += weight
        self._counts.update(
            invalid=root.invalid,
            undisturbed=root.crashed + root.plain_undisturbed,
            steps=root.steps + root.plain_steps,
            plain_steps=root.plain_steps,
            own_steps=root.own_steps,
        )
        if self._tests is not None:
            whole, copies = self._tests
            bound = 1.0 + root.bound
            whole.add((root.own + root.copies) / bound, 1.0 / bound)
            if root.bound:
                copies.add(root.copies / root.bound, 1.0 / root.bound)
        self._add_plain([True] * root.plain_crashes + [False] * (root.plain - root.plain_crashes))

    def _add_plain(self, crashed: Sequence[bool]) -> None:
        self._counts.update(plain=len(crashed), plain_crashes=sum(crashed))
        if self._tests is not None:
            for one in crashed:
                self._tests[0].add(float(one))

    def certain(self) -> tuple[float, float] | None:
        """Return an interval that is valid at any time; None if it was not requested, or if no trial counts."""
        if self._tests is None or not self._tests[0].count:
            return None
        alpha = 1.0 - self.confidence
        whole, copies = self._tests
        found: Interval = whole.interval(alpha * (1.0 - _RISK_OF_COPIES))
        low = max(found.low, copies.interval(alpha * _RISK_OF_COPIES).low) if copies.events else found.low
        return min(low, found.high), found.high

    def estimate(self) -> RareEstimate:
        """Return the crash probability per trial with its intervals."""
        count, counts = self.roots, self._counts
        estimate = self._whole.total / count if count else None
        certain = self.certain()
        why = why_too_many_invalid(counts["invalid"], counts["plain"], "plain trials are invalid")
        if self.excluded > MAX_EXCLUDED * (count + self.excluded):
            why = f"{self.excluded} of {count + self.excluded} roots have no complete result"
            why += f" (allowed: {format_percent(MAX_EXCLUDED)})"
        certain = None if why else certain
        whole, why_not, more = self._interval()
        part, why_not_part, _ = self._disturbed.interval(count, self.confidence)
        if not why and whole is not None and certain is not None and certain[0] > whole.high:
            # Certain bounds rest on less. Where the two exclude each other, the copies have missed something.
            within = f"{format_number(whole.low)} to {format_number(whole.high)}"
            why_not = f"plain trials crash more often than the copies explain ({within})"
            whole = part = None
            why_not_part = why_not
        whole, part = _at_most_1(whole), _at_most_1(part)
        plain_steps = None
        if estimate and estimate < 1.0 and count > 1 and (spread := self._whole.standard_error(count)) > 0:
            plain_steps = estimate * (1.0 - estimate) / spread**2 * counts["own_steps"] / count
        parts = {cell: part / count for cell, part in self._parts.items()}
        return RareEstimate(
            roots=count,
            estimate=None if why or estimate is None else min(1.0, estimate),
            undisturbed=min(1.0, self._undisturbed / count) if count else 0.0,
            disturbed=min(1.0, self._disturbed.total / count) if count else 0.0,
            estimated=None if why else whole,
            estimated_disturbed=None if why else part,
            why_not=why or why_not,
            why_not_disturbed=why or why_not_part,
            more_roots=None if why or whole is not None else more,
            certain=certain,
            excluded=self.excluded,
            parts=dict(sorted(parts.items(), key=lambda item: (-item[1], item[0]))),
            undisturbed_crashes=counts["undisturbed"],
            plain=counts["plain"],
            plain_crashes=counts["plain_crashes"],
            steps=counts["steps"],
            plain_steps=counts["plain_steps"],
            plain_equivalent_steps=plain_steps,
            confidence=self.confidence,
        )

    def _interval(self) -> tuple[Estimated | None, str, int | None]:
        """Return the estimated interval, or None with the reason and how many more roots are probably needed."""
        count = self.roots
        weighted, _, _ = self._weighted.interval(count, self.confidence)
        if not self._counted or weighted is None:
            return self._whole.interval(count, self.confidence)
        share, mean = self._counted / count, self._weighted.total / count
        low, high = _clopper_pearson(share * self._trials, self._trials, self.confidence)
        joint = replace(
            weighted,
            low=max(0.0, share + mean - math.hypot(share - low, mean - weighted.low)),
            high=share + mean + math.hypot(high - share, weighted.high - mean),
        )
        return joint, "", None


def _at_most_1(one: Estimated | None) -> Estimated | None:
    """Return the interval without its part above 1: a sum of weights can exceed 1, a probability cannot."""
    return None if one is None else replace(one, low=min(1.0, one.low), high=min(1.0, one.high))


class _Sums:
    """Sums over the values of roots, for mean, standard error and skewness."""

    def __init__(self) -> None:
        self.total = self.squares = self.cubes = self.greatest = 0.0
        self.positive = 0

    def add(self, value: float) -> None:
        """Add the value of a root to the sums."""
        self.total += value
        self.squares += value * value
        self.cubes += value**3
        self.greatest = max(self.greatest, value)
        self.positive += value > 0

    def standard_error(self, count: int) -> float:
        """Return the standard error of the mean value of a number of roots."""
        return math.sqrt(max(0.0, self.squares - self.total**2 / count) / (count - 1) / count)

    def skewness(self, count: int) -> float:
        """Return the skewness of the values of a number of roots; 0 if all values are equal."""
        mean = self.total / count
        variance = self.squares / count - mean**2
        if variance <= 1e-12 * mean**2:  # rounding
            return 0.0
        third = self.cubes / count - 3.0 * mean * self.squares / count + 2.0 * mean**3
        return third / (variance * math.sqrt(variance))

    def interval(self, count: int, confidence: float) -> tuple[Estimated | None, str, int | None]:
        """Return the estimated interval, or None with the reason and the number of roots that are probably missing."""
        if not count:
            return None, "no root has ended", None
        if self.total <= 0.0:
            return None, f"none of {count} roots has a crash, or a copy with one", None
        effective = self.total**2 / self.squares
        share = self.greatest / self.total
        needed = count * max(MIN_EFFECTIVE / effective, MIN_ROOTS_WITH_CRASH / self.positive, share / MAX_SHARE)
        few = self.positive < MIN_ROOTS_WITH_CRASH
        reasons = [
            f"the effective sample size is {effective:.1f} (at least {MIN_EFFECTIVE:g})" * (effective < MIN_EFFECTIVE),
            f"roots with a crash: {self.positive} (at least {MIN_ROOTS_WITH_CRASH})" * few,
            f"one root is {format_percent(share)} of the sum (at most {format_percent(MAX_SHARE)})"
            * (share > MAX_SHARE),
        ]
        if why := ", ".join(filter(None, reasons)):
            return None, why, max(1, math.ceil(needed - count))
        from scipy.special import stdtrit

        mean = self.total / count
        quantile, error = float(stdtrit(count - 1, (1.0 + confidence) / 2)), self.standard_error(count)
        skewness = self.skewness(count)
        found = Estimated(
            low=max(0.0, mean - error * _unskewed(quantile, skewness, count)),
            high=mean - error * _unskewed(-quantile, skewness, count),
            effective=effective,
            largest_share=share,
            roots_with_crash=self.positive,
        )
        return found, "", None


def _clopper_pearson(events: float, trials: int, confidence: float) -> tuple[float, float]:
    """Return Clopper and Pearson's interval for a probability.

    Args:
        events: number of events, above 0; a trial may count as a fraction of an event, which only widens the interval.
        trials: number of trials.
        confidence: of the interval, in (0, 1).
    """
    from scipy.special import betaincinv

    missing, risk = max(0.0, trials - events), (1.0 - confidence) / 2.0
    low = float(betaincinv(events, missing + 1.0, risk))
    return low, float(betaincinv(events + 1.0, missing, 1.0 - risk)) if missing else 1.0


def _unskewed(quantile: float, skewness: float, count: int) -> float:
    """Return the value of Student's statistic whose Hall transformation is the given quantile."""
    if abs(skewness) < 1e-6:
        return quantile
    scale = skewness / math.sqrt(count)
    return 3.0 / scale * (math.cbrt(1.0 + scale * quantile - scale**2 / 6.0) - 1.0)
