"""The ways of vehicles of highway-env through a junction: which of them cross that of the agent."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from highway_env.vehicle.controller import ControlledVehicle

if TYPE_CHECKING:
    from collections.abc import Iterator

    from highway_env.road.road import RoadNetwork
    from numpy.typing import NDArray

__all__ = ["crosses", "place_of"]

_REACH_M = 80.0  # what is further on is not looked at
_STEP_M = 2.0
_MEETS_M = 2.5  # two ways that come so near to each other meet
_BESIDE_M = 1.6  # half a lane: who is less to the side is ahead

_Road = tuple[str, str]


def place_of(agent: Any, other: Any) -> str:
    """Return the place of another vehicle around an agent, as the crow flies."""
    dx, dy = (other.position - agent.position).tolist()
    c, s = math.cos(agent.heading), math.sin(agent.heading)
    ahead, right = dx * c + dy * s, dy * c - dx * s  # y points down
    side = "" if abs(right) <= _BESIDE_M else "right" if right > 0 else "left"
    along = "ahead" if ahead > agent.LENGTH / 2 else "behind" if ahead < -agent.LENGTH / 2 else ""
    return f"{side} {along}".strip()


def crosses(network: RoadNetwork, agent: Any, other: Any) -> bool:
    """Whether another vehicle's way meets the agent's, and neither comes along the road of the other."""
    own_roads, own = _way(network, agent)
    roads, way = _way(network, other)
    if other.lane_index[:2] in own_roads or agent.lane_index[:2] in roads:
        return False
    offset = own[:, None, :] - way[None, :, :]
    return bool((np.hypot(offset[..., 0], offset[..., 1]) < _MEETS_M).any())


def _way(network: RoadNetwork, vehicle: Any) -> tuple[set[_Road], NDArray[np.float64]]:
    """The roads that it comes along, and points 2 m apart."""
    along = float(vehicle.lane.local_coordinates(vehicle.position)[0])
    roads, points, driven = set(), [vehicle.position], 0.0
    for index in _lanes(network, vehicle):
        roads.add(index[:2])
        lane = network.get_lane(index)
        while along < lane.length and driven < _REACH_M:
            points.append(lane.position(along, 0.0))
            along, driven = along + _STEP_M, driven + _STEP_M
        if driven >= _REACH_M:
            break
        along = 0.0
    return roads, np.array(points)


def _lanes(network: RoadNetwork, vehicle: Any) -> Iterator[tuple[str, str, int]]:
    """Its lane and those after it, as far as there is no doubt; `RoadNetwork.next_lane` would draw where there is."""
    start, end, number = vehicle.lane_index
    # Nobody has planned where a vehicle goes that is steered and not told its lanes.
    route = vehicle.route if isinstance(vehicle, ControlledVehicle) else None
    planned = {road[0]: road[1] for road in route or ()}
    seen = set()
    while (start, end) not in seen:
        yield start, end, number
        seen.add((start, end))
        after = network.graph.get(end, {})
        onward = planned.get(end) or (next(iter(after)) if len(after) == 1 else None)
        if onward not in after:
            return
        start, end, number = end, onward, min(number, len(after[onward]) - 1)
