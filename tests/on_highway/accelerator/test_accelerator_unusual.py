"""The accelerator where a user's numbers, lanes and routes are unusual: the same bits, kinds of numbers and errors."""

from __future__ import annotations

import functools
import pickle

import highway_env
import numpy as np
import pytest
from compiled import needs_kernel
from exact_values import exact
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from small_roads import begun, same_either_way, state, two_roads

from crashhunt.highway.accelerator import _roads, switch_on

assert highway_env
pytestmark = [pytest.mark.usefixtures("plain_highway_env"), needs_kernel]


def five(count=5):
    return two_roads([([18.0 * number, 4.0 * (number % 2)], 20 + number, 0.3 * number) for number in range(count)])


def both(change, steps=8, dt=0.2):
    """The state of all vehicles after each step, the same without and with the accelerator."""

    def drive():
        with pytest.MonkeyPatch.context() as patch:
            place, trace = five(), []
            for number in range(steps):
                if number == 2:
                    change(place, patch)
                try:
                    place.act()
                    place.step(dt)
                except Exception as error:  # somebody may go on after it
                    trace.append(repr(error))
                trace.append(state(place))
            return trace

    return same_either_way(drive)


@functools.cache
def usual():
    """What happens where nothing is changed."""
    return both(lambda place, patch: None)


@pytest.mark.parametrize(("number", "dt"), [(float, 0.2), (np.float64, 0.2), (int, 1), (float, np.float64(0.2))])
def test_numbers_stay_of_the_kind_that_they_are_in_highway_env(number, dt):
    def change(place, patch):
        for vehicle in place.vehicles[::2]:
            vehicle.speed = number(vehicle.speed)
        place.vehicles[3].speed = 99.0
        patch.setattr(Vehicle, "MAX_SPEED", np.float64(40))

    both(change, dt=dt)


def a_list_names_a_target(place, patch):
    place.vehicles[1].target_lane_index = ["a", "b", 0]


def a_list_names_a_lane(place, patch):
    place.vehicles[1].lane_index = ["a", "b", 0]


def no_number(place, patch):
    place.vehicles[2].speed = float("nan")


def no_direction(place, patch):
    place.vehicles[2].heading = float("nan")


def a_huge_exponent(place, patch):
    for vehicle in place.vehicles:
        vehicle.DELTA = 400.0
    place.vehicles[2].target_speed = 0.001


def braking_that_is_none(place, patch):
    patch.setattr(IDMVehicle, "COMFORT_ACC_MIN", 5.0)


@pytest.mark.parametrize(
    "change",
    [a_list_names_a_target, a_list_names_a_lane, no_number, no_direction, a_huge_exponent, braking_that_is_none],
)
def test_what_no_one_expects_reaches_the_same(change):
    """Of what is no number, not even nothing is nothing: a driver who is not polite heeds it all the same."""
    slow = both(change)
    assert slow != usual()  # it matters


def a_road_to_nowhere(place):
    place.vehicles[4].position[:] = 98.5, 0.0
    place.vehicles[4].target_lane_index = ("a", "b", 0)
    place.vehicles[4].route = [("a", "b", 0), ("b", "nowhere", 0)]
    place.vehicles[1].position[:] = 98.6, 4.0
    place.vehicles[1].target_lane_index = ("a", "b", 1)
    place.vehicles[1].route = [("a", "b", 1), ("b", "c", None)]


def a_route_without_lanes(place):
    """Of the last one, who thinks of changing lanes after the first one has done so."""
    place.vehicles[1].position[0] = 95.0
    place.vehicles[2].speed, place.vehicles[3].speed = 5.0, 15.0
    place.vehicles[3].position[0] = 20.0
    place.vehicles[4].route = [("a", "b")]
    for vehicle in place.vehicles[::4]:
        vehicle.timer = 5.0


@pytest.mark.parametrize(
    ("change", "error"), [(a_road_to_nowhere, "nowhere"), (a_route_without_lanes, "tuple index out of range")]
)
def test_an_error_is_that_of_the_same_vehicle_and_everybody_continues_as_after_it(change, error):
    slow = both(lambda place, patch: change(place))
    assert any(error in step for step in slow if isinstance(step, str))


def environment(**config):
    config = {"vehicles_count": 9, "vehicles_density": 1.6, "simulation_frequency": 5, **config}
    return begun(HighwayEnvFast, config)


@pytest.mark.parametrize("timer", [0.9, 5.0])  # of the second sub-step and of the first
def test_timer_that_begins_again_in_the_sub_step_of_an_error_is_a_whole_number(timer):
    """The last vehicle leaves its lane after the other one has thought of changing lanes in the same sub-step."""

    def drive():
        env = environment()
        thinks, leaves = env.road.vehicles[1], env.road.vehicles[-1]
        thinks.timer = timer
        leaves.position[0], leaves.speed = 9998.0 - 4.0 * (timer < 1), 20.0
        leaves.target_speed, leaves.route = 20.0, [leaves.lane_index, ("1", "2", 0)]
        with pytest.raises(KeyError):  # the road has no continuation
            env.step(1)
        return state(env.road), thinks.timer

    _, number = same_either_way(drive)
    assert (number, type(number)) == (0, int)


def shown(features, change=lambda env: None):
    def observe():
        env = environment()
        env.observation_type.features = features
        change(env)
        try:
            return exact(env.observation_type.observe())
        except Exception as error:
            return repr(error)

    return same_either_way(observe)


def far_away(env):
    env.vehicle.route = [("0", "1", 99)]


@pytest.mark.parametrize(
    ("features", "change"),
    [
        (["presence", "x", "x", "y"], lambda env: None),
        (("presence", "x"), lambda env: None),
        (["presence", "x"], far_away),
    ],
)
def test_what_an_observation_asks_for_twice_or_cannot_have_is_that_of_highway_env(features, change):
    shown(features, change)


def test_what_actions_do_to_a_road_of_which_they_have_asked_something_is_noticed():
    def drive(env):
        place, act = env.road, env.action_type.act

        def busy(action):
            act(action)
            place.act()
            place.vehicles[4].position[1] += 0.5

        env.action_type.act = busy
        env.step(1)
        return state(place)

    same_either_way(lambda: drive(environment()))


def test_an_environment_that_has_been_pickled_is_fast_too(monkeypatch):
    assert switch_on() == ""
    env = pickle.loads(pickle.dumps(environment()))
    decided = []
    roster = _roads.Prepared.roster
    monkeypatch.setattr(_roads.Prepared, "roster", lambda self: decided.append(roster(self)) or decided[-1])
    env.step(1)
    assert len(decided) == 2  # for the step and for its observation
    assert decided[0].decides


def one_action(place, patch):
    """Each step of a vehicle clips what its action says, which the next one then has."""
    first, second = (Vehicle(place, [30.0 * number, 4.0], 0, 90.0 - 30 * number) for number in (1, 2))
    first.action = second.action = {"steering": 0.01, "acceleration": 2.0}
    place.vehicles[3:] = [first, second]


def one_of_another_road(place, patch):
    place.vehicles[2].road = five(1)


def one_crashed(place, patch):
    place.vehicles[2].crashed = True


def one_pushed(place, patch):
    place.vehicles[2].impact = np.array([0.5, 3.9])


def ghosts(place, patch):
    for number, vehicle in enumerate(place.vehicles):
        vehicle.position[:] = 30.0 + 2.5 * number, 0.3 * number
        vehicle.collidable = number != 2
        vehicle.check_collisions = number not in (0, 1)


def one_of_its_own(place, patch):
    place.vehicles[1].LENGTH, place.vehicles[1].MAX_SPEED, place.vehicles[3].ACC_MAX = 9.0, 12.0, 0.5


def history(place, patch):
    place.record_history = True
    for vehicle in place.vehicles:
        vehicle.history.clear()


def slow_ones(place, patch):
    for number, vehicle in enumerate(place.vehicles):
        vehicle.speed, vehicle.timer = 0.9, 2.0
        vehicle.position[:] = 5.9 * number, 4.0 * (number % 3 == 2)


def one_about_to_change_lanes(place, patch):
    place.vehicles[1].target_lane_index, place.vehicles[1].timer = ("a", "b", 0), 5.0


def clipped_otherwise(place, patch):
    clip = Vehicle.clip_actions
    patch.setattr(Vehicle, "clip_actions", lambda self: (clip(self), self.action.update(acceleration=0.25))[0])


@pytest.mark.parametrize(
    "change",
    [
        one_about_to_change_lanes,
        clipped_otherwise,
        one_action,
        one_of_another_road,
        one_crashed,
        one_pushed,
        ghosts,
        one_of_its_own,
        history,
        slow_ones,
    ],
)
def test_what_vehicles_have_of_their_own_is_heeded(change):
    slow = both(change)
    assert slow != usual()
