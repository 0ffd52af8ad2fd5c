"""A gate of several hunts whose trials are made up: how pairs are shared, what ends it, and what it reports."""

from __future__ import annotations

import math
from contextlib import closing

import numpy as np
import pytest

from crashhunt.base import layout
from crashhunt.base.errors import NoValidTrialError, UsageError
from crashhunt.ledger import Ledger
from crashhunt.plans import HuntSettings, Request, write_settings
from crashhunt.report import describe_gate
from crashhunt.suites import Gate, GateVersion, RunRequest, _gate_runs as _gate
from crashhunt.suites._gate_preventable_crashes import PreventableCrashes
from crashhunt.trial import Failure, Outcome, TrialResult, TrialSpec

SEED = 4
OTHER = {"base": "head", "head": "base"}


def gate(tmp_path, names=("a", "b", "c"), *, most=10, **more):
    hunts = {
        name: RunRequest(Request(scenario="loop", trials=1, max_steps=9, seed=SEED), str(tmp_path)) for name in names
    }
    versions = {"base": GateVersion("m:Old", {"": "m:Old"}), "head": GateVersion("m:New", {"": "m:New"})}
    return Gate(**versions, hunts=hunts, folder=tmp_path, most=most, is_suite=len(names) > 1, **more)


@pytest.fixture
def ran(monkeypatch):
    """Hunts run at once: BASE crashes in the trials in `crashes[0]`, HEAD in those in `crashes[1]`."""
    calls, crashes = [], [set(), set()]

    def run_all(folders, slots, *, watch, machine, is_enough, environments, partners):
        assert all(partners[folder] == folder.with_name(OTHER[folder.name]) for folder in folders)
        for folder in folders:
            asked = RunRequest.read(folder / layout.REQUEST).request
            calls.append((folder, slots, machine, asked))
            settings = HuntSettings(scenario="loop", scenario_digest="0", trials=asked.trials, max_steps=9, seed=SEED,
                                    run=asked.run)  # fmt: skip
            write_settings(folder / layout.HUNT, settings, ["crashhunt", "gate"])
            with closing(Ledger(folder / layout.LEDGER, writable=True)) as ledger:
                for number in range(asked.trials):
                    outcome = Outcome.COLLISION if number in crashes[folder.name == "head"] else Outcome.SURVIVED
                    failure = Failure("invalid", "it does not fit") if "invalid" in crashes else None
                    outcome = Outcome.INVALID if failure else outcome
                    result = TrialResult(TrialSpec(number, number, {}, {}, 9), outcome, steps=5, failure=failure)
                    ledger.record(result, snapshot="0")
                ledger.enter("no_valid_trial" if "invalid" in crashes else "all_trials", "it does not fit")
        watch()
        is_enough()

    monkeypatch.setattr(_gate, "run_all", run_all)
    return calls, crashes


def test_pairs_are_shared_by_all_hunts_and_both_versions_run_with_equal_seeds(tmp_path, ran):
    calls, crashes = ran
    crashes[1].update((1, 2))
    seen = []
    report = gate(tmp_path).run(tmp_path / "g", seen.append)
    assert [(folder.relative_to(tmp_path / "g").as_posix(), asked.trials) for folder, *_, asked in calls] == [
        ("a/base", 4), ("a/head", 4), ("b/base", 3), ("b/head", 3), ("c/base", 3), ("c/head", 3),
    ]  # fmt: skip
    assert [asked.agents for *_, asked in calls] == [{"": "m:Old"}, {"": "m:New"}] * 3
    assert all(asked.run.keep_going and asked.seed == SEED for *_, asked in calls)
    assert all(slots >= 2 for _, slots, *_ in calls)
    assert [machine["trials"] for _, _, machine, _ in calls] == [4, 4, 3, 3, 3, 3]
    assert [(one.name, one.pairs, one.only_base, one.only_head) for one in report.scenarios] == [
        ("a", 4, 0, 2), ("b", 3, 0, 2), ("c", 3, 0, 2),
    ]  # fmt: skip
    assert (report.pairs, report.only_base, report.only_head, report.both) == (10, 0, 6, 0)
    assert report.evidence > 1
    assert seen[-1].name == "c"
    assert (seen[-1].done, seen[-1].most, seen[-1].only_base, seen[-1].only_head) == (10, 10, 0, 6)
    assert seen[-1].evidence == pytest.approx(report.evidence)
    assert [one.done for one in seen] == sorted(one.done for one in seen)
    # A gate with the same command continues, and one with other versions is refused.
    calls.clear()
    assert gate(tmp_path).run(tmp_path / "g").to_json() == report.to_json()
    assert calls == []


@pytest.mark.parametrize(("worse", "hunts"), [(True, 1), (False, 3)])
def test_only_worse_ends_a_suite_before_its_last_hunt(tmp_path, ran, worse, hunts):
    calls, crashes = ran
    crashes[worse].update(range(100))
    report = gate(tmp_path, most=90).run(tmp_path / "g")
    assert report.verdict == ("worse" if worse else "better")
    assert len(calls) == 2 * hunts


def test_a_gate_ends_in_the_middle_once_the_difference_is_within_the_margin(tmp_path, ran):
    report = gate(tmp_path, ["loop"], most=400, margin=0.05).run(tmp_path / "g")
    assert report.verdict == "no_difference"
    assert 0 < report.pairs < 400
    assert report.scenarios[0].pairs == report.pairs
    assert -0.05 <= report.difference.low <= 0 <= report.difference.high <= 0.05


def test_equal_hunts_without_a_margin_are_undecided_for_a_reason(tmp_path, ran):
    report = gate(tmp_path, ["loop"], most=20).run(tmp_path / "g")
    assert (report.verdict, report.pairs, report.evidence) == ("undecided", 20, pytest.approx(1.0))
    assert report.why
    assert not report.is_interrupted
    report = gate(tmp_path, ["loop"], most=20, duration_s=-1.0).run(tmp_path / "late")
    assert "the time is up" in report.why


def test_an_interrupt_reports_what_there_is(tmp_path, ran, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(_gate, "run_all", interrupted)
    report = gate(tmp_path).run(tmp_path / "g")
    assert (report.verdict, report.is_interrupted, report.why) == ("undecided", True, "interrupted")


def test_a_hunt_without_a_valid_trial_is_an_error_of_its_version(tmp_path, ran):
    ran[1].append("invalid")
    with pytest.raises(NoValidTrialError, match="no trial can be set up: it does not fit") as caught:
        gate(tmp_path, ["loop"]).run(tmp_path / "g")
    assert caught.value.where == "BASE (m:Old)"


def test_hunts_of_a_suite_have_their_own_seeds_that_come_from_the_gates(tmp_path, ran):
    calls, _ = ran
    asked = gate(tmp_path)
    for name, run in asked.hunts.items():
        asked.hunts[name] = RunRequest(Request(scenario="loop", trials=1, max_steps=9), run.folder)
    report = asked.run(tmp_path / "g")
    wanted = [int(np.random.SeedSequence(report.seed, spawn_key=(n,)).generate_state(1)[0]) for n in range(3)]
    assert [one.seed for *_, one in calls] == [seed for seed in wanted for _ in range(2)]
    assert asked.run(tmp_path / "g").seed == report.seed
    assert asked.run(tmp_path / "h").seed != report.seed


@pytest.mark.parametrize(
    "wrong", [{"most": 0}, {"most": 2}, {"margin": 1.0}, {"margin": -0.1}, {"confidence": 100.0}, {"parallel": -1}]
)
def test_limits_out_of_range_are_refused_before_anything_is_written(tmp_path, wrong):
    with pytest.raises(UsageError):
        gate(tmp_path, **wrong).run(tmp_path / "g")
    assert not (tmp_path / "g").exists()
    assert math.isinf(gate(tmp_path).duration_s)


def test_a_version_is_an_agent_or_else_a_commit(tmp_path):
    assert GateVersion.of("mine:Driver", tmp_path) == GateVersion("mine:Driver", {"": "mine:Driver"})
    assert GateVersion.of("ego=keep-lane", tmp_path).agents == {"ego": "keep-lane"}
    for word in ("ego=nobody", "", "no-such-revision"):
        with pytest.raises(UsageError, match="is neither an agent nor a commit"):
            GateVersion.of(word, tmp_path)
    found = GateVersion("v1", {}, commit="0123456789abcdef")
    assert str(found) == "v1 (0123456789)"
    assert str(GateVersion("0123", {}, commit="0123456789abcdef")) == "0123"
    assert str(GateVersion("m:A", {"": "m:A"})) == "m:A"


def test_hunts_continue_until_the_pairs_are_enough(tmp_path, ran, monkeypatch):
    said = []

    def watched(*words, is_enough, **more):
        said.append(is_enough())
        run_all(*words, is_enough=lambda: said.append(is_enough()), **more)

    run_all = _gate.run_all
    monkeypatch.setattr(_gate, "run_all", watched)
    gate(tmp_path, ["loop"], most=5).run(tmp_path / "g")
    assert said == [False, True]


def test_only_collisions_that_a_competent_driver_prevents_count(tmp_path, ran, monkeypatch):
    _, crashes = ran
    crashes[0] |= {0, 1}
    crashes[1] |= {0, 2, 3, 4}
    answers = {("base", 0): "yes", ("head", 0): "no", ("head", 2): "no_collision", ("head", 3): "yes"}
    asked = []

    def judge(_, hunt, number):
        asked.append((hunt.name, number))
        return answers.get((hunt.name, number), "unknown")

    monkeypatch.setattr(PreventableCrashes, "_judge", judge)
    report = gate(tmp_path, ("a",), only_preventable=True).run(tmp_path / "kept")
    assert (report.only_base, report.only_head, report.both) == (1, 2, 0)
    assert report.preventable == {"yes": 2, "no": 1, "unknown": 2, "no_collision": 1}
    assert report.to_json()["preventable"] == report.preventable
    assert (
        "2 of 5; no model prevents 1, and no model has an answer for 2; crashes without a collision: 1"
        in describe_gate(report)
    )
    assert report.rates is None
    first = len(asked)
    again = gate(tmp_path, ("a",), only_preventable=True).run(tmp_path / "kept")
    assert (again.only_base, again.only_head) == (1, 2)
    assert len(asked) == first == 6  # each crash once


def test_gate_without_the_option_counts_all_crashes_and_reports_no_answers(tmp_path, ran):
    _, crashes = ran
    crashes[1] |= {2}
    report = gate(tmp_path, ("a",)).run()
    assert report.only_head == 1
    assert "preventable" not in report.to_json()
