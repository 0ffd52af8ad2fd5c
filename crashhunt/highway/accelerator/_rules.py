"""The parts of a sub-step that stay in Python: checks of pairs by highway-env, and right of way at intersections."""

from __future__ import annotations

from typing import TYPE_CHECKING

from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle

if TYPE_CHECKING:
    from highway_env.road.regulation import RegulatedRoad
    from highway_env.road.road import Road

    from crashhunt.highway.accelerator._kernel import Traffic


def finish(road: Road, dt: float) -> None:
    """Finish a sub-step with highway-env's code, because the kernel has found a number that is not finite."""
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


def enforce(road: RegulatedRoad, traffic: Traffic) -> bool:
    """Compute the result of `RegulatedRoad.enforce_road_rules`, with one prediction per vehicle.

    Args:
        road: The road.
        traffic: The road's vehicles in the kernel, with their current state.

    Returns:
        Whether the rules were applied; False, with nothing changed, if highway-env must predict a path.
    """
    vehicles = road.vehicles
    conflicts = traffic.conflicts()
    if conflicts is None:
        return False
    for vehicle in vehicles:
        if getattr(vehicle, "is_yielding", False):
            if vehicle.yield_timer >= road.YIELD_DURATION * road.REGULATION_FREQUENCY:
                vehicle.target_speed = vehicle.lane.speed_limit
                delattr(vehicle, "color")
                vehicle.is_yielding = False
            else:
                vehicle.yield_timer += 1
    for row, other, is_certain in conflicts:
        one, two = vehicles[row], vehicles[other]
        if not is_certain and not road.is_conflict_possible(one, two):
            continue
        yielding = road.respect_priorities(one, two)
        if yielding is not None and isinstance(yielding, ControlledVehicle) and not isinstance(yielding, MDPVehicle):
            yielding.color = road.YIELDING_COLOR
            yielding.target_speed = 0
            yielding.is_yielding = True
            yielding.yield_timer = 0
    return True
