"""The lanes of a road network as arrays, so that coordinates on many lanes are computed together.

On a lane along an axis, the scalar product has no rounding that depends on the processor's multiply-add instructions.
So arrays give the same bits as highway-env's scalar products. For all other lanes this module evaluates highway-env's
own expressions, one lane at a time, and only if the lane's bounding box is near enough.
"""

from __future__ import annotations

import inspect
import math
from typing import TYPE_CHECKING

import numpy as np
from highway_env.road.lane import AbstractLane, CircularLane, SineLane, StraightLane
from highway_env.road.road import RoadNetwork

from crashhunt.accelerator._versions import are_numbers, is_plain

if TYPE_CHECKING:
    from numpy.typing import NDArray


__all__ = ["Network", "wrap_to_pi"]


_SAMPLES = 65  # points of a curved lane for its bounding box
_TAU = 2 * np.pi
_ON_LANE_MARGIN = 1  # m; highway-env's lateral margin for neighbours on a lane


def wrap_to_pi(x: float) -> float:
    """Return an angle between -pi and pi, with highway-env's own expression."""
    return ((x + np.pi) % _TAU) - np.pi


class Network:
    """The lanes of a network, numbered in the order in which highway-env compares them.

    Attributes:
        lanes: All lanes, by number.
        index: The number of each lane, by its key.
        number: The number of each lane, by the ``id()`` of the lane.
        keys: The keys of all lanes, by number.
        plain: Whether all lanes have a known class; otherwise the object must not be used.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self.network = network
        self.keys, self.lanes = _laid_out(network)
        self._seen = _values(self.lanes)
        self._arrays = [value for values in self._seen for value in values if isinstance(value, np.ndarray)]
        self._contents = [array.tobytes() for array in self._arrays]
        self._reach = _reach()
        self.index = {key: number for number, key in enumerate(self.keys)}
        #: the lanes in the kernel, by whether the road also searches connected lanes for neighbours
        self.compiled: dict[bool, object] = {}
        self.number = {id(lane): number for number, lane in enumerate(self.lanes)}
        self.plain = type(network) is RoadNetwork and all(map(_is_known, self.lanes)) and bool(self.lanes)
        if not self.plain:
            return
        straight = [type(lane) is StraightLane and 0.0 in lane.direction.tolist() for lane in self.lanes]
        self.is_axis = straight
        self.axis = np.flatnonzero(straight)
        self.others = np.flatnonzero(np.logical_not(straight)).tolist()
        along = [lane for lane, is_axis in zip(self.lanes, straight, strict=True) if is_axis]
        columns = [
            (
                *lane.start.tolist(),
                *lane.direction.tolist(),
                *lane.direction_lateral.tolist(),
                lane.length,
                lane.heading,
            )
            for lane in along
        ]
        table = np.array(columns, float).reshape(-1, 8).T
        self.start_x, self.start_y, self.along_x, self.along_y, self.across_x, self.across_y = table[:6]
        self.length, self.heading = table[6:]
        # Parallel lanes share one heading, which makes the arrays of angles smaller.
        self.headings = self.heading[:1] if len(set(self.heading.tolist())) == 1 else self.heading
        self.every_length = np.array([lane.length for lane in self.lanes], float)
        self.lengths = [float(lane.length) for lane in self.lanes]
        self.half_widths = [float(lane.width) / 2 + _ON_LANE_MARGIN for lane in self.lanes]
        self.widths = [float(lane.width) for lane in self.lanes]
        self.half_width = np.array(self.half_widths)[straight]  # of lanes along an axis, like `length` and `heading`
        self.limit = np.array([_limits(lane.speed_limit) for lane in self.lanes]).T
        boxes = np.array([_box(self.lanes[number]) for number in self.others]).reshape(-1, 4)
        self.low_x, self.low_y, self.high_x, self.high_y = boxes.T
        self.axis_columns = np.full(len(self.lanes), -1)
        self.axis_columns[self.axis] = np.arange(len(self.axis))
        #: the column of a lane in the arrays of lanes along an axis, or in the arrays of the other lanes
        self.column = {number: column for column, number in enumerate(self.axis.tolist())}
        self.column |= {number: column for column, number in enumerate(self.others)}

    def is_of(self, network: RoadNetwork) -> bool:
        """Whether the network still has the same lane objects with unchanged keys and attributes."""
        keys, lanes = _laid_out(network)
        if network is not self.network or keys != self.keys or list(map(id, lanes)) != list(map(id, self.lanes)):
            return False
        try:  # comparing two different array objects raises ValueError
            same = _values(lanes) == self._seen and self._reach == _reach()
        except ValueError:
            return False
        return same and [array.tobytes() for array in self._arrays] == self._contents

    def on_axis(
        self, x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return longitudinal and lateral coordinates on the lanes along an axis, each of shape (points, lanes)."""
        dx, dy = x[:, None] - self.start_x, y[:, None] - self.start_y
        # NumPy's scalar product begins with 0.0, which decides the sign of a zero result.
        return (0.0 + dx * self.along_x) + dy * self.along_y, (0.0 + dx * self.across_x) + dy * self.across_y

    def box_distance(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return lower bounds of the distances from the lanes not along an axis, of shape (points, lanes), in m."""
        dx = np.maximum(np.maximum(self.low_x - x[:, None], x[:, None] - self.high_x), 0.0)
        dy = np.maximum(np.maximum(self.low_y - y[:, None], y[:, None] - self.high_y), 0.0)
        distance: NDArray[np.float64] = np.hypot(dx, dy) - 1e-6
        return distance

    def coordinates(self, number: int, position: NDArray[np.float64]) -> tuple[float, float]:
        """Return the coordinates of a position on one lane, by highway-env's own expressions."""
        lane = self.lanes[number]
        if type(lane) is CircularLane:
            delta = position - lane.center
            phi = float(np.arctan2(delta[1], delta[0])) - lane.start_phase
            phi = lane.start_phase + wrap_to_pi(phi)
            radius = math.sqrt(np.dot(delta, delta))
            return lane.direction * (phi - lane.start_phase) * lane.radius, lane.direction * (lane.radius - radius)
        s, r = lane.local_coordinates(position)
        return float(s), float(r)

    def heading_at(self, number: int, s: float) -> float:
        """Return the heading of a lane at a longitudinal coordinate."""
        lane = self.lanes[number]
        if type(lane) is StraightLane:
            return float(lane.heading)
        if type(lane) is CircularLane:
            return float((lane.direction * s / lane.radius + lane.start_phase) + np.pi / 2 * lane.direction)
        return float(lane.heading_at(s))

    def headings_at(self, numbers: NDArray[np.intp], s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the headings of lanes, each at a longitudinal coordinate."""
        columns = self.axis_columns[numbers]
        if not len(columns) or columns.min() >= 0:
            found: NDArray[np.float64] = self.heading[columns]
            return found
        return np.array([self.heading_at(number, at) for number, at in zip(numbers.tolist(), s.tolist(), strict=True)])

    def distance(self, number: int, s: float, r: float, heading: float) -> float:
        """Return highway-env's distance of a vehicle from a lane, which includes the difference in heading."""
        length = self.lengths[number]
        angle = abs(wrap_to_pi(heading - self.heading_at(number, s)))
        return abs(r) + (s - length if s > length else 0) + (0 - s if s < 0 else 0) + 1.0 * angle

    def is_on(self, number: int, s: float, r: float) -> bool:
        """Whether highway-env's search for neighbours counts a position as on the lane."""
        return abs(r) <= self.half_widths[number] and -5 <= s < self.lengths[number] + 5

    def is_reachable(self, number: int, s: float, r: float) -> bool:
        """Whether highway-env counts the lane as reachable from a position, for a lane change."""
        return (
            not self.lanes[number].forbidden and abs(r) <= 2 * self.widths[number] and 0 <= s < self.lengths[number] + 5
        )


def _laid_out(network: RoadNetwork) -> tuple[list[tuple[str, str, int]], list[AbstractLane]]:
    """Return all keys and lanes in highway-env's order of comparison; empty if the network has its own methods."""
    keys, lanes = [], []
    if type(network) is RoadNetwork and vars(network).keys() == {"graph"}:
        for start, ends in network.graph.items():
            for end, row in ends.items():
                for number, lane in enumerate(row):
                    keys.append((start, end, number))
                    lanes.append(lane)
    return keys, lanes


def _values(lanes: list[AbstractLane]) -> list[tuple[object, ...]]:
    return [tuple(vars(lane).values()) if type(lane) in _KNOWN else () for lane in lanes]


def _limits(speed_limit: float | None) -> tuple[float, float]:
    """Return the bounds of a driver's target speed on a lane, in m/s."""
    return (0.0, float(speed_limit)) if speed_limit is not None else (-math.inf, math.inf)


def _reach() -> list[float]:
    """Return the distance in m by which each class of lanes extends beyond its end."""
    return [kind.VEHICLE_LENGTH for kind in _KNOWN]


def _is_known(lane: AbstractLane) -> bool:
    kind = type(lane)
    if kind not in _KNOWN:
        return False
    values = vars(lane)
    if "VEHICLE_LENGTH" in values or kind.VEHICLE_LENGTH != 5 or not _KNOWN[kind].isdisjoint(values):
        return False
    arrays = [values.get(name) for name in _ARRAYS[kind]]
    return (
        are_numbers(values.get(name) for name in _NUMBERS[kind])
        and (values.get("speed_limit") is None or are_numbers([values["speed_limit"]]))
        and "forbidden" in values
        and all(type(array) is np.ndarray and array.shape == (2,) and array.dtype in _DTYPES for array in arrays)
    )


_KNOWN = {
    kind: frozenset(name for name in dir(kind) if not is_plain(inspect.getattr_static(kind, name)))
    for kind in (StraightLane, SineLane, CircularLane)
}
_NUMBERS = {
    StraightLane: ("length", "width", "heading"),
    SineLane: ("length", "width", "heading", "amplitude", "pulsation", "phase"),
    CircularLane: ("length", "width", "radius", "start_phase", "direction"),
}
_ARRAYS = {
    StraightLane: ("start", "direction", "direction_lateral"),
    SineLane: ("start", "direction", "direction_lateral"),
    CircularLane: ("center",),
}
_DTYPES = (np.dtype(np.float64), np.dtype(np.int64))


def _box(lane: AbstractLane) -> tuple[float, float, float, float]:
    """Return the bounding box of a lane's centre line, padded for the curve between samples and beyond the ends."""
    spacing = float(lane.length) / (_SAMPLES - 1)
    points = np.array([lane.position(spacing * number, 0.0) for number in range(_SAMPLES)])
    pad = 1e-6
    if isinstance(lane, CircularLane):
        pad += spacing
    elif isinstance(lane, SineLane):
        pad += 2 * abs(lane.amplitude)
    low, high = points.min(axis=0) - pad, points.max(axis=0) + pad
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
