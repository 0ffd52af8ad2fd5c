"""Pairs of trials: which count, and what they say of a difference at any time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import examples
from hypothesis import given, strategies as st

from crashhunt.statistics import CountingRule, PairTest, PairWatch, TrialFacts
from crashhunt.statistics._counted_pairs import PairSequence
from crashhunt.trial import Failure

RULE = CountingRule(max_steps=9)


def trial(number, *, crashed=False, valid=True, has_ended=True, origin="", tags=(), failure=None):
    valid = valid and has_ended and failure is None
    return TrialFacts(number, has_ended, valid, crashed, 9, None, None, None, origin, tags, failure=failure)


RAISED = Failure("ValueError", "no weights", "Traceback", agent="ego", party="agent", place="reset")
NOT_INSERTED = Failure("invalid", "ego was never inserted", party="simulator")


def fed(sequence, *trials):
    return [pair for side, one in trials for pair in sequence.add(side, one)]


def test_pairs_count_in_the_order_of_their_numbers_up_to_the_first_that_has_not_ended_for_both():
    sequence = PairSequence((RULE, RULE))
    assert fed(sequence, (0, trial(1)), (1, trial(1)), (0, trial(0)), (1, trial(2))) == []
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
        (0, trial(3, origin="random", valid=False)), *((1, trial(n)) for n in range(3)), (1, trial(3, valid=False)),
    )  # fmt: skip
    assert [len(pair) for pair in pairs] == [1, 0, 0, 0]
    assert (sequence.valid, sequence.not_random, sequence.not_same, sequence.invalid) == (1, 1, 1, 1)
    assert "1 of 2 pairs have an invalid trial" in sequence.why_not


def counted(only_first, only_second, alike):
    test = PairTest()
    test.add_counts(only_first, only_second, alike)
    return test


def watch_pairs(watch, pairs, *, may_end=True):
    """Add pairs to a watch until one decides, as a gate does."""
    for pair in pairs:
        if watch.verdict == "undecided":
            watch.test.add(pair)
            watch.decide(may_end=may_end)


def test_interval_of_the_difference_is_symmetric_and_shrinks_with_pairs():
    for counts in ((0, 0, 100), (3, 9, 500), (40, 10, 1950)):
        low, high = counted(*counts).difference()
        mirrored = counted(counts[1], counts[0], counts[2]).difference()
        assert (-high, -low) == pytest.approx(mirrored, abs=1e-6)
        observed = (counts[1] - counts[0]) / sum(counts)
        assert low < observed < high
        wider = counted(*counts).difference(alpha=0.01)
        assert wider.low < low < high < wider.high
    assert counted(0, 0, 1000).difference().high * 1000 < 5.3  # without a difference: ln(2 / alpha / weight) / n
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
    assert (test.failures, test.only_first, test.only_second) == ((60, 100), 60, 10)
    assert test.log_evidence < math.log(20)
    assert not test.excludes(0.0)
    equal = with_rounds({(1, 0): 2000, (0, 2): 1000, (0, 0): 3000}, 2)  # the expected counts of equal crash rates
    assert equal.log_evidence < 0
    assert with_rounds({(1, 0): 50, (0, 0): 50}, 2).log_evidence > math.log(20)
    assert with_rounds({(0, 1): 50, (0, 0): 50}, 2).verdict() == "second"
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
    outside = sum(ever_outside(rng, *rates, 300) for _ in range(examples(100)))
    assert outside <= 0.12 * examples(100)  # 5 of 100 on average at most; more than 12 have a probability of 0.2 %


def watched(rng, base, head, pairs, margin=0.0):
    watch = PairWatch(margin)
    for number, (first, second) in enumerate(zip(rng.random(pairs) < base, rng.random(pairs) < head, strict=True)):
        watch_pairs(watch, [((trial(number, crashed=bool(first)), trial(number, crashed=bool(second))),)])
        if watch.verdict != "undecided":
            break
    return watch


def test_different_agents_get_a_verdict_and_equal_ones_seldom_do():
    rng = np.random.default_rng(26)
    equal = [watched(rng, 0.2, 0.2, 300).verdict for _ in range(examples(40))]
    assert equal.count("undecided") >= 0.875 * len(equal)
    found = [watched(rng, 0.02, 0.005, 2000) for _ in range(examples(12))]
    assert sum(watch.verdict == "better" for watch in found) >= 10 / 12 * len(found)  # 95 % on average at least
    assert not any(watch.verdict == "worse" for watch in found)


def test_verdict_stays_and_later_pairs_do_not_count():
    worse = [((trial(n), trial(n, crashed=True)),) for n in range(40)]
    watch = PairWatch(0.01)
    watch_pairs(watch, worse)
    assert (watch.verdict, watch.test.pairs) == ("worse", 8)  # 1 / evidence of 8 heads is below 5 %, of 7 it is not
    better = [(both[::-1],) for (both,) in worse]
    watch_pairs(watch, better)
    assert (watch.verdict, watch.test.pairs) == ("worse", 8)
    watch = PairWatch(0.01)
    watch_pairs(watch, better, may_end=False)
    assert (watch.verdict, watch.test.pairs) == ("undecided", 40)
    assert watch.decide() == "better"


def test_equal_crashes_in_all_pairs_are_no_difference_above_the_margin():
    watch = PairWatch(0.02)
    watch_pairs(watch, [((trial(n, crashed=n % 2 == 0),) * 2,) for n in range(400)])
    assert watch.verdict == "no_difference"
    assert watch.test.both > 0
    low, high = watch.test.difference()
    assert -0.02 < low < 0 < high < 0.02
    assert 200 < watch.test.pairs < 300


@given(st.integers(0, 40), st.integers(0, 40), st.integers(0, 400), st.sampled_from([0.1, 0.05, 0.01]))
def test_verdict_and_interval_never_contradict_each_other(only_first, only_second, alike, alpha):
    test = counted(only_first, only_second, alike)
    if not test.pairs:
        return
    low, high = test.difference(alpha)
    assert test.verdict(alpha) == ("second" if low > 0 else "first" if high < 0 else "")
    assert low - 1e-8 <= (only_second - only_first) / test.pairs <= high + 1e-8
    if test.is_within(0.05, alpha):
        assert -0.05 < low <= high < 0.05


@given(st.integers(0, 60), st.integers(0, 60))
def test_evidence_is_that_of_discordant_pairs_in_closed_form(first, second):
    any_bias = (
        math.lgamma(first + 0.5) + math.lgamma(second + 0.5) - math.lgamma(first + second + 1) - math.log(math.pi)
    )
    biased = np.logaddexp(*(a * math.log(0.75) + b * math.log(0.25) for a, b in ((first, second), (second, first))))
    expected = np.logaddexp(any_bias, biased - math.log(2)) - math.log(2) + (first + second) * math.log(2)
    assert counted(first, second, 7).log_evidence == pytest.approx(expected, abs=1e-9)


@given(st.tuples(*[st.integers(0, 30)] * 3), st.sampled_from([-0.9, -0.3, 0.01, 0.5]), st.integers(0, 5))
def test_evidence_against_a_difference_is_the_mean_of_both_sums(counts, difference, lost):
    test = counted(*counts)
    for number in range(lost):  # of the second agent: the difference is 0 or 1
        test.add(((trial(number), trial(number, valid=False)),))
    shares = [(0.5, 0.5), *((math.cos(math.pi * (place + 0.5) / 512), 0.5 / 256) for place in range(256))]
    below = above = 0.0
    for share, weight in shares:
        less, more = ([1 - sign * share * (z - difference) / (1 - sign * difference) for z in (-1, 1, 0)]
                      for sign in (1, -1))  # fmt: skip
        below += weight * math.prod(map(pow, less, counts)) * less[1] ** lost
        above += weight * math.prod(map(pow, more, counts)) * more[2] ** lost
    assert test._log_evidence_against(difference) == pytest.approx(math.log((below + above) / 2), abs=1e-9)


def pairs_of(first, second):
    sequence = PairSequence((RULE, RULE))
    test = PairTest()
    for pair in fed(sequence, *((0, one) for one in first), *((1, one) for one in second)):
        test.add(pair)
    return sequence, test


def test_agent_that_does_not_start_fails_in_the_pairs_in_which_the_other_agent_starts():
    fine = [trial(n) for n in range(40)]
    sequence, test = pairs_of(fine, [trial(n, failure=RAISED if n % 4 == 0 else None) for n in range(40)])
    assert (test.pairs, test.only_second, test.verdict(), sequence.invalid) == (40, 10, "second", 0)
    assert (test.side(1).not_started, test.side(0).not_started) == (10, 0)
    assert test.side(1).example == "trial 0: ValueError: no weights (ego, reset)"
    sequence, test = pairs_of(
        [trial(n, failure=RAISED) for n in range(40)], [trial(n, failure=RAISED) for n in range(40)]
    )
    assert (test.pairs, sequence.invalid, test.verdict()) == (0, 40, "")
    _, test = pairs_of([trial(n, crashed=True) for n in range(40)], [trial(n, failure=RAISED) for n in range(40)])
    assert (test.both, test.only_second) == (40, 0)  # no agent is better


def test_trials_that_were_killed_are_counted_apart_from_other_trials_without_a_result():
    died = Failure("signal", "it died of SIGKILL", exit_code=-9)
    second = [trial(0, failure=NOT_INSERTED), trial(1, has_ended=False), trial(2, valid=False), trial(3, failure=died)]
    _, test = pairs_of([trial(n) for n in range(4)], second)
    side = test.side(1)
    assert (side.killed, side.unknown, side.not_started) == (2, 2, 0)


@pytest.mark.parametrize("lost", [{"has_ended": False, "valid": False}, {"failure": NOT_INSERTED}])
def test_verdict_is_valid_for_every_result_of_trials_without_one(lost):
    def seen(known, missing):
        first = [trial(n, crashed=n >= known) for n in range(known + missing)]
        second = [trial(n, crashed=True) for n in range(known)]
        return pairs_of(first, second + [trial(n, **lost) for n in range(known, known + missing)])[1]

    assert seen(12, 0).verdict() == "second"
    assert seen(12, 1).verdict() == "second"
    test = seen(12, 12)
    assert test.verdict() == ""
    low, high = test.difference()
    for crashes in range(13):  # of the trials without a result
        other = counted(12 - crashes, 12, crashes).difference()
        assert low <= other.low <= other.high <= high
    assert (test.pairs, test.unknown, test.side(1).lost, test.side(1).not_started) == (12, 12, 12, 0)
    # No agent crashes, but many trials of one have no result: that is not "no difference".
    watch = PairWatch(0.05)
    watch_pairs(watch, [(both,) for both in zip(*[[trial(n) for n in range(400)]] * 2, strict=True)][:90])
    watch_pairs(watch, [((trial(n), trial(n, **lost)),) for n in range(90, 110)])
    watch_pairs(watch, [((trial(n),) * 2,) for n in range(110, 400)])
    assert watch.verdict == "undecided"


@pytest.mark.parametrize(
    ("failure", "is_own"),
    [
        (RAISED, True), (Failure("exit code", "it exited with 3", exit_code=3), True),
        (Failure("signal", "it died of SIGSEGV", exit_code=-11), True),
        (Failure("timeout", "still running", agent="ego"), True),
        (Failure("KeyError", "'x'", "Traceback", party="environment", place="reset"), True),
        (Failure("signal", "it died of SIGKILL", exit_code=-9), False), (Failure("timeout", "still running"), False),
        (Failure("MemoryError", "", "Traceback", agent="ego", party="agent"), False),
        (Failure("OSError", "[Errno 28] No space left on device", "Traceback", agent="ego", party="agent"), False),
        (NOT_INSERTED, False),
    ],
    ids=str,
)  # fmt: skip
def test_failures_of_the_surroundings_are_not_those_of_the_agent(failure, is_own):
    _, test = pairs_of([trial(0)], [trial(0, failure=failure)])
    assert (test.side(1).not_started, test.side(1).lost) == (is_own, not is_own)
