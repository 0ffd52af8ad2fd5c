"""The accelerator of highway-env: the same results to the bit, with far less work.

It replaces a few methods of highway-env's roads and of one observation, in this process only. Whatever it does not
know, such as a class that overrides what it speeds up, is left to highway-env's own code.
"""

from __future__ import annotations

from typing import Any

from highway_env.envs.common.observation import KinematicObservation, OccupancyGridObservation
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from crashhunt.simulators._accelerator._drive import decide
from crashhunt.simulators._accelerator._frame import Frame
from crashhunt.simulators._accelerator._known import reason_against, replaced
from crashhunt.simulators._accelerator._move import collide, enforce, move
from crashhunt.simulators._accelerator._network import Network
from crashhunt.simulators._accelerator._observe import close_objects, fill_lanes, observe

__all__ = ["accelerate", "decelerate"]

_ROADS = 16  # that are remembered: those of several environments in one process
_roads: dict[int, _Prepared] = {}


def accelerate() -> str:
    """Speed highway-env up in this process.

    Returns:
        Why not; empty where it is faster now.
    """
    if replaced:
        return ""
    reason = reason_against()
    if not reason:
        for owner, name, faster in _REPLACED:
            replaced[name] = getattr(owner, name)
            setattr(owner, name, faster)
    return reason


def decelerate() -> None:
    """Have highway-env as it was."""
    _roads.clear()
    for owner, name, _ in _REPLACED:
        if name in replaced:
            setattr(owner, name, replaced.pop(name))


class _Prepared:
    """What is computed once for a road: its network, and where everybody is."""

    def __init__(self, road: Road) -> None:
        self.road = road  # held, so that no other road can have its identity
        self.network = Network(road.network)
        self.frame: Frame | None = None


def _prepared(road: Road) -> _Prepared | None:
    """What is known about a road; None where it has lanes that are not known."""
    if type(road) not in (Road, RegulatedRoad):
        return None
    found = _roads.get(id(road))
    if found is None or not found.network.is_of(road.network):
        found = _roads[id(road)] = _Prepared(road)
        while len(_roads) > _ROADS:  # an episode has one road, which nobody needs afterwards
            del _roads[next(iter(_roads))]
    return found if found.network.plain else None


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
    return found.frame


def _act(self: Road) -> None:
    frame = _frame_of(self) if len(self.vehicles) > 1 else None
    if frame is None or not decide(self, frame):
        replaced["act"](self)


def _step(self: Road, dt: float) -> None:
    if len(self.vehicles) + len(self.objects) < 2:
        replaced["step"](self, dt)
        return
    found = _prepared(self)
    frame = move(self, found.network, dt) if found is not None else None
    if found is not None and frame is not None:
        found.frame = frame
    else:
        for vehicle in self.vehicles:
            vehicle.step(dt)
    collide(self, dt)


def _neighbour_vehicles(self: Road, vehicle: Any, lane_index: Any = None) -> Any:
    frame = _frame_of(self)
    row = frame.row.get(id(vehicle)) if frame is not None else None
    key = lane_index or vehicle.lane_index
    if frame is not None and row is not None and key:
        found = frame.neighbours(vehicle, row, key)
        if found is not None:
            return found
    return replaced["neighbour_vehicles"](self, vehicle, lane_index)


def _close_objects_to(
    self: Road,
    vehicle: Any,
    distance: float,
    count: int | None = None,
    see_behind: bool = True,
    sort: bool = True,
    vehicles_only: bool = False,
) -> Any:
    frame = _frame_of(self)
    if frame is not None:
        found = close_objects(
            frame, vehicle, distance, count, see_behind=see_behind, sort=sort, vehicles_only=vehicles_only
        )
        if found is not None:
            return found
    return replaced["close_objects_to"](self, vehicle, distance, count, see_behind, sort, vehicles_only)


def _enforce_road_rules(self: RegulatedRoad) -> None:
    if type(self) is not RegulatedRoad or not enforce(self):
        replaced["enforce_road_rules"](self)


def _observe(self: KinematicObservation) -> Any:
    road = self.env.road
    if type(self) is KinematicObservation and road:
        found = observe(self, _frame_of(road))
        if found is not None:
            return found
    return replaced["observe"](self)


def _fill_road_layer_by_lanes(
    self: OccupancyGridObservation, layer_index: int, lane_perception_distance: float = 100
) -> None:
    network = _network_of(self.env.road)
    if network is not None and type(self) is OccupancyGridObservation:
        fill_lanes(self, network, layer_index, lane_perception_distance)
    else:
        replaced["fill_road_layer_by_lanes"](self, layer_index, lane_perception_distance)


_REPLACED: tuple[tuple[Any, str, Any], ...] = (
    (Road, "act", _act),
    (Road, "step", _step),
    (Road, "neighbour_vehicles", _neighbour_vehicles),
    (Road, "close_objects_to", _close_objects_to),
    (RegulatedRoad, "enforce_road_rules", _enforce_road_rules),
    (KinematicObservation, "observe", _observe),
    (OccupancyGridObservation, "fill_road_layer_by_lanes", _fill_road_layer_by_lanes),
)
