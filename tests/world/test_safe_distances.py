"""Safe distances of RSS, against a simulation of the worst case that RSS describes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings, strategies as st

from crashhunt.world import safe_distance, safe_speed, time_to_drive

SPEEDS = st.floats(0.0, 40.0)
RATES = st.floats(0.5, 9.0)
RESPONSES = st.floats(0.1, 2.0)


def smallest_gap(gap, rear, front, response, accelerates, brakes, front_brakes, dt=0.002):
    """The smallest gap of the worst case: the front brakes at once, the rear one accelerates, and then brakes."""
    time, least = 0.0, gap
    while rear > 0 or front > 0:
        rate = accelerates if time < response else -brakes
        rear_next, front_next = max(0.0, rear + rate * dt), max(0.0, front - front_brakes * dt)
        gap += ((front + front_next) - (rear + rear_next)) / 2 * dt
        rear, front, time = rear_next, front_next, time + dt
        least = min(least, gap)
        if time >= response and rear == 0 and front == 0:
            break
    return least


@pytest.mark.parametrize(
    ("rear", "front", "response", "accelerates", "brakes", "front_brakes"),
    [
        (20, 20, 0.5, 2.0, 4.0, 8.0),
        (25, 10, 0.5, 2.6, 4.5, 4.5),
        (5, 30, 1.0, 3.5, 4.0, 8.0),
        (14, 0, 1.0, 1.0, 3.0, 3.0),
    ],
)
def test_from_the_safe_distance_the_worst_case_is_just_avoided(
    rear, front, response, accelerates, brakes, front_brakes
):
    named = {
        "response_s": response,
        "acceleration_mps2": accelerates,
        "braking_mps2": brakes,
        "front_braking_mps2": front_brakes,
    }
    safe = safe_distance(rear, front, **named)
    assert smallest_gap(safe + 0.1, rear, front, response, accelerates, brakes, front_brakes) > 0
    if safe > 0:  # half a metre less does not suffice
        assert smallest_gap(safe - 0.5, rear, front, response, accelerates, brakes, front_brakes) < 0


@settings(deadline=None)
@given(SPEEDS, SPEEDS, RESPONSES, RATES, RATES, RATES)
def test_the_safe_speed_is_the_inverse_of_the_safe_distance(rear, front, response, accelerates, brakes, front_brakes):
    named = {
        "response_s": response,
        "acceleration_mps2": accelerates,
        "braking_mps2": brakes,
        "front_braking_mps2": front_brakes,
    }
    gap = safe_distance(rear, front, **named)
    found = safe_speed(gap, front, **named)
    if gap > 0:
        assert found == pytest.approx(rear, rel=1e-6, abs=1e-3)
    else:
        assert found >= rear - 1e-3
    assert safe_speed(-1e6, front, **named) == 0.0


@settings(deadline=None)
@given(st.floats(0.1, 200.0), SPEEDS, st.floats(0.1, 5.0), SPEEDS)
def test_the_time_to_drive_a_distance_agrees_with_small_steps(distance, speed, acceleration, top):
    found = time_to_drive(distance, speed, acceleration, top)
    if max(speed, top) < 0.5:
        return
    dt, time, left, limit = found / 400, 0.0, distance, max(speed, top)
    while left > 0 and time < 2 * found + 1:
        later = min(limit, speed + acceleration * dt)
        left, speed, time = left - (speed + later) / 2 * dt, later, time + dt
    assert time == pytest.approx(found, abs=2.5 * dt + 0.02 * found)


def test_a_vehicle_that_never_moves_never_arrives():
    assert time_to_drive(10.0, 0.0, 0.0, 20.0) == math.inf
    assert time_to_drive(0.0, 0.0, 0.0, 20.0) == 0.0
