"""The contract suites that ship with crashhunt, against everything that ships with crashhunt."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import mostly_nightly
from gymnasium import spaces

from crashhunt.agents import CarFollowing, IntelligentDriver, KeepLaneWithSpeed, LaneChanger, RandomAgent, Recorded
from crashhunt.errors import UsageError
from crashhunt.executors import FreshProcessExecutor, PoolExecutor
from crashhunt.oracles import OffRoad, Overlap, RedLight, ReportedCollision, TooClose, TrafficEvents
from crashhunt.samplers import (
    CmaEsSampler,
    CrossEntropySampler,
    GridSampler,
    GuidedSampler,
    HaltonSampler,
    MutationSampler,
    NamedSampler,
    RandomSampler,
    SobolSampler,
    SweepSampler,
)
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators import MetaAction, SpeedAndLaneChange
from crashhunt.simulators.toy import ToySimulator
from crashhunt.space import Choice, Constant, Range
from crashhunt.testing import AgentContract, ExecutorContract, OracleContract, SamplerContract, SimulatorContract, drive

TOY = Scenario(simulator="toy", agents={"ego": AgentSetup(), "second": AgentSetup(action="meta")})


class TestToySimulator(SimulatorContract):
    @pytest.fixture
    def make(self, tmp_path):
        return lambda: ToySimulator(TOY, tmp_path)


class TestToySimulatorWithParts(SimulatorContract):
    @pytest.fixture
    def make(self, tmp_path):
        parts = AgentSetup(observation=("ego", "actors", "lidar2d:rays=8", "history:steps=2"))
        scenario = replace(TOY, agents=dict.fromkeys(TOY.agents, parts))
        return lambda: ToySimulator(scenario, tmp_path)


SUMO = """
import sys, tempfile, pytest
from pathlib import Path
from crashhunt.scenario import load_scenario, with_action
from crashhunt.sumo import SumoSimulator
from crashhunt.testing import SimulatorContract

@pytest.mark.parametrize(("name", "form"), CASES)
class TestSumo(SimulatorContract):
    @pytest.fixture
    def make(self, tmp_path, name, form):
        scenario = load_scenario(name)
        for agent in scenario.agents:
            scenario = with_action(scenario, agent, form)
        def made():
            folder = Path(tempfile.mkdtemp(dir=tmp_path))
            return SumoSimulator(scenario, folder)
        original = SumoSimulator.reset
        def reset(self, *, seed, options=None):
            from crashhunt.scenario import argument_values
            return original(self, seed=seed, options=options or {"arguments": argument_values(scenario)})
        SumoSimulator.reset = reset
        yield made
        SumoSimulator.reset = original
"""


# By day, two agents on a ring; meta-actions are in Gymnasium's own checker below.
BY_DAY = [("loop-two-agents", "continuous")]
BY_NIGHT = [
    (name, form)
    for name in ("loop", "loop-two-agents", "merge", "intersection")
    for form in ("continuous", "meta")
    if (name, form) not in BY_DAY
]


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("cases", [BY_DAY, pytest.param(BY_NIGHT, marks=pytest.mark.nightly)], ids=["day", "night"])
def test_sumo_keeps_the_contract(tmp_path, cases):
    """In a process of its own: libsumo is one simulation per process."""
    (tmp_path / "test_sumo.py").write_text(SUMO.replace("CASES", repr(cases)))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["--basetemp", str(tmp_path / "temporary"), "test_sumo.py"]  # or it tidies up after everybody else
    alone = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}  # plugins are imported for seconds, and do nothing
    done = subprocess.run(command, cwd=tmp_path, env=alone, capture_output=True, text=True, timeout=590, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(rf"^{19 * len(cases)} passed in", done.stdout, re.MULTILINE)


SPACE = {
    ("ego", "speed"): Range(5.0, 30.0),
    ("ego", "mode"): Choice(("a", "b")),
    ("", "vehicles"): Range(10, 30, integer=True),
    ("", "trucks"): Constant(3),
}


LEARNING = [CmaEsSampler, CrossEntropySampler, GuidedSampler, MutationSampler]


@pytest.mark.parametrize("kind", [RandomSampler, HaltonSampler, SobolSampler, *LEARNING])
class TestSamplers(SamplerContract):
    @pytest.fixture
    def make(self, kind):
        if kind is CmaEsSampler:
            pytest.importorskip("cmaes")
        return kind

    @pytest.fixture
    def space(self):
        return SPACE


class TestGridSampler(SamplerContract):
    @pytest.fixture
    def make(self):
        return lambda space: GridSampler(space, points=4)

    @pytest.fixture
    def space(self):
        return SPACE

    def test_every_combination_comes_once_a_round(self, make, space):
        sampler = make(space)
        assert sampler.size == 4 * 2 * 4
        rng = np.random.default_rng(0)
        one_round = [tuple(sampler.ask(number, rng).arguments.values()) for number in range(sampler.size)]
        assert len(set(one_round)) == sampler.size
        assert tuple(sampler.ask(sampler.size, rng).arguments.values()) == one_round[0]


OPTUNA = ["cma-es", "nsgaii", "nsgaiii", "qmc", "random"]  # by day, its own tests are enough


@pytest.mark.parametrize("name", ["tpe", *(pytest.param(name, marks=pytest.mark.nightly) for name in OPTUNA)])
class TestOptunaSamplers(SamplerContract):
    @pytest.fixture
    def make(self, name):
        pytest.importorskip("optuna")
        return lambda space: NamedSampler(f"optuna:{name}", space, points=3)

    @pytest.fixture
    def space(self):
        return SPACE


class TestSweepSampler(SamplerContract):
    @pytest.fixture
    def make(self):
        return SweepSampler

    @pytest.fixture
    def space(self):
        return {("ego", "speed"): Range(10, 30, step=5, integer=True), ("", "trucks"): Constant(3)}

    def test_it_steps_from_start_to_end(self, make, space):
        sampler = make(space)
        speeds = [sampler.ask(number, np.random.default_rng(0)).arguments["ego", "speed"] for number in range(6)]
        assert speeds == [10, 15, 20, 25, 30, 10]

    def test_it_wants_exactly_one_argument(self):
        for space in (SPACE, {("ego", "speed"): Constant(3)}):
            with pytest.raises(UsageError, match="exactly one varying argument"):
                SweepSampler(space)


@pytest.mark.parametrize("make", [ReportedCollision, Overlap, OffRoad, TooClose, RedLight, TrafficEvents])
class TestOracles(OracleContract):
    def test_it_finds_something(self, make):
        assert any(make().check(scene, ["ego"]) for scene in drive())


# By day, tests/executors/test_harms.py has harm in a fresh process.
@pytest.mark.parametrize("kind", mostly_nightly([PoolExecutor, FreshProcessExecutor], [PoolExecutor]))
class TestExecutors(ExecutorContract):
    @pytest.fixture
    def make(self, kind):
        return lambda settings, parallel: kind(settings, parallel=parallel)


class _Agents(AgentContract):
    @pytest.fixture
    def form(self):
        return SpeedAndLaneChange()

    @pytest.fixture
    def observations(self, tmp_path):
        simulator = ToySimulator(TOY, tmp_path)
        shown, _ = simulator.reset(seed=1)
        found = [shown["ego"]]
        actions = {"ego": np.array([14.0, 0.0]), "second": np.array([3])}
        for _ in range(40):
            shown, *_ = simulator.step({agent: actions[agent] for agent in simulator.agents})
            if "ego" not in shown:
                break
            found.append(shown["ego"])
        return found


@pytest.mark.parametrize(
    ("form", "kind", "arguments"),
    [
        (SpeedAndLaneChange(), KeepLaneWithSpeed, {"speed": 12.0}),
        (MetaAction(), KeepLaneWithSpeed, {"speed": 12.0}),
        (SpeedAndLaneChange(), CarFollowing, {"delay_s": 0.4}),
        (MetaAction(("SLOWER", "IDLE", "FASTER")), CarFollowing, {"delay_s": 0.4}),
        (SpeedAndLaneChange(), LaneChanger, {"patience_s": 1.0}),
        (MetaAction(), LaneChanger, {"patience_s": 1.0}),
        (SpeedAndLaneChange(), IntelligentDriver, {"politeness": 0.5}),
        (MetaAction(), IntelligentDriver, {"politeness": 0.5}),
        (SpeedAndLaneChange(), RandomAgent, {"hold_steps": 3}),
    ],
)
class TestAgents(_Agents):
    @pytest.fixture
    def make(self, form, kind, arguments):
        return lambda: kind(**arguments, action_space=form.space)


class TestRecorded(_Agents):
    @pytest.fixture
    def make(self, tmp_path, monkeypatch):
        monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
        from episodes import Episode, record

        from crashhunt.recording import write_log

        recording = record(Episode(["ego"], 60, 1), tmp_path / "box")
        monkeypatch.setattr(type(recording), "actions", lambda self, agent: np.tile([3.0, 1.0], (60, 1)))
        write_log(tmp_path / "log.mcap", recording)
        return lambda: Recorded(str(tmp_path / "log.mcap"))

    def test_it_never_drives_on_beyond_the_log(self, make, observations):
        agent = make()
        agent.reset(1)
        for _ in range(60):
            agent.act(observations[0])
        with pytest.raises(IndexError, match="60 actions"):
            agent.act(observations[0])


@pytest.mark.parametrize("kind", [KeepLaneWithSpeed, CarFollowing, LaneChanger, IntelligentDriver])
@pytest.mark.parametrize("space", [spaces.Discrete(2), spaces.Discrete(9), spaces.Box(-1.0, 1.0, (2,))])
def test_agents_of_ours_refuse_actions_that_they_do_not_know(kind, space):
    with pytest.raises(ValueError, match="meta-actions, not"):
        kind(action_space=space)
