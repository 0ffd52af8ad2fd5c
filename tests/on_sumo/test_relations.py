"""The columns left, right, oncoming and crossing of actors, by sumolib's lanes and the shapes of foreign networks."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise

import pytest

libsumo = pytest.importorskip("libsumo")
sumolib = pytest.importorskip("sumolib")

from test_road_readers import FURTHER, LENGTH_M, Town  # noqa: E402

from crashhunt.sumo._relations import PathAhead, Relations  # noqa: E402

REACH_M, NEAR_M = 100.0, 80.0
geometry = sumolib.geomhelper


def pose(vehicle):
    """The centre of a vehicle and its heading."""
    (x, y), heading = libsumo.vehicle.getPosition(vehicle), math.radians(90 - libsumo.vehicle.getAngle(vehicle))
    return x - LENGTH_M / 2 * math.cos(heading), y - LENGTH_M / 2 * math.sin(heading), heading


class Roads:
    """A network as sumolib reads it, and the path of one vehicle."""

    def __init__(self, net, vehicle):
        self.net, self.own = net, libsumo.vehicle.getLaneID(vehicle)
        route = libsumo.vehicle.getRoute(vehicle)[max(0, libsumo.vehicle.getRouteIndex(vehicle)) :]
        self.on_route = lambda connection: connection.getTo().getID() in route
        self.path = self.reached(self.own)
        self.roads = {self.net.getLane(one).getEdge() for one in self.path}
        beside = [one.getID() for road in self.roads for one in road.getLanes() if one.getID() not in self.path]
        self.sides = dict.fromkeys(self.path, 0) | {lane: side for lane in beside if (side := self.beside(lane))}
        beyond = {
            side: {x for one in beside if self.sides.get(one) == side for x in self.reached(one)} for side in (1, -1)
        }
        for side, lanes in beyond.items():
            self.sides |= dict.fromkeys(lanes - beyond[-side] - self.sides.keys(), side)

    def ways(self, lane):
        """Each connection from a lane, and its lanes up to the next road."""
        for first in self.net.getLane(lane).getOutgoing():
            inside, link = [], first
            while link.getViaLaneID():
                inside.append(link.getViaLaneID())
                link = self.net.getLane(inside[-1]).getOutgoing()[0]
            yield first, [*inside, first.getToLane().getID()]

    def reached(self, lane):
        """The lanes on the route that a lane leads to."""
        found, waiting = {lane}, [(lane, 0.0)]
        while waiting:
            current, done = waiting.pop()
            for link in self.net.getLane(current).getOutgoing() if done <= REACH_M else ():
                lane = link.getViaLaneID() or link.getToLane().getID()
                if lane not in found and self.on_route(link):
                    found.add(lane)
                    waiting.append((lane, done + self.net.getLane(lane).getLength()))
        return found

    def beside(self, lane):
        """1 if a lane is to the left of the path on the same road, by the shapes; -1 if it is to the right."""
        shape = self.net.getLane(lane).getShape()
        x, y = geometry.positionAtShapeOffset(shape, geometry.polyLength(shape) / 2)
        sides = set()
        for other in (one for one in self.net.getLane(lane).getEdge().getLanes() if one.getID() in self.path):
            at = geometry.polygonOffsetWithMinimumDistanceToPoint((x, y), other.getShape())
            (ax, ay), turn = geometry.positionAtShapeOffset(other.getShape(), at), direction(other.getShape(), at)
            sides.add(1 if math.cos(turn) * (y - ay) > math.sin(turn) * (x - ax) else -1)
        return sides.pop() if len(sides) == 1 else 0

    def side(self, lane):
        """The side of a lane, or of the lanes with a side that it leads to."""
        if lane in self.sides:
            return self.sides[lane]
        found, seen, waiting = set(), {lane}, [(lane, 0.0)]
        while waiting:
            current, done = waiting.pop()
            for first, way in self.ways(current) if done <= REACH_M else ():
                hits = [self.sides[one] for one in way if one in self.sides]
                found |= set(hits[:1])
                if not hits and first.getDirection() != "t" and way[-1] not in seen:
                    seen.add(way[-1])
                    waiting.append((way[-1], done + sum(self.net.getLane(one).getLength() for one in way)))
        return found.pop() if len(found) == 1 else None

    def is_opposite(self, lane):
        """Whether a lane is on a road back beside the path, or leads from one to the next inside a junction."""
        edge = self.net.getLane(lane).getEdge()
        sources = {one.getFrom() for one in self.starts_of(self.own)} if self.own[0] == ":" else set()
        roads = {one for one in self.roads | sources if not one.isSpecial()}
        if not edge.isSpecial():
            return any(self.leads_back(road, edge) for road in roads)
        target = self.net.getLane(lane).getOutgoing()[0].getTo()
        before = {link.getFrom() for link in self.starts_of(lane)}
        return all(any(self.leads_back(road, one) for road in roads) for one in (target, *before))

    def starts_of(self, lane):
        """The connections from roads whose ways contain a lane inside a junction."""
        node = self.net.getLane(lane).getEdge().getFromNode()
        lanes = [one.getID() for edge in node.getIncoming() if not edge.isSpecial() for one in edge.getLanes()]
        return [first for one in lanes for first, way in self.ways(one) if lane in way]

    def leads_back(self, road, other):
        if (road.getFromNode(), road.getToNode()) != (other.getToNode(), other.getFromNode()):
            return False
        one, two = road.getLanes()[-1], other.getLanes()[-1]
        middle = geometry.positionAtShapeOffset(one.getShape(), geometry.polyLength(one.getShape()) / 2)
        gap = geometry.distancePointToPolygon(middle, two.getShape()) - (one.getWidth() + two.getWidth()) / 2
        return gap <= 5.0

    def conflicts(self, lane):
        """Whether a way from a lane, or through it, is a foe of the path and close to it; None if unsure."""
        inside = lane.startswith(":")
        theirs = self.starts_of(lane) if inside else [first for first, _ in self.ways(lane)]
        own = self.starts_of(self.own) if self.own.startswith(":") else []
        own += [
            first
            for one in self.path
            if not one.startswith(":")
            for first, way in self.ways(one)
            if way[-1] in self.path
        ]
        answers = [self.conflict(one, two) for one in own for two in theirs]
        return True if True in answers else None if None in answers else False

    def conflict(self, own, other):
        node = own.getFrom().getToNode()
        if other.getFrom().getToNode() is not node or own.getFromLane() is other.getFromLane() or not node._foes:
            return False
        if not node.areFoes(node.getLinkIndex(own), node.getLinkIndex(other)):
            return False
        one, two = (
            [x for lane in self.way_of(link) for x in self.net.getLane(lane).getShape()] for link in (own, other)
        )
        away = min(geometry.distancePointToPolygon(point, b) for a, b in ((one, two), (two, one)) for point in a)
        crosses = geometry.intersectsPolygon(one, two)
        limit = 0.8 * (own.getFromLane().getWidth() + other.getFromLane().getWidth()) / 2
        return True if crosses or away < limit - 0.3 else None if away < limit + 0.3 else False

    def way_of(self, link):
        return next(way for first, way in self.ways(link.getFromLane().getID()) if first is link)[:-1]


def direction(shape, at):
    """The direction of a line at a distance from its start."""
    before = 0.0
    for (ax, ay, *_), (bx, by, *_) in pairwise(shape):
        before += math.hypot(bx - ax, by - ay)
        if before >= at - 1e-9 and (ax, ay) != (bx, by):
            return math.atan2(by - ay, bx - ax)
    raise AssertionError


def is_along(net, vehicle):
    """Whether a vehicle drives along its lane, and is not turning into it."""
    x, y, heading = pose(vehicle)
    shape = net.getLane(libsumo.vehicle.getLaneID(vehicle)).getShape()
    return math.cos(heading - direction(shape, geometry.polygonOffsetWithMinimumDistanceToPoint((x, y), shape))) > 0.7


@pytest.mark.parametrize(
    "name",
    ["left-grid", "roundabout", *(pytest.param(one, marks=pytest.mark.nightly) for one in ("grid-lights", *FURTHER))],
)
def test_relations_are_those_of_sumolibs_lanes(name, tmp_path):
    seen = Counter()
    with Town(name, tmp_path) as town:
        found = {}
        for number, vehicles in enumerate(town.steps(120)):
            poses = {one: pose(one) for one in vehicles} if number % 8 == 0 else {}
            for vehicle in list(poses)[number // 8 % 3 :: 3]:
                if vehicle not in found:
                    path = PathAhead(vehicle, town.graph, REACH_M)
                    found[vehicle] = path, Relations(path, town.graph, town.conflicts, REACH_M)
                path, relations = found[vehicle]
                path.update(libsumo.vehicle.getLaneID(vehicle))
                roads = Roads(town.net, vehicle)
                assert path.lanes == roads.path
                for other in (one for one in poses if 0 < math.dist(poses[vehicle][:2], poses[one][:2]) < NEAR_M):
                    lane = libsumo.vehicle.getLaneID(other)
                    wanted = roads.conflicts(lane)
                    is_opposite = roads.is_opposite(lane)
                    side = None if is_opposite else roads.side(lane)
                    both = is_along(town.net, vehicle) and is_along(town.net, other)
                    for turned in ((0, 0), (0, 1), (1, 0), (1, 1)) if both else ((0, 0),):
                        own, there = ((*poses[one][:2], poses[one][2] + math.pi * by)
                                      for one, by in zip((vehicle, other), turned, strict=True))  # fmt: skip
                        relations.update(*own)
                        left, right, oncoming, crossing = relations.of(lane, *there, is_same=lane in roads.path)
                        who = vehicle, roads.own, other, lane, turned
                        assert (left, right) == ((side == 1), (side == -1))[:: -1 if turned[0] else 1], who
                        assert oncoming == (is_opposite if sum(turned) != 1 else side is not None), who
                        assert wanted is None or crossing == wanted, who
                    seen.update(
                        left=left,
                        right=right,
                        oncoming=is_opposite,
                        crossing=crossing,
                        none=not wanted and side is None,
                    )
    assert min(seen["crossing"], seen["none"], seen["left"] + seen["oncoming"]) > 0, seen
