"""The positions of all objects of a road at one time, with their coordinates on the lanes."""

from __future__ import annotations

from bisect import bisect_left
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from highway_env.vehicle.objects import Landmark

from crashhunt.highway.accelerator._supported import VehicleClass, kinds_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from highway_env.road.road import LaneIndex, Road
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.highway.accelerator._lane_network import Network


class TrafficFrame:
    """The positions of all objects at one time, with coordinates on the lanes that are computed when needed."""

    def __init__(self, network: Network, road: Road) -> None:
        self.network = network
        self.road = road
        self._looks_further = road.neighbour_vehicles_connected_lanes
        self.things: list[RoadObject] = road.vehicles + road.objects  # the vehicles, then the objects
        # the number of each object in `things`, by its ``id()``
        self.row = {id(thing): row for row, thing in enumerate(self.things)}
        # whether all positions have the usual data type; otherwise the frame must not be used
        self.plain = are_plain(self.things)
        if not self.plain:
            return
        # the positions of the objects in m, of shape (things, 2)
        self.places: NDArray[np.float64] = _places_of(self.things)
        self._columns: dict[int, tuple[list[float], list[float]]] = {}
        self._queues: dict[int, tuple[list[float], list[RoadObject]]] = {}

    def is_of(self, road: Road) -> bool:
        """Return whether the road still has the same objects at the same positions."""
        things = road.vehicles + road.objects
        # Compare identities, because a user's class may define equality.
        return (
            self.plain
            and list(map(id, things)) == list(self.row)
            and are_plain(things)
            and self._looks_further == self.road.neighbour_vehicles_connected_lanes
            and np.array_equal(_places_of(things), self.places)
        )

    def coordinates(self, row: int, lane: int) -> tuple[float, float]:
        """Return the coordinates of an object on a lane, in m."""
        along, across = self.column(lane)
        return along[row], across[row]

    def column(self, lane: int) -> tuple[list[float], list[float]]:
        """Return the longitudinal and the lateral coordinates of all objects on a lane, in m."""
        found = self._columns.get(lane)
        if found is None:
            found = self._columns[lane] = self.network.coordinates(lane, self.places)
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
        first = bisect_left(places, s)
        # Of several objects at the same place, highway-env returns the last one ahead and the first one behind.
        return (
            _last_at_nearest_place(vehicle, s, zip(places[first:], things[first:], strict=True)),
            _last_at_nearest_place(vehicle, s, zip(reversed(places[:first]), reversed(things[:first]), strict=True)),
        )

    def _queue(self, lane: int) -> tuple[list[float], list[RoadObject]]:
        """Return positions and objects on a lane, in order; also on connected lanes if the road searches them."""
        found: dict[int, float] = {}
        for other, offset in self.network.connected_lanes(lane) if self._looks_further else [(lane, 0.0)]:
            for row, (s, r) in enumerate(zip(*self.column(other), strict=True)):
                is_free = row not in found and not isinstance(self.things[row], Landmark)
                if is_free and self.network.is_on(other, s, r):  # the first lane of an object decides
                    found[row] = s + offset
        order = sorted((s, row) for row, s in found.items())
        return [s for s, _ in order], [self.things[row] for _, row in order]


def _last_at_nearest_place(
    vehicle: RoadObject, place: float, ordered: Iterable[tuple[float, RoadObject]]
) -> RoadObject | None:
    found = None
    for other_place, thing in ordered:
        if found is not None and other_place != place:
            break
        if thing is not vehicle:
            found, place = thing, other_place
    return found


def _places_of(things: list[RoadObject]) -> NDArray[np.float64]:
    return np.array([thing.position for thing in things], float).reshape(-1, 2)


def are_plain(things: list[RoadObject], kinds: list[VehicleClass] | None = None) -> bool:
    """Return whether all positions have the usual type, no objects share an array, and no object occurs twice."""
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
