"""Traffic that keeps to the left: SUMO mirrors everything, and left is left all the same."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import libsumo
import pytest

from crashhunt.oracles import Overlap
from crashhunt.sumo._bent_vehicles import Bends
from crashhunt.trial import Disturbance

OTHER = '<vehicle id="{0}" type="car" route="st" depart="0" departPos="70" departLane="{0}" departSpeed="10"/>'
ROUND = "A0A1 A1B1 B1B0 B0A0 A0A1"
NET = Path(__file__).with_name("nets") / "left.net.xml"
SCENARIO = """
schema = 1
simulator = "sumo"
step_length_s = 0.1

[sumo]
net = "left.net.xml"
routes = ["r.rou.xml"]
options = { %s }

[agents.ego]
agent = "keep-lane"
type = "car"
edges = ["st"]
depart_lane = "1"
depart_pos = "50"
depart_speed = "10"
action = "%s"
"""


@pytest.fixture
def begin(sumo_runs):
    """Return a function that begins an episode in a scenario of a network, traffic and a text."""

    def begun(net, traffic, text):
        simulator = sumo_runs.open(sumo_runs.write(net, f"<routes>{traffic}</routes>", {"scenario.toml": text}))
        simulator.shown, _ = simulator.reset(seed=1, options={})
        return simulator

    return begun


@pytest.mark.parametrize("action", ["continuous", "meta"])
@pytest.mark.parametrize("options", ["", "lateral-resolution = 0.8"])
def test_a_change_to_the_left_is_one(begin, options, action):
    simulator = begin(NET, '<vType id="car" sigma="0" speedFactor="1"/>', SCENARIO % (options, action))
    for side in (1, -1):
        observations, *_ = simulator.reset(seed=1, options={})
        before = observations["ego"][0]
        y = simulator.scene().points[0][1]
        form, step = simulator.actions["ego"], None
        for number in range(40):
            turn = number == 0
            meant = (10.0, side if turn else 0) if action == "continuous" else (1 - side) if turn else 1
            step = simulator.step({"ego": form.encode(meant)})
        moved = simulator.scene().points[0][1] - y  # it drives towards x
        assert 2.0 < side * moved < 3.3  # on the sublanes, most of it
        shown = step[0]["ego"][0]
        assert before[2] == pytest.approx(3.2)  # right of the leftmost lane, of three
        assert shown[2] - before[2] == pytest.approx(-moved, abs=1e-3)


def test_a_sidewalk_does_not_move_the_lanes_of_the_observation(begin):
    """The sidewalk is lane 0 and 2 m wide; the other lanes have 3.2 m."""
    text = SCENARIO.replace('"st"', '"e"').replace("left.net", "sidewalk.net")
    simulator = begin(NET.with_name("sidewalk.net.xml"), '<vType id="car" sigma="0"/>', text % ("", "continuous"))
    assert simulator.shown["ego"][0][2] == pytest.approx(3.2)
    for _ in range(20):
        observations, *_ = simulator.step({"ego": simulator.actions["ego"].encode((10.0, 1))})
        if observations["ego"][0][2] == 0:
            break
        assert observations["ego"][0][2] == pytest.approx(3.2)
    assert observations["ego"][0][2] == 0


@pytest.mark.parametrize(("who", "lane", "side"), [("left ahead", "0", 1), ("right ahead", "2", -1)])
def test_who_cuts_in_from_the_left_is_there(begin, who, lane, side):
    traffic = (
        f'<vType id="car" sigma="0" speedFactor="1"/><route id="st" edges="st"/>{OTHER.format(0)}{OTHER.format(2)}'
    )
    simulator = begin(NET, traffic, SCENARIO % ("", "continuous"))
    cut_in = Disturbance(1, who, "cut_in", 0.0, 2.0, "ego")
    assert simulator.resolve_target(cut_in) == lane
    scene = simulator.scene()
    y = dict(zip([actor.id for actor in scene.roster.actors], [y for _, y in scene.points], strict=True))
    assert side * (y[lane] - y["ego"]) > 3.0  # it drives towards x
    assert simulator.disturb(lane, cut_in) is not None
    for _ in range(5):
        simulator.step({"ego": simulator.actions["ego"].encode((10.0, 0))})
    scene = simulator.scene()
    after = dict(zip([actor.id for actor in scene.roster.actors], [y for _, y in scene.points], strict=True))
    assert after[lane] == after["ego"]


DRIVERS = """
schema = 1
simulator = "sumo"
step_length_s = 0.1

[sumo]
net = "{net}"
routes = ["r.rou.xml"]

[agents.ego]
edges = ["{edge}"]
depart_pos = "20"
depart_speed = "10"
observation = ["ego", "actors"]
action = "{action}"

[agents.ahead]
edges = ["{edge}"]
depart_pos = "50"
depart_speed = "10"
observation = ["ego"]
action = "{action}"
"""


@pytest.mark.parametrize(
    ("action", "answers"),
    [("speed_and_lateral", [(10.0, 0.5), (10.0, -0.4)]), ("acceleration_steering", [(0.0, 0.01), (0.0, -0.008)])],
)
@pytest.mark.parametrize(("net", "edge"), [("left.net.xml", "st"), ("left-street.net.xml", "ab")])
def test_left_is_left_in_offsets_and_drifts_also_of_a_road_with_one_lane(begin, net, edge, action, answers):
    simulator = begin(NET.with_name(net), "", DRIVERS.format(net=net, edge=edge, action=action))

    def places():
        scene = simulator.scene()
        return [scene.points[scene.roster.index[agent]][1] for agent in ("ego", "ahead")]

    begins = places()
    for _ in range(8):
        actions = {
            agent: simulator.actions[agent].encode(answer)
            for agent, answer in zip(("ego", "ahead"), answers, strict=True)
        }
        observations, *_ = simulator.step(actions)
    moved = [y - begin for y, begin in zip(places(), begins, strict=True)]  # both drive towards x
    assert moved[0] > 0.1
    assert moved[1] < -0.1
    shown = simulator.restore_observation("ego", observations["ego"])
    columns = simulator.observation_layouts["ego"].columns
    offsets = shown["ego"][columns["ego"]["lane_offset"]], shown["actors"][0, columns["actors"]["lane_offset"]]
    assert offsets == pytest.approx(moved, abs=1e-6)


def test_long_vehicle_keeps_its_side_of_the_lane_in_a_bend(tmp_path):
    net = NET.parent / "left-grid.net.xml.gz"
    kinds = "".join(f'<vType id="{one}" length="18" latAlignment="{one}" sigma="0"/>' for one in ("left", "right"))
    vehicles = "".join(
        f'<vehicle id="{one}" type="{one}" depart="{20 * at}"><route edges="{ROUND}"/></vehicle>'
        for at, one in enumerate(("left", "right"))
    )
    (tmp_path / "r.rou.xml").write_text(f"<routes>{kinds}{vehicles}</routes>")
    options = ("--lateral-resolution", "0.4", "--step-length", "0.5", "--no-step-log", "--no-warnings")
    libsumo.start(["sumo", "-n", str(net), "-r", str(tmp_path / "r.rou.xml"), *options])
    bends, sides = Bends(lateral=True), {"left": [], "right": []}
    try:
        for _ in range(120):
            libsumo.simulationStep()
            for one in libsumo.vehicle.getIDList():
                front, heading = libsumo.vehicle.getPosition(one), math.radians(90 - libsumo.vehicle.getAngle(one))
                spine = bends.spine(one, 18.0, front, heading, high=False)
                if spine is not None:
                    sides[one].append(libsumo.vehicle.getLateralLanePosition(one))
                    assert math.dist(spine[0][:2], front) < 0.1
    finally:
        libsumo.close()
    assert all(sum(abs(one) > 0.3 for one in found) > 5 for found in sides.values())


@pytest.mark.parametrize("form", ["acceleration_steering", "speed_and_lateral"])
@pytest.mark.parametrize("visible", ["front", "outline"])
def test_vehicle_behind_reacts_to_the_part_of_ego_that_is_in_its_lane(begin, form, visible):
    behind = '<vehicle id="behind" type="car" route="st" depart="0" departPos="15" departLane="2" departSpeed="12"/>'
    kind = '<vType id="car" sigma="0" lcStrategic="-1" lcSpeedGain="0" lcKeepRight="0"/><route id="st" edges="st"/>'
    simulator = begin(NET, kind + behind, SCENARIO % ("", f"{form}:visible={visible}"))
    lanes = [libsumo.lane.getShape(f"st_{lane}")[0][1] for lane in (1, 2)]
    right = 1.0 if lanes[1] < lanes[0] else -1.0  # lane 2 is to the right of ego
    hits, encode = [], simulator.actions["ego"].encode
    for step in range(120):
        given = (8.0 if step < 15 else 0.0, -right if step < 15 else 0.0)
        if form == "acceleration_steering":
            motion, given = simulator._driving.moving["ego"], (0.0, 0.0)
            motion.state = replace(motion.state, x=100.0, y=lanes[0] - 1.5 * right, heading=0.0, speed=0.0)
        simulator.step({"ego": encode(given)})
        hits += Overlap().check(simulator.scene(), ("ego",))
    assert libsumo.vehicle.getLaneID("ego") == "st_1"
    assert bool(hits) == (visible == "front")
