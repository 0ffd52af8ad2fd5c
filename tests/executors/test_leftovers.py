"""Nothing that a trial leaves behind in its process reaches another trial."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from toy_trials import results_of, settings_for

from crashhunt.executors import FreshProcessExecutor, PoolExecutor
from crashhunt.scenario import AgentSetup, Scenario, argument_values, load_scenario
from crashhunt.trial import TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.executors import Executor

LEFTOVERS = Path(__file__).parent / "leftovers.py"
NOT_ON_THE_TOY = {"class_of_highway_env"}
ROOT_ONLY = {"user", "effective_user"}


@pytest.fixture(scope="module")
def tried(tmp_path_factory):
    """Each kind, and whether it is found before and after it is left."""
    done = subprocess.run(
        [sys.executable, LEFTOVERS], capture_output=True, text=True, timeout=300, check=True,
        cwd=tmp_path_factory.mktemp("tried"), stdin=subprocess.DEVNULL,
    )  # fmt: skip
    return json.loads(done.stdout)


def test_each_kind_is_found_where_it_is_left(tried):
    """In one process: a kind that is not found would show nothing of what isolates trials."""
    missing = NOT_ON_THE_TOY | (ROOT_ONLY if os.geteuid() else set())
    assert len(tried) >= 18
    assert {kind: found for kind, found in tried.items() if found != [False, True]}.keys() <= missing


@pytest.fixture
def run(tmp_path, monkeypatch) -> Callable[..., list[TrialResult]]:
    shutil.copy(LEFTOVERS, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("LEFT", raising=False)

    def run_trials(
        scenario: Scenario, make: Callable[..., Executor], kinds: list[str], max_steps: int = 4
    ) -> list[TrialResult]:
        values = argument_values(scenario)
        specs = [
            TrialSpec(number, 5, {"ego": {"leaves": kind}}, values, max_steps) for number, kind in enumerate(kinds)
        ]
        return results_of(make(settings_for(tmp_path, scenario=scenario, timeout_s=30.0)), specs)

    return run_trials


def toy():
    return Scenario(simulator="toy", agents={"ego": AgentSetup(agent="leftovers:Agent")})


def told(results, kinds):
    """What trials said that did not survive, by the kind that they themselves have left."""
    return {
        f"{result.spec.number} {kind}": f"{result.outcome} {result.failure and result.failure.message}"
        for kind, result in zip(kinds, results, strict=True)
        if str(result.outcome) != "survived"
    }


ALL = slice(None)


@pytest.mark.parametrize(
    ("parallel", "chosen"),
    [
        (1, slice(0, None, 2)),  # by day, each kind once
        (2, slice(1, None, 2)),
        pytest.param(1, ALL, marks=pytest.mark.nightly),
        pytest.param(2, ALL, marks=pytest.mark.nightly),
        pytest.param(3, ALL, marks=pytest.mark.nightly),
    ],
)
def test_no_kind_reaches_another_trial(run, tried, parallel, chosen):
    kinds = ["", *list(tried)[chosen], ""]
    results = run(toy(), lambda settings: PoolExecutor(settings, parallel=parallel), kinds)
    assert told(results, kinds) == {}
    # Of its own trial, a few kinds change the steps that follow: the rounding of numbers, the simulator's own methods.
    digests = [result.digest for result in results]
    assert digests[0] == digests[-1]
    assert digests.count(digests[0]) > len(kinds) - 4
    if parallel == 1:
        (alone,) = run(toy(), FreshProcessExecutor, [""])
        assert alone.digest == digests[0]


@pytest.mark.nightly
@pytest.mark.parametrize("parallel", [1, 2, 3])
@pytest.mark.parametrize("name", ["loop", "merge-highway-env"])
def test_none_reaches_another_trial_on_a_real_simulator(run, tried, name, parallel):
    agent = "leftovers:MetaAgent" if "highway" in name else "leftovers:Agent"
    scenario = load_scenario(name)
    scenario = scenario.with_agents(dict.fromkeys(scenario.agents, agent))
    kinds = [kind for one in tried for kind in (one, "")]
    results = run(scenario, lambda settings: PoolExecutor(settings, parallel=parallel), kinds)
    assert told(results[1::2], kinds[1::2]) == {}
    found = {kind: result.failure.message for kind, result in zip(kinds, results, strict=True) if result.failure}
    assert not [message for message in found.values() if "an earlier trial has left" in message]
    (alone,) = run(scenario, FreshProcessExecutor, [""])
    assert {result.digest for result in results[1::2]} == {alone.digest}
    assert replace(alone, worker=0).digest
