"""Test and interval, valid at any time, for the question whether one of two agents crashes more often in equal traffic.

A pair is one trial of each agent with the same number, seed and traffic. Pairs count in the order of their numbers, up
to the first number whose trials have not both ended. A crash ends a trial early, so the finished pairs are not a fair
sample, but the first k pairs are. With `--seeds`, a pair consists of all trials of a traffic seed.

The difference of a pair is Z = (crashes of the second - crashes of the first) / trials, from -1 to 1. The
interval of E[Z] has two ends, each with half of the error probability. For the upper end, each component bets
that E[Z] is less than d, with a share s of its maximum stake:

    E(d) = sum_j w_j / 2 prod_i (1 - s_j (Z_i - d) / (1 - d)).

Invariant: at the true difference each factor is positive and has mean 1 given the past. The sum is therefore a
non-negative martingale that begins at 1 / 2. By Ville's inequality, the probability that the sum ever reaches 1 / alpha
is at most alpha / 2. Each factor grows with d for every Z. The differences that are not rejected are therefore an
interval, and bisection finds its end. The lower end is the upper end of -Z.

The evidence of a difference is that of discordant pairs. With several trials in a pair, it is E(0) of Z plus that of
-Z.

Sources: those of `_anytime_interval`, which computes the evidence of discordant pairs. The bets on Z are those of
Waudby-Smith and Ramdas (2024), with a mixture over fixed shares.

Cost: a pair increments a counter. The bisection for one end of the interval evaluates E(d) 50 times. Each evaluation
computes one logarithm for every component j and every different value of Z.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Literal

import numpy as np

from crashhunt.rates._anytime_interval import Interval, discordance_evidence
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
    """Combines trials of two agents, which end in any order, to pairs in the order of their numbers.

    A trial that is invalid for one agent is excluded for both. Trials that are not drawn at random do not count.

    Args:
        rules: counting rules for the trials of the first agent and of the second agent.
        is_same: function that returns whether two trials of the same number have the same seed and traffic; by default,
            all have.

    Attributes:
        rounds: number of trials in each pair.
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
        self.rounds = min(rule.trials_per_unit for rule in rules) if self._traffics else 1
        self.valid = self.invalid = self.not_random = self.not_same = 0  # pairs of trials

    def add(self, side: int, trial: TrialFacts) -> Iterator[Pair]:
        """Add a trial, and yield the newly complete pairs, including pairs without a trial that counts.

        Args:
            side: 0 for a trial of the first agent, 1 for a trial of the second agent.
            trial: trial of any number; a trial that was added before is ignored.
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
        return not self._traffics or number < self._traffics * self.rounds

    def _numbers(self, place: int) -> list[int]:
        """Return the numbers of the trials of a pair; empty if the hunt has no such traffic seed."""
        if not self._traffics:
            return [place]
        if place >= self._traffics:
            return []
        return [place + turn * self._traffics for turn in range(self.rounds)]

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
        """The number of the first trial, or traffic seed, that has not ended for both agents."""
        return self._next

    @property
    def excluded(self) -> int:
        """The number of trials that have ended, but do not belong to a complete pair yet."""
        return sum(map(len, self._waiting))

    @property
    def invalid_share(self) -> float:
        """The share of pairs with an invalid trial."""
        return self.invalid / (self.invalid + self.valid) if self.invalid else 0.0

    @property
    def is_hopeless(self) -> bool:
        """Whether too many pairs certainly have an invalid trial."""
        return has_too_many_invalid(self.invalid, self.valid)

    @property
    def why_not(self) -> str:
        """The reason why the pairs allow no verdict; empty if they allow one."""
        if self.invalid_share <= MAX_INVALID_SHARE:
            return ""
        many = f"{self.invalid} of {self.invalid + self.valid} pairs have an invalid trial"
        return f"{many}, more than {MAX_INVALID_SHARE:.0%}: the rest is other traffic than described"


class PairTest:
    """Counts pairs, and returns at any time the difference that is compatible with them.

    Attributes:
        pairs: number of added pairs with at least one trial that is valid for both agents.
        only_first: number of pairs in which the first agent crashes and the second does not. If a pair has several
            trials, number of pairs in which the first agent crashes more often.
        only_second: like ``only_first``, with the two agents exchanged.
        both: number of pairs in which both agents crash, equally often.
        crashes: number of crashes of the first agent and of the second agent.
        trials: number of trials of each agent in the pairs that ``pairs`` counts.
    """

    def __init__(self, rounds: int = 1) -> None:
        self._rounds = max(1, rounds)
        self.pairs = self.only_first = self.only_second = self.both = self.trials = 0
        self.crashes = (0, 0)
        self._differences: Counter[float] = Counter()

    def add(self, pair: Pair) -> None:
        """Add a pair; a pair without a trial that counts is ignored."""
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
        """Add the counts of pairs that have one trial per agent.

        Args:
            only_first: number of pairs in which only the first agent crashes.
            only_second: number of pairs in which only the second agent crashes.
            alike: number of pairs in which no agent crashes, or both do.
        """
        self.pairs += only_first + only_second + alike
        self.trials += only_first + only_second + alike
        self.only_first += only_first
        self.only_second += only_second
        self.crashes = (self.crashes[0] + only_first, self.crashes[1] + only_second)
        self._differences.update({-1.0: only_first, 1.0: only_second, 0.0: alike})

    @property
    def log_evidence(self) -> float:
        """The logarithm of the evidence that the two agents do not crash equally often."""
        if self._rounds == 1:
            return discordance_evidence(self.only_first, self.only_second)
        # With several trials, an agent that crashes in more pairs may crash less often, so the sign is no fair coin.
        ends = [self._log_evidence_below(0.0, sign) for sign in (1, -1)]
        return max(ends) + math.log1p(math.exp(-abs(ends[0] - ends[1])))

    @property
    def second_crashes_more(self) -> bool:
        """Whether the second agent crashed more often in the pairs."""
        return self.crashes[1] > self.crashes[0]

    def difference(self, alpha: float = 0.05) -> Interval | None:
        """Return the interval of the difference in crashes per trial, second minus first agent; None without a pair.

        The probability that the interval ever excludes the true difference, after any number of pairs, is at most
        `alpha`.
        """
        if not self.pairs:
            return None
        return Interval(-self._upper_end(-1, alpha), self._upper_end(1, alpha))

    def excludes(self, difference: float, alpha: float = 0.05) -> bool:
        """Return whether the interval excludes the given difference."""
        threshold = -math.log(alpha)
        return max(self._log_evidence_below(sign * difference, sign) for sign in (1, -1)) >= threshold

    def is_within(self, margin: float, alpha: float = 0.05) -> bool:
        """Return whether the interval of the difference lies between -margin and margin."""
        threshold = -math.log(alpha)
        return self.pairs > 0 and all(self._log_evidence_below(margin, sign) >= threshold for sign in (1, -1))

    def _log_evidence_below(self, difference: float, sign: int) -> float:
        """Return the logarithm of the evidence that ``sign`` times the mean difference of pairs is below a value."""
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
    """Watches two agents until one agent certainly crashes more often, or both certainly crash about equally often.

    The pairs are evaluated in order, one after another. After a decision, later pairs do not count, so the verdict does
    not depend on the number of workers. The probability of each wrong verdict is at most `alpha`: *better* or *worse*
    if both agents crash equally often, and *no difference* if the difference is above the margin.

    Args:
        margin: the greatest difference in crashes per trial that counts as no difference; 0 to disable this verdict.
        alpha: maximum probability of a wrong verdict.
        rounds: number of trials in each pair.
    """

    def __init__(self, margin: float, alpha: float = 0.05, rounds: int = 1) -> None:
        self.margin, self.alpha = margin, alpha
        self.test = PairTest(rounds)
        self.verdict: PairVerdict = "undecided"

    def add(self, pairs: Sequence[Pair] | Iterator[Pair], *, may_end: bool = True) -> None:
        """Add pairs in their order until a pair decides.

        Args:
            pairs: the pairs, in the order of their numbers.
            may_end: whether the verdicts *better* and *no difference* are allowed yet; *worse* is always allowed.
        """
        for pair in pairs:
            if self.verdict != "undecided":
                return
            self.test.add(pair)
            self.decide(may_end=may_end)

    def decide(self, *, may_end: bool = True) -> PairVerdict:
        """Return the verdict on the pairs that were added; the first verdict is final."""
        test = self.test
        if self.verdict == "undecided" and test.log_evidence >= -math.log(self.alpha):
            is_worse = test.second_crashes_more
            if is_worse or may_end:
                self.verdict = "worse" if is_worse else "better"
        elif self.verdict == "undecided" and may_end and self.margin and test.is_within(self.margin, self.alpha):
            self.verdict = "no_difference"
        return self.verdict
