"""Right of way, read a second time: by the bits, connections and shapes of the network file, without sumolib."""

from __future__ import annotations

import gzip
import math
import random
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest

from crashhunt.scenario import AgentSetup

libsumo = pytest.importorskip("libsumo")


NETS = Path(__file__).parent / "nets"
NIGHTLY = ("allway", "grid-lights", "grid-skew", "left-grid")
AGENTS, VEHICLES, STEPS = 6, 40, 60
SURE_M, SURE_ROAD_M = 95.0, 120.0  # within these distances, every scene and every search upstream contains an actor
TOLERANCE_M, OTHER_LANE_M = 0.15, 12.0  # an actor upstream may come on any lane


class Way(NamedTuple):
    """A connection of the network file."""

    source: str
    target: str
    before: str
    after: str
    inside: tuple[str, ...]
    junction: str
    number: int
    state: str
    light: tuple[str, int] | None


class Network:
    def __init__(self, content):
        root = ElementTree.fromstring(content)
        self.shapes, self.lengths, self.ends = {}, {}, {}
        for edge in root.iter("edge"):
            self.ends[edge.get("id")] = edge.get("to")
            for lane in edge.iter("lane"):
                points = [[float(one) for one in point.split(",")[:2]] for point in lane.get("shape").split()]
                self.shapes[lane.get("id")], self.lengths[lane.get("id")] = points, float(lane.get("length"))
                assert lane.get("width") is None  # each lane is 3.2 m wide
        self.bits, ordered = {}, {}
        for junction in root.iter("junction"):
            ordered[junction.get("id")] = junction.get("intLanes", "").split()
            for one in junction.iter("request"):
                self.bits[junction.get("id"), int(one.get("index"))] = one.get("response"), one.get("foes")
        joined = {"{from}_{fromLane}".format(**one.attrib): one for one in root.iter("connection")}
        self.ways = []
        for one in root.iter("connection"):
            if one.get("from").startswith(":"):
                continue
            source, target = "{from}_{fromLane}".format(**one.attrib), "{to}_{toLane}".format(**one.attrib)
            inside, via = [], one.get("via")
            while via:
                inside.append(via)
                via = joined[via].get("via")
            where = self.ends[one.get("from")]
            light = (one.get("tl"), int(one.get("linkIndex"))) if one.get("tl") else None
            number = next(ordered[where].index(lane) for lane in reversed(inside) if lane in ordered[where])
            self.ways.append(
                Way(
                    source,
                    target,
                    one.get("from"),
                    one.get("to"),
                    tuple(inside),
                    where,
                    number,
                    one.get("state"),
                    light,
                )
            )
        self._areas = {}

    def has_bit(self, kind, own, other):
        return self.bits[own.junction, own.number][kind][-1 - other.number] == "1"

    def area(self, own, other):
        """Begin and end on both ways of where they are closer than 0.8 lane widths; None if they are not."""
        found = self._areas.get((own, other))
        if found is None:
            (mine, along), (theirs, beyond) = self._line(own), self._line(other)
            close = ((mine[:, None] - theirs[None]) ** 2).sum(axis=2) < (0.8 * 3.2) ** 2
            found = self._areas[own, other] = close.any() and (
                *along[close.any(axis=1)][[0, -1]], *beyond[close.any(axis=0)][[0, -1]],
            )  # fmt: skip
        return found

    def _line(self, way):
        points = np.array([point for lane in way.inside for point in self.shapes[lane]])
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
        at = np.linspace(0.0, along[-1], int(along[-1] / 0.1) + 2)
        line = np.column_stack([np.interp(at, along, points[:, axis]) for axis in (0, 1)])
        return line, at / along[-1] * sum(self.lengths[lane] for lane in way.inside)

    def ahead(self, vehicle):
        """Yield the ways that a vehicle may take next on its route, and how far its front is from their stop line."""
        lane, route = libsumo.vehicle.getLaneID(vehicle), libsumo.vehicle.getRoute(vehicle)
        number, away = libsumo.vehicle.getRouteIndex(vehicle), -libsumo.vehicle.getLanePosition(vehicle)
        present = True
        while number + 1 < len(route):
            pairs = [one for one in self.ways if (one.before, one.after) == tuple(route[number : number + 2])]
            if lane.startswith(":"):
                ways = [one for one in pairs if lane in one.inside]
                away -= sum(map(self.lengths.get, ways[0].inside[: ways[0].inside.index(lane)]))
            else:
                ways = [one for one in pairs if one.source == lane] or pairs
                away += self.lengths[lane]
            if away > SURE_ROAD_M:
                return
            yield (ways if present else pairs), away, present and lane in (ways[0].source, *ways[0].inside)
            away += sum(map(self.lengths.get, ways[0].inside))
            lane, number, present = ways[0].target, number + 1, False

    def walk(self, draw, length):
        route = [draw.choice(sorted({one.before for one in self.ways}))]
        while len(route) < length and (after := sorted({one.after for one in self.ways if one.before == route[-1]})):
            route.append(draw.choice(after))
        return " ".join(route)


def rows_wanted(network, own, line, agent, other):
    """The rows that may show an actor: must yield, distances to the conflict area, and what they may differ."""
    length, own_length = libsumo.vehicle.getLength(other), libsumo.vehicle.getLength(agent)
    for ways, away, is_exact in network.ahead(other):
        found = []
        for way in ways:
            if way.junction != own.junction or way.source == own.source or not network.has_bit(1, own, way):
                continue
            area = network.area(own, way)
            if not area or -line - own_length > area[1] or -away - length > area[3]:
                continue
            yields = network.has_bit(0, own, way)
            if way.light and away > 0:
                yields &= libsumo.trafficlight.getRedYellowGreenState(way.light[0])[way.light[1]] not in "ruR"
            if own.state == "w" and yields and away > 0:
                yields = None  # depends on who has waited longest
            found.append((yields, line + area[0], away + area[2], TOLERANCE_M if is_exact else OTHER_LANE_M))
        if found:
            return found
    return []


@pytest.mark.parametrize("name", ["roundabout", *(pytest.param(one, marks=pytest.mark.nightly) for one in NIGHTLY)])
def test_right_of_way_is_that_of_the_network_files_bits_and_of_all_actors_near(name, sumo_runs):
    """Several agents that SUMO drives, each with all vehicles around it, also those inside junctions upstream."""
    content, draw = gzip.decompress((NETS / f"{name}.net.xml.gz").read_bytes()), random.Random(3)
    network = Network(content)
    rows = [f'<route id="q{number}" edges="{network.walk(draw, 30)}"/>' for number in range(AGENTS)]
    for number in range(VEHICLES):
        vehicle = f'<vehicle id="v{number}" depart="{number}" departLane="best" departSpeed="max">'
        rows.append(f'{vehicle}<route edges="{network.walk(draw, 30)}"/></vehicle>')
    agents = {
        f"a{number}": AgentSetup(route=f"q{number}", action="sumo", observation=("right_of_way:rows=60",))
        for number in range(AGENTS)
    }
    routes, net = f"<routes>{''.join(rows)}</routes>", NETS / f"{name}.net.xml.gz"
    simulator = sumo_runs.written(net, routes, step_length_s=0.2, warmup_s=30.0, agents=agents)
    seen = {"exact": 0, "upstream": 0, "yields": 0}
    observations, _ = simulator.reset(seed=2, options={})
    for _ in range(STEPS):
        there = [one for one in libsumo.vehicle.getIDList() if libsumo.vehicle.getLaneID(one)]
        speeds = {one: max(0.0, libsumo.vehicle.getSpeed(one)) for one in there}
        for agent in simulator.agents:
            shown = simulator.restore_observation(agent, observations[agent])["right_of_way"]
            shown = [one.tolist() for one in shown if one[0]]
            assert [one[6] for one in shown] == sorted(one[6] for one in shown)
            ways, line, on_way = next(network.ahead(agent), ([], 0.0, False))
            if not on_way or len(ways) > 1:
                continue
            (own,) = ways
            for other in there:
                wanted = rows_wanted(network, own, line, agent, other) if other != agent else ()
                found = next(
                    (
                        row
                        for row in shown
                        for yields, distance, away, most in wanted
                        if row[5] == speeds[other] and yields in (None, row[1])
                        and abs(row[3] - distance) < most and abs(row[4] - away) < most
                    ),
                    None,
                )  # fmt: skip
                if found is None:
                    apart = math.dist(libsumo.vehicle.getPosition(agent), libsumo.vehicle.getPosition(other))
                    assert not wanted or apart > SURE_M, (agent, other, wanted, shown)
                    continue
                shown.remove(found)
                seen["exact" if wanted[0][3] == TOLERANCE_M else "upstream"] += 1
                seen["yields"] += found[1] > 0
                assert found[2] == pytest.approx(line)
                assert found[7] == (own.state in "sw")
                arrival = max(0.0, found[4]) / max(found[5], 1e-9) if found[5] > 0.1 or found[4] <= 0 else 1000.0
                assert found[6] == pytest.approx(min(1000.0, arrival))
            assert all(one[4] > SURE_ROAD_M - OTHER_LANE_M for one in shown), (agent, shown)
        observations, *_ = simulator.step({one: simulator.actions[one].encode(None) for one in simulator.agents})
    assert min(seen.values()) > 10, seen
