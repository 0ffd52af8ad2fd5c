"""Lane changers: when they change, to which side, into which gaps, and which lanes they know of."""

from __future__ import annotations

import numpy as np
import pytest
from seen import CAR_M, seen

from crashhunt.agents import IntelligentDriver, LaneChanger
from crashhunt.agents._car_following import Leader, idm_acceleration
from crashhunt.simulators import MetaAction

LANE = 3.2
SLOW = {"x": 25, "vx": -5}  # ahead, in the own lane
NAMES = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")


def changes(agent, *shown, steps=10):
    """Return which way it changes lanes in each of some steps."""
    return [agent.act(shown[min(step, len(shown) - 1)])[1] for step in range(steps)]


def changer(**more):
    return LaneChanger(**{"patience_s": 1.0, "step_length_s": 0.5, "blind_spot_m": 0.0, **more})


def test_behind_a_slower_vehicle_it_changes_to_the_left_when_its_patience_is_over_and_then_waits_again():
    shown = seen(15.0, SLOW, lane_y=2 * LANE)
    left = seen(15.0, SLOW, lane_y=LANE)
    assert changes(changer(), shown, shown, left) == [0, 1, 0, 1, 0, 1, 0, 1, 0, 1]
    assert changes(changer(patience_s=2.5), shown, steps=5) == [0, 0, 0, 0, 1]


@pytest.mark.parametrize("side", [1, -1])
def test_it_changes_only_into_a_gap_in_which_no_vehicle_has_to_brake_hard(side):
    lane_y = LANE if side == 1 else 0.0

    def goes(x, vx, **more):
        """To the right it knows of a lane because a vehicle is there, or has been."""
        agent = changer(**more)
        agent.reset(0)
        agent.act(seen(15.0, {"x": 0.0, "y": LANE}, lane_y=lane_y))
        other = {"x": x, "y": -side * LANE, "vx": vx}
        return side in changes(agent, seen(15.0, SLOW, other, lane_y=lane_y), steps=3)

    # 5 m, and 1 s of reaction, and braking with 4 m/s² until both are as fast.
    assert goes(CAR_M + 5.1, 3.0)
    assert not goes(CAR_M + 4.9, 3.0)
    assert goes(-CAR_M - 5.1, -3.0)
    assert not goes(-CAR_M - 4.9, -3.0)
    needs = 5.0 + 8.0 + 8.0 * 8.0 / 8.0
    assert goes(-CAR_M - needs - 0.1, 8.0)
    assert not goes(-CAR_M - needs + 0.1, 8.0)
    assert goes(CAR_M + needs + 0.1, -8.0)
    assert not goes(CAR_M + needs - 0.1, -8.0)
    # A blind spot is beside and behind it, and never ahead.
    assert goes(-6.0, 0.0, blind_spot_m=7.0)
    assert not goes(-6.0, 0.0, blind_spot_m=5.0)
    assert not goes(1.0, 0.0, blind_spot_m=7.0)


def test_a_lane_that_it_has_left_is_still_known_but_not_on_a_road_of_another_number_of_lanes():
    right, left = seen(15.0, SLOW, lane_y=LANE), seen(15.0, SLOW, lane_y=0.0)
    assert changes(changer(), right, right, left, steps=4) == [0, 1, 0, -1]
    agent = changer()
    agent.act(seen(15.0, lane_y=LANE))
    assert changes(agent, left) == [0] * 10  # it has not changed lanes, so a lane on the left has ended
    agent = changer()
    agent.act(seen(15.0, {"x": 15.0, "y": LANE}))
    agent.reset(0)
    assert changes(agent, left) == [0] * 10


def test_its_speed_follows_the_model_between_braking_with_8_and_accelerating_with_2_5():
    agent = LaneChanger(desired_speed=22.0, step_length_s=0.1)
    for shown, leader in (
        (seen(15.0, {"x": 45, "vx": -2}), Leader(40.0, 2.0)),
        (seen(15.0), None),
        (seen(15.0, {"x": 7, "vx": -10}), Leader(2.0, 10.0)),
    ):
        wanted = idm_acceleration(15.0, leader, desired_speed=22.0, headway_s=1.2)
        assert agent.act(shown)[0] == pytest.approx(15.0 + 0.1 * max(-8.0, wanted), abs=1e-4)
    assert agent.act(seen(0.3, {"x": 6, "vx": 0}))[0] == 0.0
    assert LaneChanger(desired_speed=22.0).act(seen(0.0))[0] <= 0.25


def driver(**more):
    return IntelligentDriver(**{"desired_speed": 25.0, "patience_s": 1.0, "step_length_s": 0.5, **more})


def test_mobil_changes_where_the_advantage_is_above_the_gain_and_decides_once_in_a_while():
    blocked = seen(20.0, {"x": 25, "vx": -5}, lane_y=LANE)
    two_lanes_to_the_left = seen(20.0, {"x": 25, "vx": -5}, lane_y=2 * LANE)
    assert changes(driver(), two_lanes_to_the_left, two_lanes_to_the_left, blocked, steps=6) == [0, 1, 0, 1, 0, 1]
    assert changes(driver(patience_s=1.5), blocked, steps=3) == [0, 0, 1]
    same = seen(20.0, {"x": 45, "vx": -1}, {"x": 45, "y": -LANE, "vx": -1}, lane_y=LANE)
    assert changes(driver(), same) == [0] * 10
    # The other lane lets it accelerate as on a free road; the leader of its own costs it this much.
    free, held = (
        idm_acceleration(20.0, leader, desired_speed=25.0, headway_s=1.5) for leader in (None, Leader(40.0, 1.0))
    )
    one = seen(20.0, {"x": 45, "vx": -1}, lane_y=LANE)
    assert any(changes(driver(gain=free - held - 0.01), one))
    assert not any(changes(driver(gain=free - held + 0.01), one))
    standing = seen(1.0, {"x": 8, "vx": -1}, lane_y=LANE)
    assert changes(driver(), standing) == [0] * 10  # lanes are not changed at a walking pace
    assert any(changes(driver(), seen(1.5, {"x": 8, "vx": -1}, lane_y=LANE)))
    assert changes(driver(), seen(20.0, {"x": 25, "vx": -5})) == [0] * 10  # there is no other lane


def test_mobil_takes_the_better_of_both_sides_and_of_equal_ones_the_left():
    agent = driver()
    known = seen(20.0, {"x": 0, "y": LANE}, lane_y=LANE)
    for left, right, side in ((30, 90, -1), (90, 30, 1), (None, 60, 1), (60, None, -1), (60, 60, 1)):
        agent.reset(0)
        agent.act(known)
        others = [{"x": 22, "vx": -5}]
        others += [{"x": x, "y": y, "vx": -5} for x, y in ((left, -LANE), (right, LANE)) if x is not None]
        assert agent.act(seen(20.0, *others, lane_y=LANE))[1] == side, (left, right)


def test_mobil_never_forces_the_follower_of_the_other_lane_to_brake_by_more_than_2():
    def goes(gap_m, faster_by, *others, **more):
        behind = {"x": -CAR_M - gap_m, "y": -LANE, "vx": faster_by}
        shown = seen(20.0, {"x": 25, "vx": -5}, behind, *others, lane_y=LANE)
        return changes(driver(**more), shown, steps=2)[1] == 1

    for faster_by in (-5.0, 0.0, 4.0):
        gaps = np.arange(2.0, 120.0)
        brakes = [
            idm_acceleration(20.0 + faster_by, Leader(gap, faster_by), desired_speed=25.0, headway_s=1.5)
            for gap in gaps
        ]
        assert [goes(gap, faster_by) for gap in gaps] == [brake >= -2.0 for brake in brakes]
    # Of several behind, the nearest one brakes.
    assert not goes(60.0, 0.0, {"x": -8.0, "y": -LANE, "vx": 0.0})
    # Nor does it change beside a vehicle, or when it had to brake so hard itself.
    assert not goes(100.0, -5.0, {"x": 3.0, "y": -LANE, "vx": 0.0})
    assert not goes(100.0, -5.0, {"x": 15.0, "y": -LANE, "vx": -3.0})


def test_by_its_politeness_it_weighs_what_the_follower_of_the_other_lane_loses():
    gap_m = 45.0

    def polite(politeness, *others):
        behind = {"x": -CAR_M - gap_m, "y": -LANE, "vx": 0.0}
        shown = seen(20.0, {"x": 40, "vx": -2}, behind, *others, lane_y=LANE)
        return changes(driver(politeness=politeness, gain=0.0), shown, steps=2)[1] == 1

    def model(speed, leader):
        return idm_acceleration(speed, leader, desired_speed=25.0, headway_s=1.5)

    own = model(20.0, Leader(35.0, 2.0))
    braking = model(20.0, Leader(gap_m, 0.0))
    for others, ahead in (((), None), (({"x": 60, "y": -LANE, "vx": -1},), Leader(55.0, 1.0))):
        advantage = model(20.0, ahead) - own
        before = None if ahead is None else Leader(gap_m + CAR_M + ahead.gap, ahead.closing_speed)
        limit = advantage / (model(20.0, before) - braking)
        assert polite(limit - 0.02, *others)
        assert not polite(limit + 0.02, *others)


def test_by_meta_actions_both_say_lane_left_and_mobil_keeps_to_its_limits():
    space = MetaAction().space
    shown = seen(20.0, {"x": 25, "vx": -5}, lane_y=LANE)
    for agent in (driver(action_space=space), changer(desired_speed=25.0, action_space=space)):
        assert [NAMES[agent.act(shown)] for _ in range(2)] == ["SLOWER", "LANE_LEFT"]
    assert driver().act(seen(20.0, {"x": 7, "vx": -20}))[0] == pytest.approx(20.0 - 8.0 * 0.5)
    assert driver().act(seen(3.0, {"x": 6, "vx": -3}))[0] == 0.0


@pytest.mark.parametrize("kind", [LaneChanger, IntelligentDriver])
def test_a_step_of_no_length_is_refused(kind):
    with pytest.raises(ValueError, match="step_length_s"):
        kind(step_length_s=0.0)
