"""What the dashboard counts and samples must be what the ledger says, whatever the order in which trials come."""

from __future__ import annotations

import random
from collections import Counter
from contextlib import closing
from dataclasses import replace

import pytest
from conftest import crashes_on_loop, examples
from hypothesis import given, settings, strategies as st

from crashhunt.crashes import list_near_misses, most_dangerous
from crashhunt.dashboard import _plotted_trials, _trial_counts as _trials
from crashhunt.dashboard._catalog import Catalog
from crashhunt.dashboard._crash_list import CrashList
from crashhunt.dashboard._hunt_page import HuntView
from crashhunt.dashboard._plotted_trials import Sample
from crashhunt.dashboard._trial_counts import TrialCounts
from crashhunt.ledger import Ledger
from crashhunt.statistics import counts_suffice, measure_rates, rate_of_counts
from crashhunt.training import HeldOutTraffics, TrainedOn
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, TrialSpec

CRASH_ON = (Outcome.COLLISION, Outcome.HANG)
OUTCOMES = (Outcome.SURVIVED, Outcome.SURVIVED, Outcome.COLLISION, Outcome.INVALID, Outcome.FINISHED)


def trial(number: int, outcome: Outcome, *, killed: bool = False) -> TrialResult:
    spec = TrialSpec(
        number=number,
        seed=number,
        arguments={"ego": {"speed": number / 7}},
        scenario_arguments={"cars": 3},
        max_steps=9,
    )
    failure = Failure(KILLED, "was killed") if killed else None
    return TrialResult(spec, outcome, steps=number % 9 + 1, failure=failure, danger=number * 0.37 % 1.0)


def record(ledger: Ledger, trials) -> None:
    for result in trials:
        ledger.record(result, snapshot="s")


def expected_prefix(trials: dict[int, TrialResult]):
    """Counts of the trials up to the first that has not ended, or was killed from outside."""
    found, number = [], 0
    while number in trials and not trials[number].was_killed_from_outside:
        found.append(trials[number])
        number += 1
    valid = [one for one in found if one.outcome is not Outcome.INVALID]
    after = [one for one in trials.values() if one.spec.number >= number and not one.was_killed_from_outside]
    return (
        len(valid),
        len(found) - len(valid),
        sum(one.outcome in CRASH_ON for one in valid),
        sum(one.steps for one in valid),
        len(after),
    )


@settings(max_examples=examples(50))
@given(
    st.integers(1, 90), st.randoms(use_true_random=False), st.lists(st.integers(0, 89), max_size=3, unique=True),
    st.sampled_from([4, 16, 256]), st.booleans(), st.sampled_from([3, 4_000]),
)  # fmt: skip
def test_counts_are_those_of_the_ledger_in_any_order(tmp_path_factory, count, rng, killed, parts, same, tail):
    trials = {
        number: trial(number, Outcome.INVALID if number in killed else rng.choice(OUTCOMES), killed=number in killed)
        for number in range(count)
    }
    if same:  # as trials that run all their steps
        trials = {n: replace(one, steps=9) if one.outcome is Outcome.SURVIVED else one for n, one in trials.items()}
    order = list(trials)
    window = rng.randint(1, 12)  # workers end a little out of order
    order.sort(key=lambda number: number + rng.uniform(0, window))
    path = tmp_path_factory.mktemp("ledger") / "ledger.sqlite"
    before = _trials.PARTS, _trials._TAIL
    _trials.PARTS, _trials._TAIL = parts, tail
    try:
        counts, there = TrialCounts(CRASH_ON), {}
        with closing(Ledger(path, writable=True)) as writer:
            while order:
                some, order = order[: (size := rng.randint(1, 30))], order[size:]
                record(writer, (trials[number] for number in some))
                there |= {number: trials[number] for number in some}
                with closing(Ledger(path, read_only=True)) as reader, reader.one_moment():
                    began = counts.last >= 0
                    new = counts.refresh(reader)
                if began:
                    assert sorted(new) == sorted((number, str(trials[number].outcome)) for number in some)
                assert counts.outcomes == Counter(str(one.outcome) for one in there.values())
                assert tuple(counts.prefix) == expected_prefix(there)
                curve = counts.curve(1000)
                assert curve[-1] == [len(there), sum(one.steps for one in there.values()), counts.crashes]
                assert len(counts.parts()) <= parts + 1
                for part in counts.parts():
                    inside = [one for n, one in there.items() if part["first"] <= n <= part["last"]]
                    assert part["outcomes"] == Counter(str(one.outcome) for one in inside)
                    assert part["steps"] == sum(one.steps for one in inside)
    finally:
        _trials.PARTS, _trials._TAIL = before


@pytest.mark.parametrize("at_once", [True, False])
def test_the_sample_keeps_all_crashes_and_an_even_share(tmp_path, monkeypatch, at_once):
    monkeypatch.setattr(_plotted_trials, "MAX_POINTS", 100)
    crashed = set(random.Random(1).sample(range(1_000), 20))
    path = tmp_path / "ledger.sqlite"
    sample, counts = Sample(CRASH_ON), TrialCounts(CRASH_ON)
    with closing(Ledger(path, writable=True)) as ledger, ledger.together():
        for begin in range(0, 1_000, 1_000 if at_once else 125):
            numbers = range(begin, begin + (1_000 if at_once else 125))
            record(ledger, (trial(n, Outcome.COLLISION if n in crashed else Outcome.SURVIVED) for n in numbers))
            first = counts.last < 0
            new = counts.refresh(ledger)
            if first:
                sample.begin(ledger, counts.last, counts.crashes)
            else:
                sample.add(ledger, new)
            assert {point["number"] for point in sample.points if point["crash"]} == {
                n for n in crashed if n <= counts.last
            }
    others = sorted(point["number"] for point in sample.points if not point["crash"])
    assert 40 <= len(others) <= 100
    assert len(others) == len(set(others))
    tenths = Counter(number // 100 for number in others)  # evenly over the hunt
    assert all(abs(tenths[tenth] - len(others) / 10) <= 3 for tenth in range(10))
    assert sample.points[0]["values"].keys() == {"speed", "cars"}


def test_the_rate_from_counts_is_the_rate_that_crashhunt_rate_reports(shell, made_once):
    hunt = made_once(crashes_on_loop, shell).folder / "runs" / "one"
    view = HuntView(next(iter(Catalog([hunt]).hunts().values())))
    view.refresh()
    assert view.settings is not None
    assert view.counts is not None
    nothing = HeldOutTraffics(0)
    assert counts_suffice(view.settings, view.facts, nothing)
    record = TrainedOn(test=0.5)
    assert not counts_suffice(view.settings, view.facts, replace(nothing, records=(record,)))
    (said,) = measure_rates(hunt, per="trial")
    counted = rate_of_counts(hunt, view.settings, view.facts, **view.counts.prefix._asdict())
    assert replace(counted, dir="", driven_s=0.0, driven_m=0.0) == replace(said, dir="", driven_s=0.0, driven_m=0.0)
    assert counted.certain is not None
    assert counted.trials > 0


def test_a_trial_that_runs_again_is_counted_once(tmp_path, shell, made_once):
    hunt = made_once(crashes_on_loop, shell).folder / "runs" / "one"
    view = HuntView(next(iter(Catalog([hunt]).hunts().values())))
    state = view.refresh(points=True)
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.replace([2])
    after = view.refresh(points=True)
    assert after.trials_run == state.trials_run - 1
    assert view.sample is not None
    assert 2 not in [point["number"] for point in view.sample.points]


def test_near_misses_are_on_the_map_where_they_were_most_critical(shell, made_once):
    hunt = made_once(crashes_on_loop, shell).folder / "runs" / "one"
    (found,) = Catalog([hunt]).hunts().values()
    crashes = CrashList(found)
    crashes.rows()  # begins the analysis of logs
    crashes._thread.join(60)
    (bundle,) = list_near_misses(hunt)
    most = most_dangerous(bundle.recording())
    scene = bundle.recording().scene(most.step)
    (point,) = [one for one in crashes.map()["points"] if one["near_miss"]]
    assert (point["x"], point["y"]) == pytest.approx(scene.points[scene.roster.index["ego"]], abs=0.01)
    assert all(one["x"] is not None and one["type"] for one in crashes.map()["points"] if not one["near_miss"])
