"""Trials in the same traffic begin from one warm-up, and no result shows it."""

from __future__ import annotations

import os
import signal
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt.base.processes import children_of
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors import PoolExecutor
from crashhunt.recording import Recording, read_black_box
from crashhunt.scenario import AgentSetup, Scenario, argument_values, load_scenario
from crashhunt.trial import Outcome, TrialSpec

HERE = Path(__file__).parent


def spec(number, seed, what="", speed=9.0, **arguments):
    return TrialSpec(number, seed, {"ego": {"what": what, "speed": speed}}, arguments, 30)


@pytest.fixture
def pool(tmp_path):
    """Makes a pool of one slot, with so many warmed-up copies."""

    def make(limit, scenario="toy", simulator="sharing:Draws", **more):
        if scenario == "toy":
            made = Scenario(simulator=simulator, agents={"ego": AgentSetup(agent="sharing:Agent")})
        else:
            made = load_scenario(scenario).with_agents({"ego": "sharing:Agent"})
        place = tmp_path / str(limit)
        place.mkdir()
        settings = WorkerSettings(
            scenario=made, oracles=("overlap",), crash_on=(Outcome.AGENT_ERROR,), scratch=place, code=(str(HERE),),
            warm_copies=limit, **more,
        )  # fmt: skip
        return closing(PoolExecutor(settings))

    return make


def run(pool, *specs):
    """Return what comes of trials, one after another, without what always differs."""
    found = []
    for one in specs:
        pool.submit(one)
        results = []
        while not results:
            results = list(pool.completed(60.0))
        found.append(replace(results[0], worker=0, wall_s=0.0, setup_s=0.0))
    return found


def without_setup(results):
    return [replace(one, setup_steps=None) for one in results]


@pytest.mark.parametrize("scenario", ["toy", pytest.param("loop", marks=pytest.mark.nightly)])
def test_shared_warm_up_changes_no_result(pool, tmp_path, scenario):
    specs = [
        spec(0, 1), spec(1, 2), spec(2, 1, speed=8.0), spec(3, 2, "thread"), spec(4, 1, "program"),
        spec(5, 2, "raises"), spec(6, 1), spec(7, 1),
    ]  # fmt: skip
    if scenario == "toy":
        specs[7] = replace(specs[7], scenario_arguments={"gap_m": 40.0})
    else:
        values = argument_values(load_scenario(scenario))
        specs = [replace(one, scenario_arguments=values) for one in specs]
    with pool(4, scenario) as sharing, pool(0, scenario) as alone:
        shared, own = run(sharing, *specs), run(alone, *specs)
        assert sharing.notes() == []
    whole = 201 if scenario == "loop" else 40
    assert [one.setup_steps for one in own] == [whole] * 8
    paid = [True, True, *[False] * 5, scenario != "loop"]  # a warm-up that is shared is simulated once
    assert [one.setup_steps for one in shared] == [whole * one for one in paid]
    assert without_setup(shared) == without_setup(own)
    assert len({one.digest for one in own}) >= 4
    assert own[5].outcome is Outcome.AGENT_ERROR
    folder = scratch_of(tmp_path / "4", 5)
    assert (folder / "run.log").read_text() == "here\n"
    assert Recording(read_black_box(folder / "blackbox.bin")).digest == own[5].digest


def test_trial_in_shared_traffic_dies_as_it_does_alone(pool, tmp_path):
    specs = [spec(0, 1), spec(1, 1, "segfaults"), spec(2, 1, "exits"), spec(3, 1)]
    with pool(2) as sharing, pool(0) as alone:
        shared, own = run(sharing, *specs), run(alone, *specs)
    assert [(one.outcome, one.steps, one.failure and one.failure.exit_code) for one in shared] == [
        (Outcome.SURVIVED, 30, None), (Outcome.PROCESS_DIED, 4, -11), (Outcome.PROCESS_DIED, 4, 7),
        (Outcome.SURVIVED, 30, None),
    ]  # fmt: skip
    assert [one.digest for one in shared] == [one.digest for one in own]
    for limit in ("2", "0"):
        stack = (scratch_of(tmp_path / limit, 1) / "stack.txt").read_text()
        assert stack.count("Fatal Python error") == 1


def test_trial_runs_again_when_its_warmed_up_copy_was_killed(pool):
    with pool(2) as sharing:
        first = run(sharing, spec(0, 1))
        os.kill(deepest_process_below(sharing._link._kept.process.pid), signal.SIGKILL)
        found = run(sharing, spec(1, 1), spec(2, 1))
        notes = sharing.notes()
    assert [one.outcome for one in (*first, *found)] == [Outcome.SURVIVED] * 3
    assert notes == ["trial 1 was ended by SIGKILL from outside, and is run again"]


def deepest_process_below(pid):
    """Return the process with the most generations between; between two trials that is a warmed-up copy."""
    found = generation = children_of(pid)
    while generation:
        found, generation = generation, [child for parent in generation for child in children_of(parent)]
    return found[0]
