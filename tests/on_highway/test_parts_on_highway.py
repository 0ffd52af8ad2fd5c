"""Parts of the simulator highway-env without an episode: disturbances, scenes, recorded paths and configurations."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

# First: this imports highway-env without what takes most of that time.
from crashhunt.highway import HighwaySimulator

# isort: split

from highway_env.road.lane import StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle

from crashhunt.base.errors import InvalidEpisodeError, ScenarioError
from crashhunt.highway import (
    _config,
    _disturbances,
    _lanes_and_contacts as _scene,
    _scripted,
    _simulator,
    _surroundings,
)
from crashhunt.highway._descriptor import HighwaySetup
from crashhunt.highway._disturbances import HighwayDisturbances
from crashhunt.highway._lanes_and_contacts import HighwayEvents, VehicleFilter
from crashhunt.highway._surroundings import surroundings_of
from crashhunt.scenario import AgentSetup, ArgumentSetup, Scenario
from crashhunt.trial import ALL_AGENTS, Disturbance
from crashhunt.world import Actor, ActorState

assert HighwaySimulator
DT = 0.5


def straight(lanes=3, kind=Road, length=1000):
    return kind(RoadNetwork.straight_road_network(lanes, length=length), np_random=np.random.default_rng(1))


def put(road, x, lane, speed=20.0, kind=IDMVehicle):
    made = kind(road, [x, 4.0 * lane], 0.0, speed)
    made.lane_index = made.target_lane_index = ("0", "1", lane)
    made.lane = road.network.get_lane(made.lane_index)
    road.vehicles.append(made)
    return made


def fake(speed=10.0, acceleration=1.0, **more):
    """A vehicle that has decided on an acceleration."""
    given = {"speed": speed, "action": {"acceleration": acceleration, "steering": 0.0}, "crashed": False,
             "target_speed": 12.0, "enable_lane_change": True, "lane_index": "here",
             "target_lane_index": "there"}  # fmt: skip
    return SimpleNamespace(**{**given, **more})


def released(make):
    """A disturbance, and what it releases at its end."""
    gone = []
    return make(gone.append), gone


# Disturbances.


@pytest.mark.parametrize(
    ("speed", "decided", "target", "found"),
    [
        (10.0, 1.0, 0.0, -3.0), (10.0, -5.0, 0.0, -5.0), (1.0, 1.0, 0.0, -2.0), (0.0, 1.0, 0.0, 0.0),
        (-1.0, 1.0, 0.0, 0.0), (10.0, 1.0, 9.0, -2.0), (9.0, 1.0, 9.0, 0.0), (8.75, 1.0, 9.0, 0.5),
        (7.0, 1.0, 9.0, 1.0), (7.0, -1.0, 9.0, -1.0),
    ],
)  # fmt: skip
def test_vehicle_brakes_to_its_target_and_keeps_it(speed, decided, target, found):
    vehicle = fake(speed, decided)
    made, gone = released(lambda release: _disturbances._Slows(vehicle, release, 4.0, 3.0, target=target))
    made.override(DT)
    assert vehicle.action == {"acceleration": found, "steering": 0.0}
    assert (made.how_strong, made.vehicle) == (4.0, vehicle)
    made.keep(), made.after()
    assert gone == []
    made.end()
    assert gone == [made]


def test_desired_speed_is_raised_by_a_share_and_put_back():
    vehicle = fake()
    made, gone = released(lambda release: _disturbances._Speeds(vehicle, release, 0.25))
    assert (vehicle.target_speed, made.how_strong) == (15.0, 0.25)
    made.override(DT)
    made.end()
    assert (vehicle.target_speed, vehicle.action["acceleration"], gone) == (12.0, 1.0, [made])


def test_vehicle_cuts_in_as_soon_as_it_can_and_brakes_there(monkeypatch):
    changes = []
    monkeypatch.setattr(_disturbances, "_change", lambda *given: changes.append(given))
    for strong, braked in ((3.0, -3.0), (0.0, 1.0)):
        vehicle = fake()
        made, gone = released(
            lambda release, vehicle=vehicle, strong=strong: _disturbances._CutsIn(vehicle, release, strong, "new")
        )
        assert vehicle.enable_lane_change is False
        assert changes == [(vehicle, "new")]
        made.override(DT)
        assert len(changes) == 2
        vehicle.target_lane_index = "new"
        made.override(DT)
        assert (len(changes), vehicle.action["acceleration"]) == (2, 1.0)
        vehicle.lane_index = "new"
        made.override(DT)
        assert vehicle.action["acceleration"] == braked
        made.end()
        assert (vehicle.enable_lane_change, gone) == (True, [made])
        changes.clear()


def test_holds_keep_the_speed_and_the_lane():
    vehicle = fake(speed=np.float64(10.0))
    made, _ = released(lambda release: _disturbances._KeepsSpeed(vehicle, release, 1.0))
    vehicle.speed = 8.0
    made.override(DT)
    assert vehicle.action["acceleration"] == 4.0
    made, gone = released(lambda release: _disturbances._KeepsLane(vehicle, release, 1.0))
    assert (vehicle.enable_lane_change, vehicle.target_lane_index) == (False, "here")
    made.end()
    assert (vehicle.enable_lane_change, gone) == (True, [made])


def test_vehicle_merges_when_little_is_left_of_its_lane(monkeypatch):
    changes, left = [], [30.0]
    monkeypatch.setattr(_disturbances, "_change", lambda *given: changes.append(given))
    monkeypatch.setattr(_disturbances, "_distance_to_lane_end", lambda vehicle: left[0])
    vehicle = fake(lane_index=("a", "b", 2), target_lane_index=("a", "b", 2))
    made, gone = released(lambda release: _disturbances._MergesLate(vehicle, release, 20.0))
    for now, count in ((30.0, 0), (20.1, 0), (20.0, 1), (5.0, 2)):
        left[0] = now
        made.override(DT)
        assert len(changes) == count
    assert changes[0] == (vehicle, ("a", "b", 1))
    vehicle.target_lane_index = ("a", "b", 1)
    made.override(DT)
    assert len(changes) == 2
    made.end()
    assert (vehicle.enable_lane_change, gone) == (True, [made])


def test_right_of_way_is_ignored_whenever_a_vehicle_would_yield():
    vehicle = fake(is_yielding=True, color="yellow", lane=SimpleNamespace(speed_limit=13.0))
    made, _ = released(lambda release: _disturbances._Ignores(vehicle, release, 1.0))
    assert (vehicle.is_yielding, vehicle.target_speed) == (False, 13.0)
    assert not hasattr(vehicle, "color")
    vehicle.target_speed = 5.0
    made.after()
    assert vehicle.target_speed == 5.0
    vehicle.is_yielding, vehicle.color = True, "yellow"
    made.after()
    assert vehicle.target_speed == 13.0


@pytest.mark.parametrize(
    ("ahead", "behind", "changes"),
    [(None, None, True), (5.0, None, False), (5.1, None, True), (None, -5.0, False), (None, -5.1, True),
     (30.0, -2.0, False)],
)  # fmt: skip
def test_lane_is_changed_where_no_vehicle_overlaps(ahead, behind, changes):
    others = [None if place is None else SimpleNamespace(LENGTH=6.0, place=place) for place in (ahead, behind)]
    asked = []
    road = SimpleNamespace(neighbour_vehicles=lambda *given: asked.append(given) or others)
    vehicle = fake(road=road, LENGTH=4.0, lane_distance_to=lambda other: other.place)
    _disturbances._change(vehicle, "new")
    assert vehicle.target_lane_index == ("new" if changes else "there")
    assert asked == [(vehicle, "new")]


def planned(what, who="ahead", strong=3.0):
    return Disturbance(1, who, what, strong, 2.0, "ego")


def test_disturbances_of_a_vehicle_are_made_within_what_it_can():
    road = straight()
    agent, other = put(road, 100.0, 1), put(road, 120.0, 0)
    made = HighwayDisturbances(road, [agent])
    assert not made.is_active
    for what, strong, how_strong, deceleration, target in (
        ("brake", 3.0, 3.0, 3.0, 0.0), ("stop", 9.0, 6.0, 6.0, 0.0), ("dawdle", 0.25, 0.25, 1.5, 15.0),
        ("dawdle", 1.5, 1.5, 1.5, 0.0),
    ):  # fmt: skip
        found = made.disturb(other, planned(what, strong=strong), agent)
        assert (found.how_strong, found._deceleration, found._target) == (how_strong, deceleration, target)
        assert made.is_active
        found.end()
        assert not made.is_active
    faster = made.disturb(other, planned("speed", strong=0.5), agent)
    assert (type(faster).__name__, other.target_speed) == ("_Speeds", 30.0)
    assert type(made.disturb(other, planned("ignore_priority"), agent)).__name__ == "_Ignores"
    assert made.disturb(other, planned("late_merge", strong=15.0), agent) is None  # its lane does not end
    cut = made.disturb(other, planned("cut_in", "left ahead", 9.0), agent)
    assert (cut.how_strong, other.target_lane_index) == (6.0, agent.lane_index)
    assert made.disturb(other, planned("cut_in"), agent) is None  # it is changing lanes already
    other.lane_index = other.target_lane_index = agent.lane_index
    assert made.disturb(other, planned("cut_in"), agent) is None
    other.lane_index = other.target_lane_index = ("x", "y", 0)
    assert made.disturb(other, planned("cut_in"), agent) is None


def test_overrides_are_those_of_vehicles_that_have_not_crashed():
    made, calls = HighwayDisturbances(straight(), []), []
    for crashed in (False, True):
        vehicle = SimpleNamespace(crashed=crashed)
        made._active.append(SimpleNamespace(
            vehicle=vehicle, override=lambda dt, crashed=crashed: calls.append((crashed, dt)),
            after=lambda crashed=crashed: calls.append((crashed, "after")),
        ))  # fmt: skip
    made.before_moving(0.25)
    made.after_moving()
    assert calls == [(False, 0.25), (False, "after"), (True, "after")]


def test_holds_are_those_of_vehicles_that_drive_by_themselves():
    road = straight()
    other, walker = put(road, 120.0, 0), put(road, 150.0, 0, kind=Vehicle)
    made = HighwayDisturbances(road, [])
    assert made.hold(walker, "keep_lane") is made.hold(None, "gone") is None
    for what, kind in (("keep_speed", "_KeepsSpeed"), ("keep_lane", "_KeepsLane")):
        found = made.hold(other, what)
        assert (type(found).__name__, found.how_strong, made.is_active) == (kind, 1.0, True)
        found.end()
        assert not made.is_active
    away = made.hold(other, "gone")
    assert (road.vehicles, made.is_active, away.how_strong) == ([walker], False, 1.0)
    away.end()


@pytest.mark.parametrize(
    ("x", "lane", "who"),
    [
        (130.0, 1, "ahead"), (70.0, 1, "behind"), (200.0, 1, "ahead"), (201.0, 1, ""), (0.0, 1, "behind"),
        (130.0, 0, "left ahead"), (130.0, 2, "right ahead"), (70.0, 0, "left behind"), (104.9, 0, "left"),
        (105.0, 0, "left ahead"), (95.1, 2, "right"), (95.0, 2, "right behind"), (150.0, 0, "left ahead"),
        (151.0, 0, ""), (50.0, 2, "right behind"), (49.0, 2, ""), (101.0, 1, "ahead"),
    ],
)  # fmt: skip
def test_place_around_an_agent_is_along_its_lanes(x, lane, who):
    road = straight()
    agent = put(road, 100.0, 1, kind=ControlledVehicle)
    other = put(road, x, lane)
    made = HighwayDisturbances(road, [agent])
    places = [place for place in ("ahead", "behind", "left", "right", "left ahead", "left behind", "right ahead",
                                  "right behind") if made.at(agent, place) is other]  # fmt: skip
    assert places == ([who] if who else [])
    assert HighwayDisturbances(road, [agent, other]).at(agent, who or "ahead") is None
    assert made.resolve_target(agent, planned("brake", who or "ahead")) is (other if who else None)


def test_place_has_the_nearest_vehicle_on_a_lane_that_exists():
    road = straight(lanes=2)
    agent = put(road, 100.0, 0, kind=ControlledVehicle)
    put(road, 140.0, 1)
    near = put(road, 120.0, 1)
    made = HighwayDisturbances(road, [agent])
    assert made.at(agent, "right ahead") is near
    assert made.at(agent, "left ahead") is None
    put(road, 112.0, 1, kind=Vehicle)  # it does not drive by itself
    assert made.at(agent, "right ahead") in (near, None)
    agent.lane_index = ("0", "1", 1)
    assert made.at(agent, "right ahead") is None


def crossing():
    """Two roads that cross at the origin, each in two parts, and a side road."""
    network = RoadNetwork()
    network.add_lane("w", "c", StraightLane([-100, 0], [0, 0]))
    network.add_lane("c", "e", StraightLane([0, 0], [100, 0]))
    network.add_lane("s", "x", StraightLane([20, -100], [20, 100]))
    network.add_lane("c", "n", StraightLane([0, 0], [0, 50]))
    network.add_lane("p", "q", StraightLane([-100, 3], [100, 3]))
    return RegulatedRoad(network, np_random=np.random.default_rng(1))


def on(road, start, end, s, kind=IDMVehicle):
    lane = road.network.get_lane((start, end, 0))
    made = kind(road, lane.position(s, 0), lane.heading_at(s), 10.0)
    made.lane_index = made.target_lane_index = (start, end, 0)
    made.lane = lane
    road.vehicles.append(made)
    return made


def test_lanes_ahead_end_at_a_fork_without_a_route():
    road = crossing()
    vehicle = on(road, "w", "c", 50.0)
    ahead = lambda index=None: [lane[:2] for lane in _disturbances.lanes_ahead(road.network, vehicle, index)]  # noqa: E731
    assert ahead() == [("w", "c")]
    vehicle.route = [("w", "c", 0), ("c", "n", 0)]
    assert ahead() == [("w", "c"), ("c", "n")]
    vehicle.route = [("w", "c", 0), ("c", "nowhere", 0)]
    assert ahead() == [("w", "c")]
    assert ahead(("c", "e", 0)) == [("c", "e")]
    plain = on(road, "w", "c", 50.0, kind=Vehicle)
    assert [lane[:2] for lane in _disturbances.lanes_ahead(road.network, plain)] == [("w", "c")]
    network = RoadNetwork()
    for number in range(3):
        network.add_lane("a", "b", StraightLane([0, 4 * number], [50, 4 * number]))
    for number in range(2):
        network.add_lane("b", "a", StraightLane([50, 4 * number], [0, 4 * number]))
    road = Road(network, np_random=np.random.default_rng(1))
    round_trip = IDMVehicle(road, [10.0, 8.0], 0.0, 10.0)
    round_trip.lane_index = ("a", "b", 2)
    assert list(_disturbances.lanes_ahead(network, round_trip)) == [("a", "b", 2), ("b", "a", 1)]


@pytest.mark.parametrize(
    ("one", "two", "route", "crossed"),
    [
        (("w", "c", 50.0), ("s", "x", 50.0), "e", True), (("w", "c", 50.0), ("s", "x", 50.0), "n", False),
        (("w", "c", 50.0), ("s", "x", 130.0), "e", False), (("w", "c", 50.0), ("c", "e", 5.0), "e", False),
        (("w", "c", 10.0), ("s", "x", 50.0), "e", False), (("w", "c", 50.0), ("p", "q", 50.0), "e", False),
        (("w", "c", 50.0), ("s", "x", 10.0), "e", False),
    ],
)  # fmt: skip
def test_paths_cross_within_their_reach(one, two, route, crossed):
    """Of 80 m each; roads that are parallel, and vehicles on the same path, do not cross."""
    road = crossing()
    agent, other = on(road, *one), on(road, *two)
    agent.route = [("w", "c", 0), ("c", route, 0)]
    assert _disturbances.crosses(road.network, agent, other) is crossed
    assert _disturbances.crosses(road.network, other, agent) is crossed


def test_path_of_a_vehicle_has_a_point_every_2_m_for_80_m():
    road = straight()
    vehicle = put(road, 101.0, 1)
    roads, points = _disturbances._way(road.network, vehicle)
    assert roads == {("0", "1")}
    assert points[:, 0].tolist() == [101.0, *range(101, 181, 2)]
    assert set(points[:, 1]) == {4.0}
    road = crossing()
    turning = on(road, "w", "c", 97.0)
    turning.route = [("w", "c", 0), ("c", "n", 0)]
    roads, points = _disturbances._way(road.network, turning)
    assert roads == {("w", "c"), ("c", "n")}
    assert points[:5].tolist() == [[-3.0, 0.0], [-3.0, 0.0], [-1.0, 0.0], [0.0, 0.0], [0.0, 2.0]]
    assert points[-1].tolist() == [0.0, 48.0]  # the end of the road


def test_crossing_vehicle_is_the_nearest_on_a_road_with_rules():
    road = crossing()
    agent = on(road, "w", "c", 80.0)
    agent.route = [("w", "c", 0), ("c", "e", 0)]
    far, near = on(road, "s", "x", 40.0), on(road, "s", "x", 60.0)
    made = HighwayDisturbances(road, [agent])
    found = {who: made.resolve_target(agent, planned("ignore_priority", who)) for who in ("left ahead", "right ahead")}
    assert found == {"left ahead": near, "right ahead": None}  # y points down
    assert HighwayDisturbances(road, [agent, near])._crossing(agent, "left ahead") is far
    near.position[1] = -79.0
    far.position[1] = -99.0
    assert made._crossing(agent, "left ahead") is None  # further than 80 m
    road.__class__ = Road
    assert made._crossing(agent, "left ahead") is None


@pytest.mark.parametrize(
    ("number", "after", "ends"),
    [(2, [2], True), (1, [2], False), (2, [3], False), (2, [3, 2], True), (0, [0], False), (2, [], False)],
)
def test_lane_ends_where_a_following_road_has_no_lane_of_its_number(number, after, ends):
    network = RoadNetwork()
    for place in range(3):
        network.add_lane("a", "b", StraightLane([0, 4 * place], [100, 4 * place]))
    graph = {f"c{index}": [None] * count for index, count in enumerate(after)}
    network.graph["b"] = graph
    road = Road(network, np_random=np.random.default_rng(1))
    vehicle = SimpleNamespace(lane_index=("a", "b", number), lane=network.get_lane(("a", "b", number)),
                              position=np.array([70.0, 4.0 * number]))  # fmt: skip
    found = HighwayDisturbances(road, [])._left_of_lane(vehicle)
    assert found == (pytest.approx(30.0) if ends else None)


# Scenes.


@pytest.mark.parametrize("turn", [0.0, 1.0, -2.0])
@pytest.mark.parametrize(
    ("x", "y", "heading", "gap"),
    [(10.0, 0.0, 0.0, 5.0), (0.0, 5.0, 0.0, 3.0), (10.0, 0.0, math.pi / 2, 6.5), (8.0, 5.0, 0.0, math.hypot(3.0, 3.0)),
     (2.0, 1.0, 0.0, 0.0)],
)  # fmt: skip
def test_gap_is_between_the_outlines_of_two_objects(turn, x, y, heading, gap):
    road = straight()
    c, s = math.cos(turn), math.sin(turn)
    one = Vehicle(road, [7.0, 3.0], turn, 1.0)
    two = Vehicle(road, [7.0 + x * c - y * s, 3.0 + x * s + y * c], turn + heading, 1.0)
    assert _scene.gap(one, two) == pytest.approx(gap)
    assert _scene.gap(two, one) == pytest.approx(gap)


def test_lanes_have_points_at_most_2_m_apart_where_they_are_curved():
    from highway_env.road.lane import CircularLane

    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0, 4], [50, 4], width=3.5))
    network.add_lane("b", "c", CircularLane([0, 0], 10.0, 0.0, 1.0))
    network.add_lane("c", "d", CircularLane([0, 0], 1.0, 0.0, 0.5))
    straight_lane, bend, short = _scene.lanes_of(network, lambda index: "-".join(map(str, index)))
    assert (straight_lane.id, straight_lane.width, straight_lane.shape) == ("a-b-0", 3.5, ((0.0, -4.0), (50.0, -4.0)))
    assert (bend.id, len(bend.shape), len(short.shape)) == ("b-c-0", 6, 2)
    assert bend.shape[0] == pytest.approx((10.0, 0.0))
    assert bend.shape[-1] == pytest.approx((10.0 * math.cos(1.0), -10.0 * math.sin(1.0)))


def touched(*others, heading=0.0, speed=10.0):
    """The contact of an agent at the origin with others: x, class, whether crashed, and speed."""
    road = straight()
    agent = Vehicle(road, [0.0, 0.0], heading, speed)
    things = [agent]
    for x, kind, crashed, speed in others:
        things.append(kind(road, [x, 0.0], 0.0, speed))
        things[-1].crashed = crashed
    names = {id(thing): f"o{number}" for number, thing in enumerate(things)}
    return _scene.contact_of("ego", agent, things, lambda thing: SimpleNamespace(id=names[id(thing)]), "lane")


def test_contact_is_with_the_nearest_crashed_object():
    found = touched((9.0, Vehicle, True, 3.0), (6.0, Vehicle, True, 4.0), (5.0, Vehicle, False, 5.0))
    assert (found.collider, found.victim, found.kind, found.lane) == ("ego", "o2", "crashed", "lane")
    assert (found.collider_speed, found.victim_speed) == (10.0, 4.0)
    behind = touched((-6.0, Vehicle, True, 30.0))
    assert (behind.collider, behind.victim, behind.collider_speed, behind.victim_speed) == ("o1", "ego", 30.0, 10.0)
    turned = touched((-6.0, Vehicle, True, 30.0), heading=math.pi)
    assert turned.collider == "ego"
    wall = touched((-6.0, Obstacle, False, 0.0))  # which is hit even from behind
    assert (wall.collider, wall.victim) == ("ego", "o1")
    alone = touched((6.0, Vehicle, False, 4.0))
    assert (alone.collider, alone.victim, alone.collider_speed) == ("ego", "", 10.0)
    assert math.isnan(alone.victim_speed)


@pytest.mark.parametrize(
    ("x", "speed", "its_speed", "collider"),
    [
        (-6.0, -9.0, 0.0, "ego"),  # it reverses into a vehicle that is parked
        (-6.0, -9.0, 2.0, "o1"),  # both approach, and the other one with its front
        (-6.0, -9.0, -2.0, "ego"),  # it reverses faster than the other one
        (-6.0, 0.0, 2.0, "o1"),
        (6.0, 0.0, -2.0, "o1"),  # the other one reverses into a vehicle that stands
        (6.0, 0.0, 0.0, "ego"),
        (6.0, 10.0, -2.0, "ego"),
    ],
)
def test_actor_that_stands_or_moves_away_does_not_drive_into_the_other(x, speed, its_speed, collider):
    found = touched((x, Vehicle, True, its_speed), speed=speed)
    assert found.collider == collider
    assert found.collider_speed == (speed if collider == "ego" else its_speed)


@pytest.mark.parametrize(
    ("stay", "left"), [((), ["b", "wall"]), (("b",), ["wall"]), (("wall", "b"), []), ((ALL_AGENTS,), [])]
)
def test_excluded_objects_are_removed_once_they_have_entered(stay, left):
    names = ["ego", "b", "wall"]
    road = SimpleNamespace(vehicles=["ego", "b"], objects=["wall", "mark"])
    made = VehicleFilter(road, stay, ["ego"], lambda: names, lambda thing: SimpleNamespace(id=thing))
    assert made.remove() is bool(left)
    assert road.vehicles == [name for name in ("ego", "b") if name not in left]
    assert road.objects == [name for name in ("wall", "mark") if name not in left]
    assert made.entered == ["b", "wall"]
    names[:] = ["ego", "late"]
    road.vehicles.append("late")
    assert made.remove() is (ALL_AGENTS not in stay)
    assert made.entered == ["b", "wall", "late"]
    assert ("late" in road.vehicles) == (ALL_AGENTS in stay)


@pytest.mark.parametrize(
    ("heading", "speed", "how"),
    [
        (0.0, 10.0, ""), (math.pi, 10.0, "the wrong way"), (0.0, -10.0, "backwards"), (math.pi, -10.0, ""),
        (2.09, 10.0, ""), (2.10, 10.0, "the wrong way"), (math.pi, 0.09, ""), (math.pi, 0.1, "the wrong way"),
    ],
)  # fmt: skip
def test_driving_against_the_lane_is_an_event_while_it_lasts(heading, speed, how):
    vehicle = SimpleNamespace(
        speed=speed, heading=heading + 0.5, position=np.array([3.0, 4.0]),
        lane=SimpleNamespace(local_coordinates=lambda position: (7.0, 0.0), heading_at={7.0: 0.5}.__getitem__),
    )  # fmt: skip
    for lanes_are_road in (True, False):
        made = HighwayEvents(0.5, {}, lanes_are_road=lanes_are_road)
        found = list(made.look("ego", vehicle, (1.0, 2.0), "a_b_0"))
        if how and lanes_are_road:
            ((event),) = found
            assert (event.kind, event.what) == ("wrong_way", f"ego drove {how} on lane a_b_0")
            assert (event.x, event.y, event.speed, event.lane, event.others) == (1.0, 2.0, speed, "a_b_0", ())
            assert list(made.look("ego", vehicle, (1.0, 2.0), "a_b_0")) == []
            vehicle.speed, before = -speed, vehicle.speed
            list(made.look("ego", vehicle, (1.0, 2.0), "a_b_0"))
            vehicle.speed = before
            assert len(list(made.look("ego", vehicle, (1.0, 2.0), "a_b_0"))) == 1
        else:
            assert found == []
    still = HighwayEvents(0.5, {"not_moving": 1.0}, lanes_are_road=True)
    vehicle.speed, vehicle.heading = 0.0, 0.5
    events = [[event.what for event in still.look("ego", vehicle, (1.0, 2.0), "a")] for _ in range(3)]
    assert events == [[], ["ego had stood still for 1 s"], []]


# Recorded paths.


class Recorded:
    """A path to the east, 2 m a step, that turns round after its second step."""

    def __init__(self, name="vehicle.1", first=0, last=3):
        self.actor = Actor(name, "Vehicle", 6.0, 2.5, 0.0)
        self.first, self.last = first, last
        self.states = [self.at(0, 1.0)]

    def at(self, steps, step_length_s):
        return ActorState(2.0 * steps, 1.0, 3.0 if steps < 2 else -3.0, 4.0 + steps)


def test_recorded_vehicle_is_between_its_states_in_a_sub_step():
    road = straight()
    puppet = _scripted.Puppet(road, Recorded(), 4, 1.0)
    assert (puppet.LENGTH, puppet.WIDTH, puppet.shown, puppet.route) == (6.0, 2.5, Recorded().at(0, 1.0), None)
    expected = (0.0 - 3.0 * math.cos(3.0), -(1.0 - 3.0 * math.sin(3.0)))
    assert puppet.position.tolist() == pytest.approx(expected)
    assert (puppet.heading, puppet.speed) == (-3.0, 4.0)
    puppet.act("FASTER")
    for number in range(1, 5):
        puppet.step(0.25)
        assert puppet.shown.x == 0.5 * number
        assert puppet.shown.speed == 4.0 + number / 4
    for _ in range(2):
        puppet.step(0.25)
    turned = math.remainder(puppet.shown.heading, math.tau)
    assert abs(turned) == pytest.approx(math.pi)  # the short way round
    puppet.begin(3)
    assert puppet.shown == Recorded().at(3, 1.0)
    puppet.impact = np.array([1.0, 1.0])
    puppet.step(0.25)
    assert (puppet.crashed, puppet.impact) == (True, None)
    places, headings = puppet.predict_trajectory_constant_speed(np.array([0.0, 2.0]))
    assert places[0].tolist() == puppet.position.tolist()
    assert places[1].tolist() == pytest.approx((puppet.position + 2.0 * puppet.velocity).tolist())
    assert headings == [puppet.heading] * 2


def test_recorded_actors_are_on_the_road_while_they_were_recorded():
    road = straight()
    agent = put(road, 50.0, 1, kind=MDPVehicle)
    put(road, 90.0, 1)
    road.objects += [Landmark(road, [9.0, 9.0]), Obstacle(road, [99.0, 9.0])]
    begins = Recorded("ego")
    script = SimpleNamespace(
        steps=5, time_s=0.0, agents=[begins],
        others=[Recorded("vehicle.1", 0, 2), Recorded("vehicle.2", 2, 5), Recorded("obstacle.1", 0, 5)],
    )  # fmt: skip
    made = _scripted.Puppets(road, script, {"ego": agent}, 4, 1.0)

    def there():
        known = {id(thing): actor.id for thing, actor in made.actors}
        return [known.get(id(thing), type(thing).__name__) for thing in (*road.vehicles, *road.objects)]

    assert there() == ["MDPVehicle", "vehicle.1", "Landmark", "obstacle.1"]
    assert agent.position.tolist() == pytest.approx((-2.5 * math.cos(3.0), -(1.0 - 2.5 * math.sin(3.0))))
    made.enter(2)
    assert there() == ["MDPVehicle", "vehicle.1", "vehicle.2", "Landmark", "obstacle.1"]
    entered = next(thing for thing, actor in made.actors if actor.id == "vehicle.2")
    assert entered.shown == Recorded().at(2, 1.0)
    made.enter(3)
    assert there() == ["MDPVehicle", "vehicle.2", "Landmark", "obstacle.1"]
    made.enter(9)  # what was there in the end stays
    assert there() == ["MDPVehicle", "vehicle.2", "Landmark", "obstacle.1"]
    wall = next(thing for thing, actor in made.actors if actor.id == "obstacle.1")
    assert (wall.LENGTH, wall.WIDTH, wall.diagonal) == (6.0, 2.5, math.hypot(6.0, 2.5))
    begins.first = 1
    with pytest.raises(InvalidEpisodeError, match="the start position of 'ego' is unknown"):
        _scripted.Puppets(road, script, {"ego": agent}, 4, 1.0)


def test_agent_of_a_late_start_keeps_its_lane_and_speed():
    road = straight()
    state = ActorState(102.5, -4.0, 0.0, 23.0)
    for late in (False, True):
        agent = put(road, 50.0, 2, kind=MDPVehicle)
        agent.route = [("x", "0", 0), ("0", "1", 2), ("1", "y", 0)]
        agent.target_speed = 30.0
        _scripted._set_pose(agent, state, late=late)
        assert (agent.position.tolist(), agent.speed, agent.lane_index) == ([100.0, 4.0], 23.0, ("0", "1", 1))
        if late:
            assert (agent.target_lane_index, agent.target_speed) == (agent.lane_index, 25.0)
            assert agent.route == [("0", "1", 2), ("1", "y", 0)]
            assert agent.speed_index == 1
        else:
            assert (agent.target_lane_index, agent.target_speed) == (("0", "1", 2), 30.0)
    plain = put(road, 50.0, 2, kind=ControlledVehicle)
    _scripted._set_pose(plain, state, late=True)
    assert (plain.target_speed, plain.target_lane_index, plain.route) == (23.0, ("0", "1", 1), None)
    assert _scripted._remaining_route([], ("0", "1", 1)) is None
    assert _scripted._remaining_route([("a", "b", 0)], ("0", "1", 1)) == [("a", "b", 0)]


# Configurations.


def scenario(agents=1, arguments=None, **config):
    return Scenario(
        simulator="highway", tables={"highway": HighwaySetup(id="highway-v0", config=config)},
        agents={f"a{number}": AgentSetup() for number in range(agents)}, arguments=arguments or {},
    )  # fmt: skip


DEFAULT = {"duration": 40, "policy_frequency": 1, "simulation_frequency": 15, "controlled_vehicles": 1, "cars": 5,
           "action": {"type": "DiscreteMetaAction"},
           "observation": {"type": "Kinematics", "features": ["x"]}}  # fmt: skip


def test_configuration_is_the_default_with_the_entries_of_the_scenario_and_its_arguments():
    arguments = {"rows": ArgumentSetup(default=4, option="observation.rows")}
    found = _config.configured(DEFAULT, scenario(arguments=arguments, cars=7), {"rows": 6})
    assert found == {**DEFAULT, "cars": 7, "observation": {**DEFAULT["observation"], "rows": 6}}
    assert "rows" not in DEFAULT["observation"]
    assert _config.configured(DEFAULT, scenario(duration=7), {})["duration"] == 7
    lifted = scenario()
    lifted = lifted.with_table(replace(lifted.table(HighwaySetup), time_limit="none"))
    for given, is_lifted, duration in (({}, False, 40), ({}, True, math.inf), ({"duration": 9}, True, 9)):
        assert _config.configured(DEFAULT, lifted if is_lifted else scenario(), given)["duration"] == duration
    assert "duration" not in _config.configured({k: v for k, v in DEFAULT.items() if k != "duration"}, scenario(), {})
    assert _config.configured(DEFAULT, scenario(my_reward=2.0), {})["my_reward"] == 2.0
    for wrong in ({"car": 3}, {"reward": 2.0}):
        with pytest.raises(ScenarioError, match="does not exist in the environment's configuration"):
            _config.configured(DEFAULT, scenario(**wrong), {})
    shaped = _config.configured(
        DEFAULT, scenario(observation={"type": "Many", "each": [{"observation_shape": [2, 3]}]}), {}
    )
    assert shaped["observation"]["each"][0]["observation_shape"] == (2, 3)


@pytest.mark.parametrize(("policy", "fine"), [(0, False), (-1, False), (0.5, True), (15, True), (15.5, False)])
def test_policy_frequency_is_at_most_that_of_the_simulation(policy, fine):
    if fine:
        assert _config.configured(DEFAULT, scenario(policy_frequency=policy), {})["policy_frequency"] == policy
    else:
        with pytest.raises(ScenarioError, match="above 0 and at most simulation_frequency, 15"):
            _config.configured(DEFAULT, scenario(policy_frequency=policy), {})


def test_several_agents_get_vehicles_actions_and_observations_each():
    found = _config.configured(DEFAULT, scenario(agents=2), {})
    assert found["controlled_vehicles"] == 2
    assert found["action"] == {"type": "MultiAgentAction", "action_config": DEFAULT["action"]}
    assert found["observation"] == {"type": "MultiAgentObservation", "observation_config": DEFAULT["observation"]}
    many = {**DEFAULT, "action": {"type": "MultiAgentAction", "action_config": {}}}
    assert _config.configured(many, scenario(agents=2), {})["action"] == many["action"]
    single = {name: value for name, value in DEFAULT.items() if name != "controlled_vehicles"}
    assert _config.configured(single, scenario(), {})["action"] == DEFAULT["action"]
    with pytest.raises(ScenarioError, match="has one controlled vehicle; the scenario has 2 agents"):
        _config.configured(single, scenario(agents=2), {})


def test_class_attributes_are_restored_that_environments_change():
    kind = type("Own", (IDMVehicle,), {"NOTE": "text"})
    _config.restore_classes()
    before = IDMVehicle.DISTANCE_WANTED
    IDMVehicle.DISTANCE_WANTED, kind.NOTE, kind.LATER, kind.method = before + 1, "other", 3, len
    del IDMVehicle.TIME_WANTED
    _config.restore_classes()
    assert (before, "text", 1.5) == (IDMVehicle.DISTANCE_WANTED, kind.NOTE, IDMVehicle.TIME_WANTED)
    assert "LATER" not in vars(kind)
    assert kind.method is len


# Surroundings.


def around(things, *, speed=20.0, lane=1, limits=None, lanes=3, x=100.0):
    road = straight(lanes, length=300)
    own = put(road, x, lane, speed, kind=MDPVehicle)
    others = [put(road, at, on_lane, 15.0) for at, on_lane in things]
    return surroundings_of(road.network, own, others, lambda thing: f"{others.index(thing)}", limits)


def test_surroundings_have_the_limits_of_the_vehicle():
    found = around([])
    assert (found.speed_mps, found.acceleration_mps2, found.braking_mps2) == (
        20.0, pytest.approx(5.0 / 0.6), pytest.approx(5.0 / 0.6)
    )  # fmt: skip
    steered = around([], limits=(-5.0, 3.0))
    assert (steered.acceleration_mps2, steered.braking_mps2) == (3.0, 5.0)
    assert around([], speed=-3.0).speed_mps == 0.0
    assert around([], lane=0, limits=(-5.0, 3.0)).sides[1].exists is False
    assert 1 not in around([], lane=0).sides


@pytest.mark.parametrize(
    ("speeds", "step"), [([20.0, 23.0], 3.0), ([20.0, 23.0, 30.0], 3.0), ([20.0], 5.0), ([], 5.0), (None, 5.0)]
)
def test_acceleration_is_that_to_the_next_target_speed(speeds, step):
    vehicle = SimpleNamespace(KP_A=0.5, **({} if speeds is None else {"target_speeds": np.array(speeds)}))
    assert _surroundings._greatest_acceleration(vehicle) == pytest.approx(0.5 * step)


@pytest.mark.parametrize(
    ("kind", "own"),
    [(type("A", (), {"__module__": "highway_env.envs"}), True),
     (type("A", (), {"__module__": "highway_env_own.x"}), False),
     (type("A", (), {"__module__": "mine"}), False)],
)  # fmt: skip
def test_environment_is_highway_envs_own_by_the_packages_of_its_classes(kind, own):
    assert _simulator._is_highway_envs_own(kind) is own
