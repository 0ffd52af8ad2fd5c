"""A rate as commands report it: an estimate if available, a certain interval, and reasons for missing numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from crashhunt.base.codec import Serializable
from crashhunt.base.errors import UsageError
from crashhunt.statistics._anytime_interval import BarVerdict, Interval
from crashhunt.statistics._counted_trials import Per, RateCounter, UnitSequence, why_too_many_invalid

_S_PER_HOUR, _M_PER_KM = 3600.0, 1000.0
_MIN_CONFIDENCE, _MAX_CONFIDENCE = 50.0, 99.9999  # percent; above that, six digits would show 100


@dataclass(frozen=True, slots=True, kw_only=True)
class RatePart(Serializable):
    """The rate of a part of the crashes, or in a part of the trials."""

    by: str  # the property that divides the parts: ``kind``, ``fault``, ``disturbance`` or an argument
    name: str  # name of the part, such as a crash type or a range of the argument
    trials: int  # number of valid trials in the part
    crashes: int  # number of crashes in the part
    estimate: float | None  # crashes divided by exposure; None if the number of trials was not fixed in advance
    # interval that is valid at any time, at the confidence of all parts together; None if there is none
    certain: Interval | None


@dataclass(frozen=True, slots=True)
class Exposure(Serializable):
    """The distance and time that the agents drove, in a number of trials."""

    trials: int
    hours: float
    km: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CrashRate(Serializable):
    """The crash rate of the agents of a hunt."""

    dir: str  # directory of the hunt
    per: Per  # the unit of exposure to which the rate refers, such as a trial or a kilometre
    confidence: float  # confidence, in percent, of the certain interval, which is valid after any number of trials
    # either ``plain`` for counted trials, or ``rare`` for forks with forced disturbances
    method: Literal["plain", "rare"] = "plain"
    units: int  # number of independent units that count: trials or traffic seeds
    crashes: int  # number of crashes in the units that ``units`` counts
    trials: int  # number of valid trials in the units that ``units`` counts
    driven_s: float  # time that the agents drove in the counted trials, in s
    driven_m: float  # distance that the agents drove in the counted trials, in m
    estimate: float | None  # crashes divided by exposure; None if the number of trials was not fixed in advance
    certain: Interval | None  # interval that is valid whenever the user looks at it; None if there is none
    why_not: str  # reason why the interval or the estimate is missing; empty if both are given
    excluded: dict[str, int]  # number of trials that do not count, by reason
    parts: tuple[RatePart, ...] = ()  # parts of the rate, by disturbance and by the property that the user chose
    steps: int = 0  # number of simulated steps of the trials
    bar: float | None = None  # threshold with which the rate is compared; None for no threshold
    # either ``below``, ``above`` or ``undecided``; empty if there is no threshold
    verdict: BarVerdict | Literal[""] = ""
    # reason why more trials cannot decide the comparison; empty if they can, or if it is decided
    why_undecided: str = ""

    json_keys = (
        "dir", "per", "confidence", "method", "units", "crashes", "exposure", "estimate", "certain", "estimated",
        "why_not", "left_out=excluded", "parts", "steps", "plain_equivalent_steps", "bar?",
        "verdict?=verdict_on_bar",
    )  # fmt: skip

    @property
    def exposure(self) -> Exposure:
        """The exposure of the counted trials."""
        return Exposure(self.trials, self.driven_s / _S_PER_HOUR, self.driven_m / _M_PER_KM)

    @property
    def estimated(self) -> Interval | None:
        """An estimated interval, which a rate from plain trials lacks."""
        return None

    @property
    def plain_equivalent_steps(self) -> float | None:
        """The number of steps that plain trials would need for the same result."""
        return self.steps

    @property
    def verdict_on_bar(self) -> BarVerdict | None:
        """The verdict; None without a threshold."""
        return self.verdict or None


def check_confidence(percent: float) -> None:
    """Refuse a confidence, in percent, that is out of range for intervals and verdicts.

    Raises:
        UsageError: the confidence is out of range.
    """
    if not _MIN_CONFIDENCE <= percent <= _MAX_CONFIDENCE:
        fix = f"give percent from {_MIN_CONFIDENCE:g} to {_MAX_CONFIDENCE:g}, such as 95"
        raise UsageError(f"--confidence is {percent:.12g}", fix=fix)


def make_rate(
    directory: str,
    per: Per,
    counter: RateCounter,
    sequence: UnitSequence,
    *,
    confidence: float = 95.0,
    why_no_interval: str = "",
    why_no_estimate: str = "",
    parts: tuple[RatePart, ...] = (),
    bar: float | None = None,
) -> CrashRate:
    """Return the crash rate from counted units.

    The reasons are empty if an interval or an estimate is possible.
    """
    why_not = why_no_interval or counter.why_not
    if not why_not and not counter.units:
        why_not = sequence.why_empty
    if not why_not and not counter.is_measured:
        why_not = "no trial has a driven distance and time"
    why_not = why_not or why_too_many_invalid(sequence.invalid, sequence.valid, "trials are invalid")
    alpha = 1 - confidence / 100
    certain = None if why_not else counter.interval(alpha)
    verdict: BarVerdict | Literal[""] = "" if bar is None else "undecided"
    if bar is not None and certain is not None and counter.test is not None:
        verdict = counter.test.verdict(bar, alpha)
    excluded = {
        "trained_on": sequence.trained_on,
        "invalid": sequence.invalid,
        "not_random": sequence.not_random,
        "after_unfinished": sequence.excluded,
        "other_code": sequence.other_code,
    }
    return CrashRate(
        dir=directory,
        per=per,
        confidence=confidence,
        units=counter.units,
        crashes=counter.crashes,
        trials=counter.trials,
        driven_s=counter.driven_s,
        driven_m=counter.driven_m,
        estimate=None if why_not or why_no_estimate else counter.observed,
        certain=certain,
        why_not=why_not or why_no_estimate,
        excluded={name: count for name, count in excluded.items() if count},
        parts=() if why_not else parts,
        steps=counter.steps,
        bar=bar,
        verdict=verdict,
    )
