"""Car following: the leader on straight and bent roads, the braking, and what the agent remembers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, strategies as st
from seen import CAR_M, seen

from crashhunt.agents import CarFollowing
from crashhunt.agents._car_following import (
    Leader,
    PathCurvature,
    check_layout,
    find_leader,
    idm_acceleration,
    off_path,
)
from crashhunt.base.errors import UsageError
from crashhunt.simulators import MetaAction

SPEEDS = st.floats(0.0, 24.0)


def test_the_vehicle_ahead_is_the_nearest_one_on_the_path_that_does_not_come_towards_it():
    on_path, nearer = {"x": 40, "vx": -3}, {"x": 30, "y": 1.6, "vx": -1}
    assert find_leader(seen(20, on_path, nearer)) == find_leader(seen(20, nearer, on_path)) == Leader(30 - CAR_M, 1)
    beside, behind, oncoming = {"x": 20, "y": 1.8}, {"x": -8}, {"x": 15, "vx": -40, "heading": math.pi}
    assert find_leader(seen(20, beside, behind, oncoming, on_path)) == Leader(40 - CAR_M, 3)
    crossing = {"x": 15, "heading": math.pi / 2}
    assert find_leader(seen(20, crossing, on_path)) == Leader(15 - CAR_M, 0)
    assert find_leader(seen(20, beside, behind, oncoming)) is None
    assert find_leader(seen(20, beside), lateral=3.2) == Leader(20 - CAR_M, 0)
    assert find_leader(seen(20, on_path), lateral=3.2) is None


@given(radius=st.floats(60, 400), arc=st.floats(0.05, 0.3), side=st.sampled_from([1, -1]))
def test_a_vehicle_on_the_same_bend_is_on_the_path_and_one_in_the_next_lane_is_not(radius, arc, side):
    at = {"x": radius * math.sin(arc), "y": side * radius * (1 - math.cos(arc)), "heading": side * arc}
    curvature = side / radius
    ahead = seen(20, at)[1].tolist()
    # The path is a parabola, which leaves the circle of the bend by at most 3 % of how far that bends.
    tolerance = abs(at["y"]) * 0.03
    assert off_path(ahead, lateral=0.0, curvature=curvature) <= tolerance
    for lane in (-3.2, 3.2):
        off = off_path(ahead, lateral=lane, curvature=curvature)
        assert off == pytest.approx(3.2, abs=tolerance + 0.01)


@given(arc=st.floats(0.05, 0.3), side=st.sampled_from([1, -1]), share=st.floats(0.01, 0.99))
def test_a_bend_may_begin_anywhere_between_both_vehicles(arc, side, share):
    """On a straight road still, so that only the heading of the vehicle ahead shows the bend."""
    farthest = math.tan(arc / 2) * 100
    ahead = seen(20, {"x": 100, "y": side * share * farthest * 0.99, "heading": side * arc})[1].tolist()
    assert off_path(ahead, lateral=0.0, curvature=0.0) == 0.0
    turned_away = seen(20, {"x": 100, "y": side * 3.0, "heading": -side * arc})[1].tolist()
    assert off_path(turned_away, lateral=0.0, curvature=0.0) == pytest.approx(3.0)
    crossing = seen(20, {"x": 100, "y": side * 3.0, "heading": side * 1.2})[1].tolist()  # more than 60 degrees
    assert off_path(crossing, lateral=0.0, curvature=0.0) == pytest.approx(3.0)


@given(radius=st.floats(30, 500), side=st.sampled_from([1, -1]), step_s=st.sampled_from([0.1, 0.5]))
def test_the_curvature_of_a_circle_is_found_within_two_seconds_and_all_around(radius, side, step_s):
    path, speed = PathCurvature(step_s), 15.0
    found = [path.update(seen(speed, heading=3.0 + side * number * speed * step_s / radius)) for number in range(60)]
    assert found[0] == 0.0
    assert found[-1] == pytest.approx(side / radius, rel=0.01)
    assert all(abs(value) <= 1.01 / radius for value in found)
    path.reset()
    assert path.update(seen(speed, heading=1.0)) == 0.0


def test_turns_at_a_walking_pace_do_not_count_as_a_bend():
    path = PathCurvature(0.1)
    assert [path.update(seen(0.5, heading=turn)) for turn in (0.0, 0.1, 0.2)] == [0.0, 0.0, 0.0]


@given(speed=SPEEDS, headway_s=st.floats(0.5, 2.5))
def test_at_the_gap_of_equilibrium_it_keeps_its_speed(speed, headway_s):
    """Equation 20 of Treiber, Hennecke, Helbing (2000)."""
    gap = (4.0 + speed * headway_s) / math.sqrt(1 - (speed / 25) ** 4)
    given_ = {"desired_speed": 25.0, "headway_s": headway_s}
    assert idm_acceleration(speed, Leader(gap, 0.0), **given_) == pytest.approx(0.0, abs=1e-9)
    assert idm_acceleration(speed, Leader(gap * 0.9, 0.0), **given_) < 0
    assert idm_acceleration(speed, Leader(gap, -1.0), **given_) >= 0


@given(speed=SPEEDS)
def test_on_a_free_road_it_goes_from_its_comfortable_acceleration_to_its_desired_speed(speed):
    free = idm_acceleration(speed, None, desired_speed=25.0, headway_s=1.5, comfort=1.7)
    assert free == pytest.approx(1.7 * (1 - (speed / 25) ** 4))
    assert idm_acceleration(speed, Leader(1e9, 0.0), desired_speed=25.0, headway_s=1.5, comfort=1.7) == pytest.approx(
        free
    )


def test_it_brakes_by_the_model_when_it_comes_closer():
    # s* = 4 + 20 * 1.5 + 20 * 5 / (2 * 2) = 59; 2 * (1 - (20 / 25)^4 - (59 / 40)^2)
    assert idm_acceleration(20.0, Leader(40.0, 5.0), desired_speed=25.0, headway_s=1.5) == pytest.approx(-3.17045)
    assert idm_acceleration(20.0, Leader(-3.0, 5.0), desired_speed=25.0, headway_s=1.5) < -1000


def test_it_acts_on_an_observation_as_old_as_its_delay_and_knows_its_own_speed():
    agent = CarFollowing(delay_s=0.3, max_brake=5.0, step_length_s=0.1)
    agent.reset(0)
    free, blocked = seen(20.0), seen(20.0, {"x": 9, "vx": -20})
    quicker = agent.act(free)
    assert quicker == (pytest.approx(20.0 + 0.1 * 2 * (1 - (20 / 25) ** 4)), 0)
    assert [agent.act(blocked) for _ in range(3)] == [quicker] * 3  # of before the vehicle appeared
    assert agent.act(seen(18.0, {"x": 9, "vx": -18})) == (pytest.approx(18.0 - 5.0 * 0.1), 0)  # as hard as it can
    agent.reset(0)
    assert agent.act(free) == quicker
    assert agent.act(blocked) == quicker


@pytest.mark.parametrize(("delay_s", "step_s", "steps"), [(0.0, 0.1, 0), (1.2, 0.1, 12), (1.0, 0.5, 2)])
def test_a_delay_is_counted_in_steps_of_the_simulation(delay_s, step_s, steps):
    agent = CarFollowing(delay_s=delay_s, step_length_s=step_s)
    agent.reset(0)
    if steps:
        agent.act(seen(20.0))
    speeds = [agent.act(seen(20.0, {"x": 9, "vx": -20}))[0] for _ in range(steps + 1)]
    assert [speed < 20.0 for speed in speeds] == [False] * steps + [True]


def test_it_follows_the_bend_that_it_drives_through():
    """The vehicle ahead is beside the straight line, but on the bend."""
    arc, radius = 0.25, 100.0
    ahead = {"x": radius * math.sin(arc), "y": radius * (1 - math.cos(arc)), "vx": -15, "heading": 0.0}
    agent = CarFollowing(delay_s=0.0)
    speeds = [agent.act(seen(15.0, ahead, heading=number * 1.5 / radius))[0] for number in range(20)]
    assert speeds[0] > 15.0 > speeds[-1]


def test_meta_actions_are_faster_slower_and_idle():
    space = MetaAction().space
    names = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
    agent = CarFollowing(delay_s=0.0, action_space=space)
    said = [names[agent.act(shown)] for shown in (seen(10.0), seen(24.9), seen(20.0, {"x": 12, "vx": -10}))]
    assert said == ["FASTER", "IDLE", "SLOWER"]


@pytest.mark.parametrize(
    ("given_", "says"),
    [({"delay_s": -0.1}, "delay_s"), ({"delay_s": math.nan}, "delay_s"), ({"step_length_s": 0.0}, "step")],
)
def test_an_argument_out_of_range_is_refused(given_, says):
    with pytest.raises(ValueError, match=says):
        CarFollowing(**given_)


def test_an_observation_of_other_columns_is_refused():
    for space in (None, spaces.Box(-1, 1, (8, 7), np.float32)):
        check_layout(space)
    for space in (spaces.Box(-1, 1, (8, 6), np.float32), spaces.Discrete(3)):
        with pytest.raises(UsageError, match=r"default features.*; give the observation these features"):
            check_layout(space)


def test_parts_of_observations_are_refused_with_their_names():
    space = spaces.Dict({"ego": spaces.Box(0.0, 1.0, (13,)), "actors": spaces.Box(0.0, 1.0, (2, 15))})
    with pytest.raises(
        UsageError, match="receive the parts actors, ego; name no parts for it, or --observe kinematics"
    ):
        check_layout(space)
