"""Caches for the roads in use: their lanes, and the state of their vehicles."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING

from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from crashhunt.accelerator._kernel import Roster, kernel
from crashhunt.accelerator._move import as_numpy, move
from crashhunt.accelerator._network import Network
from crashhunt.accelerator._vehicle_arrays import Crowd, Frame
from crashhunt.accelerator._versions import Own, Watch, is_plain, kinds_of

if TYPE_CHECKING:
    from highway_env.vehicle.kinematics import Vehicle

    from crashhunt.accelerator._kernel import Traffic

    Everybody = tuple["Prepared", Crowd, Frame]


__all__ = [
    "Prepared",
    "forget",
    "frame_of",
    "is_known",
    "look",
    "look_traffic",
    "methods_of",
    "network_of",
    "prepared",
    "take",
    "take_traffic",
    "watches",
]


_MAX_ROADS = 16  # number of cached roads: one process may run several environments
_roads: dict[int, Prepared] = {}
watches: dict[str, Watch] = {}
"""The watches ``roads`` and ``observations`` while the accelerator is on; otherwise empty."""


class Prepared:
    """The cached data of a road: its network, and the state of its vehicles.

    Attributes:
        network: The lanes of the road.
        frame: The positions at the last access.
        alone: Whether no foreign code runs between the sub-steps of the road, so that the state stays valid.
    """

    def __init__(self, road: Road) -> None:
        self.road = road  # keeps the road alive, so that no other road can get its id()
        self.network = Network(road.network)
        self.frame: Frame | None = None
        self.alone = False
        self._crowd: Crowd | None = None
        self._roster: Roster | None = None
        self._traffic: Traffic | None = None
        self._moved: list[Vehicle] = []

    def move(self, crowd: Crowd, dt: float, before: Frame | None) -> Frame | None:
        """Move all vehicles with `move`, and remember which vehicles need `as_numpy` afterwards."""
        frame = move(crowd, self.network, dt, before, alone=self.alone)
        if self.alone and frame is not None:
            self._moved = crowd.vehicles
        return frame

    def traffic(self) -> Traffic | None:
        """Return all vehicles in the kernel, with their current state; None if the kernel does not know them."""
        road = self.road
        if road.record_history or kernel() is None:
            return None
        things = road.vehicles + road.objects
        kinds = kinds_of(things)
        if self._roster is None or not self._roster.is_of(road, things, kinds):
            if not all(kind.drives for kind in kinds[: len(road.vehicles)]):
                return None
            self._roster = Roster(Crowd(road), self.network)
        traffic = self._roster.traffic
        return traffic if traffic is not None and traffic.read() else None

    def keep_traffic(self, traffic: Traffic) -> None:
        """Keep the state of all vehicles in the kernel until foreign code runs."""
        self._crowd = None
        self._traffic = traffic if self.alone else None

    def trusted_traffic(self) -> Traffic | None:
        """Return the kept state in the kernel and discard it; None if none has been kept since the last call."""
        traffic, self._traffic = self._traffic, None
        return traffic

    def keep(self, crowd: Crowd, frame: Frame) -> None:
        """Keep the state of all vehicles until foreign code runs."""
        self.frame = frame
        self._crowd = crowd if self.alone and crowd.drives and crowd.moves else None

    def trusted(self) -> Everybody | None:
        """Return the kept state and discard it; None if no state has been kept since the last call."""
        crowd, self._crowd = self._crowd, None
        return (self, crowd, self.frame) if crowd is not None and self.frame is not None else None

    def distrust(self) -> None:
        """Prepare for foreign code: restore highway-env's types, and discard the kept state."""
        self._crowd = self._traffic = None
        as_numpy(self._moved)
        self._moved = []


def look(road: Road) -> Everybody | None:
    """Return the current state of a road; None if the road or the decisions of a vehicle are unknown."""
    found = prepared(road) if all(kind.drives for kind in kinds_of(road.vehicles)) else None
    if found is None:
        return None
    crowd = Crowd(road)
    if not crowd.drives:
        return None
    if found.frame is None or not found.frame.has(crowd.things, crowd.places):
        found.frame = Frame(found.network, road, crowd.places)
    return found, crowd, found.frame


def take(road: Road) -> Everybody | None:
    """Return the kept state of a road; None if foreign code may have run since."""
    found = _roads.get(id(road))
    return found.trusted() if found is not None and found.road is road else None


def take_traffic(road: Road) -> tuple[Prepared, Traffic] | None:
    """Return the kept state of a road in the kernel; None if foreign code may have run since."""
    found = _roads.get(id(road))
    traffic = found.trusted_traffic() if found is not None and found.road is road else None
    return (found, traffic) if found is not None and traffic is not None else None


def look_traffic(road: Road, *, known: bool = False) -> tuple[Prepared, Traffic] | None:
    """Return the current state of a road in the kernel; None if the kernel cannot be used for the road."""
    found = prepared(road, known=known) if kernel() is not None else None
    traffic = found.traffic() if found is not None else None
    return (found, traffic) if found is not None and traffic is not None else None


def forget() -> None:
    """Forget all roads."""
    _roads.clear()
    watches.clear()


def prepared(road: Road, *, known: bool = False) -> Prepared | None:
    """Return the cached data of a road; None if the road, its lanes or highway-env itself are unknown.

    Args:
        road: The road.
        known: Whether `is_known` has just returned true for the road.
    """
    if not known and not is_known(road):
        return None
    found = _roads.get(id(road))
    if found is None or not found.network.is_of(road.network):
        found = _roads[id(road)] = Prepared(road)
        while len(_roads) > _MAX_ROADS:  # each episode has a new road
            del _roads[next(iter(_roads))]
    return found if found.network.plain else None


class _RoadKind:
    """Properties of a class of roads: whether it overrides a method that the accelerator bypasses."""

    def __init__(self, kind: type[Road]) -> None:
        base = RegulatedRoad if issubclass(kind, RegulatedRoad) else Road
        self.own = Own(kind, base, _READ)
        self.plain = self.own.plain and not any(map(self.own.has, _BYPASSED))


_READ = ("network", "vehicles", "objects", "np_random", "record_history", "neighbour_vehicles_connected_lanes")
_BYPASSED = ("neighbour_vehicles", "is_conflict_possible")
"""The methods of a road that the accelerator does not call; it calls all others."""
_CALLED = {"act", "step"}  # a road object may have its own, which call the methods of the class
_road_kinds: dict[type, _RoadKind] = {}


def is_known(road: Road) -> bool:
    """Whether a road has a known class, and no function of highway-env has been replaced."""
    if not watches or not watches["roads"].intact:
        return False
    kind = type(road)
    if kind not in (Road, RegulatedRoad):
        found = _road_kinds.get(kind)
        if found is None or not found.own.current:
            found = _road_kinds[kind] = _RoadKind(kind)
        if not found.plain:
            return False
    return type(road.vehicles) is list and type(road.objects) is list and _ROAD_METHODS.isdisjoint(vars(road))


def network_of(road: Road) -> Network | None:
    """Return the lanes of a road; None if the road is unknown."""
    found = prepared(road)
    return found.network if found is not None else None


def frame_of(road: Road) -> Frame | None:
    """Return the current positions on a road; None if the road or an object is unknown."""
    found = prepared(road)
    if found is None:
        return None
    if found.frame is None or not found.frame.is_of(road):
        found.frame = Frame(found.network, road)
    return found.frame if found.frame.plain else None


def methods_of(kind: type) -> frozenset[str]:
    """Return the names of all members of a class that are not plain values."""
    return frozenset(name for name in dir(kind) if not is_plain(inspect.getattr_static(kind, name)))


_ROAD_METHODS = methods_of(RegulatedRoad) - _CALLED
