"""Vehicles of highway-env that err: who is meant, what they do, and that the accelerator makes no difference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from crashhunt.disturbances import disturber_of
from crashhunt.episode import Episode, Observer
from crashhunt.highway import HighwaySimulator
from crashhunt.highway._descriptor import HighwaySetup
from crashhunt.scenario import AgentSetup, ObservationSetup, Scenario
from crashhunt.trial import CELLS, Disturbance, TrialSpec

CONFIG = {"simulation_frequency": 5, "policy_frequency": 5, "vehicles_count": 12, "lanes_count": 3, "duration": 999}
RATES = {"brake": 1.0, "stop": 0.2, "dawdle": 0.5, "speed": 1.0, "cut_in": 1.0, "unseen": 1.0}


class Idle(Observer):
    """Goes on as it is, and keeps what takes place."""

    def __init__(self):
        self.scenes, self.told, self.seen = [], [], []

    def reset(self, seed):
        pass

    def act(self, observation):
        self.seen.append(observation)
        return 1

    def scene(self, step, scene, rewards):
        self.scenes.append(scene.data.tobytes())

    def disturbance(self, disturbance):
        self.told.append(disturbance)


def scenario(*, accelerate=True, env="highway-fast-v0", observation=None, **config):
    usual = CONFIG if env == "highway-fast-v0" else {"simulation_frequency": 10, "policy_frequency": 5}
    setup = HighwaySetup(id=env, config={**usual, **config}, accelerate=accelerate)
    tables = {"highway": setup}
    return Scenario(simulator="highway", agents={"ego": AgentSetup()}, tables=tables, observation=observation)


@pytest.fixture
def begin():
    made = []

    def start(*disturbances, steps=100, seed=1, accelerate=True, **config):
        simulator, idle = HighwaySimulator(scenario(accelerate=accelerate, **config), None), Idle()
        spec = TrialSpec(0, seed, {}, {}, steps, disturbances=disturbances)
        episode = Episode(spec, simulator=simulator, make_agent=lambda *_: idle, observers=(idle,))
        made.append(episode)
        episode.start()
        assert episode.result is None, episode.result.failure
        return episode, idle

    yield start
    for episode in made:
        episode.close()
        episode.simulator.close()


def place(episode, lane, ahead_m, speed=20.0):
    """Put a vehicle somewhere around the agent, alone with it on the road."""
    road = episode.simulator._env.road
    agent = episode.simulator._env.vehicle
    agent.position[:] = (100.0, 4.0)
    agent.target_lane_index = agent.lane_index = ("0", "1", 1)
    agent.speed = agent.target_speed = 20.0
    other = IDMVehicle(road, np.array([100.0 + ahead_m, 4.0 * lane]), 0.0, speed, target_speed=speed, timer=0.0)
    road.vehicles[:] = [agent, other]
    episode.simulator._read_scene(())
    return other


def planned(step, what, who="ahead", strong=3.0, long=1.0):
    return Disturbance(step, who, what, strong, long, "ego")


def follow(episode, vehicle, steps):
    speeds = [vehicle.speed]
    for _ in range(steps):
        episode.step()
        speeds.append(vehicle.speed)
    return speeds


def test_the_one_that_is_ahead_brakes_and_drives_on_by_itself(begin):
    episode, idle = begin(planned(3, "brake"))
    other = place(episode, 1, 40.0)
    speeds = follow(episode, other, 12)
    assert np.allclose(np.diff(speeds)[2:7] / 0.2, -3.0)
    assert speeds[-1] > speeds[7]
    (told,) = idle.told
    assert told == replace(planned(3, "brake"), vehicle=told.vehicle)
    assert told.vehicle.startswith("vehicle.")


@pytest.mark.parametrize("observation", [None, ObservationSetup(vehicles=3, features=("presence", "x", "y"))])
def test_an_actor_is_not_seen_for_a_while(begin, observation):
    """Whoever makes the observation: highway-env itself, or crashhunt's own layout."""
    episode, idle = begin(planned(3, "unseen", "ahead", 1.0, 0.6), observation=observation)
    other = place(episode, 1, 40.0)
    follow(episode, other, 9)
    seen = [bool(shown[1][0]) for shown in idle.seen[1:]]  # the first was before the others were put away
    assert seen == [True, True, False, False, False, True, True, True]
    assert idle.told[0].vehicle


def crossing(episode, other_road, meters):
    """Put the agent before the junction and another one on a road of it, both about to drive straight on."""
    env = episode.simulator._env
    road, agent = env.road, env.vehicle
    for vehicle, (start, inside), along in ((agent, ("o0", "ir0"), 80.0), (None, other_road, meters)):
        lane = road.network.get_lane((start, inside, 0))
        if vehicle is None:
            vehicle = IDMVehicle(
                road, lane.position(along, 0.0), lane.heading_at(along), 9.0, target_speed=9.0, timer=0
            )
        vehicle.position, vehicle.heading = np.array(lane.position(along, 0.0)), lane.heading_at(along)
        vehicle.speed = 9.0
        vehicle.lane_index = vehicle.target_lane_index = (start, inside, 0)
        vehicle.lane = lane
        vehicle.plan_route_to(f"o{(int(start[1]) + 2) % 4}")
    road.vehicles[:] = [agent, vehicle]
    episode.simulator._read_scene(())
    return vehicle


JUNCTION = {"env": "intersection-v0", "initial_vehicle_count": 0, "spawn_probability": 0.0}


def test_an_actor_ignores_that_others_have_priority(begin):
    """Of two that come to the junction at once, the one from the minor road gives way, or does not."""
    least = {}
    for what in ("ignore_priority", "late_action"):
        who = "left ahead" if what == "ignore_priority" else "itself"
        episode, idle = begin(planned(1, what, who, 1.0, 6.0), **JUNCTION)
        other = crossing(episode, ("o1", "ir1"), 80.0)
        other.lane.priority = -1
        episode.simulator._env.vehicle.lane.priority = 3
        least[what] = min(follow(episode, other, 12))
        assert bool(idle.told[0].vehicle)
        assert not (what == "ignore_priority" and getattr(other, "is_yielding", False))
    assert least["late_action"] < 7.0
    assert least["ignore_priority"] > 8.5


def test_who_is_steered_has_no_route_and_its_way_is_crossed_where_its_lane_leads(begin):
    episode, _ = begin(**JUNCTION | {"env": "intersection-v1"})
    env = episode.simulator._env
    road, agent = env.road, env.vehicle
    assert type(agent).__name__ == "BicycleVehicle"
    places = {}
    for road_of_agent in (
        ("o0", "ir0"),
        ("ir0", "il2"),
    ):  # before the junction it may go anywhere, and in it straight on
        lane, other = road.network.get_lane((*road_of_agent, 0)), road.network.get_lane(("o1", "ir1", 0))
        agent.position, agent.heading = np.array(lane.position(2.0, 0.0)), lane.heading_at(2.0)
        agent.on_state_update()
        crosser = IDMVehicle(road, other.position(95.0, 0.0), other.heading_at(95.0), 9.0)
        crosser.plan_route_to("o3")
        road.vehicles[:] = [agent, crosser]
        episode.simulator._read_scene(())
        found = [cell for cell in CELLS if episode.simulator.resolve_target(planned(1, "ignore_priority", cell, 1.0))]
        places[road_of_agent] = found
    assert places == {("o0", "ir0"): [], ("ir0", "il2"): ["left ahead"]}


def test_a_vehicle_merges_only_where_its_lane_ends(begin):
    episode, idle = begin(planned(2, "late_merge", "right ahead", 15.0, 9.0), env="merge-v0")
    road, agent = episode.simulator._env.road, episode.simulator._env.vehicle
    lane = road.network.get_lane(("b", "c", 2))
    agent.position, agent.lane_index = np.array([235.0, 4.0]), ("b", "c", 1)
    agent.target_lane_index, agent.lane = agent.lane_index, road.network.get_lane(agent.lane_index)
    agent.speed = agent.target_speed = 10.0
    other = IDMVehicle(road, lane.position(20.0, 0.0), 0.0, 15.0, target_speed=15.0, timer=0.0)
    other.lane_index = other.target_lane_index = ("b", "c", 2)
    other.lane = lane
    road.vehicles[:] = [agent, other]
    episode.simulator._read_scene(())
    merged = []
    for _ in range(30):
        episode.step()
        if other.target_lane_index[2] == 1 and not merged:
            merged.append(lane.length - lane.local_coordinates(other.position)[0])
    assert idle.told[0].vehicle
    assert merged
    assert merged[0] <= 15.0
    assert episode.simulator.disturb(idle.told[0].vehicle, planned(9, "late_merge")) is None  # it is over


def test_the_same_with_and_without_the_accelerator(begin):
    drawn = disturber_of(RATES, agents=("ego",), step_length_s=0.2).draw(3, 40)
    found = []
    for accelerate in (True, False):
        episode, idle = begin(*drawn, steps=40, seed=3, accelerate=accelerate)
        while episode.result is None:
            episode.step()
        found.append((idle.scenes, idle.told, episode.result.disturbances))
    assert found[0] == found[1]
    assert len(found[0][2]) > 2


def test_a_hunt_with_disturbances(shell):
    words = ("--scenario", "highway", "--disturb", "brake=0.5,cut_in=0.5", "--seed", "1", "--no-snapshot", "--json")
    done = shell.crashhunt("run", "h", "1", "2", "20", *words)
    assert done.json["trials_run"] == 2
    assert (
        "does not support the disturbance 'step_out'"
        in shell.crashhunt(
            "run", "h2", "1", "2", "20", "--scenario", "highway", "--disturb", "step_out=1", expect=2
        ).err
    )


@pytest.mark.parametrize("accelerate", [True, False])
def test_others_are_held_to_their_speed_and_lane_or_taken_off_the_road(begin, accelerate):
    names = [f"vehicle.{number}" for number in (1, 2, 3)]
    kept = [
        Disturbance(6, "itself", what, 0.0, 99.0, "ego", name)
        for what, name in zip(("keep_speed", "keep_lane", "gone"), names, strict=True)
    ]
    episode, idle = begin(*kept, Disturbance(7, "itself", "gone", 0.0, 9.0, "ego", "vehicle.99"), accelerate=accelerate)
    speeds, there = [], []
    for step in range(12):
        speeds.append(episode.scene.speeds[episode.scene.roster.index[names[0]]])
        there.append(names[2] in episode.scene.roster.index)
        if step == 8:
            vehicle = episode.simulator._env.road.vehicles[2]
            assert (vehicle.enable_lane_change, vehicle.target_lane_index) == (False, vehicle.lane_index)
        assert episode.step() is None
    assert speeds[5:] == pytest.approx([speeds[5]] * 7)
    assert there == [True] * 6 + [False] * 6
    assert sorted((one.what, one.vehicle) for one in idle.told) == [
        ("gone", ""), ("gone", names[2]), ("keep_lane", names[1]), ("keep_speed", names[0]),
    ]  # fmt: skip
