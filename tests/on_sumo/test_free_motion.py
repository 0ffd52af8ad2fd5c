"""Tests of vehicles that move freely on SUMO: pose, road, arrival, contacts, events, and what SUMO makes of them."""

from __future__ import annotations

import gzip
import math
import shutil
from dataclasses import replace
from pathlib import Path

import libsumo
import numpy as np
import pytest
import sumolib
from conftest import mostly_nightly

from crashhunt.base.errors import ActionError
from crashhunt.oracles import Overlap
from crashhunt.scenario import AgentSetup, load_scenario
from crashhunt.simulators import BicycleModel, MotionState
from crashhunt.sumo._drivable_area import DrivableArea, _is_inside, _overlap
from crashhunt.sumo._free_motion import FreeMotion, _words_of
from crashhunt.world import Contact, describe_road_map

EMPTY = {"priority_demand": 1, "minor_demand": 1}


@pytest.fixture
def start(sumo_runs):
    """Return a function that begins an episode, and returns the simulator and a function that takes a step."""

    def begin(form, scenario="intersection", seed=3, **values):
        loaded = load_scenario(scenario)
        agents = {agent: replace(setup, action=form) for agent, setup in loaded.agents.items()}
        simulator, _ = sumo_runs.begin(replace(loaded, agents=agents), seed, values)

        def step(*actions):
            given = dict(zip(simulator.agents, actions, strict=True))
            *_, ended, _, _ = simulator.step(
                {agent: simulator.actions[agent].encode(one) for agent, one in given.items()}
            )
            return ended

        return simulator, step

    return begin


def centre(agent="ego"):
    heading = math.radians(90 - libsumo.vehicle.getAngle(agent))
    x, y = libsumo.vehicle.getPosition(agent)
    half = libsumo.vehicle.getLength(agent) / 2
    return x - half * math.cos(heading), y - half * math.sin(heading), heading


def test_sumo_places_the_vehicle_on_the_course_of_the_bicycle_model(start):
    simulator, step = start("acceleration_steering", **EMPTY)
    x, y, heading = centre()
    vehicle = libsumo.vehicle
    state = MotionState(x=x, y=y, heading=heading, speed=vehicle.getSpeed("ego"))
    model = BicycleModel(
        wheelbase=0.6 * vehicle.getLength("ego"), max_acceleration=vehicle.getAccel("ego"),
        max_deceleration=vehicle.getDecel("ego"), max_speed=vehicle.getMaxSpeed("ego"),
    )  # fmt: skip
    for number in range(40):
        action = (-2.0 if number < 20 else 1.0, 0.02 * math.sin(number))
        step(action)
        state = model.step(state, *action, 0.1)
        assert centre() == pytest.approx((state.x, state.y, state.heading), abs=1e-9)
        assert vehicle.getSpeed("ego") == pytest.approx(state.speed, abs=1e-9)
        assert simulator._driving.moving["ego"].steering() == state.steering


def test_speed_is_that_of_the_motion_where_a_vehicle_next_to_its_lane_enters_a_junction(start):
    simulator, step = start("target_pose", **EMPTY)
    _, y0, _ = centre()
    for number in range(210):
        x, _, _ = centre()
        step((x + 1.2, y0 + min(number / 50, 1.0) * (-1.58 - y0), 0.0, 0.1))
        scene = simulator.scene()
        assert scene.speed(scene.roster.index["ego"]) == pytest.approx(simulator._driving.moving["ego"].state.speed)
    assert centre()[0] > 0.0  # the middle of the junction


def test_pedals_are_shares_of_the_accelerations_of_the_type(start):
    _, step = start("throttle_brake_steering", **EMPTY)
    speed, limits = libsumo.vehicle.getSpeed("ego"), (libsumo.vehicle.getAccel("ego"), libsumo.vehicle.getDecel("ego"))
    step((0.5, 0.0, 0.0))
    step((0.0, 0.2, 0.0))
    assert libsumo.vehicle.getSpeed("ego") == pytest.approx(speed + 0.05 * limits[0] - 0.02 * limits[1])


def test_vehicle_arrives_at_the_end_of_its_route_and_leaves(start):
    simulator, step = start("acceleration_steering", **EMPTY)
    ended, steps = {"ego": False}, 0
    while not ended["ego"]:
        ended = step((1.0, 0.0))
        steps += 1
        assert steps < 600
    assert "ego" not in libsumo.vehicle.getIDList()
    assert simulator.scene().off_road == ()
    assert simulator.scene().points == [] or "ego" not in simulator.scene().roster.index


def test_vehicle_off_the_road_is_reported_and_stays_where_it_drives(start):
    simulator, step = start("acceleration_steering", **EMPTY)
    ended, steps = {"ego": False}, 0
    while not ended["ego"]:
        ended = step((0.0, 0.1))
        steps += 1
        assert steps < 30
    assert simulator.scene().off_road == ("ego",)
    x, y, _ = centre()
    assert not DrivableArea().contains(x, y, "passenger")


def test_wrong_way_is_reported_on_the_lane_below_the_vehicle(start):
    simulator, step = start("target_pose", **EMPTY)
    kinds = []
    for _ in range(200):
        x, *_ = centre()
        step((x + 18, 1.6, 0.0, 1.4))
        kinds += [event.kind for event in simulator.scene().events]
    assert kinds == ["wrong_way"]


def test_followers_brake_for_a_vehicle_that_moves_freely_and_contacts_are_found(start):
    simulator, step = start("acceleration_steering", "loop", vehicles=35)
    found = []
    for _ in range(200):
        if simulator.agents:
            step((-5.0, 0.0))
            found += Overlap().check(simulator.scene(), ("ego",))
    assert libsumo.vehicle.getSpeed("ego") == 0.0
    follower, gap = libsumo.vehicle.getFollower("ego", 100.0)
    assert gap >= 0
    assert libsumo.vehicle.getLeader(follower, 100.0)[0] == "ego"
    assert found == []


def box(x, y, length, width, turn):
    c, s = math.cos(turn), math.sin(turn)
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    return [(x + a * length / 2 * c - b * width / 2 * s, y + a * length / 2 * s + b * width / 2 * c) for a, b in signs]


def test_overlap_of_outlines_is_that_of_separating_lines():
    """Two convex polygons are apart if and only if a side of one of them has the other one wholly on its outer side."""

    def separates(one, two):
        sides = zip(one, [*one[1:], one[0]], strict=True)
        return any(all((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) <= 0 for x, y in two) for a, b in sides)

    rng, seen = np.random.default_rng(4), set()
    for values in rng.uniform((-4, -4, 1, 0.5, -3, 1, 0.2), (4, 4, 6, 3, 3, 6, 3), (400, 7)).tolist():
        one, two = box(0.0, 0.0, *values[5:], 0.3), box(*values[:5])
        apart = separates(one, two) or separates(two, one)
        assert _overlap(one, two) == _overlap(two, one) == (not apart)
        seen.add(apart)
    assert seen == {True, False}


@pytest.mark.parametrize(("kind", "harms"), [("building", True), ("obstacle.wall", True), ("park", False)])
def test_vehicle_that_drives_into_a_building_is_off_the_road_and_the_event_names_it(start, tmp_path, kind, harms):
    simulator, step = start("acceleration_steering", **EMPTY)
    x, y, heading = centre()
    ahead, left = (math.cos(heading), math.sin(heading)), (-math.sin(heading), math.cos(heading))
    half = libsumo.vehicle.getLength("ego") / 2
    width = libsumo.vehicle.getWidth("ego") / 2
    at = [30.0 * ahead[one] + (width + 1.9) * left[one] for one in (0, 1)]  # it reaches 0.1 m into the vehicle's path
    shape = box(x + at[0], y + at[1], 4.0, 4.0, heading)
    folder = tmp_path / "with-polygon"
    shutil.copytree(load_scenario("intersection").folder, folder)
    points = " ".join(f"{px},{py}" for px, py in shape)
    polygon = f'<additional><poly id="b1" type="{kind}" color="red" shape="{points}"/></additional>'
    (folder / "polygons.add.xml").write_text(polygon)
    toml = folder / "scenario.toml"
    toml.write_text(toml.read_text().replace("[sumo]\n", '[sumo]\nadditional = ["polygons.add.xml"]\n'))
    simulator.close()
    simulator, step = start("acceleration_steering", str(folder), **EMPTY)
    road_map = simulator.road_map("ego")
    assert {*road_map.obstacles} == {one.id for one in simulator.obstacles()} == ({"b1"} if harms else set())
    for name, outline in road_map.obstacles.items():
        assert outline[:4] == pytest.approx(np.array(shape), abs=0.01)
        assert not outline.flags.writeable
        assert describe_road_map(road_map, simulator.vehicle_data("ego"))["obstacles"] == {name: outline.tolist()}
    driven = 0.0
    for _ in range(60):
        ended = step((0.0, 0.0))
        driven += libsumo.vehicle.getSpeed("ego") * simulator.step_length_s
        if ended["ego"]:
            break
    if not harms:
        assert driven > 40.0
        return
    assert simulator.scene().off_road == ("ego",)
    assert 28.0 - half < driven < 28.0 - half + 1.5  # the front has passed the near side of the building
    (event,) = simulator.scene().events
    assert (event.kind, event.what) == ("off_road", f"ego drove into the {kind} 'b1'")


def test_two_vehicles_that_move_freely_collide_by_their_outlines(start):
    simulator, step = start("acceleration_steering", "loop-two-agents")
    one, other = simulator.agents
    for vehicle in {*libsumo.vehicle.getIDList()} - {one, other}:
        libsumo.vehicle.remove(vehicle)
    libsumo.vehicle.moveTo(other, "south_0", 112.0)  # on the lane of the first one, ahead of it
    simulator._driving.moving[other] = FreeMotion(other, "acceleration_steering", 0.1, DrivableArea())
    found = []
    for _ in range(120):
        step((2.0, 0.0), (-5.0, 0.0))
        found += Overlap().check(simulator.scene(), (one, other))
        if found:
            break
    assert {found[0].collision.collider, found[0].collision.victim} == {one, other}


def test_a_reported_collision_of_a_free_vehicle_counts_only_if_the_outlines_touch(start, monkeypatch):
    simulator, step = start("acceleration_steering", "loop")
    ahead = libsumo.vehicle.getLeader("ego", 1000.0)[0]
    reported = (Contact("ego", ahead, "junction", "south_0", 5.0, 15.0),)
    monkeypatch.setattr(simulator._sight._collisions, "read", lambda persons: reported)
    assert step((0.0, 0.0)) == {"ego": False}
    assert simulator.scene().contacts == ()
    x, y, _ = centre()
    libsumo.vehicle.moveToXY(ahead, "", -1, x + 3.0, y + 0.5, libsumo.vehicle.getAngle("ego"), 2)
    assert step((0.0, 0.0)) == {"ego": True}
    assert simulator.scene().contacts == reported


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (lambda x, y, h, v: [[0.1, x + 5, y, h, v]], r"the trajectory moves the vehicle by 5.000 m in a step of 0.1 s"),
        (lambda x, y, h, v: [[0.1, x, y, h, v]], r"moves the vehicle by 0.000 m"),
        (lambda x, y, h, v: [[0.1, x + v / 10, y, h + 0.5, v]], r"turns the vehicle by 0.50 rad"),
        (lambda x, y, h, v: [[0.05, x + v / 20, y, h, v]], r"the trajectory ends 0.05 s from now"),
        (lambda x, y, h, v: [[0.2, x, y, h, v], [0.1, x, y, h, v]], "time of point 1 of the trajectory is 0.1 s"),
        (lambda x, y, h, v: [[-0.1, x, y, h, v]], "time of point 0 of the trajectory is -0.1"),
        (lambda x, y, h, v: [[0.1, float("nan"), y, h, v]], "x of point 0 of the trajectory is nan"),
        (lambda x, y, h, v: [], "is not a trajectory"),
        (lambda x, y, h, v: np.zeros((2, 5), complex), "of the type complex128 is not a trajectory"),
        (lambda x, y, h, v: np.zeros((65, 5)), "of the shape .65, 5. is not a trajectory"),
    ],
)  # fmt: skip
def test_trajectory_that_cannot_be_followed_is_refused_with_value_and_limit(start, points, message):
    simulator, _ = start("trajectory", **EMPTY)
    with pytest.raises(ActionError, match=message) as caught:
        simulator.actions["ego"].encode(points(*centre(), libsumo.vehicle.getSpeed("ego")))
    assert caught.value.fix


@pytest.mark.parametrize("form", ["trajectory", "target_pose"])
def test_vehicle_that_stands_moves_backwards_by_no_more_than_the_tolerance_in_all(start, form):
    simulator, step = start(form, **EMPTY)

    def pose(ahead):
        x, y, h = centre()
        return (x + ahead, y, h, 0.1) if form == "target_pose" else [[0.1, x + ahead, y, h, 0.0]]

    while libsumo.vehicle.getSpeed("ego") > 0.3:
        step(pose(max(0.0, libsumo.vehicle.getSpeed("ego") - 1.0) / 10))
    step(pose(0.2))
    for ahead in (-0.15, 0.1, -0.14):
        step(pose(ahead))
    with pytest.raises(ActionError, match=r"moves the vehicle backwards by 0\.28 m") as caught:
        simulator.actions["ego"].encode(pose(-0.09))
    assert "0.2 m" in caught.value.fix
    step(pose(0.25))
    step(pose(-0.19))


def test_vehicle_that_has_overtaken_on_the_oncoming_lane_has_its_route_again(start):
    _, step = start("trajectory", **EMPTY)
    route, y0, seen = libsumo.vehicle.getRoute("ego"), centre()[1], []
    for number in range(110):
        x, y, h = centre()
        to = math.atan2(y0 + (6.5 if number < 50 else 0.0) - y, 8.0)
        h += max(-0.1, min(0.1, max(-0.4, min(0.4, to)) - h))
        speed = max(8.0, libsumo.vehicle.getSpeed("ego") - 1.0)
        step([[0.1, x + speed / 10 * math.cos(h), y + speed / 10 * math.sin(h), h, speed]])
        seen.append((libsumo.vehicle.getRoadID("ego"), libsumo.vehicle.getRoute("ego")))
    ((away, _),) = {one for one in seen if one[0] != route[0]}
    first = max(place for place, one in enumerate(seen) if one[0] == away) + 1
    assert away == "to-west"
    assert seen[first][1] == route[:1]  # SUMO replaces the route of a vehicle on another road
    assert {one[1] for one in seen[first + 1 :]} == {route}


def test_target_pose_that_is_due_too_early_is_refused_with_the_way_of_a_step(start):
    simulator, _ = start("target_pose", **EMPTY)
    (x, y, h), v = centre(), libsumo.vehicle.getSpeed("ego")
    with pytest.raises(ActionError, match=r"the target pose moves the vehicle by \d\.\d+ m in a step") as caught:
        simulator.actions["ego"].encode((x + 1.5 * v, y, h, 0.5))
    most = math.floor((v + 1.0) * 10 + 20) / 100
    assert caught.value.fix.startswith("return a later time, or a pose with a way of 0.")
    assert f" to {most:.2f} m in the step; positions are those of the centre" in caught.value.fix
    assert simulator.actions["ego"].encode((x + 1.5 * v, y, h, 1.5)) is not None


def test_trajectory_is_followed_between_its_points(start):
    simulator, step = start("trajectory", **EMPTY)
    x, y, h = centre()
    v = libsumo.vehicle.getSpeed("ego")
    plan = np.array([[t, x + v * t, y + 0.1 * t, h, v] for t in (0.0, 0.07, 0.5)])
    encoded = simulator.actions["ego"].encode(plan)
    assert np.array_equal(simulator.actions["ego"].encode(encoded), encoded)
    step(plan)
    assert centre()[:2] == pytest.approx((x + 0.1 * v, y + 0.01), abs=1e-9)
    assert centre()[2] == pytest.approx(h, abs=1e-9)


def test_target_pose_is_reached_at_its_time(start):
    _, step = start("target_pose", **EMPTY)
    x, y, _ = centre()
    v = libsumo.vehicle.getSpeed("ego")
    for number in range(20):
        step((x + 2 * v, y + 1.5, 0.0, 2.0 - 0.1 * number))
    assert centre() == pytest.approx((x + 2 * v, y + 1.5, 0.0), abs=1e-6)


def test_area_agrees_with_the_distance_to_every_lane_and_the_winding_around_the_junction(start):
    start("acceleration_steering", **EMPTY)
    area, lanes = DrivableArea(), [lane for lane in libsumo.lane.getIDList() if "12" not in lane and "13" not in lane]
    shapes = {lane: np.array(libsumo.lane.getShape(lane)) for lane in lanes}
    junction = np.array(libsumo.junction.getShape("center"))
    rng = np.random.default_rng(5)
    for point in [*rng.uniform((-60.0, -12.0), (-9.0, 12.0), (200, 2)), *rng.uniform(-12.0, 12.0, (200, 2))]:
        gaps = []
        for lane, shape in shapes.items():
            a, along = shape[:-1], np.diff(shape, axis=0)
            share = np.clip(((point - a) * along).sum(1) / (along**2).sum(1), 0, 1)[:, None]
            gaps.append(np.hypot(*(a + share * along - point).T).min() - libsumo.lane.getWidth(lane) / 2)
        angles = np.arctan2(*(junction - point).T[::-1])
        winding = abs(sum(math.remainder(turn, math.tau) for turn in np.diff(angles, append=angles[:1]))) > 1.0
        assert area.contains(*point, "passenger") == (min(gaps) <= 0 or winding), point
    assert not area.contains(500.0, 900.0, "passenger")


def test_polygon_contains_what_it_winds_around():
    rng = np.random.default_rng(2)
    corners = [(math.cos(turn) * far, math.sin(turn) * far) for turn, far in zip(
        np.linspace(0, 6, 9), rng.uniform(1, 4, 9), strict=True
    )]  # fmt: skip
    for point in rng.uniform(-4, 4, (200, 2)):
        angles = np.arctan2(*(np.array(corners) - point).T[::-1])
        winding = sum(math.remainder(turn, math.tau) for turn in np.diff(angles, append=angles[:1]))
        assert _is_inside(*point, corners) == (abs(winding) > 1.0)


@pytest.mark.parametrize(
    "form",
    [
        "acceleration_steering", "throttle_brake_steering", "trajectory", "target_pose", "trajectory:frame=ego",
        "target_pose:frame=ego", "trajectory:tracker=pure_pursuit", "trajectory:frame=ego:tracker=pure_pursuit",
    ],
)  # fmt: skip
def test_full_braking_stops_the_vehicle_in_its_lane_in_a_bend(start, form):
    simulator, step = start(form, "loop", vehicles=10)
    for vehicle in {*libsumo.vehicle.getIDList()} - {"ego"}:
        libsumo.vehicle.remove(vehicle)
    libsumo.vehicle.moveTo("ego", "east_0", 5.0)  # on the half circle
    settings = AgentSetup(action=form).action_settings
    motion = FreeMotion("ego", form.partition(":")[0], 0.1, DrivableArea(), settings)
    simulator._driving.moving["ego"] = motion
    simulator.actions["ego"].check = motion.check if motion.is_planned else None
    speed, steps = motion.state.speed, 0
    assert simulator.full_braking("ego").how.endswith("steering to the middle of its lane")
    while motion.state.speed > 0:
        step(simulator.full_braking("ego").choose())
        steps += 1
        assert simulator.agents == ["ego"]
        assert libsumo.vehicle.getLaneID("ego") == "east_0"
    assert abs(libsumo.vehicle.getLateralLanePosition("ego")) < 0.5
    assert steps == pytest.approx(speed / motion.model.max_deceleration / 0.1, abs=2)


@pytest.mark.parametrize(
    "form",
    ["acceleration_steering", "throttle_brake_steering", "trajectory", "trajectory:frame=ego:tracker=pure_pursuit"],
)
def test_reference_driver_corrects_steering_out_of_the_lane(start, form):
    simulator, step = start(form, "motorway")
    motion = simulator._driving.moving["ego"]
    plain = simulator.actions["ego"].encode(motion._action(0.0, 0.0))
    assert simulator.is_steered("ego")
    found = simulator.motion_of("ego", plain)
    assert (found.lane_change, found.speed_mps) == (0, pytest.approx(motion.state.speed))
    for _ in range(5):
        left = simulator.actions["ego"].encode(motion._action(0.0, 0.1))
        step(left)
    left = simulator.actions["ego"].encode(motion._action(0.0, 0.1))
    assert simulator.motion_of("ego", left).lane_change == 1
    kept = simulator.action_with("ego", left, speed_mps=motion.state.speed - 0.2, keeps_lane=True)
    assert motion._next(kept.tolist()).steering < motion.state.steering
    assert simulator.motion_of("ego", kept).speed_mps == pytest.approx(motion.state.speed - 0.2, abs=1e-6)


@pytest.mark.parametrize("form", ["trajectory", "target_pose"])
def test_vehicle_of_an_overruled_agent_pursues_poses_elsewhere(start, form):
    simulator, step = start(form, "motorway")
    encode, motion = simulator.actions["ego"].encode, simulator._driving.moving["ego"]
    begin = motion.state
    cos, sin = math.cos(begin.heading), math.sin(begin.heading)

    def plan(steps):
        """3 m ahead of where the vehicle would be, and 0.5 m to the left."""
        along = 3.0 + begin.speed * 0.1 * steps
        x, y = begin.x + along * cos - 0.5 * sin, begin.y + along * sin + 0.5 * cos
        return [(0.1, x, y, begin.heading, begin.speed)] if form == "trajectory" else (x, y, begin.heading, 0.1)

    with pytest.raises(ActionError, match="moves the vehicle by"):
        encode(plan(1))
    simulator.action_with("ego", None, speed_mps=begin.speed, keeps_lane=True)
    for steps in range(1, 60):
        step(encode(plan(steps)))
    dx, dy = motion.state.x - begin.x, motion.state.y - begin.y
    assert dy * cos - dx * sin == pytest.approx(0.5, abs=0.05)
    assert motion.state.speed == pytest.approx(begin.speed, abs=0.5)
    hard = motion.model.max_deceleration
    braked = motion.model.step(motion.state, -hard, 0.0, 0.1).speed
    assert motion._next(encode(motion._action(-hard, 0.0)).tolist()).speed == pytest.approx(braked)
    if form == "target_pose":  # a pose without a speed: the vehicle gets there as fast as it can, and never turns back
        assert dx * cos + dy * sin == pytest.approx(3.0 + begin.speed * 5.9, abs=0.5)
        for _ in range(80):
            step(encode((begin.x, begin.y, begin.heading, 0.1)))
        assert motion.state.speed == 0.0
        assert motion.state.heading == pytest.approx(begin.heading, abs=0.02)


@pytest.mark.parametrize("side", [1, -1])
def test_steering_leaves_the_lane_only_away_from_its_middle(start, side):
    simulator, _ = start("acceleration_steering", "motorway")
    motion, straight = simulator._driving.moving["ego"], simulator.actions["ego"].encode((0.0, 0.0))
    state = replace(motion.state, speed=20.0)

    def change(aside_m, turn):
        x, y = (state.x - aside_m * math.sin(state.heading), state.y + aside_m * math.cos(state.heading))
        motion.state = replace(state, x=x, y=y, heading=state.heading + turn)
        return simulator.motion_of("ego", straight).lane_change

    assert change(side * 1.5, side * 0.05) == side
    assert change(side * 0.9, side * 0.04) == side  # 0.4 m further within the next 0.5 s
    assert change(side * 0.2, side * 0.01) == 0
    assert change(side * 1.5, side * -0.05) == 0  # it returns
    assert change(side * 1.5, side * -0.4) == -side  # it returns, and beyond


def test_standing_vehicle_keeps_its_heading(start):
    simulator, step = start("trajectory", **EMPTY)
    motion = simulator._driving.moving["ego"]
    while motion.state.speed > 0:
        step(motion.brake())
    x, y, heading = centre()
    step([[0.0, x, y, heading, 0.01], [0.1, x - 6e-5, y, heading + 3.14, 0.01]])  # as FISS+ plans at a standstill
    assert centre()[2] == heading
    with pytest.raises(ActionError, match=r"turns the vehicle by 3\.14 rad"):
        simulator.actions["ego"].encode([[0.1, x + 0.02, y, heading + 3.14, 0.2]])


def relative(points):
    """Return points of a trajectory in the frame of the vehicle, by complex numbers."""
    x, y, heading = centre()
    moved = [((px + 1j * py) - (x + 1j * y)) * np.exp(-1j * heading) for _, px, py, *_ in points]
    return [[t, z.real, z.imag, h - heading, v] for (t, _, _, h, v), z in zip(points, moved, strict=True)]


@pytest.mark.parametrize("tracker", ["interpolation", "pure_pursuit"])
def test_trajectory_in_the_frame_of_the_vehicle_is_the_same_motion(start, tracker):
    courses = []
    for frame, change in (("map", list), ("ego", relative)):
        _, step = start(f"trajectory:frame={frame}:tracker={tracker}", **EMPTY)
        x, y, heading = centre()
        speed, course = libsumo.vehicle.getSpeed("ego"), []
        for number in range(30):
            times = np.arange(0.0, 3.0, 0.1)
            s = (number * 0.1 + times) * speed
            path = [[t, x + d, y + 0.02 * d, heading + 0.02, speed] for t, d in zip(times, s, strict=True)]
            step(change(path))
            course.append(centre())
        courses.append(course)
    assert np.allclose(*courses, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("frame", "point", "share"),
    mostly_nightly(
        [(frame, *one) for frame in ("map", "ego") for one in (("rear_axle", -0.3), ("front_bumper", 0.5))],
        always=[("map", "rear_axle", -0.3), ("ego", "front_bumper", 0.5)],
    ),
)
@pytest.mark.parametrize("form", ["trajectory", "trajectory:tracker=pure_pursuit", "target_pose"])
def test_plan_for_another_reference_point_is_the_same_motion(start, form, frame, point, share):
    """The plan in the map is moved along its headings; in the vehicle's frame, its own point is the origin."""
    courses = []
    for name in (form, f"{form}:frame={frame}:reference_point={point}"):
        simulator, step = start(name, **EMPTY)
        x, y, _ = centre()
        speed, ahead, course = libsumo.vehicle.getSpeed("ego"), 0.0, []
        if "reference" in name:
            ahead = share * libsumo.vehicle.getLength("ego")
        for number in range(15):
            times = np.arange(0.1, 2.05, 0.1) if form != "target_pose" else [2.0 - 0.1 * number]
            rows = []
            for t in times:
                s = (t + 0.1 * number) * speed if form != "target_pose" else 2.0 * speed
                turn = 0.01 * s / speed
                rows.append([t, x + s + ahead * math.cos(turn), y + 0.2 * turn + ahead * math.sin(turn), turn, speed])
            if ahead and frame == "ego":
                rows = [[t, a - ahead, *rest] for t, a, *rest in relative(rows)]
            step(rows if form != "target_pose" else (*rows[0][1:4], rows[0][0]))
            course.append(centre())
            if ahead:
                motion = simulator._driving.moving["ego"]
                row = [0.1, motion.state.x + 1.0, motion.state.y, motion.state.heading + 0.02, speed]
                assert np.allclose(motion._in_map([motion._as_returned(row)]), [row], rtol=0, atol=1e-9)
        courses.append(course)
    assert np.allclose(*courses, rtol=0, atol=1e-6)


def test_pose_in_the_frame_of_the_vehicle_is_the_same_motion(start):
    courses = []
    for frame, change in (("map", list), ("ego", relative)):
        _, step = start(f"target_pose:frame={frame}", **EMPTY)
        x, y, _ = centre()
        v, course = libsumo.vehicle.getSpeed("ego"), []
        for number in range(20):
            ((_, *pose, _),) = change([[0.0, x + 2 * v, y + 1.5, 0.0, v]])
            step((*pose, 2.0 - 0.1 * number))
            course.append(centre())
        courses.append(course)
    assert np.allclose(*courses, rtol=0, atol=1e-6)


def test_pure_pursuit_returns_to_a_line_within_the_limits_of_the_vehicle(start):
    simulator, step = start("trajectory:tracker=pure_pursuit", **EMPTY)
    x, y, _ = centre()
    line = [[t, x + 14 * t, y + 1.2, 0.0, 13.0] for t in np.arange(0.0, 5.0, 0.1)]  # it jumps to the left
    offsets, turns, before = [], [], 0.0
    for number in range(60):
        step([[t, px + 1.3 * number, *rest] for t, px, *rest in line])
        offsets.append(centre()[1] - y - 1.2)
        turns.append(simulator._driving.moving["ego"].steering() - before)
        before += turns[-1]
    assert max(map(abs, turns)) <= 0.1 + 1e-9  # 1 rad/s
    assert max(offsets) < 0.2
    assert abs(offsets[-1]) < 0.02


def test_pursuit_reaches_the_speed_of_a_later_first_point_at_its_time(start):
    simulator, step = start("trajectory:frame=ego:tracker=pure_pursuit", **EMPTY)
    motion = simulator._driving.moving["ego"]
    speed = motion.state.speed
    step([[0.5, 0.5 * speed, 0.0, 0.0, speed - 1.0], [1.0, speed, 0.0, 0.0, speed - 2.0]])
    assert motion.state.speed == pytest.approx(speed - 0.2)


def test_pursued_trajectory_that_is_elsewhere_is_refused(start):
    simulator, _ = start("trajectory:frame=ego:tracker=pure_pursuit", **EMPTY)
    simulator.actions["ego"].encode([[0.1, 4.0, 2.9, 0.0, 5.0]])
    with pytest.raises(ActionError, match=r"the trajectory is 8\.0 m away from the vehicle") as caught:
        simulator.actions["ego"].encode([[0.1, 8.0, 0.0, 0.0, 5.0]])
    speed = simulator._driving.moving["ego"].state.speed
    assert caught.value.fix == f"return a point within {5 + 0.1 * speed:.1f} m"
    simulator.actions["ego"].encode([[0.5, 10.0, 0.0, 0.0, 20.0], [1.0, 20.0, 0.0, 0.0, 20.0]])  # of a coarse planner
    simulator.actions["ego"].encode([[2.0, speed, 0.0, 0.0, 0.0]])  # which stops in 2 s


def drive_to(motion, *pose):
    """Place the vehicle of a motion at a pose of its centre."""
    x, y, heading, speed = pose
    motion.state = MotionState(x=x, y=y, heading=heading, speed=speed)


def test_vehicle_far_from_all_lanes_stays_where_it_is_and_is_not_teleported(start):
    simulator, step = start("acceleration_steering", **EMPTY)
    motion = simulator._driving.moving["ego"]
    drive_to(motion, -60.0, 70.0, 1.0, 10.0)
    assert step((0.0, 0.0)) == {"ego": True}
    assert centre()[:2] == pytest.approx((-60.0 + math.cos(1.0), 70.0 + math.sin(1.0)), abs=1e-6)
    assert not libsumo.simulation.getStartingTeleportIDList()
    drive_to(motion, 5000.0, 5000.0, 1.0, 10.0)  # SUMO finds no lane there, and keeps the last place
    assert not motion.apply(np.array((0.0, 0.0)))
    libsumo.simulationStep()
    assert "ego" in libsumo.vehicle.getIDList()
    assert not libsumo.simulation.getStartingTeleportIDList()


def test_vehicle_across_two_lanes_is_seen_in_the_lane_below_its_front_and_hit_in_the_other(start):
    simulator, step = start("acceleration_steering", "motorway", demand=2000)
    cars = [car for car in libsumo.vehicle.getIDList() if car != "ego"]
    for car in cars[2:]:
        libsumo.vehicle.remove(car)
    road, y = libsumo.vehicle.getRoadID("ego"), libsumo.lane.getShape(f"{libsumo.vehicle.getRoadID('ego')}_0")[0][1]
    for lane, car in enumerate(cars[:2]):
        libsumo.vehicle.setLaneChangeMode(car, 0)
        libsumo.vehicle.moveTo(car, f"{road}_{lane}", 300.0)
        libsumo.vehicle.setSpeed(car, -1)
    motion = simulator._driving.moving["ego"]
    drive_to(
        motion, libsumo.simulation.convert2D(road, 400.0, 0)[0], y + 2.0, 0.6, 0.0
    )  # on the line between the lanes, its front to the left
    found = []
    for _ in range(100):
        step((0.0, 0.0))
        found += Overlap().check(simulator.scene(), ("ego",))
        if found:
            break
    assert libsumo.vehicle.getLaneID("ego") == f"{road}_1"
    assert libsumo.vehicle.getLeader(cars[1], 200.0)[0] == "ego"
    assert (libsumo.vehicle.getLeader(cars[0], 200.0) or ("",))[0] != "ego"
    assert {found[0].collision.collider, found[0].collision.victim} == {"ego", cars[0]}


def test_road_that_the_route_does_not_contain_is_reported_once(start):
    simulator, step = start("acceleration_steering", **EMPTY)
    motion, lane = simulator._driving.moving["ego"], libsumo.lane.getShape("to-south_0")
    (x, y), (to_x, to_y) = lane[0][:2], lane[-1][:2]
    drive_to(motion, x, y, math.atan2(to_y - y, to_x - x), 8.0)
    kinds = []
    for _ in range(30):
        step((0.0, 0.0))
        kinds += [(event.kind, event.what) for event in simulator.scene().events]
    assert kinds == [("off_route", "ego left its route: it drives on lane to-south_0")]
    assert simulator.agents == ["ego"]


def test_vehicle_does_not_drive_backwards(start):
    simulator, _ = start("target_pose", **EMPTY)
    motion = simulator._driving.moving["ego"]
    x, y, heading = centre()
    drive_to(motion, x, y, heading, 2.0)
    with pytest.raises(ActionError, match="the target pose moves the vehicle backwards"):
        simulator.actions["ego"].encode((x - 0.21, y, heading, 0.1))


def drivable(net):
    """Return a function that says by sumolib's geometry whether a point is on a lane for cars or in a junction."""
    edges = [edge for edge in net.getEdges(withInternal=True) if edge.allows("passenger")]
    lanes = [(lane.getShape(), lane.getWidth() / 2) for edge in edges for lane in edge.getLanes()]
    junctions = [node.getShape() for node in net.getNodes() if len(node.getShape()) > 2]
    away = sumolib.geomhelper.distancePointToPolygon
    return lambda place: (
        any(away(place, shape) <= half for shape, half in lanes)
        or any(sumolib.geomhelper.isWithin(place, shape) for shape in junctions)
    )


def test_kerb_is_driven_over_where_a_side_leaves_the_road_while_the_centre_stays_on_it(start):
    simulator, step = start("target_pose", **EMPTY)
    is_drivable = drivable(sumolib.net.readNet(libsumo.simulation.getOption("net-file"), withInternal=True))
    _, y0, _ = centre()
    said, over, before = [], [], False
    for number in range(45):
        x, _, _ = centre()
        step((x + 1.2, y0 - 0.9 * math.sin(number / 8) ** 2, 0.2 * math.sin(number / 5), 0.1))
        x, y, heading = centre()
        c, s = math.cos(heading), math.sin(heading)
        half, half_width = 2.5 - 0.1, 0.9 - 0.1
        dense = [(half * share, side * half_width) for share in np.linspace(-1, 1, 9) for side in (1, -1)]
        now = not all(is_drivable((x + a * c - b * s, y + a * s + b * c)) for a, b in dense)
        over += [number] if now and not before else []
        before = now
        said += [(number, event.what) for event in simulator.scene().events if event.kind == "kerb"]
    assert [number for number, _ in said] == over
    assert len(over) >= 2
    assert all("drove over the kerb with its" in what and "right" in what for _, what in said)
    assert simulator.agents == ["ego"]


def test_kerb_event_names_every_corner_that_is_over_the_kerb():
    front, rear = (1.0, -1.0), (-1.0, -1.0)
    assert _words_of([front]) == "its front right corner"
    assert _words_of([front, rear, (0.0, -1.0)]) == "its front right and rear right corners"
    assert _words_of([(1.0, 1.0), (0.5, 1.0), (0.0, -1.0)]) == "its front left corner and its right side"
    assert _words_of([(0.5, -1.0), (0.0, -1.0)]) == "its right side"


def test_vehicle_next_to_its_lane_is_over_the_kerb_with_two_corners(start):
    simulator, step = start("target_pose", **EMPTY)
    _, y0, _ = centre()
    said = []
    for number in range(30):
        x, _, _ = centre()
        step((x + 1.2, y0 - 0.05 * number, 0.0, 0.1))  # it slides to the right, parallel to the kerb
        said += [event.what for event in simulator.scene().events if event.kind == "kerb"]
    assert said == ["ego drove over the kerb with its front right and rear right corners"]


TOWN = """schema = 1
simulator = "sumo"
step_length_s = 0.1
[sumo]
net = "town.net.xml"
routes = ["r.rou.xml"]
[agents.ego]
route = "ego"
depart_speed = "8"
"""


def test_lane_of_the_other_direction_is_entered_without_running_the_red_light_of_the_turnaround(start, tmp_path):
    town = tmp_path / "town"
    town.mkdir()
    network = (Path(__file__).parent / "nets" / "grid-walks.net.xml.gz").read_bytes()
    (town / "town.net.xml").write_bytes(gzip.decompress(network))
    (town / "r.rou.xml").write_text('<routes><route id="ego" edges="A1B1 B1C1"/></routes>')
    (town / "scenario.toml").write_text(TOWN)
    simulator, step = start("target_pose", str(town))
    assert {"B1A1_2"} <= {link[0] for link in libsumo.lane.getLinks("A1B1_2")}
    lights = libsumo.trafficlight.getRedYellowGreenState("B1")
    libsumo.trafficlight.setRedYellowGreenState("B1", "r" * len(lights))
    kinds = []
    for lane in ("A1B1_2", "B1A1_2", "A1B1_2", "A1B1_2"):
        y = libsumo.lane.getShape(lane)[0][1]
        for _ in range(40 if len(kinds) else 20):
            x, *_ = centre()
            step((x + 16.0, y, 0.0, 2.0))
            kinds += [(event.kind, libsumo.vehicle.getLaneID("ego")) for event in simulator.scene().events]
    assert [kind for kind, _ in kinds] == ["wrong_way", "red_light"]
    assert kinds[1][1].startswith(":B1_")
