"""Rare mode: what it refuses, which forcing a root has, when it ends, and whole hunts on the toy."""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import pytest

import crashhunt
from crashhunt.cli import _spell_out
from crashhunt.disturbances import DisturbanceSampler, brake
from crashhunt.errors import UsageError
from crashhunt.hunts import _rates as rare_module, hunt_state
from crashhunt.hunts._rates import Forcings, RareWatch, SplittingWatch
from crashhunt.hunts._reports import RareReport
from crashhunt.ledger import Ledger
from crashhunt.rates import BLOCK, TRIALS_PER_ROOT, _splitting as splitting, is_root
from crashhunt.trial import CRASHES, Disturbance, Forced, ForcedCopy, Forcing, Outcome, TrialResult, TrialSpec

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks need Linux")

TOY = """
title = "A toy"
schema = 1
simulator = "toy"
[arguments.gap_m]
default = 12.0
[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"
[agents.ego.arguments.speed]
default = 9.0
"""
OPTIONS = {"scenario": "toy.toml", "seed": 4, "snapshot_code": False, "rare": True}


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    (tmp_path / "toy.toml").write_text(TOY)
    monkeypatch.chdir(tmp_path)


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
        ({"rare": False, "splitting": True}, "--splitting needs --rare"),
        ({"splitting": True, "sampler": "guided"}, "--sampler guided draws dependent trials"),
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


def test_a_box_of_western_longitudes_is_the_value_of_its_option():
    assert _spell_out(["init", "d", "--bbox", "-122.3,37.8,-122.2,37.9"]) == [
        "init", "d", "--bbox=-122.3,37.8,-122.2,37.9",
    ]  # fmt: skip
    for words in (["init", "d", "--bbox"], ["init", "--bbox", "--json"], ["init", "d", "--bbox", "2,48,3,49"]):
        assert _spell_out(words) == words


def test_splitting_needs_no_disturbance_and_is_written_as_the_second_word_of_rare(tmp_path):
    assert crashhunt.prepare(tmp_path / "h", 1, 8, 20, **OPTIONS, splitting=True).settings.splitting
    assert _spell_out(["run", "--rare", "splitting", "h"]) == ["run", "--rare", "--splitting", "h"]
    assert _spell_out(["run", "splitting", "--rare", "h"]) == ["run", "splitting", "--rare", "h"]


class Rows(dict):
    """A ledger of roots."""

    def result(self, number):
        return self.get(number)


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


def test_running_rate_of_splitting_counts_the_pilots():
    rows = rows_of([root(number) for number in range(3)])
    watch = SplittingWatch(settings(), rows)
    for roots in (1, 3):
        watch.read(roots * TRIALS_PER_ROOT)
        assert watch.running(now=True)["why_not"] == f"{roots} of 128 pilot roots have ended"


def test_too_many_invalid_plain_trials_leave_no_estimate():
    rows = rows_of([root(number, "collision" if number % 2 else "") for number in range(50)])
    rows[0] = root(0, unanswered=1, why_unanswered="a copy was killed")  # its plain trials count in any case
    for number in range(1, 55, 5):  # of 200 plain trials, 11
        rows[number] = plain(number, Outcome.INVALID)
    rule = RareWatch(settings(), rows, SAMPLER)
    rule.read()
    found = rule.estimate()
    assert found.why_not == "11 of 200 plain trials are invalid, more than 5%: the rest is other traffic than described"
    assert (found.estimate, found.certain, found.estimated) == (None, None, None)
    rows[51] = plain(51)
    rule = RareWatch(settings(), rows, SAMPLER)
    rule.read()
    assert rule.estimate().estimate > 0


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
    assert estimate_of(whole) == estimate_of(again)
    assert whole.rare.verified == len(whole.rare.crashes) > 0
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


@pytest.mark.nightly
def test_hunt_with_splitting_copies_paths_whose_crashes_come_again_from_the_start(tmp_path, monkeypatch):
    for module in (rare_module, splitting):
        monkeypatch.setattr(module, "PILOT_ROOTS", 6)
    monkeypatch.setattr(rare_module, "why_unfit", lambda shares: "")
    (tmp_path / "toy.toml").write_text(TOY.replace("12.0", "5.0"))
    options = OPTIONS | {"splitting": True, "keep": 1, "keep_going": True, "arguments": {"speed": 10.8}}
    whole = crashhunt.run(tmp_path / "whole", 2, 90, 60, **options)
    crashhunt.run(tmp_path / "again", 1, 63, 60, **options)
    again = crashhunt.run(tmp_path / "again", 2, 90, 60, **options)
    assert estimate_of(whole) == estimate_of(again)
    with closing(Ledger(tmp_path / "whole" / "ledger.sqlite")) as ledger:
        roots = [result for result in ledger.results() if is_root(result.spec.number)]
    copies = [copy for result in roots for copy in result.forced.copies]
    assert copies
    assert not any(result.forced.copies for result in roots[:6])
    assert whole.rare.estimate.roots == 6
    assert whole.rare.verified == len(whole.rare.crashes) > 0
    assert any("levels (closing speed by gap)" in line for line in whole.rare.lines)
