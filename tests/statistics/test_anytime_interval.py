"""Certain intervals: against the formula written out, against Clopper and Pearson, and against known rates."""

from __future__ import annotations

import math
from copy import deepcopy
from itertools import pairwise, product

import numpy as np
import pytest
from conftest import examples
from hypothesis import given, strategies as st

from crashhunt.statistics import Bets, Interval, RateTest

COUNTS = st.integers(0, 3000).flatmap(lambda count: st.tuples(st.integers(0, count), st.just(count)))
UNITS = st.lists(st.tuples(st.sampled_from([0.0, 1.0]), st.floats(0.01, 1.0)), min_size=1, max_size=25)


def beta_quantile(share: float, a: float, b: float) -> float:
    """Return a quantile of a beta distribution."""
    from scipy.stats import beta  # takes 0.8 s, and every worker collects this module

    return beta.ppf(share, a, b)


def counted(crashes: int, trials: int, bets: Bets | None = None) -> RateTest:
    test = RateTest(bets)
    test.add(1.0, 1.0, crashes)
    test.add(0.0, 1.0, trials - crashes)
    return test


KNOTS = ((1e-7, 0.6), (6.3e-5, 1.0), (1.26e-4, 6.0), (0.063, 6.0), (0.158, 2.0), (0.98, 2.0), (1e3, 0.5))


def weight_of(rate):
    """Return the weight of a component up to a factor: linear in the logarithm of its rate."""
    for (low, before), (high, after) in pairwise(KNOTS):
        if low <= rate <= high:
            share = math.log(rate / low) / math.log(high / low)
            return before + (after - before) * share
    return KNOTS[0][1] if rate < 1e-7 else KNOTS[-1][1]


def written_out(units, rate, components=162, most_events=1.0, most_exposure=1.0, top=0.98):
    """The sum of products, in plain Python, over components that end above 1 and over all."""
    alternatives = [0.0, *np.geomspace(1e-7, top, components)]
    capitals = []
    for q in alternatives:
        k = min(max(q / most_exposure / rate - 1, -0.999 / most_events), 0.999 / (rate * most_exposure))
        capitals.append(math.prod(1 + k * (events - rate * exposure) for events, exposure in units))
    shares = [weight_of(q) for q in alternatives[1:]]
    weights = [0.535, *(0.465 * share / sum(shares) for share in shares)]
    each = [weight * capital for weight, capital in zip(weights, capitals, strict=True)]
    return sum(part for part, capital in zip(each, capitals, strict=True) if capital > 1), sum(each)


@given(COUNTS, st.floats(1e-6, 0.999))
def test_evidence_is_the_sum_of_products(counts, rate):
    crashes, trials = counts[0] % 40, counts[1] % 40 + 40
    units = [(1.0, 1.0)] * crashes + [(0.0, 1.0)] * (trials - crashes)
    test = counted(crashes, trials)
    won, everything = written_out(units, rate)
    assert math.exp(test.bets.log_mixture(test.log_capitals(rate))) == pytest.approx(everything, rel=1e-9)
    assert math.exp(test.log_evidence(rate)) == pytest.approx(won, rel=1e-9)
    assert 0 <= everything - won <= 1  # what components below 1 would add


@given(UNITS, st.floats(1e-3, 50.0))
def test_evidence_of_exposures_is_the_sum_of_products(units, rate):
    test = RateTest(Bets(1.0, 2.0))
    test.extend(units)
    grid = test.bets._alternatives
    top = grid[-1] * 2.0
    assert grid[1] == pytest.approx(1e-7 / 2)
    assert grid[162] == pytest.approx(0.98 / 2)
    won, _ = written_out(units, rate, len(grid) - 1, 1.0, 2.0, top)
    assert math.exp(test.log_evidence(rate)) == pytest.approx(won, rel=1e-6, abs=1e-12)


@given(COUNTS)
def test_interval_contains_the_observed_rate_and_lies_in_the_unit_interval(counts):
    crashes, trials = counts
    low, high = counted(crashes, trials).interval()
    assert 0.0 <= low <= (crashes / trials if trials else 0.0) <= high <= 1.0
    assert (low == 0.0) == (crashes == 0)


@given(COUNTS)
def test_evidence_reaches_the_threshold_at_both_ends_and_nowhere_between(counts):
    crashes, trials = counts
    test = counted(crashes, trials)
    low, high = test.interval()
    inside = np.linspace(low, high, 23)[1:-1]
    assert all(test.log_evidence(rate) < math.log(20) for rate in inside if rate > 0)
    for end, factor in ((low, 1 - 1e-6), (high, 1 + 1e-6)):
        if 0 < end < 1:
            assert test.log_evidence(end * factor) >= math.log(20) > test.log_evidence(end / factor)


@given(UNITS)
def test_no_rate_beyond_an_end_has_less_evidence(units):
    """The ends are where the evidence first reaches the threshold; it must not fall below it further out."""
    test = RateTest(Bets(1.0, 1.0, fixed_exposure=False))
    test.extend(units * 20)
    low, high = test.interval()
    factors = np.geomspace(1.0001, 1e5, examples(200))
    beyond = [high * factor for factor in factors] + [low / factor for factor in factors if low > 0]
    mixture = [test.bets.log_mixture(test.log_capitals(rate)) for rate in beyond]
    assert min(map(test.log_evidence, beyond)) >= math.log(20)
    assert min(mixture) >= math.log(20)


def test_each_component_falls_and_then_rises_in_the_rate():
    """The proof of the crossings: the slope of a component of n trials and c crashes has the sign of this cubic.

    n r³ + r² (c - q n) + r q (n - 2 c) - c q (1 - q) has one root above 0 for all shares of crashes and all q.
    """
    for share, q in product(np.linspace(0.005, 1, examples(200)), np.geomspace(1e-7, 0.98, examples(60))):
        roots = np.roots([1.0, share - q, q * (1 - 2 * share), -share * q * (1 - q)])
        above = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-15)]
        assert len(above) == 1, (share, q)


@given(COUNTS)
def test_more_trials_without_a_crash_lower_both_ends_and_a_crash_raises_both(counts):
    crashes, trials = counts
    low, high = counted(crashes, trials).interval()
    calm = counted(crashes, trials + 1 + trials // 4).interval()
    crashed = counted(crashes + 1, trials + 1).interval()
    assert calm.high <= high * (1 + 1e-8)
    assert calm.low <= low * (1 + 1e-8)
    assert crashed.low >= low * (1 - 1e-8)
    assert crashed.high >= high * (1 - 1e-8)


@given(COUNTS, st.floats(0.5, 0.999), st.floats(0.5, 0.999))
def test_more_confidence_gives_a_wider_interval(counts, first, second):
    test = counted(*counts)
    narrow, wide = (test.interval(1 - level) for level in sorted((first, second)))
    assert wide.low <= narrow.low * (1 + 1e-8)
    assert wide.high >= narrow.high * (1 - 1e-8)


@given(UNITS, st.floats(1e-3, 1e3))
def test_the_unit_of_exposure_scales_the_interval(units, scale):
    one, other = RateTest(Bets(1.0, 1.0, fixed_exposure=False)), RateTest(Bets(1.0, scale, fixed_exposure=False))
    one.extend(units)
    other.extend((events, exposure * scale) for events, exposure in units)
    assert np.multiply(other.interval(), scale) == pytest.approx(one.interval(), rel=1e-6)


@given(UNITS, st.randoms())
def test_order_of_units_does_not_change_the_interval(units, random):
    shuffled = units.copy()
    random.shuffle(shuffled)
    found = []
    for each in (units, shuffled):
        test = RateTest(Bets(1.0, 1.0, fixed_exposure=False))
        test.extend(each)
        found.append(test.interval())
    assert found[0] == pytest.approx(found[1], rel=1e-8)


def test_without_units_nothing_is_excluded():
    assert RateTest().interval() == Interval(0.0, 1.0)
    assert RateTest(Bets(1.0, 3.0)).interval() == Interval(0.0, math.inf)
    assert RateTest().verdict(0.5) == "undecided"


@pytest.mark.parametrize("trials", [30, 100, 300, 1000, 3000, 9000])
def test_no_crash_gives_at_most_3_6_by_n_and_less_than_clopper_and_pearson(trials):
    found = counted(0, trials).interval()
    assert found.low == 0.0
    assert found.high * trials <= 3.6
    assert found.high < 1 - 0.025 ** (1 / trials)


def test_figure_of_the_guide_for_no_crash_in_3515_trials():
    assert counted(0, 3515).interval().high == pytest.approx(9.86e-4, rel=0.005)


@pytest.mark.parametrize("trials", [100, 1000, 10_000, 100_000])
def test_width_at_30_crashes_is_at_most_1_83_times_that_of_clopper_and_pearson(trials):
    low, high = counted(30, trials).interval()
    exact = beta_quantile(0.975, 31, trials - 30) - beta_quantile(0.025, 30, trials - 29)
    assert 1.0 < (high - low) / exact <= 1.83


@pytest.mark.parametrize("unit", [(1.5, 1.0), (-0.1, 1.0), (0.0, 1.01), (0.0, math.nan)])
def test_a_unit_beyond_its_bounds_is_refused(unit):
    with pytest.raises(ValueError, match="at most 1 events and exposure 1"):
        RateTest().add(*unit)


def test_impossible_bounds_are_refused():
    with pytest.raises(ValueError, match="must be finite and above 0"):
        Bets(1.0, math.inf)


@given(COUNTS, st.floats(1e-5, 0.99))
def test_verdict_is_the_side_of_the_bar_on_which_the_interval_lies(counts, bar):
    test = counted(*counts)
    low, high = test.interval()
    expected = "below" if high < bar else "above" if low > bar else "undecided"
    if min(abs(high / bar - 1), abs(low / bar - 1)) > 1e-6:
        assert test.verdict(bar) == expected


def ever_outside(rng, rate, trials, repetitions, alpha=0.05):
    """The share of repetitions in which the martingale at the true rate ever reaches 1 / alpha, looked at every trial.

    Between two crashes it is a sum of exponentials in the number of trials, which is convex: the most is at a crash.
    """
    bets, out = Bets(), 0
    stakes = bets.stakes(rate)
    gain, loss = np.log1p(stakes * (1 - rate)), np.log1p(-stakes * rate)
    for _ in range(repetitions):
        gaps = rng.geometric(rate, size=int(trials * rate * 2 + 40))
        at = np.cumsum(gaps)
        at = at[at <= trials]
        crashes = np.arange(len(at))
        before = np.outer(crashes, gain) + np.outer(at - 1 - crashes, loss)
        last = (len(at) * gain + (trials - len(at)) * loss)[None]
        most = max(bets.log_mixture(row) for row in (*before, *(before + gain), *last))
        out += most >= -math.log(alpha)
    return out / repetitions


def test_the_true_rate_is_rarely_ever_outside():
    assert ever_outside(np.random.default_rng(1), 0.01, 3000, 100) <= 0.10


@pytest.mark.nightly
@pytest.mark.parametrize("rate", [1e-2, 1e-3, 1e-4])
def test_the_true_rate_is_ever_outside_in_at_most_5_5_percent_of_2000_runs(rate):
    assert ever_outside(np.random.default_rng(7), rate, int(100 / rate), 2000) <= 0.055


def test_the_interval_of_exposures_covers_the_true_rate():
    """Crashes end trials early, so exposure and crash depend on each other, as they do in real trials."""
    rng, hazard, longest, outside = np.random.default_rng(5), 0.02, 10.0, 0
    for _ in range(examples(60)):
        ends = rng.exponential(1 / hazard, 400)
        test = RateTest(Bets(1.0, longest, fixed_exposure=False))
        test.extend((float(end < longest), min(end, longest)) for end in ends)
        low, high = test.interval()
        outside += not low <= hazard <= high
    assert outside <= examples(60) / 15  # a twentieth on average at most


def test_clusters_count_as_one_unit():
    """Ten trials of a traffic that all crash or all survive say no more than one of them."""
    alone, together = RateTest(), RateTest(Bets(10.0, 10.0))
    alone.add(1, 1, 3)
    alone.add(0, 1, 57)
    together.add(10, 10, 3)
    together.add(0, 10, 57)
    assert together.observed == alone.observed
    assert together.interval().high >= alone.interval().high * 0.9
    assert together.interval().low <= alone.interval().low * 1.1


def test_many_different_exposures_are_spread_and_never_make_the_interval_narrower():
    rng = np.random.default_rng(3)
    exposures = rng.uniform(0.0, 2.0, 1500)
    units = [(float(rng.random() < 0.1 * exposure), float(exposure)) for exposure in exposures]
    spread, exact = RateTest(Bets(1.0, 2.0)), RateTest(Bets(1.0, 2.0))
    spread.extend(units)
    exact._spreads = None  # neither True nor a reason to begin
    for events, exposure in units:
        exact._units[events, exposure] += 1
    exact.events, exact.exposure = spread.events, spread.exposure
    assert len(spread._units) <= 2 * 257
    assert sum(count for _, count in spread._units.items()) == pytest.approx(1500)
    assert sum(over * count for (_, over), count in spread._units.items()) == pytest.approx(sum(exposures))
    for rate in np.geomspace(1e-3, 10, examples(60)):
        assert (spread.log_capitals(rate) <= exact.log_capitals(rate) + 1e-9).all()
    assert spread.interval() == pytest.approx(exact.interval(), rel=1e-3)
    at_once = deepcopy(spread)
    at_once.add(1.0, 0.7, times=3)
    spread.extend([(1.0, 0.7)] * 3)
    assert at_once.log_capitals(0.1) == pytest.approx(spread.log_capitals(0.1))


def test_interval_of_many_events_is_as_narrow_as_the_data_allow():
    """A grid of 40 components was 5.6 times as wide here."""
    low, high = counted(3000, 100_000).interval()
    exact = beta_quantile(0.975, 3001, 97_000) - beta_quantile(0.025, 3000, 97_001)
    assert high - low < 2.3 * exact


def test_interval_keeps_its_width_up_to_100_000_trials():
    for trials in (30, 100, 1000, 10_000, 100_000):
        assert counted(0, trials).interval().high * trials < 3.6
    for trials in (100, 1000, 3000, 10_000, 100_000):
        low, high = counted(30, trials).interval()
        exact = beta_quantile(0.975, 31, trials - 30) - beta_quantile(0.025, 30, trials - 29)
        assert high - low < 1.8 * exact
