"""The parts ``lanes``, ``route`` and ``speed_limit`` on highway-env, compared with points of its road network."""

from __future__ import annotations

import copy
import math
from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest

from crashhunt.highway import HighwaySimulator
from crashhunt.highway._descriptor import HighwaySetup
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators import PARTS

SPACING_M, BEHIND, POINTS = 2.0, 5, 40
WORDS = ("lanes:lanes=12", "route:behind=6", "speed_limit")
LANES, ROUTE = ({column.name: n for n, column in enumerate(PARTS[name].columns)} for name in ("lanes", "route"))
BY_DAY = ("highway-v0", "merge-v1", "intersection-v2", "racetrack-v1")
AT_NIGHT = ("roundabout-v1", "u-turn-v1", "two-way-v0", "exit-v1", "lane-keeping-v0", "racetrack-oval-v0")


def simulator_of(name, *words):
    setup = HighwaySetup(id=name)
    return HighwaySimulator(
        Scenario(simulator="highway", tables={"highway": setup}, agents={"ego": AgentSetup(observation=words)}), None
    )


def steps_of(simulator, seed, count):
    """Yield the vehicle, the network and the parts before and after each step with a random action."""
    observations, _ = simulator.reset(seed=seed)
    space = simulator.actions["ego"].space
    space.seed(seed)
    for _ in range(count):
        parts = simulator.observation_layouts["ego"].restore(observations["ego"])
        yield simulator._controlled["ego"], simulator._env.road.network, parts
        if not simulator.agents:
            return
        observations, *_ = simulator.step({"ego": simulator.actions["ego"].encode(space.sample())})


def samples(lane, place, step_m=0.05):
    """Return points along a lane; of a long lane, those within 300 m of a place."""
    begin, end = 0.0, lane.length
    if lane.length > 1000.0:
        along, _ = lane.local_coordinates(place)
        begin, end = max(0.0, along - 300.0), min(lane.length, along + 300.0)
    places = np.linspace(begin, end, max(2, math.ceil((end - begin) / step_m) + 1))
    return np.array([lane.position(place, 0.0) for place in places])


def lanes_at(network, row, columns, margin_m=0.01):
    """Return the lanes whose centre lines go through a point in the direction of the point."""
    place = np.array([row[columns["x"]], -row[columns["y"]]])
    found = []
    for index, lane in network.lanes_dict().items():
        along, aside = lane.local_coordinates(place)
        turn = math.remainder(float(lane.heading_at(along)) + row[columns["heading"]], math.tau)
        if -margin_m <= along <= lane.length + margin_m and abs(aside) < 2e-3 and abs(turn) < 0.02:
            found.append(index)
    return found


@pytest.mark.parametrize("name", [*BY_DAY, *(pytest.param(one, marks=pytest.mark.nightly) for one in AT_NIGHT)])
def test_lanes_and_route_are_those_of_the_road_network(name):
    compared = 0
    with closing(simulator_of(name, *WORDS)) as simulator:
        sampled = {}
        for vehicle, network, parts in steps_of(simulator, 3, 8):
            position, (start, end, number) = vehicle.position, vehicle.lane_index
            roads = network.lanes_dict()
            if not sampled:
                sampled = {index: samples(lane, position) for index, lane in roads.items()}
            away = {index: np.hypot(*(points - position).T).min() for index, points in sampled.items()}
            own, left, right, *others = parts["lanes"]
            for row in [*own, *parts["lanes"].reshape(-1, len(LANES)), *left][::7]:
                if row[0]:
                    assert lanes_at(network, row, LANES), row
                else:
                    assert not row.any()
            for change, rows in ((0, own), (-1, left), (1, right)):  # highway-env numbers lanes from the left
                lane = roads.get((start, end, number + change))
                if lane is None or (change and lane.forbidden):
                    assert not rows.any()
                    continue
                here = rows[BEHIND]
                found = math.dist(here[1:3] * (1, -1), position)  # its y axis points down
                assert found == pytest.approx(away[start, end, number + change], abs=0.026)
                assert (start, end, number + change) in lanes_at(network, here, LANES)
                assert here[LANES["width"]] == lane.width_at(0.0)
                assert here[LANES["speed_limit"]] == lane.speed_limit
                compared += 1
            shown = own[own[:, 0] > 0]
            for one, two in pairwise(shown):
                # Lanes of racetrack-v1 overlap at their ends by up to 1 m.
                if {*lanes_at(network, one, LANES, -2.0)} & {*lanes_at(network, two, LANES, -2.0)}:
                    assert math.dist(one[1:3], two[1:3]) == pytest.approx(SPACING_M, abs=0.02)
            near = sorted(
                away[index]
                for index, lane in roads.items()
                if not (index[:2] == (start, end) and abs(index[2] - number) < 2) and not lane.forbidden
            )
            found = [math.dist(rows[BEHIND, 1:3] * (1, -1), position) for rows in others if rows.any()]
            assert found == pytest.approx([one for one in near if one <= 50.0][: len(others)], abs=0.03)
            route, limit = parts["route"], parts["speed_limit"]
            assert limit.tolist() == [vehicle.lane.speed_limit]
            assert (route[:, 0] > 0).tolist() == sorted(route[:, 0] > 0, reverse=True)
            # highway-env itself says which lanes follow; it drops the passed roads of the route, so it gets a copy.
            planned, index = copy.copy(getattr(vehicle, "route", None)), vehicle.lane_index
            for row in route[route[:, 0] > 0][5:]:
                if index not in (lanes := lanes_at(network, row, ROUTE)):
                    index = network.next_lane(index, planned, np.array([row[1], -row[2]]))
                    assert index in lanes
                lane = network.get_lane(index)
                assert row[ROUTE["speed_limit"]] == lane.speed_limit
                lanes_of_road = len(network.graph[index[0]][index[1]])
                assert row[ROUTE["lane_index"]] == lanes_of_road - 1 - (index[2] or 0)
    assert compared >= 5


def test_points_before_the_first_lane_are_absent():
    with closing(
        simulator_of("intersection-v2", "lanes:behind=60:points=60", "route:behind=60:points=60")
    ) as simulator:
        _, _, parts = next(steps_of(simulator, 1, 1))
    present = parts["lanes"][0, :, 0]
    assert present[30] == 1
    assert 0 < present[:30].sum() < 30
    assert (np.diff(present[:30]) >= 0).all()  # absent, then present
    assert parts["route"][0, 0] == 1  # which begins later instead
    first = int(present.argmax())
    assert parts["route"][0, 1:3] == pytest.approx(parts["lanes"][0, first, 1:3])


def test_parts_do_not_change_the_episode():
    ends = []
    for words in (("ego",), ("ego", *WORDS)):
        with closing(simulator_of("roundabout-v1", *words)) as simulator:
            for _ in steps_of(simulator, 5, 9):
                end = [(thing.position.tolist(), float(thing.speed)) for thing in simulator._objects()]
            ends.append(end)
    assert ends[0] == ends[1]
