"""What a careful driver of a SUMO vehicle would consider: leaders, right of way, red lights, the neighbouring lanes."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING
from xml.sax.saxutils import unescape

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.sumo._files import read_xml
from crashhunt.sumo._lane_graph import junction_of
from crashhunt.world import Crossing, Neighbor, Side, Surroundings

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence
    from pathlib import Path

_UNREGULATED_JUNCTION = re.compile(rb'<junction id="([^":][^"]*)" type="unregulated"')  # SUMO's order of attributes
_MIN_LOOK_M, _LOOK_S = 60.0, 6.0  # further away, no safe distance of a road vehicle reaches
_LEADERS, _RIGHT = 2, 1  # bits of the mode of getNeighbors
_RED_STATES = frozenset("ruR")
_STOP_LINE_MARGIN_M = 1.0  # SUMO's vehicles stop this far before a line, too
_MIN_BRAKING_MPS2 = 0.5  # a type may have a decel of 0, and a safe distance divides by it


def unregulated_junctions(network: Path) -> frozenset[str]:
    """Return the identifiers of the junctions of a network that have no rules of right of way.

    Raises:
        ScenarioError: the file cannot be read.
    """
    return frozenset(unescape(found.decode()) for found in _UNREGULATED_JUNCTION.findall(read_xml(network)))


def surroundings_of(
    agent: str, neighboring_lane: Callable[[str, int], tuple[bool, int] | None], unregulated: Collection[str] = ()
) -> Surroundings:
    """Return the surroundings of a vehicle in the current step. Only getters of libsumo are called.

    The vehicle is on the road. ``unregulated`` has the junctions without rules of right of way.
    """
    speed = max(0.0, float(sumo.vehicle_getSpeed(agent)))
    look_m = _look_m(speed)
    return Surroundings(
        speed_mps=speed,
        acceleration_mps2=float(sumo.vehicle_getAccel(agent)),
        braking_mps2=_braking(agent),
        ahead=(*_leaders(agent, look_m), *_red_lights(agent, look_m)),
        crossing=tuple(_crossing(agent, _regulated_m(agent, look_m, unregulated))),
        sides={change: side for change in (1, -1) if (side := _side(agent, change, neighboring_lane)) is not None},
    )


def nearest_ahead_of(agent: str, kind: str) -> Neighbor | None:
    """Return the nearest object of a kind that `surroundings_of` returns ahead; None without one."""
    look_m = _look_m(max(0.0, float(sumo.vehicle_getSpeed(agent))))
    found = _leaders(agent, look_m) if kind == "vehicle" else _red_lights(agent, look_m)
    return _nearest(found)


def _look_m(speed: float) -> float:
    return max(_MIN_LOOK_M, _LOOK_S * speed)


def _braking(vehicle: str) -> float:
    return max(_MIN_BRAKING_MPS2, float(sumo.vehicle_getDecel(vehicle)))


def _neighbor(vehicle: str, gap_m: float) -> Neighbor:
    return Neighbor(
        actor=vehicle,
        gap_m=gap_m,
        speed_mps=max(0.0, float(sumo.vehicle_getSpeed(vehicle))),
        braking_mps2=_braking(vehicle),
        acceleration_mps2=float(sumo.vehicle_getAccel(vehicle)),
    )


def _leaders(agent: str, look_m: float) -> list[Neighbor]:
    found = sumo.vehicle_getLeader(agent, look_m)
    # SUMO subtracts the agent's minGap from the distance. A person on a crossing is no vehicle.
    if not found or not found[0] or found[0] in sumo.person_getIDList():
        return []
    return [_neighbor(found[0], found[1] + float(sumo.vehicle_getMinGap(agent)))]


def _red_lights(agent: str, look_m: float) -> list[Neighbor]:
    return [
        Neighbor(
            actor="",
            gap_m=distance - _STOP_LINE_MARGIN_M,
            speed_mps=0.0,
            braking_mps2=_MIN_BRAKING_MPS2,
            kind="red light",
        )
        for _, _, distance, state in sumo.vehicle_getNextTLS(agent)
        if state in _RED_STATES and 0 <= distance <= look_m
    ]


def _regulated_m(agent: str, look_m: float, unregulated: Collection[str]) -> float:
    """Return how far ahead the rules of right of way are known, at most the given distance, in m."""
    if not unregulated:
        return look_m
    lane = sumo.vehicle_getLaneID(agent)
    if junction_of(lane) in unregulated:
        return 0.0
    distance_m = float(sumo.lane_getLength(lane)) - float(sumo.vehicle_getLanePosition(agent))
    for target, _, _, _, inside, _, _, length_m in sumo.vehicle_getNextLinks(agent):
        if junction_of(inside) in unregulated:
            return min(look_m, distance_m - _STOP_LINE_MARGIN_M)
        distance_m += float(length_m) + float(sumo.lane_getLength(target))
    return look_m


def _crossing(agent: str, look_m: float) -> list[Crossing]:
    """Return the actors that SUMO counts as foes of the next links, unless neither actor has to yield."""
    if look_m <= 0.0:
        return []
    length = float(sumo.vehicle_getLength(agent))
    found = []
    for foe in sumo.vehicle_getJunctionFoes(agent, look_m):
        name, distance, foe_distance, exit_m, foe_exit, _, _, yields, foe_yields = foe
        if not yields and not foe_yields:
            continue  # it comes from the same lane, and is a leader or a follower
        if exit_m + length <= 0:
            continue
        found.append(
            Crossing(
                actor=name,
                distance_m=distance,
                exit_m=exit_m + length,
                actor_distance_m=foe_distance,
                actor_exit_m=foe_exit + float(sumo.vehicle_getLength(name)),
                speed_mps=max(0.0, float(sumo.vehicle_getSpeed(name))),
                braking_mps2=_braking(name),
                has_right_of_way=bool(yields),
            )
        )
    return found


def _side(agent: str, change: int, neighboring_lane: Callable[[str, int], tuple[bool, int] | None]) -> Side | None:
    lane = neighboring_lane(agent, change)
    if lane is None:
        return None
    exists, direction = lane
    if not exists:
        return Side(exists=False)
    right = _RIGHT if direction < 0 else 0
    leaders: Sequence[tuple[str, float]] = libsumo.vehicle.getNeighbors(agent, right | _LEADERS)
    followers: Sequence[tuple[str, float]] = libsumo.vehicle.getNeighbors(agent, right)
    # SUMO subtracts the minGap of the rear vehicle from each distance.
    ahead = [_neighbor(name, away + float(sumo.vehicle_getMinGap(agent))) for name, away in leaders]
    behind = [_neighbor(name, away + float(sumo.vehicle_getMinGap(name))) for name, away in followers]
    return Side(exists=True, ahead=_nearest(ahead), behind=_nearest(behind))


def _nearest(neighbors: list[Neighbor]) -> Neighbor | None:
    return min(neighbors, key=lambda one: one.gap_m, default=None)
