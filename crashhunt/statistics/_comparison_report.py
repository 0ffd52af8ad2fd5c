"""A comparison of hunts as commands report it: the figures of each hunt, and the answer for each pair, in words."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, field
from typing import Literal, TextIO

from crashhunt.base.codec import Serializable, null_is
from crashhunt.base.text import count_of, format_number
from crashhunt.statistics._anytime_interval import Interval
from crashhunt.statistics._counted_trials import PER_WORDS, Per
from crashhunt.trial import Outcome

Answer = Literal["first", "second", "undecided", ""]
CONFIDENCE = 0.95
ALPHA = 1 - CONFIDENCE


@dataclass(frozen=True, slots=True)
class HuntFigures(Serializable):
    """The figures of one hunt in a comparison.

    Args:
        dir: directory of the hunt.
        state: state of the hunt.
        agents: agent of each controlled vehicle.
        trials: number of valid trials, up to the first trial that has not ended.
        crashes: number of crashes in the trials that ``trials`` counts.
        crash_rate: crash rate of the trials that ``trials`` counts, in the unit ``per``; NaN if the rate would be
            biased, or if there is no trial.
        interval: interval of the crash rate with 95 % confidence, valid at any time; None if the trials do not allow an
            interval.
        why_not: reason why the interval or the rate is missing.
        median_steps_to_crash: median number of steps until a crash; NaN if there was no crash.
        median_time_to_collision_s: median, over trials without a crash, of the least time to collision, in s; infinite
            if most trials had no collision course.
        outcomes: number of trials with each outcome, over all trials with the newest code, including invalid trials.
        counted: origin of the trials that count, if the search guided all others. Only unguided trials show a crash
            rate. The origin is empty if all trials count.
        disturbed: number of crashes with disturbances; None if the hunt has no disturbances.
        excluded: number of trials that do not count, because a trial with a lower number has not ended.
        exclusions: number of trials that do not count, by reason. Reason ``trained_on``: an agent of this hunt, or of a
            compared hunt with the same seed, was trained on the traffic of these trials. Reason ``other_code``: the
            trials ran with earlier code, or had begun when the code changed.
        per: the unit to which rate and interval refer: ``trial``, ``hour`` or ``1000km``.
    """

    dir: str
    state: str
    agents: dict[str, str]
    trials: int
    crashes: int
    crash_rate: float = field(metadata=null_is(math.nan))
    interval: tuple[float, float] | None
    why_not: str
    median_steps_to_crash: float = field(metadata=null_is(math.nan))
    median_time_to_collision_s: float = field(metadata=null_is(math.inf))
    outcomes: dict[str, int]
    counted: str = ""
    disturbed: int | None = None
    excluded: int = 0
    exclusions: dict[str, int] = field(default_factory=dict)
    per: Per = "trial"

    json_keys = (
        "dir", "state", "agents", "trials", "crashes", "crash_rate", "interval=bounds", "why_not",
        "median_steps_to_crash", "median_time_to_collision_s", "outcomes", "counted", "disturbed", "excluded",
        "left_out=exclusions", "per",
    )  # fmt: skip

    @property
    def bounds(self) -> tuple[float, float | None] | None:
        """The interval; an infinite end becomes null in JSON."""
        return self.interval


@dataclass(frozen=True, slots=True)
class Pair(Serializable):
    """Comparison of two hunts.

    Trials with the same number, seed and traffic are compared in pairs. If there are no such trials, the crash rates of
    the two hunts are compared.
    """

    first: str  # directory of the first hunt
    second: str  # directory of the second hunt
    trials: int  # number of pairs of valid trials
    # pairs in which only the first hunt crashed; with ``--seeds``, traffic seeds in which it crashed more often
    only_first: int
    # pairs in which only the second hunt crashed; with ``--seeds``, traffic seeds in which it crashed more often
    only_second: int
    both: int  # pairs in which both hunts crashed; with ``--seeds``, traffic seeds in which both crashed equally often
    # *p* value of McNemar's or Fisher's exact test on the crashes per trial; None if the number of trials was not fixed
    # in advance. It decides nothing.
    p_value: float | None
    caution: str = ""  # a warning that limits the meaning of the answer; empty if there is none
    # basis of the verdict: ``pairs``, the evidence of pairs; ``intervals``, the certain intervals of both hunts; empty
    # if there is none
    test: Literal["pairs", "intervals", ""] = "pairs"
    why_unpaired: str = ""  # reason why there are no pairs; empty if there are pairs
    # numbers of crashes and of valid trials, of the first hunt and of the second
    counts: tuple[int, int, int, int] = (0, 0, 0, 0)
    # e-value against the hypothesis that both hunts crash equally often per trial; 20 or more means 95 % confidence.
    # None without pairs, and for rates per hour or per 1,000 km.
    evidence: float | None = field(default=None, metadata=null_is(None))
    # interval of the difference of the crash rates in the unit ``per``, second minus first; None if there is none
    difference: Interval | None = None
    units: int = 0  # number of independent pairs, of trials or of traffic seeds
    # number of trials of both hunts that do not count. A trial does not count if a trial with a lower number has not
    # ended, or if the trial is invalid in both hunts. A trial on whose traffic an agent was trained does not count
    # either.
    excluded: int = 0
    # the hunt that certainly crashes less, ``first`` or ``second``; ``undecided`` if neither does; empty if no answer
    # is possible. The answer follows from ``difference``: it is undecided if this interval contains 0.
    answer: Answer = ""
    # number of trials of the first hunt and of the second that count as crashes. The agent does not start in these
    # trials, and it starts in the same trials of the other hunt.
    not_started: tuple[int, int] = (0, 0)
    # number of pairs with an unknown result. A trial was killed from outside or could not be set up, in one hunt only.
    # The answer is valid for any result of these pairs.
    without_result: int = 0
    per: Per = "trial"  # the unit to which answer and difference refer: ``trial``, ``hour`` or ``1000km``

    json_keys = (
        "first", "second", "trials", "only_first", "only_second", "both", "p_value", "caution", "test", "why_unpaired",
        "counts", "evidence", "difference", "units", "excluded", "answer", "not_started", "without_result", "per",
        "verdict",
    )  # fmt: skip

    @property
    def verdict(self) -> str:
        """Return the answer as text."""
        if self.test != "pairs":
            return self._unpaired()
        if self.units != self.trials:
            what = (
                f"of {self.units} traffics with {self.trials} trials each way, {self.first} crashes more often in "
                f"{self.only_first}, {self.second} in {self.only_second}"
            )
        else:
            what = (
                f"of {count_of(self.trials, 'trial')} with the same seeds, "
                f"{self.only_first} crash only in {self.first}, "
                f"{self.only_second} only in {self.second}, {self.both} in both"
            )
        if self.evidence is not None:
            decides = f"; {format_number(1 / ALPHA)} decides" if self.answer == "undecided" else ""
            what += f" (evidence {format_number(self.evidence)}{decides})"
        return f"{self._answer}: {what}{self._difference}"

    @property
    def _answer(self) -> str:
        if not self.answer:
            return f"no answer {PER_WORDS[self.per]}"
        if self.answer in ("first", "second"):
            return f"{self.first if self.answer == 'first' else self.second} crashes less"
        return "undecided, because the difference may be 0"

    @property
    def _difference(self) -> str:
        if self.difference is None:
            return ""
        found = f"{self.difference.as_difference()} crashes {PER_WORDS[self.per]}"
        return f"; difference: {found} ({self.second} minus {self.first}, 95 %)"

    def _unpaired(self) -> str:
        reason = f"{self.first} and {self.second}{self.why_unpaired.removeprefix('they')}"
        if not self.test:
            return reason
        a, trials_a, b, trials_b = self.counts
        counts = f"{a} of {trials_a} trials crash in {self.first}, {b} of {trials_b} in {self.second}"
        return f"{reason}; {self._answer}: {counts}{self._difference}"


@dataclass(frozen=True, slots=True)
class Comparison(Serializable):
    """The comparison of several hunts.

    Args:
        hunts: hunts in the order in which they were given.
        pairs: comparisons of the first hunt with each of the others.
    """

    hunts: tuple[HuntFigures, ...]
    pairs: tuple[Pair, ...]

    @property
    def per(self) -> Per:
        """The unit of all rates: ``trial``, ``hour`` or ``1000km``."""
        return self.hunts[0].per

    def write_csv(self, out: TextIO) -> None:
        """Write one CSV line for each hunt."""
        names = ("dir", "state", "trials", "crashes", "crash_rate", "rate_low", "rate_high", "why_not",
                 "median_steps_to_crash", "median_time_to_collision_s", *map(str, Outcome), "per")  # fmt: skip
        writer = csv.DictWriter(out, names)
        writer.writeheader()
        for hunt in self.hunts:
            low, high = hunt.interval or ("", "")
            row = {name: getattr(hunt, name) for name in names if hasattr(hunt, name)}
            counts = {str(kind): hunt.outcomes.get(kind, 0) for kind in Outcome}
            writer.writerow({**row, **counts, "rate_low": low, "rate_high": high})

    def __repr__(self) -> str:
        rates = ", ".join(f"{hunt.dir}: {hunt.crashes} of {hunt.trials}" for hunt in self.hunts)
        return f"<comparison {rates}>"
