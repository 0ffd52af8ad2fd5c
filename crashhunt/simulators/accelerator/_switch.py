"""The accelerator of highway-env: the same results to the bit, with far less work.

It replaces a few methods of highway-env's roads and of one observation, in this process only. Whatever it does not
know, such as a class that overrides what it speeds up, is left to highway-env's own code.
"""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

from highway_env.envs.common.observation import (
    KinematicObservation,
    KinematicsGoalObservation,
    OccupancyGridObservation,
)
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from crashhunt.simulators.accelerator._drive import decide
from crashhunt.simulators.accelerator._frame import Frame
from crashhunt.simulators.accelerator._known import Own, left_alone, originals, reason_against
from crashhunt.simulators.accelerator._move import collide, enforce, move
from crashhunt.simulators.accelerator._network import Network
from crashhunt.simulators.accelerator._observe import close_objects, fill_lanes, observe, observe_goal
from crashhunt.simulators.accelerator._watch import Watch, is_plain

if TYPE_CHECKING:
    from collections.abc import Callable

    from highway_env.road.lane import LaneIndex
    from highway_env.vehicle.kinematics import Vehicle

__all__ = ["is_on", "left_alone", "switch_off", "switch_on", "why_not"]

_ROADS = 16  # that are remembered: those of several environments in one process
_roads: dict[int, _Prepared] = {}
_state: dict[str, Watch] = {}  # "roads" and "observations": the watches, while it is fast


def switch_on() -> str:
    """Speed highway-env up in this process.

    Returns:
        Why not; empty where it is faster now.
    """
    if _state:
        return why_not()
    reason = reason_against()
    if not reason:
        for owner, name, faster in _REPLACED:
            originals[_name(owner, name)] = getattr(owner, name)
            setattr(owner, name, faster)
        # Whoever replaces one of ours has it called; but vehicles that decide together ask nobody for neighbours.
        ours = {_name(owner, name) for owner, name, _ in _REPLACED}
        _state["roads"] = Watch.of_roads(ours - {"Road.neighbour_vehicles"})
        _state["observations"] = Watch.of_observations(ours)
    return reason


def switch_off() -> None:
    """Have highway-env as it was; what somebody else has replaced meanwhile stays, and does without us."""
    _roads.clear()
    _state.clear()
    for owner, name, faster in _REPLACED:
        if vars(owner).get(name) is faster:
            setattr(owner, name, originals[_name(owner, name)])


def _name(owner: type, name: str) -> str:
    return f"{owner.__qualname__}.{name}"


def is_on() -> bool:
    """Whether somebody has asked for it, and it could be done."""
    return bool(_state)


def why_not() -> str:
    """Say why it is not fast at this moment; empty where it is, or where nobody has asked for it."""
    return next((watch.reason for watch in _state.values() if watch.reason), "")


class _Prepared:
    """What is computed once for a road: its network, and where everybody is."""

    def __init__(self, road: Road) -> None:
        self.road = road  # held, so that no other road can have its identity
        self.network = Network(road.network)
        self.frame: Frame | None = None


def _prepared(road: Road) -> _Prepared | None:
    """What is known about a road; None where it, its lanes or highway-env itself are not what is known."""
    return _prepared_if_known(road) if _is_known(road) else None


def _prepared_if_known(road: Road) -> _Prepared | None:
    """The same of a road that has just been looked at."""
    found = _roads.get(id(road))
    if found is None or not found.network.is_of(road.network):
        found = _roads[id(road)] = _Prepared(road)
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


def _is_known(road: Road) -> bool:
    if not _state or not _state["roads"].intact:
        return False
    kind = type(road)
    if kind not in (Road, RegulatedRoad):
        found = _road_kinds.get(kind)
        if found is None or not found.own.current:
            found = _road_kinds[kind] = _RoadKind(kind)
        if not found.plain:
            return False
    return type(road.vehicles) is list and type(road.objects) is list and _ROAD_METHODS.isdisjoint(vars(road))


def _network_of(road: Road) -> Network | None:
    found = _prepared(road)
    return found.network if found is not None else None


def _frame_of(road: Road) -> Frame | None:
    """Where everybody is on a road now."""
    found = _prepared(road)
    if found is None:
        return None
    if found.frame is None or not found.frame.is_of(road):
        found.frame = Frame(found.network, road)
    return found.frame if found.frame.plain else None


def _act(self: Road) -> None:
    if len(self.vehicles) < 2:
        for vehicle in self.vehicles:
            vehicle.act()
        return
    frame = _frame_of(self)
    if frame is None or not decide(self, frame):
        originals["Road.act"](self)


def _step(self: Road, dt: float) -> None:
    if len(self.vehicles) + len(self.objects) < 2 or not _is_known(self):
        originals["Road.step"](self, dt)
        return
    found = _prepared_if_known(self)
    frame = move(self, found.network, dt) if found is not None else None
    if found is not None and frame is not None:
        found.frame = frame
    else:
        for vehicle in self.vehicles:
            vehicle.step(dt)
    collide(self, dt)


def _neighbour_vehicles(self: Road, vehicle: Vehicle, lane_index: LaneIndex | None = None) -> object:
    frame = _frame_of(self)
    row = frame.row.get(id(vehicle)) if frame is not None else None
    key = lane_index or vehicle.lane_index
    if frame is not None and row is not None and key:
        found = frame.neighbours(vehicle, row, key)
        if found is not None:
            return found
    return originals["Road.neighbour_vehicles"](self, vehicle, lane_index)


def _close_objects_to(
    self: Road,
    vehicle: Vehicle,
    distance: float,
    count: int | None = None,
    see_behind: bool = True,
    sort: bool = True,
    vehicles_only: bool = False,
) -> object:
    frame = _frame_of(self)
    if frame is not None:
        found = close_objects(
            frame, vehicle, distance, count, see_behind=see_behind, sort=sort, vehicles_only=vehicles_only
        )
        if found is not None:
            return found
    return originals["Road.close_objects_to"](self, vehicle, distance, count, see_behind, sort, vehicles_only)


def _enforce_road_rules(self: RegulatedRoad) -> None:
    if _prepared(self) is None or not enforce(self):
        originals["RegulatedRoad.enforce_road_rules"](self)


def _observe(self: KinematicObservation) -> object:
    if _is_plain(self, KinematicObservation):
        found = observe(self, _frame_of(self.env.road))
        if found is not None:
            return found
    return originals["KinematicObservation.observe"](self)


def _observe_goal(self: KinematicsGoalObservation) -> object:
    found = observe_goal(self) if _is_plain(self, KinematicsGoalObservation) else None
    return found if found is not None else originals["KinematicsGoalObservation.observe"](self)


def _fill_road_layer_by_lanes(
    self: OccupancyGridObservation, layer_index: int, lane_perception_distance: float = 100
) -> None:
    network = _network_of(self.env.road) if _is_plain(self, OccupancyGridObservation) else None
    if network is not None:
        fill_lanes(self, network, layer_index, lane_perception_distance)
    else:
        originals["OccupancyGridObservation.fill_road_layer_by_lanes"](self, layer_index, lane_perception_distance)


def _is_plain(observation: KinematicObservation | OccupancyGridObservation, kind: Any) -> bool:
    """Whether an observation of a road is of a class that is known, and nobody has replaced a part of it."""
    return bool(
        type(observation) is kind
        and _state
        and _state["observations"].intact
        and isinstance(observation.env.road, Road)
        and _SHOWN[kind].isdisjoint(vars(observation))
    )


def _methods(kind: type) -> frozenset[str]:
    return frozenset(name for name in dir(kind) if not is_plain(inspect.getattr_static(kind, name)))


_OBSERVATIONS = (KinematicObservation, KinematicsGoalObservation, OccupancyGridObservation)
_SHOWN = {kind: _methods(kind) for kind in _OBSERVATIONS}
_ROAD_METHODS = _methods(RegulatedRoad) - _CALLED
_REPLACED: tuple[tuple[type, str, Callable[..., object]], ...] = (
    (Road, "act", _act),
    (Road, "step", _step),
    (Road, "neighbour_vehicles", _neighbour_vehicles),
    (Road, "close_objects_to", _close_objects_to),
    (RegulatedRoad, "enforce_road_rules", _enforce_road_rules),
    (KinematicObservation, "observe", _observe),
    (KinematicsGoalObservation, "observe", _observe_goal),
    (OccupancyGridObservation, "fill_road_layer_by_lanes", _fill_road_layer_by_lanes),
)
