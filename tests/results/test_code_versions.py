"""Hunts whose code changes: they are refused or keep the versions apart, in every figure."""

from __future__ import annotations

import math
import os
import shutil
from contextlib import closing
from dataclasses import replace

import pytest
from made_up_trials import Inline, leave_own_code_out, replace_bundles, survives

import crashhunt
from crashhunt.cli import main
from crashhunt.crashes import group_crashes, list_bundles
from crashhunt.errors import HuntDirectoryError
from crashhunt.hunts import Hunt, _hunt, check
from crashhunt.ledger import Ledger
from crashhunt.report import describe_hunt, describe_rates
from crashhunt.results import CodeVersions, HuntResults, count_versions, crashes_by_version, find_crashes, hunt_state
from crashhunt.samplers import NamedSampler
from crashhunt.statistics import compare, measure_rates
from crashhunt.trial import Failure, Outcome

TOY = """
title = "A toy"
schema = 1
simulator = "toy"
[arguments.gap_m]
default = 30.0
[agents.ego]
agent = "mine:Mine"
"""
AGENT = """
class Mine:
    def reset(self, seed):
        self.fails = seed % 4 in {0}
    def act(self, observation):
        assert not self.fails
        return 8.0, 0
"""
OPTIONS = {"scenario": "toy.toml", "seed": 4, "snapshot_code": False, "keep_going": True}
REFUSED = "the code has changed since the"


@pytest.fixture
def agent(tmp_path, monkeypatch):
    """Writes the agent, which fails in trials whose seeds, modulo 4, are given."""

    def write(*fails):
        (tmp_path / "mine.py").write_text(AGENT.format(set(fails) or "()"))
        write.fails = fails

    leave_own_code_out(monkeypatch)
    (tmp_path / "toy.toml").write_text(TOY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    write(0)
    return write


def make_up(agent, monkeypatch):
    """Have no trial run: each ends as the agent would have it end."""

    def ends(spec):
        failed = {"outcome": Outcome.AGENT_ERROR, "failure": Failure("AssertionError", "", agent="ego")}
        return replace(survives(spec), **(failed if spec.seed % 4 in agent.fails else {}))

    def make(name, settings, *, parallel):
        executor = Inline(settings, parallel=parallel, ends=ends)
        executor.said = []
        return executor

    replace_bundles(monkeypatch)
    monkeypatch.setattr(_hunt, "make_executor", make)


@pytest.fixture
def made_up(agent, monkeypatch):
    """The same, where no trial runs."""
    make_up(agent, monkeypatch)
    return agent


def run(trials, path="h", **options):
    return crashhunt.run(path, 1, trials, 3, **OPTIONS | options)


def contents(path):
    return {file.relative_to(path).as_posix(): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}


def rows(path):
    with closing(Ledger(path / "ledger.sqlite")) as ledger:
        return {one.spec.number: str(one.outcome) for one in ledger.results()}


def test_hunt_does_not_resume_with_other_code_and_loses_nothing(made_up, tmp_path):
    run(8)
    before = contents(tmp_path / "h")
    made_up(0, 1, 2, 3)
    for trials in (8, 16):  # also where there is nothing to run: the user expects results of the present code
        with pytest.raises(HuntDirectoryError, match=f"{REFUSED} 8 trials of this hunt: mine.py;") as caught:
            run(trials)
        assert "--continue-with-new-code" in caught.value.fix
    after = contents(tmp_path / "h")
    assert {**after, ".lock": b""} == {**before, ".lock": b""}  # which has the number of the process
    made_up(0)
    os.utime("mine.py", (1, 1))
    (tmp_path / "README.md").write_text("read me")
    (tmp_path / "__pycache__").mkdir(exist_ok=True)
    assert sum(run(9).outcomes.values()) == 9


def test_hunt_without_results_may_change_its_code(made_up, tmp_path):
    run(2)
    with closing(Ledger(tmp_path / "h" / "ledger.sqlite", writable=True)) as ledger:
        ledger.replace([0, 1])
    made_up(0, 1, 2, 3)
    report = run(4)
    assert (report.outcomes, report.code_versions) == ({"agent_error": 4}, ())


@pytest.mark.long
def test_versions_are_kept_apart_in_every_figure(agent, tmp_path, capsys, monkeypatch):
    hunt = tmp_path / "h"
    first = run(4, keep=1)
    failed = first.outcomes["agent_error"]
    agent(0, 1, 2, 3)
    with pytest.raises(
        HuntDirectoryError, match="TRIALS is 4, but the first 4 trials belong to earlier code"
    ) as caught:
        run(4, continue_with_new_code=True)
    assert caught.value.fix.startswith("give more than 4 TRIALS")
    report = run(7, keep=1, continue_with_new_code=True)
    newest, earlier = sorted(report.code_versions, key=lambda one: not one.is_newest)
    assert (newest.version, newest.first, newest.trials, newest.crashes) == (2, 4, 3, 3)
    assert (earlier.version, earlier.first, earlier.trials, earlier.crashes) == (1, None, 4, failed)
    assert report.tally.found == sum(group.count for group in report.kinds) == 3
    assert "newest version 2: 3 of 3 trials crashed; version 1:" in describe_hunt(report)
    assert report.to_json()["code_versions"][1]["crashes"] == 3

    (rate,) = measure_rates(hunt, per="trial")
    assert (rate.trials, rate.crashes, rate.estimate, rate.excluded) == (3, 3, 1.0, {"other_code": 4})
    assert "not counted: 4 of earlier code" in describe_rates([rate])
    state = hunt_state(hunt)
    assert (state.rate["trials"], state.rate["crashes"], state.rate["certain"]["low"]) == (3, 3, rate.certain.low)
    assert (state.crashes, [one["crashes"] for one in state.code_versions]) == (failed + 3, [failed, 3])
    assert state.kinds[0]["count"] == 3
    results = HuntResults(hunt)
    assert [row["code_version"] for row in results.rows()] == [1] * 4 + [2] * 3
    assert results.trials()["code_version"].tolist() == [1] * 4 + [2] * 3
    with monkeypatch.context() as patch:
        make_up(agent, patch)
        run(7, "other")
    comparison = compare(hunt, "other")
    figures = comparison.hunts[0]
    assert (figures.trials, figures.crashes, figures.crash_rate, figures.outcomes) == (3, 3, 1.0, {"agent_error": 3})
    (pair,) = comparison.pairs
    assert (pair.trials, pair.both) == (3, 3)
    groups = group_crashes(list_bundles(hunt), faults=False).groups
    assert [*crashes_by_version([hunt], groups)[str(hunt)].values()] == [{1: failed, 2: 3}]
    found = find_crashes(hunt, 9)
    assert (list(found.types.values()), found.untyped, found.tally.found) == ([3], 0, failed + 3)
    assert check(hunt)[0].fine
    for command in ("status", "crashes", "rate"):
        with pytest.raises(SystemExit) as ended:
            main([command, str(hunt)])
        assert ended.value.code == 0
        assert "version 1" in (text := capsys.readouterr().out) or "4 of earlier code" in text


def test_raise_after_results_of_the_newest_version_forbids_its_estimate_but_not_that_of_the_next(made_up, tmp_path):
    hunt = tmp_path / "h"
    run(4)
    made_up(0, 1, 2, 3)
    run(7, continue_with_new_code=True)
    assert measure_rates(hunt, per="trial")[0].estimate == 1.0
    run(8)
    assert measure_rates(hunt, per="trial")[0].why_not.startswith("TRIALS was changed")
    made_up(0)  # the first version again
    with pytest.raises(HuntDirectoryError, match=f"{REFUSED} 4 trials"):
        run(11)
    report = run(11, continue_with_new_code=True)
    newest = next(one for one in report.code_versions if one.is_newest)
    assert (newest.version, newest.first, newest.trials, len(report.code_versions)) == (1, 8, 7, 2)
    (rate,) = measure_rates(hunt, per="trial")
    assert (rate.trials, rate.excluded, rate.estimate) == (3, {"other_code": 8}, rate.crashes / 4)
    assert HuntResults(hunt)._snapshot().digest in CodeVersions.of(HuntResults(hunt).facts).newest


@pytest.mark.long
@pytest.mark.nightly
def test_crash_of_earlier_code_does_not_end_the_hunt_for_one_of_the_new_code(agent, tmp_path):
    options = {"keep_going": False}
    report = run(16, **options)
    assert report.stopped_because == "crash"
    (crash,) = report.crashes
    agent()  # fixed
    with pytest.raises(HuntDirectoryError, match=REFUSED):
        run(16, **options)
    fixed = run(16, continue_with_new_code=True, **options)
    assert (fixed.stopped_because, fixed.crashes, fixed.tally.found) == ("all_trials", (), 0)
    (rate,) = measure_rates(tmp_path / "h", per="trial")
    assert rate.crashes == 0
    # Trials that were under way when the crash ended the hunt are a choice by their results.
    assert crash.result.spec.number < 16 - rate.trials
    assert [one.id for one in list_bundles(tmp_path / "h")] == [crash.id]
    again = run(16, **options)  # which states the result again
    assert (again.stopped_because, again.crashes) == ("all_trials", ())


def test_hunts_whose_figures_need_all_trials_do_not_continue_with_new_code(made_up):
    options = {"seeds": 2}
    run(4, **options)
    made_up(1)
    with pytest.raises(HuntDirectoryError, match="--continue-with-new-code and --seeds exclude each other"):
        run(8, continue_with_new_code=True, **options)


def test_resumed_hunt_names_new_files_that_do_not_count(made_up, tmp_path):
    (tmp_path / "car").mkdir()
    shutil.move("mine.py", tmp_path / "car" / "mine.py")
    (tmp_path / "toy.toml").write_text(TOY.replace("mine:Mine", "car.mine:Mine"))
    run(2)
    (tmp_path / "car" / "film.mp4").write_bytes(b"a film")
    report = run(3)
    assert report.notes == ("new since the earlier trials, and not counted as a change of the code: car/film.mp4",)
    assert report.code_versions == ()
    (tmp_path / "car" / "helper.py").write_text("")
    with pytest.raises(HuntDirectoryError, match=r"car/helper.py \(new\);"):
        run(4)


@pytest.mark.parametrize(
    ("timeout_s", "says"),
    [(5, "2 of the hunt's trials took longer or hung"), pytest.param(90, "1 of the", marks=pytest.mark.nightly)],
)
def test_other_time_limit_is_refused_where_earlier_trials_would_end_otherwise(made_up, tmp_path, timeout_s, says):
    run(3, timeout_s=50)
    run(4, timeout_s=40)  # which changes nothing
    with closing(Ledger(tmp_path / "h" / "ledger.sqlite", writable=True)) as ledger:
        snapshot = ledger.snapshot_of(0)
        for number, outcome, wall_s in (
            (0, Outcome.HANG, 30.0), (1, Outcome.SURVIVED, 30.0),
            (2, Outcome.SURVIVED, 0.1), (3, Outcome.SURVIVED, 0.1),
        ):  # fmt: skip
            ledger.record(replace(ledger.result(number), outcome=outcome, wall_s=wall_s), snapshot=snapshot)
    with pytest.raises(HuntDirectoryError, match=f"--timeout was 40 and is now {timeout_s}, but {says}") as caught:
        run(5, timeout_s=timeout_s)
    assert caught.value.fix == "give --timeout 40, or a new directory"


@pytest.mark.nightly
def test_hunt_of_a_gate_names_no_option_that_its_command_lacks(made_up, tmp_path, monkeypatch):
    run(2)
    made_up(1)
    monkeypatch.setattr("crashhunt.hunts.Hunt", lambda *given, **more: Hunt(*given, **more, partner=tmp_path / "other"))
    with pytest.raises(HuntDirectoryError, match=REFUSED) as caught:
        run(4)
    assert "--" not in caught.value.fix


def test_learning_sampler_receives_no_results_of_earlier_code(made_up, tmp_path, monkeypatch):
    told = []
    run(4, sampler="mutation")
    made_up(0, 1, 2, 3)
    tell = NamedSampler.tell
    monkeypatch.setattr(NamedSampler, "tell", lambda sampler, result: told.append(result) or tell(sampler, result))
    run(16, sampler="mutation", continue_with_new_code=True)
    assert {str(one.outcome) for one in told} == {"agent_error"}
    assert min(one.spec.number for one in told) >= 4


@pytest.mark.nightly
def test_versions_of_a_hunt_that_recorded_none_are_those_of_its_snapshots(agent, tmp_path):
    """A hunt of an earlier crashhunt, which resumed with any code."""
    hunt = tmp_path / "h"
    run(4)
    agent(0, 1, 2, 3)
    run(7, continue_with_new_code=True, keep=1)
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(code_versions=None)
    report = run(9, keep=1)
    assert [(one.trials, one.is_newest) for one in report.code_versions] == [(4, False), (5, True)]
    (rate,) = measure_rates(hunt, per="trial")
    assert (rate.crashes, rate.trials + rate.excluded["other_code"]) == (rate.trials, 9)
    assert rate.trials > 0
    with closing(Ledger(hunt / "ledger.sqlite")) as ledger:
        assert len(count_versions(ledger, ledger.facts(), ("agent_error",))) == 2
    assert math.isfinite(rate.certain.low)
