"""Parts of observations on highway-env and on the toy, compared with the objects of the simulators."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.spaces import flatten, unflatten

from crashhunt.highway import HighwaySimulator
from crashhunt.highway._descriptor import HighwaySetup
from crashhunt.scenario import AgentSetup, Scenario, argument_values, load_scenario
from crashhunt.simulators import PARTS
from crashhunt.simulators.toy import ToySimulator
from crashhunt.trial import Disturbance

EGO, ACTORS = ({column.name: index for index, column in enumerate(PARTS[name].columns)} for name in ("ego", "actors"))
WORDS = ("ego", "actors:rows=20:radius=80", "lidar2d:rays=12", "predictions:rows=2:steps=2")


def simulator_of(name, *words):
    scenario = load_scenario(name)
    agents = {agent: replace(setup, observation=words or WORDS) for agent, setup in scenario.agents.items()}
    return HighwaySimulator(replace(scenario, agents=agents), None), argument_values(scenario)


@pytest.mark.parametrize(
    ("name", "is_straight"), [("highway", True), ("merge-highway-env", False), ("roundabout", False)]
)
def test_ego_and_actors_are_the_objects_of_highway_env(name, is_straight):
    simulator, values = simulator_of(name)
    with closing(simulator):
        observations, _ = simulator.reset(seed=2, options={"arguments": values})
        (agent,) = simulator.agents
        rng, speed, leaders = np.random.default_rng(1), None, 0
        for step in range(8):
            if step:
                space = simulator.actions[agent].space
                space.seed(int(rng.integers(99)))
                observations, *_ = simulator.step({agent: simulator.actions[agent].encode(space.sample())})
            shown = unflatten(simulator.shown_spaces[agent], observations[agent])
            assert flatten(simulator.shown_spaces[agent], shown).tobytes() == observations[agent].tobytes()
            vehicle, own = simulator._controlled[agent], shown["ego"]
            x, y = vehicle.position
            assert own[[EGO["x"], EGO["y"], EGO["speed"]]] == pytest.approx([x, -y, vehicle.speed])
            assert math.remainder(own[EGO["heading"]] + vehicle.heading, math.tau) == pytest.approx(0.0)
            if speed is not None:
                assert own[EGO["acceleration"]] == pytest.approx((vehicle.speed - speed) / simulator.step_length_s)
                assert own[EGO["steering"]] == -vehicle.action["steering"]
            speed = vehicle.speed
            number = vehicle.lane_index[2]
            assert (
                own[EGO["lane_index"]]
                == len(simulator._env.road.network.graph[vehicle.lane_index[0]][vehicle.lane_index[1]]) - 1 - number
            )
            others = [thing for thing in simulator._objects() if thing is not vehicle]
            near = sorted(
                (thing for thing in others if np.hypot(*(thing.position - vehicle.position)) <= 80.0),
                key=lambda thing: np.hypot(*(thing.position - vehicle.position)),
            )
            rows = shown["actors"]
            assert rows[:, ACTORS["present"]].sum() == min(20, len(near))
            front, rear = simulator._env.road.neighbour_vehicles(vehicle)
            for row, thing in zip(rows, near, strict=False):
                x, y = thing.position
                assert row[[ACTORS["x"], ACTORS["y"]]] == pytest.approx([x, -y])
                turn = thing.heading
                velocity = thing.speed * math.cos(turn), -thing.speed * math.sin(turn)
                assert row[[ACTORS["vx"], ACTORS["vy"]]] == pytest.approx(velocity)
                if is_straight and thing in (front, rear):
                    leaders += 1
                    is_on_lane = thing.lane_index == vehicle.lane_index
                    assert bool(row[ACTORS["same_lane"]]) == is_on_lane
                    assert (row[ACTORS["ahead"]] > 0) == (thing is front)
        assert leaders > 3 or not is_straight


def test_vehicle_without_a_route_observes_actors():
    setup = AgentSetup(observation=("actors:rows=20",))
    scenario = Scenario(simulator="highway", tables={"highway": HighwaySetup(id="racetrack-v1")}, agents={"ego": setup})
    with closing(HighwaySimulator(scenario, None)) as simulator:
        observations, _ = simulator.reset(seed=2)
        rows = simulator.observation_layouts["ego"].restore(observations["ego"])["actors"]
        assert rows[:, ACTORS["present"]].sum() == len(simulator._objects()) - 1 == 1


def test_hidden_vehicle_is_not_shown_to_an_agent_that_observes_parts():
    simulator, values = simulator_of("highway", "actors:radius=120")
    with closing(simulator):
        observations, _ = simulator.reset(seed=2, options={"arguments": values})
        (agent,) = simulator.agents
        before = observations[agent].reshape(-1, 15)
        other = next(actor.id for actor in simulator.scene().roster.actors if actor.id != agent)
        hidden = simulator.disturb(other, Disturbance(1, "ahead", "unseen", 1.0, 1.0, agent=agent))
        action = simulator.actions[agent].encode(simulator._idle(agent))
        observations, *_ = simulator.step({agent: action})
        assert observations[agent].reshape(-1, 15)[:, 0].sum() == before[:, 0].sum() - 1
        hidden.end()


def test_parts_of_the_toy_are_those_of_its_vehicles():
    agents = {"ego": AgentSetup(observation=("ego", "actors:rows=2", "lidar2d:rays=2")), "other": AgentSetup()}
    toy = ToySimulator(Scenario(simulator="toy", agents=agents), None)
    observations, _ = toy.reset(seed=1, options={"arguments": {"gap_m": 10.0}})
    assert observations["other"].shape == (8, 7)
    for _ in range(3):
        observations, *_ = toy.step({agent: toy.actions[agent].encode((8.0, 0)) for agent in ("ego", "other")})
    shown = unflatten(toy.shown_spaces["ego"], observations["ego"])
    (x, _), scene = toy.scene().points[0], toy.scene()
    assert shown["ego"][[EGO["x"], EGO["speed"], EGO["time"]]] == pytest.approx([x - 2.5, scene.speeds[0], 0.3])
    assert shown["actors"][0, ACTORS["ahead"]] == pytest.approx(scene.points[2][0] - x)
    assert shown["lidar2d"].tolist() == pytest.approx([scene.points[2][0] - 5.0 - (x - 2.5), 100.0])
