"""The road and the obstacles that SUMO knows: where vehicles may drive, and what stands in their way."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import libsumo
import numpy as np
from libsumo import _libsumo as sumo

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.simulators import MotionState


_RECENT_LANES = 4  # looked at before SUMO is asked for the lane below a point
_OBSTACLES = ("building", "obstacle")  # types of polygons


def obstacle_outlines() -> dict[str, list[tuple[float, float]]]:
    """Return the outline of each polygon of the episode that is an obstacle, by identifier, in order."""
    shapes = {
        name: [tuple(point[:2]) for point in sumo.polygon_getShape(name)]
        for name in sorted(sumo.polygon_getIDList())
        if sumo.polygon_getType(name).partition(".")[0] in _OBSTACLES
    }
    return {name: shape for name, shape in shapes.items() if len(shape) > 2}


class DrivableArea:
    """The lanes that a class of vehicles may use, the junctions between them, and the obstacles.

    SUMO finds the lane below a point; of each lane that was below one, the geometry is kept. Obstacles are the polygons
    of additional files whose type is ``building`` or ``obstacle``, or begins so, such as ``building.school``.
    """

    def __init__(self) -> None:
        self._obstacles: list[tuple[str, Sequence[tuple[float, float]]]] = []
        self._boxes = np.zeros((0, 4))  # least and largest x and y of each obstacle
        self._lanes: dict[str, tuple[Sequence[tuple[float, float]], float]] = {}
        self._junctions: dict[str, Sequence[tuple[float, float]]] = {}
        self._recent: dict[str, list[str]] = {}  # lanes by vehicle class, the last one first
        self._open: dict[tuple[str, str], list[str]] = {}

    def read_obstacles(self) -> None:
        """Read the obstacles of the episode."""
        self._obstacles.clear()
        self._recent.clear()
        for name, shape in obstacle_outlines().items():
            self._obstacles.append((f"{sumo.polygon_getType(name)} {name!r}", shape))
        boxes = [(*np.min(shape, axis=0), *np.max(shape, axis=0)) for _, shape in self._obstacles]
        self._boxes = np.array(boxes).reshape(-1, 4)

    @property
    def has_obstacles(self) -> bool:
        """Whether there are obstacles in this episode."""
        return bool(self._obstacles)

    def obstacle_at(self, corners: Sequence[tuple[float, float]]) -> str:
        """Return type and identifier of the first obstacle that an outline touches; empty if there is none."""
        (low_x, low_y), (high_x, high_y) = np.min(corners, axis=0), np.max(corners, axis=0)
        x0, y0, x1, y1 = self._boxes.T
        near = np.flatnonzero((x0 <= high_x) & (x1 >= low_x) & (y0 <= high_y) & (y1 >= low_y))
        found = (self._obstacles[one] for one in near)
        return next((name for name, shape in found if _overlap(corners, shape)), "")

    def contains(self, x: float, y: float, kind: str) -> bool:
        """Return whether a point is on a lane that a class of vehicles may use, or inside a junction."""
        recent = self._recent.get(kind, [])
        for place, lane in enumerate(recent):
            if self._is_on(lane, x, y):
                if place:
                    recent.insert(0, recent.pop(place))
                return True
        try:
            edge, _, lane = sumo.simulation_convertRoad(x, y, False, kind)
        except libsumo.TraCIException:
            return False  # no lane of this class is near
        for found in (f"{edge}_{lane}", *self._open_lanes(edge, kind)):
            if self._is_on(found, x, y):
                self._recent[kind] = [found, *(one for one in recent if one != found)][:_RECENT_LANES]
                return True
        return any(
            _is_inside(x, y, self._shape(junction))
            for junction in {sumo.edge_getFromJunction(edge), sumo.edge_getToJunction(edge)}
        )

    def lane_around(self, state: MotionState, half: float, half_width: float, kind: str) -> str:
        """Return the lane that was last found for a class of vehicles, if a rectangle is on one straight part of it.

        The rectangle has half the given length and width, in m, around the pose of its centre.
        """
        recent = self._recent.get(kind)
        if not recent:
            return ""
        shape, border = self._lane(recent[0])
        x, y, cos, sin = state.x, state.y, math.cos(state.heading), math.sin(state.heading)
        for (ax, ay), (bx, by) in pairwise(shape):
            dx, dy = bx - ax, by - ay
            length = math.sqrt(dx * dx + dy * dy)
            along, across = abs(cos * dx + sin * dy), abs(cos * dy - sin * dx)
            reach = half * along + half_width * across  # times the length, as all lengths here
            if (
                reach <= (x - ax) * dx + (y - ay) * dy <= length * length - reach
                and abs((y - ay) * dx - (x - ax) * dy) + half * across + half_width * along <= border * length
            ):
                return recent[0]
        return ""

    def _open_lanes(self, edge: str, kind: str) -> Sequence[str]:
        """Return the lanes of an edge that a vehicle class may use; the nearest centre line may be of another lane."""
        found = self._open.get((edge, kind))
        if found is None:
            lanes = [f"{edge}_{lane}" for lane in range(sumo.edge_getLaneNumber(edge))]
            found = self._open[edge, kind] = [one for one in lanes if kind not in sumo.lane_getDisallowed(one)]
        return found

    def _is_on(self, lane: str, x: float, y: float) -> bool:
        shape, half = self._lane(lane)
        return any(_distance_squared(x, y, *start, *end) <= half * half for start, end in pairwise(shape))

    def _lane(self, lane: str) -> tuple[Sequence[tuple[float, float]], float]:
        """Return the centre line of a lane, and half its width in m."""
        found = self._lanes.get(lane)
        if found is None:
            found = self._lanes[lane] = (
                [tuple(point[:2]) for point in sumo.lane_getShape(lane)],
                sumo.lane_getWidth(lane) / 2,
            )
        return found

    def _shape(self, junction: str) -> Sequence[tuple[float, float]]:
        found = self._junctions.get(junction)
        if found is None:
            found = self._junctions[junction] = [tuple(point[:2]) for point in sumo.junction_getShape(junction)]
        return found


def offset_from(path: Sequence[tuple[float, float]], x: float, y: float) -> tuple[float, float]:
    """Return how far a point is to the left of the nearest part of a path, in m, and the direction of this part."""
    nearest = (math.inf, 0.0, 0.0)
    for (ax, ay), (bx, by) in pairwise(path):
        squared, direction = _distance_squared(x, y, ax, ay, bx, by), math.atan2(by - ay, bx - ax)
        if squared < nearest[0] and (ax, ay) != (bx, by):
            nearest = squared, (y - ay) * math.cos(direction) - (x - ax) * math.sin(direction), direction
    return nearest[1:]


def _distance_squared(x: float, y: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Return the squared distance of a point from a line between two points, in m²."""
    dx, dy = bx - ax, by - ay
    squared = dx * dx + dy * dy
    share = 0.0 if squared == 0.0 else max(0.0, min(1.0, ((x - ax) * dx + (y - ay) * dy) / squared))
    return (ax + share * dx - x) ** 2 + (ay + share * dy - y) ** 2


def _overlap(one: Sequence[tuple[float, float]], two: Sequence[tuple[float, float]]) -> bool:
    """Return whether two polygons overlap: their sides cross, or a corner of one is inside the other."""
    if any(_is_inside(*corner, two) for corner in one) or any(_is_inside(*corner, one) for corner in two):
        return True
    return any(_cross(a, b, c, d) for a, b in _sides(one) for c, d in _sides(two))


def _sides(shape: Sequence[tuple[float, float]]) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    return list(zip(shape, [*shape[1:], *shape[:1]], strict=True))


def _cross(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float], d: tuple[float, float]) -> bool:
    """Return whether two lines between points cross."""

    def side(p: tuple[float, float], q: tuple[float, float], r: tuple[float, float]) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0


def _is_inside(x: float, y: float, shape: Sequence[tuple[float, float]]) -> bool:
    """Return whether a point is inside a polygon, by the number of its sides to the right of the point."""
    inside = False
    for (ax, ay), (bx, by) in _sides(shape):
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
    return inside
