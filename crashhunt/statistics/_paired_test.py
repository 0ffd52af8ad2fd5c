"""Test and interval, valid at any time, for the question whether one of two agents crashes more often in equal traffic.

The difference Z of a pair is the failures of the second agent minus those of the first, divided by the number of
trials. A trial fails if it crashes, or if the agent's own code prevents its start. Two sums bet on each difference d:

    below(d) = sum_j w_j prod_i (1 - s_j (Z_i - d) / (1 - d))

    above(d) = sum_j w_j prod_i (1 + s_j (Z_i - d) / (1 + d))

The first sum bets that E[Z] is less than d, and the second that it is greater. Component j bets a share s_j of the
maximum stake. The evidence E(d) against d is the mean of both sums.
The interval consists of the differences with less evidence against them than 1 / alpha. The verdict follows from the
interval: one agent is worse if the interval excludes 0. Therefore interval and verdict never contradict each other.

Invariant: at the true difference each factor is positive and has mean 1 given the past. So E is a non-negative
martingale that begins at 1. By Ville's inequality, the probability that E ever reaches 1 / alpha is at most alpha.
Each factor is a positive, convex function of d. The factors of a sum are monotone in the same direction, so E is
convex. At the observed mean, E is at most 1. The differences that are not rejected are therefore an interval around
the mean, and bisection finds its ends.

If the result of a trial is unknown, its pair counts with the greatest possible Z in the first sum, and with the least
in the second. Both sums only become smaller. An interval and a verdict are therefore valid whatever the results are.

At d = 0, the factors of concordant pairs are 1, and E is the evidence of McNemar's discordant pairs (1947). Without a
difference, each of these is a fair coin. Half of the weight is on the shares of Krichevsky and Trofimov (1981), which
detect any bias eventually: s = 2 q - 1, where q has the distribution Beta(1/2, 1/2). The sum uses the nodes of Gauss
and Chebyshev. The other half bets that one side occurs three times as often as the other. Most changes of interest have
such a bias, and this half detects them sooner.

Sources: those of `_anytime_interval`. The bets on Z are those of Waudby-Smith and Ramdas (2024), with a mixture over
fixed shares.

Cost: a pair increments a counter. The bisection for one end of the interval evaluates E(d) 50 times. Each evaluation
computes one logarithm for every component j and every different value of Z.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Literal

import numpy as np

from crashhunt.statistics._anytime_interval import Interval, log_of_sum
from crashhunt.statistics._counted_pairs import SideCounts, failures_of, reason_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.statistics._counted_pairs import Pair
    from crashhunt.statistics._counted_trials import TrialFacts

_NODES = 256  # of the shares from 0 to 1; the mixture is exact up to 1,023 discordant pairs
_BIASED_SHARE = 0.5  # 2 q - 1 for a coin with q = 3/4
_SHARES: NDArray[np.float64] = np.append(np.cos(np.pi * (np.arange(_NODES) + 0.5) / (2 * _NODES)), _BIASED_SHARE)
_LOG_WEIGHTS: NDArray[np.float64] = np.log(np.append(np.full(_NODES, 0.5 / _NODES), 0.5) / 2)
_PRECISION = 1e-9  # of both ends


class PairTest:
    """Counts pairs, and returns at any time the difference that is compatible with them.

    Attributes:
        pairs: number of added pairs with known results.
        unknown: number of added pairs in which the result of a trial is unknown.
        only_first: number of pairs in which the first agent fails and the second does not. If a pair has several
            trials, number of pairs in which the first agent fails more often.
        only_second: like ``only_first``, with the two agents exchanged.
        both: number of pairs in which both agents fail, equally often.
        failures: number of failures of the first agent and of the second agent.
        trials: number of trials of each agent in the pairs that ``pairs`` counts.
        unstarted: trials of the first agent and of the second agent that failed because the agent did not start.
        lost: trials of the first agent and of the second agent whose result is unknown.
    """

    def __init__(self, rounds: int = 1) -> None:
        self._rounds = max(1, rounds)
        self.pairs = self.only_first = self.only_second = self.both = self.trials = self.unknown = 0
        self.failures = (0, 0)
        self.unstarted: tuple[list[TrialFacts], list[TrialFacts]] = ([], [])
        self.lost: tuple[list[TrialFacts], list[TrialFacts]] = ([], [])
        self._differences: Counter[tuple[float, float]] = Counter()  # the least and the greatest of each pair

    def add(self, pair: Pair) -> None:
        """Add a pair; a pair without a trial that counts is ignored."""
        if not pair:
            return
        for both in pair:
            for one, unstarted, lost in zip(both, self.unstarted, self.lost, strict=True):
                if not one.valid:
                    (unstarted if all(failures_of(one)) else lost).append(one)
        least, most = ([sum(failures_of(both[side])[end] for both in pair) for side in (0, 1)] for end in (0, 1))
        self._differences[(least[1] - most[0]) / self._rounds, (most[1] - least[0]) / self._rounds] += 1
        if least != most:
            self.unknown += 1
            return
        first, second = least
        self.pairs += 1
        self.trials += len(pair)
        self.failures = (self.failures[0] + first, self.failures[1] + second)
        self.only_first += first > second
        self.only_second += second > first
        self.both += first == second > 0

    def add_counts(self, only_first: int, only_second: int, alike: int) -> None:
        """Add the counts of pairs that have one trial per agent."""
        self.pairs += only_first + only_second + alike
        self.trials += only_first + only_second + alike
        self.only_first += only_first
        self.only_second += only_second
        self.failures = (self.failures[0] + only_first, self.failures[1] + only_second)
        self._differences.update({(-1.0, -1.0): only_first, (1.0, 1.0): only_second, (0.0, 0.0): alike})

    def side(self, side: int) -> SideCounts:
        """Return the trials of the first agent (0) or of the second (1) that are invalid for this agent only."""
        unstarted, lost = self.unstarted[side], self.lost[side]
        killed = sum(
            not one.has_ended or (one.failure is not None and one.failure.exit_code is not None) for one in lost
        )
        example = next((f"trial {one.number}: {reason_of(one)}" for one in (*unstarted, *lost)), "")
        return SideCounts(not_started=len(unstarted), killed=killed, unknown=len(lost) - killed, example=example)

    @property
    def log_evidence(self) -> float:
        """The logarithm of the evidence that the two agents do not fail equally often."""
        return self._log_evidence_against(0.0)

    def difference(self, alpha: float = 0.05) -> Interval | None:
        """Return the interval of the difference in failures per trial, second minus first agent; None without a pair.

        The probability that the interval ever excludes the true difference, after any number of pairs, is at most
        `alpha`.
        """
        if not self._differences.total():
            return None
        least, greatest = (
            sum(ends[end] * times for ends, times in self._differences.items()) / self._differences.total()
            for end in (0, 1)
        )
        return Interval(self._end(least, -1.0, alpha), self._end(greatest, 1.0, alpha))

    def verdict(self, alpha: float = 0.05) -> Literal["first", "second", ""]:
        """Return which agent fails more often, on which side of 0 the interval lies; empty if it contains 0."""
        if self.log_evidence < -math.log(alpha):
            return ""
        return "second" if self._total > 0 else "first"

    def excludes(self, difference: float, alpha: float = 0.05) -> bool:
        """Return whether the interval excludes the given difference."""
        return self._log_evidence_against(difference) >= -math.log(alpha)

    def is_within(self, margin: float, alpha: float = 0.05) -> bool:
        """Return whether the interval of the difference lies between -margin and margin."""
        if not self._differences.total() or not all(self.excludes(end, alpha) for end in (-margin, margin)):
            return False
        return abs(self._total) < margin * self._differences.total()

    @property
    def _total(self) -> float:
        """The sum of the differences of all pairs; the middle of its bounds if results are unknown."""
        return sum((least + most) / 2 * times for (least, most), times in self._differences.items())

    def _log_evidence_against(self, difference: float) -> float:
        """Return the logarithm of the evidence that the mean difference of pairs is not the given one."""
        ends = np.array(list(self._differences), float).reshape(-1, 2)
        times = np.array(list(self._differences.values()), float)
        logs = np.concatenate([
            np.log1p(-np.outer(_SHARES, side - sign * difference) / (1 - sign * difference)) @ times + _LOG_WEIGHTS
            for sign, side in ((1, ends[:, 1]), (-1, -ends[:, 0]))
        ])  # fmt: skip
        return log_of_sum(logs)

    def _end(self, inside: float, outside: float, alpha: float) -> float:
        """Return the end of the interval between the observed mean and the greatest or the least difference."""
        if abs(inside - outside) <= _PRECISION:
            return outside
        outside -= math.copysign(_PRECISION, outside)
        if not self.excludes(outside, alpha):
            return math.copysign(1.0, outside)
        if inside * outside < 0:  # so that interval and verdict agree on 0, whatever is rounded
            inside, outside = (inside, 0.0) if self.excludes(0.0, alpha) else (0.0, outside)
        while abs(outside - inside) > _PRECISION:
            middle = (inside + outside) / 2
            if self.excludes(middle, alpha):
                outside = middle
            else:
                inside = middle
        return inside
