"""Short roads of highway-env, and what happens on them without and with the accelerator."""

from __future__ import annotations

import numpy as np
from exact_values import exact
from gymnasium.utils import seeding
from highway_env.road.lane import StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from crashhunt.highway import restore_classes
from crashhunt.highway.accelerator import switch_off, switch_on


def small_road(*kinds, lanes=3, connected=False, regulated=False):
    """Vehicles on a straight road, one beside and behind the other."""
    place = (RegulatedRoad if regulated else Road)(
        RoadNetwork.straight_road_network(lanes), np_random=np.random.default_rng(1)
    )
    place.neighbour_vehicles_connected_lanes = connected
    place.vehicles += [kind(place, [17.0 * n, 4.0 * (n % lanes)], 0.02 * n, 20.0 + n) for n, kind in enumerate(kinds)]
    return place


def two_roads(poses):
    """One after the other, of two lanes each; vehicles by where they are, their speed, how old their last idea is."""
    network = RoadNetwork()
    for start, end, at in (("a", "b", 0), ("b", "c", 100)):
        for beside in range(2):
            network.add_lane(start, end, StraightLane([at, 4 * beside], [at + 100, 4 * beside], speed_limit=30))
    place = Road(network, np_random=np.random.default_rng(1))
    place.vehicles += [IDMVehicle(place, position, 0, speed, timer=timer) for position, speed, timer in poses]
    return place


def begun(kind, config, seed=3):
    """An environment that begins with a seed.

    Its constructor resets it without one, and to reset it again takes as long as a step.
    """
    env = kind.__new__(kind)
    env._np_random, _ = seeding.np_random(seed)
    env.__init__(config)
    return env


def state(place):
    """Every attribute of the vehicles and objects of a road, and its generator."""
    things = [*place.vehicles, *place.objects]
    found = [(type(thing).__name__, len(vars(thing).get("history", ())), exact(vars(thing))) for thing in things]
    return found, str(place.np_random.bit_generator.state)


def same_either_way(drive):
    """Return what a function returns without the accelerator, and with it, which stays on: these must be equal."""
    found = []
    for fast in (False, True):
        switch_off()
        restore_classes()
        if fast:
            assert switch_on() == ""
        found.append(drive())
    slow, fast = found
    assert slow == fast
    return slow
