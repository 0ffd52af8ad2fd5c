"""The shapes of highway-env's lanes, and how far its vehicles are apart."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from highway_env.vehicle.objects import Obstacle

from crashhunt.world import Contact, Lane, rectangle_gap

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from highway_env.road.road import RoadNetwork
    from highway_env.vehicle.objects import RoadObject

    from crashhunt.world import Actor

__all__ = ["contact_of", "gap", "lanes_of"]

_LANE_STEP_M = 2.0  # between the points of a bend


def lanes_of(network: RoadNetwork, named: Callable[[tuple[str, str, int]], str]) -> list[Lane]:
    """Return all lanes of a network; those that bend as points 2 m apart."""
    found = []
    for index, lane in network.lanes_dict().items():
        count = 2 if type(lane).__name__ == "StraightLane" else max(2, math.ceil(lane.length / _LANE_STEP_M) + 1)
        points = [lane.position(lane.length * number / (count - 1), 0.0).tolist() for number in range(count)]
        shape = tuple((float(x), -float(y)) for x, y in points)
        found.append(Lane(named(index), float(lane.width_at(lane.length / 2)), shape))
    return found


def gap(one: RoadObject, two: RoadObject) -> float:
    """Return the distance between two outlines, in m."""
    x, y = (two.position - one.position).tolist()
    c, s = math.cos(one.heading), math.sin(one.heading)
    halves = [np.array([[thing.LENGTH / 2, thing.WIDTH / 2]]) for thing in (one, two)]
    turn = np.array([two.heading - one.heading])
    return float(rectangle_gap(np.array([[x * c + y * s, y * c - x * s]]), turn, *halves)[0])


def contact_of(
    agent: str,
    vehicle: RoadObject,
    things: Iterable[RoadObject],
    actor_of: Callable[[RoadObject], Actor],
    lane: str,
) -> Contact:
    """Return whom a controlled vehicle touches that has just crashed.

    Args:
        agent: its name.
        vehicle: itself.
        things: all that there are.
        actor_of: returns what does not change about one of them.
        lane: on which it is.
    """
    # An obstacle that something is pushed away from does not itself say so.
    others = [other for other in things if other is not vehicle and (other.crashed or isinstance(other, Obstacle))]
    hit = min(others, key=lambda other: gap(vehicle, other), default=None)
    if hit is None:
        return Contact(agent, "", "crashed", lane, float(vehicle.speed), math.nan)
    x, y = (hit.position - vehicle.position).tolist()
    first, second = (agent, vehicle), (actor_of(hit).id, hit)
    ahead = x * math.cos(vehicle.heading) + y * math.sin(vehicle.heading) > 0
    if not ahead and not isinstance(hit, Obstacle):
        first, second = second, first
    return Contact(first[0], second[0], "crashed", lane, float(first[1].speed), float(second[1].speed))
