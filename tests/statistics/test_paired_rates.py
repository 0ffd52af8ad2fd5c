"""The difference of two rates per hour or per 1,000 km, from pairs in equal traffic."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import examples

from crashhunt.statistics import CountingRule, Interval, RateTest, TrialFacts
from crashhunt.statistics._paired_rates import difference_of_rates
from crashhunt.trial import Failure

RULE = CountingRule(max_steps=300)
RAISED = Failure("ValueError", "no weights", "Traceback", agent="ego", party="agent")


def trial(number, seconds, *, crashed=False, speed=10.0, has_ended=True, failure=None):
    valid = has_ended and failure is None
    driven = (seconds, seconds * speed, 0.1) if valid else (None, None, None)
    return TrialFacts(number, has_ended, valid, crashed, 9, *driven, "", failure=failure)


def drawn(rng, number, hazards, shared, speeds=(10.0, 10.0)):
    """Pairs of 30 s whose agents crash with a hazard per second; a share of the pairs has the same cause."""
    pairs = []
    for place in range(number):
        first, second = rng.exponential(size=2)
        second = first if rng.random() < shared else second
        ends = [time / hazard for time, hazard in zip((first, second), hazards, strict=True)]
        both = (trial(place, min(end, 30.0), crashed=end < 30, speed=v) for end, v in zip(ends, speeds, strict=True))
        pairs.append((tuple(both),))
    return pairs


def test_interval_seldom_ever_excludes_the_true_difference_and_decides_what_the_rates_alone_do_not():
    rng = np.random.default_rng(26)
    outside = decided = decided_by_rates = 0
    repetitions = examples(8)
    for hazards in ((0.003, 0.003), (0.001, 0.006)):
        for _ in range(repetitions):
            pairs = drawn(rng, 200, hazards, 0.5)
            for looked in (50, 200):
                found = difference_of_rates(pairs[:looked], (RULE, RULE), "hour")
                outside += not found.low <= 3600 * (hazards[1] - hazards[0]) <= found.high
            tests = [RateTest(RULE.bets("hour", 0.1)) for _ in (0, 1)]
            for both in (pair[0] for pair in pairs):
                for one, test in zip(both, tests, strict=True):
                    test.add(float(one.crashed), one.driven_s / 3600)
            first, second = (test.interval(0.025) for test in tests)
            decided += found.low > 0
            decided_by_rates += second.low > first.high
    assert outside <= repetitions * 3 / 8
    assert decided >= repetitions * 6 / 8
    assert decided > 2 * decided_by_rates


@pytest.mark.parametrize("per", ["hour", "1000km"])
def test_exchanged_agents_have_the_opposite_difference(per):
    pairs = drawn(np.random.default_rng(1), 60, (0.004, 0.01), 0.5, speeds=(20.0, 30.0))
    low, high = difference_of_rates(pairs, (RULE, RULE), per)
    exchanged = [tuple((two, one) for one, two in pair) for pair in pairs]
    assert difference_of_rates(exchanged, (RULE, RULE), per) == Interval(-high, -low)
    wider = difference_of_rates(pairs, (RULE, RULE), per, 0.01)
    assert wider.low < low < high < wider.high


@pytest.mark.parametrize(
    ("per", "unit"), [("hour", lambda one: one.driven_s / 3600), ("1000km", lambda one: one.driven_m / 1e6)]
)
def test_ends_are_where_the_evidence_is_the_inverse_of_the_error_probability(per, unit):
    pairs = [both for (both,) in drawn(np.random.default_rng(4), 50, (0.006, 0.02), 0.5, speeds=(20.0, 30.0))]
    lost = {3: 0, 20: 1, 41: 1}  # the unit to the agent whose trial was killed
    told = [tuple(trial(n, 0.0, has_ended=False) if lost.get(n) == who else one for who, one in enumerate(both))
            for n, both in enumerate(pairs)]  # fmt: skip
    found = difference_of_rates([(both,) for both in told], (RULE, RULE), per, alpha=0.06)
    bets = RULE.bets(per, 0.1)
    weighted = [(0.5, 0.5), *((math.cos(math.pi * (place + 0.5) / 32), 0.5 / 16) for place in range(16))]

    def evidence(first, rate, difference):
        most, total = bets.most_events + rate * bets.most_exposure, 0.0
        one, two = (np.array([(both[who].crashed, unit(both[who])) for n, both in enumerate(pairs) if n not in lost])
                    for who in (first, 1 - first))  # fmt: skip
        z = two[:, 0] - one[:, 0] - rate * (two[:, 1] - one[:, 1]) - difference * two[:, 1]
        for share, weight in weighted:
            total += weight * (1 - share) ** len(lost) * np.prod(1 - share * z / most)
        return total

    for first, end in ((0, found.high), (1, -found.low)):
        ends = []
        for worst in ((0.0, bets.most_exposure), (bets.most_events, 0.0)):
            test = RateTest(bets)
            for n, both in enumerate(pairs):
                test.add(*(worst if lost.get(n) == first else (float(both[first].crashed), unit(both[first]))))
            ends.append(test.interval(0.1 * 0.03))
        low, high = ends[0].low, ends[1].high
        rates = [low, *np.geomspace(max(low, high / 1000), high, 5)]
        assert min(evidence(first, rate, end) for rate in rates) == pytest.approx(1 / (0.9 * 0.03), rel=1e-3)


def test_trials_that_do_not_start_are_failures_and_those_without_a_result_may_be():
    fine = [trial(n, 30.0) for n in range(60)]
    failed = [trial(n, 30.0) if n % 4 else trial(n, 0.0, failure=RAISED) for n in range(60)]
    killed = [trial(n, 30.0) if n % 4 else trial(n, 0.0, has_ended=False) for n in range(60)]

    def found(second):
        return difference_of_rates([(both,) for both in zip(fine, second, strict=True)], (RULE, RULE), "hour")

    assert found(failed).low > 0
    assert found(killed).low < 0
    assert found(killed).high > found(failed).high
    assert found(fine).low < 0 < found(fine).high


def test_unknown_distance_is_a_reason():
    pairs = [((trial(n, 30.0), trial(n, 30.0)),) for n in range(3)]
    assert difference_of_rates([], (RULE, RULE), "hour") == "no trial has a driven distance and time"
    unknown = trial(3, 30.0)._replace(driven_m=None)
    reason = difference_of_rates([*pairs, ((trial(3, 30.0), unknown),)], (RULE, RULE), "1000km")
    assert reason == "trial 3 has no driven distance and time"
    standing = [((trial(n, 30.0, speed=0.0), trial(n, 30.0, speed=0.0)),) for n in range(3)]
    assert difference_of_rates(standing, (RULE, RULE), "1000km") == Interval(-math.inf, math.inf)
