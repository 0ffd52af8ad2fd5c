"""The parts ``lanes``, ``route`` and ``speed_limit`` on highway-env, with the columns that they have on SUMO."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from highway_env.road.lane import StraightLane
from highway_env.vehicle.controller import ControlledVehicle

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from highway_env.road.lane import AbstractLane
    from highway_env.road.road import RoadNetwork
    from numpy.typing import NDArray

    from crashhunt.simulators import RequestedPart

    Array = NDArray[np.float64]
    _LaneIndex = tuple[str, str, int]

LANE_PARTS = ("lanes", "route", "speed_limit")
"""The parts that this module reads."""

_NODE_M = 0.25  # largest distance of two points of a curved lane, so that chords deviate by less than 1 mm
_NEAR_M = 50.0
# A road back, as in two-way-v0, does not continue a lane, and neither does a road elsewhere, as in lane-keeping-v0.
_MAX_TURN_RAD, _MAX_GAP_M = math.pi / 2, 6.0


class _Line(NamedTuple):
    """The centre line of a lane, in the frame of scenes."""

    along: Array  # distance of each point from the first one, in m
    rows: Array  # columns of each point: 1, x, y, heading (continuous, in rad), width, speed limit, lane index

    def nearest(self, x: float, y: float) -> tuple[float, float]:
        """Return the distance of a point from the line, and how far along the line the nearest point is, in m."""
        points, gaps = self.rows[:, 1:3], np.diff(self.along)
        share = (((x, y) - points[:-1]) * np.diff(points, axis=0)).sum(axis=1) / gaps**2
        share = np.clip(share, 0.0, 1.0)
        found = points[:-1] + share[:, None] * np.diff(points, axis=0)
        away = np.hypot(found[:, 0] - x, found[:, 1] - y)
        first = int(away.argmin())
        return float(away[first]), float(self.along[first] + share[first] * gaps[first])

    def at(self, along: NDArray[np.floating[Any]]) -> Array:
        """Return the columns of points on the line, whose rows are 0 before and behind the line."""
        segment = np.clip(np.searchsorted(self.along, along, side="right") - 1, 0, len(self.along) - 2)
        gap = self.along[segment + 1] - self.along[segment]
        share = (along - self.along[segment]) / np.where(gap > 0.0, gap, 1.0)
        found = self.rows[segment].copy()
        found[:, 1:4] += share[:, None] * (self.rows[segment + 1, 1:4] - found[:, 1:4])
        found[:, 3] = np.remainder(found[:, 3] + math.pi, math.tau) - math.pi
        tolerance_m = 1e-9
        found[(along < self.along[0] - tolerance_m) | (along > self.along[-1] + tolerance_m)] = 0.0
        return found


class LaneParts:
    """Reads lanes and routes in one episode. Reads positions only, and draws no random number."""

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._lines: dict[_LaneIndex, _Line] = {}

    def read(self, vehicle: Any, request: RequestedPart) -> Array:
        """Return a part of `LANE_PARTS` for a vehicle."""
        if request.part.name == "speed_limit":
            return np.array([float(vehicle.lane.speed_limit)])
        return (self._lanes if request.part.name == "lanes" else self._route)(vehicle, request)

    def _lanes(self, vehicle: Any, request: RequestedPart) -> Array:
        lanes, points, columns = request.shape
        spacing = request.settings["spacing"]
        before = min(points - 1, math.floor(request.settings["behind"] / spacing + 1e-9))
        steps = (np.arange(points) - before) * spacing
        found = np.zeros(request.shape)
        for number, index in enumerate(self._shown_lanes(vehicle)[:lanes]):
            if index is not None:
                path, start = self._path(index, vehicle, -float(steps[0]), float(steps[-1]))
                found[number] = path.at(start + steps)[:, :columns]
        return found

    def _route(self, vehicle: Any, request: RequestedPart) -> Array:
        points, spacing = request.shape[0], request.settings["spacing"]
        before = min(points - 1, math.floor(request.settings["behind"] / spacing + 1e-9))
        path, start = self._path(vehicle.lane_index, vehicle, before * spacing, points * spacing)
        before = min(before, math.floor((start - float(path.along[0])) / spacing + 1e-9))
        return path.at(start + (np.arange(points) - before) * spacing)[:, (0, 1, 2, 3, 5, 6)]

    def _shown_lanes(self, vehicle: Any) -> list[_LaneIndex | None]:
        """Return the own lane, its left and right neighbour, then the nearest others."""
        start, end, number = own = vehicle.lane_index
        road = self._network.graph[start][end]
        sides: list[_LaneIndex | None] = []
        for side in (number - 1, number + 1):  # highway-env numbers lanes from the left
            is_usable = 0 <= side < len(road) and not road[side].forbidden
            sides.append((start, end, side) if is_usable else None)
        x, y = _place_of(vehicle)
        others = []
        for index, lane in self._network.lanes_dict().items():
            if index != own and index not in sides and not lane.forbidden:
                others.append((self._line(index).nearest(x, y)[0], index))
        others.sort(key=lambda one: one[0])
        return [own, *sides, *(index for away, index in others if away <= _NEAR_M)]

    def _path(self, index: _LaneIndex, vehicle: Any, behind_m: float, ahead_m: float) -> tuple[_Line, float]:
        """Return the line through a lane, and how far along the line the point nearest to a vehicle is, in m."""
        own = self._line(index)
        # A lane may end next to the place where the next one begins, so its last point must not be that of the next.
        start = min(own.nearest(*_place_of(vehicle))[1], float(own.along[-1]) - 1e-6)
        planned = {road[0]: road[1] for road in _route_of(vehicle)}
        after = self._chain(index, ahead_m - (float(own.along[-1]) - start), lambda one: self._next(one, planned))
        before = self._chain(index, behind_m - start, self._previous)[::-1]
        lines = [*before, own, *after]
        begins = np.cumsum([0.0, *(float(line.along[-1]) for line in lines)])
        along = np.concatenate([line.along + begin for line, begin in zip(lines, begins, strict=False)])
        return _Line(along, np.concatenate([line.rows for line in lines])), float(begins[len(before)]) + start

    def _chain(
        self, index: _LaneIndex, length_m: float, follow: Callable[[_LaneIndex], _LaneIndex | None]
    ) -> list[_Line]:
        """Return the lines that a function finds one after the other, until they have a total length."""
        found: list[_Line] = []
        while length_m > 0.0 and (after := follow(index)) is not None:
            index = after
            found.append(self._line(index))
            length_m -= float(found[-1].along[-1])
        return found

    def _next(self, index: _LaneIndex, planned: Mapping[str, str]) -> _LaneIndex | None:
        """Return the lane after a lane: on the planned route, or with the smallest turn."""
        roads = self._network.graph.get(index[1], {})
        end = self._line(index).rows[-1]
        onward = planned.get(index[1], "")
        if onward in roads:
            return self._lane_of((index[1], onward), index, end, 0)
        return self._straightest(((index[1], to) for to in roads), index, end, 0)

    def _previous(self, index: _LaneIndex) -> _LaneIndex | None:
        """Return the lane that leads into a lane with the smallest turn."""
        graph = self._network.graph
        roads = ((start, index[0]) for start in graph if index[0] in graph[start])
        return self._straightest(roads, index, self._line(index).rows[0], -1)

    def _straightest(
        self, roads: Iterable[tuple[str, str]], index: _LaneIndex, here: Array, end: int
    ) -> _LaneIndex | None:
        """Return the lane with the smallest turn, of those that join a lane; None if no lane does.

        The row ``end``, where the roads meet, is 0 or -1.
        """
        found = []
        for road in roads:
            other = self._lane_of(road, index, here, end)
            there = self._line(other).rows[end]
            turn = abs(math.remainder(float(there[3] - here[3]), math.tau))
            if turn <= _MAX_TURN_RAD and math.dist(there[1:3], here[1:3]) <= _MAX_GAP_M:
                found.append((turn, other))
        return min(found, default=(0.0, None))[1]

    def _lane_of(self, road: tuple[str, str], index: _LaneIndex, here: Array, end: int) -> _LaneIndex:
        """Return the lane of a road that continues a lane, as highway-env does: of the same number, or the nearest."""
        graph = self._network.graph
        lanes = len(graph[road[0]][road[1]])
        if lanes == len(graph[index[0]][index[1]]):
            return (*road, index[2] or 0)
        return min(
            ((*road, number) for number in range(lanes)),
            key=lambda one: math.dist(self._line(one).rows[end, 1:3], here[1:3]),
        )

    def _line(self, index: _LaneIndex) -> _Line:
        found = self._lines.get(index)
        if found is None:
            lanes_of_road = len(self._network.graph[index[0]][index[1]])
            lane = self._network.get_lane(index)
            found = self._lines[index] = _line_of(lane, lanes_of_road - 1 - (index[2] or 0))
        return found


def _line_of(lane: AbstractLane, lane_index: int) -> _Line:
    count = 2 if type(lane) is StraightLane else max(2, math.ceil(lane.length / _NODE_M) + 1)
    places = [lane.length * number / (count - 1) for number in range(count)]
    points = np.array([lane.position(place, 0.0) for place in places]) * (1.0, -1.0)  # its y axis points down
    headings = np.unwrap([-float(lane.heading_at(place)) for place in places])
    widths = [float(lane.width_at(place)) for place in places]
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    rest = np.full((count, 2), (float(lane.speed_limit), float(lane_index)))
    return _Line(along, np.column_stack((np.ones(count), points, headings, widths, rest)))


def _place_of(vehicle: Any) -> tuple[float, float]:
    x, y = vehicle.position.tolist()
    return x, 0.0 - y


def _route_of(vehicle: Any) -> Iterable[_LaneIndex]:
    """Return the planned route of a vehicle, which only a ControlledVehicle has."""
    return (vehicle.route or ()) if isinstance(vehicle, ControlledVehicle) else ()
