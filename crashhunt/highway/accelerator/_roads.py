"""Caches for the roads in use: their lanes, and the states of their vehicles."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, NamedTuple

from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from crashhunt.highway.accelerator._kernel_objects import KernelObjects
from crashhunt.highway.accelerator._lane_network import Network
from crashhunt.highway.accelerator._supported import Own, Watch, is_plain, kinds_of

if TYPE_CHECKING:
    from crashhunt.highway.accelerator._kernel import Traffic


_MAX_ROADS = 16  # number of cached roads: one process may run several environments
_roads: dict[int, Prepared] = {}
watches: dict[str, Watch] = {}
"""The watches ``roads`` and ``observations`` while the accelerator is on; otherwise empty."""


class Prepared:
    """The cached data of a road: its network, and the states of its vehicles."""

    def __init__(self, road: Road) -> None:
        self.road = road  # keeps the road alive, so that no other road can get its id()
        self.network = Network(road.network)  # the lanes of the road
        # whether no foreign code runs between the sub-steps of the road, so that the state stays valid
        self.alone = False
        # whether a step of the environment runs, in which the observation follows the last sub-step
        self.in_step = False
        # whether road and vehicles have been compared with the kernel's since foreign code last ran
        self.checked = False
        self._roster: KernelObjects | None = None
        self._kept: RoadState | None = None

    def roster(self) -> KernelObjects | None:
        """Return all vehicles in the kernel, with their current state; None if the kernel does not know them."""
        road = self.road
        if road.record_history:
            return None
        if self._roster is None or not (self.checked or self._roster.is_of(road)):
            self._roster = KernelObjects(road, self.network)
        traffic = self._roster.traffic
        return self._roster if traffic is not None and traffic.read() else None

    def drives_all(self) -> bool:
        """Return whether the kernel knows how all vehicles of the road make decisions and move."""
        road, roster = self.road, self._roster
        self.checked = False
        if roster is not None and roster.is_of(road):
            drives = roster.decides and roster.moves
            self.checked = drives and roster.traffic is not None  # other vehicles run foreign code in a sub-step
            return drives
        return all(kind.drives and kind.moves for kind in kinds_of(road.vehicles))

    def keep(self, state: RoadState) -> None:
        """Keep the state of all vehicles in the kernel until foreign code runs."""
        self._kept = state if self.alone else None

    def trusted(self) -> RoadState | None:
        """Return the kept state and discard it; None if no state was kept after the last call."""
        kept, self._kept = self._kept, None
        return kept

    def distrust(self) -> None:
        """Discard the kept state and the last check, because foreign code runs next."""
        self._kept = None
        self.checked = False


class RoadState(NamedTuple):
    """The current state of a road's vehicles in the kernel."""

    owner: Prepared
    roster: KernelObjects
    traffic: Traffic


def cached(road: Road | None) -> Prepared | None:
    """Return the cached data of a road without any check; None if there is no cached data."""
    found = _roads.get(id(road))
    return found if found is not None and found.road is road else None


def take(road: Road) -> RoadState | None:
    """Return the kept state of a road; None if foreign code may have run in the meantime."""
    found = cached(road)
    return found.trusted() if found is not None and found.alone else None


def take_for_observation(road: Road) -> RoadState | None:
    """Return the kept state of a road like `take`; foreign code may run after the observation."""
    found = cached(road)
    if found is None:
        return None
    kept = found.trusted()
    found.distrust()
    return kept


def look(road: Road) -> RoadState | None:
    """Return the current state of a road; None if the kernel cannot be used for the road."""
    found = cached(road)
    if found is None or not found.checked:
        found = prepared(road) if is_known(road) else None
    roster = found.roster() if found is not None else None
    if found is None or roster is None or roster.traffic is None:
        return None
    return RoadState(found, roster, roster.traffic)


def forget() -> None:
    """Discard the cached data of all roads."""
    _roads.clear()
    watches.clear()


def is_intact(what: str) -> bool:
    """Return whether the accelerator is on, and the functions of highway-env are unchanged that a watch observes.

    Another thread may switch the accelerator on or off at any time.
    """
    watch = watches.get(what)
    return watch is not None and watch.intact


def prepared(road: Road) -> Prepared | None:
    """Return the cached data of a road whose vehicles may be searched; None if its lanes are unknown."""
    found = _roads.get(id(road))
    if found is None or not found.network.is_of(road.network):
        found = _roads[id(road)] = Prepared(road)
        for key in [*_roads][:-_MAX_ROADS]:  # each episode has a new road
            _roads.pop(key, None)  # another thread may have removed it
    return found if found.network.plain else None


class _RoadKind:
    """Properties of a class of roads."""

    def __init__(self, kind: type[Road]) -> None:
        base = RegulatedRoad if issubclass(kind, RegulatedRoad) else Road
        self.own = Own(kind, base, _READ_ATTRIBUTES)
        # whether the class overrides no attribute that the accelerator reads, and no method that it bypasses
        self.is_known = self.own.plain and not any(map(self.own.has, _BYPASSED_METHODS))


_READ_ATTRIBUTES = (
    "network",
    "vehicles",
    "objects",
    "np_random",
    "record_history",
    "neighbour_vehicles_connected_lanes",
)
_BYPASSED_METHODS = ("neighbour_vehicles", "is_conflict_possible")
"""The methods of a road that the accelerator does not call; it calls all others."""
_OVERRIDABLE_METHODS = {"act", "step"}  # a road object may have its own, which call the methods of the class
_road_kinds: dict[type, _RoadKind] = {}


def is_known(road: Road) -> bool:
    """Return whether the kernel may drive and search a road's vehicles.

    The road's class and highway-env must be unchanged, and the road must not have methods of its own.
    """
    kind = type(road)
    found = _road_kinds.get(kind)
    if found is None or not found.own.current:
        found = _road_kinds[kind] = _RoadKind(kind)
    return (
        found.is_known
        and is_intact("roads")
        and type(road.vehicles) is list
        and type(road.objects) is list
        and _ROAD_METHODS.isdisjoint(vars(road))
    )


def network_of(road: Road) -> Network | None:
    """Return the lanes of a road; None if the road is unknown."""
    found = prepared(road) if is_known(road) else None
    return found.network if found is not None else None


def methods_of(kind: type) -> frozenset[str]:
    """Return the names of all members of a class that are not plain values."""
    return frozenset(name for name in dir(kind) if not is_plain(inspect.getattr_static(kind, name)))


_ROAD_METHODS = methods_of(RegulatedRoad) - _OVERRIDABLE_METHODS
