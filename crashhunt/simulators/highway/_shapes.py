"""The shapes of highway-env's lanes, and how far its vehicles are apart."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.world import Lane, rectangle_gap

if TYPE_CHECKING:
    from collections.abc import Callable

    from highway_env.road.road import RoadNetwork
    from highway_env.vehicle.objects import RoadObject

__all__ = ["gap", "lanes_of"]

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
