"""The vehicles and objects of a road as arrays: positions, coordinates on lanes, and parameters of drivers."""

from __future__ import annotations

from bisect import bisect_left
from functools import cached_property
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.objects import Landmark

from crashhunt.accelerator._versions import NUMBERS_OF, are_numbers, kinds_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from highway_env.road.road import LaneIndex, Road
    from highway_env.vehicle.kinematics import Vehicle
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.accelerator._network import Network
    from crashhunt.accelerator._versions import Kind

    Pairs = tuple[NDArray[np.bool_], NDArray[np.float64]]  # who may touch which, and within which distance


__all__ = ["ASK", "MANY", "NO_VEHICLE", "PARAMETERS_OF", "Crowd", "Frame", "are_plain", "connected_lanes"]


MANY = 12  # from this number of vehicles on, arrays are used in place of a loop
NO_VEHICLE, ASK = -1, -2


class Frame:
    """The positions of all objects at one instant, with lazily computed coordinates on the lanes.

    Args:
        network: The lanes of the road.
        road: The road with its vehicles and objects.
        places: The positions in m, of shape (things, 2); None to read them from the objects.
        before: An earlier frame of the same objects, or None.

    Attributes:
        plain: Whether all positions have the usual type; otherwise the frame must not be used.
    """

    def __init__(
        self, network: Network, road: Road, places: NDArray[np.float64] | None = None, before: Frame | None = None
    ) -> None:
        self.network = network
        self.road = road
        self._looks_further = road.neighbour_vehicles_connected_lanes
        self.things: list[RoadObject]
        self.row: dict[int, int]
        if before is None:
            self.things = road.vehicles + road.objects
            self.row = {id(thing): row for row, thing in enumerate(self.things)}
        else:
            self.things, self.row, self.no_landmark = before.things, before.row, before.no_landmark
        self.plain = places is not None or are_plain(self.things)
        if not self.plain:
            return
        if places is None:
            places = np.array([thing.position for thing in self.things], float).reshape(-1, 2)
        self.places = places
        self._columns: dict[int, tuple[list[float], list[float]]] = {}
        self._single: dict[tuple[int, int], tuple[float, float]] = {}
        self._queues: dict[LaneIndex, tuple[list[float], list[RoadObject]]] = {}

    def is_of(self, road: Road) -> bool:
        """Whether the road still has the same objects at the same positions."""
        things = road.vehicles + road.objects
        if not self.plain or not are_plain(things):
            return False
        places = np.array([thing.position for thing in things], float).reshape(-1, 2)
        return self.has(things, places)

    def has(self, things: list[RoadObject], places: NDArray[np.float64]) -> bool:
        """Whether the frame has exactly these objects at these positions."""
        # Compare identities, because a user's class may define equality.
        return (
            self.plain
            and list(map(id, things)) == list(self.row)
            and self._looks_further == self.road.neighbour_vehicles_connected_lanes
            and np.array_equal(places, self.places)
        )

    @cached_property
    def on_axis(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coordinates of all objects on the lanes along an axis, each of shape (things, lanes)."""
        return self.network.on_axis(self.places[:, 0], self.places[:, 1])

    @cached_property
    def no_landmark(self) -> NDArray[np.bool_]:
        """Whether each object counts as a neighbour on a lane; landmarks do not."""
        return np.array([not isinstance(thing, Landmark) for thing in self.things], bool)

    @cached_property
    def boxes(self) -> NDArray[np.float64]:
        """Lower bounds of the distances of all objects from the lanes not along an axis."""
        return self.network.box_distance(self.places[:, 0], self.places[:, 1])

    @cached_property
    def _order(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
        """Objects on lanes along an axis, sorted by lane and position: column of the lane, row of the object, m."""
        (s, r), network = self.on_axis, self.network
        on = (np.abs(r) <= network.half_width) & (s >= -5) & (s < network.length + 5) & self.no_landmark[:, None]
        columns, rows = np.nonzero(on.T)
        along = s[rows, columns]
        order = np.lexsort((along, columns))
        return columns[order], rows[order], along[order]

    @cached_property
    def ahead(self) -> NDArray[np.intp]:
        """Row of the next object ahead on each lane along an axis, of shape (things, lanes).

        The value `NO_VEHICLE` means that no object is ahead. The value `ASK` means that the caller must search: the
        object is not on the lane, or two objects are at the same position.
        """
        columns, rows, along = self._order
        found = np.full((len(self.things), len(self.network.axis)), ASK)
        same = columns[1:] == columns[:-1]
        if not (same & (along[1:] == along[:-1])).any():
            after = np.full(len(rows), NO_VEHICLE)
            after[:-1][same] = rows[1:][same]
            found[rows, columns] = after
        return found

    def coordinates_of(
        self, rows: Sequence[int] | NDArray[np.intp], lanes: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the coordinates of objects, each on its given lane."""
        columns = self.network.axis_columns[lanes]
        if len(rows) >= MANY and columns.min() >= 0:
            s, r = self.on_axis
            return s[rows, columns], r[rows, columns]
        pairs = [self.coordinates(row, lane) for row, lane in zip(map(int, rows), lanes.tolist(), strict=True)]
        return np.array([s for s, _ in pairs]), np.array([r for _, r in pairs])

    def coordinates(self, row: int, lane: int) -> tuple[float, float]:
        """Return the coordinates of an object on a lane."""
        columns = self._columns.get(lane)
        if columns is None and self.network.is_axis[lane]:
            columns = self.column(lane)
        if columns is not None:
            return columns[0][row], columns[1][row]
        found = self._single.get((row, lane))
        if found is None:
            found = self._single[row, lane] = self.network.coordinates(lane, self.things[row].position)
        return found

    def column(self, lane: int) -> tuple[list[float], list[float]]:
        """Return the coordinates of all objects on a lane along an axis."""
        found = self._columns.get(lane)
        if found is None:
            (s, r), column = self.on_axis, self.network.column[lane]
            found = self._columns[lane] = s[:, column].tolist(), r[:, column].tolist()
        return found

    def neighbours(
        self, vehicle: RoadObject, row: int, key: LaneIndex
    ) -> tuple[RoadObject | None, RoadObject | None] | None:
        """Return the result of `Road.neighbour_vehicles`, the objects ahead and behind; None if the lane is unknown."""
        try:
            lane = self.network.index.get(key)
        except TypeError:  # highway-env accepts a list as a lane index, which is not hashable
            return None
        if lane is None:
            return None
        queue = self._queues.get(lane)
        if queue is None:
            queue = self._queues[lane] = self._queue(lane)
        places, things = queue
        s = self.coordinates(row, lane)[0]
        if s != s:
            return None, None
        ahead = behind = None
        at = s
        first = bisect_left(places, s)
        for number in range(
            first, len(places)
        ):  # of several objects at the same position, highway-env returns the last
            if things[number] is not vehicle:
                if ahead is not None and places[number] != at:
                    break
                ahead, at = things[number], places[number]
        for number in range(first - 1, -1, -1):  # behind, highway-env returns the first
            if things[number] is not vehicle:
                if behind is not None and places[number] != at:
                    break
                behind, at = things[number], places[number]
        return ahead, behind

    def _queue(self, lane: int) -> tuple[list[float], list[RoadObject]]:
        """Return the positions and objects on a lane, and on connected lanes if the road wants them, in order."""
        if not self._looks_further and len(self.things) >= MANY and self.network.is_axis[lane]:
            return self._axis_queue(lane)
        if not self._looks_further:
            found = self._on_lane(lane)
        else:
            found = []
            seen: set[int] = set()
            for other, offset in connected_lanes(self.network, lane):
                for s, row in self._on_lane(other):
                    if row not in seen:  # the first lane of an object decides
                        seen.add(row)
                        found.append((s + offset, row))
        found.sort()
        return [s for s, _ in found], [self.things[row] for _, row in found]

    def _axis_queue(self, lane: int) -> tuple[list[float], list[RoadObject]]:
        """Return the positions and objects on a lane along an axis, without connected lanes."""
        columns, rows, along = self._order
        begin, end = columns.searchsorted((self.network.column[lane], self.network.column[lane] + 1)).tolist()
        return along[begin:end].tolist(), [self.things[row] for row in rows[begin:end].tolist()]

    def _on_lane(self, lane: int) -> list[tuple[float, int]]:
        network = self.network
        if network.is_axis[lane]:
            s, r = self.column(lane)
            rows: Sequence[int] = range(len(self.things))
        else:
            limit = network.half_widths[lane] + 5
            rows = np.flatnonzero(self.boxes[:, network.column[lane]] <= limit).tolist()
        found = []
        for row in rows:
            place = (s[row], r[row]) if network.is_axis[lane] else self.coordinates(row, lane)
            if network.is_on(lane, *place) and not isinstance(self.things[row], Landmark):
                found.append((place[0], row))
        return found


def connected_lanes(network: Network, lane: int) -> list[tuple[int, float]]:
    """Return a lane, its successors and its predecessors, each with the offset of its coordinates, in m."""
    graph = network.network.graph
    start, end, number = network.keys[lane]
    found = [(lane, 0.0)]
    for after, lanes in graph.get(end, {}).items():
        if lanes:
            chosen = number if number < len(lanes) else 0
            found.append((network.index[end, after, chosen], network.lanes[lane].length))
    for before, ends in graph.items():
        lanes = ends.get(start, [])
        if lanes:
            chosen = network.index[before, start, number if number < len(lanes) else 0]
            found.append((chosen, -network.lanes[chosen].length))
    return found


def are_plain(things: list[RoadObject], kinds: list[Kind] | None = None) -> bool:
    """Whether all positions have the usual type, no two objects share a position array, and no object occurs twice."""
    if not all(map(_PLAIN, kinds or kinds_of(things))):
        return False
    positions = [thing.position for thing in things]
    return (
        len(set(map(id, things))) == len(set(map(id, positions))) == len(things)
        and _ARRAYS.issuperset(map(type, positions))
        and all(map(_is_place, positions))
    )


def _is_place(position: NDArray[np.float64]) -> bool:
    # An unpickled array has an equal dtype that is another object.
    return (position.dtype is _FLOAT or position.dtype == _FLOAT) and position.shape == (2,)


_PLAIN = attrgetter("plain")
_FLOAT = np.dtype(np.float64)
_ARRAYS = frozenset((np.ndarray,))


# All objects of a road, with the attributes that stay constant while no foreign code runs.

_COLLIDES, _MOVES = attrgetter("collides"), attrgetter("moves")
_STEEP = 20.0  # with a larger IDM exponent, an acceleration may overflow
_POSE = attrgetter("heading", "speed")
_NAMES = NUMBERS_OF["idm"]  # the names of all other bases are a prefix of these
PARAMETERS_OF = {how: attrgetter(*names) for how, names in NUMBERS_OF.items()}


class Crowd:
    """The state and parameters of all vehicles and objects of a road; `move` updates the state.

    Args:
        road: The road with its vehicles and objects.

    Attributes:
        drives: Whether the accelerator knows how all vehicles decide, and all their parameters are usual numbers.
        moves: Whether the accelerator knows how all vehicles move.
        collides: Whether the accelerator knows how all objects collide.
        things: The vehicles, then the objects; the arrays have a row for each.
        places: Positions in m, of shape (things, 2).
        headings: Headings in rad.
        speeds: Speeds in m/s.
        lanes: The numbers of the vehicles' lanes; None until `move` has found them.
        idm: Rows of the vehicles with the IDM and MOBIL models.
        controlled: Rows of the vehicles that keep a target speed and a target lane.
        sliding: Rows of the vehicles with the dynamic bicycle model.
        of_numpy: Rows of the vehicles whose speeds are NumPy floats and must stay so.
        timed: The vehicles that count the time since their last decision about a lane change.
    """

    def __init__(self, road: Road) -> None:
        self.road = road
        self.things: list[RoadObject] = road.vehicles + road.objects
        self.vehicles: list[Vehicle] = list(road.vehicles)
        self.kinds = kinds = kinds_of(self.things)
        self.drives = self.moves = self.collides = False
        if not are_plain(self.things, kinds) or not self._read(kinds):
            return
        poses = list(map(_POSE, self.things))
        if not are_numbers(chain.from_iterable(poses)):
            return
        count = len(self.vehicles)
        self.how = [kind.drives for kind in kinds[:count]]
        here = all(vehicle.road is road for vehicle in self.vehicles)
        self.collides = all(map(_COLLIDES, kinds))
        self.moves = here and all(map(_MOVES, kinds[:count]))
        self.drives = here and self.collides and all(self.how)
        self.places = np.array([thing.position for thing in self.things], float).reshape(-1, 2)
        self.headings, self.speeds = np.array(poses, float).reshape(-1, 2).T.copy()
        self.idm = [row for row, how in enumerate(self.how) if how == "idm"]
        self.controlled = [row for row, how in enumerate(self.how) if how == "controlled"]
        self.of_numpy = {row for row, (_, speed) in enumerate(poses[:count]) if type(speed) is np.float64}
        self.lanes: NDArray[np.intp] | None = None
        self.sliding = [row for row, kind in enumerate(kinds[:count]) if kind.slides]
        self.timed = [vehicle for vehicle, kind in zip(self.vehicles, kinds, strict=False) if kind.times]

    def _read(self, kinds: list[Kind]) -> bool:
        """Read the parameters of all objects, once per class; return False if one is missing or not a number."""
        shared: dict[int, int] = {}  # index in `found` of the parameters of each class
        found: list[tuple[float, ...]] = []
        which: list[int] = []
        try:
            for kind, thing in zip(kinds, self.things, strict=True):
                own = not kind.fixed.isdisjoint(vars(thing))
                if own and not kind.is_of(thing):
                    return False
                number = None if own else shared.get(id(kind))
                if number is None:
                    number = len(found)
                    found.append(PARAMETERS_OF[kind.base](thing))
                    if not own:
                        shared[id(kind)] = number
                which.append(number)
            deltas = [thing.DELTA for thing, kind in zip(self.things, kinds, strict=True) if kind.base == "idm"]
        except AttributeError:  # a user's vehicle may lack a parameter that highway-env never reads
            return False
        if not are_numbers(chain.from_iterable(found)) or not are_numbers(deltas):
            return False
        #: whether the limits of speeds are NumPy floats, which speeds then become
        self.numpy_limits = any(type(number) is np.float64 for row in found for number in row[2:4])
        whole = [row + (np.nan,) * (len(_NAMES) - len(row)) for row in found]
        self.numbers = dict(zip(_NAMES, np.array(whole, float).reshape(-1, len(_NAMES))[which].T, strict=True))
        self.numbers["DELTA"] = delta = np.full(len(kinds), np.nan)
        delta[[row for row, kind in enumerate(kinds) if kind.base == "idm"]] = deltas
        return True

    @cached_property
    def row(self) -> dict[int, int]:
        """The row of each object, by its ``id()``."""
        return {id(thing): row for row, thing in enumerate(self.things)}

    @cached_property
    def aims(self) -> list[bool]:
        """Whether each vehicle has a target lane."""
        return [isinstance(vehicle, ControlledVehicle) for vehicle in self.vehicles]

    @cached_property
    def tame(self) -> bool:
        """Whether the parameters guarantee finite accelerations for finite velocities."""
        found = self.of_gaps[:, self.idm]
        comfort, braking, *_ = found
        steep = np.abs(self.numbers["DELTA"][self.idm])
        return bool(np.isfinite(found).all() and (comfort * braking < 0).all() and (steep < _STEEP).all())

    @cached_property
    def of_steering(self) -> NDArray[np.float64]:
        """The parameters of steering, of shape (5, things)."""
        return self._table("TAU_PURSUIT", "KP_LATERAL", "KP_HEADING", "LENGTH", "MAX_STEERING_ANGLE")

    @cached_property
    def of_speeds(self) -> NDArray[np.float64]:
        """The parameters of free-road acceleration, of shape (2, things)."""
        return self._table("COMFORT_ACC_MAX", "DELTA")

    @cached_property
    def of_gaps(self) -> NDArray[np.float64]:
        """The parameters of the desired gap, of shape (4, things)."""
        return self._table("COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED", "TIME_WANTED")

    def _table(self, *names: str) -> NDArray[np.float64]:
        return np.array([self.numbers[name] for name in names])

    @cached_property
    def pairs(self) -> Pairs | None:
        """The pairs of vehicles and things to check for collisions, and the reach of each pair at standstill in m.

        Both arrays have the shape (vehicles, things). None if a diagonal is not a usual number.
        """
        things, count = self.things, len(self.vehicles)
        try:
            diagonals = [thing.diagonal for thing in things]
        except AttributeError:
            return None
        if not are_numbers(diagonals):
            return None
        radius = np.array(diagonals, float) / 2
        checks = np.array([bool(thing.check_collisions) for thing in things], bool)
        ghosts = np.array([not thing.collidable for thing in things], bool)
        rows = np.arange(len(things))
        # highway-env skips a pair if neither object checks for collisions.
        asked = (rows > rows[:count, None]) & (checks | checks[:count, None]) & ~(ghosts | ghosts[:count, None])
        return asked, radius[:count, None] + radius
