"""What a step computes for each agent: the effect of its meta-action, and the rewards of `HighwayEnv`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from highway_env import utils
from highway_env.envs.common.action import ActionType, DiscreteMetaAction
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle

if TYPE_CHECKING:
    from highway_env.envs.common.abstract import AbstractEnv
    from highway_env.envs.highway_env import HighwayEnv

_CLIP = np.clip
_ONE = np.float64(1)
_SPEED_CHANGES = {"SLOWER": -1, "IDLE": 0, "FASTER": 1}
_DTYPES = (np.dtype(np.float64), np.dtype(np.int64))
_MEMBERS = [(owner, name) for owner in (ActionType, DiscreteMetaAction) for name in ("act", "controlled_vehicle")]
_ORIGINALS = [vars(owner).get(name) for owner, name in _MEMBERS]


def choose(env: AbstractEnv, action: object) -> bool:
    """Apply that part of `DiscreteMetaAction.act` whose effect remains after the next `Road.act`.

    `MDPVehicle.act` chooses a target speed or lane, and then computes steering and acceleration. `Road.act` computes
    both again from the same state before any code reads them.

    Args:
        env: The environment, whose road has just been checked: no vehicle on it has own methods.
        action: The action of the environment's agent.

    Returns:
        Whether the action was applied; False, with nothing changed, if highway-env must apply it.
    """
    deciding = env.action_type
    if type(deciding) is not DiscreteMetaAction or type(action) not in (int, np.int64) or "act" in vars(deciding):
        return False
    if [vars(owner).get(name) for owner, name in _MEMBERS] != _ORIGINALS or type(deciding.actions) is not dict:
        return False
    meaning = deciding.actions.get(action)
    change = _SPEED_CHANGES.get(meaning) if type(meaning) is str else None
    vehicle = deciding.controlled_vehicle
    if change is None or type(vehicle) is not MDPVehicle:
        return False
    road = env.road
    if vehicle.road is not road or not any(other is vehicle for other in road.vehicles):
        return False
    try:
        at_end = road.network.get_lane(vehicle.target_lane_index).after_end(vehicle.position)
    except Exception:
        return False  # highway-env raises the same error
    return not at_end and (not change or _change_speed(vehicle, change))


def _change_speed(vehicle: MDPVehicle, change: int) -> bool:
    """Compute the result of `MDPVehicle.act` for the target speed; return False if the speeds are unusual."""
    speed, speeds = vehicle.speed, vehicle.target_speeds
    if type(speed) not in (float, np.float64) or type(speeds) is not np.ndarray:
        return False
    if speeds.ndim != 1 or speeds.size < 2 or speeds.dtype not in _DTYPES:
        return False
    first, last = float(speeds[0]), float(speeds[-1])
    if first == last:
        return False
    nearest = (float(speed) - first) / (last - first) * (speeds.size - 1)
    if not math.isfinite(nearest):
        return False
    index = min(max(round(nearest), 0), speeds.size - 1) + change
    vehicle.speed_index = min(max(index, 0), speeds.size - 1)
    vehicle.target_speed = speeds[vehicle.speed_index]
    return True


def rewards(env: HighwayEnv) -> dict[str, float]:
    """Return the result of `HighwayEnv._rewards`, in which the speed is limited by faster code."""
    vehicle = env.vehicle
    neighbours = env.road.network.all_side_lanes(vehicle.lane_index)
    lane = vehicle.target_lane_index[2] if isinstance(vehicle, ControlledVehicle) else vehicle.lane_index[2]
    forward_speed = vehicle.speed * np.cos(vehicle.heading)
    scaled_speed = utils.lmap(forward_speed, env.config["reward_speed_range"], [0, 1])
    return {
        "collision_reward": float(vehicle.crashed),
        "right_lane_reward": lane / max(len(neighbours) - 1, 1),
        "high_speed_reward": _clip_to_unit(scaled_speed),
        "on_road_reward": float(vehicle.on_road),
    }


def _clip_to_unit(value: float) -> float:
    """Return the result of ``np.clip(value, 0, 1)``."""
    if type(value) is not np.float64 or np.clip is not _CLIP or not value > 0:
        clipped: float = np.clip(value, 0, 1)  # decides about the sign of zero, and about NaN
        return clipped
    return value if value < 1 else _ONE
