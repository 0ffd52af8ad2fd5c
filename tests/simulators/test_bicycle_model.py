"""Tests of the kinematic bicycle model against a closed-form circle and a fine integration of its equations."""

import math

import pytest
from hypothesis import example, given, strategies as st

from crashhunt.simulators import MAX_STEERING_RAD, BicycleModel, MotionState
from crashhunt.simulators._bicycle_model import MAX_JERK_MPS3, MAX_STEERING_RATE_RADPS

MODEL = BicycleModel(wheelbase=3.0, max_acceleration=3.0, max_deceleration=5.0, max_speed=40.0)


def integrated(state, acceleration, steering, seconds, parts=20_000):
    """Integrate x' = v cos(h + b), y' = v sin(h + b), h' = v cos(b) tan(d) / L, v' = a by the midpoint rule."""
    x, y, heading, speed, dt = state.x, state.y, state.heading, state.speed, seconds / parts
    slip = math.atan(math.tan(steering) / 2)
    for _ in range(parts):
        if speed + acceleration * dt < 0:
            return x, y, heading, 0.0
        middle = speed + acceleration * dt / 2
        turn = middle * math.cos(slip) * math.tan(steering) / 3.0
        at = heading + turn * dt / 2 + slip
        x, y, heading = x + middle * math.cos(at) * dt, y + middle * math.sin(at) * dt, heading + turn * dt
        speed += acceleration * dt
    return x, y, heading, speed


@given(
    speed=st.floats(0, 35), heading=st.floats(-7, 7), acceleration=st.floats(-5, 3),
    steering=st.floats(-MAX_STEERING_RAD, MAX_STEERING_RAD), step_s=st.sampled_from([0.05, 0.1, 1.0]),
)  # fmt: skip
@example(speed=15.0, heading=0.0, acceleration=0.0, steering=5e-324, step_s=0.1)  # half of it is 0
@example(speed=5.5, heading=0.0, acceleration=0.0, steering=5e-324, step_s=1.0)  # and of this turn, it is not
def test_step_equals_a_fine_integration_of_the_equations(speed, heading, acceleration, steering, step_s):
    state = MotionState(x=4.0, y=-7.0, heading=heading, speed=speed, acceleration=acceleration, steering=steering)
    found = MODEL.step(state, acceleration, steering, step_s)
    x, y, turned, reached = integrated(state, acceleration, steering, step_s, parts=500)
    assert (found.x, found.y) == pytest.approx((x, y), abs=2e-2)
    assert (found.heading, found.speed) == pytest.approx((turned, reached), abs=2e-2)


def test_constant_steering_drives_a_circle_of_the_closed_form():
    steering = 0.3
    slip = math.atan(math.tan(steering) / 2)
    radius = 3.0 / (math.cos(slip) * math.tan(steering))
    state = MotionState(x=0.0, y=0.0, heading=-slip, speed=5.0, steering=steering)  # the centre moves along x at first
    steps = round(2 * math.pi * radius / 0.5)
    for step in range(1, steps + 1):
        state = MODEL.step(state, 0.0, steering, 0.1)
        assert math.hypot(state.x, state.y - radius) == pytest.approx(radius, abs=1e-9)
        assert state.heading + slip == pytest.approx(0.5 * step / radius, abs=1e-9)
    assert math.hypot(state.x, state.y) < 0.5


def test_limits_of_angle_rate_acceleration_jerk_and_speed_hold():
    state = MODEL.step(MotionState(x=0.0, y=0.0, heading=0.0, speed=10.0), -10.0, 1.0, 0.01)
    assert state.acceleration == pytest.approx(-MAX_JERK_MPS3 * 0.01)
    assert state.steering == pytest.approx(MAX_STEERING_RATE_RADPS * 0.01)
    for _ in range(300):
        state = MODEL.step(state, 10.0, 1.0, 0.1)
    assert (state.acceleration, state.steering, state.speed) == (0.0, MAX_STEERING_RAD, pytest.approx(40.0))


def test_vehicle_stops_after_its_braking_distance_and_does_not_drive_backwards():
    state = MotionState(x=0.0, y=0.0, heading=0.0, speed=10.0, acceleration=-5.0)
    for _ in range(40):
        state = MODEL.step(state, -5.0, 0.0, 0.1)
    assert (state.x, state.y, state.speed) == (pytest.approx(10.0), 0.0, 0.0)
