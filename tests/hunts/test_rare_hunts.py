"""Rare mode: what it refuses, which forcing a root has, when it ends, and whole hunts on the toy."""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import pytest

import crashhunt
from crashhunt.disturbances import DisturbanceSampler, brake
from crashhunt.errors import UsageError
from crashhunt.hunts._rare import Forcings, PrecisionRule
from crashhunt.ledger import Ledger
from crashhunt.rates import BLOCK
from crashhunt.trial import CRASHES, Forced, ForcedCopy, Forcing, Outcome, TrialResult, TrialSpec

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux only")

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
        ({"disturb": ["stop=0.01"], "sampler": "guided"}, "the sampler guided does not draw trials independently"),
        ({"disturb": ["stop=0.01"], "seeds": 3}, "--rare and --seeds exclude each other"),
        ({"disturb": ["stop=0.01"], "branch": True}, "--rare and --branch exclude each other"),
        ({"disturb": ["stop=0.01"], "probe": "4s"}, "--rare and --probe exclude each other"),
        ({"disturb": ["stop=0.01"], "distinct": 2}, "--rare and --distinct exclude each other"),
        ({"disturb": ["stop=3"]}, "stop=3 has a chance of 0.3 per step"),
        ({"rare": False, "until_error": "30%"}, "--until-error 30% is for --rare"),
        ({"disturb": ["stop=0.01"], "until_error": "300%"}, "--until-error is 300%"),
        ({"disturb": ["stop=0.01"], "until_error": "soon"}, "--until-error is soon"),
    ],
)
def test_rare_mode_refuses_what_it_has_no_law_for(tmp_path, options, says):
    with pytest.raises(UsageError, match=says) as refused:
        crashhunt.prepare(tmp_path / "h", 1, 8, 20, **(OPTIONS | options))
    assert refused.value.fix


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


def test_forcing_is_learned_from_the_blocks_before_the_previous_one():
    rows = Rows({number: root(number, "collision") for number in range(BLOCK)})
    forcings = Forcings(settings(), rows, SAMPLER)
    assert [Forcings.needed(number) for number in (0, BLOCK, 2 * BLOCK - 1, 2 * BLOCK, 3 * BLOCK)] == [
        0, 0, 0, BLOCK, 2 * BLOCK,
    ]  # fmt: skip
    start = forcings.of(0)
    assert (forcings.of(2 * BLOCK - 1), start.ratios) == (start, {})
    learned = forcings.of(2 * BLOCK)
    assert learned.ratios["brake=6.0"] > 1 > learned.ratios["brake=2.0"]
    # A resumed hunt begins at any root, and has the same forcing.
    assert Forcings(settings(), rows, SAMPLER).of(2 * BLOCK + 5) == learned


def test_precision_rule_ends_at_a_full_block_and_excludes_incomplete_roots():
    rows = Rows({number: root(number, "collision" if number % 2 else "") for number in range(5 * BLOCK)})
    rows[3] = root(3, unanswered=1, why_unanswered="a copy was killed")
    rule = PrecisionRule(settings("0.3"), rows, SAMPLER)
    rule.read(40)
    assert (len(rule.roots) + rule.excluded, rule.excluded, rule.is_met) == (40, 1, False)
    rule.read()
    assert rule.is_met
    assert len(rule.roots) + rule.excluded == 2 * BLOCK  # of 5 blocks
    assert rule.estimate().relative_error <= 0.3
    del rows[7]
    gap = PrecisionRule(settings(), rows, SAMPLER)
    gap.read()
    assert len(gap.roots) + gap.excluded == 7  # a root of a higher number does not count before one that has not ended


def estimate_of(report):
    data = report.rare.to_json()
    return {key: value for key, value in data.items() if key != "crashes"}


@pytest.mark.nightly
def test_a_hunt_in_rare_mode_is_the_same_with_any_number_of_workers_and_resumed(tmp_path):
    options = OPTIONS | {"disturb": ["brake=0.02", "stop=0.02"]}
    one = crashhunt.run(tmp_path / "one", 1, 70, 60, **options)
    three = crashhunt.run(tmp_path / "three", 3, 70, 60, **options)
    crashhunt.run(tmp_path / "again", 2, 40, 60, **options)
    again = crashhunt.run(tmp_path / "again", 2, 70, 60, **options)
    assert estimate_of(one) == estimate_of(three) == estimate_of(again)
    assert one.rare.is_verified
    assert one.rare.verified == 5
    assert len(one.rare.crashes) == 5
    assert one.rare.estimate.roots == 70
    with closing(Ledger(tmp_path / "one" / "ledger.sqlite")) as ledger:
        results = list(ledger.results())
    assert all(one.step == 1 for result in results for one in result.spec.disturbances)
    assert results[0].spec.forcing.ratios == {} != results[69].spec.forcing.ratios
    assert 4 < sum(len(result.forced.copies) for result in results) / 70 <= 8


@pytest.mark.nightly
def test_a_hunt_in_rare_mode_ends_where_the_error_is_small_enough(tmp_path):
    options = OPTIONS | {"disturb": ["brake=0.5", "stop=0.5"], "until_error": "60%"}
    report = crashhunt.run(tmp_path / "h", 2, 200, 60, **options)
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
