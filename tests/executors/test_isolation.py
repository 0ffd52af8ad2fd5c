"""A trial is the same wherever in its worker it comes, and in a process of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from toy_trials import results_of, settings_for

from crashhunt.executors import Executor, FreshProcessExecutor, PoolExecutor
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.trial import TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.scenario import Scenario

SETS_CLASSES = """
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

Vehicle.MAX_SPEED = 60.0
IDMVehicle.TIME_WANTED = 0.3

class Agent:
    def reset(self, seed): ...

    def act(self, observation):
        assert (Vehicle.MAX_SPEED, IDMVehicle.TIME_WANTED) == (60.0, 0.3)
        return 1
"""
STARTS_A_THREAD = """
import threading

threading.Thread(target=threading.Event().wait, daemon=True).start()

class Agent:
    def reset(self, seed): ...

    def act(self, observation):
        return 5.0, 0
"""
DRAWS_AT_IMPORT_AND_SETS_CLASSES_LATE = """
import random
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

DRAWN = random.random() + np.random.random()
RNG = np.random.default_rng(1)

class Agent:
    def reset(self, seed): ...

    def act(self, observation):
        IDMVehicle.TIME_WANTED += DRAWN + RNG.random()
        IDMVehicle.act = IDMVehicle.act
        return 1
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[TrialResult]]:
    monkeypatch.chdir(tmp_path)

    def run(module: str, scenario: Scenario, kind: Callable[..., Executor], count: int) -> list[TrialResult]:
        Path("mine.py").write_text(module, encoding="utf-8")
        chosen = scenario.with_agents(dict.fromkeys(scenario.agents, "mine:Agent"))
        specs = [TrialSpec(number, 5, {}, argument_values(scenario), max_steps=3) for number in range(count)]
        return results_of(kind(settings_for(tmp_path, scenario=chosen), parallel=1), specs)

    return run


@pytest.mark.parametrize(
    ("module", "scenario"),
    [
        pytest.param(SETS_CLASSES, "merge-highway-env", marks=pytest.mark.nightly),  # by day, numbers at import
        (DRAWS_AT_IMPORT_AND_SETS_CLASSES_LATE, "merge-highway-env"),
        (STARTS_A_THREAD, "toy"),
    ],
    ids=["classes at import", "random numbers at import and classes in an episode", "a thread at import"],
)
def test_a_trial_does_not_depend_on_its_place(run, module, scenario):
    found = load_scenario("merge-highway-env" if scenario == "toy" else scenario)
    if scenario == "toy":
        found = replace(found, simulator="toy", tables={}, observation=None, arguments={})
    pooled = run(module, found, PoolExecutor, 2)
    (fresh,) = run(module, found, FreshProcessExecutor, 1)
    assert {(str(result.outcome), result.digest) for result in pooled} == {("survived", fresh.digest)}
