"""Measure the certain intervals of rates: coverage, width, and how soon a bar is decided.

Prints the tables of crashhunt/guide/reference/rates.md. Every run is looked at after every trial.
usage: scripts/rates_study.py [REPETITIONS]   (2000, unless another number is given; about a minute)
"""

from __future__ import annotations

import math
import sys

import numpy as np
from scipy.stats import beta

from crashhunt.rates import Bets, RateTest

ALPHA = 0.05
BETS = Bets()


def martingale_peak(rng: np.random.Generator, rate: float, trials: int) -> float:
    """Return the greatest logarithm of the martingale at the true rate, over all numbers of trials.

    Between two crashes the martingale is a sum of exponentials in the number of trials. That is convex, so its maximum
    is just before or just after a crash, or at the end.
    """
    stakes = BETS.stakes(rate)
    gain, loss = np.log1p(stakes * (1 - rate)), np.log1p(-stakes * rate)
    at = np.cumsum(rng.geometric(rate, size=int(2 * trials * rate + 40)))
    at = at[at <= trials]
    crashes = np.arange(len(at))
    before = np.outer(crashes, gain) + np.outer(at - 1 - crashes, loss)
    end = len(at) * gain + (trials - len(at)) * loss
    return max(BETS.log_mixture(row) for row in (*before, *(before + gain), end))


def trials_to_decide(rng: np.random.Generator, rate: float, bar: float) -> tuple[int, str]:
    """Return after how many trials a bar is decided, and how."""
    stakes = BETS.stakes(bar)
    gain, loss = np.log1p(stakes * (1 - bar)), np.log1p(-stakes * bar)
    crashes = np.cumsum(rng.random(int(200 / bar)) < rate)
    for first in range(0, len(crashes), 200):
        number = np.arange(first + 1, first + 201)
        capitals = np.outer(crashes[first : first + 200], gain) + np.outer(number - crashes[first : first + 200], loss)
        for place, row in enumerate(capitals):
            if BETS.log_evidence(row) >= -math.log(ALPHA):
                trials = first + place + 1
                return trials, "below" if crashes[trials - 1] < bar * trials else "above"
    return len(crashes), "undecided"


def counted(crashes: int, trials: int) -> RateTest:
    """Return the test of so many crashes in so many trials."""
    test = RateTest(BETS)
    test.add(1.0, 1.0, crashes)
    test.add(0.0, 1.0, trials - crashes)
    return test


def main(repetitions: int) -> None:
    """Print the tables."""
    rng = np.random.default_rng(26)
    print("rate    trials     ever outside")
    for rate in (1e-2, 1e-3, 1e-4):
        trials = round(100 / rate)
        out = sum(martingale_peak(rng, rate, trials) >= -math.log(ALPHA) for _ in range(repetitions))
        print(f"{rate:<7g} {trials:<10,} {out / repetitions:.2%} of {repetitions:,}")
    print("\ntrials     at most, without a crash     Clopper and Pearson")
    for trials in (30, 100, 300, 1000, 3000, 9000, 30_000, 100_000):
        high = counted(0, trials).interval(ALPHA).high
        print(f"{trials:<10,} {high * trials:.2f}/n {'':22} {(1 - (ALPHA / 2) ** (1 / trials)) * trials:.2f}/n")
    print("\ntrials     width at 30 crashes, by that of Clopper and Pearson")
    for trials in (100, 1000, 10_000, 100_000):
        low, high = counted(30, trials).interval(ALPHA)
        exact = beta.ppf(1 - ALPHA / 2, 31, trials - 30) - beta.ppf(ALPHA / 2, 30, trials - 29)
        print(f"{trials:<10,} {(high - low) / exact:.2f}")
    print("\nrate by bar     median trials by 1/bar     wrong")
    bar = 0.01
    for share in (0.0, 1 / 3, 0.5, 2.0):
        ends = [trials_to_decide(rng, share * bar, bar) for _ in range(repetitions // 2)]
        wrong = sum(verdict == ("above" if share < 1 else "below") for _, verdict in ends)
        print(f"{share:<15.2f} {np.median([n for n, _ in ends]) * bar:<26.1f} {wrong} of {len(ends):,}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
