"""Measure the verdicts of gates: how often two equal agents are told apart, and how soon two different ones are.

Prints the tables of crashhunt/guide/reference/evaluation/gate-evaluation.md. Every gate is looked at after every pair.
usage: scripts/studies/run gates [REPETITIONS]   (2000 unless given, half as many for each row; about three minutes)
"""

from __future__ import annotations

import sys
from collections import Counter
from typing import NamedTuple

import numpy as np

from crashhunt.statistics import PairTest, PairWatch


class Chances(NamedTuple):
    """How often trials of a pair crash.

    Args:
        base: crash rate of BASE.
        head: of HEAD.
        shared: how often both crash because of the traffic; part of both rates.
    """

    base: float
    head: float
    shared: float = 0.0

    @property
    def only(self) -> tuple[float, float]:
        """How often only BASE crashes, and only HEAD, if they crash independently besides what they share."""
        base, head = ((rate - self.shared) / (1 - self.shared) for rate in (self.base, self.head))
        return (1 - self.shared) * base * (1 - head), (1 - self.shared) * head * (1 - base)


def gate(rng: np.random.Generator, chances: Chances, pairs: int, margin: float) -> tuple[str, int]:
    """Return the verdict of a gate that is looked at after every pair, and after how many pairs it came.

    Between two discordant pairs the evidence of difference stays, and that of no difference grows. So the first moment
    of either is found by a look at each discordant pair, and by bisection in between.
    """
    only_base, only_head = chances.only
    draws = rng.random(pairs)
    kinds = np.where(draws < only_base, -1, np.where(draws < only_base + only_head, 1, 0))
    watch, ended, counts = PairWatch(margin), 0, [0, 0]
    for place in [*np.flatnonzero(kinds), pairs]:
        alike = int(place) - ended
        if margin and alike and (found := _within(counts, ended, alike, margin)):
            return "no_difference", found
        ended = int(place)
        if ended == pairs:
            break
        counts[int(kinds[place] > 0)] += 1
        watch.test = counted_pairs(counts, ended + 1)
        ended += 1
        if (verdict := watch.decide()) != "undecided":
            return verdict, ended
    return "undecided", pairs


def _within(counts: list[int], ended: int, alike: int, margin: float) -> int:
    """Return after how many pairs the interval lies within the margin, if it does before the next discordant pair."""
    if not counted_pairs(counts, ended + alike).is_within(margin):
        return 0
    low, high = ended, ended + alike
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if counted_pairs(counts, middle).is_within(margin) else (middle, high)
    return high


def counted_pairs(counts: list[int], pairs: int) -> PairTest:
    """Return the test of so many pairs, in some of which only BASE or only HEAD crashes."""
    test = PairTest()
    test.add_counts(counts[0], counts[1], pairs - sum(counts))
    return test


def difference_ever_outside(rng: np.random.Generator, chances: Chances, pairs: int) -> bool:
    """Return whether the interval of the difference ever excludes the true one, over all numbers of pairs.

    Between two discordant pairs the capital of each end is a sum of exponentials in the number of pairs, so convex. So
    its maximum is just before or just after a discordant pair, or at the end.
    """
    only_base, only_head = chances.only
    draws = rng.random(pairs)
    is_base, is_head = draws < only_base, (draws >= only_base) & (draws < only_base + only_head)
    events = np.flatnonzero(is_base | is_head)
    looks = np.unique(np.concatenate((events[events > 0] - 1, events, [pairs - 1])))
    base, head, true = np.cumsum(is_base), np.cumsum(is_head), only_head - only_base
    for place in looks:
        test = counted_pairs([int(base[place]), int(head[place])], int(place) + 1)
        if test.excludes(true):
            return True
    return False


def study_gates(repetitions: int) -> None:
    """Print the tables of gates."""
    rng = np.random.default_rng(26)
    print("BASE    HEAD    shared  pairs   margin  better  worse  no difference  undecided  median pairs to a verdict")
    for chances, pairs, margin in (
        (Chances(0.02, 0.02), 2000, 0.0),
        (Chances(0.2, 0.2), 2000, 0.0),
        (Chances(0.2, 0.2, 0.15), 2000, 0.0),
        (Chances(0.002, 0.002), 20_000, 0.0),
        (Chances(0.02, 0.005), 2000, 0.0),
        (Chances(0.005, 0.02), 2000, 0.0),
        (Chances(0.02, 0.005, 0.004), 2000, 0.0),
        (Chances(0.0, 0.0), 1000, 0.01),
        (Chances(0.02, 0.02, 0.018), 1000, 0.01),
        (Chances(0.02, 0.02), 10_000, 0.01),
        (Chances(0.02, 0.03), 10_000, 0.01),
    ):
        ends = [gate(rng, chances, pairs, margin) for _ in range(repetitions // 2)]
        found = Counter(verdict for verdict, _ in ends)
        decided = [number for verdict, number in ends if verdict != "undecided"]
        shares = (found[verdict] / len(ends) for verdict in ("better", "worse", "no_difference", "undecided"))
        words = [f"{chances.base:<7g} {chances.head:<7g} {chances.shared:<7g} {pairs:<7} {margin:<7g}"]
        words += [f"{share:7.1%}" for share in shares]
        print(*words, f"  {np.median(decided):,.0f}" if decided else "  -")
    print("\nBASE    HEAD    shared  pairs   difference ever outside")
    for chances, pairs in (
        (Chances(0.02, 0.02), 2000),
        (Chances(0.2, 0.2), 1000),
        (Chances(0.02, 0.005), 2000),
        (Chances(0.3, 0.5, 0.2), 1000),
    ):
        out = sum(difference_ever_outside(rng, chances, pairs) for _ in range(repetitions // 2))
        print(f"{chances.base:<7g} {chances.head:<7g} {chances.shared:<7g} {pairs:<7} {out / (repetitions // 2):.1%}")
    print("\npairs   interval of the difference without a discordant pair")
    for pairs in (100, 300, 1000, 3000):
        low, high = counted_pairs([0, 0], pairs).difference() or (0.0, 0.0)
        print(f"{pairs:<7} {low:+.4f} to {high:+.4f}  ({high * pairs:.2f}/n)")


if __name__ == "__main__":
    study_gates(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
