"""Movement and collisions of vehicles: `Road.step`, and the right-of-way rules of intersections."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING

import numpy as np
from highway_env import utils
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle

from crashhunt.accelerator._network import wrap_to_pi
from crashhunt.accelerator._vehicle_arrays import Frame
from crashhunt.accelerator._versions import are_numbers, kinds_of

if TYPE_CHECKING:
    from highway_env.road.regulation import RegulatedRoad
    from highway_env.road.road import Road
    from highway_env.vehicle.kinematics import Vehicle
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.accelerator._network import Network
    from crashhunt.accelerator._vehicle_arrays import Crowd
    from crashhunt.accelerator._versions import Kind

    Path = tuple[list[NDArray[np.float64]], list[float]]  # positions and headings that are predicted


__all__ = ["as_numpy", "collide", "collide_one_by_one", "enforce", "finish", "move"]


_DICTS, _FLOATS = frozenset((dict,)), frozenset((float,))
_MARGIN = 1e-6  # m; objects that are separated by less than this get highway-env's exact test


def move(crowd: Crowd, network: Network, dt: float, frame: Frame | None = None, *, alone: bool = False) -> Frame | None:
    """Move all vehicles for a sub-step, and update the arrays of the crowd.

    Args:
        crowd: The vehicles with their positions; the accelerator knows how all of them move.
        network: The lanes of their road.
        dt: Length of the sub-step, in s.
        frame: Their positions before the sub-step, if known.
        alone: Whether headings may be Python floats until `as_numpy` is called.

    Returns:
        The new positions, or None, with nothing changed, if a number has an unusual type.
    """
    vehicles, count = crowd.vehicles, len(crowd.vehicles)
    actions = [vehicle.action for vehicle in vehicles]
    if not _DICTS.issuperset(map(type, actions)) or len(set(map(id, actions))) < count:
        return None
    acts = [action.get("steering") for action in actions] + [action.get("acceleration") for action in actions]
    if not are_numbers((dt, *acts)):
        return None
    for vehicle in crowd.timed:
        vehicle.timer += dt
    heading, speed = crowd.headings[:count], crowd.speeds[:count]
    _clip_all(crowd, acts, speed)
    steering, acceleration = np.array(acts, float).reshape(2, -1)
    slip = np.arctan(1 / 2 * np.tan(steering))
    course = heading + slip
    places = crowd.places.copy()
    places[:count, 0] += (speed * np.cos(course)) * dt
    places[:count, 1] += (speed * np.sin(course)) * dt
    turned = heading + speed * np.sin(slip) / (crowd.numbers["LENGTH"][:count] / 2) * dt
    faster = speed + acceleration * dt
    speeds: list[float] = faster.tolist()
    # Keep the type of each speed, Python's or NumPy's, because later arithmetic depends on it.
    for row in range(count) if type(dt) is np.float64 else crowd.of_numpy:
        speeds[row] = faster[row]
    _write(crowd, places, turned.tolist() if alone else list(turned), speeds)
    for row in crowd.sliding:
        _slide(vehicles[row], dt)
        places[row], turned[row], faster[row] = vehicles[row].position, vehicles[row].heading, vehicles[row].speed
    crowd.places, crowd.headings[:count], crowd.speeds[:count] = places, turned, faster
    frame = Frame(network, crowd.road, places, frame)
    if not np.isfinite(places).all() or not np.isfinite(turned).all():
        crowd.lanes = None
        for vehicle in vehicles:
            vehicle.on_state_update()
        return frame
    keys, lanes, closest = network.keys, network.lanes, _closest(frame, turned)
    for vehicle, lane in zip(vehicles, closest, strict=True):
        vehicle.lane_index = keys[lane]
        vehicle.lane = lanes[lane]
    crowd.lanes = np.array(closest)
    return frame


def as_numpy(vehicles: list[Vehicle]) -> None:
    """Convert headings to NumPy floats, which they are after a step of highway-env."""
    for vehicle in vehicles:
        if type(vehicle.heading) is float:
            vehicle.heading = np.float64(vehicle.heading)


def _slide(vehicle: Vehicle, dt: float) -> None:
    """Move a vehicle by its own model, without the search for its lane, which `move` does for all vehicles."""
    road, vehicle.road = vehicle.road, None
    try:
        vehicle.step(dt)
    finally:
        vehicle.road = road


def _write(crowd: Crowd, places: NDArray[np.float64], headings: list[float], speeds: list[float]) -> None:
    """Write the new state into the vehicles; push vehicles that were hit, and update their rows in ``places``."""
    for row, (vehicle, (x, y)) in enumerate(zip(crowd.vehicles, places[: len(headings)].tolist(), strict=True)):
        if row in crowd.sliding:
            continue
        position = vehicle.position
        position[0] = x
        position[1] = y
        if vehicle.impact is not None:
            vehicle.position += vehicle.impact
            vehicle.crashed = True
            vehicle.impact = None
            places[row] = vehicle.position
        vehicle.heading = headings[row]
        vehicle.speed = speeds[row]


def _clip_all(crowd: Crowd, acts: list[float], speed: NDArray[np.float64]) -> None:
    """Apply `Vehicle.clip_actions` where it has an effect, except to vehicles with their own dynamic model."""
    vehicles, numbers, count = crowd.vehicles, crowd.numbers, len(crowd.vehicles)
    over = (speed > numbers["MAX_SPEED"][:count]) | (speed < numbers["MIN_SPEED"][:count])
    rows = {*np.flatnonzero(over).tolist(), *[row for row, vehicle in enumerate(vehicles) if vehicle.crashed]}
    if not _FLOATS.issuperset(map(type, acts)):
        rows.update([number % count for number, act in enumerate(acts) if type(act) is not float])
    for row in rows.difference(crowd.sliding):
        _clip_actions(vehicles[row])
        acts[row], acts[row + count] = vehicles[row].action["steering"], vehicles[row].action["acceleration"]
        if type(acts[row + count]) is np.float64:
            crowd.of_numpy.add(row)


def _clip_actions(vehicle: Vehicle) -> None:
    """Do what `Vehicle.clip_actions` does."""
    action, speed = vehicle.action, vehicle.speed
    if vehicle.crashed:
        action["steering"] = 0
        action["acceleration"] = -1.0 * speed
    action["steering"] = float(action["steering"])
    action["acceleration"] = float(action["acceleration"])
    if speed > vehicle.MAX_SPEED:
        action["acceleration"] = min(action["acceleration"], 1.0 * (vehicle.MAX_SPEED - speed))
    elif speed < vehicle.MIN_SPEED:
        action["acceleration"] = max(action["acceleration"], 1.0 * (vehicle.MIN_SPEED - speed))


def _closest(frame: Frame, heading: NDArray[np.float64]) -> list[int]:
    """Return the number of the closest lane of every vehicle, as by `RoadNetwork.get_closest_lane_index`."""
    network = frame.network
    count = len(heading)
    best = [math.inf] * count
    nearest: list[int] = [-1] * count
    if len(network.axis):
        s, r = frame.on_axis
        s, r = s[:count], r[:count]
        angle = np.abs(wrap_to_pi(heading[:, None] - network.headings))
        distance = np.abs(r) + np.maximum(s - network.length, 0) + np.maximum(0 - s, 0) + 1.0 * angle
        columns = distance.argmin(axis=1)
        nearest = network.axis[columns].tolist()
        if not network.others:
            return nearest
        best = distance[np.arange(count), columns].tolist()
    headings, boxes = heading.tolist(), frame.boxes[:count]
    vehicles = frame.road.vehicles
    for row in range(count):
        found, lane = best[row], nearest[row]
        last = network.number.get(id(vehicles[row].lane), -1)
        if last >= 0 and not network.is_axis[last]:  # a vehicle is mostly still on its last lane
            found, lane = min((found, lane), (_distance(frame, row, last, headings[row]), last))
        for column in np.flatnonzero(boxes[row] <= found).tolist():
            other = network.others[column]
            if other != last:
                found, lane = min((found, lane), (_distance(frame, row, other, headings[row]), other))
        nearest[row] = lane
    return nearest


def _distance(frame: Frame, row: int, lane: int, heading: float) -> float:
    return frame.network.distance(lane, *frame.coordinates(row, lane), heading)


def collide(road: Road, dt: float, crowd: Crowd) -> bool:
    """Check all pairs of objects for collisions, as `Road.step` does, but skip the pairs that cannot touch.

    Returns:
        Whether the accelerator knows how all objects collide. Otherwise highway-env's own code has checked all pairs.
    """
    pairs = crowd.pairs if crowd.collides else None
    if pairs is None:
        collide_one_by_one(road, dt)
        return False
    asked, apart = pairs
    (x, y), count = crowd.places.T, len(crowd.vehicles)
    dx, dy = x - x[:count, None], y - y[:count, None]
    reach = np.maximum(apart + crowd.speeds[:count, None] * dt, 0.0) + _MARGIN
    squared = dx * dx + dy * dy
    near = asked & (squared <= reach * reach)
    if not np.isfinite(squared).all():
        near |= asked & ~(np.isfinite(dx) & np.isfinite(dy))
    if near.any():
        for first, second in np.argwhere(near).tolist():
            one, two = crowd.vehicles[first], crowd.things[second]
            if not _stay_apart(one, two, dt):
                one.handle_collisions(two, dt)
    return True


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


def _stay_apart(one: RoadObject, two: RoadObject, dt: float) -> bool:
    """Whether an axis separates the outlines of two objects with certainty, now and during the sub-step."""
    (x, y), (other_x, other_y) = one.position.tolist(), two.position.tolist()
    dx, dy = other_x - x, other_y - y
    first, second = float(one.heading), float(two.heading)
    c1, s1, c2, s2 = math.cos(first), math.sin(first), math.cos(second), math.sin(second)
    length, width, other_length, other_width = one.LENGTH / 2, one.WIDTH / 2, two.LENGTH / 2, two.WIDTH / 2
    vx, vy = (one.speed * c1 - two.speed * c2) * dt, (one.speed * s1 - two.speed * s2) * dt
    along, across = abs(c1 * c2 + s1 * s2), abs(c1 * s2 - s1 * c2)
    for nx, ny, reach in (
        (-s1, c1, width + other_length * across + other_width * along),
        (c1, s1, length + other_length * along + other_width * across),
        (-s2, c2, other_width + length * across + width * along),
        (c2, s2, other_length + length * along + width * across),
    ):
        place, towards = dx * nx + dy * ny, vx * nx + vy * ny
        if place < 0:
            place, towards = -place, -towards
        if place - reach - max(towards, 0.0) > _MARGIN:
            return True
    return False


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
        near = (offset * offset).sum(axis=2) <= (one.LENGTH + _MARGIN) ** 2
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
