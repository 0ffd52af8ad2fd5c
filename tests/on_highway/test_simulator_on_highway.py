"""Parts of highway-env's simulator itself: its agents, actors and disturbances, without an environment."""

from __future__ import annotations

from collections import Counter
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

# First: this imports highway-env without what takes most of that time.
from crashhunt.highway import HighwaySimulator

# isort: split

from highway_env.envs.common.action import ContinuousAction, DiscreteAction
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle
from test_parts_on_highway import planned, put, straight

from crashhunt.highway import _simulator
from crashhunt.highway._disturbances import HighwayDisturbances
from crashhunt.highway._lanes_and_contacts import is_at_an_end


@pytest.fixture
def simulator():
    """A simulator of one agent on a road with another vehicle, without an environment."""
    road = straight()
    made = object.__new__(HighwaySimulator)
    made.observation_layouts = {}
    agent, made.other = put(road, 100.0, 1, kind=MDPVehicle), put(road, 130.0, 1)
    road.objects += [Obstacle(road, [150.0, 0.0]), Landmark(road, [160.0, 0.0])]
    made._env, made._controlled, made.step_length_s = (
        SimpleNamespace(road=road, np_random=road.np_random),
        {"ego": agent},
        0.5,
    )
    made._kinds, made._known, made._counts = {"ego": SimpleNamespace(acceleration_range=[-5.0, 3.0])}, {}, Counter()
    made._disturbances = HighwayDisturbances(road, [agent])
    made._kinematics, made._seeing = None, {"ego": SimpleNamespace(observe=lambda: [*road.vehicles])}
    return made


def test_actions_of_an_agent_are_those_of_its_own_vehicle(simulator, monkeypatch):
    for name in ("motion_of", "action_with", "is_steered"):
        monkeypatch.setattr(_simulator, name, lambda *given, **named: (*given, named))
    kind, vehicle = simulator._kinds["ego"], simulator._controlled["ego"]
    assert simulator.motion_of("ego", "action") == (kind, vehicle, "action", 0.5, {})
    named = {"speed_mps": 3.0, "keeps_lane": True}
    assert simulator.action_with("ego", "action", **named) == (kind, vehicle, "action", 0.5, named)
    assert simulator.is_steered("ego") == (kind, {})


def test_actors_are_numbered_as_they_are_met_and_agents_have_their_names(simulator):
    assert [simulator._actor(thing).id for thing in simulator._objects()] == ["ego", "vehicle.1", "obstacle.1"]
    assert simulator._actor(simulator.other) is simulator._actor(simulator.other)
    actor = simulator._actor(simulator.other)
    assert (actor.kind, actor.length, actor.width) == ("IDMVehicle", 5.0, 2.0)
    late = put(simulator._env.road, 160.0, 1)
    assert simulator._actor(late).id == "vehicle.2"


@pytest.mark.parametrize(
    "action", [None, ContinuousAction, DiscreteAction, partial(ContinuousAction, longitudinal=False)]
)
def test_surroundings_of_an_agent_are_all_others_whatever_its_actions_are(simulator, action):
    if action is not None:  # whose vehicle has no target lane
        simulator._kinds["ego"] = action(None)
        simulator._env.road.vehicles.remove(simulator._controlled["ego"])
        simulator._controlled["ego"] = put(simulator._env.road, 100.0, 1, kind=Vehicle)
    found = simulator.surroundings("ego")
    assert [leader.actor for leader in found.ahead] == ["vehicle.1"]
    assert found.ahead[0].gap_m == pytest.approx(25.0)
    assert (found.braking_mps2 == 5.0) is (action is not None)


def test_disturbances_and_holds_find_the_vehicle_by_its_identifier(simulator):
    brake, unseen = planned("brake"), planned("unseen", strong=1.0)
    assert simulator.resolve_target(brake) == "vehicle.1"
    assert simulator.resolve_target(planned("brake", "behind")) == ""
    made = simulator.disturb("vehicle.1", brake)
    assert made.vehicle is simulator.other
    seeing, road = simulator._seeing["ego"], simulator._env.road
    hides = simulator.disturb("vehicle.1", unseen)
    assert seeing.observe() == [simulator._controlled["ego"]]
    hides.end()
    assert len(seeing.observe()) == 2
    simulator._kinematics = SimpleNamespace(hidden=set())
    simulator.disturb("vehicle.1", unseen)
    assert simulator._kinematics.hidden == {("ego", "vehicle.1")}
    assert simulator.hold("vehicle.9", "keep_lane") is None
    assert simulator.hold("vehicle.1", "gone") is not None
    assert simulator.other not in road.vehicles
    assert simulator.hold("vehicle.1", "keep_lane") is None  # it has gone


def test_generator_of_the_road_is_reseeded_where_it_is_another_one(simulator):
    for other in (False, True):
        env = simulator._env
        env.np_random = np.random.default_rng(1)
        env.road.np_random = np.random.default_rng(2) if other else env.np_random
        simulator.reseed(7)
        first = np.random.default_rng(7).random()
        assert env.np_random.random() == first
        if other:
            assert env.road.np_random.random() == first


@pytest.mark.parametrize(
    ("x", "y", "at_an_end"), [(999.0, 4.0, False), (1001.0, 4.0, True), (1001.0, 6.1, False), (1001.0, 5.9, True)]
)
def test_vehicle_arrives_at_the_end_of_a_lane_that_leads_nowhere(simulator, x, y, at_an_end):
    vehicle = put(simulator._env.road, 900.0, 1)
    vehicle.position = np.array([x, y])
    assert bool(is_at_an_end(vehicle, simulator._env.road.network)) is at_an_end
    simulator._env.road.network.graph["1"] = {}
    assert not is_at_an_end(vehicle, simulator._env.road.network)
