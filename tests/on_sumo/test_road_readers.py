"""What an agent sees of the road: sumolib's geometry, TraCI's own answers and brute force on foreign networks."""

from __future__ import annotations

import functools
import math
import random
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import examples
from crossing_lines import crossing

libsumo = pytest.importorskip("libsumo")
sumolib = pytest.importorskip("sumolib")

from crashhunt.simulators import parse_parts  # noqa: E402
from crashhunt.sumo import _right_of_way_readers, _road_readers as readers, _signal_readers  # noqa: E402
from crashhunt.sumo._conflicts import Conflicts  # noqa: E402
from crashhunt.sumo._lane_graph import LaneGraph  # noqa: E402
from crashhunt.sumo._reader_protocol import AgentMoment, Places, ReaderSetup  # noqa: E402
from crashhunt.sumo.maps import read_network  # noqa: E402

NETS = Path(__file__).parent / "nets"
REAL = Path(sumolib.__file__).parent / "scenario" / "scenarios" / "RealWorld"
PUBLIC = {f"rilsa{one}": REAL / f"RiLSA_example{one}" / f"rilsa{one}.net.xml" for one in (1, 2, 3, 4)}
"""Networks that SUMO's package contains, of signalised junctions in a German guideline."""
NIGHTLY = pytest.mark.nightly
FURTHER = (
    "rand", "spider", "stops", "allway",
    "grid-skew", "grid-walks", "rand-wide", "spider-lights", *PUBLIC,
)  # fmt: skip
FOREIGN = (
    "grid-lights",
    "left-grid",
    *(pytest.param(name, marks=NIGHTLY) for name in FURTHER),
)
STEP_S, LENGTH_M = 0.5, 4.5
READERS = {
    "lanes": readers.LanesReader,
    "route": readers.RouteReader,
    "route_state": readers.RouteStateReader,
    "signals": _signal_readers.SignalsReader,
    "speed_limit": readers.SpeedLimitReader,
    "stop_line": _right_of_way_readers.StopLineReader,
    "time_to_switch": _signal_readers.SwitchTimesReader,
}


def moment_of(vehicle):
    """The scene of a vehicle alone, as seen by itself."""
    return AgentMoment(
        scene=SimpleNamespace(
            points=[libsumo.vehicle.getPosition(vehicle)],
            headings=[math.radians(90 - libsumo.vehicle.getAngle(vehicle))],
            speeds=[libsumo.vehicle.getSpeed(vehicle)],
            roster=SimpleNamespace(actors=[SimpleNamespace(id=vehicle, length=LENGTH_M)]),
            time_s=libsumo.simulation.getTime(),
        ),
        row=0,
        lane=libsumo.vehicle.getLaneID(vehicle),
        hidden=frozenset(),
    )


def roads_of(edges):
    """The roads for cars of some edges, in the order of their ids."""
    return sorted(
        (one for one in edges if one.allows("passenger") and not one.isSpecial()), key=lambda one: one.getID()
    )


@functools.cache
def network_of(name):
    """A network as sumolib reads it and as its graph, which tests do not change."""
    path = PUBLIC.get(name, NETS / f"{name}.net.xml.gz")
    graph = LaneGraph(read_network(path, with_junctions=True))
    return path, sumolib.net.readNet(str(path), withInternal=True), graph, Conflicts(graph)


class Town:
    """Vehicles that SUMO drives on random routes through a network, with a reader of each part for each of them."""

    def __init__(self, name, folder, vehicles=30):
        path, self.net, self.graph, self.conflicts = network_of(name)
        self.sign = -1 if self.graph.is_left_hand else 1
        draw = random.Random(5)
        lines = [f'<vType id="t" length="{LENGTH_M}"/>']
        for number in range(vehicles):
            route = [draw.choice(roads_of(self.net.getEdges(withInternal=False)))]
            for _ in range(draw.randrange(1, 12)):
                after = roads_of(route[-1].getOutgoing())
                route += [draw.choice(after)] if after else []
            edges = " ".join(one.getID() for one in route)
            lines.append(
                f'<vehicle id="v{number}" type="t" depart="{number}" departLane="random"><route edges="{edges}"/>'
            )
            lines.append("</vehicle>")
        (folder / "r.rou.xml").write_text("<routes>" + "".join(lines) + "</routes>")
        options = ["--step-length", str(STEP_S), "--no-step-log", "--no-warnings", "--seed", "1"]
        libsumo.start(["sumo", "-n", str(path), "-r", str(folder / "r.rou.xml"), *options])
        self._readers = {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        libsumo.close()

    def steps(self, count):
        for _ in range(count):
            libsumo.simulationStep()
            yield [one for one in libsumo.vehicle.getIDList() if libsumo.vehicle.getLaneID(one)]

    def reader(self, vehicle, part):
        found = self._readers.get((vehicle, part))
        if found is None:
            found = self._readers[vehicle, part] = READERS[part.partition(":")[0]](
                ReaderSetup(
                    agent=vehicle, request=parse_parts([part], where="here")[0], graph=self.graph,
                    places=Places(self.graph, vehicle), conflicts=self.conflicts,
                    step_length_s=STEP_S, start_m=0.0, start_s=0.0,
                )
            )  # fmt: skip
        return found

    def read(self, vehicle, part):
        return self.reader(vehicle, part).observe(moment_of(vehicle))


@pytest.fixture(params=FOREIGN)
def town(request, tmp_path):
    with Town(request.param, tmp_path) as found:
        yield found


def test_signals_show_the_lights_that_traci_names_and_the_age_of_their_state(tmp_path):
    with Town("grid-lights", tmp_path) as town:
        since, seen = {}, 0
        for vehicles in town.steps(110):
            time_s = libsumo.simulation.getTime()
            for light in libsumo.trafficlight.getIDList():
                for link, letter in enumerate(libsumo.trafficlight.getRedYellowGreenState(light)):
                    state = "GgyYrRus".find(letter) // 2
                    if since.get((light, link), (-1,))[0] != min(state, 2):
                        since[light, link] = min(state, 2), time_s - STEP_S
            for vehicle in vehicles:
                shown = town.read(vehicle, "signals")
                wanted = libsumo.vehicle.getNextTLS(vehicle)[:3]
                assert shown[:, 0].sum() == len(wanted)
                for row, (light, link, distance, letter) in enumerate(wanted[:1]):
                    state, start = since[light, link]
                    if start <= STEP_S:  # the change came before the first observation
                        continue
                    assert shown[row] == pytest.approx((1, state, distance, time_s - start), abs=0.02), letter
                    seen += 1
                # TraCI leaves some lanes inside junctions out behind the next lights.
                for row, (_, _, distance, _) in enumerate(wanted):
                    assert shown[row, 2] == pytest.approx(distance, abs=7 * row + 0.02)
        assert seen > 300


def test_time_to_switch_is_when_the_next_light_then_changes(tmp_path):
    with Town("grid-lights", tmp_path) as town:
        expected, states, checked = [], [], 0
        for vehicles in town.steps(140):
            states.append(
                {one: libsumo.trafficlight.getRedYellowGreenState(one) for one in libsumo.trafficlight.getIDList()}
            )
            for vehicle in vehicles if len(states) < 60 else ():
                shown, wanted = town.read(vehicle, "time_to_switch"), libsumo.vehicle.getNextTLS(vehicle)[:3]
                assert np.count_nonzero(shown[len(wanted) :]) == 0
                expected += [(len(states) - 1, light, link, shown[0]) for light, link, *_ in wanted[:1]]
        kinds = dict(zip("GgyYrRus", (0, 0, 1, 1, 2, 2, 2, 2), strict=True))
        for now, light, link, time_s in expected:
            seen = [kinds[one[light][link]] for one in states[now:]]
            changed = next((number for number, kind in enumerate(seen) if kind != seen[0]), None)
            if changed is not None:  # a scene shows the change one step after it
                assert time_s == pytest.approx((changed - 1) * STEP_S), (light, link)
                checked += 1
        assert checked > 300


def test_lane_changes_are_those_that_sumo_plans_and_distances_those_that_it_drives(town):
    left_at, driven = {}, {}
    changes = 0
    for vehicles in town.steps(120):
        for vehicle in vehicles:
            left, needed, until_change, *_ = town.read(vehicle, "route_state")
            lane = libsumo.vehicle.getLaneID(vehicle)
            assert 0 <= until_change <= left + 12.0  # lanes of a junction have different lengths
            if lane.startswith(":"):
                continue
            best = {one[0]: one for one in libsumo.vehicle.getBestLanes(vehicle)}
            assert needed == town.sign * best[lane][3]
            changes += needed != 0
            route = libsumo.vehicle.getRoute(vehicle)
            left_at.setdefault(vehicle, (left, libsumo.vehicle.getDistance(vehicle)))
            if libsumo.vehicle.getRouteIndex(vehicle) == len(route) - 1:
                driven[vehicle] = libsumo.vehicle.getDistance(vehicle) + left, len(route)
                end = libsumo.lane.getLength(lane) - libsumo.vehicle.getLanePosition(vehicle)
                assert left == until_change == pytest.approx(end)
    assert len(driven) > 3
    for vehicle, (total, edges) in driven.items():
        left, before = left_at[vehicle]
        assert before + left == pytest.approx(total, abs=6 * edges)
    assert changes or town.graph.is_left_hand or len(next(iter(town.graph.edges.values()))) == 1


def shape_of(town, lane):
    return town.net.getLane(lane).getShape()


SAMPLES = (54, 30, 42, 18, 6)[: examples(8)]
"""The steps in which all vehicles are examined: more are on the road in the first ones here."""


def test_points_of_lanes_lie_on_sumolibs_lanes_at_the_spacing(town):
    distance_to = sumolib.geomhelper.distancePointToPolygon
    along = sumolib.geomhelper.polygonOffsetWithMinimumDistanceToPoint
    points = others = 0
    for number, vehicles in enumerate(town.steps(60)):
        for vehicle in vehicles if number in SAMPLES else ():
            shown = town.read(vehicle, "lanes")
            lane, (x, y) = libsumo.vehicle.getLaneID(vehicle), libsumo.vehicle.getPosition(vehicle)
            heading = math.radians(90 - libsumo.vehicle.getAngle(vehicle))
            x, y = x - LENGTH_M / 2 * math.cos(heading), y - LENGTH_M / 2 * math.sin(heading)
            own = shown[0]
            assert set(own[own[:, 0] > 0][:, 5]) <= {lane.data.speed_mps for lane in town.graph.lanes.values()}
            for (here, *a, _, _, _), (there, *b, _, _, _) in pairwise(own):
                assert not here or not there or math.dist(a, b) <= 2.0 + 1e-9
            index = 5  # 10 m behind it is the first point
            if libsumo.vehicle.getLanePosition(vehicle) > LENGTH_M:
                assert distance_to(own[index, 1:3], shape_of(town, lane)) < 1e-6
                assert abs(along((x, y), shape_of(town, lane)) - along(own[index, 1:3], shape_of(town, lane))) < 0.5
                assert own[index, 4:] == pytest.approx(
                    (town.net.getLane(lane).getWidth(), town.net.getLane(lane).getSpeed())
                )
                points += 1
            if not lane.startswith(":"):
                edge, place = town.net.getLane(lane).getEdge(), int(lane.rpartition("_")[2])
                for row, side in ((1, town.sign), (2, -town.sign)):
                    beside = place + side
                    there = 0 <= beside < edge.getLaneNumber() and edge.getLane(beside).allows("passenger")
                    assert shown[row, index, 0] == there
                    if shown[row, index, 0] and libsumo.vehicle.getLanePosition(vehicle) > LENGTH_M + 1:
                        assert distance_to(shown[row, index, 1:3], edge.getLane(beside).getShape()) < 1e-6
            away = sorted(
                distance_to((x, y), one.getShape())
                for edge in town.net.getEdges() if edge.getFunction() in ("", "internal")
                for one in edge.getLanes()
                if one.allows("passenger") and one.getID() != lane and not is_beside(town, one.getID(), lane)
            )  # fmt: skip
            near = [min(np.hypot(*(one[one[:, 0] > 0][:, 1:3] - (x, y)).T)) for one in shown[3:] if one[:, 0].any()]
            wanted = [one for one in away if one < 49.0][: len(shown) - 3]
            assert len(near) >= len(wanted)
            for found, best in zip(sorted(near), wanted, strict=False):
                assert found <= best + 0.5  # the distance of two prepared points, at the end of a lane
                others += 1
    assert points > 30
    assert others > 100


def is_beside(town, lane, own):
    edge, index = own.rpartition("_")[::2]
    return lane in (f"{edge}_{int(index) - 1}", f"{edge}_{int(index) + 1}")


def test_route_points_follow_the_edges_of_the_route(town):
    checked = 0
    for number, vehicles in enumerate(town.steps(60)):
        for vehicle in vehicles if number in SAMPLES else ():
            if libsumo.vehicle.getLanePosition(vehicle) < LENGTH_M:  # its centre is not on its lane yet
                continue
            shown = town.read(vehicle, "route")
            number = libsumo.vehicle.getRouteIndex(vehicle)
            edges = libsumo.vehicle.getRoute(vehicle)[max(0, number - 1) :]
            lanes = [lane for edge in edges for lane in town.net.getEdge(edge).getLanes()]
            for one, two in pairwise(edges):
                for connection in town.net.getEdge(one).getConnections(town.net.getEdge(two)):
                    via = connection.getViaLaneID()
                    while via:
                        lanes.append(town.net.getLane(via))
                        via = next((after.getViaLaneID() for after in lanes[-1].getOutgoing()), "")
            for present, x, y, _, limit, index in shown:
                if not present:
                    continue
                distances = [(sumolib.geomhelper.distancePointToPolygon((x, y), one.getShape()), one) for one in lanes]
                fitting = [one for distance, one in distances if distance < 1e-6]
                assert any(one.getSpeed() == limit and one.getIndex() == index for one in fitting)
                checked += 1
            present = shown[:, 0].astype(bool)
            assert not present[np.argmin(present) :].any() or present.all()
    assert checked > 1000


def test_route_points_behind_lead_to_the_points_ahead(town):
    checked = 0
    for vehicles in (vehicles for number, vehicles in enumerate(town.steps(60)) if number % 20 == 19):
        for vehicle in vehicles:
            ahead, around = (town.read(vehicle, part) for part in ("route", "route:points=40:behind=15"))
            behind = int(np.hypot(*(around[:8, 1:3] - ahead[0, 1:3]).T).argmin())
            assert around[behind:, :3] == pytest.approx(ahead[: 40 - behind, :3], abs=1e-6)
            assert np.hypot(*np.diff(around[: behind + 1, 1:3], axis=0).T).max(initial=0.0) < 2.0 + 1e-9
            assert behind == 7 or libsumo.vehicle.getDistance(vehicle) < 20.0
            checked += behind
    assert checked > 100


def test_stop_line_is_that_of_the_next_link_and_the_rules_of_its_junction(town):
    seen = dict.fromkeys(("yields", "signs", "lights", "none"), 0)
    for number, vehicles in enumerate(town.steps(60)):
        for vehicle in vehicles if number % 3 == 0 else ():
            lane = libsumo.vehicle.getLaneID(vehicle)
            assert town.read(vehicle, "speed_limit").tolist() == [town.net.getLane(lane).getSpeed()]
            found = next_connection(town, vehicle)
            if found is None:
                continue
            (own, line), node = found, found[0].getFrom().getToNode()
            others = [one for edge in node.getIncoming() for to in edge.getOutgoing().values() for one in to]
            yields = any(
                node.getLinkIndex(own) in node._prohibits and node.forbids(other, own)
                for other in others
                if other.getFromLane() is not own.getFromLane() and crossing(path_of(town, own), path_of(town, other))
            )
            present, distance, must_yield, stop_sign, signal = town.read(vehicle, "stop_line").tolist()
            assert (present, distance) == (1, pytest.approx(line))
            assert (stop_sign, signal) == (own.getState() in "sw", bool(own.getTLSID()))
            assert must_yield >= yields  # paths that are near each other without a common point also conflict
            seen["yields"] += must_yield > 0
            seen["signs"] += stop_sign > 0
            seen["lights"] += signal > 0
            seen["none"] += not (must_yield or stop_sign or signal)
    assert sum(seen.values()) > 50


def path_of(town, connection):
    points, via = [], connection.getViaLaneID()
    while via:
        points += [point for point in shape_of(town, via) if not points or math.dist(point, points[-1]) > 1e-6]
        via = next((after.getViaLaneID() for after in town.net.getLane(via).getOutgoing()), "")
    return points


def next_connection(town, vehicle):
    """The next connection of a vehicle on a road, and its distance from the stop line."""
    lane, links = libsumo.vehicle.getLaneID(vehicle), libsumo.vehicle.getNextLinks(vehicle)
    for connection in town.net.getLane(lane).getOutgoing() if links and not lane.startswith(":") else ():
        if connection.getToLane().getID() == links[0][0] and connection.getViaLaneID():
            return connection, libsumo.lane.getLength(lane) - libsumo.vehicle.getLanePosition(vehicle)
    return None
