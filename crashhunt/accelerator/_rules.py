"""The parts of a sub-step that stay in Python: checks of pairs by highway-env, and right of way at intersections."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import numpy as np
from highway_env import utils
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle

from crashhunt.accelerator._versions import kinds_of

if TYPE_CHECKING:
    from highway_env.road.regulation import RegulatedRoad
    from highway_env.road.road import Road
    from highway_env.vehicle.kinematics import Vehicle
    from numpy.typing import NDArray

    from crashhunt.accelerator._versions import Kind

    Path = tuple[list[NDArray[np.float64]], list[float]]  # positions and headings that are predicted


__all__ = ["collide_one_by_one", "enforce", "finish"]


_MARGIN_M = 1e-6  # predicted positions that are separated by less than this get highway-env's exact test


def finish(road: Road, dt: float) -> None:
    """Finish a sub-step after the kernel has moved the vehicles: with numbers that are not finite, in highway-env."""
    for vehicle in road.vehicles:
        vehicle.on_state_update()
    collide_one_by_one(road, dt)


def collide_one_by_one(road: Road, dt: float) -> None:
    """Check all pairs of objects for collisions, with highway-env's own code."""
    for number, vehicle in enumerate(road.vehicles):
        for other in road.vehicles[number + 1 :]:
            vehicle.handle_collisions(other, dt)
        for other in road.objects:
            vehicle.handle_collisions(other, dt)


def enforce(road: RegulatedRoad) -> bool:
    """Do what `RegulatedRoad.enforce_road_rules` does, with one prediction per vehicle.

    Returns:
        False, with nothing changed, if the class of a vehicle is unknown.
    """
    vehicles, kinds = road.vehicles, kinds_of(road.vehicles)
    if not all(kind.predicts and kind.is_of(vehicle) for kind, vehicle in zip(kinds, vehicles, strict=True)):
        return False
    for vehicle in vehicles:
        if getattr(vehicle, "is_yielding", False):
            if vehicle.yield_timer >= road.YIELD_DURATION * road.REGULATION_FREQUENCY:
                vehicle.target_speed = vehicle.lane.speed_limit
                delattr(vehicle, "color")
                vehicle.is_yielding = False
            else:
                vehicle.yield_timer += 1
    if len(vehicles) < 2:
        return True
    times = np.arange(0.25, 3, 0.25)
    foreseen = [_foresee(vehicle, kind, times) for vehicle, kind in zip(vehicles, kinds, strict=True)]
    paths = np.array([np.reshape(positions, (len(times), 2)) for positions, _ in foreseen])
    for number, one in enumerate(vehicles[:-1]):
        offset = paths[number + 1 :] - paths[number]
        near = (offset * offset).sum(axis=2) <= (one.LENGTH + _MARGIN_M) ** 2
        for other in np.flatnonzero(near.any(axis=1)).tolist():
            two = vehicles[number + 1 + other]
            if _conflict(one, two, foreseen[number], foreseen[number + 1 + other]):
                yielding = road.respect_priorities(one, two)
                if (
                    yielding is not None
                    and isinstance(yielding, ControlledVehicle)
                    and not isinstance(yielding, MDPVehicle)
                ):
                    yielding.color = road.YIELDING_COLOR
                    yielding.target_speed = 0
                    yielding.is_yielding = True
                    yielding.yield_timer = 0
    return True


def _foresee(vehicle: Vehicle, kind: Kind, times: NDArray[np.float64]) -> Path:
    """Return `predict_trajectory_constant_speed`, computed with a copy of the vehicle and not of the whole road."""
    if kind.base != "nothing" or vehicle.prediction_type not in ("zero_steering", "constant_steering"):
        path: Path = vehicle.predict_trajectory_constant_speed(times)
        return path
    steering = 0.0 if vehicle.prediction_type == "zero_steering" else vehicle.action["steering"]
    ahead = copy.copy(vehicle)
    ahead.road, ahead.position = None, vehicle.position.copy()  # without a road, the copy does not search for its lane
    ahead.action = {"acceleration": 0.0, "steering": steering}
    positions, headings = [], []
    for dt in np.diff(np.concatenate(([0.0], times))):
        ahead.step(dt)
        positions.append(ahead.position.copy())
        headings.append(ahead.heading)
    return positions, headings


def _conflict(one: Vehicle, two: Vehicle, first: Path, second: Path) -> bool:
    """Return the result of `RegulatedRoad.is_conflict_possible` from the predicted paths."""
    for place, heading, other_place, other_heading in zip(*first, *second, strict=False):
        if np.linalg.norm(other_place - place) > one.LENGTH:
            continue
        if utils.rotated_rectangles_intersect(
            (place, 1.5 * one.LENGTH, 0.9 * one.WIDTH, heading),
            (other_place, 1.5 * two.LENGTH, 0.9 * two.WIDTH, other_heading),
        ):
            return True
    return False
