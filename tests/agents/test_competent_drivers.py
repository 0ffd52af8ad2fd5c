"""The agent that drives as a reference model: what it brakes for, what not, and which arguments it refuses."""

from __future__ import annotations

import pytest
from seen import CAR_M, seen

from crashhunt.agents import REFERENCE_MODELS, ReferenceDriver

STEP_S = 0.1


def drive_behind(
    driver: ReferenceDriver, *, speed: float, other: float, gap: float, beside: float = 0.0, lateral: float = 0.0
):
    """Drive for 20 s; return the smallest gap, the hardest braking in m/s² and the last speed."""
    least, hardest = gap, 0.0
    driver.reset(0)
    for _ in range(200):
        row = {"x": gap + CAR_M, "y": -beside, "vx": other - speed, "vy": lateral if beside > 0 else 0.0}
        target, change = driver.act(seen(speed, row))
        assert change == 0
        hardest = min(hardest, (target - speed) / STEP_S)
        speed = target
        gap -= (speed - other) * STEP_S
        beside = max(0.0, beside - lateral * STEP_S)
        least = min(least, gap)
    return least, hardest, speed


@pytest.mark.parametrize("model", REFERENCE_MODELS)
def test_driver_brakes_hard_for_a_cut_in_and_does_not_touch_the_other_vehicle(model):
    driver = ReferenceDriver(model=model, desired_speed=0)
    least, hardest, speed = drive_behind(driver, speed=22.0, other=14.0, gap=24.0, beside=3.5, lateral=1.5)
    assert least > 0
    assert hardest < -2.5
    assert speed == pytest.approx(14.0, abs=1.0)


@pytest.mark.parametrize("model", REFERENCE_MODELS)
def test_driver_ignores_a_vehicle_that_stays_in_the_next_lane(model):
    driver = ReferenceDriver(model=model, desired_speed=0)
    _, hardest, speed = drive_behind(driver, speed=22.0, other=14.0, gap=40.0, beside=3.5)
    assert hardest > -0.01
    assert speed == pytest.approx(22.0)


@pytest.mark.parametrize("model", ["cc_human", "fsm", "rss"])
def test_driver_stops_behind_a_vehicle_that_stands_in_its_path(model):
    driver = ReferenceDriver(model=model, desired_speed=20)
    least, _, speed = drive_behind(driver, speed=20.0, other=0.0, gap=120.0)
    assert least > 0
    assert speed < 0.6


def test_driver_reacts_after_the_reaction_time_and_to_the_vehicle_that_it_has_seen_before():
    driver = ReferenceDriver(model="cc_human", desired_speed=0)
    ahead = {"x": 15.0 + CAR_M, "vx": -10.0}
    speeds = [driver.act(seen(20.0, {**ahead, "x": ahead["x"] - step}))[0] for step in range(9)]
    assert speeds[:8] == pytest.approx([20.0 - 0.04] * 8)  # lifts the foot for 0.75 s, which are eight steps
    assert speeds[8] == pytest.approx(20.0 - 0.04 - 0.1265)  # then a ramp of 12.65 m/s³


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"model": "human"}, "model must be one of cc_human, fsm, rss, reg157, not 'human'"),
        ({"desired_speed": -1.0}, "desired_speed must be a number of at least 0, not -1.0"),
        ({"length": 0.0}, "length must be a number above 0"),
        ({"width": float("nan")}, "width must be a number above 0"),
    ],
)
def test_driver_refuses_arguments_out_of_range(arguments, words):
    with pytest.raises(ValueError, match=words):
        ReferenceDriver(**arguments)
