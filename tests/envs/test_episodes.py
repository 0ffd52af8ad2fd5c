"""The Gymnasium environment in the process of its caller: how episodes begin and end, and what their info has."""

from __future__ import annotations

import weakref
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from crashhunt.envs import SumoEnv
from crashhunt.errors import SimulatorError, UsageError

RED = (198, 40, 40)


@pytest.fixture
def make():
    """Make environments in this process, which are closed with the test."""
    made = []

    def make(*arguments, **options):
        made.append(SumoEnv(*arguments, process=False, **options))
        return made[-1]

    yield make
    for env in made:
        env.close()


def drive(env, action, most=600):
    """Take an action until the episode ends, and return what each step gave."""
    steps = []
    while len(steps) < most:
        steps.append(env.step(action))
        if steps[-1][2] or steps[-1][3]:
            break
    return steps


@pytest.mark.parametrize(
    ("scenario", "action", "outcome"),
    [("loop", (40.0, 0), "collision"), ("loop", (40.0, -1), "off_road"), ("intersection", (13.0, 0), "finished")],
)
def test_last_step_alone_has_the_outcome(make, scenario, action, outcome):
    env = make(scenario)
    _, info = env.reset(seed=3)
    steps = drive(env, action)
    assert [step[2] for step in steps] == [False] * (len(steps) - 1) + [True]
    assert [step[4].get("outcome") for step in steps] == [None] * (len(steps) - 1) + [outcome]
    times = [info["sim_time_s"], *(step[4]["sim_time_s"] for step in steps)]
    assert np.diff(times) == pytest.approx(env._episodes.step_length_s)
    with pytest.raises(SimulatorError, match="the episode has ended; call reset"):
        env.step(action)


def test_crash_is_marked_in_the_picture_of_its_step_only(make):
    env = make("loop", render_mode="rgb_array")
    env.reset(seed=3)
    before = 0
    for _ in range(600):
        terminated = env.step((40.0, 0))[2]
        if terminated:
            break
        before = red(env.render()) if env._steps > 110 else 0
    assert terminated
    assert red(env.render()) > before == 0
    env.reset(seed=3)
    assert red(env.render()) == 0


def red(picture):
    return int((picture == RED).all(axis=2).sum())


def test_reward_is_the_distance_of_the_step(make):
    env = make("loop")
    env.reset(seed=3)
    rewards = [step[1] for step in drive(env, (5.0, 0), 80)]
    assert rewards[-1] == pytest.approx(0.5)


def test_fork_of_a_process_has_no_simulation_of_its_own_yet(make, monkeypatch):
    monkeypatch.setattr("crashhunt.envs._sumo_env.RemoteEpisodes", lambda *words: Ended())
    monkeypatch.setattr("crashhunt.envs._sumo_env._here", weakref.WeakSet())
    monkeypatch.setattr("crashhunt.envs._sumo_env._process", [])
    make("loop")
    assert SumoEnv("loop").agent == "of another process"
    monkeypatch.setattr("crashhunt.envs._sumo_env.os", SimpleNamespace(getpid=lambda: -5))  # as in a fork
    first = SumoEnv("loop")
    assert first.agent == "ego"
    assert SumoEnv("loop").agent == "of another process"
    first.close()
    second = SumoEnv("loop")  # what the parent has does not count
    assert second.agent == "ego"
    second.close()
    second.close()


class Ended:
    """Stands for the episodes of another process."""

    agent, observation_space, action_space, step_length_s = "of another process", None, None, 0.3


@pytest.mark.parametrize(("step_length_s", "rate"), [(0.3, 3), (0.1, 10), (1.0, 1), (5.0, 1)])
def test_render_rate_is_that_of_the_steps(monkeypatch, step_length_s, rate):
    monkeypatch.setattr("crashhunt.envs._sumo_env.RemoteEpisodes", lambda *_: Ended())
    monkeypatch.setattr(Ended, "step_length_s", step_length_s)
    assert SumoEnv("loop", process=True).metadata["render_fps"] == rate
    assert SumoEnv.metadata["render_fps"] == 10


class Branching(Ended):
    """Episodes of another process that note the seeds of their copies."""

    def __init__(self, *words):
        self.seeds, self.steps = [], 0

    def reset(self, seed, arguments):
        return "seen", {}

    def step(self, action):
        self.steps += 1
        return "seen", 0.0, False, {}

    def branch(self, seeds):
        self.seeds += seeds
        return [Branching() for _ in seeds]


def test_copies_get_a_seed_each_and_count_their_own_steps(monkeypatch):
    monkeypatch.setattr("crashhunt.envs._sumo_env.RemoteEpisodes", Branching)
    env = SumoEnv("loop", process=True, max_steps=3)
    env.reset(seed=1)
    assert env.step(0)[3] is False
    seeds = []
    for seed in (5, 5, 0):
        copies = env.branch(3, seed=seed)
        seeds.append(env._episodes.seeds[-3:])
        assert len({*seeds[-1]}) == len(copies) == 3
        assert all(0 <= one < 2**31 for one in seeds[-1])  # as those of trials
    assert seeds[0] == seeds[1] != seeds[2]
    env.branch(2)
    assert env._episodes.seeds[9:] == [None, None]
    env.branch(1, seed=5)
    assert env._episodes.seeds[11:] == seeds[0][:1]
    one, other, _ = copies
    assert [one.step(0)[3] for _ in range(2)] == [False, True]  # the third step of the episode
    assert other.step(0)[3] is env.step(0)[3] is False
    with pytest.raises(UsageError, match="a copy of an episode cannot be reset"):
        one.reset(seed=1)
    env.reset(seed=2)
    with pytest.raises(UsageError, match="n is 0; give the number of copies"):
        env.branch(0)


def test_environment_with_parts_passes_the_checker_of_gymnasium_and_names_the_actors():
    env = gymnasium.make(
        "crashhunt:crashhunt/SUMO-v0", scenario="intersection", observation="ego, actors:rows=4", max_steps=20,
        process=False,
    )  # fmt: skip
    try:
        check_env(env.unwrapped, skip_render_check=True)
        observation, info = env.reset(seed=3)
        assert observation["actors"].shape == (4, 15)
        assert len(info["actors"]) == observation["actors"][:, 0].sum()
        assert env.observation_space.contains(observation)
    finally:
        env.close()
    with pytest.raises(UsageError, match="observation: 'eggo' is not a part of observations; did you mean 'ego'"):
        gymnasium.make("crashhunt:crashhunt/SUMO-v0", observation=["eggo"])
    for wrong in ([3], 3, None):
        with pytest.raises(UsageError, match="give the names of parts as text"):
            gymnasium.make("crashhunt:crashhunt/SUMO-v0", observation=wrong)


@pytest.mark.parametrize(
    ("form", "action"),
    [
        ("acceleration", (0.5, 0)),
        ("acceleration_steering", np.array([0.5, 0.0])),
        ("throttle_brake_steering", (0.2, 0.0, 0.0)),
        ("speed_and_lateral", (20.0, 0.1)),
        ("sumo", None),
    ],
)
def test_environment_takes_every_form_in_several_episodes(make, form, action):
    env = make("motorway", action=form)
    for seed in (1, 2):
        env.reset(seed=seed)
        assert not env.step(action)[2]
