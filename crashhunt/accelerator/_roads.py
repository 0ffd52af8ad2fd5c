"""What is known about the roads that are driven on: their lanes, and who is on them."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING

from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from crashhunt.accelerator._move import as_numpy, move
from crashhunt.accelerator._network import Network
from crashhunt.accelerator._vehicle_arrays import Crowd, Frame
from crashhunt.accelerator._versions import Own, Watch, is_plain, kinds_of

if TYPE_CHECKING:
    from highway_env.vehicle.kinematics import Vehicle

    Everybody = tuple["Prepared", Crowd, Frame]


__all__ = [
    "Prepared",
    "forget",
    "frame_of",
    "is_known",
    "look",
    "methods_of",
    "network_of",
    "prepared",
    "take",
    "watches",
]


_ROADS = 16  # that are remembered: those of several environments in one process
_roads: dict[int, Prepared] = {}
watches: dict[str, Watch] = {}
"""``roads`` and ``observations``, while it is fast."""


class Prepared:
    """What is computed once for a road: its network, and where everybody is.

    Attributes:
        network: its lanes.
        frame: where everybody was when that was last asked for.
        alone: whether nobody else's code runs between its sub-steps, so that who is there is looked at once.
    """

    def __init__(self, road: Road) -> None:
        self.road = road  # held, so that no other road can have its identity
        self.network = Network(road.network)
        self.frame: Frame | None = None
        self.alone = False
        self._crowd: Crowd | None = None
        self._moved: list[Vehicle] = []

    def move(self, crowd: Crowd, dt: float, before: Frame | None) -> Frame | None:
        """Move everybody, as `move` does."""
        frame = move(crowd, self.network, dt, before, alone=self.alone)
        if self.alone and frame is not None:
            self._moved = crowd.vehicles
        return frame

    def keep(self, crowd: Crowd, frame: Frame) -> None:
        """Trust what is known about everybody until somebody else's code runs."""
        self.frame = frame
        self._crowd = crowd if self.alone and crowd.drives and crowd.moves else None

    def trusted(self) -> Everybody | None:
        """Who is there, as they were kept; nobody is, until they are kept again."""
        crowd, self._crowd = self._crowd, None
        return (self, crowd, self.frame) if crowd is not None and self.frame is not None else None

    def distrust(self) -> None:
        """Have somebody else's code run: everybody is as in highway-env, and is looked at again afterwards."""
        self._crowd = None
        as_numpy(self._moved)
        self._moved = []


def look(road: Road) -> Everybody | None:
    """Look at everybody on a road; None where it is not known, or how all of them drive."""
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
    """Everybody on a road on which nobody else's code has run since they were kept."""
    found = _roads.get(id(road))
    return found.trusted() if found is not None and found.road is road else None


def forget() -> None:
    """Forget all roads."""
    _roads.clear()
    watches.clear()


def prepared(road: Road, *, known: bool = False) -> Prepared | None:
    """Return what is known about a road; None where it, its lanes or highway-env itself are not what is known.

    Args:
        road: the road.
        known: whether `is_known` has just said that it is.
    """
    if not known and not is_known(road):
        return None
    found = _roads.get(id(road))
    if found is None or not found.network.is_of(road.network):
        found = _roads[id(road)] = Prepared(road)
        while len(_roads) > _ROADS:  # an episode has one road, which nobody needs afterwards
            del _roads[next(iter(_roads))]
    return found if found.network.plain else None


class _RoadKind:
    """What is known about a class of roads; those that have no method in the way are as good as highway-env's own."""

    def __init__(self, kind: type[Road]) -> None:
        base = RegulatedRoad if issubclass(kind, RegulatedRoad) else Road
        self.own = Own(kind, base, _READ)
        self.plain = self.own.plain and not any(map(self.own.has, _BYPASSED))


_READ = ("network", "vehicles", "objects", "np_random", "record_history", "neighbour_vehicles_connected_lanes")
_BYPASSED = ("neighbour_vehicles", "is_conflict_possible")
"""The methods of a road that are not called where it is sped up; all others are."""
_CALLED = {"act", "step"}  # one road may have its own, which call the class's
_road_kinds: dict[type, _RoadKind] = {}


def is_known(road: Road) -> bool:
    """Whether a road is of a kind that is known, and highway-env as it was."""
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
    """The lanes of a road."""
    found = prepared(road)
    return found.network if found is not None else None


def frame_of(road: Road) -> Frame | None:
    """Where everybody is on a road now."""
    found = prepared(road)
    if found is None:
        return None
    if found.frame is None or not found.frame.is_of(road):
        found.frame = Frame(found.network, road)
    return found.frame if found.frame.plain else None


def methods_of(kind: type) -> frozenset[str]:
    """The names of all that a class has and that is no mere value."""
    return frozenset(name for name in dir(kind) if not is_plain(inspect.getattr_static(kind, name)))


_ROAD_METHODS = methods_of(RegulatedRoad) - _CALLED
