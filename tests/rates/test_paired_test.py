"""Pairs of trials: which count, and what they say of a difference at any time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from crashhunt.rates import CountingRule, PairSequence, PairTest, PairWatch, TrialFacts

RULE = CountingRule(max_steps=9)


def trial(number, *, crashed=False, valid=True, has_ended=True, origin="", tags=()):
    return TrialFacts(number, has_ended, valid, crashed, 9, None, None, None, origin, tags)


def fed(sequence, *trials):
    return [pair for side, one in trials for pair in sequence.add(side, one)]


def test_pairs_count_in_the_order_of_their_numbers_up_to_the_first_that_has_not_ended_for_both():
    sequence = PairSequence((RULE, RULE))
    assert fed(sequence, (0, trial(1)), (1, trial(1)), (0, trial(0)), (1, trial(2))) == []
    assert fed(sequence, (1, trial(0, has_ended=False))) == []  # killed, so it runs again
    found = fed(sequence, (1, trial(0, crashed=True)))
    assert [[one.number for one, _ in pair] for pair in found] == [[0], [1]]
    assert found[0][0][1].crashed
    assert (sequence.position, sequence.excluded, sequence.valid) == (2, 1, 2)
    assert fed(sequence, (0, trial(0)), (1, trial(1))) == []  # looked at again


@given(st.permutations(range(12)), st.permutations(range(12)), st.integers(0, 2))
def test_pairs_do_not_depend_on_the_order_in_which_trials_end(first, second, traffics):
    rule = CountingRule(max_steps=9, traffics=traffics, planned=12)
    sequence = PairSequence((rule, rule))
    found = fed(sequence, *((0, trial(number)) for number in first), *((1, trial(number)) for number in second))
    numbers = [[one.number for one, _ in pair] for pair in found]
    expected = [list(range(turn, 12, traffics)) for turn in range(traffics)] if traffics else [[n] for n in range(12)]
    assert numbers == expected
    assert all(one.number == other.number for pair in found for one, other in pair)


def test_what_differs_or_was_guided_or_is_invalid_leaves_both_sides():
    guided = CountingRule(max_steps=9, plain_origin="random")
    sequence = PairSequence((guided, RULE), lambda one, other: one.tags == other.tags)
    pairs = fed(
        sequence,
        (0, trial(0, origin="random")), (0, trial(1, origin="mutation")), (0, trial(2, origin="random", tags=("a",))),
        (0, trial(3, origin="random", valid=False)), *((1, trial(n)) for n in range(4)),
    )  # fmt: skip
    assert [len(pair) for pair in pairs] == [1, 0, 0, 0]
    assert (sequence.valid, sequence.not_random, sequence.not_same, sequence.invalid) == (1, 1, 1, 1)
    assert "1 of 2 pairs have an invalid trial" in sequence.why_not


def counted(only_first, only_second, alike):
    test = PairTest()
    test.add_counts(only_first, only_second, alike)
    return test


def test_interval_of_the_difference_is_symmetric_and_shrinks_with_pairs():
    for counts in ((0, 0, 100), (3, 9, 500), (40, 10, 1950)):
        low, high = counted(*counts).difference()
        mirrored = counted(counts[1], counts[0], counts[2]).difference()
        assert (-high, -low) == pytest.approx(mirrored, abs=1e-6)
        observed = (counts[1] - counts[0]) / sum(counts)
        assert low < observed < high
        wider = counted(*counts).difference(alpha=0.01)
        assert wider.low < low < high < wider.high
    assert counted(0, 0, 1000).difference().high * 1000 < 5.1  # without a difference: ln(2 / alpha / weight) / n
    assert counted(0, 0, 0).difference() is None


@pytest.mark.parametrize("counts", [(0, 0, 400), (2, 1, 600), (0, 9, 100)])
def test_margin_is_decided_once_the_interval_lies_within_it(counts):
    test = counted(*counts)
    low, high = test.difference()
    for margin in (max(-low, high) * 1.001, max(-low, high) * 0.999):
        assert test.is_within(margin) == (low > -margin and high < margin)


def with_rounds(counts, rounds):
    test = PairTest(rounds)
    for (first, second), times in counts.items():
        for _ in range(times):
            test.add(tuple((trial(n, crashed=n < first), trial(n, crashed=n < second)) for n in range(rounds)))
    return test


def test_agent_that_crashes_in_more_traffics_but_less_often_is_not_the_worse_one():
    test = with_rounds({(1, 0): 60, (0, 10): 10, (0, 0): 30}, 10)
    assert (test.crashes, test.only_first, test.only_second) == ((60, 100), 60, 10)
    assert test.second_crashes_more
    assert test.log_evidence < math.log(20)
    assert not test.excludes(0.0)
    equal = with_rounds({(1, 0): 2000, (0, 2): 1000, (0, 0): 3000}, 2)  # the expected counts of equal crash rates
    assert equal.log_evidence < 0
    assert with_rounds({(1, 0): 50, (0, 0): 50}, 2).log_evidence > math.log(20)
    assert with_rounds({}, 2).log_evidence == pytest.approx(0.0)


def ever_outside(rng, only_first, only_second, pairs):
    """Whether the interval ever excludes the true difference, looked at after every pair."""
    draws = rng.random(pairs)
    difference = only_second - only_first
    first, second = np.cumsum(draws < only_first), np.cumsum(draws >= 1 - only_second)
    number = np.arange(1, pairs + 1)
    events = np.flatnonzero((draws < only_first) | (draws >= 1 - only_second))
    looks = sorted({*events, *(events[events > 0] - 1), pairs - 1})  # between two, the capital is convex
    return any(counted(first[k], second[k], number[k] - first[k] - second[k]).excludes(difference) for k in looks)


@pytest.mark.parametrize("rates", [(0.05, 0.05), (0.02, 0.06), pytest.param((0.15, 0.15), marks=pytest.mark.nightly)])
def test_interval_seldom_ever_excludes_the_true_difference(rates):
    rng = np.random.default_rng(26)
    outside = sum(ever_outside(rng, *rates, 300) for _ in range(100))
    assert outside <= 12  # 5 on average at most; more than 12 have a probability of 0.2 %


def watched(rng, base, head, pairs, margin=0.0):
    watch = PairWatch(margin)
    for number, (first, second) in enumerate(zip(rng.random(pairs) < base, rng.random(pairs) < head, strict=True)):
        watch.add([((trial(number, crashed=bool(first)), trial(number, crashed=bool(second))),)])
        if watch.verdict != "undecided":
            break
    return watch


def test_different_agents_get_a_verdict_and_equal_ones_seldom_do():
    rng = np.random.default_rng(26)
    assert sum(watched(rng, 0.2, 0.2, 300).verdict != "undecided" for _ in range(100)) <= 12
    found = [watched(rng, 0.02, 0.005, 2000) for _ in range(30)]
    assert sum(watch.verdict == "better" for watch in found) >= 26  # 28.5 on average at least
    assert not any(watch.verdict == "worse" for watch in found)


def test_verdict_stays_and_later_pairs_do_not_count():
    worse = [((trial(n), trial(n, crashed=True)),) for n in range(40)]
    watch = PairWatch(0.01)
    watch.add(worse)
    assert (watch.verdict, watch.test.pairs) == ("worse", 8)  # 1 / evidence of 8 heads is below 5 %, of 7 it is not
    better = [(both[::-1],) for (both,) in worse]
    watch.add(better)
    assert (watch.verdict, watch.test.pairs) == ("worse", 8)
    watch = PairWatch(0.01)
    watch.add(better, may_end=False)
    assert (watch.verdict, watch.test.pairs) == ("undecided", 40)
    assert watch.decide() == "better"


def test_equal_crashes_in_all_pairs_are_no_difference_above_the_margin():
    watch = PairWatch(0.02)
    watch.add([((trial(n, crashed=n % 2 == 0),) * 2,) for n in range(400)])
    assert watch.verdict == "no_difference"
    assert watch.test.both > 0
    low, high = watch.test.difference()
    assert -0.02 < low < 0 < high < 0.02
    assert 200 < watch.test.pairs < 300
