"""highway-env's own observation is left out where the scenario replaces it, and nobody can tell."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

# First: this imports highway-env without what takes most of that time.
from crashhunt.highway import HighwaySimulator

# isort: split

from compiled import needs_kernel
from highway_env.envs.common.observation import KinematicObservation, MultiAgentObservation
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.objects import Landmark
from test_highway import drive, simulator_of

from crashhunt.highway.accelerator import SkippedObservation, switch_off, switch_on
from crashhunt.scenario import ObservationSetup

assert HighwaySimulator
pytestmark = needs_kernel
SMALL = {"vehicles_count": 6, "simulation_frequency": 4, "duration": 9}


@pytest.fixture(autouse=True)
def accelerated(plain_highway_env):
    assert switch_on() == ""


def made(kind=HighwayEnvFast, **config):
    env = kind({**SMALL, **config})
    env.reset(seed=1)
    return env


def stepped(env):
    with SkippedObservation(env):
        return env.step(1)


def seen(env):
    """Whether an observation is made."""
    shown, *_ = stepped(env)
    assert "observe" not in vars(env.observation_type)
    return shown is not None


TWO = {"observation": {"type": "MultiAgentObservation", "observation_config": {"type": "Kinematics"}}}


@pytest.mark.parametrize("config", [{}, TWO, {"observation": {"type": "OccupancyGrid"}}])
def test_nothing_is_observed_where_no_one_asks(config):
    env, other = made(**config), made(**config)
    assert not seen(env)
    _, *expected = other.step(1)
    assert repr(expected) == repr(list(stepped(made(**config))[1:]))
    assert plain(env.observation_type.observe()) == plain(other.observation_type.observe())  # whoever asks gets it
    assert env.np_random.bit_generator.state == other.np_random.bit_generator.state


def plain(shown):
    return [array.tobytes() for array in shown] if isinstance(shown, tuple) else shown.tobytes()


class Told(HighwayEnvFast):
    def _info(self, obs, action=None):
        return {**super()._info(obs, action), "seen": float(np.sum(obs))}


class Describing(IDMVehicle):
    def to_dict(self, origin_vehicle=None, observe_intentions=True):
        return super().to_dict(origin_vehicle, observe_intentions)


def of_another_class(env):
    env.road.vehicles[-1].__class__ = Describing


def of_another_mind(env):
    env.road.vehicles[-1].to_dict = IDMVehicle.to_dict.__get__(env.road.vehicles[-1])


def asked_otherwise(env):
    env._info = lambda obs, action=None: {"seen": obs}


def seeing_otherwise(env):
    env.observation_type.normalize_obs = lambda df: df * 0.5


def not_settled(env):
    env.observation_type.features_range = None  # chosen by the lanes where it is first needed


CASES = [
    (made, {"observation": {"type": "Kinematics", "order": "shuffled"}}, None),  # it draws random numbers
    (made, {"observation": {"type": "TimeToCollision"}}, None),
    (lambda **config: made(Told, **config), {}, None),
    *(
        (made, {}, change)
        for change in (of_another_class, of_another_mind, asked_otherwise, seeing_otherwise, not_settled)
    ),
]


def test_it_is_made_where_an_object_describes_itself_otherwise():
    env = made()
    env.road.objects.append(Landmark(env.road, env.vehicle.position + 5.0))
    assert not seen(env)
    env.road.objects[-1].to_dict = lambda *_, **__: dict.fromkeys(env.observation_type.features, 0.5)
    assert seen(env)


@pytest.mark.parametrize(("make", "config", "change"), CASES)
def test_it_is_made_where_an_actor_can_tell(make, config, change):
    env = make(**config)
    if change is not None:
        change(env)
    assert seen(env)


def test_it_is_made_where_an_environment_looks_at_it():
    env = gymnasium.make("parking-v0", disable_env_checker=True).unwrapped
    env.reset(seed=1)
    with SkippedObservation(env):
        assert env.step(np.zeros(2))[0] is not None


@pytest.mark.parametrize("owner", [KinematicObservation, MultiAgentObservation, HighwayEnvFast])
def test_it_is_made_where_an_actor_has_replaced_a_method(owner, monkeypatch):
    name = "_info" if owner is HighwayEnvFast else "space"
    method = getattr(owner, name)
    assert not seen(made())
    monkeypatch.setattr(owner, name, lambda self, *words, **more: method(self, *words, **more))
    assert seen(made())


def test_it_is_made_without_the_accelerator():
    env = made()
    switch_off()
    assert seen(env)


def test_a_scenario_that_shows_something_else_is_not_distinguished(tmp_path, monkeypatch):
    """And one that shows what highway-env shows has it made."""

    def run(observation):
        times = []
        observe = KinematicObservation.observe
        monkeypatch.setattr(KinematicObservation, "observe", lambda self: times.append(1) or observe(self))
        simulator = simulator_of(tmp_path, "highway-fast-v0", config=SMALL, observation=observation)
        times.clear()
        simulator.reset(seed=1)
        before = len(times)
        trace = [plain(tuple(found[0].values())) for found in drive(simulator, "IDLE", 3)]
        monkeypatch.undo()
        return trace, len(times) - 2 * before  # in two resets

    other = ObservationSetup(vehicles=4)
    trace, times = run(other)
    assert times == 0
    switch_off()
    monkeypatch.setattr("crashhunt.highway.accelerator.switch_on", lambda: "")
    assert run(other)[0] == trace
    assert run(None)[1] == 3
