"""The compiled kernel for highway-env: its functions, its refusals, and what it leaves behind after an error."""

from __future__ import annotations

import hashlib
import logging
import math
import os
import struct
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations, pairwise
from types import SimpleNamespace

# First: this imports highway-env without what takes most of that time.
from crashhunt.highway import HighwaySimulator, restore_classes

# isort: split

import gymnasium
import numpy as np
import pytest
from compiled import needs_kernel
from conftest import examples, one_in
from exact_values import exact
from highway_env.envs.common import observation
from highway_env.road.lane import CircularLane, SineLane, StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import AggressiveVehicle, DefensiveVehicle, IDMVehicle, LinearVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle, RoadObject
from hypothesis import example, given, settings, strategies as st
from small_roads import same_either_way, state

from crashhunt.highway import _descriptor as highway
from crashhunt.highway._descriptor import BACKEND
from crashhunt.highway.accelerator import _kernel, _roads, _switch, switch_off, switch_on
from crashhunt.scenario import load_scenario

assert HighwaySimulator
pytestmark = [
    pytest.mark.usefixtures("plain_highway_env"),
    needs_kernel,
]
NUMBERS = st.floats(-1e6, 1e6)


@pytest.fixture
def plain_highway_env():
    """highway-env as it was before, and after: an intersection changes the class of all drivers."""
    restore_classes()
    switch_off()
    yield
    switch_off()
    restore_classes()


def bits(number):
    return struct.pack("<d", number)


@pytest.mark.parametrize("function", [np.sin, np.cos, np.tan, np.arctan], ids=lambda function: function.__name__)
@given(x=NUMBERS)
def test_functions_of_one_number_have_the_bits_of_numpy(function, x):
    assert bits(_kernel.kernel().compute(function.__name__, (x,))) == bits(function(x))


@given(x=st.floats(-1, 1), y=NUMBERS, z=st.floats(0, 1e3), exponent=st.sampled_from([2.0, 4.0, 3.7, 0.5]))
def test_other_functions_have_the_bits_of_numpy(x, y, z, exponent):
    compute = _kernel.kernel().compute
    assert bits(compute("arcsin", (x,))) == bits(np.arcsin(x))
    assert bits(compute("arctan2", (x, y))) == bits(np.arctan2(x, y))
    assert bits(compute("power", (z, exponent))) == bits(np.power(z, exponent))
    assert bits(compute("power", (y, 2))) == bits(np.power(y, 2))


@example(a=0.0, b=7.887040746228229e-289, c=0.0, d=-2.330937333305343e-132)
@given(a=NUMBERS, b=NUMBERS, c=NUMBERS, d=NUMBERS)
def test_products_and_remainders_have_the_bits_of_numpy_and_python(a, b, c, d):
    compute = _kernel.kernel().compute
    assert bits(compute("dot", (a, b, c, d))) == bits(np.dot(np.array([a, b]), np.array([c, d])))
    matrix, outline = np.array([[a, -b], [b, a]]), np.array([[c, d], [d, c], [-c, d], [-d, c]])
    # The kernel adds a position, which removes the sign of a zero.
    assert bits(compute("product", (b, a, d, c)) + 0.0) == bits((matrix @ outline.T)[1, 1] + 0.0)
    assert (
        bits(compute("remainder", (a, 2 * math.pi))) == bits(np.float64(a) % (2 * math.pi)) == bits(a % (2 * math.pi))
    )


@pytest.mark.parametrize(
    "name",
    one_in(
        3,
        ["sin", "cos", "tan", "arctan", "arcsin", "arctan2", "power", "remainder", "dot", "dot3", "product", "square"],
    ),
)
def test_a_function_with_one_other_bit_disables_the_kernel(name, monkeypatch):
    right = _kernel.kernel().compute

    def compute(asked, numbers):
        found = right(asked, numbers)
        return math.nextafter(found, math.inf) if asked == name and numbers[0] > 1e-3 else found

    wrong = SimpleNamespace(INTERFACE=_kernel._INTERFACE, bind=lambda *_: None, compute=compute)
    monkeypatch.setattr(_kernel.importlib, "import_module", lambda _: wrong)
    assert _kernel._load_kernel.__wrapped__() == (None, f"on this processor, it computes {name} otherwise than NumPy")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (lambda name: (_ for _ in ()).throw(ImportError(name)), "it is not built"),
        (
            lambda name: type("Old", (), {"INTERFACE": 0}),
            f"it is of another version of crashhunt (0 instead of {_kernel._INTERFACE})",
        ),
    ],
)
def test_without_the_kernel_there_is_a_reason(error, reason, monkeypatch):
    monkeypatch.setattr(_kernel.importlib, "import_module", error)
    assert _kernel._load_kernel.__wrapped__() == (None, reason)


def test_missing_kernel_is_noted_before_a_hunt(monkeypatch):
    scenario = load_scenario("highway")
    assert BACKEND.accelerator.note(scenario) == ""
    monkeypatch.setattr(highway, "find_spec", lambda _: None)
    assert "the kernel of the accelerator is not built. Fix: install a C++ compiler" in BACKEND.accelerator.note(
        scenario
    )
    assert BACKEND.accelerator.note(BACKEND.accelerator.switched_off(scenario)) == ""


def test_kernel_runs_all_substeps_of_an_environment():
    assert not switch_on()
    codes = {IDMVehicle.act.__code__, Vehicle.step.__code__, ControlledVehicle.steering_control.__code__}
    called = []

    def see(frame, event, _):
        if event == "call" and frame.f_code in codes:
            called.append(frame.f_code.co_qualname)

    for name in ("highway-v0", "merge-v1", "roundabout-v1", "intersection-v2"):
        config = {"other_vehicles_type": "highway_env.vehicle.behavior.DefensiveVehicle"} if "high" in name else {}
        env = gymnasium.make(name, config=config).unwrapped
        env.reset(seed=3)
        for action in (0, 1, 2, 1):
            sys.setprofile(see)
            env.step(action)
            sys.setprofile(None)
        # Only the agent decides for itself, once per step.
        assert called.count("IDMVehicle.act") == called.count("Vehicle.step") == 0, name


def network(rng):
    """Lanes of all shapes between a few nodes, so that vehicles change lanes, leave them and choose the next."""
    net = RoadNetwork()
    x, y, nodes = 0.0, 0.0, "abcde"
    for start, end in pairwise(nodes):
        length, width = float(rng.uniform(25, 90)), float(rng.choice([3.0, 4.0, 4.5]))
        kind = rng.integers(3)
        slope = float(rng.choice([0.0, rng.normal() * 5]))
        limit = [None, 20, 30.0][rng.integers(3)]
        for number in range(rng.integers(1, 5)):
            shift = width * number
            first, last = [x, y + shift], [x + length, y + shift + slope]
            forbidden = bool(rng.random() < 0.1)
            if kind == 0:
                lane = StraightLane(first, last, width=width, speed_limit=limit, forbidden=forbidden)
            elif kind == 1:
                swing = (float(rng.uniform(0.2, 3)), float(2 * np.pi / length), float(rng.uniform(0, 6)))
                lane = SineLane(first, last, *swing, width=width, speed_limit=limit, forbidden=forbidden)
            else:
                centre, radius = [x, y - length], length + shift
                turn = bool(rng.random() < 0.5)
                angles = (np.pi / 2, 0.2) if not turn else (-np.pi / 2, 0.7)
                lane = CircularLane(centre, radius, *angles, clockwise=turn, width=width, speed_limit=limit)
            net.add_lane(start, end, lane)
        x, y = x + length, y + slope
    return net


class Cone(RoadObject):
    """An object of a user's that collisions push."""

    def __init__(self, road, position):
        super().__init__(road, position)


LINEAR = (LinearVehicle, AggressiveVehicle, DefensiveVehicle)
KINDS = (IDMVehicle, IDMVehicle, ControlledVehicle, MDPVehicle, Vehicle, BicycleVehicle, *LINEAR)


def crowded(seed):
    """A road with vehicles and objects of all kinds, near each other, some of them about to crash."""
    rng = np.random.default_rng(seed)
    net = network(rng)
    road = Road(net, np_random=np.random.default_rng(seed), neighbour_vehicles_connected_lanes=bool(rng.random() < 0.5))
    for _ in range(rng.integers(2, 25)):
        kind = KINDS[rng.integers(len(KINDS))]
        key = net.random_lane_index(road.np_random)
        lane = net.get_lane(key)
        s = float(rng.uniform(-3, lane.length + 3))
        speed = float(rng.choice([0.0, rng.uniform(0, 15), rng.uniform(10, 45), -3.0]))
        heading = float(lane.heading_at(s) + rng.choice([0.0, rng.normal() * 0.3]))
        made = kind(
            road, lane.position(s, float(rng.normal())), heading, np.float64(speed) if rng.random() < 0.5 else speed
        )
        if kind in (Vehicle, BicycleVehicle):
            number = float if rng.random() < 0.7 else np.float32  # as an action space has it
            made.act({"steering": number(rng.normal() * 0.2), "acceleration": number(rng.normal() * 3)})
        else:
            made.target_speed = float(rng.choice([made.target_speed, rng.uniform(-1, 40)]))
        if isinstance(made, IDMVehicle):
            made.timer = float(rng.uniform(0, 2))
            made.enable_lane_change = bool(rng.random() < 0.9)
            if rng.random() < 0.5:
                made.randomize_behavior()
            if rng.random() < 0.2:
                made.POLITENESS = float(rng.uniform(0, 1))
        if isinstance(made, ControlledVehicle) and rng.random() < 0.4:
            made.plan_route_to(str(rng.choice(list("bcde"))))
            if made.route and rng.random() < 0.5:
                made.route[0] = (*made.route[0][:2], [None, 0, 1][rng.integers(3)])
        made.crashed = bool(rng.random() < 0.05)
        if rng.random() < 0.05:
            made.impact = rng.normal(size=2)
        made.solid = bool(rng.random() < 0.95)
        made.check_collisions, made.collidable = bool(rng.random() < 0.9), bool(rng.random() < 0.9)
        road.vehicles.append(made)
    for _ in range(rng.integers(5)):
        kind = (Obstacle, Landmark, Cone)[rng.integers(3)]
        lane = net.get_lane(net.random_lane_index(road.np_random))
        road.objects.append(kind(road, lane.position(float(rng.uniform(0, lane.length)), 0)))
    return road


def played(seed, steps):
    road, found = crowded(seed), []
    for _ in range(steps):
        try:
            road.act()
            road.step(1 / 15)
        except Exception as error:
            found.append(repr(error))
        found.append(state(road))
    return found


@settings(max_examples=examples(60))
@given(seed=st.integers(0, 2**31))
def test_every_bit_and_type_is_that_of_highway_env_on_random_roads(seed):
    steps = examples(12)  # by day few, because most of what differs on a road does so within four steps
    switch_off()
    slow = played(seed, steps)
    assert not switch_on()
    try:
        fast = played(seed, steps)
    finally:
        switch_off()
    for number, (one, two) in enumerate(zip(slow, fast, strict=True)):
        assert one == two, number


def test_a_polite_driver_makes_way_for_the_one_behind():
    """Which no road of the test above shows, because it takes a gain that another term alone does not have."""

    def chosen():
        road = Road(RoadNetwork.straight_road_network(2), np_random=np.random.default_rng(1))
        for x in (40.0, 25.0):
            road.vehicles.append(IDMVehicle(road, [x, 0.0], 0.0, 20.0, target_speed=20.0, timer=5.0))
        road.vehicles[0].POLITENESS = 0.5
        road.act()
        return road.vehicles[0].target_lane_index

    assert same_either_way(chosen) == ("0", "1", 1)


def grids(seed):
    road = crowded(seed)
    observers = [vehicle for vehicle in road.vehicles if isinstance(vehicle, MDPVehicle)]
    env = SimpleNamespace(road=road, vehicle=observers[0] if observers else None)
    return [exact(observation.compute_ttc_grid(env, 0.5, 6, observer)) for observer in observers]


def test_times_to_collision_are_those_of_highway_env():
    same_either_way(lambda: list(map(grids, range(3))))
    assert _roads.look(crowded(1)) is not None


def conflicts(seed):
    """A road with vehicles whose paths cross; the conflicts that the kernel finds, and those that highway-env finds."""
    road = crowded(seed)
    road.vehicles = [vehicle for vehicle in road.vehicles if isinstance(vehicle, ControlledVehicle)][:8]
    state = _roads.look(road)
    sure = state.traffic.conflicts() if state is not None else None
    if sure is None:
        return None
    pairs = combinations(range(len(road.vehicles)), 2)
    possible = {pair for pair in pairs if RegulatedRoad.is_conflict_possible(*map(road.vehicles.__getitem__, pair))}
    return {pair[:2] for pair in sure if pair[2]}, possible, {pair[:2] for pair in sure}


def test_conflicts_are_those_of_highway_env():
    assert not switch_on()
    found = [both for both in map(conflicts, range(8)) if both is not None]
    assert all(sure <= possible <= all_found for sure, possible, all_found in found)
    # highway-env decides about few pairs, and there are conflicts.
    assert sum(len(possible) for _, possible, _ in found) > 2
    assert sum(len(all_found - sure) for sure, _, all_found in found) <= 2


class Lorry(ControlledVehicle):
    """Without own methods, so that the kernel knows it."""

    LENGTH = 20.0


def crossing(*vehicles):
    """Two lanes from a to b, two on to c, one that crosses them, and two narrow ones beside them.

    Vehicles are given by class, lane, place in m, speed and route.
    """
    net = RoadNetwork()
    for number in range(2):
        net.add_lane("a", "b", StraightLane([0, 4 * number], [20, 4 * number]))
        net.add_lane("b", "c", StraightLane([20, 4 * number], [120, 4 * number]))
    net.add_lane("d", "e", StraightLane([35, -50], [35, 50]))
    for y in (1.7, 1.9):
        net.add_lane("f", "g", StraightLane([20, -y], [120, -y], width=1.0))
    road = RegulatedRoad(net, np_random=np.random.default_rng(1))
    for kind, key, s, speed, route in vehicles:
        lane = net.get_lane(key)
        made = kind(road, lane.position(s, 0), lane.heading_at(s), speed)
        made.lane_index = made.target_lane_index = key
        made.route = route
        road.vehicles.append(made)
    return road


ON = ("b", "c", 0)
ROUTE = [("a", "b", 0), ("b", "c", None)]
CROSSINGS = {
    "on the next part of a route": (
        (ControlledVehicle, ("a", "b", 0), 15.0, 10.0, ROUTE),
        (ControlledVehicle, ("d", "e", 0), 40.0, 5.0, None),
    ),
    "in the own lane of an open part": (
        (ControlledVehicle, ("a", "b", 1), 15.0, 10.0, [("a", "b", 1), ("b", "c", None)]),
        (ControlledVehicle, ("b", "c", 1), 10.0, 0.0, None),
    ),
    "in the other lane of an open part": (
        (ControlledVehicle, ("a", "b", 1), 15.0, 10.0, [("a", "b", 1), ("b", "c", None)]),
        (ControlledVehicle, ("b", "c", 0), 10.0, 0.0, None),
    ),
    "the other is inside": ((Lorry, ON, 20.0, 0.0, None), (ControlledVehicle, ON, 27.5, 0.0, None)),
    "inside the other": ((ControlledVehicle, ON, 24.5, 0.0, None), (Lorry, ON, 20.0, 0.0, None)),
    "side by side": ((ControlledVehicle, ON, 20.0, 0.0, None), (ControlledVehicle, ("f", "g", 0), 20.0, 0.0, None)),
    "side by side, apart": (
        (ControlledVehicle, ON, 20.0, 0.0, None),
        (ControlledVehicle, ("f", "g", 1), 20.0, 0.0, None),
    ),
    "one behind the other": ((Lorry, ON, 20.0, 0.0, None), (ControlledVehicle, ON, 39.5, 0.0, None)),
}


@pytest.mark.parametrize("name", CROSSINGS)
def test_a_conflict_of_two_vehicles_is_that_of_highway_env(name):
    assert not switch_on()
    road = crossing(*CROSSINGS[name])
    expected = RegulatedRoad.is_conflict_possible(*road.vehicles)
    assert _roads.look(road).traffic.conflicts() == ([(0, 1, True)] if expected else [])


def test_vehicles_conflict_in_some_crossings_and_not_in_all():
    found = {name: RegulatedRoad.is_conflict_possible(*crossing(*case).vehicles) for name, case in CROSSINGS.items()}
    assert [name for name in found if not found[name]] == [
        "in the other lane of an open part", "side by side, apart", "one behind the other",
    ]  # fmt: skip


def test_an_error_of_highway_env_leaves_what_highway_env_leaves():
    """A vehicle in the middle of the list has no road ahead, and an unusual part in its route."""

    def broken():
        road = crowded(5)
        for vehicle in road.vehicles:
            if isinstance(vehicle, ControlledVehicle):
                end = vehicle.target_lane_index[1]
                vehicle.route = [(*vehicle.target_lane_index[:2], None), (end, "nothing", 3)]
        found = []
        for _ in range(40):
            try:
                road.act()
                road.step(0.2)
            except Exception as error:
                found.append(repr(error))
            found.append(state(road))
        return found

    logging.getLogger("highway_env").setLevel(logging.ERROR)
    slow = same_either_way(broken)
    assert any("Error" in found for found in slow if isinstance(found, str))


def test_threads_do_not_disturb_each_other():
    slow = [played(seed, 5) for seed in range(8)]
    assert not switch_on()
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(lambda seed: played(seed, 5), range(8))) == slow


def test_two_threads_may_discard_the_same_road(monkeypatch):
    class Discarded(dict):
        def __iter__(self):
            return iter(["discarded by another thread", *super().__iter__()])

    assert not switch_on()
    monkeypatch.setattr(_roads, "_roads", Discarded())
    monkeypatch.setattr(_roads, "_MAX_ROADS", 1)
    roads = [crowded(1), crowded(2)]
    assert all(_roads.look(road) is not None for road in roads)
    assert _roads.cached(roads[0]) is None
    assert _roads.cached(roads[1]) is not None


@pytest.mark.parametrize("watched", ["roads", "observations"])
def test_another_thread_may_switch_the_accelerator_off_meanwhile(watched):
    assert not switch_on()
    road = crowded(1)
    assert _roads.is_intact(watched)
    del _roads.watches[watched]
    assert not _roads.is_intact(watched)
    assert (_roads.look(road) is None) == (watched == "roads")


def test_fork_computes_the_same_bits():
    assert not switch_on()
    road = crowded(4)

    def digest():
        found = []
        for _ in range(4):
            road.act()
            road.step(1 / 15)
            found.append(state(road))
        return hashlib.sha256(repr(found).encode()).digest()

    digest()
    outlet, inlet = os.pipe()
    child = os.fork()
    if not child:
        os.write(inlet, digest())
        os._exit(0)
    os.waitpid(child, 0)
    assert os.read(outlet, 100) == digest()
    os.close(outlet)
    os.close(inlet)


@pytest.mark.parametrize("speed", [-40.0, 40.0, -40.5, 40.5])
def test_an_action_at_the_limit_of_speed_stays(speed):
    def moved():
        road = Road(RoadNetwork.straight_road_network(2), np_random=np.random.default_rng(1))
        for place in (0.0, 300.0):
            road.vehicles.append(Vehicle(road, [place, 0.0], 0.0, speed))
            road.vehicles[-1].act({"steering": 0.0, "acceleration": math.copysign(3.0, speed)})
        road.step(0.1)
        return state(road)

    same_either_way(moved)


def test_another_vehicle_of_equal_speed_has_no_time_to_collision():
    def grid():
        road = Road(RoadNetwork.straight_road_network(2), np_random=np.random.default_rng(1))
        road.vehicles.append(MDPVehicle(road, [0.0, 0.0], 0.0, 25.0))
        road.vehicles.append(IDMVehicle(road, [12.0, 0.0], 0.9, 25.0))  # along the lane, it is slower
        env = SimpleNamespace(road=road, vehicle=road.vehicles[0])
        return exact(observation.compute_ttc_grid(env, 0.5, 6, road.vehicles[0]))

    same_either_way(grid)


def test_linear_vehicle_collects_the_same_data():
    def collected():
        road = Road(RoadNetwork.straight_road_network(2), np_random=np.random.default_rng(1))
        for number, kind in enumerate((*LINEAR, IDMVehicle)):
            road.vehicles.append(kind(road, [20.0 * number, 4.0 * (number % 2)], 0.0, 20.0 + number))
        road.vehicles[0].randomize_behavior()
        road.vehicles[1].collecting_data = False
        for _ in range(20):
            road.act()
            road.step(0.1)
        return [exact(vehicle.data) for vehicle in road.vehicles[:3]], state(road)

    slow = same_either_way(collected)
    _, outputs = slow[0][0]["lateral"]["outputs"]
    assert len(outputs) == 20
    assert slow[0][1] == {}


@pytest.mark.parametrize(
    "change",
    [
        lambda road: setattr(road.vehicles[0], "speed", np.float32(3)),
        lambda road: setattr(road.vehicles[0], "position", np.zeros((1, 2))),
        lambda road: setattr(road.vehicles[0], "heading", math.nan),
        lambda road: setattr(road.vehicles[0], "target_lane_index", ("a", "z", 0)),
        lambda road: setattr(road.vehicles[0], "crashed", 1),
        lambda road: setattr(road.vehicles[0], "impact", [0.0, 0.0]),
        lambda road: setattr(road.vehicles[0], "impact", np.zeros((1, 2))),
        lambda road: setattr(road.vehicles[0], "impact", np.zeros(2, np.float32)),
        lambda road: delattr(road.vehicles[0], "action"),
        lambda road: setattr(road.vehicles[0], "action", {"steering": 0}),
        lambda road: setattr(road.vehicles[0], "route", [["a", "b", 0]]),
        lambda road: setattr(road.vehicles[0], "position", road.vehicles[1].position),
        lambda road: setattr(road.vehicles[0], "action", road.vehicles[1].action),
        lambda road: road.objects.append(IDMVehicle(road, [15.0, 0.0], 0.0, 10.0)),
        lambda road: setattr(road, "record_history", True),
        lambda road: setattr(road.vehicles[0], "MAX_SPEED", np.float64(30)),
    ],
)
def test_what_is_unusual_is_refused_at_once(change):
    assert not switch_on()
    road = crowded(11)
    road.vehicles.insert(0, IDMVehicle(road, [5.0, 0.0], 0.0, 10.0))
    assert _roads.prepared(road).roster() is not None
    change(road)
    assert _roads.prepared(road).roster() is None


def kinematic(rng):
    """A random observation of this kind, without its road."""
    features = list(
        rng.permutation(["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h"])[: rng.integers(1, 9)]
    )
    truths = ("absolute", "normalize", "clip", "see_behind", "include_obstacles", "observe_intentions")
    given = {name: bool(rng.random() < 0.5) for name in truths}
    if rng.random() < 0.5:
        given["features_range"] = {"x": [-100, 80], "vy": [-9.5, 9.5], "heading": [-np.pi, np.pi], "other": [0, 1]}
    return {**given, "features": list(map(str, features)), "vehicles_count": int(rng.integers(1, 9)),
            "order": str(rng.choice(["sorted", "shuffled"]))}  # fmt: skip


def observed(seed):
    """What every vehicle of a road sees."""
    road, rng = crowded(seed), np.random.default_rng(seed)
    for vehicle in road.vehicles[::3]:
        if isinstance(vehicle, ControlledVehicle):
            vehicle.route = [[], [("a", "b", 0), ("b", "c", None)]][rng.integers(2)]
    if seed == 3:
        road.vehicles[-1].route = [("a", "nowhere", 0)]
    found = []
    for vehicle in road.vehicles[:6]:
        env = SimpleNamespace(road=road, vehicle=vehicle, PERCEPTION_DISTANCE=200, np_random=np.random.default_rng(1))
        seen = observation.KinematicObservation(env, **kinematic(rng))
        try:
            found.append((exact(seen.observe()), seen.features_range))
        except Exception as error:
            found.append(repr(error))
    return found


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_observations_of_the_kernel_have_the_bits_of_highway_env(monkeypatch):
    slow = [observed(seed) for seed in range(4)]
    assert not switch_on()
    others = []
    close = _switch.close_objects
    monkeypatch.setattr(
        _switch, "close_objects", lambda *given, **options: others.append(1) or close(*given, **options)
    )
    assert [observed(seed) for seed in range(4)] == slow
    assert len(others) < sum(map(len, slow)) / 2  # seen by highway-env, or without the kernel


def test_search_for_close_objects_of_a_users_road_is_called():
    class Blind(Road):
        def close_objects_to(self, *given, **options):
            return []

    assert not switch_on()
    road = Blind(RoadNetwork.straight_road_network(2), np_random=np.random.default_rng(1))
    road.vehicles += [IDMVehicle(road, [12.0 * number, 0.0], 0.0, 20.0) for number in range(3)]
    env = SimpleNamespace(road=road, vehicle=road.vehicles[0], PERCEPTION_DISTANCE=200)
    assert not observation.KinematicObservation(env).observe()[1:].any()


def test_poses_in_a_scene_are_those_of_python():
    vehicles = crowded(3).vehicles
    halves = [1.1 + number for number in range(len(vehicles))]
    found = _kernel.kernel().mirrored_poses(vehicles, halves)
    for vehicle, half, point, heading, speed in zip(vehicles, halves, *found, strict=True):
        (x, y), angle = vehicle.position.tolist(), float(vehicle.heading)
        expected = (x + half * math.cos(angle), 0.0 - (y + half * math.sin(angle)))
        assert (point, heading, speed) == (expected, 0.0 - angle, float(vehicle.speed))
        assert {type(number) for number in (*point, heading, speed)} == {float}
    vehicles[1].heading = np.float32(1)
    assert _kernel.kernel().mirrored_poses(vehicles, halves) is None
    vehicles[1].heading = math.inf  # Python's cosine raises an error
    assert _kernel.kernel().mirrored_poses(vehicles, halves) is None


def test_point_on_the_axis_has_no_negative_zero():
    road = Road(RoadNetwork.straight_road_network(1))
    points, headings, _ = _kernel.kernel().mirrored_poses([Vehicle(road, [3.0, 0.0], 0.0, 1.0)], [2.5])
    assert (points[0][1].hex(), headings[0].hex()) == ((0.0).hex(), (0.0).hex())


def test_neighbours_at_the_same_distance_stay_in_order_and_objects_behind_are_not_seen():
    def seen():
        road = Road(RoadNetwork.straight_road_network(4), np_random=np.random.default_rng(1))
        road.vehicles += [IDMVehicle(road, [0.0, 4.0], 0.0, 20.0)]
        road.vehicles += [IDMVehicle(road, [20.0 * (-1) ** n, 4.0 * (n % 4)], 0.0, 10.0 + n) for n in range(24)]
        road.objects += [Obstacle(road, [12.0, 8.0], 0.3, 5.0), Obstacle(road, [-15.0, 8.0])]
        env = SimpleNamespace(road=road, vehicle=road.vehicles[0], PERCEPTION_DISTANCE=200)
        return exact(observation.KinematicObservation(env, vehicles_count=20, see_behind=True).observe())

    same_either_way(seen)
