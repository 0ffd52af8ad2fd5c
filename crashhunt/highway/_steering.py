"""highway-env's continuous actions, acceleration and steering, as speeds and lane changes, and back.

The vehicle follows highway-env's kinematic bicycle model (`Vehicle.step`), which determines the direction of motion
from the heading and the steering angle.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from highway_env.envs.common.action import ContinuousAction, DiscreteAction
from highway_env.utils import lmap

from crashhunt.world import Motion

if TYPE_CHECKING:
    from numpy.typing import NDArray

OVER_M = 1.0
"""A vehicle that is so far over the side of its lane is in the way of the next lane, in m: as highway-env has it."""

_HEADING_S, _LATERAL_S = 0.2, 0.6  # time constants of highway-env's own lane keeping (`ControlledVehicle`)
_MAX_APPROACH_RAD = math.pi / 4  # heading towards the middle of the lane, also as there
_MIN_SPEED_MPS = 0.1  # a slower vehicle hardly turns
_LOOK_S = 0.5  # of lateral motion: as long as the response time of a reference driver


def is_steered(kind: Any) -> bool:
    """Whether the actions of a vehicle are an acceleration and a steering angle, without tires that slip."""
    continuous = isinstance(kind, ContinuousAction) and not isinstance(kind, DiscreteAction)
    return continuous and kind.longitudinal and kind.lateral and not kind.dynamical


def motion_of(kind: Any, vehicle: Any, action: NDArray[Any], step_s: float) -> Motion:
    """Return what an action does within the next step. Changes nothing, and draws no random number.

    The action is acceleration and steering, each from -1 to 1.
    """
    throttle, wheel = np.clip(action, -1.0, 1.0) if kind.clip else action
    acceleration = lmap(float(throttle), [-1, 1], kind.acceleration_range)
    slip = math.atan(math.tan(lmap(float(wheel), [-1, 1], kind.steering_range)) / 2)
    turn = vehicle.speed * math.sin(slip) / (vehicle.LENGTH / 2) * step_s
    along, aside = vehicle.lane.local_coordinates(vehicle.position)
    heading = math.remainder(vehicle.heading - vehicle.lane.heading_at(along), math.tau)
    moves = vehicle.speed * (math.sin(heading + turn / 2 + slip) * step_s + math.sin(heading + turn) * _LOOK_S)
    leaves = moves * (aside + moves) > 0  # otherwise it moves towards the middle of its lane
    return Motion(
        speed_mps=max(0.0, float(vehicle.speed + acceleration * step_s)),
        lane_change=lane_change_of(vehicle, float(aside + moves)) if leaves else 0,
    )


def lane_change_of(vehicle: Any, aside_m: float) -> int:
    """Return the side on which a vehicle at a lateral position is in the way of the next lane; 0 on neither.

    Args:
        vehicle: the vehicle.
        aside_m: position of its centre to the right of the middle of its lane, in m.

    Returns:
        1 for left, -1 for right.
    """
    along = vehicle.lane.local_coordinates(vehicle.position)[0]
    if abs(aside_m) <= vehicle.lane.width_at(along) / 2 - OVER_M:
        return 0
    return -1 if aside_m > 0 else 1  # highway-env's y axis points down


def action_with(
    kind: Any,
    vehicle: Any,
    action: NDArray[Any] | None,
    step_s: float,
    *,
    speed_mps: float | None,
    keeps_lane: bool,
) -> NDArray[Any]:
    """Return an action with another speed, or with the steering that keeps the lane.

    The action may be None if both its speed and its steering are replaced. The vehicle reaches the speed, at least 0,
    as far as it can; None leaves the acceleration.
    """
    found = np.zeros(2) if action is None else np.array(action)
    if speed_mps is not None:
        found[0] = lmap((speed_mps - float(vehicle.speed)) / step_s, kind.acceleration_range, [-1, 1])
    if keeps_lane:
        found[1] = lmap(_lane_keeping_angle(vehicle, step_s), kind.steering_range, [-1, 1])
    return found.clip(-1.0, 1.0)


def _lane_keeping_angle(vehicle: Any, step_s: float) -> float:
    """Return the steering angle that leads to the middle of the lane, in rad.

    This is `ControlledVehicle.steering_control`, which computes a new angle in every sub-step. An action holds for a
    whole step, so no time constant is shorter than a step.
    """
    heading_s = max(_HEADING_S, step_s)
    lateral_s = _LATERAL_S / _HEADING_S * heading_s
    speed = max(_MIN_SPEED_MPS, float(vehicle.speed))
    along, aside = vehicle.lane.local_coordinates(vehicle.position)
    approach = math.asin(min(1.0, max(-1.0, -aside / lateral_s / speed)))
    wanted = vehicle.lane.heading_at(along + speed * heading_s)
    wanted += min(_MAX_APPROACH_RAD, max(-_MAX_APPROACH_RAD, approach))
    rate = math.remainder(wanted - vehicle.heading, math.tau) / heading_s
    slip = math.asin(min(1.0, max(-1.0, vehicle.LENGTH / 2 / speed * rate)))
    return math.atan(2 * math.tan(slip))
