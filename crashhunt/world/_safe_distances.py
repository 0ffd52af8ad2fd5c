"""Safe distances of Responsibility-Sensitive Safety (RSS), and the surroundings for which they are computed.

Source: Shalev-Shwartz, Shammah, Shashua: On a Formal Model of Safe and Scalable Self-driving Cars (2017),
arXiv:1708.06374. The safe longitudinal distance comes from definition 1 and lemma 2 of this paper. The same distance to
the followers and leaders of the target lane decides about a lane change, because a change takes a single step in SUMO.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

NeighborKind = Literal["vehicle", "red light", "crossing"]


def safe_distance(
    rear_mps: float,
    front_mps: float,
    *,
    response_s: float,
    acceleration_mps2: float,
    braking_mps2: float,
    front_braking_mps2: float,
) -> float:
    """Return the smallest gap at which the rear vehicle can avoid hitting the front vehicle, in m.

    During the response time, the rear vehicle accelerates as hard as it can; then it brakes. The front vehicle brakes
    from the beginning.

    >>> round(safe_distance(20, 20, response_s=0.5, acceleration_mps2=2, braking_mps2=4, front_braking_mps2=8), 3)
    40.375

    Args:
        rear_mps: speed of the rear vehicle, in m/s; at least 0.
        front_mps: speed of the front vehicle, in m/s; at least 0.
        response_s: response time of the rear vehicle, in s.
        acceleration_mps2: greatest acceleration of the rear vehicle, in m/s².
        braking_mps2: least deceleration with which the rear vehicle brakes, in m/s²; more than 0.
        front_braking_mps2: greatest deceleration of the front vehicle, in m/s²; more than 0.
    """
    later = rear_mps + response_s * acceleration_mps2
    driven = (rear_mps + later) / 2 * response_s + later * later / (2 * braking_mps2)
    return max(0.0, driven - front_mps * front_mps / (2 * front_braking_mps2))


def safe_speed(
    gap_m: float,
    front_mps: float,
    *,
    response_s: float,
    acceleration_mps2: float,
    braking_mps2: float,
    front_braking_mps2: float,
) -> float:
    """Return the greatest speed of the rear vehicle for which a gap is safe, in m/s; 0 if no speed is safe.

    This function is the inverse of `safe_distance`: the positive root of a quadratic equation. The gap between the
    vehicles is in m, and all other arguments are those of `safe_distance`.
    """
    # With the response time t: later² / (2 b) + later t - a t² / 2 = gap + front² / (2 b_front), later = v + a t.
    room = gap_m + front_mps * front_mps / (2 * front_braking_mps2) + acceleration_mps2 * response_s * response_s / 2
    if room <= 0:
        return 0.0
    reach = response_s * braking_mps2
    later = math.sqrt(reach * reach + 2 * braking_mps2 * room) - reach
    return max(0.0, later - response_s * acceleration_mps2)


def time_to_drive(distance_m: float, speed_mps: float, acceleration_mps2: float, top_mps: float) -> float:
    """Return the time in which a vehicle that accelerates to a top speed drives a distance, in s; infinite if never.

    Args:
        distance_m: distance in m; 0 or less takes no time.
        speed_mps: speed at the beginning, in m/s.
        acceleration_mps2: acceleration until the top speed, in m/s²; at least 0.
        top_mps: top speed in m/s; a vehicle that is faster keeps its speed.
    """
    if distance_m <= 0:
        return 0.0
    top = max(speed_mps, top_mps)
    if acceleration_mps2 <= 0 or top == speed_mps:
        return distance_m / speed_mps if speed_mps > 0 else math.inf
    spent_s = (top - speed_mps) / acceleration_mps2
    covered = (speed_mps + top) / 2 * spent_s
    if covered < distance_m:
        return spent_s + (distance_m - covered) / top
    return (math.sqrt(speed_mps * speed_mps + 2 * acceleration_mps2 * distance_m) - speed_mps) / acceleration_mps2


@dataclass(frozen=True, slots=True, kw_only=True)
class Neighbor:
    """An actor or a stop line ahead of or behind the agent, on one lane."""

    actor: str  # identifier of the actor; empty for a red light
    gap_m: float  # gap between the bumpers, in m; negative if the vehicles are side by side
    speed_mps: float  # speed of the actor along the lane, in m/s
    braking_mps2: float  # greatest deceleration of the actor, in m/s²; the usual one of its type
    acceleration_mps2: float = 0.0  # greatest acceleration of the actor, in m/s²
    # type of the obstacle: ``vehicle``, ``red light`` or ``crossing`` (an actor with a crossing path, before which the
    # agent must stop)
    kind: NeighborKind = "vehicle"


@dataclass(frozen=True, slots=True, kw_only=True)
class Crossing:
    """An actor whose path crosses or joins the agent's path in a junction."""

    actor: str  # identifier of the actor
    distance_m: float  # distance of the agent to the conflict area, in m; negative inside and after the area
    exit_m: float  # distance that the agent drives until its rear has left the conflict area, in m
    actor_distance_m: float  # distance of the actor to the conflict area, in m
    actor_exit_m: float  # distance that the actor drives until its rear has left the conflict area, in m
    speed_mps: float  # speed of the actor, in m/s
    braking_mps2: float  # greatest deceleration of the actor, in m/s²
    has_right_of_way: bool  # whether the agent must yield to the actor


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """The neighbouring lane of an agent on one side."""

    exists: bool  # whether the lane exists and the agent may use it
    ahead: Neighbor | None = None  # the nearest vehicle ahead of the agent in this lane; None if there is none
    behind: Neighbor | None = None  # the nearest vehicle behind the agent in this lane; None if there is none


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """What an action of acceleration and steering does to a vehicle."""

    speed_mps: float  # speed after the step, in m/s
    lane_change: int  # the side to which the vehicle leaves its lane; 1 left, -1 right, 0 neither


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """What a careful driver of the agent's vehicle would consider in one step."""

    speed_mps: float  # speed of the agent, in m/s
    acceleration_mps2: float  # greatest acceleration of the agent, in m/s²
    braking_mps2: float  # deceleration of the agent at full braking, in m/s²
    ahead: tuple[Neighbor, ...] = ()  # vehicles and red lights on the agent's path
    crossing: tuple[Crossing, ...] = ()  # actors whose paths cross the agent's path
    # the neighbouring lanes by direction, 1 for left and -1 for right; a missing side is unknown, as inside a junction
    sides: Mapping[int, Side] = field(default_factory=dict)
