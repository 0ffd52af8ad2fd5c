"""A whole step of an environment with the accelerator: meta-action, sub-steps, observation and rewards."""

from __future__ import annotations

from functools import cache, partial, wraps

import highway_env
import numpy as np
import pytest
from compiled import needs_kernel
from conftest import mostly_nightly
from exact_values import exact
from highway_env.envs.common import observation
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ActionType, DiscreteMetaAction
from highway_env.envs.common.observation import KinematicObservation
from highway_env.envs.exit_env import ExitEnv
from highway_env.envs.highway_env import HighwayEnv, HighwayEnvFast
from highway_env.envs.merge_env import MergeEnv
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from small_roads import begun, same_either_way

from crashhunt.highway import HighwaySimulator
from crashhunt.highway.accelerator import Onlooker, _substep_loop, switch_off, switch_on

assert highway_env
assert HighwaySimulator
pytestmark = [pytest.mark.usefixtures("plain_highway_env"), needs_kernel]
ACTIONS = (3, 4, 1, 0, 2, np.int64(4), np.int64(3), 1)
CONFIG = {"vehicles_count": 6, "vehicles_density": 1.6, "simulation_frequency": 4}


def trace(make, change, actions):
    """Everything that a user sees of each step, with the attributes of all vehicles."""
    found = []
    env = make()
    try:
        env.step(1)
        change(env)
        for action in actions:
            seen = env.step(action)
            vehicles = [exact(vars(vehicle)) for vehicle in (env.vehicle, *env.road.vehicles)]
            found.append((exact(seen), vehicles, exact(vars(env).get("extra"))))
    except Exception as error:
        found.append(repr(error))
    return found


def both(make, change=lambda env: None, actions=ACTIONS):
    """The trace, which is the same without and with the accelerator."""
    return same_either_way(lambda: trace(make, change, actions))


def made(kind=HighwayEnvFast, **config):
    return begun(kind, {**CONFIG, **config})


@cache
def usual():
    """The trace of the first steps where nothing is changed."""
    return trace(made, lambda env: None, ACTIONS[:3])


def push(road):
    road.vehicles[1].position[0] += 0.5
    road.vehicles[2].speed *= 0.9


def _described_elsewhere(vehicle, *given, **named):
    return {**type(vehicle).to_dict(vehicle, *given, **named), "x": 0.5}


class Simulating(HighwayEnvFast):
    def _simulate(self, action=None):
        super()._simulate(action)
        push(self.road)


class Showing(HighwayEnvFast):
    @property
    def observation_type(self):
        if self.road is not None and len(self.road.vehicles) > 2:
            push(self.road)
        return vars(self)["seeing"]

    @observation_type.setter
    def observation_type(self, value):
        vars(self)["seeing"] = value


class Looking(HighwayEnvFast):
    """Looks again after it has changed the road."""

    def _reward(self, action):
        reward = super()._reward(action)
        if not vars(self).get("looks"):
            return reward
        push(self.road)
        for vehicle in self.road.vehicles[1:]:
            vehicle.to_dict = partial(_described_elsewhere, vehicle)
        self.extra = self.observation_type.observe()
        return reward


class Planning(HighwayEnvFast):
    """Observes after a change, in a step of its own."""

    def step(self, action):
        self._simulate(action)
        push(self.road)
        return self.observation_type.observe(), self._reward(action), False, False, {}


class Foreign:
    """An observation of a user's, which changes the road before highway-env's."""

    def __init__(self, env):
        self._env, self._observation = env, env.observation_type

    def observe(self):
        push(self._env.road)
        return self._observation.observe()


def foreign(env):
    env.observation_type = Foreign(env)


def removing(env):
    """Removes a vehicle in each step, as long as there are some."""
    act = env.action_type.act
    env.action_type.act = lambda action: (len(env.road.vehicles) > 4 and env.road.vehicles.pop(), act(action))


def simulating(env):
    run = env._simulate
    env._simulate = lambda action=None: (run(action), push(env.road))


def observing(env):
    observe = env.observation_type.observe
    env.observation_type.observe = lambda: (push(env.road), observe())[1]


def looking_on(env):
    env.road.step = Onlooker(env.road.step, after=lambda: push(env.road), interferes=lambda: True)


def planning(env):
    act = env.action_type.act
    env.action_type.act = lambda action: (env._simulate(None), push(env.road), act(action))


BETWEEN = [
    (Simulating, lambda env: None),
    (Showing, lambda env: None),
    (Looking, lambda env: setattr(env, "looks", True)),
    (Planning, lambda env: None),
    (HighwayEnvFast, simulating),
    (HighwayEnvFast, observing),
    (HighwayEnvFast, looking_on),
    (HighwayEnvFast, planning),
    (HighwayEnvFast, foreign),
    (HighwayEnvFast, removing),
]


@pytest.mark.parametrize(
    ("kind", "change"),
    mostly_nightly(BETWEEN, BETWEEN[::2]),
)
def test_change_between_sub_steps_and_observation_is_observed(kind, change):
    slow = both(lambda: made(kind), change, ACTIONS[:3])
    assert slow != usual()  # it matters
    assert not isinstance(slow[-1], str)


def test_replaced_observation_sees_what_it_changes(monkeypatch):
    def observe(observation):
        road = observation.env.road
        road.vehicles.pop()
        road.act()  # of the vehicles that are left
        return original(observation)

    def drive():
        nonlocal original
        env, found = made(), []
        env.step(1)
        original = KinematicObservation.observe
        with monkeypatch.context() as patch:
            patch.setattr(KinematicObservation, "observe", observe)
            for _ in range(2):
                found += [exact(env.step(1)), [exact(vars(vehicle)) for vehicle in env.road.vehicles]]
        return found

    original = None
    same_either_way(drive)


def test_observation_does_not_read_the_road_again(monkeypatch):
    switch_on()
    env, reads = made(), []
    env.step(1)
    look = _substep_loop.look
    monkeypatch.setattr(_substep_loop, "look", lambda road: (reads.append(1), look(road))[1])
    monkeypatch.setattr("crashhunt.highway.accelerator._switch.look", lambda road: reads.append(2))
    env.step(1)
    assert reads == [1]


class Own(MDPVehicle):
    def speed_control(self, target_speed):
        return super().speed_control(target_speed) * 0.5


class Fast(MDPVehicle):
    def speed_to_index(self, speed):
        return super().speed_to_index(speed + 5)


def ego_of(kind):
    def change(env):
        env.vehicle.__class__ = kind

    return change


def at_the_end_of_its_lane(env):
    lane = env.road.network.get_lane(env.vehicle.target_lane_index)
    env.vehicle.position = np.array([lane.length - 1.0, env.vehicle.position[1]])


def with_speeds(speeds):
    def change(env):
        env.vehicle.target_speeds = speeds

    return change


def off_the_road(env):
    env.road.vehicles.remove(env.vehicle)
    env.vehicle.action = {"steering": 0.1, "acceleration": 0.2}


def with_its_own_method(env):
    vehicle = env.vehicle
    vehicle.extra = []
    control = vehicle.speed_control
    vehicle.speed_control = lambda speed: (vehicle.extra.append(speed), control(speed))[1]


def with_its_own_names(env):
    env.action_type.actions = {0: "FASTER", 1: "SLOWER", 2: "LANE_LEFT", 3: "IDLE", 4: "WHATEVER"}


def whole(env):
    env.vehicle.speed = 25


def nowhere(env):
    env.vehicle.target_lane_index = ("nowhere", "1", 0)


META_ACTIONS = [
    lambda env: None,
    ego_of(Own),
    ego_of(Fast),
    at_the_end_of_its_lane,
    with_speeds(np.array([10, 20, 30, 40])),
    with_speeds(np.linspace(20, 24, 9)),
    with_speeds(np.array([25.0, 25.0])),
    with_speeds(np.array([25.0])),
    with_speeds(np.array([20.0, 30.0], np.float32)),
    with_speeds([20.0, 25.0, 30.0]),
    off_the_road,
    with_its_own_method,
    with_its_own_names,
    whole,
    nowhere,
]


@pytest.mark.parametrize(
    "change",
    mostly_nightly(META_ACTIONS, META_ACTIONS[::3]),
)
def test_meta_actions_have_the_effect_that_they_have_in_highway_env(change):
    both(made, change)


@pytest.mark.filterwarnings("ignore")
def test_sub_step_that_leads_beyond_all_numbers_counts_once():
    def drive():
        env = made()
        env.step(1)
        env.road.vehicles[-1].position[0], env.road.vehicles[-1].speed = 1.797e308, 1e308
        with pytest.raises(TypeError):
            env.step(1)
        return env.steps, [exact(vars(vehicle)) for vehicle in env.road.vehicles]

    same_either_way(drive)


def test_meta_action_at_the_end_of_a_lane_is_applied_by_highway_env():
    switch_on()
    env = made()
    env.step(1)
    at_the_end_of_its_lane(env)
    before = exact(vars(env.vehicle))
    assert not _substep_loop.choose(env, 3)
    assert exact(vars(env.vehicle)) == before


def test_road_is_read_after_a_step_whose_observation_has_its_own_method():
    def drive():
        env = made()
        env.step(1)
        env.observation_type.normalize_obs = env.observation_type.normalize_obs
        env.step(1)
        push(env.road)
        env.road.act()
        env.road.step(0.25)
        return [exact(vars(vehicle)) for vehicle in env.road.vehicles]

    same_either_way(drive)


def test_meta_actions_at_the_end_of_a_road_have_the_effect_that_they_have_in_highway_env():
    def change(env):
        env.vehicle.position = np.array([149.0, env.vehicle.position[1]])

    slow = both(lambda: made(MergeEnv), change)
    assert slow[0][1][0]["target_lane_index"] != slow[-1][1][0]["target_lane_index"]


class Spawning(IDMVehicle):
    """Places a vehicle into its own way in the middle of a step, so that both crash."""

    def act(self, action=None):
        super().act(action)
        self.acts = vars(self).get("acts", 0) + 1
        if self.acts % 4 == 2:
            self.road.vehicles.append(IDMVehicle(self.road, self.position + np.array([1.0, 0.0]), 0.0, 5.0))


class Unhurt(IDMVehicle):
    """Replaces the collision check of another vehicle in the middle of a step."""

    def act(self, action=None):
        super().act(action)
        self.acts = vars(self).get("acts", 0) + 1
        other = self.road.vehicles[2]
        if self.acts == 6:
            other.handle_collisions = lambda *given: setattr(other, "checks", vars(other).get("checks", 0) + 1)


@pytest.mark.parametrize("kind", [Spawning, Unhurt])
def test_change_by_a_vehicle_of_a_user_in_a_sub_step_is_noticed(kind):
    def change(env):
        env.road.vehicles[3].__class__ = kind

    slow = both(made, change)
    assert not isinstance(slow[-1], str)
    egos_and_others = slow[-1][1]
    assert any("checks" in vehicle or vehicle["crashed"] != exact(False) for vehicle in egos_and_others)


def test_simulation_of_all_environments_replaced_during_an_episode_changes_the_observation(monkeypatch):
    def change(env):
        run = AbstractEnv._simulate
        monkeypatch.setattr(AbstractEnv, "_simulate", lambda self, action=None: (run(self, action), push(self.road)))

    def drive():
        found = trace(made, change, ACTIONS[:3])
        monkeypatch.undo()
        return found

    slow = same_either_way(drive)
    assert slow != usual()


@pytest.mark.parametrize("kind", ["Kinematics", "ExitObservation"])
def test_search_of_a_user_runs_once_for_an_observation(kind):
    class Forgetting(Road):
        """Misses an object at random, and notes each search."""

        def close_objects_to(self, *given, **named):
            self.searches = vars(self).get("searches", 0) + 1
            found = super().close_objects_to(*given, **named)
            return [other for other in found if self.np_random.random() < 0.7]

    def change(env):
        env.road.__class__ = Forgetting
        for vehicle in env.road.vehicles[1:]:
            vehicle.to_dict = partial(_described_elsewhere, vehicle)  # which highway-env has to call

    make = partial(made, ExitEnv if kind == "ExitObservation" else HighwayEnvFast)
    slow = both(make, change, ACTIONS[:3])
    assert not isinstance(slow[-1], str)


def test_second_observation_of_an_observation_sees_its_change():
    def change(env):
        seeing, second = env.observation_type, KinematicObservation(env)
        normalize = seeing.normalize_obs

        def change_and_observe(rows):
            push(env.road)
            env.extra = second.observe()
            return normalize(rows)

        seeing.normalize_obs = change_and_observe

    both(made, change, ACTIONS[:3])


def test_meta_action_with_an_unusual_name_has_the_effect_that_it_has_in_highway_env():
    slow = both(made, lambda env: setattr(env.action_type, "actions", {1: ["FASTER"]}), [1, 1])
    assert not isinstance(slow[-1], str)


@pytest.mark.parametrize(
    ("owner", "name"),
    [(HighwayEnv, "_rewards"), (AbstractEnv, "_simulate"), (AbstractEnv, "step"), (observation, "compute_ttc_grid")],
)
def test_method_that_was_replaced_before_the_accelerator_is_kept(owner, name, monkeypatch):
    calls = []
    original = getattr(owner, name)

    @wraps(original)
    def replacement(*given, **named):
        calls.append(1)
        return original(*given, **named)

    monkeypatch.setattr(owner, name, replacement)
    assert switch_on() == ""
    assert getattr(owner, name) is replacement
    seeing = {"type": "TimeToCollision"} if owner is observation else {"type": "Kinematics"}
    env = made(observation=seeing)
    calls.clear()
    env.step(1)
    assert calls
    switch_off()
    assert getattr(owner, name) is replacement


def test_wrapper_with_the_name_of_the_method_of_a_vehicle_disables_the_accelerator(monkeypatch):
    @wraps(Vehicle.step)
    def slower(self, dt):
        original(self, dt / 2)

    original = Vehicle.step
    monkeypatch.setattr(Vehicle, "step", slower)
    assert switch_on().startswith("Vehicle.step has been replaced by ")


@pytest.mark.parametrize("action", [7, 1.0, True, np.float64(3), np.array(4), "FASTER", None])
def test_unusual_action_has_the_effect_that_it_has_in_highway_env(action):
    both(made, actions=[action, action])


def test_speed_halfway_between_two_target_speeds_is_rounded_as_in_highway_env():
    def change(env):
        env.vehicle.speed = 22.5

    for action in (3, 4):
        both(made, change, [action])


@pytest.mark.parametrize(("owner", "name"), [(DiscreteMetaAction, "act"), (ActionType, "controlled_vehicle")])
def test_replaced_method_of_meta_actions_is_called(owner, name, monkeypatch):
    called = []
    original = vars(owner)[name]
    if name == "act":
        monkeypatch.setattr(owner, name, lambda self, action: (called.append(1), original(self, 4 - action))[1])
    else:
        change = property(lambda self: (called.append(1), original.fget(self))[1], original.fset)
        monkeypatch.setattr(owner, name, change)
    both(made)
    assert len(called) >= 2 * len(ACTIONS)


def test_meta_action_leaves_controls_to_the_road():
    switch_on()
    env = made()
    env.step(1)
    env.vehicle.action = action = {"steering": 0.5, "acceleration": 0.5}
    assert _substep_loop.choose(env, 4)
    assert env.vehicle.action is action
    assert env.vehicle.target_speed == env.vehicle.target_speeds[env.vehicle.speed_index]


@pytest.mark.parametrize("speed", [-50.0, 0.0, 19.0, 20.0, 25.0, 30.0, 40.0, np.float64(22.5), np.nan, 25])
@pytest.mark.parametrize("kind", [HighwayEnv, HighwayEnvFast])
def test_rewards_are_those_of_highway_env(speed, kind):
    def change(env):
        env.vehicle.speed = speed
        env.vehicle.heading = np.float64(0.3)

    def rewards():
        env = made(kind)
        change(env)
        return exact(env._rewards(1)), exact(env._reward(1))

    same_either_way(rewards)


def test_replaced_clip_limits_the_speed_in_rewards(monkeypatch):
    switch_on()
    env = made()
    monkeypatch.setattr(np, "clip", lambda value, *_: np.float64(0.125))
    assert env._rewards(1)["high_speed_reward"] == 0.125
