"""The accelerator looks at everybody once in a step and its observation, unless foreign code runs between."""

from __future__ import annotations

import copy
import functools
from types import SimpleNamespace

import highway_env
import numpy as np
import pytest
from compiled import needs_kernel
from conftest import mostly_nightly
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.envs.intersection_env import ContinuousIntersectionEnv
from highway_env.road import regulation, road
from highway_env.road.lane import StraightLane
from highway_env.vehicle import behavior, dynamics
from highway_env.vehicle.controller import ControlledVehicle
from small_roads import begun, same_either_way, state, two_roads

from crashhunt.highway.accelerator import Onlooker, _roads, _switch, kind_of, switch_on

assert highway_env
pytestmark = [pytest.mark.usefixtures("plain_highway_env"), needs_kernel]


def made(kind=HighwayEnvFast):
    return begun(kind, {"vehicles_count": 9, "vehicles_density": 1.6, "simulation_frequency": 8})


def both(make, drive):
    """What happens, which is the same without and with the accelerator."""
    return same_either_way(lambda: drive(make()))


def driven(change=lambda env: None, steps=3):
    """The state of all vehicles after each step."""

    def drive(env):
        change(env)
        trace = []
        for number in range(steps):
            env.step(number % 3)
            trace.append(state(env.road))
        return trace

    return drive


@functools.cache
def usual():
    """The states where nothing is changed."""
    return driven()(made())


def looked(monkeypatch):
    """How often everybody is looked at."""
    times = []
    roster = _roads.Prepared.roster
    monkeypatch.setattr(_roads.Prepared, "roster", lambda self: times.append(1) or roster(self))
    return times


def onlooker(env):
    env.road.step = Onlooker(env.road.step)


def passer_by(env):
    advance = env.road.step
    env.road.step = lambda dt: advance(dt)


@pytest.mark.parametrize(("change", "times"), [(lambda env: None, 2), (onlooker, 2), (passer_by, 34)])
def test_everybody_is_looked_at_once_in_a_step_unless_an_actor_might_do_anything(change, times, monkeypatch):
    both(made, driven(change, steps=2))
    env = made()
    change(env)
    found = looked(monkeypatch)
    env.step(1)
    env.step(1)
    assert len(found) == times


def push(place):
    place.vehicles[4].speed *= 0.9
    place.vehicles[5].position[1] += 0.3


def interfering(env, **when):
    count = iter(range(1000))
    sometimes = {name: lambda *_: push(env.road) if next(count) % 3 == 0 else None for name in when}
    env.road.step = Onlooker(env.road.step, **sometimes, interferes=lambda: True)


class Rendering(HighwayEnvFast):
    def _automatic_rendering(self):
        push(self.road)


class Counting(HighwayEnvFast):
    @property
    def steps(self):
        return vars(self)["steps"]

    @steps.setter
    def steps(self, number):
        vars(self)["steps"] = number
        if self.road is not None and self.road.vehicles and number % 4 == 3:
            push(self.road)


def acting_late(env):
    act = env.action_type.act
    env.steps = 5
    env.action_type.act = lambda action: (push(env.road), act(action))


def looking_away(env):
    env._automatic_rendering = lambda: push(env.road)


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (HighwayEnvFast, lambda env: interfering(env, before=True)),
        (HighwayEnvFast, lambda env: interfering(env, after=True)),
        (HighwayEnvFast, acting_late),
        (HighwayEnvFast, looking_away),
        (Rendering, lambda env: None),
        (Counting, lambda env: None),
    ],
)
def test_the_one_that_changes_something_between_two_sub_steps_is_noticed(kind, change):
    slow = both(lambda: made(kind), driven(change))
    assert slow != usual()  # it matters


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize(("owner", "name"), [(AbstractEnv, "_simulate"), (AbstractEnv, "_automatic_rendering"),
                                             (road.Road, "act"), (road.Road, "step")])  # fmt: skip
def test_what_an_actor_wraps_is_called_in_every_sub_step(owner, name, early, monkeypatch):
    """Before highway-env is sped up or afterwards; of a road's methods, before it the accelerator steps aside."""
    method = getattr(owner, name)

    def wrapped(self, *words):
        found = method(self, *words)
        if (self if isinstance(self, road.Road) else self.road) is not None:
            push(self if isinstance(self, road.Road) else self.road)
        return found

    expected = driven(lambda env: monkeypatch.setattr(owner, name, wrapped))(made())
    monkeypatch.undo()
    if early:
        env = made()
        monkeypatch.setattr(owner, name, wrapped)
        assert (switch_on() == "") == (owner is AbstractEnv)
        assert driven()(env) == expected
    else:
        assert switch_on() == ""
        method = getattr(owner, name)
        env = made()
        monkeypatch.setattr(owner, name, wrapped)
        assert driven()(env) == expected


def test_a_copy_of_a_road_is_looked_at_by_the_same():
    times = []
    env = made()
    env.road.step = Onlooker(env.road.step, after=lambda: times.append(1))
    assert copy.deepcopy(env).road.step is env.road.step


def test_the_one_that_changes_something_between_two_steps_is_noticed():
    def drive(env):
        trace = []
        for _ in range(3):
            env.step(1)
            push(env.road)
            trace += stepped(env.road, 1)
        return trace

    both(made, drive)


def changed(place, changes):
    """The same road, with attributes of its vehicles changed."""
    for vehicle, change in zip(place.vehicles, changes, strict=True):
        vars(vehicle).update(change)
    return place


def test_vehicles_that_share_a_route_drop_its_parts_one_after_another():
    """The first one thinks of changing lanes when the second one drops a part, on which it depends."""

    def make():
        route = {"route": [("a", "b", 0), ("b", "c", 1)]}
        return changed(two_roads([([50.0, 4.0], 15.0, 1.5), ([98.5, 0.0], 15.0, 0.1)]), [route] * 2)

    both(make, lambda place: stepped(place, 3))


def test_who_sees_the_end_of_a_lane_later_is_still_in_the_way_there():
    def make():
        target = {"target_lane_index": ("a", "b", 1)}
        return changed(two_roads([([90.0, 0.5], 15.0, 0.1), ([98.5, 0.5], 15.0, 0.1)]), [target] * 2)

    both(make, lambda place: stepped(place, 3))


SLOW = {"target_speed": 15.0, "DISTANCE_WANTED": 0.5}  # so that it matters who is ahead


def test_a_lane_that_an_actor_states_a_vehicle_is_on():
    def make():
        poses = [([3.0 + 7 * number, 0.0 if number % 2 else 4.0], 2.0, 0.05 * number) for number in range(14)]
        place = changed(two_roads(poses), [SLOW] * 14)
        place.vehicles[4].lane_index = ("a", "b", 0)
        place.vehicles[6].lane = place.network.get_lane(("a", "b", 0))
        return place

    both(make, lambda place: stepped(place, 3))


class Splitting(behavior.IDMVehicle):
    def step(self, dt):
        super().step(dt)
        if len(self.road.vehicles) == 1:
            self.road.vehicles.append(behavior.IDMVehicle(self.road, np.add(self.position, (3.0, 0.1)), 0.0, 5.0))


@pytest.mark.parametrize("kind", [behavior.IDMVehicle, Splitting])
def test_a_vehicle_that_is_the_only_one_when_the_road_begins_to_move(kind):
    def make():
        place = two_roads([([20.0, 0.0], 15.0, 0.3)])
        place.vehicles[0].__class__ = kind
        return place

    both(make, lambda place: stepped(place, 4))


def test_vehicles_in_the_very_same_place():
    def make():
        poses = [([3.0 + 7 * (number // 2), 4.0 * (number % 3 == 0)], 2.0, 0.08 * number) for number in range(28)]
        place = changed(two_roads(poses), [SLOW] * 28)
        for vehicle in place.vehicles[::2]:
            vehicle.check_collisions = vehicle.collidable = False
        return place

    both(make, lambda place: stepped(place, 3))


def stepped(place, steps, dt=0.2):
    trace = []
    for _ in range(steps):
        place.act()
        place.step(dt)
        trace.append(state(place))
    return trace


def crossing(kind=dynamics.BicycleVehicle):
    """Two roads that cross, one vehicle by the dynamic model, others who give way, and one in its back."""
    network = road.RoadNetwork()
    network.add_lane("w", "e", StraightLane([-100, 0], [200, 0], priority=1, speed_limit=12))
    network.add_lane("s", "n", StraightLane([0, -100], [0, 200], priority=0, speed_limit=12))
    place = regulation.RegulatedRoad(network, np_random=np.random.default_rng(1))
    sliding = kind(place, [-28.0, 0.5], 0.02, 9.0)
    sliding.action = {"steering": 0.03, "acceleration": 0.5}
    others = [ControlledVehicle(place, [0.0, -25.0 - 11 * number], np.pi / 2, 8.0) for number in range(3)]
    place.vehicles += [*others[:2], sliding, others[2], behavior.IDMVehicle(place, [-34.5, 0.0], 0.0, 15.0)]
    return place


class Skidding(dynamics.BicycleVehicle):
    def derivative_func(self, time, state, **kwargs):
        return super().derivative_func(time, state, **kwargs) * 0.98


FORESEEN = [(k, p) for k in (dynamics.BicycleVehicle, Skidding) for p in ("constant_steering", "zero_steering", "none")]


@pytest.mark.parametrize(("kind", "prediction"), mostly_nightly(FORESEEN, [*FORESEEN[:3], FORESEEN[-1]]))
def test_a_vehicle_by_the_dynamic_model_is_moved_and_foreseen_by_it(kind, prediction):
    def make():
        place = crossing(kind)
        place.vehicles[2].prediction_type = prediction
        return place

    def drive(place):
        try:
            return stepped(place, 30), any(vehicle.crashed for vehicle in place.vehicles)
        except ValueError as error:
            return repr(error), True

    slow = both(make, drive)
    assert slow[1]  # somebody is hit
    assert kind_of(kind).moves == kind_of(kind).predicts == (kind is not Skidding)


def test_a_vehicle_by_the_dynamic_model_is_foreseen_without_a_copy_of_the_road(monkeypatch):
    assert switch_on() == ""
    place = crossing()
    monkeypatch.setattr(copy, "deepcopy", lambda thing: pytest.fail("it was copied"))
    stepped(place, 12)


def test_an_environment_whose_vehicle_moves_by_the_dynamic_model():
    """The one of ours of which least was gained."""

    def make():
        env = ContinuousIntersectionEnv({"initial_vehicle_count": 4, "spawn_probability": 0.0})
        env.reset(seed=2)
        return env

    def drive(env):
        trace = []
        for _ in range(2):
            env.step(np.array([0.1, 0.02]))
            trace.append(state(env.road))
        return trace

    both(make, drive)


def test_observers_that_wait_for_a_crash_are_called_after_its_sub_step():
    """Otherwise the sub-steps run without them."""

    def drive(env, waits=bool):
        found = []
        env.road.vehicles[3].position = env.road.vehicles[0].position + np.array([16.0, 0.0])
        env.road.vehicles[3].speed = 0.0
        env.road.step = Onlooker(
            env.road.step,
            before=lambda _: found.append(state(env.road)),
            after=lambda: found.append((env.road.vehicles[0].crashed, state(env.road))),
            waits=waits,
        )
        for _ in range(3):
            env.step(1)
        return found

    assert switch_on() == ""
    every, few = drive(made()), drive(made(), lambda: True)
    first = next(number for number, (crashed, _) in enumerate(every[1::2]) if crashed)
    assert 0 < first < 7  # within the first step, and not in its last sub-step
    # The sub-steps up to the crash, those left of the step, and those of the next two.
    assert few == [every[1::2][number] for number in (first, 7, 15, 23)]


@pytest.mark.parametrize(
    ("kinds", "drives"),
    [
        ([(True, True)], True), ([(True, True), (True, False)], False), ([(False, True)], False),
        ([(False, False)], False), ([], True),
    ],
)  # fmt: skip
def test_kernel_drives_all_only_where_each_vehicle_decides_and_moves_as_it_knows(monkeypatch, kinds, drives):
    place = made().road
    found = [SimpleNamespace(drives=decides, moves=moves) for decides, moves in kinds]
    monkeypatch.setattr(_roads, "kinds_of", lambda vehicles: found if vehicles is place.vehicles else [])
    prepared = _roads.Prepared(place)
    prepared.checked = True
    assert prepared.drives_all() is drives
    assert not prepared.checked  # the vehicles have not been compared with the kernel's


def test_lanes_of_a_grid_are_marked_once(monkeypatch):
    """The result is highway-env's either way, so only a count shows that its own slower code does not run as well."""
    config = {"observation": {"type": "OccupancyGrid", "features": ["presence", "on_road"]}}
    seen = both(lambda: HighwayEnvFast(config), lambda env: env.reset(seed=3)[0].tobytes())
    ran = []
    with monkeypatch.context() as here:  # as long as originals are put back into their classes, they are the true ones
        here.setitem(_switch.originals, "OccupancyGridObservation.fill_road_layer_by_lanes", lambda *_: ran.append(1))
        env = HighwayEnvFast(config)
        assert env.reset(seed=3)[0].tobytes() == seen
    assert ran == []
