"""Where nothing is unusual, the accelerator leaves no work to highway-env: the bits are the same either way."""

from __future__ import annotations

import re
import sys
from collections import Counter
from contextlib import contextmanager
from functools import partial
from itertools import product

import gymnasium

# First: this imports highway-env without what takes most of that time.
from crashhunt.highway import HighwaySimulator

# isort: split

import numpy as np
import pytest
from compiled import needs_kernel
from highway_env.envs.common import observation
from highway_env.envs.common.observation import observation_factory
from highway_env.envs.exit_env import ExitEnv
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.road.lane import StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle
from small_roads import begun, same_either_way, small_road

from crashhunt.highway.accelerator import (
    Onlooker,
    _kernel_objects,
    _lane_network as _network,
    _substep_loop,
    _switch,
    switch_off,
    switch_on,
)

assert HighwaySimulator
pytestmark = [
    pytest.mark.usefixtures("plain_highway_env"),
    pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning"),
    needs_kernel,
]
SMALL = {"vehicles_count": 6, "simulation_frequency": 4}
ALL = ["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h"]


@contextmanager
def originals_counted():
    """How often methods of highway-env run that the accelerator replaces."""
    calls, before = Counter(), dict(_switch.originals)

    def counted(name, original):
        return lambda *given, **named: (calls.update([name]), original(*given, **named))[1]

    for owner, name, _ in _switch._REPLACEMENTS:
        key = _switch._name(owner, name)
        _switch.originals[key] = counted(key, before[key])
    try:
        yield calls
    finally:
        _switch.originals.update(before)


@contextmanager
def built():
    """How often lanes and vehicles are put into new objects of the accelerator."""
    counts = Counter()
    with pytest.MonkeyPatch.context() as patch:
        for kind in (_network.Network, _kernel_objects.KernelObjects):
            make = kind.__init__
            patch.setattr(
                kind, "__init__", lambda *given, make=make: (counts.update([type(given[0]).__name__]), make(*given))[1]
            )
        yield counts


def seeing(**observing):
    return {**SMALL, "observation": observing}


USUAL = [
    ("highway-fast-v0", SMALL, {}),
    ("highway-fast-v0", seeing(type="Kinematics", features=ALL, vehicles_count=2, absolute=True, clip=False), {}),
    ("highway-fast-v0", seeing(type="Kinematics", normalize=False, order="shuffled", see_behind=True), {}),
    ("highway-fast-v0", seeing(type="Kinematics", features_range={"x": [-90, 90], "vy": [np.float64(-2), 3]}), {}),
    ("highway-fast-v0", seeing(type="Kinematics", features=["x", "lat_off", "cos_d"]), {}),
    ("highway-fast-v0", seeing(type="OccupancyGrid", features=["presence", "on_road"]), {}),
    ("highway-fast-v0", seeing(type="OccupancyGrid", as_image=True, clip=False), {}),
    ("highway-fast-v0", seeing(type="TimeToCollision", horizon=4), {}),
    ("highway-fast-v0", {**SMALL, "action": {"type": "ContinuousAction"}}, {}),
    ("highway-fast-v0", {**SMALL, "action": {"type": "ContinuousAction", "dynamical": True}}, {}),
    ("highway-fast-v0", {**SMALL, "neighbour_vehicles_connected_lanes": True}, {}),
    ("highway-fast-v0", {**SMALL, "other_vehicles_type": "highway_env.vehicle.behavior.DefensiveVehicle"}, {}),
    ("intersection-v0", {"initial_vehicle_count": 4, "spawn_probability": 0.0}, {}),
    ("merge-v0", {}, {}),
    ("roundabout-v0", {}, {}),
    ("exit-v0", SMALL, {}),
    ("parking-v0", {"vehicles_count": 2}, {}),
    ("parking-v0", {}, {}),
    ("racetrack-v0", {}, {}),
    ("two-way-v0", {}, {}),
    ("u-turn-v0", {}, {}),
]  # fmt: skip


BITS = {
    "Kinematics": [
        {"observe_intentions": False, "features": ["y", "cos_d", "sin_d", "presence"]},
        {"absolute": True, "normalize": False, "features": ["x", "long_off", "ang_off", "heading"]},
        {"features_range": {"x": [-30, 60], "vx": [5, 25], "lat_off": [-1, 2]}, "features": ["x", "vx", "lat_off"]},
        {"vehicles_count": 2, "see_behind": True, "include_obstacles": False, "features": ["x", "lat_off"]},
    ],
    "ExitObservation": [{"features": ["x", "vx", "presence"]}, {"vehicles_count": 3, "order": "shuffled"}],
    "OccupancyGrid": [
        {"as_image": True, "features": ["vx", "on_road"]},
        {"as_image": True, "clip": False},
        {"clip": False, "features_range": {"vx": [10, 20], "x": [-50, 50], "y": [-12, 8], "heading": [-1, 2]},
         "features": ["heading", "vx", "cos_h"]},
        {"grid_size": [[-20, 60], [-9, 9]], "grid_step": [7, 3], "align_to_vehicle_axes": True},
        {"absolute": True, "grid_size": [[100, 300], [-9, 9]]},
        {"features": []},
        {"features": ["presence", "lat_off"]},
    ],
    "TimeToCollision": [{"horizon": 5}],
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning", "ignore::FutureWarning")
def test_observations_have_the_bits_of_highway_env_whatever_they_are_set_to():
    def shown():
        found = []
        for kind, settings in BITS.items():
            env = (ExitEnv if kind == "ExitObservation" else HighwayEnvFast)(SMALL)
            env.reset(seed=4)
            env.road.objects.append(Obstacle(env.road, env.vehicle.position + np.array([12.0, 3.0])))
            env.vehicle.heading = 0.2
            env.road.vehicles[2].plan_route_to(env.vehicle.lane_index[1])
            for setting in settings:
                seeing = observation_factory(env, {"type": kind, **setting})
                seeing.observer_vehicle = env.vehicle
                try:
                    seen = seeing.observe()
                    found.append(
                        (
                            kind,
                            setting,
                            seen.dtype,
                            seen.shape,
                            seen.tobytes(),
                            repr(vars(seeing).get("features_range")),
                        )
                    )
                except Exception as error:
                    found.append((kind, setting, repr(error)))
        return found

    slow = same_either_way(shown)
    assert sum(len(entry) == 3 for entry in slow) <= 2  # errors
    assert len({str(entry[-2]) for entry in slow}) > 10


ODD = [
    {"vehicles_count": 1}, {"vehicles_count": np.int64(4)}, {"vehicles_count": 4.0}, {"features": ("presence", "x")},
    {"features": ["x", "x"]}, {"features": []}, {"features_range": {"x": [5, 5]}}, {"order": "unsorted"},
    {"features_range": {"x": [0, np.inf]}}, {"features_range": {"x": [np.float32(0), 9]}},
    {"features_range": {"x": [9]}}, {"features_range": {"x": (20, -20), "y": [0, 1, 2], "none": [0, 0]}},
    {"features_range": {"cos_h": [0, 2]}, "features": ["cos_h", "sin_h"]},
]  # fmt: skip


def odd_speeds(vehicle):
    """Tables of target speeds, of which highway-env can use some."""
    before = vehicle.target_speeds
    for table in (before, before.astype(np.float32), before.astype(int), np.array([20.0]), np.array([20.0, np.nan]),
                  np.array([[20.0, 30.0]]), [20.0, 30.0], np.array(["20", "30"])):  # fmt: skip
        vehicle.target_speeds = table
        yield str(table)
    vehicle.target_speeds = before


@pytest.mark.filterwarnings("ignore")
def test_odd_settings_have_what_they_have_in_highway_env():
    def outcome(look):
        try:
            seen = look()
        except Exception as error:
            return repr(error)
        return seen.dtype, seen.shape, seen.tobytes()

    def found():
        env = begun(HighwayEnvFast, {**SMALL, "vehicles_count": 3}, 4)
        every = []
        for setting in ODD:
            seeing = observation_factory(env, {"type": "Kinematics"})
            vars(seeing).update(setting)
            seeing.observer_vehicle = env.vehicle
            every.append((str(setting), outcome(seeing.observe), str(seeing.features_range)))
        for reach in (np.float32(150), np.float64(30.0)):
            env.PERCEPTION_DISTANCE = reach
            every.append((str(reach), outcome(env.observation_type.observe)))
        times = partial(observation.compute_ttc_grid, env, 0.5, 4)
        every += [(table, outcome(times)) for table in odd_speeds(env.vehicle)]
        away = MDPVehicle(env.road, env.vehicle.position + np.array([9.0, 0.0]), 0.0, 20.0)
        for vehicle in (away, env.vehicle, env.road.vehicles[2]):
            every += [outcome(lambda v=vehicle, h=h: observation.compute_ttc_grid(env, 1.0, h, v)) for h in (3, 2.5)]
        return every

    same_either_way(found)


LEFT_TO_THE_KERNEL = {
    "step", "handle_collisions", "_is_colliding", "lane_distance_to", "acceleration", "desired_gap", "mobil", "to_dict",
    "steering_control", "speed_control", "clip_actions", "predict_trajectory_constant_speed", "change_lane_policy",
    "on_state_update", "neighbour_vehicles", "get_closest_lane_index",
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_step_of_a_usual_environment_is_the_accelerators_alone():
    """Lanes and vehicles are the kernel's from the first step on; positions are read anew where Python observes."""
    assert switch_on() == ""
    ran = set()

    def see(frame, event, _):
        if event == "call" and "highway_env/vehicle" in frame.f_code.co_filename:
            ran.add(frame.f_code.co_name)

    for name, config, new in USUAL:
        env = gymnasium.make(name, disable_env_checker=True).unwrapped
        env.reset(seed=1, options={"config": config})
        idle = 1 if env.action_space.shape == () else env.action_space.sample() * 0
        env.step(idle)
        with originals_counted() as calls, built() as made:
            sys.setprofile(see)
            for _ in range(3):
                env.step(idle)
            sys.setprofile(None)
        alone = len(env.road.vehicles) == 1
        assert calls == {"AbstractEnv.step": 3} | ({"AbstractEnv._simulate": 3} if alone else {}), (name, config)
        assert made == {kind: 3 * count for kind, count in new.items()}, (name, config)
        assert ran & LEFT_TO_THE_KERNEL == set(), (name, config)


def test_searches_have_the_answers_of_highway_env_for_all_arguments():
    def answers():
        place = small_road(*[IDMVehicle, MDPVehicle, Vehicle] * 3)
        place.objects += [Obstacle(place, [12.0, 4.0]), Landmark(place, [30.0, 0.0]), Obstacle(place, [-13.0, 4.0])]
        things = [*place.vehicles, *place.objects]
        found = []
        for vehicle in place.vehicles:
            found += [[*place.neighbour_vehicles(vehicle, lane)] for lane in (None, ("0", "1", 0), ("0", "1", 2))]
            for behind, sort, only in product((True, False), repeat=3):
                found.append(place.close_objects_to(vehicle, 51.0, 3 if sort else None, behind, sort, only))
            found += [place.close_objects_to(vehicle, 40.0), place.close_vehicles_to(vehicle, 40.0, 2, False)]
        return [[None if thing is None else things.index(thing) for thing in row] for row in found]

    slow = answers()
    assert switch_on() == ""
    with originals_counted() as calls:
        assert answers() == slow
    assert calls == {}
    assert len({tuple(row) for row in slow}) > 30


def test_search_from_a_vehicle_or_for_a_lane_that_is_not_on_the_road_is_highway_envs():
    def answers(place):
        other = IDMVehicle(place, [20.0, 4.0], 0.0, 20.0)
        found = [place.neighbour_vehicles(other, lane) for lane in (None, ("0", "1", 0), ["0", "1", 2])]
        found.append(place.neighbour_vehicles(place.vehicles[0], ["0", "1", 1]))
        found.append(place.close_objects_to(other, 60.0))
        other.lane_index = place.vehicles[0].lane_index = None
        found += [place.neighbour_vehicles(thing) for thing in (other, place.vehicles[0])]
        return [[thing and place.vehicles.index(thing) for thing in row] for row in found]

    slow = answers(small_road(*[IDMVehicle] * 5))
    assert switch_on() == ""
    with originals_counted() as calls:
        assert answers(small_road(*[IDMVehicle] * 5)) == slow
    assert calls == {"Road.neighbour_vehicles": 6, "Road.close_objects_to": 1}


# Steps of an environment.


def test_environment_is_left_as_highway_env_leaves_it():
    """Its counters, and the vehicles with every attribute, also after an error in a sub-step."""

    def left(kind, **config):
        env = begun(kind, {**SMALL, "simulation_frequency": 6, "policy_frequency": 2, **config}, 2)
        env.enable_auto_render = True
        trace = []
        for number in range(4):
            if number == 2:
                env.road.vehicles[3].route = [("0", "1", 0), ("1", "nowhere", 0)]
                env.road.vehicles[3].position[0] = env.road.network.get_lane(("0", "1", 0)).length - 8.0
            try:
                env.step(1 if number % 2 else 3)
            except Exception as error:
                trace.append(repr(error))
            trace.append([env.steps, env.time, env.enable_auto_render, env.vehicle.target_speed])
            trace += [[str(value) for name, value in vars(vehicle).items() if name != "timer"]
                      for vehicle in env.road.vehicles]  # fmt: skip
        return [re.sub("0x[0-9a-f]+|#[0-9]+", "", str(entry)) for entry in trace]

    errors = 0
    for config in ({}, {"manual_control": True, "policy_frequency": 4}):
        slow = same_either_way(partial(left, HighwayEnvFast, **config))
        errors += sum("KeyError" in entry for entry in slow)
    assert errors > 1


def test_agent_acts_once_in_each_period_whatever_steps_have_run_before():
    def acted(steps, action):
        env = begun(HighwayEnvFast, {**SMALL, "simulation_frequency": 8}, 2)
        calls, act = [], env.action_type.act
        env.action_type.act = lambda action: (calls.append(env.steps), act(action))
        env.steps = steps
        env._simulate(action)
        return calls, env.steps

    for steps, action in product((0, 3), (None, 1)):
        expected = ([] if action is None else [-(-steps // 8) * 8], steps + 8)
        assert same_either_way(partial(acted, steps, action)) == expected


def test_usual_change_of_the_target_speed_needs_no_code_of_highway_env():
    assert switch_on() == ""
    env = begun(HighwayEnvFast, SMALL)
    vehicle, tables = env.vehicle, (env.vehicle.target_speeds, np.array([10, 20, 30]), np.array([20.0, 21.0]))
    before = {name: vars(vehicle)[name] for name in ("target_speed", "speed_index", "target_lane_index")}
    for action, table, speed in product((1, 3, 4, np.int64(3)), tables, (22.0, np.float64(-3), 99.0, 25, 15.0)):
        found, usual = [], type(speed) is not int or action == 1
        for apply in (lambda action: _substep_loop.choose(env, action), env.action_type.act):
            vars(vehicle).update(before, speed=speed, target_speeds=table)
            applied = apply(action)
            found.append({name: vars(vehicle)[name] for name in before})
            assert applied in (usual, None)
        assert found[0] == (found[1] if usual else before)
    vars(vehicle).update(before, target_speeds=np.array([[20.0, 30.0]]))
    assert not _substep_loop.choose(env, 3)


def road_with(step):
    place = small_road(IDMVehicle)
    if step is not None:
        place.step = step
    return place


@pytest.mark.parametrize(
    ("step", "waits", "interferes"),
    [
        (None, True, False),
        (len, False, True),
        (Onlooker(len), False, False),
        (Onlooker(len, waits=lambda: True), True, False),
        (Onlooker(len, interferes=lambda: True), False, True),
        (Onlooker(len, interferes=lambda: True, waits=lambda: True), True, True),
    ],
)
def test_observers_of_a_road_wait_and_interfere_as_they_declare(step, waits, interferes):
    place = road_with(step)
    assert _substep_loop._waits(place) is waits
    assert _substep_loop._interferes(place) is interferes


def test_right_of_way_is_that_of_highway_env_for_all_durations(monkeypatch):
    def driven():
        network = RoadNetwork()
        network.add_lane("w", "e", StraightLane([-100, 0], [200, 0], priority=1, speed_limit=12))
        network.add_lane("s", "n", StraightLane([0, -100], [0, 200], priority=0, speed_limit=11))
        place = RegulatedRoad(network, np_random=np.random.default_rng(1))
        place.vehicles += [IDMVehicle(place, [-20.0 - 12 * n, 0.0], 0.0, 10.0) for n in range(2)]
        place.vehicles += [MDPVehicle(place, [0.0, -90.0], np.pi / 2, 8.0)]
        place.vehicles += [IDMVehicle(place, [0.0, -19.0 - 12 * n], np.pi / 2, 8.0) for n in range(2)]
        names = ("speed", "target_speed", "is_yielding", "yield_timer", "color")
        trace = []
        for _ in range(24):
            place.enforce_road_rules()
            place.act()
            place.step(0.25)
            trace.append([str({name: vars(vehicle).get(name) for name in names}) for vehicle in place.vehicles])
        return trace

    for duration, frequency in ((0.0, 2), (2, 3)):
        monkeypatch.setattr(RegulatedRoad, "YIELD_DURATION", duration)
        monkeypatch.setattr(RegulatedRoad, "REGULATION_FREQUENCY", frequency)
        switch_off()
        slow = driven()
        assert switch_on() == ""
        with originals_counted() as calls:
            assert driven() == slow
        assert calls == {}
        assert any("'is_yielding': True" in vehicle for step in slow for vehicle in step)
        assert any("'is_yielding': False" in vehicle for step in slow for vehicle in step)
