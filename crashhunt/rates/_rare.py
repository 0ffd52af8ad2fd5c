"""The rare-event estimator: crash probability per trial from roots and their copies with forced first onsets.

Each root has a value: the weighted crashes of its copies, plus the probability of no onset where the root itself
crashes. The values are independent, given the allocation, and unbiased (see `crashhunt.disturbances.FirstOnsets`). The
estimate is their mean. Crashes that a disturbance had an effect on, and crashes without, are summed apart.

Learning: the forcing of a block of 32 roots depends on the blocks before the previous one only. So it is the same
whatever the number of workers, and no worker waits for the end of a block. The proposal is 10 % the law itself and
90 % the law times the square root of the smoothed crash share of each cell. That minimizes the variance for
independent copies of equal cost; the 10 % bound all weights.

The interval is that of Student's t, reported only where the data can carry it. The effective sample size and the number
of roots with a crash are at least 20, and no root has more than 20 % of the sum. The same interval on the logarithm was
tried and covered less: where an interval is seldom reported, it is reported of estimates that are too high. No interval
from weighted copies can exclude a failure mode that no copy has met. The certain interval is for that: it is the one of
`crashhunt.rates._betting`, so it is valid at any number of roots. The part of the roots themselves and that of their
copies are bounded apart and added, by Bonferroni's inequality. A copies' sum Y is at most b, which the forcing of its
root fixes before the root begins. So Y / b counts as events and 1 / b as exposure: their ratio of means is the rate.

Source: Owen, Monte Carlo theory, methods and examples, 2013, chapters 8 to 9; Kish, Survey sampling, 1965, for the
effective sample size.
Cost: one pass over the roots.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from crashhunt.disturbances import COPIES_PER_ROOT
from crashhunt.rates._betting import Bets, RateTest
from crashhunt.trial import Forcing, Outcome

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.trial import Forced, TrialResult

__all__ = [
    "BLOCK", "Estimated", "RareEstimate", "Root", "learn_forcing", "rare_estimate", "root_of",
]  # fmt: skip

BLOCK: Final = 32
"""Roots with the same forcing."""
PLAIN_SHARE: Final = 0.1
"""Share of the proposal that is the law itself: no weight is above 10 times that of the law."""
_PRIOR_COPIES: Final = 4.0  # weight of the common crash share in that of a cell
MIN_EFFECTIVE: Final = 20.0
MIN_ROOTS_WITH_CRASH: Final = 20
MAX_SHARE: Final = 0.2
MAX_EXCLUDED: Final = 0.05
"""Share of roots without a complete result above which nothing is estimated."""


@dataclass(frozen=True, slots=True)
class Root:
    """The value of one root.

    Args:
        undisturbed: its estimate of the probability of a crash that no disturbance had an effect on.
        disturbed: the same for the other crashes.
        own: the part of their sum that is not of copies, from 0 to 1.
        by: by cell, the part of ``disturbed`` that is of copies.
        steps: simulated for it, those of copies included.
        own_steps: its own steps.
        bound: the largest possible part of copies, known before the root begins.
        crashed: whether the root itself crashed undisturbed.
    """

    undisturbed: float
    disturbed: float
    own: float = 0.0
    by: Mapping[str, float] = field(default_factory=dict)
    steps: int = 0
    own_steps: int = 0
    bound: float = math.inf
    crashed: bool = False

    @property
    def value(self) -> float:
        """The estimate of the crash probability."""
        return self.undisturbed + self.disturbed


@dataclass(frozen=True, slots=True)
class Estimated:
    """An estimated interval, and what it rests on.

    Args:
        low: of the interval.
        high: of the interval.
        effective: effective sample size, in roots.
        largest_share: of the root with the greatest value in the sum, 0 to 1.
        roots_with_crash: how many roots have a value above 0.
    """

    low: float
    high: float
    effective: float
    largest_share: float
    roots_with_crash: int


@dataclass(frozen=True, slots=True)
class RareEstimate:
    """The crash probability per trial, estimated from roots.

    Args:
        roots: how many.
        estimate: crash probability per trial; None where there is no root.
        undisturbed: the part of crashes that no disturbance had an effect on.
        disturbed: the other part.
        estimated: interval for ``estimate``; None where the roots cannot carry one.
        estimated_disturbed: the same for ``disturbed``.
        why_not: why there is no interval for ``estimate``; empty where there is.
        why_not_disturbed: the same for ``disturbed``.
        more_roots: how many more roots are probably needed for ``estimated``; None where that cannot be predicted.
        certain: bounds that hold whatever the roots have not met; None where they were not asked for.
        excluded: how many roots have no complete result.
        parts: by cell, the part of ``disturbed`` whose first onset is of that cell.
        undisturbed_crashes: how many roots crashed undisturbed.
        steps: how many were simulated.
        plain_equivalent_steps: how many steps plain trials would take to the same standard error; None without one.
        relative_error: half the width of ``estimated`` over the estimate; infinite where there is none.
    """

    roots: int
    estimate: float | None
    undisturbed: float
    disturbed: float
    estimated: Estimated | None
    estimated_disturbed: Estimated | None
    why_not: str
    why_not_disturbed: str
    more_roots: int | None
    certain: tuple[float, float] | None
    excluded: int
    parts: Mapping[str, float]
    undisturbed_crashes: int
    steps: int
    plain_equivalent_steps: float | None
    confidence: float

    @property
    def relative_error(self) -> float:
        """Half the width of the estimated interval over the estimate; infinite without an interval."""
        if self.estimated is None or not self.estimate:
            return math.inf
        return (self.estimated.high - self.estimated.low) / 2 / self.estimate

    def to_json(self) -> JsonObject:
        """Return plain data without NaN."""
        low, high = self.certain or (None, None)
        return {
            "method": "rare",
            "per": "trial",
            "confidence": self.confidence,
            "units": self.roots,
            "estimate": self.estimate,
            "certain": {"low": low, "high": high} if self.certain is not None else None,
            "estimated": _plain(self.estimated),
            "why_not": self.why_not,
            "more_roots": self.more_roots,
            "left_out": self.excluded,
            "parts": {
                "undisturbed": {"estimate": self.undisturbed, "crashes": self.undisturbed_crashes},
                "disturbed": {
                    "estimate": self.disturbed,
                    "estimated": _plain(self.estimated_disturbed),
                    "why_not": self.why_not_disturbed,
                    "by": dict(self.parts),
                },
            },
            "steps": self.steps,
            "plain_equivalent_steps": self.plain_equivalent_steps,
        }


def _plain(one: Estimated | None) -> JsonObject | None:
    if one is None:
        return None
    return {
        "low": one.low,
        "high": one.high,
        "effective": one.effective,
        "largest_share": one.largest_share,
        "roots_with_crash": one.roots_with_crash,
    }


def root_of(result: TrialResult, crash_on: Sequence[Outcome], hazard: float) -> Root | None:
    """Return the value of a root; None where it has no complete result.

    Args:
        result: of the root.
        crash_on: the outcomes that count as a crash.
        hazard: sum of the chances per step of all models around all agents.
    """
    forced = result.forced
    if forced is None or forced.unanswered or result.outcome is Outcome.INVALID or result.spec.forcing is None:
        return None
    crashed = result.outcome in crash_on
    own = forced.survival if crashed else 0.0
    undisturbed, disturbed = (0.0, own) if result.disturbed else (own, 0.0)
    by: defaultdict[str, float] = defaultdict(float)
    for copy in forced.copies:
        if copy.crash and copy.disturbed:
            disturbed += copy.weight
            by[copy.cell] += copy.weight
        elif copy.crash:
            undisturbed += copy.weight
    return Root(
        undisturbed=undisturbed,
        disturbed=disturbed,
        own=own,
        by=by,
        steps=result.steps + result.other_steps,
        own_steps=result.steps + (result.setup_steps or 0),
        bound=_bound(result.spec.forcing, hazard * result.spec.max_steps),
        crashed=crashed and not result.disturbed,
    )


def _bound(forcing: Forcing, hazard: float) -> float:
    """Return the largest sum of the weights of copies.

    Args:
        forcing: of the root.
        hazard: sum of all chances of a trial, which bounds the probability of an onset from above.
    """
    ratios = (1.0, *forcing.ratios.values())
    most_proposed = min(1.0, hazard) * max(ratios)
    return (most_proposed + forcing.spacing) / min(ratios)


def learn_forcing(earlier: Iterable[Forced], start: Forcing) -> Forcing:
    """Return the forcing that earlier roots suggest.

    Args:
        earlier: what came of the copies of earlier roots.
        start: the forcing of the first roots, where earlier ones say nothing.
    """
    masses: Counter[str] = Counter()
    copies: Counter[str] = Counter()
    crashes: Counter[str] = Counter()
    roots = 0
    for one in earlier:
        roots += 1
        masses.update(one.masses)
        for copy in one.copies:
            copies[copy.cell] += 1
            crashes[copy.cell] += bool(copy.crash)
    total = math.fsum(masses.values())
    if not roots or total <= 0.0:
        return start
    common = (crashes.total() + 0.5) / (copies.total() + 1.0)
    roots_of_shares = {
        cell: math.sqrt((crashes[cell] + _PRIOR_COPIES * common) / (copies[cell] + _PRIOR_COPIES))
        for cell in sorted(masses)
    }
    mean = math.fsum(masses[cell] / total * share for cell, share in roots_of_shares.items())
    ratios = {cell: PLAIN_SHARE + (1.0 - PLAIN_SHARE) * share / mean for cell, share in roots_of_shares.items()}
    return Forcing(total / roots / COPIES_PER_ROOT, ratios)


def rare_estimate(
    roots: Sequence[Root], *, least_bound: float | None = None, excluded: int = 0, confidence: float = 0.95
) -> RareEstimate:
    """Return the crash probability per trial with its intervals.

    Args:
        roots: with a complete result, in the order of their numbers.
        least_bound: lower limit of all `Root.bound`, fixed before the first root; None for no certain interval.
        excluded: how many roots have none.
        confidence: of all intervals, in (0, 1).
    """
    values = [root.value for root in roots]
    count = len(roots)
    parts: defaultdict[str, float] = defaultdict(float)
    for root in roots:
        for cell, weight in root.by.items():
            parts[cell] += weight / count
    estimate = math.fsum(values) / count if count else None
    why = ""
    if excluded > MAX_EXCLUDED * (count + excluded):
        why = f"{excluded} of {count + excluded} roots have no complete result (allowed: {MAX_EXCLUDED:.0%})"
    whole, why_not, more = _interval(values, confidence)
    part, why_not_part, _ = _interval([root.disturbed for root in roots], confidence)
    plain_steps = None
    if estimate and count > 1 and (spread := _standard_error(values)) > 0:
        per_trial = sum(root.own_steps for root in roots) / count
        plain_steps = estimate * (1.0 - min(estimate, 1.0)) / spread**2 * per_trial
    return RareEstimate(
        roots=count,
        estimate=None if why else estimate,
        undisturbed=math.fsum(root.undisturbed for root in roots) / count if count else 0.0,
        disturbed=math.fsum(root.disturbed for root in roots) / count if count else 0.0,
        estimated=None if why else whole,
        estimated_disturbed=None if why else part,
        why_not=why or why_not,
        why_not_disturbed=why or why_not_part,
        more_roots=None if why or whole is not None else more,
        certain=None if why or least_bound is None or not count else _certain(roots, least_bound, confidence),
        excluded=excluded,
        parts=dict(sorted(parts.items(), key=lambda item: (-item[1], item[0]))),
        undisturbed_crashes=sum(root.crashed for root in roots),
        steps=sum(root.steps for root in roots),
        plain_equivalent_steps=plain_steps,
        confidence=confidence,
    )


def _certain(roots: Sequence[Root], least_bound: float, confidence: float) -> tuple[float, float]:
    """Return bounds on the sum of the part of the roots themselves and the part of their copies."""
    own, copies = RateTest(), RateTest(Bets(1.0, 1.0 / least_bound, fixed_exposure=False))
    for root in roots:
        own.add(root.own, 1.0)
        copies.add((root.value - root.own) / root.bound, 1.0 / root.bound)
    alpha = (1.0 - confidence) / 2
    found = [test.interval(alpha) for test in (own, copies)]
    return math.fsum(one.low for one in found), min(1.0, math.fsum(one.high for one in found))


def _standard_error(values: Sequence[float]) -> float:
    count, mean = len(values), math.fsum(values) / len(values)
    return math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (count - 1) / count)


def _interval(values: Sequence[float], confidence: float) -> tuple[Estimated | None, str, int | None]:
    """Return the estimated interval, or None with the reason and how many more roots are probably needed."""
    from scipy.special import stdtrit

    count, total = len(values), math.fsum(values)
    with_crash = sum(value > 0 for value in values)
    if total <= 0.0:
        return None, f"none of {count} roots has a crash, or a copy with one", None
    effective = total**2 / math.fsum(value**2 for value in values)
    share = max(values) / total
    needed = count * max(MIN_EFFECTIVE / effective, MIN_ROOTS_WITH_CRASH / with_crash, share / MAX_SHARE)
    reasons = [
        f"the effective sample size is {effective:.1f} (at least {MIN_EFFECTIVE:g})" * (effective < MIN_EFFECTIVE),
        f"{with_crash} roots have a crash (at least {MIN_ROOTS_WITH_CRASH})" * (with_crash < MIN_ROOTS_WITH_CRASH),
        f"one root is {share:.0%} of the sum (at most {MAX_SHARE:.0%})" * (share > MAX_SHARE),
    ]
    if why := ", ".join(filter(None, reasons)):
        return None, why, max(1, math.ceil(needed - count))
    mean = total / count
    width = float(stdtrit(count - 1, (1.0 + confidence) / 2)) * _standard_error(values)
    return (
        Estimated(
            low=max(0.0, mean - width),
            high=mean + width,
            effective=effective,
            largest_share=share,
            roots_with_crash=with_crash,
        ),
        "",
        None,
    )
