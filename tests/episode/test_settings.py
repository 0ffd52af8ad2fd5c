"""What a worker is told, as it crosses to another process and to another version."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt.base.errors import CrashhuntError
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.scenario import load_scenario
from crashhunt.trial import Outcome, TrialResult, TrialSpec

TOY = """
title = "A toy"
schema = 1
simulator = "toy"
step_length_s = 0.25
[arguments.gap_m]
default = 30.0
range = "10:60"
[agents.ego]
agent = "keep-lane"
[agents.ego.arguments.speed]
default = 8.0
"""


@pytest.fixture
def scenario(tmp_path):
    (tmp_path / "scenario.toml").write_text(TOY)
    return replace(load_scenario(tmp_path / "scenario.toml"), notes=("said once",))


@pytest.fixture
def settings(scenario, tmp_path):
    return WorkerSettings(
        scenario=scenario, oracles=("overlap", "my:Oracle"), crash_on=(Outcome.HANG, Outcome.COLLISION),
        scratch=tmp_path / "scratch", code=("/a", "/b"), argument_files={"w.npz": "/c/w.npz"}, timeout_s=2.5,
        keep_trials=True, sealed=("/d",), find_escapes=True, audit=0.25, hunt_seed=7,
    )  # fmt: skip


def plain(settings):
    return json.loads(json.dumps(settings.to_json()))


def test_it_crosses_as_json(settings):
    again = WorkerSettings.from_json(plain(settings))
    assert again == settings
    assert again.scenario.agents["ego"].arguments["speed"].default == 8.0


@pytest.mark.parametrize(("name", "value"), [("warm_copies", 3), ("probe_s", 2.5)])
def test_what_has_come_since_is_reported_where_it_is_asked_for_only(settings, name, value):
    assert name not in plain(settings)
    asked = replace(settings, **{name: value})
    assert plain(asked)[name] == value
    assert WorkerSettings.from_json(plain(asked)) == asked


def test_what_is_not_said_is_the_usual(scenario, tmp_path):
    usual = WorkerSettings(scenario=scenario, oracles=(), crash_on=(), scratch=tmp_path)
    facts = (usual.code, usual.argument_files, usual.timeout_s, usual.keep_trials, usual.sealed, usual.find_escapes)
    assert facts == ((), {}, 60.0, False, None, False)
    assert (usual.audit, usual.hunt_seed) == (0.0, 0)
    data = plain(usual)
    assert WorkerSettings.from_json(data) == usual
    for name in (
        "argument_files",
        "sealed",
        "find_escapes",
        "audit",
        "hunt_seed",
    ):  # which earlier versions did not say
        del data[name]
    assert WorkerSettings.from_json(data) == usual


def test_an_older_version_is_reported_of_nothing_that_it_need_not_know(settings):
    data = plain(settings)
    assert data["schema"] == 1
    scenario = data["scenario"]
    asked = {"schema", "title", "simulator", "step_length_s", "notes", "arguments", "agents", "folder"}
    assert asked <= set(scenario)
    assert not {"warmup_s", "insertion_timeout_s", "events", "sumo", "highway", "gym", "file"} & set(scenario)
    assert scenario["arguments"] == {"gap_m": {"default": 30.0, "range": "10:60"}}
    assert scenario["agents"] == {"ego": {"agent": "keep-lane", "arguments": {"speed": {"default": 8.0}}}}
    assert data["crash_on"] == ["hang", "collision"]


def test_another_schema_is_refused(settings):
    for schema in (2, 0, None):
        with pytest.raises(CrashhuntError, match="runs its trials in another way"):
            WorkerSettings.from_json({**plain(settings), "schema": schema})


def test_the_audit_is_a_share_of_the_trials_without_a_crash(scenario, tmp_path):
    def audited(share, seed=1, outcome=Outcome.SURVIVED):
        settings = WorkerSettings(
            scenario=scenario, oracles=(), crash_on=(), scratch=tmp_path, audit=share, hunt_seed=seed
        )
        trials = [TrialResult(TrialSpec(number, 0, {}, {}, max_steps=1), outcome) for number in range(400)]
        return [trial.spec.number for trial in trials if settings.is_audited(trial)]

    assert audited(0.0) == []
    assert audited(1.0) == list(range(400))
    some = audited(0.25)
    assert 70 < len(some) < 130
    assert set(some) < set(audited(0.5))
    assert audited(0.25, seed=2) != some
    assert audited(0.25, outcome=Outcome.FINISHED) == some
    for outcome in (Outcome.COLLISION, Outcome.INVALID, Outcome.HANG):
        assert audited(1.0, outcome=outcome) == []


def test_names_in_the_scratch_folder():
    assert scratch_of(Path("/s"), 12) == Path("/s/trial-000012")
