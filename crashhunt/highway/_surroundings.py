"""What a careful driver of a highway-env vehicle would consider: vehicles ahead and on the neighbouring lanes.

Crossing actors are not considered, because highway-env's roads have no right of way that could be read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from crashhunt.highway._disturbances import lanes_ahead
from crashhunt.highway._steering import OVER_M, lane_change_of
from crashhunt.world import Neighbor, Side, Surroundings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from highway_env.road.road import RoadNetwork

    _LaneIndex = tuple[str, str, int]

_MIN_LOOK_M, _LOOK_S = 60.0, 6.0  # further away, no safe distance of a road vehicle reaches
_OTHERS_MPS2 = 6.0  # IDMVehicle.ACC_MAX: the limit of the other vehicles in both directions
_SPEED_STEP_MPS = 5.0  # ControlledVehicle.DELTA_SPEED, where a vehicle has no list of target speeds


def surroundings_of(
    network: RoadNetwork,
    vehicle: Any,
    others: Iterable[Any],
    name_of: Callable[[Any], str],
    acceleration_range: tuple[float, float] | None = None,
) -> Surroundings:
    """Return the surroundings of a vehicle. Reads positions only, and draws no random number.

    The accelerations of continuous actions are in m/s²; None for a vehicle with meta-actions.
    """
    things = list(others)
    ahead: dict[str, Neighbor] = {}
    lanes = [vehicle.lane_index]  # two while it changes lanes
    if acceleration_range is None:
        lanes.append(vehicle.target_lane_index)
    elif change := lane_change_of(vehicle, float(vehicle.lane.local_coordinates(vehicle.position)[1])):
        lanes.append(_next_lane(network, vehicle.lane_index, change))
    for index in dict.fromkeys(index for index in lanes if index is not None):
        leader = _side(network, vehicle, index, things, name_of).ahead
        if leader is not None:
            ahead[leader.actor] = leader
    sides = {}
    for change in (1, -1):
        index = _next_lane(network, vehicle.lane_index if acceleration_range else vehicle.target_lane_index, change)
        if index is not None and network.get_lane(index).is_reachable_from(vehicle.position):
            sides[change] = _side(network, vehicle, index, things, name_of)
        elif acceleration_range is not None:
            sides[change] = Side(exists=False)
        # With meta-actions, highway-env ignores a change to a lane that does not exist, or that is out of reach.
    limit = _greatest_acceleration(vehicle) if acceleration_range is None else 0.0
    braking, acceleration = acceleration_range or (-limit, limit)
    return Surroundings(
        speed_mps=max(0.0, float(vehicle.speed)),
        acceleration_mps2=acceleration,
        braking_mps2=-braking,
        ahead=tuple(ahead.values()),
        sides=sides,
    )


def _next_lane(network: RoadNetwork, index: _LaneIndex, change: int) -> _LaneIndex | None:
    start, end, own = index
    number = own - change  # highway-env numbers lanes from the left
    return (start, end, number) if 0 <= number < len(network.graph[start][end]) else None


def _greatest_acceleration(vehicle: Any) -> float:
    """Return the acceleration at the beginning of a step to the next target speed, in m/s²."""
    speeds: Any = getattr(vehicle, "target_speeds", ())
    step = float(speeds[1] - speeds[0]) if len(speeds) > 1 else _SPEED_STEP_MPS
    return float(vehicle.KP_A) * step


def _side(
    network: RoadNetwork, vehicle: Any, index: _LaneIndex, things: list[Any], name_of: Callable[[Any], str]
) -> Side:
    """Return the nearest vehicles ahead and behind on a lane."""
    along = float(network.get_lane(index).local_coordinates(vehicle.position)[0])
    found: dict[bool, Neighbor] = {}
    for lane, offset_m in _connected(network, vehicle, index):
        for thing in things:
            there, aside = lane.local_coordinates(thing.position)
            if not lane.on_lane(thing.position, there, aside, margin=OVER_M):
                continue
            away = float(there) + offset_m - along
            is_ahead, gap_m = away >= 0, abs(away) - (vehicle.LENGTH + thing.LENGTH) / 2
            if is_ahead not in found or gap_m < found[is_ahead].gap_m:
                found[is_ahead] = Neighbor(
                    actor=name_of(thing),
                    gap_m=float(gap_m),
                    speed_mps=max(0.0, float(thing.speed)),
                    braking_mps2=_OTHERS_MPS2,
                    acceleration_mps2=_OTHERS_MPS2,
                )
    return Side(exists=True, ahead=found.get(True), behind=found.get(False))


def _connected(network: RoadNetwork, vehicle: Any, index: _LaneIndex) -> Iterator[tuple[Any, float]]:
    """Yield a lane with the lanes after it and before it, each with the distance from the beginning of the lane."""
    look_m = max(_MIN_LOOK_M, _LOOK_S * float(vehicle.speed))
    begins = 0.0
    for each in lanes_ahead(network, vehicle, index):
        lane = network.get_lane(each)
        yield lane, begins
        begins += float(lane.length)
        if begins > float(network.get_lane(index).local_coordinates(vehicle.position)[0]) + look_m:
            break
    start, _, number = index
    for roads in network.graph.values():
        lanes = roads.get(start, ())
        if lanes:
            lane = lanes[min(number, len(lanes) - 1)]
            yield lane, -float(lane.length)
