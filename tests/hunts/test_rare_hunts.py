"""Rare mode: what it refuses, which forcing a root has, when it ends, and whole hunts on the toy."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import pytest
from made_up_trials import leave_own_code_out
from test_hunt_loop import TOY as RANGED

import crashhunt
from crashhunt.disturbances import DisturbanceSampler, brake
from crashhunt.errors import UsageError
from crashhunt.hunts._reports import RareReport
from crashhunt.ledger import Ledger
from crashhunt.results import hunt_state
from crashhunt.statistics import BLOCK, TRIALS_PER_ROOT, _rate_of_running_hunt as rare_module
from crashhunt.statistics._rare import is_root
from crashhunt.statistics._rate_of_running_hunt import Forcings, RareWatch
from crashhunt.trial import (
    CRASHES,
    KILLED,
    Disturbance,
    Failure,
    Forced,
    ForcedCopy,
    Forcing,
    Outcome,
    TrialResult,
    TrialSpec,
)

TOY = RANGED.replace('default = 8.0\nrange = "6:14"', "default = 9.0")
OPTIONS = {"scenario": "toy.toml", "seed": 4, "snapshot_code": False, "rare": True}


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    (tmp_path / "toy.toml").write_text(TOY)
    monkeypatch.chdir(tmp_path)
    leave_own_code_out(monkeypatch)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "--rare needs disturbances with rates"),
        ({"disturb": ["none"]}, "--rare needs disturbances with rates"),
        ({"disturb": ["brake@5=ahead:4:2", "stop=0.01"]}, "brake@5=ahead:4.0:2.0 begins in every trial"),
        ({"disturb": ["stop=0.01"], "sampler": "guided"}, "--sampler guided draws dependent trials"),
        ({"disturb": ["stop=0.01"], "seeds": 3}, "--rare and --seeds exclude each other"),
        ({"disturb": ["stop=0.01"], "branch": True}, "--rare and --branch exclude each other"),
        ({"disturb": ["stop=0.01"], "probe": "4s"}, "--rare and --probe exclude each other"),
        ({"disturb": ["stop=0.01"], "distinct": 2}, "--rare and --distinct exclude each other"),
        ({"disturb": ["stop=3"]}, "stop=3 begins with the probability 0.3 in each step"),
        ({"rare": False, "until_error": "30%"}, "--until-error 30% needs --rare"),
        ({"disturb": ["stop=0.01"], "until_error": "300%"}, "--until-error is 300%"),
        ({"disturb": ["stop=0.01"], "until_error": "soon"}, "--until-error is soon"),
    ],
)
def test_rare_mode_refuses_what_it_has_no_law_for(tmp_path, options, says):
    with pytest.raises(UsageError, match=says) as refused:
        crashhunt.prepare(tmp_path / "h", 1, 8, 20, **(OPTIONS | options))
    assert refused.value.fix


def test_rare_mode_keeps_going_so_it_may_keep_a_few_bundles_of_each_type(tmp_path):
    hunt = crashhunt.prepare(tmp_path / "h", 1, 8, 20, **OPTIONS, disturb=["stop=0.01"], keep=2)
    assert (hunt.settings.run.keep, hunt.settings.run.keep_going) == (2, True)


class Rows(dict):
    """A ledger of roots."""

    replanned = None

    def result(self, number):
        return self.get(number)

    def facts(self):
        return {"replanned": self.replanned}


SAMPLER = DisturbanceSampler({"brake": brake()}, {"brake": 1e-3}, ("ego",), 1.0)


def settings(until_error=""):
    return SimpleNamespace(max_steps=50, crash_on=CRASHES, run=SimpleNamespace(until_error=until_error))


def root(number, crash="", **more):
    copies = (ForcedCopy("brake=6.0", 3, 0.01, 2, crash, 9), ForcedCopy("brake=2.0", 3, 0.01, 2))
    forced = Forced(0.95, {"brake=6.0": 0.01, "brake=2.0": 0.04}, copies, 90, **more)
    spec = TrialSpec(number, number, {}, {}, 50, forcing=Forcing(0.01))
    return TrialResult(spec, Outcome.SURVIVED, 50, forced=forced)


def plain(number, outcome=Outcome.SURVIVED):
    return TrialResult(TrialSpec(number, number, {}, {}, 50), outcome, 50)


def rows_of(roots):
    """Return a ledger with roots, each with its plain trials."""
    rows = Rows()
    for place, first in enumerate(roots):
        number = place * TRIALS_PER_ROOT
        rows[number] = replace(first, spec=replace(first.spec, number=number))
        rows |= {other: plain(other) for other in range(number + 1, number + TRIALS_PER_ROOT)}
    return rows


BLOCK_OF_TRIALS = BLOCK * TRIALS_PER_ROOT


def test_every_fifth_trial_is_a_root_and_the_others_wait_for_nothing():
    assert [number for number in range(11) if is_root(number)] == [0, 5, 10]
    forcings = Forcings(settings(), Rows(), SAMPLER)
    assert forcings.of(0) is not None
    assert forcings.of(1) is None
    assert Forcings.needed(2 * BLOCK_OF_TRIALS + 1) == 0


def test_forcing_is_learned_from_the_blocks_before_the_previous_one():
    rows = rows_of([root(number, "collision") for number in range(BLOCK)])
    forcings = Forcings(settings(), rows, SAMPLER)
    many = BLOCK_OF_TRIALS
    asked = (0, many, 2 * many - TRIALS_PER_ROOT, 2 * many, 3 * many)
    assert [Forcings.needed(number) for number in asked] == [0, 0, 0, many, 2 * many]
    start = forcings.of(0)
    assert (forcings.of(2 * many - TRIALS_PER_ROOT), start.ratios) == (start, {})
    learned = forcings.of(2 * many)
    assert learned.ratios["brake=6.0"] > 1 > learned.ratios["brake=2.0"]
    # A resumed hunt begins at any root, and has the same forcing.
    assert Forcings(settings(), rows, SAMPLER).of(2 * many + TRIALS_PER_ROOT) == learned


def test_hunt_may_end_at_a_full_block_and_incomplete_roots_are_excluded():
    rows = rows_of([root(number, "collision" if number % 2 else "") for number in range(5 * BLOCK)])
    incomplete = root(3, unanswered=1, why_unanswered="a copy was killed")
    rows[15] = replace(incomplete, spec=replace(incomplete.spec, number=15))
    rule = RareWatch(settings("0.3"), rows, SAMPLER)
    rule.read(40 * TRIALS_PER_ROOT + 2)
    assert (rule.roots, rule.estimate().excluded, rule.is_met) == (40, 1, False)
    assert rule.estimate().plain == 40 * (TRIALS_PER_ROOT - 1)
    rule.read()
    assert rule.is_met
    assert rule.roots == 2 * BLOCK  # of 5 blocks
    assert rule.estimate().relative_error <= 0.3
    del rows[7 * TRIALS_PER_ROOT]
    gap = RareWatch(settings(), rows, SAMPLER)
    gap.read()
    assert gap.roots == 7  # a root of a higher number does not count before one that has not ended


def test_crashes_of_plain_trials_count_for_the_undisturbed_part_and_for_the_certain_bounds():
    rows = rows_of([root(number, "collision" if number % 2 else "") for number in range(60)])
    calm = RareWatch(settings(), rows, SAMPLER)
    calm.read()
    for number in (1, 2, 8, 101, 203):
        rows[number] = plain(number, Outcome.COLLISION)
    rows[4] = plain(4, Outcome.INVALID)
    rule = RareWatch(settings(), rows, SAMPLER)
    rule.read()
    found, before = rule.estimate(), calm.estimate()
    assert (found.plain, found.plain_crashes, found.undisturbed_crashes) == (239, 5, 5)
    lines = "\n".join(RareReport(found, 0, 0, ()).lines)
    assert "undisturbed 5 of 299 trials" in lines
    assert f"with a disturbance: {found.disturbed:.2g} per trial ({found.estimated_disturbed.low:.2g} to" in lines
    assert "with a disturbance" not in "\n".join(RareReport(before, 0, 0, ()).lines)
    assert before.undisturbed == 0
    assert found.undisturbed == pytest.approx((2 / 4 + 3 / 5) / 60)  # the group of trial 4 has one trial fewer
    assert found.disturbed == before.disturbed
    assert found.certain[0] <= found.undisturbed + found.disturbed <= found.certain[1]
    assert found.certain[1] > before.certain[1]
    running = rule.running()
    assert running["certain"] == {"low": found.certain[0], "high": found.certain[1]}
    assert (running["method"], running["units"], running["crashes"]) == ("rare", 60, 5)


@pytest.mark.parametrize(("roots", "is_kept"), [(4, False), (60, True)])
def test_estimate_after_a_change_of_trials_needs_an_interval(roots, is_kept):
    rows = rows_of([root(number, "collision" if number % 2 else "") for number in range(roots)])
    rows.replanned = True  # perhaps until a fork crashed
    asked = SimpleNamespace(**vars(settings()) | {"rare": True})
    watch = rare_module.rare_watch(asked, rows, SAMPLER)
    watch.read()
    found = watch.estimate()
    assert ((found.estimate is None), found.estimated is None) == (not is_kept, not is_kept)
    assert found.why_not.startswith("TRIALS was changed after results were known, and ") != is_kept
    assert (watch.running()["estimate"], found.certain is None) == (found.estimate, False)


def test_too_many_invalid_plain_trials_leave_no_estimate():
    rows = rows_of([root(number, "collision" if number % 2 else "") for number in range(50)])
    rows[0] = root(0, unanswered=1, why_unanswered="a copy was killed")  # its plain trials count in any case
    for number in range(1, 55, 5):  # of 200 plain trials, 11
        rows[number] = plain(number, Outcome.INVALID)
    rule = RareWatch(settings(), rows, SAMPLER)
    rule.read()
    found = rule.estimate()
    why = "11 of 200 plain trials are invalid, more than 5 %: the rest is other traffic than described"
    assert found.why_not == why
    assert (found.estimate, found.certain, found.estimated) == (None, None, None)
    rows[51] = plain(51)
    rule = RareWatch(settings(), rows, SAMPLER)
    rule.read()
    assert rule.estimate().estimate > 0
    assert rule.estimate().plain_crashes == 0  # also of the root that was not answered


def test_plain_trials_that_contradict_the_copies_withhold_the_interval():
    rows = rows_of([root(number, "collision" if number % 2 else "") for number in range(60)])
    disturbed = replace(plain(0), disturbances=(Disturbance(3, "ahead", "brake", 2.0, 1.0, "ego", vehicle="v"),))
    for number in rows:
        if number % TRIALS_PER_ROOT == 1:
            spec = replace(disturbed.spec, number=number)
            rows[number] = replace(disturbed, spec=spec, outcome=Outcome.COLLISION)
    rule = RareWatch(settings(), rows, SAMPLER)
    rule.read()
    found = rule.estimate()
    assert found.estimated is None
    assert "plain trials crash more often than the copies explain" in found.why_not


def test_weightiest_crashes_are_kept_in_order():
    def weighted(number, weight):
        copy = ForcedCopy("brake=6.0", 3, weight, 2, "collision", 9)
        low = ForcedCopy("brake=6.0", 3, 9.0, 2, "", 9)  # without a crash, its weight does not count
        first = root(number)
        return replace(first, forced=replace(first.forced, copies=(copy, low, replace(copy, weight=weight / 4))))

    weights = [0.001, 0.005, 0.002, 0.007, 0.003, 0.004, 0.006]
    watch = RareWatch(settings(), rows_of([weighted(n, weight) for n, weight in enumerate(weights)]), SAMPLER)
    watch.read()
    kept = [one.spec.number // TRIALS_PER_ROOT for one in watch.weightiest]
    assert kept == [3, 6, 1, 5, 4]
    assert [rare_module.greatest_weight(one) for one in watch.weightiest] == [0.007, 0.006, 0.005, 0.004, 0.003]
    assert list(rare_module.crashed_copies(plain(1))) == []


def test_hunt_without_rare_mode_has_no_objects_of_it():
    for make in (rare_module.forcings_of, rare_module.rare_watch):
        assert make(SimpleNamespace(**vars(settings()), rare=False), Rows(), SAMPLER) is None


# The trials that count for a rate.

RULED = SimpleNamespace(
    sampler="random", seeds=0, trials=40, max_steps=50, seed=7, agents={"ego": 1, "second": 2}, rare=False,
    crash_on=CRASHES, run=SimpleNamespace(until_rate=""),
)  # fmt: skip


def of(**options):
    return SimpleNamespace(**vars(RULED) | options)


def records(*seeds, empty=False):
    return SimpleNamespace(records=[SimpleNamespace(hunt_seeds=seeds)] if seeds else [], has="has", is_empty=empty)


def test_rule_of_counting_follows_the_hunt():
    rule = rare_module.counting_rule(RULED, {})
    assert (rule.max_steps, rule.agents, rule.plain_origin, rule.traffics, rule.planned) == (50, 2, "", 0, 40)
    assert rule.is_held_out is None
    assert rare_module.counting_rule(of(agents={}), {}).agents == 1
    guided = of(sampler="guided")
    assert rare_module.counting_rule(guided, {"plain_origin": "random"}).plain_origin == "random"
    assert rare_module.counting_rule(guided, {}).plain_origin == ""
    assert rare_module.counting_rule(guided, {"independent": True, "plain_origin": "random"}).plain_origin == ""
    traffics = rare_module.counting_rule(of(seeds=3), {"independent": False, "plain_origin": "random"})
    assert (traffics.plain_origin, traffics.traffics) == ("", 3)
    assert rare_module.counting_rule(RULED, {}, records()).is_held_out is None
    assert rare_module.counting_rule(RULED, {}, records(1)).is_held_out == "has"


def test_rate_needs_traffic_that_no_agent_was_trained_on():
    refuse = rare_module.refuse_training_traffic
    rare, until = of(rare=True), of(run=SimpleNamespace(until_rate="0.1/trial"))
    with pytest.raises(UsageError, match=r"--rare: an agent was trained on traffics of --seed 7; give another --seed"):
        refuse(rare, records(3, 7))
    with pytest.raises(UsageError, match="--until-rate: an agent was trained on all traffics of --seed 7"):
        refuse(until, records(3, empty=True))
    for accepted in ((rare, records(3)), (rare, records()), (until, records(7)), (RULED, records(7, empty=True))):
        refuse(*accepted)


@pytest.mark.parametrize(
    ("options", "facts", "says"),
    [
        ({}, {}, ""),
        ({"rare": True}, {}, "in rare mode, one of five trials"),
        ({"sampler": "guided"}, {}, "the sampler guided does not draw trials independently"),
        ({"sampler": "guided"}, {"independent": True}, ""),
        ({"sampler": "guided"}, {"plain_origin": "random"}, ""),
        ({}, {"independent": False}, "the sampler random does not draw trials independently"),
        ({"seeds": 40}, {}, ""),
        ({"seeds": 41}, {}, "TRIALS must be at least --seeds"),
        ({"seeds": 3, "sampler": "sobol"}, {"independent": True}, "the sampler sobol does not draw"),
    ],
)
def test_hunt_without_a_rate_gives_the_reason(options, facts, says):
    found = rare_module.why_no_interval(of(**options), facts)
    assert found.find(says) >= 0
    assert bool(found) is bool(says)


def test_rate_counts_the_trials_of_earlier_runs(tmp_path):
    killed = Failure(KILLED, "out of memory")
    with closing(Ledger(tmp_path / "l.sqlite", writable=True)) as ledger:
        for number, outcome in enumerate([Outcome.SURVIVED, Outcome.COLLISION, Outcome.INVALID, Outcome.FINISHED]):
            ledger.record(plain(number, outcome), snapshot="")
        ledger.record(replace(plain(4, Outcome.INVALID), failure=killed), snapshot="")
        ledger.record(plain(5, Outcome.COLLISION), snapshot="")
        watch = rare_module.rate_watch(RULED, ledger, records())
        found = watch.running(now=True)
        assert (found["per"], found["trials"], found["crashes"]) == ("trial", 3, 1)  # up to the killed trial
        ledger.note(independent=False)
        assert rare_module.rate_watch(RULED, ledger, records()) is None
        assert rare_module.bar_watch(RULED, ledger, records()) is None
        until = of(run=SimpleNamespace(until_rate="0.5/trial"))
        bar = rare_module.bar_watch(until, ledger, records())
        assert (bar.bar, bar.per) == (0.5, "trial")
        assert bar.running(now=True)["crashes"] == 1


def estimate_of(report):
    data = report.rare.to_json()
    return {key: value for key, value in data.items() if key != "crashes"}


@pytest.mark.nightly
def test_a_hunt_in_rare_mode_is_the_same_with_any_number_of_workers_and_resumed(tmp_path, monkeypatch):
    monkeypatch.setattr(rare_module, "BLOCK", 4)  # of 32, the third would begin after 320 trials
    options = OPTIONS | {"disturb": ["brake=0.02", "stop=0.02"]}
    whole = crashhunt.run(tmp_path / "whole", 1, 60, 60, **options)
    crashhunt.run(tmp_path / "again", 3, 33, 60, **options)
    again = crashhunt.run(tmp_path / "again", 2, 60, 60, **options)
    expected = estimate_of(whole)
    # The estimate of a hunt whose TRIALS was changed is withheld where its interval is.
    expected |= {"estimate": None, "why_not": f"TRIALS was changed after results were known, and {expected['why_not']}"}
    assert estimate_of(again) == expected
    assert whole.rare.run_again == len(whole.rare.crashes) > 0
    assert whole.rare.estimate.roots == 12
    with closing(Ledger(tmp_path / "whole" / "ledger.sqlite")) as ledger:
        results = list(ledger.results())
    roots = [result for result in results if is_root(result.spec.number)]
    assert all(one.step == 1 for result in roots for one in result.spec.disturbances)
    assert roots[0].spec.forcing.ratios == {} != roots[11].spec.forcing.ratios
    assert 3 < sum(len(result.forced.copies) for result in roots) / 12 <= 9
    others = [result for result in results if not is_root(result.spec.number)]
    assert all(result.forced is None and result.spec.forcing is None for result in others)
    assert any(one.step > 1 for result in others for one in result.spec.disturbances)
    crashed = [result for result in others if result.outcome in CRASHES]
    assert whole.rare.estimate.plain_crashes == len(crashed)
    found = hunt_state(tmp_path / "whole").rate
    assert found == whole.rare.estimate.running()


@pytest.mark.nightly
def test_a_hunt_in_rare_mode_ends_where_the_error_is_small_enough(tmp_path):
    options = OPTIONS | {"disturb": ["brake=0.5", "stop=0.5"], "until_error": "60%"}
    report = crashhunt.run(tmp_path / "h", 2, 1000, 60, **options)
    assert report.stopped_because == "precise"
    assert report.rare.estimate.relative_error <= 0.6
    assert report.rare.estimate.roots % BLOCK == 0
    assert "per trial (" in report.rare.lines[0]


def test_result_with_copies_survives_json():
    result = root(3, "collision")
    assert TrialResult.from_json(result.to_json()) == result
    assert result.other_steps == 90
    lost = replace(result, forced=replace(result.forced, unanswered=1, may_be_asked_again=True))
    assert lost.is_to_be_run_again
    assert not lost.is_fully_asked
