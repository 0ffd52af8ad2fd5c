"""A short road of highway-env with vehicles of given classes."""

from __future__ import annotations

import numpy as np
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork


def small_road(*kinds, lanes=3, connected=False, regulated=False):
    """Vehicles on a straight road, one beside and behind the other."""
    place = (RegulatedRoad if regulated else Road)(
        RoadNetwork.straight_road_network(lanes), np_random=np.random.default_rng(1)
    )
    place.neighbour_vehicles_connected_lanes = connected
    place.vehicles += [kind(place, [17.0 * n, 4.0 * (n % lanes)], 0.02 * n, 20.0 + n) for n, kind in enumerate(kinds)]
    return place
