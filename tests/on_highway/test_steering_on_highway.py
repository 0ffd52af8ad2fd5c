"""Accelerations and steering angles of highway-env as speeds and lane changes, against its own vehicles."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("highway_env")
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.controller import ControlledVehicle

from crashhunt.highway._disturbances import place_of
from crashhunt.highway._steering import action_with, lane_change_of, motion_of

KIND = SimpleNamespace(clip=True, acceleration_range=(-5.0, 4.0), steering_range=(-math.pi / 4, math.pi / 4))
STEP_S = 0.1


def vehicle_at(aside=0.0, heading=0.0, speed=20.0, lane=1):
    road = Road(RoadNetwork.straight_road_network(lanes=3, length=1000), record_history=False)
    made = ControlledVehicle(road, [100.0, 4.0 * lane + aside], heading, speed)
    made.lane_index = made.target_lane_index = ("0", "1", lane)
    made.lane = road.network.get_lane(made.lane_index)
    return made


@pytest.mark.parametrize("aside", [-1.5, -0.2, 0.0, 0.7])
@pytest.mark.parametrize("heading", [-0.3, 0.0, 0.05])
@pytest.mark.parametrize("speed", [0.0, 0.5, 20.0])
def test_lane_is_kept_with_the_steering_of_highway_envs_own_vehicles(aside, heading, speed):
    vehicle = vehicle_at(aside, heading, speed)
    own = vehicle.steering_control(vehicle.lane_index)
    found = action_with(KIND, vehicle, np.array([0.25, 0.0]), STEP_S, speed_mps=None, keeps_lane=True)
    assert found[0] == 0.25
    if speed >= 0.5:  # below 0.1 m/s, both hardly turn, with other bounds
        assert found[1] * KIND.steering_range[1] == pytest.approx(np.clip(own, *KIND.steering_range), abs=1e-9)
    assert abs(found[1]) <= 1.0
    untouched = action_with(KIND, vehicle, np.array([0.25, 0.5]), STEP_S, speed_mps=None, keeps_lane=False)
    assert untouched.tolist() == [0.25, 0.5]


def test_steering_of_a_long_step_has_time_constants_that_are_no_shorter():
    angles = [
        action_with(KIND, vehicle_at(0.5), np.zeros(2), step_s, speed_mps=None, keeps_lane=True)[1]
        for step_s in (0.1, 0.2, 0.4)
    ]
    assert angles[0] == angles[1] < angles[2] < 0


@pytest.mark.parametrize("speed", [20.3, 19.6, 20.0])
def test_action_with_another_speed_reaches_it_in_the_step(speed):
    vehicle = vehicle_at()
    action = action_with(KIND, vehicle, np.array([0.9, 0.1]), STEP_S, speed_mps=speed, keeps_lane=False)
    assert action[1] == 0.1
    assert motion_of(KIND, vehicle, action, STEP_S).speed_mps == pytest.approx(speed)
    for beyond, throttle in ((30.0, 1.0), (0.0, -1.0)):
        assert action_with(KIND, vehicle, action, STEP_S, speed_mps=beyond, keeps_lane=False)[0] == throttle


@pytest.mark.parametrize(("throttle", "wheel"), [(1.0, 0.0), (-1.0, 0.2), (0.3, -0.4), (9.0, 9.0)])
def test_motion_is_that_of_highway_envs_own_step(throttle, wheel):
    vehicle = vehicle_at(0.3)
    found = motion_of(KIND, vehicle, np.array([throttle, wheel]), STEP_S)
    accelerated = 20.0 + STEP_S * (np.interp(throttle, [-1, 1], KIND.acceleration_range))
    assert found.speed_mps == pytest.approx(accelerated)
    slow = vehicle_at(speed=0.1)
    assert motion_of(KIND, slow, np.array([-1.0, 0.0]), STEP_S).speed_mps == 0.0
    loose = SimpleNamespace(**{**vars(KIND), "clip": False})
    assert motion_of(loose, vehicle, np.array([2.0, 0.0]), STEP_S).speed_mps == pytest.approx(20.0 + 0.1 * 8.5)


@pytest.mark.parametrize(
    ("aside", "heading", "wheel", "change"),
    [
        (0.0, 0.0, 0.0, 0),
        (0.0, 0.2, 0.0, -1),  # y points down, so a heading above 0 leads to the right
        (0.0, -0.2, 0.0, 1),
        (0.0, 0.0, 0.5, -1),
        (0.0, 0.0, -0.5, 1),
        (0.9, -0.1, 0.0, 0),  # back to the middle of its lane
        (0.9, 0.02, 0.0, -1),
        (1.5, 0.0, 0.0, 0),  # over the side, but not on the way
        (0.0, 0.01, 0.0, 0),
    ],
)
def test_lane_change_begins_where_the_vehicle_is_in_the_way_of_the_next_lane(aside, heading, wheel, change):
    found = motion_of(KIND, vehicle_at(aside, heading), np.array([0.0, wheel]), STEP_S)
    assert found.lane_change == change


@pytest.mark.parametrize(("aside", "change"), [(1.0, 0), (-1.0, 0), (1.01, -1), (-1.01, 1), (0.0, 0)])
def test_vehicle_is_in_the_way_when_it_is_1_m_over_the_side(aside, change):
    assert lane_change_of(vehicle_at(), aside) == change


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, 2.5])
@pytest.mark.parametrize(
    ("ahead", "right", "place"),
    [
        (10.0, 0.0, "ahead"), (-10.0, 1.5, "behind"), (10.0, 1.7, "right ahead"), (10.0, -1.7, "left ahead"),
        (-10.0, 3.0, "right behind"), (0.0, 3.0, "right"), (2.4, -3.0, "left"), (2.6, -3.0, "left ahead"),
        (-2.6, -3.0, "left behind"),
    ],
)  # fmt: skip
def test_place_is_seen_from_the_agent(heading, ahead, right, place):
    c, s = math.cos(heading), math.sin(heading)
    agent = SimpleNamespace(position=np.array([5.0, 7.0]), heading=heading, LENGTH=5.0)
    other = SimpleNamespace(position=np.array([5.0 + ahead * c - right * s, 7.0 + ahead * s + right * c]))
    assert place_of(agent, other) == place
