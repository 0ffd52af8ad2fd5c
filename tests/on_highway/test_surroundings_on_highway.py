"""What a careful driver of a highway-env vehicle would consider, on a straight road where gaps are known."""

from __future__ import annotations

import numpy as np
import pytest

highway_env = pytest.importorskip("highway_env")
from highway_env.road.road import Road, RoadNetwork  # noqa: E402
from highway_env.vehicle.behavior import IDMVehicle  # noqa: E402
from highway_env.vehicle.controller import MDPVehicle  # noqa: E402

from crashhunt.highway._surroundings import surroundings_of  # noqa: E402

ENDS_M = 100.0  # of the first road; the second one begins there


def around(lane, others, *, target=None, aside=0.0, acceleration_range=None):
    """Return the surroundings of a vehicle at 80 m; others are pairs of a lane and a place along the road."""
    network = RoadNetwork.straight_road_network(3, length=ENDS_M, nodes_str=("a", "b"))
    network = RoadNetwork.straight_road_network(3, start=ENDS_M, length=400, nodes_str=("b", "c"), net=network)
    road = Road(network, np_random=np.random.RandomState(0))
    own = MDPVehicle(road, [80.0, 4.0 * lane + aside], speed=25.0)
    own.target_lane_index = (*own.lane_index[:2], lane if target is None else target)
    things = [IDMVehicle(road, [x, 4.0 * number], speed=20.0) for number, x in others]
    road.vehicles += [own, *things]
    return surroundings_of(network, own, things, lambda thing: f"x{things.index(thing)}", acceleration_range)


def test_neighbors_are_the_nearest_of_each_lane_also_beyond_the_end_of_the_road():
    found = around(1, [(1, 120.0), (1, 150.0), (1, 60.0), (0, 110.0), (0, 70.0), (2, 83.0)])
    (leader,) = found.ahead
    assert (leader.actor, leader.speed_mps) == ("x0", 20.0)
    assert leader.gap_m == pytest.approx(120.0 - 80.0 - 5.0)
    left, right = found.sides[1], found.sides[-1]
    assert (left.ahead.actor, left.behind.actor) == ("x3", "x4")
    assert left.behind.gap_m == pytest.approx(5.0)
    assert (right.ahead.actor, right.ahead.gap_m, right.behind) == ("x5", pytest.approx(-2.0), None)


def test_lane_that_does_not_exist_is_no_side():
    """highway-env ignores such a change, so it is no omission."""
    assert around(0, []).sides.keys() == {-1}
    assert around(2, []).sides.keys() == {1}


def test_both_lanes_count_while_the_vehicle_changes_lanes():
    found = around(1, [(1, 120.0), (0, 100.0)], target=0)
    assert {one.actor for one in found.ahead} == {"x0", "x1"}
    assert found.sides.keys() == {-1}


@pytest.mark.parametrize(("aside", "ahead"), [(0.9, {"x1"}), (1.1, {"x1", "x2"}), (-0.9, {"x1"}), (-1.1, {"x0", "x1"})])
def test_lane_that_a_steered_vehicle_reaches_into_counts(aside, ahead):
    """Such a vehicle has no target lane; highway-env's lanes are 4 m wide."""
    found = around(1, [(0, 120.0), (1, 120.0), (2, 120.0)], aside=aside, acceleration_range=(-5.0, 3.0))
    assert {one.actor for one in found.ahead} == ahead
    assert found.sides.keys() == {-1, 1}  # it has not chosen a lane
