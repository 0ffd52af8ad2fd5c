"""The kinematic bicycle model about the centre of a vehicle's rectangle, integrated exactly.

Source: P. Polack et al., The kinematic bicycle model: a consistent model for planning feasible trajectories for
autonomous vehicles?, IEEE Intelligent Vehicles Symposium 2017. Both axles are equally far from the centre.

Within a step, the steering angle δ and the acceleration are constant. With the wheelbase L, the centre moves at the
slip angle β = atan(tan(δ) / 2) to the heading, on a circle of the curvature cos(β) tan(δ) / L. The arc is as long as
the distance driven, v t + a t² / 2 up to a standstill, so the pose after the step has a closed form.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

from crashhunt.scenario import ACTIONS

MAX_STEERING_RAD = ACTIONS["acceleration_steering"].components[1].high
"""Largest steering angle; a passenger car turns within a circle of 10 to 12 m with it."""
MAX_STEERING_RATE_RADPS = 1.0
"""Largest change of the steering angle per second."""
MAX_JERK_MPS3 = 50.0
"""Largest change of the acceleration per second: brakes need 0.1 s for 5 m/s²."""
WHEELBASE_SHARE = 0.6
"""Wheelbase of a vehicle as a share of its length, because SUMO has no wheelbase."""


@dataclass(frozen=True, slots=True)
class MotionState:
    """The state of a vehicle that moves freely in the plane."""

    x: float  # position of the centre to the east, in m
    y: float  # position of the centre to the north, in m
    heading: float  # heading in rad, counter-clockwise from east
    speed: float  # speed of the centre in m/s, at least 0
    acceleration: float = 0.0  # acceleration of the last step, in m/s²
    steering: float = 0.0  # steering angle of the last step in rad, positive to the left


@dataclass(frozen=True, slots=True)
class BicycleModel:
    """A vehicle that moves by the kinematic bicycle model, within its limits."""

    wheelbase: float  # distance between the axles, in m
    max_acceleration: float  # largest acceleration, in m/s²
    max_deceleration: float  # largest deceleration, in m/s²
    max_speed: float = math.inf  # largest speed, in m/s

    def step(self, state: MotionState, acceleration: float, steering: float, step_s: float) -> MotionState:
        """Return the state after a step; the vehicle stops at a standstill and does not drive backwards.

        Args:
            state: state before the step.
            acceleration: requested acceleration, in m/s². The limits of acceleration and jerk apply.
            steering: requested steering angle, in rad. The limits of angle and rate apply.
            step_s: step length, in s.
        """
        bounded = _clip(acceleration, -self.max_deceleration, self.max_acceleration)
        a = _toward(state.acceleration, bounded, MAX_JERK_MPS3 * step_s)
        delta = _toward(
            state.steering, _clip(steering, -MAX_STEERING_RAD, MAX_STEERING_RAD), MAX_STEERING_RATE_RADPS * step_s
        )
        if state.speed + a * step_s > self.max_speed:
            a = min(a, max(0.0, (self.max_speed - state.speed) / step_s))
        speed = state.speed + a * step_s
        if speed < 0.0:
            distance, speed = state.speed * state.speed / (-2.0 * a), 0.0
        else:
            distance = (state.speed + a * step_s / 2) * step_s
        slip = math.atan(math.tan(delta) / 2)
        turned = distance * math.cos(slip) * math.tan(delta) / self.wheelbase
        half = turned / 2
        # Of numbers below the smallest normal one, products keep few digits.
        chord = distance if abs(half) < sys.float_info.min else distance * math.sin(half) / half
        course = state.heading + slip + half
        return MotionState(
            x=state.x + chord * math.cos(course), y=state.y + chord * math.sin(course),
            heading=state.heading + turned, speed=speed, acceleration=a, steering=delta,
        )  # fmt: skip


def _clip(value: float, low: float, high: float) -> float:
    return max(low, min(high, value))


def _toward(before: float, wanted: float, change: float) -> float:
    """Return the wanted value, or the value that is nearest to it within a change of the value before."""
    return _clip(wanted, before - change, before + change)
