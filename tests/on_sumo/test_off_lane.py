"""Vehicles that SUMO takes off their lanes: parked, taxis, picking up persons, teleported, moved by remote control."""

from __future__ import annotations

import re
from pathlib import Path

import libsumo
import numpy as np
import pytest
from conftest import mostly_nightly
from onlookers import Scripted

from crashhunt.oracles import OffRoad, Overlap, ReportedCollision, TooClose
from crashhunt.scenario import AgentSetup
from crashhunt.trial import CRASHES, Disturbance, Outcome, TrialSpec

pytestmark = pytest.mark.usefixtures("agents_may_command_sumo")

NET = Path(__file__).with_name("signal.net.xml")
HEAD = """<vType id="car" sigma="0" speedDev="0"/><vType id="cab" vClass="taxi" sigma="0">
<param key="has.taxi.device" value="true"/></vType><route id="across" edges="west east"/>"""
PLACES = """<additional><parkingArea id="park" lane="west_1" startPos="60" endPos="120" roadsideCapacity="6"/>
<parkingArea id="full" lane="west_0" startPos="30" endPos="50" roadsideCapacity="1"/>
<parkingArea id="on" lane="west_0" startPos="60" endPos="120" roadsideCapacity="3" onRoad="true"/>
<chargingStation id="charge" lane="west_0" startPos="60" endPos="90"/><busStop id="bus" lane="west_0" startPos="60"
endPos="90"/><containerStop id="box" lane="west_0" startPos="60" endPos="90"/>{more}</additional>"""


def check(observation):
    assert np.isfinite(observation).all()
    assert np.abs(observation).max() < 1e6  # SUMO's word for "no value" is -1073741824


@pytest.fixture
def drive(sumo_runs):
    """Runs an episode with the compiled core and without it; returns the result and the recording, which are equal."""

    def once(native, act, ego, traffic, more, options, steps, disturbances, speed_mode):
        demand = sorted([ego, *traffic], key=lambda one: float(re.search("depart='([^']*)'", one)[1]))
        simulator = sumo_runs.written(
            NET, f"<routes>{HEAD}{''.join(demand)}</routes>", additional=PLACES.format(more=more),
            table={"options": options, "native": native}, step_length_s=0.1, warmup_s=0.0,
            agents={"ego": AgentSetup(existing=True, speed_mode=speed_mode)},
        )  # fmt: skip
        spec = TrialSpec(0, 1, {"ego": {}}, {}, max_steps=steps, disturbances=disturbances)
        oracles = [ReportedCollision(), Overlap(), OffRoad(), TooClose()]
        found = sumo_runs.record(simulator, spec, Scripted(act, check), oracles=oracles, crash_on=CRASHES)
        assert not simulator.notices
        return found

    def run(act, ego, *, traffic=(), more="", options=None, steps=400, disturbances=(), speed_mode=31):
        given = act, ego, traffic, more, options or {}, steps, disturbances, speed_mode
        (result, recording), (plain, _) = once(True, *given), once(False, *given)
        assert (result.digest, result.outcome, result.events) == (plain.digest, plain.outcome, plain.events)
        assert str(result.closest) == str(plain.closest)
        assert str(result.danger) == str(plain.danger)
        return result, recording

    return run


def vehicle(inside="", **given):
    words = {"id": "ego", "type": "car", "route": "across", "depart": "0", "departSpeed": "8"} | given
    return f"<vehicle {' '.join(f'{name}={value!r}' for name, value in words.items())}>{inside}</vehicle>"


def steady(step):
    return 8.0, 0


def parked_steps(recording, name="ego"):
    scenes = [step.scene for step in recording.all_steps if step.scene]
    return [n for n, scene in enumerate(scenes) for actor in scene.roster.actors if actor.id == name and actor.parked]


ON_THE_ROAD = tuple(vehicle(id=f"other{n}", depart=str(n), departLane="0", departSpeed="max") for n in range(2, 30, 4))
STOPS = {
    "beside the road": '<stop lane="west_0" endPos="90" duration="12" parking="true"/>',
    "beside the left lane": '<stop lane="west_1" endPos="90" duration="12" parking="true"/>',
    "in a parking area": '<stop parkingArea="park" duration="12"/>',
    "to load": '<stop containerStop="box" duration="12" parking="true"/>',
    "to charge": '<stop chargingStation="charge" duration="12" parking="true"/>',
    "at a bus stop": '<stop busStop="bus" duration="12" parking="true"/>',
    "at its start": '<stop parkingArea="park" duration="12"/>',
}


@pytest.mark.parametrize("stop", mostly_nightly(STOPS, ("beside the left lane", "in a parking area", "at its start")))
def test_parked_agent_is_observed_at_its_last_lane_without_collision(drive, stop):
    """The parking area of the left lane lies on the right lane, on which others drive through the parked vehicle."""
    is_area = "parkingArea" in STOPS[stop]
    place = {"departPos": "stop", "departSpeed": "0"} if "start" in stop else {}

    def act(step):  # a parked vehicle that is told to change lanes has no lane to leave
        return 8.0, int(is_area and 90 < step < 110) * (-1) ** step

    lane = "1" if is_area or "west_1" in STOPS[stop] else "0"
    result, recording = drive(act, vehicle(STOPS[stop], departLane=lane, **place), traffic=ON_THE_ROAD, steps=300)
    assert (result.outcome, result.events) == (Outcome.SURVIVED, {}), (result.collision, result.failure)
    parked = parked_steps(recording)
    assert len(parked) > 100
    assert recording.steps > parked[-1] + 20  # it drives on
    assert result.closest.gap_m > 0.5


@pytest.mark.parametrize("lateral", [False, True])
def test_parked_vehicles_of_the_traffic_are_passed(drive, lateral):
    """They stand in the middle of the lane on which the agent drives."""
    stop = STOPS["in a parking area"].replace("12", "900")
    traffic = [vehicle(stop, id=f"p{n}", departPos="stop", departSpeed="0") for n in range(6)]
    options = {"lateral-resolution": 0.8} if lateral else {}
    result, recording = drive(steady, vehicle(depart="15", departLane="0"), traffic=traffic, options=options, steps=200)
    assert result.outcome is Outcome.SURVIVED, result.collision
    assert any(parked_steps(recording, f"p{n}") for n in range(6))
    assert (result.events, result.danger) == ({}, 0.0)


def test_idle_taxi_survives(drive):
    result, recording = drive(steady, vehicle(type="cab", departLane="0"), traffic=ON_THE_ROAD, steps=200)
    assert (result.outcome, result.events) == (Outcome.SURVIVED, {})
    assert parked_steps(recording)


@pytest.mark.parametrize("line", ["taxi", "ego"])
def test_vehicle_that_picks_up_a_person_is_no_failure(drive, line):
    person = f"<person id='p' depart='0.5'><ride from='west' to='east' lines='{line}'/></person>"
    stop = '<stop lane="west_0" endPos="60" triggered="true" parking="true"/>' if line == "ego" else ""
    ego = vehicle(stop, type="cab" if line == "taxi" else "car", departLane="0")
    result, recording = drive(steady, ego, traffic=[person], steps=300)
    assert (result.outcome, result.failure) == (Outcome.SURVIVED, None)
    assert parked_steps(recording)


def test_vehicle_that_an_agent_moves_off_every_lane_is_observed(drive):
    def act(step):
        if 20 < step < 60:
            libsumo.vehicle.moveToXY("ego", "", -1, -100.0 + step, 40.0, angle=90.0, keepRoute=2)
        return 8.0, int(step == 40)

    result, _ = drive(act, vehicle(departLane="0"), traffic=ON_THE_ROAD, steps=200)
    assert (result.outcome, result.steps, result.failure) == (Outcome.FINISHED, 60, None)


def test_teleport_across_a_junction_is_no_red_light_run(drive):
    """SUMO puts the vehicle behind the crossing in the same step."""
    result, _ = drive(steady, vehicle(departLane="0", depart="2"), options={"time-to-teleport": 5}, steps=300)
    assert (result.outcome, result.events) == (Outcome.SURVIVED, {"teleport": 1})


def rerouter(inside):
    return f'<rerouter id="r" edges="west"><interval begin="0" end="900">{inside}</interval></rerouter>'


@pytest.mark.parametrize(
    ("stop", "more"),
    [
        pytest.param('<stop parkingArea="on" duration="12"/>', "", marks=pytest.mark.nightly),
        (
            '<stop parkingArea="full" duration="12"/>',
            rerouter('<parkingAreaReroute id="full"/><parkingAreaReroute id="on"/>'),
        ),
        ("", rerouter('<closingReroute id="east"/>')),
        pytest.param("", rerouter('<closingLaneReroute id="east_0"/>'), marks=pytest.mark.nightly),
        ('<stop lane="west_0" endPos="60" duration="3" jump="2"/><stop lane="east_0" endPos="60" duration="3"/>', ""),
        ("", '<vaporizer id="east" begin="0" end="900"/>'),
    ],
)  # fmt: skip
def test_other_ways_off_the_lane_or_the_route_are_no_failure(drive, stop, more):
    result, _ = drive(steady, vehicle(stop, departLane="0", depart="1"), more=more, traffic=ON_THE_ROAD, steps=300)
    assert result.outcome in (Outcome.SURVIVED, Outcome.FINISHED)
    assert result.failure is None


def test_disturbances_around_a_parked_vehicle_have_no_target(drive):
    ways = [("brake", "ahead"), ("cut_in", "left behind"), ("cut_in", "left ahead"), ("stop", "behind")]
    given = [
        Disturbance(step=step, agent="ego", what=what, who=who, how_strong=3.0, how_long=0.5)
        for step in range(130, 230, 10)
        for what, who in ways
    ]
    stop = vehicle(STOPS["beside the road"], departLane="0")
    left = [vehicle(id=f"left{n}", depart=str(n), departLane="1") for n in range(1, 20, 2)]
    _, recording = drive(steady, stop, traffic=[*ON_THE_ROAD, *left], steps=240, disturbances=tuple(given))
    assert {disturbance.vehicle for disturbance in recording.disturbances} == {""}


@pytest.mark.parametrize(
    ("stop", "place"),
    [
        ('<stop busStop="bus" duration="3"/>', "at bus, lane west_0, 60-90 m"),
        ('<stop lane="west_1" startPos="50" endPos="70" duration="3"/>', "on lane west_1, 50-70 m"),
    ],
)
def test_scheduled_stop_that_is_missed_is_an_event(drive, stop, place):
    """SUMO stops such a vehicle at the end of its lane, for the duration of the stop or for good."""
    result, recording = drive(steady, vehicle(stop, departLane="0"), steps=300, speed_mode=6)
    events = [event for step in recording.all_steps if step.scene for event in step.scene.events]
    (event,) = [event for event in events if event.kind == "stop_missed"]
    assert result.outcome is Outcome.SURVIVED
    assert event.what == f"ego missed its scheduled stop {place}: SUMO stopped it at the end of lane west_0"
