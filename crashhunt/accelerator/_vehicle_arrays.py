"""Everybody on a road at one instant, with their coordinates on the lanes: computed once, shared by all who ask."""

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

    Pairs = tuple[NDArray[np.bool_], NDArray[np.float64]]  # who may touch whom, and within which distance


__all__ = ["ASK", "MANY", "NOBODY", "Crowd", "Frame", "are_plain"]


MANY = 12  # from so many on, arrays are faster than one after another
NOBODY, ASK = -1, -2


class Frame:
    """Positions do not change while vehicles decide.

    Args:
        network: of the road.
        road: with its vehicles and objects.
        places: where they are, of shape (things, 2) and in m, if that has been looked at.
        before: of the same ones earlier, if there is one.

    Attributes:
        plain: whether all have a place of the usual kind; otherwise nothing here may be used.
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
        """Whether everybody is still there, and where they were."""
        things = road.vehicles + road.objects
        if not self.plain or not are_plain(things):
            return False
        places = np.array([thing.position for thing in things], float).reshape(-1, 2)
        return self.has(things, places)

    def has(self, things: list[RoadObject], places: NDArray[np.float64]) -> bool:
        """Whether these are everybody, and this is where they were."""
        # By identity: a class of somebody's may call two vehicles equal.
        return (
            self.plain
            and list(map(id, things)) == list(self.row)
            and self._looks_further == self.road.neighbour_vehicles_connected_lanes
            and np.array_equal(places, self.places)
        )

    @cached_property
    def on_axis(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coordinates of all on the lanes along an axis, each of shape (things, lanes)."""
        return self.network.on_axis(self.places[:, 0], self.places[:, 1])

    @cached_property
    def no_landmark(self) -> NDArray[np.bool_]:
        """Which of all somebody may meet on a lane."""
        return np.array([not isinstance(thing, Landmark) for thing in self.things], bool)

    @cached_property
    def boxes(self) -> NDArray[np.float64]:
        """Lower bounds of the distances of all from the other lanes."""
        return self.network.box_distance(self.places[:, 0], self.places[:, 1])

    @cached_property
    def _order(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
        """All who are on a lane along an axis, by lane and by their place there: column of the lane, row, m."""
        (s, r), network = self.on_axis, self.network
        on = (np.abs(r) <= network.half_width) & (s >= -5) & (s < network.length + 5) & self.no_landmark[:, None]
        columns, rows = np.nonzero(on.T)
        along = s[rows, columns]
        order = np.lexsort((along, columns))
        return columns[order], rows[order], along[order]

    @cached_property
    def ahead(self) -> NDArray[np.intp]:
        """Who is next on the lanes along an axis, of shape (things, lanes): a row, or one of the two below.

        `NOBODY`, or `ASK` for those who are not on the lane themselves, or where two are in the same place.
        """
        columns, rows, along = self._order
        found = np.full((len(self.things), len(self.network.axis)), ASK)
        same = columns[1:] == columns[:-1]
        if not (same & (along[1:] == along[:-1])).any():
            after = np.full(len(rows), NOBODY)
            after[:-1][same] = rows[1:][same]
            found[rows, columns] = after
        return found

    def coordinates_of(
        self, rows: Sequence[int] | NDArray[np.intp], lanes: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coordinates of so many, each on a lane of its own."""
        columns = self.network.axis_columns[lanes]
        if len(rows) >= MANY and columns.min() >= 0:
            s, r = self.on_axis
            return s[rows, columns], r[rows, columns]
        pairs = [self.coordinates(row, lane) for row, lane in zip(map(int, rows), lanes.tolist(), strict=True)]
        return np.array([s for s, _ in pairs]), np.array([r for _, r in pairs])

    def coordinates(self, row: int, lane: int) -> tuple[float, float]:
        """Coordinates of one on one lane."""
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
        """Coordinates of all on one lane along an axis."""
        found = self._columns.get(lane)
        if found is None:
            (s, r), column = self.on_axis, self.network.column[lane]
            found = self._columns[lane] = s[:, column].tolist(), r[:, column].tolist()
        return found

    def neighbours(
        self, vehicle: RoadObject, row: int, key: LaneIndex
    ) -> tuple[RoadObject | None, RoadObject | None] | None:
        """Who is ahead and who is behind on a lane: `Road.neighbour_vehicles`. None where that must be asked."""
        try:
            lane = self.network.index.get(key)
        except TypeError:  # a list names a lane as well
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
        for number in range(first, len(places)):  # of those in the same place, the last one counts
            if things[number] is not vehicle:
                if ahead is not None and places[number] != at:
                    break
                ahead, at = things[number], places[number]
        for number in range(first - 1, -1, -1):  # and here the first one
            if things[number] is not vehicle:
                if behind is not None and places[number] != at:
                    break
                behind, at = things[number], places[number]
        return ahead, behind

    def _queue(self, lane: int) -> tuple[list[float], list[RoadObject]]:
        """Those on a lane, and with it on those that lead to it and on from it, by their place along it."""
        if not self._looks_further and len(self.things) >= MANY and self.network.is_axis[lane]:
            return self._axis_queue(lane)
        if not self._looks_further:
            found = self._on_lane(lane)
        else:
            found = []
            seen: set[int] = set()
            for other, offset in self._connected(lane):
                for s, row in self._on_lane(other):
                    if row not in seen:  # the first lane on which it is decides
                        seen.add(row)
                        found.append((s + offset, row))
        found.sort()
        return [s for s, _ in found], [self.things[row] for _, row in found]

    def _axis_queue(self, lane: int) -> tuple[list[float], list[RoadObject]]:
        """The same on one lane along an axis alone."""
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

    def _connected(self, lane: int) -> list[tuple[int, float]]:
        """The lane, those that follow and those that lead to it, each with the offset of its coordinates."""
        graph, network = self.road.network.graph, self.network
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
    """Whether all have a place of the usual kind, which nobody else has; nobody is on the road twice."""
    if not all(map(_PLAIN, kinds or kinds_of(things))):
        return False
    positions = [thing.position for thing in things]
    return (
        len(set(map(id, things))) == len(set(map(id, positions))) == len(things)
        and _ARRAYS.issuperset(map(type, positions))
        and all(map(_is_place, positions))
    )


def _is_place(position: NDArray[np.float64]) -> bool:
    # That of an array that has been pickled is another one that is equal.
    return (position.dtype is _FLOAT or position.dtype == _FLOAT) and position.shape == (2,)


_PLAIN = attrgetter("plain")
_FLOAT = np.dtype(np.float64)
_ARRAYS = frozenset((np.ndarray,))


# Everybody on a road, with what of them stays as it is for as long as nobody else's code runs.

_COLLIDES, _MOVES = attrgetter("collides"), attrgetter("moves")
_STEEP = 20.0  # what has an exponent above need not be finite
_POSE = attrgetter("heading", "speed")
_NAMES = NUMBERS_OF["idm"]  # which all others have the first of
_READ = {how: attrgetter(*names) for how, names in NUMBERS_OF.items()}


class Crowd:
    """Looked at when it is made; `move` keeps up to date where everybody is, and says so here.

    Args:
        road: with its vehicles and objects.

    Attributes:
        drives: whether it is known how all vehicles decide, and all that they reckon with are numbers.
        moves: whether it is known how all vehicles move.
        collides: whether it is known how all collide.
        things: the vehicles, and the objects after them, of which all others have one entry each.
        places: shape (things, 2), in m.
        headings: in rad.
        speeds: in m/s.
        lanes: the numbers of the lanes on which vehicles are, once `move` has found them.
        idm: the rows of vehicles that decide by themselves.
        controlled: the rows of vehicles that keep to a speed and a lane.
        sliding: the rows of vehicles that move by the dynamic model.
        of_numpy: the rows of vehicles whose speeds are NumPy's floats, as which they stay.
        timed: the vehicles that count the time since they last thought of changing lanes.
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
        """Read the numbers that a class usually has for all of its vehicles."""
        shared: dict[int, int] = {}  # of each class, where its numbers are among those found
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
                    found.append(_READ[kind.base](thing))
                    if not own:
                        shared[id(kind)] = number
                which.append(number)
            deltas = [thing.DELTA for thing, kind in zip(self.things, kinds, strict=True) if kind.base == "idm"]
        except AttributeError:  # highway-env may never ask for what somebody's vehicle lacks
            return False
        if not are_numbers(chain.from_iterable(found)) or not are_numbers(deltas):
            return False
        whole = [row + (np.nan,) * (len(_NAMES) - len(row)) for row in found]
        self.numbers = dict(zip(_NAMES, np.array(whole, float).reshape(-1, len(_NAMES))[which].T, strict=True))
        self.numbers["DELTA"] = delta = np.full(len(kinds), np.nan)
        delta[[row for row, kind in enumerate(kinds) if kind.base == "idm"]] = deltas
        return True

    @cached_property
    def row(self) -> dict[int, int]:
        """The row of everybody by their identity."""
        return {id(thing): row for row, thing in enumerate(self.things)}

    @cached_property
    def aims(self) -> list[bool]:
        """Which vehicles have a lane that they want to be on."""
        return [isinstance(vehicle, ControlledVehicle) for vehicle in self.vehicles]

    @cached_property
    def tame(self) -> bool:
        """Whether every acceleration that drivers reckon with is finite, as long as everybody's velocity is."""
        found = self.of_gaps[:, self.idm]
        comfort, braking, *_ = found
        steep = np.abs(self.numbers["DELTA"][self.idm])
        return bool(np.isfinite(found).all() and (comfort * braking < 0).all() and (steep < _STEEP).all())

    @cached_property
    def of_steering(self) -> NDArray[np.float64]:
        """Shape (5, things)."""
        return self._table("TAU_PURSUIT", "KP_LATERAL", "KP_HEADING", "LENGTH", "MAX_STEERING_ANGLE")

    @cached_property
    def of_speeds(self) -> NDArray[np.float64]:
        """Shape (2, things)."""
        return self._table("COMFORT_ACC_MAX", "DELTA")

    @cached_property
    def of_gaps(self) -> NDArray[np.float64]:
        """Shape (4, things)."""
        return self._table("COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED", "TIME_WANTED")

    def _table(self, *names: str) -> NDArray[np.float64]:
        return np.array([self.numbers[name] for name in names])

    @cached_property
    def pairs(self) -> Pairs | None:
        """Which vehicles ask whether they touch which things, and within which distance of standing vehicles.

        None where a number is of no usual kind. Of shape (vehicles, things), in m.
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
        # Of two that neither of them look for collisions, nothing is asked.
        asked = (rows > rows[:count, None]) & (checks | checks[:count, None]) & ~(ghosts | ghosts[:count, None])
        return asked, radius[:count, None] + radius
