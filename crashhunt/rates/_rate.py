"""A rate as commands report it: an estimate where there is one, a certain interval, and why something is missing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.rates._units import MAX_INVALID_SHARE

if TYPE_CHECKING:
    from crashhunt.base.codec import JsonObject
    from crashhunt.rates._certain_interval import Interval
    from crashhunt.rates._units import Per, RateCounter, UnitSequence

__all__ = ["CrashRate", "RatePart", "check_confidence", "make_rate"]

_S_PER_HOUR, _M_PER_KM = 3600.0, 1000.0
_MIN_CONFIDENCE, _MAX_CONFIDENCE = 50.0, 99.9999  # percent; above that, six digits would show 100


@dataclass(frozen=True, slots=True, kw_only=True)
class RatePart:
    """The rate of some of the crashes, or in some of the trials.

    Args:
        by: what divides the parts: ``kind``, ``fault``, ``disturbance`` or an argument.
        name: name of the part.
        trials: valid trials in it.
        crashes: crashes of them.
        estimate: crashes by exposure; None if the number of trials was not fixed ahead.
        certain: interval, at the confidence of all parts together; None if there is none.
    """

    by: str
    name: str
    trials: int
    crashes: int
    estimate: float | None
    certain: Interval | None

    def to_json(self) -> JsonObject:
        """Return plain data."""
        return {
            "by": self.by, "name": self.name, "trials": self.trials, "crashes": self.crashes,
            "estimate": self.estimate, "certain": _plain(self.certain),
        }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class CrashRate:
    """How often the agents of a hunt crash.

    Args:
        dir: directory of the hunt.
        per: what the rate is per.
        confidence: confidence of the certain interval, in percent.
        method: ``plain``, counted trials; or ``rare``, copies with forced onsets.
        units: independent units that count: trials, or traffics.
        crashes: crashes in them.
        trials: valid trials in them.
        driven_s: time that the agents drove in them, in s.
        driven_m: distance, in m.
        estimate: crashes by exposure; None if the number of trials was not fixed ahead.
        certain: interval that is valid whenever you look; None if there is none.
        why_not: why there is no interval, or no estimate; empty if there are both.
        excluded: reason to number of trials that do not count.
        parts: parts of the rate, by disturbance and by what was asked for.
        steps: that the trials took.
        bar: rate that it was compared with; None for none.
        verdict: ``below``, ``above`` or ``undecided``; empty without a bar.
        why_undecided: why more trials do not help to compare it; empty if they do, or it is decided.
    """

    dir: str
    per: Per
    confidence: float
    method: str = "plain"
    units: int
    crashes: int
    trials: int
    driven_s: float
    driven_m: float
    estimate: float | None
    certain: Interval | None
    why_not: str
    excluded: dict[str, int]
    parts: tuple[RatePart, ...] = ()
    steps: int = 0
    bar: float | None = None
    verdict: str = ""
    why_undecided: str = ""

    def to_json(self) -> JsonObject:
        """Return an entry of what ``rate --json`` prints; what is no finite number is null."""
        found: JsonObject = {
            "dir": self.dir,
            "per": self.per,
            "confidence": self.confidence,
            "method": self.method,
            "units": self.units,
            "crashes": self.crashes,
            "exposure": {
                "trials": self.trials,
                "hours": self.driven_s / _S_PER_HOUR,
                "km": self.driven_m / _M_PER_KM,
            },
            "estimate": self.estimate,
            "certain": _plain(self.certain),
            "estimated": None,
            "why_not": self.why_not,
            "left_out": self.excluded,
            "parts": [part.to_json() for part in self.parts],
            "steps": self.steps,
            "plain_equivalent_steps": self.steps,
        }
        if self.bar is not None:
            found |= {"bar": self.bar, "verdict": self.verdict}
        return found


def check_confidence(percent: float) -> None:
    """Refuse a confidence, in percent, that no interval or verdict can have.

    Raises:
        UsageError: it is out of range.
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
    """Return the rate of counted units.

    Args:
        directory: directory of the hunt.
        per: what the rate is per.
        counter: counter of all units.
        sequence: that the units came from.
        confidence: confidence of the interval, in percent.
        why_no_interval: reason against any interval, such as a sampler that learns; empty for none.
        why_no_estimate: reason against an estimate; empty for none.
        parts: parts of the rate.
        bar: rate to compare with.
    """
    why_not = why_no_interval or counter.why_not
    if not why_not and not counter.units:
        why_not = sequence.why_empty
    if not why_not and sequence.invalid_share > MAX_INVALID_SHARE:
        many = f"{sequence.invalid} of {sequence.invalid + sequence.valid} trials are invalid"
        why_not = f"{many}, more than {MAX_INVALID_SHARE:.0%}: the rest is other traffic than described"
    alpha = 1 - confidence / 100
    certain = None if why_not else counter.interval(alpha)
    verdict = "" if bar is None else "undecided"
    if bar is not None and certain is not None and counter.test is not None:
        verdict = counter.test.verdict(bar, alpha)
    excluded = {
        "trained_on": sequence.trained_on,
        "invalid": sequence.invalid,
        "not_random": sequence.not_random,
        "after_unfinished": sequence.excluded,
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


def _plain(interval: Interval | None) -> JsonObject | None:
    if interval is None:
        return None
    return {"low": interval.low, "high": interval.high if math.isfinite(interval.high) else None}
