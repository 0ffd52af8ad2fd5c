"""Parallel environments with many agents, as PettingZoo has them: one agent is tested, the others act by a policy."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces

from crashhunt.base.foreign_code import ForeignError
from crashhunt.errors import ScenarioError, UnusableValueError
from crashhunt.gym import GymSimulator
from crashhunt.gym._descriptor import CrashRule, GymSetup
from crashhunt.gym._pettingzoo import OneLearner
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.testing import SimulatorContract


class Chase:
    """Some chase each other on a line; has the interface of ``pettingzoo.ParallelEnv``.

    As in PettingZoo's wrapper of environments whose agents take turns, there is no ``agents`` before `reset`.
    """

    metadata = {"name": "chase_v0"}  # noqa: RUF012 - as PettingZoo declares it
    possible_agents = ("runner", "hunter_0", "hunter_1")

    def __init__(self, leaves_at=0, late=False, masked=False):
        self.leaves_at, self.late, self.masked, self.render_mode = leaves_at, late, masked, None
        self.log = []
        self._spaces = {name: spaces.Discrete(3) for name in self.possible_agents}

    def observation_space(self, agent):
        size = 3 if agent == "runner" else 1
        return spaces.Dict({"places": spaces.Box(-99, 99, (size,), np.float64), "turn": spaces.Discrete(99)})

    def action_space(self, agent):
        return self._spaces[agent]

    def reset(self, seed=None, options=None):
        self.agents = [name for name in self.possible_agents if not (self.late and name == "runner")]
        self.steps = 0
        places = np.random.default_rng(seed).integers(-5, 6, 3).astype(float)
        self.places = dict(zip(self.possible_agents, places, strict=True))
        return self._look(), {name: {} for name in self.agents}

    def step(self, actions):
        assert set(actions) == set(self.agents)
        self.log.append({name: int(action) for name, action in actions.items()})
        self.steps += 1
        for name, action in actions.items():
            self.places[name] += int(action) - 1
        gone = "runner" if self.steps == self.leaves_at else "hunter_1" if self.steps == 2 else ""
        shown = self._look()
        rewards = dict.fromkeys(self.agents, 1.0)
        infos = {name: {"caught": self.places[name] == 0} for name in self.agents}
        if self.masked:
            infos = {name: {"action_mask": np.array([0, 0, 1], np.int8)} for name in self.agents}
        ended = {name: name == gone for name in self.agents}
        self.agents = [name for name in self.agents if name != gone]
        return shown, rewards, ended, dict.fromkeys(ended, False), infos

    def _look(self):
        places = np.array(list(self.places.values()))
        return {
            name: {"places": places if name == "runner" else places[:1], "turn": self.steps} for name in self.agents
        }

    def close(self):
        pass


class Generated(Chase):
    """Has no list of its agents, as PettingZoo allows if they are generated."""

    def __init__(self):
        pass

    def __getattribute__(self, name):
        if name == "possible_agents":
            raise AttributeError(name)
        return super().__getattribute__(name)


class InTurns(Chase):
    def agent_iter(self):
        return iter(self.agents)


def to_the_right(name, observation, action_space, generator):
    assert action_space.n == 3
    assert observation["turn"] < 99
    assert name != "hunter_0"
    return 2 if name == "runner" else int(generator.integers(1))


def simulator_of(tmp_path, name="Chase", learner="", others="", **kwargs):
    setup = GymSetup(
        id=f"{__name__}:{name}", kwargs=kwargs, crash=CrashRule(info="caught"), learner=learner, others=others
    )
    return GymSimulator(Scenario(simulator="gym", tables={"gym": setup}, agents={"me": AgentSetup()}), tmp_path)


class TestChase(SimulatorContract):
    @pytest.fixture
    def make(self, tmp_path):
        return lambda: simulator_of(tmp_path)


def drive(simulator, steps=6, seed=3, action=1):
    simulator.reset(seed=seed)
    seen = []
    for _ in range(steps):
        if not simulator.agents:
            break
        observations, *_ = simulator.step({"me": simulator.actions["me"].encode(action)})
        seen.append(simulator.restore_observation("me", observations["me"]))
    return seen, simulator._env._parallel.log


def test_learner_is_the_first_agent_or_the_one_that_is_named(tmp_path):
    seen, _ = drive(simulator_of(tmp_path), steps=1)
    assert seen[0]["places"].shape == (3,)
    seen, log = drive(simulator_of(tmp_path, learner="hunter_0"), steps=1, action=0)
    assert seen[0]["places"].shape == (1,)
    assert log[0]["hunter_0"] == 0


def test_others_act_by_the_policy_that_the_scenario_names(tmp_path):
    _, log = drive(simulator_of(tmp_path, learner="hunter_0", others=f"{__name__}:to_the_right"), steps=3)
    assert [actions["runner"] for actions in log] == [2] * len(log)
    assert log[0]["hunter_1"] == 0


def out_of_range(name, observation, action_space, generator):
    return 7 if name == "hunter_0" else np.float64(1)


def test_action_of_another_player_outside_its_space_names_the_player(tmp_path):
    simulator = simulator_of(tmp_path, learner="hunter_1", others=f"{__name__}:out_of_range")
    with pytest.raises(ForeignError) as caught:
        drive(simulator)
    says = "for 'runner': the action np.float64(1.0)", "for 'hunter_0': the action 7"
    assert isinstance(caught.value.error, UnusableValueError)
    assert str(caught.value.error) in {
        f"gym.others = '{__name__}:out_of_range' returned {one} is not in Discrete(3); return an action in this space"
        for one in says
    }


def test_action_of_another_player_reaches_the_environment_as_it_was_returned():
    space = spaces.Box(-1, 1, (1,), np.float32)
    parallel = SimpleNamespace(
        possible_agents=["a", "b"], observation_space=lambda _: space, action_space=lambda _: space
    )
    made = OneLearner(parallel, policy=lambda *_: np.array([0.1]))
    made._seen = {"b": np.zeros(1)}
    assert made._other_actions("b").dtype == np.float64


def test_masked_actions_are_not_drawn(tmp_path):
    _, log = drive(simulator_of(tmp_path, masked=True), steps=5)
    assert {action for actions in log[1:] for name, action in actions.items() if name != "runner"} == {2}


@pytest.mark.parametrize("leaves_at", [1, 2])
def test_episode_ends_with_the_learner(tmp_path, leaves_at):
    seen, log = drive(simulator_of(tmp_path, leaves_at=leaves_at))
    assert len(seen) == len(log) == leaves_at


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("Chase", {"learner": "runer"}, "gym.learner = 'runer' is not an agent; did you mean 'runner'?"),
        (
            "Generated",
            {},
            "this factory returned a Generated, a parallel environment without possible_agents; set it to",
        ),
        ("InTurns", {}, "this factory returned a InTurns, whose agents act in turns; name the function parallel_env"),
    ],
)
def test_mistake_is_one_line(tmp_path, name, options, says):
    with pytest.raises(ScenarioError) as caught:
        simulator_of(tmp_path, name, **options)
    assert says.replace("runner'?", "runner'") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_learner_of_an_environment_with_one_agent_is_refused(tmp_path):
    setup = GymSetup(id="CartPole-v1", learner="cart")
    scenario = Scenario(simulator="gym", tables={"gym": setup}, agents={"me": AgentSetup()})
    with pytest.raises(ScenarioError, match=r"has one agent.*; remove gym.learner and gym.others"):
        GymSimulator(scenario, tmp_path)


def test_learner_that_comes_later_makes_the_trial_invalid(tmp_path):
    simulator = simulator_of(tmp_path, late=True)
    with pytest.raises(Exception, match="the learner 'runner' is missing in the first step of the environment"):
        simulator.reset(seed=1)


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        (1, {"runner": (1.0,)}, "the reward is of type tuple: (1.0,)"),
        (2, {"runner": {"over": False}}, "terminations['runner'] is of type dict: {'over': False}"),
        (3, {"runner": "False"}, "truncations['runner'] is of type str: 'False'"),
        (0, 3, "step() returned observations = 3, which is not a dictionary by agent"),
        (2, False, "step() returned terminations = False, which is not a dictionary by agent"),
        (4, [], "step() returned infos = [], which is not a dictionary by agent"),
        (0, {}, "step() returned no observation of the learner 'runner', which is among the agents"),
        (1, {}, "step() returned no reward of the learner 'runner', which is among the agents"),
        (4, {"runner": {"caught": {"hunter_0": False}}}, "info['caught'] is of type dict: {'hunter_0': False}"),
    ],
)
def test_value_of_the_learner_that_is_no_number_is_refused(tmp_path, monkeypatch, place, value, says):
    step = Chase.step

    def changed(self, actions):
        parts = list(step(self, actions))
        parts[place] = value
        return tuple(parts)

    monkeypatch.setattr(Chase, "step", changed)
    simulator = simulator_of(tmp_path)
    simulator.reset(seed=1)
    with pytest.raises(ForeignError) as caught:
        simulator.step({"me": simulator.actions["me"].encode(1)})
    assert str(caught.value.error).startswith(says)
    assert caught.value.party == "environment"
