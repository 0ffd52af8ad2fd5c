"""The toy simulator: every rule of its road."""

from __future__ import annotations

import numpy as np
import pytest

from crashhunt.base.errors import InvalidEpisodeError, SimulatorError
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators import toy
from crashhunt.simulators.toy import ToySimulator
from crashhunt.trial import Disturbance

DT = 0.5


def made(agents=("a", "b"), seed=1, action="continuous", brakes=False, **arguments):
    simulator = ToySimulator(
        Scenario(step_length_s=DT, agents={name: AgentSetup(action=action) for name in agents}), None
    )
    simulator.seen, _ = simulator.reset(seed=seed, options={"arguments": arguments})
    simulator._rng = type("Rng", (), {"random": lambda self: 0.04 if brakes else 0.05})()
    return simulator


def step(simulator, *values):
    actions = {
        agent: simulator.actions[agent].encode(value) for agent, value in zip(simulator.agents, values, strict=True)
    }
    return simulator.step(actions)


def places(simulator):
    scene = simulator.scene()
    return {
        actor.id: (x, speed)
        for actor, (x, _), speed in zip(scene.roster.actors, scene.points, scene.speeds, strict=True)
    }


def test_vehicles_begin_in_a_row_behind_the_leader():
    assert places(made()) == {"a": (0.0, 10.0), "b": (35.0, 10.0), "leader": (70.0, 10.0)}
    simulator = made(leader_speed=4, gap_m=10)
    assert places(simulator) == {"a": (0.0, 4.0), "b": (15.0, 4.0), "leader": (30.0, 4.0)}
    assert simulator.agents == ["a", "b"]
    assert simulator.seen["a"][:3, 1].tolist() == [0.0, 15.0, 30.0]
    (lane,) = simulator.lanes()
    assert (lane.id, lane.width, lane.shape) == ("road_0", 3.5, ((0.0, 0.0), (1000.0, 0.0)))
    assert made(road_m=50).lanes()[0].shape[1] == (50.0, 0.0)
    actor = simulator.scene().roster.actors[0]
    assert (actor.kind, actor.length, actor.width) == ("passenger", 5.0, 1.8)


def test_vehicles_reach_their_target_speed_within_their_limits():
    simulator = made()
    observations, rewards, terminations, truncations, infos = step(simulator, (20.0, 0), (0.0, 0))
    assert places(simulator) == {"a": (5.75, 11.5), "b": (38.0, 6.0), "leader": (75.0, 10.0)}
    assert rewards == {"a": 5.75, "b": 3.0}
    assert (terminations, truncations, infos) == (
        dict.fromkeys("ab", False),
        dict.fromkeys("ab", False),
        {"a": {}, "b": {}},
    )
    assert observations["a"][0, 1:4].tolist() == [5.75, 0.0, 11.5]
    for _ in range(2):
        step(simulator, (11.6, 0), (0.0, 0))
    assert [speed for _, speed in places(simulator).values()] == [pytest.approx(11.6), 0.0, 10.0]
    assert simulator.scene().time_s == 1.5


def test_leader_brakes_at_random_and_reseeding_decides_when():
    simulator = made(brakes=True)
    step(simulator, (10.0, 0), (10.0, 0))
    assert places(simulator)["leader"] == (73.0, 6.0)

    def run(seed):
        simulator = made(seed=1)
        simulator.reseed(seed)
        speeds = []
        for _ in range(30):
            step(simulator, (0.0, 0), (0.0, 0))
            speeds.append(places(simulator)["leader"][1])
        return speeds

    assert run(3) == run(3) != run(4)
    assert min(run(3)) < 10.0


def test_meta_actions_change_the_speed_in_steps():
    simulator = made(action="meta", gap_m=300)
    for action, speed in ((1, 10.0), (3, 11.5), (0, 11.5), (2, 11.5), (4, 7.5), (4, 3.5), (4, 0.0)):
        step(simulator, action, 1)
        assert places(simulator)["a"][1] == speed
    assert simulator.full_braking("a").action == 4
    braking = made().full_braking("a")
    assert (braking.action, braking.deceleration) == ((0.0, 0), 8.0)


def test_contact_is_with_the_vehicle_ahead_and_reported_once():
    simulator = made(gap_m=1.0, leader_speed=0.0)
    *_, terminations, _, _ = step(simulator, (20.0, 0), (0.0, 0))
    assert simulator.scene().contacts == ()
    *_, terminations, _, _ = step(simulator, (20.0, 0), (0.0, 0))
    (contact,) = simulator.scene().contacts
    assert (contact.collider, contact.victim, contact.kind, contact.lane) == ("a", "b", "collision", "road_0")
    assert (contact.collider_speed, contact.victim_speed) == (3.0, 0.0)
    assert terminations == {"a": True, "b": False}
    assert simulator.agents == ["b"]
    step(simulator, (20.0, 0))
    assert simulator.scene().contacts == ()
    step(simulator, (20.0, 0))
    (contact,) = simulator.scene().contacts
    assert (contact.collider, contact.victim) == ("b", "leader")
    touching = made(agents=("a",), gap_m=0.0, leader_speed=0.0)
    step(touching, (0.0, 0))
    assert touching.scene().contacts == ()  # bumper to bumper is no overlap


def test_agent_that_arrives_is_gone_and_the_others_continue():
    simulator = made(road_m=45.0)
    observations, _, terminations, *_ = step(simulator, (10.0, 0), (10.0, 0))
    assert terminations == {"a": False, "b": False}
    observations, rewards, terminations, *_ = step(simulator, (10.0, 0), (10.0, 0))
    assert terminations == {"a": False, "b": True}  # at 45 m exactly
    assert (simulator.agents, list(places(simulator))) == (["a"], ["a", "leader"])
    assert not observations["b"].any()
    assert rewards["b"] == 5.0
    step(simulator, (10.0, 0))
    assert places(simulator)["a"][0] == 15.0
    simulator.reset(seed=1)
    assert simulator.agents == ["a", "b"]


def test_lanes_are_in_each_tenth_scene_and_at_contacts():
    simulator = made(agents=("a",), gap_m=100.0)
    found = [bool(simulator.scene().lanes)]
    for _ in range(10):
        step(simulator, (0.0, 0))
        found.append(bool(simulator.scene().lanes))
    assert found == [True, *[False] * 9, True]
    assert simulator.scene().lanes == ("road_0", "road_0")
    crash = made(agents=("a",), gap_m=1.0, leader_speed=0.0)
    step(crash, (20.0, 0)), step(crash, (20.0, 0))
    assert crash.scene().lanes == ("road_0", "road_0")


def planned(what="brake", who="ahead", strong=3.0, agent="b"):
    return Disturbance(1, who, what, strong, 1.0, agent)


def test_leader_is_the_only_target_of_the_agent_behind_it():
    simulator = made()
    assert simulator.resolve_target(planned()) == "leader"
    assert simulator.resolve_target(planned(agent="a")) == ""
    assert simulator.resolve_target(planned(who="behind")) == ""
    assert simulator.resolve_target(planned(agent="gone")) == ""


def test_disturbances_and_holds_change_the_leader_while_they_last():
    simulator = made()
    brake = simulator.disturb("leader", planned(strong=9.0))
    assert brake.how_strong == 8.0
    for speed in (6.0, 2.0, 0.0):
        step(simulator, (0.0, 0), (0.0, 0))
        assert places(simulator)["leader"][1] == speed
        brake.keep()
    brake.end()
    step(simulator, (0.0, 0), (0.0, 0))
    assert places(simulator)["leader"][1] == 1.5
    gentle = simulator.disturb("leader", planned(strong=1.0))
    assert gentle.how_strong == 1.0
    step(simulator, (0.0, 0), (0.0, 0))
    assert places(simulator)["leader"][1] == 1.0
    gentle.end()
    assert simulator.hold("leader", "keep_lane") is simulator.hold("a", "keep_speed") is None
    steady = simulator.hold("leader", "keep_speed")
    for _ in range(2):
        step(simulator, (0.0, 0), (0.0, 0))
        steady.keep()
        assert places(simulator)["leader"][1] == 1.0
    assert steady.how_strong == 1.0
    steady.end()
    step(simulator, (0.0, 0), (0.0, 0))
    assert places(simulator)["leader"][1] == 2.5
    hidden = simulator.disturb("leader", planned("unseen"))
    observations, *_ = step(simulator, (0.0, 0), (0.0, 0))
    assert [int(observations[agent][:, 0].sum()) for agent in "ab"] == [3, 2]
    simulator.reset(seed=1)
    assert simulator._kinematics.hidden == set()
    hidden.end()


def test_simulator_fails_on_demand(monkeypatch):
    with pytest.raises(InvalidEpisodeError, match="as its scenario arguments demand"):
        made(fail_reset=True)
    happened = []
    monkeypatch.setattr(toy.os, "_exit", lambda code: happened.append(("exit", code)))
    monkeypatch.setattr(toy.time, "sleep", lambda seconds: happened.append(("sleep", seconds)))
    monkeypatch.setattr(toy.ctypes, "string_at", lambda place: happened.append(("read", place)))
    monkeypatch.setattr(
        toy.ctypes, "PyDLL", lambda name: type("C", (), {"sleep": lambda self, s: happened.append((name, s))})()
    )
    simulator = made(fail_at_step=5, exit_at_step=2, segfault_at_step=3, hang_at_step=4, step_wall_s=0.25)
    for expected in ([], [("exit", 3)], [("read", 0)], [(None, 3600)]):
        happened.clear()
        step(simulator, (0.0, 0), (0.0, 0))
        assert happened == [("sleep", 0.25), *expected]
    with pytest.raises(SimulatorError, match="as its scenario arguments demand"):
        step(simulator, (0.0, 0), (0.0, 0))
    happened.clear()
    step(made(), (0.0, 0), (0.0, 0))
    assert happened == []
    assert np.isfinite(simulator.scene().time_s)
