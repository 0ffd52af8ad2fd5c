"""The bends of long SUMO vehicles: they bend along the lanes that they occupy, as in SUMO's own geometry."""

from __future__ import annotations

import math
from bisect import bisect_right
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

from libsumo import _libsumo as sumo

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from crashhunt.world import Spine

_RAIL_CLASSES = frozenset({"rail", "rail_urban", "rail_electric", "rail_fast", "tram", "subway", "cable_car"})
_RIGID_M = 15.0  # longest rigid bus in the EU (Directive 96/53/EC, Annex I); a longer vehicle has a joint
_JOINT_M = 6.0  # a shorter rail vehicle or trailer is treated as rigid
_PIECE_M = 5.0  # longest straight piece of a bent vehicle: a car's length
_STRAIGHT_M = 0.05  # a vehicle that deviates less from a straight line is treated as straight
_MIRRORED_M = 0.01  # a line that begins further from the front bumper may be on the wrong side of its lane
_MISPLACED_M = 1.0  # a vehicle further from its lane, as after moveToXY, is treated as straight

Point = tuple[float, float]


def is_articulated(kind: str, length: float) -> bool:
    """Return whether a vehicle has joints: rail vehicles, trailers, and vehicles longer than a rigid bus."""
    jointed = kind in _RAIL_CLASSES or kind == "trailer"
    return length > (_JOINT_M if jointed else _RIGID_M)


class Bends:
    """Computes the centre lines of long vehicles.

    SUMO moves the front and the back of a vehicle along the same lanes. After a lane change, the whole vehicle is in
    the new lane. Therefore a vehicle's centre line follows the lanes from its front backwards along its route.
    """

    def __init__(self, *, lateral: bool) -> None:
        self._lateral = lateral
        self._shapes: dict[str, tuple[list[Point], list[float], float]] = {}
        self._sources: dict[str, list[str]] = {}
        self._used: dict[str, dict[str, str]] = {}

    def reset(self) -> None:
        """Delete the stored vehicles of the last episode."""
        self._used.clear()

    def spine(self, vehicle: str, length: float, front: Point, heading: float, *, high: bool) -> Spine | None:
        """Return the centre line of a vehicle; None if the vehicle is straight.

        The heading is that of SUMO, in rad; of a train, that of its first carriage. Without ``high``, the network has
        no heights, and z is 0.
        """
        lane = sumo.vehicle_getLaneID(vehicle)
        if not lane:
            return None
        edge = sumo.lane_getEdgeID(lane)
        self._used.setdefault(vehicle, {})[edge] = lane
        pieces = max(2, math.ceil(length / _PIECE_M))
        line = list(self._behind(vehicle, lane, sumo.vehicle_getLanePosition(vehicle), length))
        distances = [0.0, *accumulate(math.dist(a, b) for (a, *_), (b, *_) in pairwise(line))]
        if self._lateral:
            left = sumo.vehicle_getLateralLanePosition(vehicle)
            moved = _shifted(line, left)
            # In left-hand traffic, SUMO mirrors the offsets of all vehicles but those that it has moved to a position.
            if moved and math.dist(moved[0][0], front) > _MIRRORED_M:
                moved = min(moved, _shifted(line, -left), key=lambda one: math.dist(one[0][0], front))
            line = moved
        if len(line) < 2 or math.dist(line[0][0], front) > _MISPLACED_M:
            return None
        found = []
        for number in range(pieces + 1):
            place = length * number / pieces
            index = min(max(bisect_right(distances, place), 1), len(line) - 1)
            (x, y), _, _ = line[index - 1]
            (back_x, back_y), on, at = line[index]
            share = (place - distances[index - 1]) / max(distances[index] - distances[index - 1], 1e-9)
            # Behind the beginning of its route, the vehicle is straight.
            x, y = x + share * (back_x - x), y + share * (back_y - y)
            found.append((x, y, height_at(on, at) if high else 0.0))
        return None if _is_straight(found, length, heading) else tuple(found)

    def _behind(self, vehicle: str, lane: str, position: float, length: float) -> Iterator[tuple[Point, str, float]]:
        """Yield the points of the lanes backwards from a vehicle's front, each with its lane and its position."""
        route = sumo.vehicle_getRoute(vehicle)
        edge = sumo.vehicle_getRouteIndex(vehicle) - (not lane.startswith(":"))  # index of the edge before this lane
        driven = 0.0
        while True:
            points, places, scale = self._shape(lane)
            place = min(position * scale, places[-1])
            last = max(bisect_right(places, place), 1) - 1
            if last + 1 < len(points) and places[last + 1] > places[last]:
                share = (place - places[last]) / (places[last + 1] - places[last])
                (x, y), (next_x, next_y) = points[last], points[last + 1]
                yield (x + share * (next_x - x), y + share * (next_y - y)), lane, position
            for index in range(last, -1, -1):
                yield points[index], lane, places[index] / scale
            driven += place
            if driven >= length or edge < 0:
                return
            before = self._before(vehicle, lane, route[edge])
            if not before:
                return
            lane, position = before, sumo.lane_getLength(before)
            edge -= not lane.startswith(":")

    def _before(self, vehicle: str, lane: str, edge: str) -> str:
        """Return the lane on ``edge`` from which a vehicle came onto ``lane``; empty if there is none."""
        if not self._sources:
            self._find_sources()
        used = self._used[vehicle].get(edge)
        found = []
        for source in self._sources.get(lane, ()):
            start = source
            while start.startswith(":") and start in self._sources:
                (start, *_) = self._sources[start]  # an internal lane has exactly one predecessor
            if start.rpartition("_")[0] == edge:
                found.append((start != used, source))
        return min(found)[1] if found else ""

    def _find_sources(self) -> None:
        for lane in sumo.lane_getIDList():
            for link in sumo.lane_getLinks(lane):
                target = link[4] or link[0]
                self._sources.setdefault(target, []).append(lane)

    def _shape(self, lane: str) -> tuple[list[Point], list[float], float]:
        """Return a lane's points, their distances along it (m), and the ratio of its drawn length to SUMO's length."""
        found = self._shapes.get(lane)
        if found is None:
            points = [(x, y) for x, y, *_ in sumo.lane_getShape(lane)]
            places = [0.0, *accumulate(math.dist(a, b) for a, b in pairwise(points))]
            found = self._shapes[lane] = points, places, max(places[-1], 1e-6) / max(sumo.lane_getLength(lane), 1e-6)
        return found


def _shifted(line: list[tuple[Point, str, float]], left: float) -> list[tuple[Point, str, float]]:
    """Return a line, whose points run backwards, after moving it to the left as seen in driving direction."""
    moved = []
    for index, ((x, y), lane, place) in enumerate(line):
        (ax, ay), (bx, by) = line[max(index - 1, 0)][0], line[min(index + 1, len(line) - 1)][0]
        dx, dy = ax - bx, ay - by
        norm = math.hypot(dx, dy) or 1.0
        moved.append(((x - dy / norm * left, y + dx / norm * left), lane, place))
    return moved


def height_at(lane: str, position: float) -> float:
    """Return z of a lane's centre line at a position, in m; a position beyond an end is replaced by that end."""
    edge, _, index = lane.rpartition("_")
    # SUMO refuses a position that exceeds the length of the lane by a rounding error.
    position = max(0.0, min(position, sumo.lane_getLength(lane) - 1e-6))
    place = sumo.simulation_convert3D(edge, position, int(index), False)
    return float(place[2]) if len(place) > 2 else 0.0


def _is_straight(spine: Sequence[tuple[float, float, float]], length: float, heading: float) -> bool:
    """Return whether one rectangle with this heading covers the vehicle within `_STRAIGHT_M`."""
    (x, y, _), c, s = spine[0], math.cos(heading), math.sin(heading)
    if math.dist(spine[-1][:2], (x - length * c, y - length * s)) > _STRAIGHT_M:
        return False
    return all(abs((px - x) * s - (py - y) * c) < _STRAIGHT_M for px, py, _ in spine)
