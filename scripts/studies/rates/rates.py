"""Measure the intervals of rates where the true rate is known: coverage, width, and how soon a bar is decided.

Prints the tables of crashhunt/guide/reference/evaluation/rates-evaluation.md.
usage: scripts/studies/run rates intervals [REPETITIONS]   certain intervals, looked at after every trial (2000)
       scripts/studies/run rates hunts [REPETITIONS]       the same, of hunts that end in different ways (2000)
       scripts/studies/run rates rare [REPETITIONS] [CASE] rare mode, with 200 and 400 roots (500); a minute a case
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import beta

from crashhunt.disturbances import first_forcing
from crashhunt.statistics import (
    BLOCK,
    TRIALS_PER_ROOT,
    BarWatch,
    Bets,
    CountingRule,
    Estimated,
    RareCounter,
    RareEstimate,
    RateTest,
    TrialFacts,
    learn_forcing,
    root_of,
)
from crashhunt.trial import CRASHES, Forced

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "tests" / "statistics"))

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


def intervals(repetitions: int) -> None:
    """Print the tables of certain intervals."""
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


# Hunts that end in different ways. Each yields trials in the order in which they end.


def _trial(number: int, *, crashed: bool, origin: str = "random") -> TrialFacts:
    return TrialFacts(number, True, True, crashed, 1, None, None, None, origin)


def _whole(rng: np.random.Generator, rate: float) -> Iterable[TrialFacts]:
    return (_trial(number, crashed=bool(rng.random() < rate)) for number in range(1000))


def _until_first_crash(rng: np.random.Generator, rate: float) -> Iterable[TrialFacts]:
    for number in range(1000):
        crashed = bool(rng.random() < rate)
        yield _trial(number, crashed=crashed)
        if crashed:
            return


def _killed_and_resumed(rng: np.random.Generator, rate: float) -> Iterable[TrialFacts]:
    """Of the first run, trials that take long have not ended; those that crash take shorter."""
    crashed = rng.random(1000) < rate
    ended = np.where(crashed, rng.random(1000) < 0.95, rng.random(1000) < 0.5) & (np.arange(1000) < 500)
    for number in [*np.flatnonzero(ended), *np.flatnonzero(~ended)]:
        yield _trial(int(number), crashed=bool(crashed[number]))


def _two_workers(rng: np.random.Generator, rate: float) -> Iterable[TrialFacts]:
    """Trials that crash take a tenth of the time; the hunt ends at once when one has crashed twice in all."""
    crashed = rng.random(1000) < rate
    free, ends = [0.0, 0.0], []
    for number in range(1000):
        worker = int(np.argmin(free))
        free[worker] += 0.1 if crashed[number] else 1.0
        ends.append((free[worker], number))
    seen = 0
    for _, number in sorted(ends):
        yield _trial(number, crashed=bool(crashed[number]))
        seen += bool(crashed[number])
        if seen == 2:
            return


def _guided(rng: np.random.Generator, rate: float) -> Iterable[TrialFacts]:
    """Of a sampler that learns, a fifth of the trials is drawn at random; the others crash ten times as often."""
    for number in range(1000):
        plain = number % 5 == 0
        crashed = bool(rng.random() < (rate if plain else 10 * rate))
        yield _trial(number, crashed=crashed, origin="random" if plain else "mutation")


def _few_traffics(rng: np.random.Generator, rate: float) -> Iterable[TrialFacts]:
    """Trials of one traffic crash together: a fifth of the traffics has all crashes."""
    hard = rng.random(200) < 0.2
    return (_trial(n, crashed=bool(hard[n % 200] and rng.random() < 5 * rate)) for n in range(1000))


PLAIN = CountingRule(max_steps=1, planned=1000)
HUNTS = {
    "1,000 trials": (_whole, PLAIN),
    "stopped at the first crash": (_until_first_crash, PLAIN),
    "killed and resumed": (_killed_and_resumed, PLAIN),
    "two workers, stopped at two crashes": (_two_workers, PLAIN),
    "guided": (_guided, replace(PLAIN, plain_origin="random")),
    "--seeds 200": (_few_traffics, replace(PLAIN, traffics=200)),
}


def hunts(repetitions: int, rate: float = 0.02) -> None:
    """Print how often the interval ever excludes the true rate, by how the hunt ends."""
    print(f"hunt, rate {rate:g}                        ever outside")
    for name, (run, rule) in HUNTS.items():
        rng, out = np.random.default_rng(27), 0
        for _ in range(repetitions):
            watch = BarWatch(rule, rate, "trial", CRASHES, ALPHA)
            for trial in run(rng, rate):
                watch.add_facts(trial)
            out += watch.decided_at is not None
        print(f"{name:<40} {out / repetitions:.2%} of {repetitions:,}", flush=True)


# Rare mode, against a Markov model whose crash probability is known by dynamic programming.

CASES: dict[str, dict[str, Any]] = {
    "one onset, 1e-2": {"chances": {"stop": 5e-3}},
    "one onset, 1e-3": {"chances": {"stop": 5e-4}},
    "one onset, 1e-4": {"chances": {"stop": 5e-5}},
    "one onset, 1e-5": {"chances": {"stop": 5e-6}},
    "one onset, 1e-6": {"chances": {"stop": 5e-7}},
    "three kinds, 1e-4": {"chances": {"late_action": 5e-5, "brake": 1e-4, "stop": 5e-5}},
    "two onsets, 1e-2": {"chances": {"late_action": 5e-3, "brake": 1e-2}},
    "two onsets, 1e-4": {"chances": {"late_action": 5e-4, "brake": 1e-3}},
    "undisturbed 1e-2, one onset 1e-4": {"chances": {"stop": 5e-5}, "hidden": 2.5e-4},
    "undisturbed 1e-4, one onset 1e-4": {"chances": {"stop": 5e-5}, "hidden": 2.5e-6},
}
ROOTS = 200


REPETITIONS_AT_ONCE = 50


def rare_runs(case: dict[str, Any], roots: Sequence[int], seed: int) -> list[list[RareEstimate]]:
    """Return the estimates of some hunts, each after 200 roots and after all of its roots.

    The plain trials are drawn with the known probabilities, because nothing else counts of them.

    Args:
        case: the model.
        roots: number of roots of each hunt.
        seed: of all of them.
    """
    from markov import Model  # type: ignore[import-not-found]
    from markov_arrays import Arrays, run_roots

    model = Model(**case)
    arrays, (undisturbed, disturbed) = Arrays(model), model.truth()
    rng = np.random.default_rng([28, seed])
    start = first_forcing(model.sampler(), model.steps)
    counters = [RareCounter(min(1.0, model.hazard * model.steps)) for _ in roots]
    earlier: list[list[Forced]] = [[] for _ in roots]
    found: list[list[RareEstimate]] = [[] for _ in roots]
    for first in range(0, max(roots), BLOCK):
        here = [range(first, min(first + BLOCK, count)) for count in roots]
        learned = [
            learn_forcing(known[: max(0, first // BLOCK - 1) * BLOCK], start) if numbers else start
            for known, numbers in zip(earlier, here, strict=True)
        ]
        forcings = [forcing for forcing, numbers in zip(learned, here, strict=True) for _ in numbers]
        results = iter(run_roots(arrays, forcings, rng.integers(2**31, size=len(forcings)), rng))
        for hunt, numbers in enumerate(here):
            for number in numbers:
                result = next(results)
                assert result.forced is not None
                earlier[hunt].append(result.forced)
                root = root_of(result, CRASHES, model.hazard)
                assert root is not None
                plain = rng.random(TRIALS_PER_ROOT - 1)
                alone = int((plain < undisturbed).sum())
                root = replace(
                    root,
                    undisturbed=(root.undisturbed + alone) / TRIALS_PER_ROOT,
                    counted=(root.counted + alone) / TRIALS_PER_ROOT,
                    plain=len(plain),
                    plain_undisturbed=alone,
                    plain_crashes=int((plain < undisturbed + disturbed).sum()),
                    plain_steps=model.steps * len(plain),
                )
                counters[hunt].add(root)
                if number + 1 in (ROOTS, roots[hunt]):
                    found[hunt].append(counters[hunt].estimate())
    return found


def rare(repetitions: int, name: str) -> None:
    """Run a case of rare mode, and print its line of the table after every 50 repetitions."""
    runs: list[list[RareEstimate]] = []
    while len(runs) < repetitions:
        # Every fifth run has 400 roots.
        numbers = range(len(runs), min(len(runs) + REPETITIONS_AT_ONCE, repetitions))
        runs += rare_runs(CASES[name], [2 * ROOTS if one % 5 == 0 else ROOTS for one in numbers], numbers[0])
        _print_rare(name, runs)


def _print_rare(name: str, runs: list[list[RareEstimate]]) -> None:
    from markov import Model

    repetitions = len(runs)
    parts = Model(**CASES[name]).truth()
    truth = math.fsum(parts)
    values = np.array([run[0].estimate for run in runs], float)
    z = (values.mean() - truth) / (values.std(ddof=1) / math.sqrt(repetitions))
    by_roots = [run[0] for run in runs], [run[1] for run in runs if len(run) > 1]
    whole = "; ".join(_coverage([one.estimated for one in some], truth) for some in by_roots)
    disturbed = "; ".join(_coverage([one.estimated_disturbed for one in some], parts[1]) for some in by_roots)
    low, high = np.transpose([run[0].certain for run in runs if run[0].certain is not None])
    gain = np.median([(run[0].plain_equivalent_steps or 0.0) / run[0].steps for run in runs])
    print(
        f"{name:<34} {repetitions} repetitions  truth {truth:.3g}  mean {values.mean():.3g}  z {z:+.2f}  "
        f"with 200 and 400 roots: {whole}  disturbed part: {disturbed}  "
        f"at most covers {np.mean(high >= truth):.1%}  at least covers {np.mean(low <= truth):.1%}  "
        f"median at most {np.median(high):.2g}  median at least {np.median(low):.2g}  steps saved {gain:.0f} times",
        flush=True,
    )


def _coverage(found: list[Estimated | None], truth: float) -> str:
    """Return how often an interval was reported, how often it covers the truth, and how often it lies above it."""
    told = [one for one in found if one is not None]
    if not told:
        return "reported 0%"
    above, below = np.mean([one.low > truth for one in told]), np.mean([one.high < truth for one in told])
    return f"reported {len(told) / len(found):.1%}, covers {1 - above - below:.1%} (above the truth {above:.1%})"


def main(words: list[str]) -> None:
    """Print the tables that were asked for."""
    part = words[0] if words else "intervals"
    repetitions = int(words[1]) if len(words) > 1 else (500 if part == "rare" else 2000)
    if part == "intervals":
        intervals(repetitions)
    elif part == "hunts":
        hunts(repetitions)
    else:
        for name in CASES:
            if len(words) < 3 or words[2] in name:
                rare(repetitions, name)


if __name__ == "__main__":
    main(sys.argv[1:])
