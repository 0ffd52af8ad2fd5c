"""The map that an agent receives: lanes, stop lines, route and reference path, against sumolib on foreign networks."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

libsumo = pytest.importorskip("libsumo")
sumolib = pytest.importorskip("sumolib")

from crashhunt.sumo._lane_graph import VEHICLE_CLASSES, LaneGraph  # noqa: E402
from crashhunt.sumo.maps import read_network  # noqa: E402
from crashhunt.world import lane_lines  # noqa: E402

NETS = Path(__file__).parent / "nets"
LARGE = ("grid-skew", "grid-walks", "rand-wide", "spider-lights")
ALL = [
    pytest.param(path.name, marks=pytest.mark.nightly) if path.name.startswith(LARGE) else path.name
    for path in sorted(NETS.glob("*.net.xml*"))
]
PUBLIC = Path(sumolib.__file__).parent / "scenario" / "scenarios" / "RealWorld"
ALL += [pytest.param(str(path), marks=pytest.mark.nightly) for path in sorted(PUBLIC.glob("*/rilsa?.net.xml"))]
CAR = "passenger"


def graph_of(name):
    return LaneGraph(read_network(NETS / name, with_junctions=True))


@pytest.mark.parametrize("name", ALL)
def test_lanes_have_the_shape_neighbours_and_classes_that_sumolib_reads(name):
    net, graph = sumolib.net.readNet(str(NETS / name), withInternal=True), graph_of(name)
    lanes = graph.lanes_for(CAR)
    wanted = {
        lane.getID(): lane for edge in net.getEdges() if edge.getFunction() != "walkingarea" for lane in edge.getLanes()
    }
    assert lanes.keys() == wanted.keys()
    for name_, lane in lanes.items():
        other = wanted[name_]
        assert (lane.width, lane.speed_limit) == (other.getWidth(), other.getSpeed())
        assert lane.allowed == set(other.getPermissions()) & VEHICLE_CLASSES
        assert lane.is_open == other.allows(CAR)
        after = {one.getViaLaneID() or one.getToLane().getID() for one in other.getOutgoing()}
        assert set(lane.successors) == after & wanted.keys()
        for after in lane.successors:
            assert lane.id in lanes[after].predecessors
        for line in (lane.center, lane.left_line, lane.right_line):
            steps = np.hypot(*np.diff(line, axis=0).T)
            assert line.shape == lane.center.shape
            assert 0.0 < steps.min() <= steps.max() <= 2.0 + 1e-9
            assert not line.flags.writeable
        points = [point[:2] for point in other.getShape()]
        for x, y in lane.center:
            assert sumolib.geomhelper.distancePointToPolygon((x, y), points) < (1e-6 if len(set(points)) > 1 else 0.02)
        assert math.dist(lane.center[-1], points[-1]) < 0.02
        edge, index = wanted[name_].getEdge(), other.getIndex()
        sides = (1, -1) if not graph.is_left_hand else (-1, 1)
        for beside, shift in zip((lane.left, lane.right), sides, strict=True):
            there = 0 <= index + shift < edge.getLaneNumber()
            assert beside == (edge.getLane(index + shift).getID() if there else "")
        if lane.left:
            middle, there = len(lane.center) // 2, lanes[lane.left].center
            along = lane.center[middle] - lane.center[middle - 1]
            across = there[len(there) // 2] - lane.center[middle]
            if np.hypot(*across) > 1.0:  # lanes inside a junction may cross each other
                assert along[0] * across[1] - along[1] * across[0] > 0


def test_the_edges_of_a_lane_are_half_a_width_from_its_centre_and_never_turn_back():
    lines = lane_lines([(0.0, 0.0), (30.0, 0.0), (30.0, 0.0), (30.0, 20.0)], 4.0)
    assert np.allclose(lines.left[:3], [(0, 2), (lines.left[1, 0], 2), (lines.left[2, 0], 2)])
    assert np.allclose(lines.right[-1], (32, 20))
    corner = int(np.argmin(np.hypot(*(lines.center - (30.0, 0.0)).T)))
    assert np.allclose(lines.left[corner], (28, 2))
    assert np.allclose(lines.right[corner], (32, -2))
    tight = [(math.cos(angle), math.sin(angle)) for angle in np.linspace(0, math.pi, 12)]
    bend = lane_lines(tight, 3.2)  # of a radius of 1 m
    forward = np.einsum("ij,ij->i", np.diff(bend.left, axis=0), np.diff(bend.center, axis=0))
    assert (forward > 0).all()
    assert lane_lines([(1.0, 1.0), (1.0, 1.0)], 3.0).center.shape == (2, 2)


def test_a_lane_whose_marking_forbids_it_may_not_be_left():
    graph = LaneGraph(read_network(NETS / "grid-lights.net.xml.gz", with_junctions=True))
    lane = next(one for one in graph.lanes.values() if not one.is_internal and graph.neighbor(one, 1) is not None)
    assert graph.may_change(lane, 1, CAR)
    object.__setattr__(lane.data, "change_up", frozenset({"bus"}))
    assert not graph.may_change(lane, 1, CAR)
    assert graph.may_change(lane, 1, "bus")
    object.__setattr__(lane.data, "change_up", frozenset({"all"}))
    assert graph.may_change(lane, 1, CAR)


KINDS = {
    "grid-lights": {"traffic_light"},
    "left-grid": {"right_before_left"},
    "allway": {"allway_stop"},
    "stops": {"stop", "yield"},
    "spider": {"yield"},
}


@pytest.mark.parametrize(("name", "kinds"), KINDS.items())
def test_stop_lines_are_where_a_vehicle_may_have_to_stop(name, kinds):
    graph = graph_of(f"{name}.net.xml.gz")
    assert {line.kind for line in graph.stop_lines} == kinds
    net = sumolib.net.readNet(str(NETS / f"{name}.net.xml.gz"))
    for line in graph.stop_lines:
        lane = net.getLane(line.lane)
        assert line.junction == lane.getEdge().getToNode().getID()
        assert np.hypot(*(line.ends.mean(axis=0) - lane.getShape()[-1])) < 1e-6
        assert np.hypot(*(line.ends[0] - line.ends[1])) == pytest.approx(lane.getWidth())
        assert bool(line.signal) == (line.kind == "traffic_light")
        tls = {one.getTLSID() for one in lane.getOutgoing()} - {""}
        assert line.signal in (tls or {""})


def ring_of(graph, edge, laps):
    """A route around the block: the first edges that lead back to an edge, several times."""
    waiting, paths = [edge], {edge: (edge,)}
    while waiting:
        current = waiting.pop(0)
        for lane in graph.edges[current]:
            for link in lane.links:
                after = graph.lanes[link.target].edge
                if after == edge and len(paths[current]) > 3:
                    return paths[current] * laps
                if after not in paths:
                    paths[after] = (*paths[current], after)
                    waiting.append(after)
    raise AssertionError(edge)


@pytest.mark.parametrize("name", ["grid-lights", "left-grid", "spider"])
def test_a_ring_route_is_listed_lap_by_lap_with_the_lanes_inside_junctions(name):
    graph = graph_of(f"{name}.net.xml.gz")
    first = next(edge for edge in graph.edges if not edge.startswith(":"))
    edges = ring_of(graph, first, laps=3)
    lane = graph.edges[first][0]
    found = graph.guide(edges, CAR).road_map(0, lane)
    roads = [name for name, _ in pairwise([*(one.rpartition("_")[0] for one in found.route), ""]) if name[0] != ":"]
    assert [one for place, one in enumerate(roads) if not place or one != roads[place - 1]] == list(edges)
    lanes = found.lanes
    for one, two in pairwise(found.route):
        assert two in lanes[one].successors or lanes[one].road == lanes[two].road
    steps = np.hypot(*np.diff(found.reference_path, axis=0).T)
    assert 0.0 < steps.min() <= steps.max() <= 2.0 + 1e-9
    assert np.allclose(found.reference_path[0], lane.lines.center[0])
    length = sum(lanes[one].length for one in dict.fromkeys(found.route)) * 3
    assert steps.sum() == pytest.approx(length, rel=0.4)
    turns = np.diff(np.unwrap(np.arctan2(*np.diff(found.reference_path, axis=0).T[::-1])))
    assert np.abs(turns).max() < 1.2  # no jump sideways at a lane change


def test_a_route_that_no_lane_leads_along_is_followed_as_far_as_it_goes():
    graph = graph_of("grid-lights.net.xml.gz")
    first, *_, last = (edge for edge in graph.edges if not edge.startswith(":"))
    found = graph.guide((first, last), CAR).road_map(0, graph.edges[first][0])
    assert found.route == (graph.edges[first][0].id,)
    assert graph.guide((), CAR).road_map(0, None).reference_path.shape == (0, 2)


def test_the_simulator_gives_the_map_and_the_vehicle_of_the_present_route(sumo_runs):
    simulator, _ = sumo_runs.begin("loop", 1)
    road, vehicle = simulator.road_map("ego"), simulator.vehicle_data("ego")
    assert simulator.road_map("ego").lanes is road.lanes
    assert road.route[0] == libsumo.vehicle.getLaneID("ego")
    edges = libsumo.vehicle.getRoute("ego")[libsumo.vehicle.getRouteIndex("ego") :]
    roads = [road.lanes[one].road for one in road.route if not one.startswith(":")]
    assert [one for place, one in enumerate(roads) if not place or one != roads[place - 1]] == list(edges)
    assert (vehicle.length, vehicle.width) == (libsumo.vehicle.getLength("ego"), libsumo.vehicle.getWidth("ego"))
    assert 0.0 < vehicle.rear_axle_offset < vehicle.wheelbase < vehicle.length
    assert vehicle.max_deceleration <= vehicle.emergency_deceleration
    assert vehicle.kind == CAR
