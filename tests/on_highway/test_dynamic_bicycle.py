"""The dynamic bicycle model in the compiled kernel, with the bits of highway-env, and what it leaves to highway-env."""

from __future__ import annotations

import math
import sys

# First: this imports highway-env without what takes most of that time.
from crashhunt.highway import HighwaySimulator

# isort: split

import gymnasium
import numpy as np
import pytest
from compiled import needs_kernel
from exact_values import exact
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.dynamics import BicycleVehicle
from hypothesis import given, strategies as st

from crashhunt.highway.accelerator import _kernel, switch_off, switch_on

assert HighwaySimulator
pytestmark = [pytest.mark.usefixtures("plain_highway_env"), needs_kernel]
SPEEDS = [0.0, 0.9, 1.0, -0.99, -12.0, 8.3, 39.0, 45.0]


class Lorry(BicycleVehicle):
    """A user's vehicle with other numbers, some of them whole."""

    MASS = 2
    LENGTH_A, LENGTH_B = 2, np.float64(1.5)
    FRICTION_FRONT = 11
    MAX_ANGULAR_SPEED = 0.25


def state(vehicle):
    names = ("position", "heading", "speed", "lateral_speed", "yaw_rate", "action", "lane_index", "crashed", "impact")
    return {name: exact(vars(vehicle)[name]) for name in names}


def driven(kind, *, speed=8.3, steering=0.1, dt=0.1, alone=True, crashed=False, **given):
    """The states of a vehicle after each sub-step, and how often highway-env computed the derivative itself."""
    road = Road(RoadNetwork.straight_road_network(2), np_random=np.random.default_rng(1))
    vehicle = kind(road, [20.0, 1.0], 0.2, speed)
    vehicle.act({"steering": steering, "acceleration": np.float32(0.7)})
    vehicle.crashed = crashed
    vars(vehicle).update(given)
    road.vehicles += [vehicle] if alone else [IDMVehicle(road, [0.0, 4.0], 0.0, 20.0), vehicle]
    found, calls, code = [], [], BicycleVehicle.derivative_func.__code__
    sys.setprofile(lambda frame, event, _: calls.append(1) if event == "call" and frame.f_code is code else None)
    try:
        for _ in range(4):
            road.step(dt)
            found.append(state(vehicle))
    except ArithmeticError as error:
        found.append(repr(error))
    finally:
        sys.setprofile(None)
    return found, len(calls)


def both(*words, **options):
    """The states, which must be the same without and with the accelerator, and the calls with it."""
    switch_off()
    slow, calls = driven(*words, **options)
    assert calls
    assert not switch_on()
    try:
        fast, calls = driven(*words, **options)
    finally:
        switch_off()
    assert fast == slow
    return calls


@given(
    kind=st.sampled_from([BicycleVehicle, Lorry]),
    speed=st.sampled_from(SPEEDS) | st.floats(-60, 60),
    steering=st.sampled_from([0, -0.0, 1.7, -2.0, np.float32(0.3)]) | st.floats(-1.5, 1.5),
    lateral_speed=st.sampled_from([0, -0.0]) | st.floats(-5, 5),
    yaw_rate=st.sampled_from([0, 7.0, -7.0]) | st.floats(-1, 1),
    dt=st.sampled_from([1 / 15, 0.1, 0.5]),
    crashed=st.booleans(),
    alone=st.booleans(),
)
def test_kernel_moves_by_the_dynamic_model_with_the_bits_of_highway_env(kind, **given):
    assert both(kind, **given) == 0


def test_kernel_moves_the_only_vehicle_of_an_environment():
    def played():
        env = gymnasium.make("lane-keeping-v0", disable_env_checker=True).unwrapped
        env.reset(seed=4)
        env.action_space.seed(4)
        steps = [[*env.step(env.action_space.sample())[:2], env.vehicle.position.copy()] for _ in range(30)]
        return [[exact(part) for part in step] for step in steps]

    slow = played()
    assert not switch_on()
    assert played() == slow


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    "given", [{"lateral_speed": 1e308}, {"yaw_rate": math.nan}, {"lateral_speed": math.nan}, {"steering": math.nan}]
)
def test_numbers_that_are_not_finite_are_left_to_highway_env(given):
    assert both(BicycleVehicle, **given) > 0


@pytest.mark.parametrize("name", ["MASS", "LENGTH_A", "INERTIA_Z"])
def test_a_division_by_zero_is_left_to_highway_env(name):
    assert both(BicycleVehicle, speed=0.5, **{name: 0}) > 0
    assert both(BicycleVehicle, speed=8.0, **{name: 0}) > 0


def test_a_steep_steering_angle_to_the_left_is_clipped_like_one_to_the_right():
    for steering in (-1.4, -1.6, 1.6):
        assert both(BicycleVehicle, steering=steering) == 0


def test_highway_env_resumes_from_what_the_kernel_has_computed():
    """The first sub-steps are finite, and the kernel has not written them when highway-env has to take over."""

    def played():
        env = gymnasium.make("highway-fast-v0", disable_env_checker=True).unwrapped
        config = {"vehicles_count": 2, "action": {"type": "ContinuousAction", "dynamical": True}}
        env.reset(seed=4, options={"config": config})
        env.vehicle.FRICTION_FRONT, env.vehicle.MASS = 1e60, 1e-60  # velocities explode after some sub-steps
        try:
            env.step(np.array([0.3, 0.2]))
        except Exception as error:
            return repr(error), state(env.vehicle)
        return state(env.vehicle)

    with np.errstate(all="ignore"):
        slow = played()
        assert not switch_on()
        assert played() == slow


def test_an_unknown_type_of_a_velocity_is_left_to_highway_env():
    assert both(BicycleVehicle, yaw_rate=np.float32(0.3)) > 0


def test_places_that_a_user_keeps_stay():
    """highway-env gives such a vehicle a new array of its position in each step."""
    assert not switch_on()
    road = Road(RoadNetwork.straight_road_network(2), np_random=np.random.default_rng(1))
    road.vehicles.append(BicycleVehicle(road, [20.0, 1.0], 0.0, 10.0))
    kept = road.vehicles[0].position
    road.step(0.1)
    assert kept.tolist() == [20.0, 1.0]
    assert road.vehicles[0].position.tolist() == [21.0, 1.0]


def test_unknown_rounding_of_numpy_leaves_the_model_to_highway_env():
    module = _kernel.kernel()
    try:
        module.bind_turn(0)
        assert both(BicycleVehicle, alone=False) > 0
    finally:
        _kernel._bind_turn(module)
    assert both(BicycleVehicle, alone=False) == 0


def test_rounding_of_numpy_is_found_out():
    class Module:
        def __init__(self, right):
            self.right, self.rounds = right, None

        def bind_turn(self, rounds):
            self.rounds = rounds

        def compute(self, name, numbers):
            assert name == "turned"
            a, b, c, d = numbers
            found = float((np.array(((a, b), (-b, a))) @ np.array([c, d]))[0])
            return found if self.rounds == self.right else math.nextafter(found, 1e300)

    for right in (1, 0):
        module = Module(right)
        _kernel._bind_turn(module)
        assert module.rounds == right
    with pytest.raises(ValueError, match="unknown way of rounding 4"):
        _kernel.kernel().bind_turn(4)
