"""Whether one of two agents crashes more often, in the same traffic: a test and an interval that are valid at any time.

A pair is one trial of each agent with the same number, seed and traffic. Pairs count in the order of their numbers, up
to the first number that has not ended for both. A crash ends a trial early, so the pairs that happen to have ended are
not a fair sample. The first k pairs are. With `--seeds` a pair is a traffic with all its trials.

The difference of a pair is Z = (crashes of the second - crashes of the first) / trials, from -1 to 1. The interval of
E[Z] has two ends, each with half of the error probability. For the upper end, each component bets that E[Z] is less
than d, with the share s of the most that it may stake:

    E(d) = sum_j w_j / 2 prod_i (1 - s_j (Z_i - d) / (1 - d)).

Invariant: at the true difference each factor is positive and has mean 1 given the past. So the sum is a non-negative
martingale that begins at 1 / 2. By Ville's inequality it ever reaches 1 / alpha with probability alpha / 2 at most.
Each factor grows with d for every Z. So the differences that are not rejected are an interval, and bisection finds
its end. The lower end is the upper end of -Z.

Sources: as in `_certain_interval`, from where the evidence of discordant pairs comes. For Z the bets are those of I.
Waudby-Smith and A. Ramdas (2024), with a mixture over fixed shares.

Cost: a pair adds to a counter. An end takes 50 evaluations, each of as many logarithms as there are components times
different values of Z.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Literal

import numpy as np

from crashhunt.rates._certain_interval import Interval, discordance_evidence
from crashhunt.rates._units import MAX_INVALID_SHARE, has_too_many_invalid

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from crashhunt.rates._units import CountingRule, TrialFacts

__all__ = ["Pair", "PairSequence", "PairTest", "PairVerdict", "PairWatch"]

PairVerdict = Literal["better", "worse", "no_difference", "undecided"]
"""What pairs say of the second agent, compared with the first."""

_WEIGHT_OF_GREATEST = 0.25
_GREATEST_SHARE, _SECOND_SHARE, _LEAST_SHARE = 0.999, 0.9, 0.003  # of the most that a bet may stake
_COMPONENTS = 12  # from the second to the least, evenly spaced in the logarithm
_SHARES: NDArray[np.float64] = np.concatenate(
    ([_GREATEST_SHARE], np.geomspace(_SECOND_SHARE, _LEAST_SHARE, _COMPONENTS))
)
_LOG_WEIGHTS: NDArray[np.float64] = np.log(
    np.concatenate(
        ([_WEIGHT_OF_GREATEST], np.full(_COMPONENTS, (1 - _WEIGHT_OF_GREATEST) / _COMPONENTS)),
    )
    / 2
)
_PRECISION = 1e-9  # of both ends

Pair = tuple[tuple["TrialFacts", "TrialFacts"], ...]
"""The trials of a pair that are valid for both agents, each as first and second: one, or those of a traffic."""


class PairSequence:
    """Puts trials of two agents, which end in any order, into pairs in the order of their numbers.

    A trial that is invalid for one of them leaves both sides. Trials that are not drawn at random do not count.

    Args:
        rules: how the trials of the first and of the second agent count.
        is_same: whether two trials of the same number have the same seed and traffic; by default all have.
    """

    def __init__(
        self,
        rules: tuple[CountingRule, CountingRule],
        is_same: Callable[[TrialFacts, TrialFacts], bool] = lambda _first, _second: True,
    ) -> None:
        self._rules, self._is_same = rules, is_same
        self._waiting: tuple[dict[int, TrialFacts], dict[int, TrialFacts]] = ({}, {})
        self._complete: dict[int, Pair] = {}
        self._next = 0  # trial, or traffic
        self._traffics = rules[0].traffics
        self._rounds = min(rule.trials_per_unit for rule in rules)
        self.valid = self.invalid = self.not_random = self.not_same = 0  # pairs of trials

    def add(self, side: int, trial: TrialFacts) -> Iterator[Pair]:
        """Add a trial, and yield the pairs that are complete now, also those without a trial that counts.

        Args:
            side: 0 for a trial of the first agent, 1 for one of the second.
            trial: trial of any number; one that was added before is ignored.
        """
        if not trial.has_ended or self._has(trial.number) or not self._is_wanted(trial.number):
            return
        self._waiting[side][trial.number] = trial
        while (numbers := self._numbers(self._next)) and all(
            number in waiting for number in numbers for waiting in self._waiting
        ):
            self._next += 1
            yield self._counted(numbers)

    def _has(self, number: int) -> bool:
        return (number % self._traffics if self._traffics else number) < self._next

    def _is_wanted(self, number: int) -> bool:
        return not self._traffics or number < self._traffics * self._rounds

    def _numbers(self, place: int) -> list[int]:
        """Return the numbers of the trials of a pair; none where there is no such traffic."""
        if not self._traffics:
            return [place]
        if place >= self._traffics:
            return []
        return [place + turn * self._traffics for turn in range(self._rounds)]

    def _counted(self, numbers: list[int]) -> Pair:
        found = []
        for number in numbers:
            both = self._waiting[0].pop(number), self._waiting[1].pop(number)
            if any(
                rule.plain_origin and one.origin != rule.plain_origin
                for rule, one in zip(self._rules, both, strict=True)
            ):
                self.not_random += 1
            elif not self._is_same(*both):
                self.not_same += 1
            elif not (both[0].valid and both[1].valid):
                self.invalid += 1
            else:
                self.valid += 1
                found.append(both)
        return tuple(found)

    @property
    def position(self) -> int:
        """How many pairs have ended in a row: the number of the first trial, or traffic, that has not for both."""
        return self._next

    @property
    def excluded(self) -> int:
        """How many trials have ended, but belong to no complete pair yet."""
        return sum(map(len, self._waiting))

    @property
    def invalid_share(self) -> float:
        """The share of pairs with an invalid trial."""
        return self.invalid / (self.invalid + self.valid) if self.invalid else 0.0

    @property
    def is_hopeless(self) -> bool:
        """Whether certainly too many pairs have an invalid trial."""
        return has_too_many_invalid(self.invalid, self.valid)

    @property
    def why_not(self) -> str:
        """Why the pairs say nothing; empty if they do."""
        if self.invalid_share <= MAX_INVALID_SHARE:
            return ""
        many = f"{self.invalid} of {self.invalid + self.valid} pairs have an invalid trial"
        return f"{many}, more than {MAX_INVALID_SHARE:.0%}: the rest is other traffic than described"


class PairTest:
    """Counts pairs, and returns what they say of the difference at any time.

    Attributes:
        pairs: how many count.
        only_first: number of the pairs in which the first agent crashes and the second does not. Where a pair is a
            traffic: in how many the first crashes more often.
        only_second: likewise.
        both: in how many both crash, equally often.
        crashes: crashes of the first and of the second.
        trials: trials of each, in these pairs.
    """

    def __init__(self, rounds: int = 1) -> None:
        self._rounds = max(1, rounds)
        self.pairs = self.only_first = self.only_second = self.both = self.trials = 0
        self.crashes = (0, 0)
        self._differences: Counter[float] = Counter()

    def add(self, pair: Pair) -> None:
        """Add a pair; one without a trial that counts is ignored."""
        if not pair:
            return
        first, second = (sum(both[side].crashed for both in pair) for side in (0, 1))
        self.pairs += 1
        self.trials += len(pair)
        self.crashes = (self.crashes[0] + first, self.crashes[1] + second)
        self.only_first += first > second
        self.only_second += second > first
        self.both += first == second > 0
        self._differences[(second - first) / self._rounds] += 1

    def add_counts(self, only_first: int, only_second: int, alike: int) -> None:
        """Add pairs of single trials by their number.

        Args:
            only_first: pairs in which only the first crashes.
            only_second: pairs in which only the second does.
            alike: pairs in which neither does.
        """
        self.pairs += only_first + only_second + alike
        self.trials += only_first + only_second + alike
        self.only_first += only_first
        self.only_second += only_second
        self.crashes = (self.crashes[0] + only_first, self.crashes[1] + only_second)
        self._differences.update({-1.0: only_first, 1.0: only_second, 0.0: alike})

    @property
    def log_evidence(self) -> float:
        """The logarithm of the evidence that the two do not crash equally often."""
        return discordance_evidence(self.only_first, self.only_second)

    def difference(self, alpha: float = 0.05) -> Interval | None:
        """Return the interval of the difference in crashes per trial, second minus first; None without a pair.

        The probability that it ever excludes the true difference, after any number of pairs, is `alpha` at most.
        """
        if not self.pairs:
            return None
        return Interval(-self._upper_end(-1, alpha), self._upper_end(1, alpha))

    def excludes(self, difference: float, alpha: float = 0.05) -> bool:
        """Return whether the interval excludes a difference."""
        threshold = -math.log(alpha)
        return max(self._log_evidence_below(sign * difference, sign) for sign in (1, -1)) >= threshold

    def is_within(self, margin: float, alpha: float = 0.05) -> bool:
        """Return whether the interval of the difference lies between -margin and margin."""
        threshold = -math.log(alpha)
        return self.pairs > 0 and all(self._log_evidence_below(margin, sign) >= threshold for sign in (1, -1))

    def _log_evidence_below(self, difference: float, sign: int) -> float:
        """Return the logarithm of the evidence that sign * E[Z] is less than a difference."""
        values = sign * np.array(list(self._differences), float)
        times = np.array(list(self._differences.values()), float)
        stakes = _SHARES / (1 - difference)
        logs = np.log1p(-np.outer(stakes, values - difference)) @ times + _LOG_WEIGHTS
        top = float(logs.max())
        return top + math.log(float(np.exp(logs - top).sum()))

    def _upper_end(self, sign: int, alpha: float) -> float:
        threshold = -math.log(alpha)
        low, high = -1.0, 1.0 - _PRECISION
        if self._log_evidence_below(high, sign) < threshold:
            return 1.0
        while high - low > _PRECISION:
            middle = (low + high) / 2
            if self._log_evidence_below(middle, sign) < threshold:
                low = middle
            else:
                high = middle
        return high


class PairWatch:
    """Watches two agents until one certainly crashes more often, or both about equally often.

    The pairs are looked at in order, one after the other. Once a pair decides, later pairs do not count. So any number
    of workers gives the same verdict. The probability of each wrong verdict is `alpha` at most: better or worse where
    both crash equally often, and no difference where there is one above the margin.

    Args:
        margin: the greatest difference in crashes per trial that counts as none; 0 for no such verdict.
        alpha: the probability of a wrong verdict, at most.
        rounds: trials per pair.
    """

    def __init__(self, margin: float, alpha: float = 0.05, rounds: int = 1) -> None:
        self.margin, self.alpha = margin, alpha
        self.test = PairTest(rounds)
        self.verdict: PairVerdict = "undecided"

    def add(self, pairs: Sequence[Pair] | Iterator[Pair], *, may_end: bool = True) -> None:
        """Add pairs in their order, until one decides.

        Args:
            pairs: pairs in order.
            may_end: whether better and no difference are verdicts yet; worse always is one.
        """
        for pair in pairs:
            if self.verdict != "undecided":
                return
            self.test.add(pair)
            self.decide(may_end=may_end)

    def decide(self, *, may_end: bool = True) -> PairVerdict:
        """Return the verdict on the pairs that were added; the first verdict stays."""
        test = self.test
        if self.verdict == "undecided" and test.log_evidence >= -math.log(self.alpha):
            is_worse = test.only_second > test.only_first
            if is_worse or may_end:
                self.verdict = "worse" if is_worse else "better"
        elif self.verdict == "undecided" and may_end and self.margin and test.is_within(self.margin, self.alpha):
            self.verdict = "no_difference"
        return self.verdict
