"""Tests of what SUMO's vehicles do about the part of an agent's vehicle that is in another lane than its front."""

from __future__ import annotations

import math
import random
import shutil
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import libsumo
import pytest
from conftest import examples

from crashhunt.disturbances import parse_fixed
from crashhunt.envs._env_episodes import Episodes
from crashhunt.oracles import Overlap
from crashhunt.plans._choices import chosen_actions
from crashhunt.scenario import (
    argument_values,
    load_scenario,
    with_action,
    with_stated_choice,
    with_whole_vehicle_visible,
)
from crashhunt.simulators import MotionState
from crashhunt.sumo import SumoSimulator
from crashhunt.sumo._followers import Followers, Piece, _Part
from crashhunt.sumo.maps._road_network import NetworkLane
from crashhunt.trial import CallSignature

EMPTY = {"intersection": {"priority_demand": 1, "minor_demand": 1}, "motorway": {"demand": 1}}
SEEN = pytest.mark.parametrize("visible", ["front", "whole"])


@pytest.fixture
def begin(sumo_runs):
    """Return a function that begins an episode on an empty road, with a vehicle behind ego."""

    def begun(scenario, visible, form="acceleration_steering", **values):
        chosen = with_action(load_scenario(scenario), "ego", f"{form}:visible={visible}")
        return Drive(sumo_runs.open(chosen), {**argument_values(chosen), **EMPTY[scenario], **values})

    return begun


class Drive:
    """An episode in which ego holds its action."""

    def __init__(self, simulator, arguments, keeps=()):
        self.simulator, self.hits = simulator, []
        simulator.reset(seed=3, options={"arguments": arguments})
        for car in libsumo.vehicle.getIDList():
            if car not in ("ego", *keeps):
                libsumo.vehicle.remove(car)

    def add(self, name, route, lane, place, speed, **attributes):
        libsumo.vehicle.add(name, route, "DEFAULT_VEHTYPE", "now", "free", "base", "0")
        libsumo.vehicle.setImperfection(name, 0.0)
        for attribute, value in attributes.items():
            getattr(libsumo.vehicle, attribute)(name, value)
        libsumo.vehicle.moveTo(name, lane, place)
        libsumo.vehicle.setPreviousSpeed(name, speed)

    def put(self, front, heading, speed=0.0):
        motion = self.simulator._driving.moving["ego"]
        half = libsumo.vehicle.getLength("ego") / 2
        x, y = front[0] - half * math.cos(heading), front[1] - half * math.sin(heading)
        motion.state = MotionState(x=x, y=y, heading=heading, speed=speed)
        return motion

    def step(self, *action):
        self.simulator.step({"ego": self.simulator.actions["ego"].encode(action or (0.0, 0.0))})
        self.hits += [one.collision for one in Overlap().check(self.simulator.scene(), ("ego",))]

    def speeds(self, steps, name="car", *action):
        """The speeds of a vehicle in the next steps, until it drives into ego."""
        found = []
        for _ in range(steps):
            self.step(*action)
            found.append(libsumo.vehicle.getSpeed(name))
            if self.hits:
                break
        return found


@SEEN
@pytest.mark.parametrize("speed", [15.0, 20.0])
def test_vehicle_stops_behind_the_half_of_ego_that_is_in_its_lane(begin, visible, speed):
    drive = begin("motorway", visible)
    road = libsumo.vehicle.getRoadID("ego")
    (_, right), (_, middle) = (libsumo.lane.getShape(f"{road}_{lane}")[0] for lane in (0, 1))
    drive.add("car", "through", f"{road}_0", 300.0, speed, setMaxSpeed=speed + 1.0, setLaneChangeMode=0)
    drive.put((400.0, middle - 1.0), 0.3)
    speeds = drive.speeds(250)
    assert libsumo.vehicle.getLaneID("ego") == f"{road}_1"
    if visible == "front":
        assert [(hit.collider, hit.victim) for hit in drive.hits] == [("car", "ego")]
        assert speeds[-1] > 14.0
        return
    assert not drive.hits
    assert speeds[-1] < 0.1
    assert max(before - after for before, after in pairwise(speeds)) <= 0.46  # its decel of 4.5
    tail = 400.0 - libsumo.vehicle.getLength("ego") * math.cos(0.3)
    gap = tail - libsumo.vehicle.getPosition("car")[0]
    assert libsumo.vehicle.getMinGap("car") - 0.6 <= gap <= libsumo.vehicle.getMinGap("car") + 0.6
    drive.put((400.0, middle + 3.0), 0.0)  # ego leaves the lane, and the car drives by itself again
    assert drive.speeds(60)[-1] > 8.0
    assert libsumo.vehicle.getSpeedMode("car") == 31
    assert right < middle


@SEEN
def test_vehicle_that_drives_straight_on_stops_behind_the_tail_of_ego_that_turns(begin, visible):
    drive = begin("intersection", visible)
    drive.add("car", "west-east", "from-west_0", 150.0, 13.0)
    drive.put((-4.2, 0.4), 0.6)
    drive.speeds(200)
    assert libsumo.vehicle.getLaneID("ego") == ":center_11_0"
    hits = [(hit.collider, hit.victim) for hit in drive.hits]
    assert hits == ([("car", "ego")] if visible == "front" else [])
    assert libsumo.vehicle.getSpeed("car") > 10.0 or visible == "whole"
    assert libsumo.vehicle.getPosition("car")[0] < -6.0


@SEEN
def test_truck_that_turns_stops_before_the_front_of_ego_that_waits_to_turn(begin, visible):
    drive = begin("intersection", visible)
    drive.add("car", "south-west", ":center_8_0", 0.5, 3.0, setLength=8.0, setWidth=2.4)
    drive.put((-4.0, 0.33), 0.1)  # SUMO sees no conflict before the second half of a left turn
    drive.speeds(200)
    assert libsumo.vehicle.getLaneID("ego") == ":center_11_0"
    assert [(hit.collider, hit.victim) for hit in drive.hits] == ([("car", "ego")] if visible == "front" else [])


def test_long_lane_change_slows_the_vehicle_in_the_next_lane_before_the_front_is_there(begin):
    slowed = {}
    for visible in ("front", "whole"):
        drive = begin("intersection", visible)
        drive.add("car", "west-north", "from-west_1", 38.0, 13.0, setMaxSpeed=13.0)
        drive.put((-200.0, -3.2), math.atan2(3.2, 4.0 * 8.0), 8.0)  # a change over 4 s
        speeds, lanes = [], []
        for _ in range(30):
            speeds += drive.speeds(1)
            lanes.append(libsumo.vehicle.getLaneID("ego"))
        entered = lanes.index("from-west_1")
        slowed[visible] = next(step for step, speed in enumerate(speeds) if speed < 12.9) - entered
    assert slowed["whole"] < -2
    assert slowed["front"] >= 0


@SEEN
def test_vehicle_does_not_change_to_the_lane_of_the_tail_next_to_it(begin, visible):
    drive = begin("motorway", visible)
    road = libsumo.vehicle.getRoadID("ego")
    middle, left = (libsumo.lane.getShape(f"{road}_{lane}")[0][1] for lane in (1, 2))
    drive.add("slow", "through", f"{road}_0", 345.0, 10.0, setMaxSpeed=10.0, setLaneChangeMode=0)
    drive.add("car", "through", f"{road}_0", 325.0, 14.0, setMaxSpeed=35.0)
    lanes = []
    for _ in range(40):
        place = libsumo.vehicle.getPosition("car")[0]
        drive.put((place + 2.0, (middle + left) / 2 - 0.3), 0.3, 14.0)  # its tail is in the middle lane
        drive.step()
        lanes.append(libsumo.vehicle.getLaneIndex("car"))
    assert max(lanes) == (1 if visible == "front" else 0)
    assert bool(drive.hits) == (visible == "front")
    drive.put((900.0, left), 0.0, 14.0)
    drive.speeds(2)
    assert libsumo.vehicle.getLaneChangeMode("car") == 1621  # SUMO's default


def test_vehicle_ahead_changes_to_the_lane_of_a_part_at_the_gaps_at_which_sumo_changes_to_the_lane_of_the_front(begin):
    first = [1, 34, 37, 40, 43, 49]  # SUMO's limit is between those in the middle
    gaps = [*first, *sorted({*range(1, 50, 3)} - {*first})][: examples(17)]
    changes = {}
    for visible, aside in (("whole", 0.0), ("whole", 1.0), ("outline", 1.0)):
        least = changes[visible, aside] = set()
        for gap in gaps:
            drive = begin("motorway", visible)
            road = libsumo.vehicle.getRoadID("ego")
            middle, left = (libsumo.lane.getShape(f"{road}_{lane}")[0][1] for lane in (1, 2))
            drive.add("slow", "through", f"{road}_0", 350.0, 10.0, setMaxSpeed=10.0, setLaneChangeMode=0)
            drive.add("car", "through", f"{road}_0", 320.0, 14.0, setMaxSpeed=35.0)
            for _ in range(40):
                rear = libsumo.vehicle.getPosition("car")[0] - libsumo.vehicle.getLength("car")
                y = middle + aside * ((left - middle) / 2 + 0.1)  # half of ego is in the middle lane
                drive.put((rear - gap, y), 0.0, 20.0)
                drive.step()
                assert libsumo.vehicle.getLaneIndex("ego") == 1 + aside
                if libsumo.vehicle.getLaneIndex("car") == 1:
                    least.add(gap)
                    break
    assert changes["whole", 0.0] == changes["whole", 1.0] != set()
    assert 1 in changes["outline", 1.0] - changes["whole", 1.0]


def test_vehicle_below_a_bridge_does_not_brake_for_ego_on_it(tmp_path):
    shutil.copy(Path(__file__).with_name("nets") / "bridge.net.xml", tmp_path)
    (tmp_path / "r.rou.xml").write_text(
        '<routes><vehicle id="low" depart="0" departPos="150" departLane="1" departSpeed="15">'
        '<route edges="low"/></vehicle></routes>'
    )
    (tmp_path / "scenario.toml").write_text(
        'schema = 1\nsimulator = "sumo"\n[sumo]\nnet = "bridge.net.xml"\nroutes = ["r.rou.xml"]\n[agents.ego]\n'
        'edges = ["bridge", "down"]\ndepart_pos = "58"\naction = "acceleration_steering:visible=whole"\n'
    )
    with closing(SumoSimulator(load_scenario(tmp_path), tmp_path)) as simulator:
        drive = Drive(simulator, {}, keeps=["low"])
        drive.put((303.0, 300.5), math.pi / 2)  # across the side of its lane
        assert min(drive.speeds(100, "low")[1:]) > 14.0
        assert libsumo.vehicle.getPosition("low")[0] > 290.0
        assert [*simulator._followers._parts_of("ego")] == []


def test_traffic_is_bit_identical_while_ego_is_inside_its_lane(begin):
    seen = []
    for visible in ("front", "whole"):
        drive = begin("motorway", visible, demand=2500)
        states = []
        for _ in range(150):
            drive.step(0.3, 0.0)
            states.append([(car, libsumo.vehicle.getPosition(car)) for car in libsumo.vehicle.getIDList()])
        seen.append(states)
    assert len(seen[0][-1]) > 5
    assert seen[0] == seen[1]


@pytest.mark.parametrize("words", ["dawdle", "keep_speed", "user"])
def test_command_of_a_disturbance_is_bounded_and_a_hold_takes_precedence(begin, words):
    drive = begin("motorway", "outline")
    road = libsumo.vehicle.getRoadID("ego")
    middle = libsumo.lane.getShape(f"{road}_1")[0][1]
    drive.add("car", "through", f"{road}_0", 300.0, 15.0, setMaxSpeed=15.0, setLaneChangeMode=0)
    drive.put((400.0, middle - 1.0), 0.3)
    drive.step()
    if words == "user":
        libsumo.vehicle.setSpeed("car", 14.0)
        libsumo.vehicle.setSpeedMode("car", 0)
        command = None
    elif words == "keep_speed":
        command = drive.simulator.hold("car", "keep_speed")
    else:
        (disturbance,) = parse_fixed(["dawdle@1=ahead:0.2:20"], ("ego",))
        command = drive.simulator.disturb("car", disturbance)
    for _ in range(200):
        if command is not None:
            command.keep()
        drive.step()
        if drive.hits:
            break
    assert bool(drive.hits) == (words != "dawdle")
    if command is not None:
        command.end()
        assert libsumo.vehicle.getSpeedMode("car") == 31


@pytest.mark.parametrize(
    ("lane", "is_examined"),
    [
        ({}, True), ({"disallowed": {"passenger"}}, True), ({"disallowed": {"all"}}, False),
        ({"allowed": {"bus"}}, True), ({"allowed": {"pedestrian", "wheelchair"}}, False), ({"allowed": {"all"}}, True),
    ],
)  # fmt: skip
def test_lanes_of_all_vehicles_are_examined_also_without_cars(lane, is_examined):
    given = {"allowed": None, "disallowed": frozenset(), **lane}
    data = NetworkLane(length_m=9.0, speed_mps=9.0, shape=((0.0, 0.0), (9.0, 0.0)), **given)
    graph = SimpleNamespace(lanes={"a": SimpleNamespace(id="a", data=data)})
    followers = Followers(["ego"], ["ego"], lambda: graph, 0.1)
    followers.prepare()
    assert bool(followers._near([(4.0, 1.0), (5.0, 1.0)], 1.0)) == is_examined


@SEEN
def test_vehicle_of_an_agent_that_a_program_removes_has_left(begin, visible):
    simulator = begin("motorway", visible, "speed_and_lateral").simulator
    libsumo.vehicle.remove("ego")
    _, _, terminations, *_ = simulator.step({"ego": simulator.actions["ego"].encode((9.0, 1.0))})
    assert terminations == {"ego": True}


def test_outline_in_a_lane_agrees_with_points_of_the_outline():
    """Independent: a dense grid of points of the rectangle, turned into the frame of the lane point by point."""
    draw = random.Random(5)
    for _ in range(examples(60)):
        turn, x, y = draw.uniform(-3.0, 3.0), draw.uniform(-4.0, 24.0), draw.uniform(-3.5, 3.5)
        half, half_width, scale = draw.uniform(1.0, 5.0), draw.uniform(0.5, 1.3), draw.uniform(0.9, 1.1)
        right, left = -draw.uniform(0.4, 1.6), draw.uniform(0.4, 1.6)

        def at(along, across, x=x, y=y, turn=turn, half=half, half_width=half_width):
            forward, aside = along * half, across * half_width
            return (
                x + forward * math.cos(turn) - aside * math.sin(turn),
                y + forward * math.sin(turn) + aside * math.cos(turn),
            )

        outline = [at(*corner) for corner in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        part = _Part([(Piece("lane", 0.0, 0.0, 1.0, 0.0, 20.0, 7.0, scale), outline)], 0.0)
        points = [at(i / 60, j / 60) for i in range(-60, 61) for j in range(-60, 61)]
        inside = [px for px, py in points if 0.0 <= px <= 20.0 and right <= py <= left]
        reach = part.reach(right, left)
        if len(inside) > 20:
            assert reach == pytest.approx((7.0 + scale * min(inside), 7.0 + scale * max(inside)), abs=0.2)
        elif not inside and reach is not None:
            assert reach[1] - reach[0] < 0.4


def test_new_hunts_choose_the_outline_for_forms_that_can_be_in_two_lanes():
    found = {
        form: with_whole_vehicle_visible(form) for form in ("trajectory:frame=ego", "speed_and_lateral", "meta", None)
    }
    assert found == {
        "trajectory:frame=ego": "trajectory:frame=ego:visible=whole",
        "speed_and_lateral": "speed_and_lateral:visible=whole", "meta": "meta", None: None,
    }  # fmt: skip
    for name in ("acceleration_steering", "trajectory:visible=whole:frame=ego", "meta", ""):
        assert with_whole_vehicle_visible(with_stated_choice(name)) == name
    drifts = "speed_and_lane:lane_change_duration_s=3"
    assert with_whole_vehicle_visible(drifts) == f"{drifts}:visible=whole"
    assert with_whole_vehicle_visible("speed_and_lane") == "speed_and_lane"


@pytest.mark.parametrize(
    ("form", "recorded"),
    [
        ("", None),
        ("acceleration_steering", "acceleration_steering:visible=whole"),
        ("acceleration_steering:visible=front", "acceleration_steering"),
    ],
)
def test_hunt_records_what_others_see_and_an_environment_has_the_same(form, recorded):
    signatures = {"ego": CallSignature({}, open=True, given=())}
    assert chosen_actions(form, load_scenario("intersection"), signatures).get("ego") == recorded
    episodes = Episodes("intersection", "ego", form)
    assert episodes._simulator._followers.agents == (["ego"] if "whole" in str(recorded) else [])
    episodes.close()
