"""The map of a road network for planners: lanes with their outlines and neighbours, stop lines, and a route."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.base.program_message_types import RoadMapData

    Line = NDArray[np.float64]

MAX_SPACING_M = 2.0
"""Upper bound of the distance of two neighbouring points of a `MapLane`."""
_MIN_SPACING_M = 1e-3  # points of one line that are closer count as one point
_MIN_MITRE = 0.25  # cosine of half the largest turn at which the two lines of a lane keep their distance


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MapLane:
    """A lane of a road, or a lane inside a junction.

    Each line is a read-only array of shape (N, 2) with x and y in m. N is the same for the three lines. Neighbouring
    points are at most 2 m apart, and no two of them are equal. The first point is the start of the lane.

    Args:
        id: identifier of the lane in the simulator.
        road: identifier of the road, or of the path across a junction, that the lane belongs to.
        index: index of the lane on its road, as the simulator counts: 0 is the outer lane.
        center: centre line.
        left_line: left edge of the lane.
        right_line: right edge of the lane.
        width: width in m.
        speed_limit: speed limit in m/s.
        length: length in m, as the simulator measures distances. It can differ from the length of the centre line.
        successors: identifiers of the lanes that follow, including lanes inside junctions.
        predecessors: identifiers of the lanes that lead into this lane.
        left: identifier of the neighbouring lane to the left in the same direction; empty if there is none.
        right: identifier of the neighbouring lane to the right in the same direction; empty if there is none.
        can_change_left: whether the vehicle may change to the lane to the left, by its class and by the marking.
        can_change_right: whether the vehicle may change to the lane to the right.
        allowed: the vehicle classes that may use the lane.
        is_open: whether the vehicle may use the lane.
        is_internal: whether the lane is inside a junction.
    """

    id: str
    road: str
    index: int
    center: Line
    left_line: Line
    right_line: Line
    width: float
    speed_limit: float
    length: float
    successors: tuple[str, ...]
    predecessors: tuple[str, ...]
    left: str
    right: str
    can_change_left: bool
    can_change_right: bool
    allowed: frozenset[str]
    is_open: bool
    is_internal: bool


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StopLine:
    """The end of a lane at a junction where a vehicle may have to stop.

    Args:
        lane: identifier of the lane that ends at the stop line.
        junction: identifier of the junction.
        ends: left and right end of the line, read-only, shape (2, 2), in m.
        kind: ``traffic_light``, ``stop`` (stop sign), ``allway_stop``, ``yield`` or ``right_before_left``.
        signal: identifier of the traffic light; empty if there is none.
    """

    lane: str
    junction: str
    ends: Line
    kind: str
    signal: str


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RoadMap:
    """The map that an agent receives as its parameter ``map``: x to the east, y to the north, in m. Read-only.

    Args:
        lanes: all lanes by identifier, including lanes inside junctions.
        stop_lines: the stop lines of all junctions.
        route: identifiers of the lanes of the route in driving order, including lanes inside junctions. Where a lane
            change is necessary, both lanes of the road follow each other. A lane is listed each time that the route
            passes it.
        reference_path: centre of the route as points, shape (N, 2), at most 2 m apart. A lane change is a smooth line.
        is_left_hand: whether traffic drives on the left.
        obstacles: outlines of buildings and other obstacles by identifier, each of shape (N, 2). A vehicle that moves
            freely leaves the road where it touches one.
    """

    lanes: Mapping[str, MapLane]
    stop_lines: tuple[StopLine, ...]
    route: tuple[str, ...]
    reference_path: Line
    is_left_hand: bool
    obstacles: Mapping[str, Line] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleData:
    """The size and the limits of a vehicle, which an agent receives as its parameter ``vehicle``.

    Args:
        length: length in m.
        width: width in m.
        wheelbase: distance of the axles in m.
        rear_axle_offset: distance in m by which the rear axle is behind the centre of the vehicle.
        max_speed: top speed in m/s.
        max_acceleration: largest acceleration in m/s².
        max_deceleration: largest deceleration in normal driving, in m/s².
        emergency_deceleration: largest deceleration of which the vehicle is capable, in m/s².
        kind: class of the vehicle in the simulator, such as ``passenger``.
        max_steering: largest steering angle in rad, to both sides.
        max_steering_rate: largest change of the steering angle, in rad/s.
        max_jerk: largest change of the acceleration, in m/s³.
    """

    length: float
    width: float
    wheelbase: float
    rear_axle_offset: float
    max_speed: float
    max_acceleration: float
    max_deceleration: float
    emergency_deceleration: float
    kind: str
    max_steering: float
    max_steering_rate: float
    max_jerk: float


def describe_road_map(road_map: RoadMap, vehicle: VehicleData) -> RoadMapData:
    """Return a map and the data of a vehicle as JSON-compatible data, always in the same order."""
    return {
        "lanes": {
            name: {
                "id": lane.id, "road": lane.road, "index": lane.index, "center": lane.center.tolist(),
                "left_line": lane.left_line.tolist(), "right_line": lane.right_line.tolist(), "width": lane.width,
                "speed_limit": lane.speed_limit, "length": lane.length, "successors": list(lane.successors),
                "predecessors": list(lane.predecessors), "left": lane.left, "right": lane.right,
                "can_change_left": lane.can_change_left, "can_change_right": lane.can_change_right,
                "allowed": sorted(lane.allowed), "is_open": lane.is_open, "is_internal": lane.is_internal,
            }
            for name, lane in road_map.lanes.items()
        },
        "stop_lines": [
            {"lane": one.lane, "junction": one.junction, "ends": one.ends.tolist(), "kind": one.kind,
             "signal": one.signal}
            for one in road_map.stop_lines
        ],
        "route": list(road_map.route), "reference_path": road_map.reference_path.tolist(),
        "is_left_hand": road_map.is_left_hand, "vehicle": asdict(vehicle),
        "obstacles": {name: outline.tolist() for name, outline in road_map.obstacles.items()},
    }  # fmt: skip


class LaneLines(NamedTuple):
    """Centre line, left line and right line of a lane, each of shape (N, 2)."""

    center: Line
    left: Line
    right: Line


def lane_lines(shape: Sequence[tuple[float, float]], width_m: float) -> LaneLines:
    """Return the centre line and the two edges of a lane, with points at most `MAX_SPACING_M` apart."""
    center = distinct_points(np.array(shape, float))
    if len(center) == 1:
        center = np.vstack((center, center + np.array((10 * _MIN_SPACING_M, 0.0))))
    left, right = (_parallel_line(center, side * width_m / 2) for side in (1.0, -1.0))
    lines = np.stack((center, left, right))
    longest = np.hypot(*np.moveaxis(np.diff(lines, axis=1), 2, 0)).max(axis=0)
    found = _subdivided(lines, np.maximum(1, np.ceil(longest / MAX_SPACING_M - 1e-9)).astype(int))
    found.flags.writeable = False
    return LaneLines(*found)


def distinct_points(line: Line) -> Line:
    """Return a line of shape (N, 2) without points that are equal to the point before."""
    keep = [0] if len(line) else []
    for row in range(1, len(line)):
        if np.hypot(*(line[row] - line[keep[-1]])) >= _MIN_SPACING_M:
            keep.append(row)
    return line if len(keep) == len(line) else line[keep]


def _parallel_line(center: Line, offset_m: float) -> Line:
    """Return a line at a distance to the left of a line, with one point for each point, that never turns back."""
    along = np.diff(center, axis=0)
    along /= np.hypot(along[:, 0], along[:, 1])[:, None]
    normal = np.column_stack((-along[:, 1], along[:, 0]))
    before, after = np.vstack((normal[:1], normal)), np.vstack((normal, normal[-1:]))
    middle = before + after
    length = np.hypot(middle[:, 0], middle[:, 1])
    middle = np.where(length[:, None] > 1e-9, middle / np.maximum(length, 1e-9)[:, None], after)
    mitre = np.maximum(_MIN_MITRE, np.einsum("ij,ij->i", middle, after))
    found: Line = center + offset_m * middle / mitre[:, None]
    advance = np.einsum("ij,ij->i", np.diff(found, axis=0), along)
    if (advance < _MIN_SPACING_M).any():  # the inner edge of a bend that is narrower than the lane
        for row, direction in enumerate(along):
            behind = float((found[row + 1] - found[row]) @ direction)
            if behind < _MIN_SPACING_M:
                found[row + 1] += (_MIN_SPACING_M - behind) * direction
    return found


def _subdivided(lines: Line, pieces: NDArray[np.intp]) -> Line:
    """Return lines of shape (…, N, 2) with each segment divided into a number of equal pieces."""
    if (pieces == 1).all():
        return lines.copy()
    first = np.repeat(np.arange(len(pieces)), pieces)
    share = (np.arange(len(first)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[first]
    start, end = lines[..., first, :], lines[..., first + 1, :]
    return np.concatenate((start + share[:, None] * (end - start), lines[..., -1:, :]), axis=-2)


def spaced_line(line: Line) -> Line:
    """Return a read-only line through distinct points at most `MAX_SPACING_M` apart, from points of shape (N, 2)."""
    line = distinct_points(line)
    length = np.hypot(*np.diff(line, axis=0).T)
    found = (
        _subdivided(line, np.maximum(1, np.ceil(length / MAX_SPACING_M - 1e-9)).astype(int)) if len(line) > 1 else line
    )
    found.flags.writeable = False
    return found
