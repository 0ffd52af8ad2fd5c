"""Which trials count, in which order, and what a hunt with a bar decides."""

from __future__ import annotations

import json
import math
import random
from dataclasses import replace

import pytest
from hypothesis import given, strategies as st

from crashhunt.base.pacing import Paced
from crashhunt.plans import check_rate, rate_of
from crashhunt.statistics import BarWatch, CountingRule, RateWatch, TrialFacts
from crashhunt.statistics._anytime_interval import RateTest
from crashhunt.statistics._counted_trials import (
    MAX_INVALID_SHARE,
    RateCounter,
    UnitSequence,
    facts_of_plain,
)
from crashhunt.statistics._rate_report import make_rate
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, TrialSpec

RULE = CountingRule(max_steps=100)


def trial(number, *, crashed=False, valid=True, has_ended=True, origin="", steps=100, speed=10.0):
    steps = steps if valid else 0
    return TrialFacts(number, has_ended, valid, crashed, steps, steps * 0.1, steps * 0.1 * speed, 0.1, origin)


def data(number, outcome="survived", **more):
    """A trial as a ledger has it."""
    driven = {"driven_s": 10.0, "driven_m": 100.0, "step_length_s": 0.1}
    return {"spec": {"number": number, "seed": number}, "outcome": outcome, "steps": 100, **driven, **more}


def counted(trials, rule=RULE, per="trial"):
    sequence, counter = UnitSequence(rule), RateCounter(rule, per)
    for one in trials:
        for unit in sequence.add(one):
            counter.add(unit)
    return make_rate("h", per, counter, sequence)


@given(st.lists(st.booleans(), min_size=1, max_size=40), st.randoms())
def test_order_in_which_trials_end_changes_nothing(crashes, shuffler):
    trials = [trial(number, crashed=crashed) for number, crashed in enumerate(crashes)]
    shuffled = trials.copy()
    shuffler.shuffle(shuffled)
    assert counted(trials) == counted(shuffled)


def test_trials_after_one_that_has_not_ended_do_not_count():
    found = counted([trial(0), trial(1), trial(3, crashed=True), trial(4)])
    assert (found.trials, found.crashes, found.excluded) == (2, 0, {"after_unfinished": 2})


def test_trials_before_the_code_changed_do_not_count():
    rule = replace(RULE, first=3)
    found = counted([trial(n, crashed=n < 3) for n in (4, 0, 2, 3, 1)], rule)
    assert (found.trials, found.crashes) == (2, 0)
    nothing = counted(map(trial, range(3)), rule)
    assert nothing.why_not == "all 3 trials ran with earlier code, or had begun when the code changed"
    assert counted([], rule).why_not == "no valid trial has finished"
    assert counted([trial(0), trial(4)], rule).why_not.startswith("trial 3 has not ended")


@pytest.mark.parametrize(
    ("outcome", "failure", "has_ended", "valid", "crashed"),
    [
        (Outcome.SURVIVED, None, True, True, False),
        (Outcome.COLLISION, None, True, True, True),
        (Outcome.OFF_ROAD, None, True, True, False),  # no crash of this hunt
        (Outcome.INVALID, Failure("invalid", "ego was never inserted"), True, False, False),
        (Outcome.INVALID, Failure(KILLED, "it was killed"), False, False, False),
    ],
)
def test_facts_of_a_result_are_those_of_its_row(outcome, failure, has_ended, valid, crashed):
    spec = TrialSpec(7, 5, {}, {}, 99, origin="random")
    result = TrialResult(spec, outcome, steps=42, failure=failure, driven_s=4.2, driven_m=50.0, step_length_s=0.1)
    expected = TrialFacts(7, has_ended, valid, crashed, 42, 4.2, 50.0, 0.1, "random", seed=5)
    row = facts_of_plain(result.to_json(), ("collision",), ("part",))
    assert row == expected._replace(tags=("part",), failure=failure)
    assert facts_of_plain({"spec": {"number": 7, "seed": 5}, "outcome": "collision", "steps": 42}, ()) == TrialFacts(
        7, True, True, False, 42, seed=5
    )  # a row of an earlier version


def test_missing_rate_names_the_earlier_trial_that_has_not_ended():
    found = counted([trial(1, crashed=True)])
    assert found.why_not == "trial 0 has not ended, and trials count in the order of their numbers"


def test_crashes_without_any_driven_distance_have_no_rate_per_hour():
    trials = [trial(number, crashed=True)._replace(driven_s=None, driven_m=None) for number in range(3)]
    for per in ("hour", "1000km"):
        found = counted(trials, per=per)
        assert (found.certain, found.why_not) == (None, "no trial has a driven distance and time")
        assert counted([*trials, trial(3)], per=per).certain is not None
    assert counted(trials).certain is not None


def test_trial_that_drove_longer_than_its_hunt_allows_leaves_no_rate_per_hour():
    trials = [trial(0), trial(1), trial(2, steps=900), trial(3, steps=990)]
    found = counted(trials, per="hour")
    assert found.why_not.startswith("trial 2 is beyond the bounds of the hunt: one trial has 0 events and exposure 0.0")
    assert counted(trials).why_not == ""


def test_trial_that_was_killed_from_outside_has_not_ended():
    found = counted([trial(0), trial(1, valid=False, has_ended=False), trial(2)])
    assert (found.trials, found.excluded) == (1, {"after_unfinished": 1})


def test_invalid_trials_leave_both_sides_and_more_than_five_percent_leave_no_rate():
    few = counted([trial(number, valid=number != 5) for number in range(40)])
    assert (few.trials, few.excluded) == (39, {"invalid": 1})
    assert few.certain is not None
    many = counted([trial(number, valid=number % 10 > 0) for number in range(40)])
    assert many.certain is None
    assert many.estimate is None
    assert many.why_not.startswith("4 of 40 trials are invalid")


def test_only_trials_of_the_plain_origin_count():
    rule = CountingRule(max_steps=100, plain_origin="random")
    trials = [trial(n, crashed=n % 4 > 0, origin="random" if n % 4 == 0 else "mutation") for n in range(40)]
    found = counted(trials, rule)
    assert (found.trials, found.crashes, found.excluded) == (10, 0, {"not_random": 30})


def test_units_of_a_hunt_with_few_traffics_are_traffics():
    rule = CountingRule(max_steps=100, traffics=5, planned=42)  # the last round is incomplete
    trials = [trial(number, crashed=number % 5 == 2) for number in range(42)]
    found = counted(trials, rule)
    assert (found.units, found.trials, found.crashes) == (5, 40, 8)
    whole = counted([one._replace(number=number) for number, one in enumerate(trials[:40])])
    assert found.certain.high - found.certain.low > whole.certain.high - whole.certain.low
    assert counted(trials[:39], rule).units == 4


def test_trials_on_training_traffic_leave_both_sides_and_none_left_leaves_no_rate():
    trials = [trial(number, crashed=number % 3 == 0)._replace(seed=number) for number in range(30)]
    rule = replace(RULE, is_held_out=lambda seed: seed % 2 == 0)
    found, plain = counted(trials, rule), counted([one._replace(number=n) for n, one in enumerate(trials[::2])])
    assert (found.trials, found.crashes, found.excluded) == (15, 5, {"trained_on": 15})
    assert (found.certain, found.estimate) == (plain.certain, plain.estimate)
    nothing = counted(trials, replace(RULE, is_held_out=lambda _seed: False))
    assert (nothing.certain, nothing.estimate, nothing.trials) == (None, None, 0)
    assert nothing.why_not.startswith("an agent was trained on the traffic of all 30 trials; run another --seed")


def test_hunt_with_a_bar_decides_on_held_out_traffic_only():
    def seeded(number):
        return data(number, "collision" if number % 2 else "survived")

    watch = BarWatch(replace(RULE, is_held_out=lambda seed: seed % 2 == 0), 0.05, "trial", ("collision",))
    for number in range(400):
        watch.add(seeded(number))
    assert watch.verdict == "below"
    assert watch.running(now=True)["trained_on"] == watch.sequence.trained_on > 0
    everything = BarWatch(RULE, 0.05, "trial", ("collision",))
    for number in range(400):
        everything.add(seeded(number))
    assert everything.verdict == "above"


def test_rate_per_hour_and_per_1000_km_scale_with_exposure():
    trials = [trial(number, crashed=number % 4 == 0, speed=20.0) for number in range(200)]
    by_trial, by_hour, by_km = (counted(trials, per=per) for per in ("trial", "hour", "1000km"))
    assert by_hour.estimate == pytest.approx(by_trial.estimate * 3600 / 10)
    assert by_km.estimate == pytest.approx(by_trial.estimate * 1000 / 0.2)
    assert by_hour.certain.high == pytest.approx(by_trial.certain.high * 360, rel=0.15)
    assert by_km.certain.low == pytest.approx(by_trial.certain.low * 5000, rel=0.25)


def test_trials_without_a_distance_have_no_rate_per_hour_but_one_per_trial():
    trials = [trial(number)._replace(driven_s=None, step_length_s=None) for number in range(20)]
    assert counted(trials, per="hour").why_not == "trial 0 has no driven distance and time"
    assert counted(trials).certain is not None


def test_json_has_no_number_that_is_not_finite():
    found = counted([trial(0, valid=False)], per="hour").to_json()
    assert found["certain"] is None
    assert found["estimate"] is None


# --- a hunt with a bar


def watched(outcomes, bar=0.1, order=None):
    watch = BarWatch(RULE, bar, "trial", ("collision",))
    for number in order or range(len(outcomes)):
        watch.add(data(number, outcomes[number]))
    return watch


def test_bar_decides_below_without_crashes_and_above_with_many():
    below = watched(["survived"] * 60)
    assert below.verdict == "below"
    assert below.decided_at * 0.1 < 3.6
    assert watched(["collision", "survived"] * 20).verdict == "above"
    assert watched(["survived"] * 10).verdict == "undecided"


def test_decision_is_that_of_the_interval():
    for number in range(60):
        watch = watched(["survived"] * number)
        if number:
            assert (watch.interval().high <= 0.1) == (watch.verdict == "below")


@given(st.lists(st.sampled_from(["survived", "collision", "invalid"]), min_size=30, max_size=90), st.integers(0, 99))
def test_decision_depends_on_no_order(outcomes, seed):
    order = list(range(len(outcomes)))
    random.Random(seed).shuffle(order)
    first, second = watched(outcomes), watched(outcomes, order=order)
    assert (first.verdict, first.decided_at) == (second.verdict, second.decided_at)
    assert first.interval() == second.interval()


@pytest.mark.parametrize(("bar", "most"), [(0.25, 2500), (0.9, 200)])  # no rate is 20 % above the second
def test_rate_at_the_bar_ends_undecided_once_it_certainly_is_near_it(bar, most):
    watch = BarWatch(RULE, bar, "trial", ("collision",))
    for number in range(20_000):
        watch.add(data(number, "survived" if number * (1 - bar) % 1 < 1 - bar else "collision"))
        if watch.decided_at is not None:
            break
    assert (watch.verdict, watch.decided_at) == ("undecided", number)
    assert watch.why_undecided == "the rate certainly is within 20 % of the bar, so more trials do not help"
    low, high = watch.interval()
    assert 0.8 * bar <= low < bar < high <= 1.2 * bar
    assert number < most


def test_many_invalid_trials_end_a_hunt_undecided_and_few_do_not():
    few = watched((["invalid"] + ["survived"] * 24) * 8, bar=0.001)
    assert (few.decided_at, few.sequence.invalid_share) == (None, 0.04)
    many = watched((["survived"] * 3 + ["invalid"]) * 200, bar=0.001)
    assert (many.verdict, many.decided_at) == ("undecided", many.sequence.hopeless_at)
    assert many.why_undecided == "too many trials are invalid, so more of them do not help"
    assert many.decided_at < 60
    shuffled = watched((["survived"] * 3 + ["invalid"]) * 200, bar=0.001, order=[*range(799, -1, -1)])
    assert (shuffled.decided_at, shuffled.counter.units) == (many.decided_at, many.counter.units)


def test_share_of_invalid_trials_just_above_the_limit_ends_a_hunt_too():
    outcomes = (["survived"] * 9 + ["invalid"] + ["survived"] * 9) * 220  # 5.26 %
    watch = watched(outcomes, bar=1e-5)
    assert watch.decided_at is not None
    assert watch.why_undecided == "too many trials are invalid, so more of them do not help"


def test_trial_without_exposure_ends_a_hunt_undecided():
    watch = BarWatch(RULE, 1.0, "hour", ("collision",))
    watch.add(data(0, driven_s=None, step_length_s=None))
    assert (watch.verdict, watch.decided_at) == ("undecided", 0)
    assert watch.why_undecided == "trial 0 has no driven distance and time"


@pytest.mark.nightly
def test_bars_are_decided_soon_and_rarely_wrongly():
    """At a third of the bar the median is at most 15 / bar trials, and at most 1 % of the decisions are wrong."""
    rng, ends = random.Random(4), []
    for _ in range(300):
        watch = BarWatch(RULE, 0.03, "trial", ("collision",))
        number = 0
        while watch.decided_at is None:
            watch.add(data(number, "collision" if rng.random() < 0.01 else "survived"))
            number += 1
        ends.append((number, watch.verdict))
    assert sorted(number for number, _ in ends)[150] <= 15 / 0.03
    assert sum(verdict == "above" for _, verdict in ends) <= 3


# --- RATE/UNIT


@given(
    st.floats(1e-12, 0.999), st.sampled_from(["trial", "hour", "1000km"]), st.sampled_from(["{:g}", "{:.3e}", "{!r}"])
)
def test_written_rates_are_read_back(rate, per, form):
    text = form.format(rate)
    assert rate_of(f"{text}/{per}") == (float(text), per)
    assert check_rate(f" {text} / {per} ") == ""


@given(st.text(max_size=12))
def test_any_text_is_a_rate_or_is_refused(text):
    if not check_rate(text) and text:
        rate, per = rate_of(text)
        assert rate > 0
        assert per in ("trial", "hour", "1000km")


@given(st.lists(st.sampled_from(["fine", "crash", "invalid", "killed"]), max_size=60), st.randoms())
def test_running_rate_is_that_of_the_trials_in_a_row_and_no_bar_ends_it(kinds, random):
    trials = [
        trial(number, crashed=kind == "crash", valid=kind != "invalid", has_ended=kind != "killed")
        for number, kind in enumerate(kinds)
    ]
    first = kinds.index("killed") if "killed" in kinds else len(kinds)
    random.shuffle(trials)
    watch = RateWatch(RULE, "trial", ["collision"])
    for one in trials:
        watch.add_facts(one)
    found, row = watch.running(now=True), kinds[:first]
    valid, invalid = len(row) - row.count("invalid"), row.count("invalid")
    assert (found["trials"], found["crashes"]) == (valid, row.count("crash"))
    if not valid or invalid > MAX_INVALID_SHARE * len(row):
        assert found["certain"] is None
        assert found["why_not"]
    else:
        low, high = watch.interval()
        assert found["certain"] == {"low": low, "high": high}
    json.dumps(found, allow_nan=False)


def test_running_rate_names_the_trial_that_others_wait_for():
    watch = RateWatch(RULE, "trial", ["collision"])
    assert watch.running(now=True)["why_not"] == "no valid trial has finished"
    watch.add_facts(trial(1, crashed=True))
    assert watch.running(now=True)["why_not"].startswith("trial 0 has not ended")
    watch.add_facts(trial(0))
    assert watch.running(now=True)["crashes"] == 1
    watch = RateWatch(CountingRule(max_steps=100, traffics=3, planned=6), "trial", ["collision"])
    for number in (0, 1, 2, 4):
        watch.add_facts(trial(number))
    assert watch.running(now=True)["why_not"].startswith("traffic 0 has not ended all of its 2 trials, and traffics ")
    watch.add_facts(trial(3))
    assert (watch.running(now=True)["trials"], watch.running(now=True)["why_not"]) == (4, "")


def test_running_rate_is_made_again_only_where_something_has_changed():
    made = []
    paced = Paced()

    def make():
        made.append(1)
        return len(made)

    assert [paced(1, make), paced(1, make), paced(1, make, now=True)] == [1, 1, 1]
    assert paced(2, make, now=True) == 2


@pytest.mark.parametrize(("bar", "needed_km"), [(10.0, 350.0), (1.0, 3_500.0), (0.1, 35_000.0)])
@pytest.mark.parametrize(("max_steps", "km_per_trial"), [(600, 0.8), (1500, 2.0)])
def test_crash_free_kilometres_for_a_claim_are_those_of_the_guide(bar, needed_km, max_steps, km_per_trial):
    def upper_bound(km):
        interval = RateTest(CountingRule(max_steps=max_steps).bets("1000km", 0.1))
        interval.add(0.0, km_per_trial / 1000, times=round(km / km_per_trial))
        return interval.interval(0.05).high

    assert upper_bound(0.85 * needed_km) > bar > upper_bound(1.15 * needed_km)
    # With the number of kilometres fixed beforehand, the exact bound of a Poisson process is -log(0.05) / km.
    assert upper_bound(needed_km) > -math.log(0.05) / needed_km * 1000
