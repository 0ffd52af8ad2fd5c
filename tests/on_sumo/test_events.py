"""Traffic events on SUMO: each by a small scenario that brings it about; red lights against another way to count."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise
from pathlib import Path

import libsumo
import numpy as np
import pytest
from conftest import mostly_nightly
from onlookers import Scripted

from crashhunt.highway import HighwaySimulator
from crashhunt.highway._descriptor import HighwaySetup
from crashhunt.oracles import OffRoad, Overlap, ReportedCollision
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.sumo import SumoEvents
from crashhunt.trial import CRASHES, Outcome, TrialSpec

pytestmark = pytest.mark.usefixtures("agents_may_command_sumo")

NET = Path(__file__).with_name("signal.net.xml")
ROUTES = """<routes>
<vType id="car" sigma="0"/><vType id="oncoming" sigma="0" lcOpposite="1"/>
<route id="across" edges="west east"/><route id="left" edges="west north"/><route id="back" edges="-east -west"/>
<route id="up" edges="south north"/>
{traffic}
</routes>"""


@pytest.fixture
def drive(sumo_runs):
    """Runs an episode on a signalled crossing; returns its result and the events with their steps."""

    def run(act, *, route="across", traffic="", steps=300, dt=0.1, warmup_s=0.0, crash_on=CRASHES, **more):
        limits, options, net = more.pop("limits", {}), more.pop("options", {}), more.pop("net", NET)
        routes, setup = more.pop("routes", ROUTES), {"type": "car", **more}
        simulator = sumo_runs.written(
            net,
            routes.format(traffic=traffic),
            table={"options": options},
            step_length_s=dt,
            warmup_s=warmup_s,
            agents={"ego": AgentSetup(**({} if setup.get("existing") else {"route": route}), **setup)},
            events=limits,
        )
        oracles = [ReportedCollision(), Overlap(), OffRoad()]
        spec = TrialSpec(0, 1, {"ego": {}}, {}, max_steps=steps)
        result, recording = sumo_runs.record(simulator, spec, Scripted(act), oracles=oracles, crash_on=crash_on)
        assert result.failure is None, result.failure.traceback
        told = [(step.step, event) for step in recording.all_steps if step.scene for event in step.scene.events]
        assert result.events == Counter(event.kind for _, event in told)
        return result, told

    return run


BEYOND = {":c_5_0": ":c_6_0"}  # who turns left may wait in the middle of the crossing


def steady(speed):
    """Drives at one speed."""
    return lambda step: (speed, 0)


def kinds(told):
    return [event.kind for _, event in told]


@pytest.mark.parametrize(
    ("route", "dt"),
    mostly_nightly(
        [(route, dt) for route in ("across", "left", "up") for dt in (0.1, 0.5, 1.0)],
        always=[("across", 0.1), ("left", 0.5), ("up", 1.0)],
    ),
)
def test_red_lights_are_those_that_another_way_of_counting_finds(drive, route, dt):
    """Every four seconds of a cycle of 40: the signal's own state, and the lane before and after each step."""
    total = 0
    for departs in range(0, 40, 4):
        seen = []

        def act(step, seen=seen):
            state = libsumo.trafficlight.getRedYellowGreenState("c")
            seen.append((libsumo.vehicle.getLaneID("ego"), state))
            return 11.0, 0

        lane = "1" if route == "left" else "0"
        result, told = drive(act, route=route, dt=dt, warmup_s=departs, steps=round(25 / dt), depart_lane=lane)
        links = [link for (link,) in libsumo.trafficlight.getControlledLinks("c")]
        expected = 0
        for (before, _), (after, state) in pairwise(seen):
            shown = {
                state[number]
                for number, (source, to, via) in enumerate(links)
                if source == before and edge(after) in (edge(to), edge(via), edge(BEYOND.get(via, via)))
            }
            expected += shown == {"r"}
        assert kinds(told) == ["red_light"] * expected
        assert result.outcome in (Outcome.FINISHED, Outcome.SURVIVED)
        total += expected
    assert 3 <= total <= 7


def test_red_light_of_the_second_junction_in_a_step_is_seen(drive):
    """The first junction has no light. The signal's own state and the edges before and after each step say the same."""
    routes = '<routes><vType id="car" sigma="0"/><route id="on" edges="west middle east"/>{traffic}</routes>'
    both = expected = 0
    for departs in range(0, 90, 3):
        seen, speed = [], 28.0 + departs % 13

        def act(step, seen=seen, speed=speed):
            seen.append((edge(libsumo.vehicle.getLaneID("ego")), libsumo.trafficlight.getRedYellowGreenState("two")))
            return speed, 0

        net = NET.parent / "nets" / "lights.net.xml"
        _, told = drive(
            act, net=net, routes=routes, route="on", dt=1.0, warmup_s=departs, steps=16, depart_speed=f"{speed}"
        )
        links = [source for ((source, _, _),) in libsumo.trafficlight.getControlledLinks("two")]
        passed = [
            (before, state[links.index("middle_0")])
            for (before, _), (after, state) in pairwise(seen)
            if before != "east" and not before.startswith(":two") and (after == "east" or after.startswith(":two"))
        ]
        ran = [before for before, state in passed if state == "r"]
        assert kinds(told) == ["red_light"] * len(ran)
        expected += len(ran)
        both += sum(before in ("west", ":one_1") for before in ran)
    assert expected >= 5
    assert both >= 3, (expected, both)


def edge(lane):
    return lane.rpartition("_")[0]


def test_a_red_light_ends_a_trial_where_an_actor_asked_for_it(drive):
    result, told = drive(steady(10.0), warmup_s=10.0, crash_on=(Outcome.RED_LIGHT,))
    ((step, event),) = told
    assert (result.outcome, result.steps, result.collision, result.event) == (Outcome.RED_LIGHT, step, None, event)
    assert result.summary == f"ego ran a red light at 10.0 m/s, coming from lane west_0, at step {step}"
    assert (event.lane, event.speed, event.y) == (":c_3_0", pytest.approx(10), pytest.approx(-4.8))
    again, _ = drive(steady(10.0), warmup_s=10.0)
    assert again.outcome is Outcome.FINISHED  # it is told, and nothing else
    assert again.events == {"red_light": 1}


def test_what_is_reported_is_no_part_of_the_digest(drive, monkeypatch):
    told, _ = drive(steady(10.0), warmup_s=10.0)
    monkeypatch.setattr(SumoEvents, "look", lambda *_: ())
    silent, _ = drive(steady(10.0), warmup_s=10.0)
    assert told.events
    assert not silent.events
    assert told.digest == silent.digest


def test_a_missed_route_is_reported_where_sumo_stops_the_vehicle(drive):
    """SUMO's vehicles never leave their route: one on the wrong lane is held at its end for ever."""
    result, told = drive(steady(10.0), route="left", depart_lane="0", limits={"not_moving": 5.0}, crash_on=())
    assert kinds(told) == ["off_route", "not_moving"]
    (step, event), (later, _) = told
    assert (event.lane, event.speed) == ("west_0", 0.0)
    assert later - step == 49
    assert result.outcome is Outcome.SURVIVED
    assert drive(steady(10.0), route="left", depart_lane="1")[1] == []


def test_the_wrong_way(drive):
    def overtakes(step):
        if step == 30:
            libsumo.vehicle.changeLane("ego", 1, 5.0)  # a lane further to the left than there are in its direction
        if step == 60:
            libsumo.vehicle.changeLane("ego", 0, 5.0)
        return 10.0, 0

    _, told = drive(overtakes, route="back", type="oncoming", depart_speed="10", crash_on=())
    assert kinds(told) == ["wrong_way"]
    assert told[0][1].lane == "east_1"
    assert 30 < told[0][0] <= 40
    assert drive(steady(10.0), route="back", type="oncoming")[1] == []


def cuts_in(step):
    return 6.0, 1 if step == 42 else 0


BEHIND = '<vehicle id="f" type="car" route="across" depart="1" departLane="1" departSpeed="15"/>'
IN_FRONT_OF_IT = {"depart_lane": "0", "depart_speed": "6", "depart_pos": "40", "steps": 100}


def test_the_one_that_brakes_hard_behind_is_reported(drive):
    _, ((step, event),) = drive(cuts_in, traffic=BEHIND, **IN_FRONT_OF_IT)
    assert (event.kind, event.agent, event.others) == ("hard_braking", "ego", ("f",))
    assert event.what == "f braked at 9.0 m/s² with ego ahead of it"
    assert step == 43  # the lane is changed at the end of a step; in the next, the other decides
    assert drive(cuts_in, traffic=BEHIND, limits={"hard_braking": 9.5}, **IN_FRONT_OF_IT)[1] == []
    # The same braking for somebody else, two metres behind whom the controlled vehicle follows on.
    ahead = '<vehicle id="slow" type="car" route="across" depart="0" departLane="0" departPos="40" departSpeed="6"/>'

    leaves: list[int] = []

    def follows(step):
        if step == 1:
            libsumo.vehicle.setLaneChangeMode("slow", 0)
            libsumo.vehicle.setSpeed("slow", 6.0)
        if step == 42:
            libsumo.vehicle.changeLane("slow", 1, 5.0)
        if step in leaves:
            libsumo.vehicle.changeLane("slow", 0, 5.0)
        return 6.0, 0

    braking = []

    def watches(step):
        if "f" in libsumo.vehicle.getIDList():
            braking.append(libsumo.vehicle.getAcceleration("f"))
        return follows(step)

    place = {"depart_lane": "0", "depart_speed": "6", "depart_pos": "80", "steps": 100}
    assert drive(watches, traffic=ahead + BEHIND, **place)[1] == []
    assert min(braking) < -8.0
    # The controlled vehicle is next ahead only once that one has left the lane, in the step after.
    leaves.append(45)
    assert drive(watches, traffic=ahead + BEHIND, **{**place, "depart_lane": "1"})[1] == []


def test_the_one_that_brakes_hard_for_one_that_crosses_is_reported(drive):
    cross = '<flow id="c" type="car" route="across" begin="0" end="60" period="1.7" departSpeed="15"/>'
    place = {"depart_pos": "60", "depart_speed": "0", "traffic": cross}
    result, told = drive(lambda step: (8.0 if step > 37 else 0.0, 0), route="up", **place)
    assert kinds(told) == ["red_light", "hard_braking"]
    assert told[1][1].what == "c.0 braked at 9.0 m/s² with ego across its way"
    assert result.summary.startswith("ego was hit by c.0")


def test_others_that_collide_in_sight(drive):
    """One of two others is told to ignore everything, and drives into the first, which waits at the red light."""
    two = "".join(
        f'<vehicle id="{name}" type="car" route="across" depart="{depart}" departLane="0" departSpeed="10"/>'
        for name, depart in (("a", 18), ("b", 22))
    )

    def act(step):
        if "b" in libsumo.vehicle.getIDList():
            libsumo.vehicle.setSpeedMode("b", 0)
            libsumo.vehicle.setLaneChangeMode("b", 0)
            libsumo.vehicle.setSpeed("b", 10.0)
        return 8.0, 0

    result, told = drive(act, route="back", traffic=two, warmup_s=15.0, steps=250)
    event = next(event for _, event in told if event.kind == "others_collided")
    assert event.others == ("b", "a")
    assert event.what.startswith("b drove into a, ")
    assert "had braked hard" not in event.what
    assert result.outcome is not Outcome.COLLISION


def test_teleports_of_the_controlled_vehicle_and_in_sight(drive):
    options = {"time-to-teleport": 5}
    result, told = drive(steady(0.0), options=options, crash_on=(Outcome.TELEPORT,))
    assert result.summary == f"SUMO teleported ego, at step {result.steps}"
    assert kinds(told) == ["teleport"]
    other = '<vehicle id="o" type="car" route="across" depart="0" departLane="1" departSpeed="10"/>'

    def act(step):
        libsumo.vehicle.setSpeed("o", 0.0) if "o" in libsumo.vehicle.getIDList() else None
        return 10.0, 0

    _, told = drive(act, traffic=other, options=options, route="up", depart_pos="0", steps=150)
    assert [event.others for _, event in told if event.kind == "teleport"] == [("o",)]
    assert next(event.what for _, event in told if event.kind == "teleport").startswith("SUMO teleported o, ")


def test_on_highway_env_a_standstill_and_driving_backwards(tmp_path):
    config = {"action": {"type": "ContinuousAction"}, "vehicles_count": 0, "policy_frequency": 5, "duration": 1000}
    scenario = Scenario(
        simulator="highway",
        agents={"ego": AgentSetup()},
        tables={"highway": HighwaySetup(id="highway-fast-v0", config=config)},
        events={"not_moving": 3.0},
    )
    simulator = HighwaySimulator(scenario, tmp_path)
    simulator.reset(seed=1, options={"arguments": {}})
    told = []
    for step in range(1, 90):
        # It brakes from 25 m/s at 5 m/s², stands, and goes on backwards.
        braking = -1.0 if step <= 25 or step > 60 else 0.0
        simulator.step({"ego": np.array([braking, 0.0], np.float32)})
        told += [(step, event) for event in simulator.scene().events]
    assert [(step, event.kind) for step, event in told] == [(39, "not_moving"), (61, "wrong_way")]
    assert told[1][1].what == "ego drove backwards on lane 0_1_1"
    simulator.close()


STOP_ROUTE = {"stops": ("-103", "105"), "allway": ("A0A1", "A1B1")}


@pytest.mark.parametrize("name", STOP_ROUTE)
def test_stop_sign_is_run_by_a_vehicle_that_does_not_stand_before_the_line(drive, name, tmp_path):
    """TraCI's own positions and speeds say where the vehicle stood; SUMO's driver stops at each sign."""
    net, edges = NET.parent / "nets" / f"{name}.net.xml.gz", " ".join(STOP_ROUTE[name])
    routes = f'<routes><vType id="car" sigma="0"/><route id="on" edges="{edges}"/>{{traffic}}</routes>'
    for halts_m, expected in ((None, ["stop_sign"]), (3.0, []), (20.0, ["stop_sign"])):
        stood = []

        def act(step, halts_m=halts_m, stood=stood):
            lane = libsumo.vehicle.getLaneID("ego")
            rest = libsumo.lane.getLength(lane) - libsumo.vehicle.getLanePosition("ego")
            if halts_m is None or stood.count(True) > 5 or not lane.startswith(STOP_ROUTE[name][0]):
                return 8.0, 0
            stood.append(libsumo.vehicle.getSpeed("ego") < 0.1)
            return math.sqrt(max(0.0, 3.0 * (rest - halts_m))), 0

        result, told = drive(act, net=net, routes=routes, route="on", dt=0.1, steps=600, depart_speed="5", speed_mode=0)
        assert kinds(told) == expected, halts_m
        assert result.outcome in (Outcome.FINISHED, Outcome.SURVIVED)
        assert not expected or told[0][1].what.startswith("ego ran a stop sign at ")
    result, told = drive(lambda _: None, net=net, routes=routes, route="on", dt=0.1, steps=900, action="sumo")
    assert (result.outcome, kinds(told)) == (Outcome.FINISHED, [])
