"""Action masks on their way from an environment to an agent."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from crashhunt.base.foreign_code import ForeignError
from crashhunt.episode import Episode
from crashhunt.gym import GymSimulator
from crashhunt.highway import HighwaySimulator
from crashhunt.scenario import scenario_from_dict
from crashhunt.trial import Outcome, TrialSpec, signature_of

LINE = spaces.Box(-1.0, 1.0, (1,), np.float32)


class Plain(gymnasium.Env):
    """An environment of 5 steps without masks, whose info is given."""

    def __init__(self, actions=None, infos=({},), masks=None):
        self.observation_space, self.action_space = LINE, actions or spaces.Discrete(3)
        self.infos, self.masks = infos, masks

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.taken = 0, []
        return np.zeros(1, np.float32), self.infos[0]

    def step(self, action):
        self.steps += 1
        self.taken.append(action)
        return np.zeros(1, np.float32), 0.0, self.steps >= 5, False, self.infos[self.steps % len(self.infos)]


class Masking(gymnasium.Wrapper):
    """What `ActionMasker` of sb3-contrib is: a wrapper with the method."""

    def action_masks(self):
        return self.unwrapped.masks(self.unwrapped.steps)


@pytest.fixture
def simulator(tmp_path, monkeypatch):
    def make(env):
        monkeypatch.setattr("crashhunt.gym._simulator.load_object", lambda name: lambda: env)
        table = {"simulator": "gym", "gym": {"id": "tests_masks:make"}, "agents": {"ego": {}}}
        return GymSimulator(scenario_from_dict(table, where="here", folder=tmp_path), tmp_path)

    return make


def step(simulator):
    simulator.step({"ego": simulator.actions["ego"].encode(simulator.actions["ego"].space.sample())})


def forbid(number):
    return np.arange(3) != number % 3


@pytest.mark.parametrize(
    "env",
    [
        Masking(Plain(masks=forbid)),
        gymnasium.wrappers.TransformReward(Masking(Plain(masks=forbid)), lambda reward: reward),
        Plain(infos=[{"action_mask": forbid(number).astype(np.int8)} for number in range(3)]),
        Masking(Plain(masks=forbid, infos=[{"action_mask": np.ones(3, np.int8)}])),
    ],
    ids=["wrapper", "inner wrapper", "info", "method before info"],
)
def test_mask_is_that_of_the_next_step(simulator, env):
    made = simulator(env)
    made.reset(seed=1)
    for number in range(4):
        assert made.action_mask("ego").tolist() == forbid(number).tolist()
        step(made)
    assert not made.notices


def test_mask_of_several_actions_is_in_a_row(simulator):
    made = simulator(Masking(Plain(spaces.MultiDiscrete([2, 3]), masks=lambda _: (np.ones(2), np.array([0, 1, 1])))))
    made.reset(seed=1)
    assert made.action_mask("ego").tolist() == [True, True, False, True, True]
    made = simulator(Plain(spaces.MultiBinary(2), [{"action_mask": [True, False, True, True]}]))
    made.reset(seed=1)
    assert made.action_mask("ego").tolist() == [True, False, True, True]


@pytest.mark.parametrize("mask", [np.ones(2), np.array(["a", "b", "c"]), lambda: 1 / 0])
def test_mask_that_cannot_be_one_is_the_environments_failure(simulator, mask):
    made = simulator(Masking(Plain(masks=lambda _: mask() if callable(mask) else mask)))
    made.reset(seed=1)
    with pytest.raises(ForeignError) as caught:
        made.action_mask("ego")
    assert caught.value.party == "environment"
    if not callable(mask):
        assert "action_masks() is" in str(caught.value.error)
        assert "must have 3 values for actions in Discrete(3)" in str(caught.value.error)


def test_environment_without_masks_has_none(simulator):
    made = simulator(Plain())
    made.reset(seed=1)
    assert made.action_mask("ego") is None
    step(made)
    assert not made.notices


def test_masks_that_no_agent_uses_are_a_notice(simulator):
    made = simulator(Masking(Plain(masks=forbid)))
    for _ in range(2):
        made.reset(seed=1)
        step(made)
        step(made)
    assert [*made.notices] == ["the environment 'tests_masks:make' gives action masks, which its agent does not use"]


class Obedient:
    """Takes the last action that is possible."""

    def __init__(self, action_masks=None):
        self.masks = action_masks
        self.masks()  # as a policy that refuses an environment without masks

    def reset(self, seed):
        pass

    def act(self, observation):
        return int(np.flatnonzero(self.masks())[-1])


def run(simulator):
    def make_agent(name, made, arguments):
        return Obedient(lambda: made.action_mask(name))

    spec = TrialSpec(number=0, seed=1, arguments={"ego": {}}, scenario_arguments={}, max_steps=9)
    with Episode(spec, simulator=simulator, make_agent=make_agent) as episode:
        result = episode.start()
        while result is None:
            result = episode.step()
    return result


def test_agent_asks_for_the_mask_in_each_step(simulator):
    env = Masking(Plain(masks=forbid))
    assert run(simulator(env)).outcome is Outcome.FINISHED
    assert env.unwrapped.taken == [2, 2, 1, 2, 2]


def test_failure_in_the_mask_is_not_the_agents(simulator):
    result = run(simulator(Masking(Plain(masks=lambda step: forbid(step) if step < 3 else 1 / 0))))
    assert (result.outcome, result.steps) == (Outcome.SIMULATOR_ERROR, 3)
    assert (result.failure.party, result.failure.place, result.failure.agent) == ("environment", "action mask", "")


def test_failure_in_the_first_mask_is_not_the_agents(simulator):
    result = run(simulator(Masking(Plain(masks=lambda step: 1 / 0))))
    assert (result.outcome, result.steps) == (Outcome.INVALID, 0)
    assert (result.failure.party, result.failure.place, result.failure.agent) == ("environment", "action mask", "")


def test_masks_are_no_argument_of_an_agent():
    signature = signature_of(Obedient)
    assert not signature.arguments
    assert signature.given == ("action_masks",)


def test_highway_env_masks_what_is_not_available(tmp_path):
    table = {"simulator": "highway", "highway": {"id": "highway-fast-v0"}, "agents": {"ego": {}}}
    made = HighwaySimulator(scenario_from_dict(table, where="here", folder=tmp_path), tmp_path)
    seen = set()
    for seed in range(6):
        made.reset(seed=seed)
        mask = made.action_mask("ego")
        assert np.flatnonzero(mask).tolist() == sorted(made._env.unwrapped.get_available_actions())
        seen.add(mask.tobytes())
    assert len(seen) > 1
    assert [*made.notices] == [
        "the environment has no action_masks(), so the masks are highway-env's available actions"
    ]
    made._env.action_masks = lambda: np.array([True, False, False, False, True])
    assert made.action_mask("ego").tolist() == [True, False, False, False, True]


def test_continuous_actions_of_highway_env_have_no_mask(tmp_path):
    config = {"action": {"type": "ContinuousAction"}}
    table = {"simulator": "highway", "highway": {"id": "highway-fast-v0", "config": config}, "agents": {"ego": {}}}
    made = HighwaySimulator(scenario_from_dict(table, where="here", folder=tmp_path), tmp_path)
    made.reset(seed=1)
    assert made.action_mask("ego") is None
