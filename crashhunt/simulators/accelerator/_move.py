"""How vehicles move and collide: `Road.step`, and the rules of an intersection."""

from __future__ import annotations

import math
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from highway_env import utils
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle

from crashhunt.simulators.accelerator._frame import Frame, are_plain
from crashhunt.simulators.accelerator._known import are_numbers, kinds_of
from crashhunt.simulators.accelerator._network import wrap_to_pi

if TYPE_CHECKING:
    from highway_env.road.regulation import RegulatedRoad
    from highway_env.road.road import Road
    from highway_env.vehicle.kinematics import Vehicle
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.simulators.accelerator._network import Network

    Path = tuple[list[NDArray[np.float64]], list[float]]  # positions and headings that are predicted

__all__ = ["collide", "enforce", "move"]

_OUTLINE = attrgetter("LENGTH", "WIDTH", "heading", "speed", "diagonal")
_MARGIN = 1e-6  # m; what is nearer than this is left to the exact test


def move(road: Road, network: Network, dt: float) -> Frame | None:
    """Move all vehicles; return where they are then, or None where one of them is not known and nothing was done."""
    vehicles = road.vehicles
    kinds = kinds_of(vehicles)
    if road.record_history or not vehicles or not are_plain(vehicles + road.objects):
        return None
    if not all(
        kind.moves and kind.is_of(vehicle) and vehicle.road is road and type(vehicle.action) is dict
        for kind, vehicle in zip(kinds, vehicles, strict=True)
    ):
        return None
    headings, speeds = [vehicle.heading for vehicle in vehicles], [vehicle.speed for vehicle in vehicles]
    lengths = [vehicle.LENGTH for vehicle in vehicles]
    acts = [vehicle.action.get(name) for vehicle in vehicles for name in ("steering", "acceleration")]
    if not are_numbers((dt, *headings, *speeds, *lengths, *acts)) or 2 * len({id(v.action) for v in vehicles}) < len(
        acts
    ):
        return None
    for kind, vehicle in zip(kinds, vehicles, strict=True):
        if kind.times:
            vehicle.timer += dt
        _clip_actions(vehicle)
    heading, speed = np.array(headings, float), np.array(speeds, float)
    steering = np.array([vehicle.action["steering"] for vehicle in vehicles])
    half_length = np.array(lengths) / 2
    slip = np.arctan(1 / 2 * np.tan(steering))
    course = heading + slip
    dx, dy = ((speed * np.cos(course)) * dt).tolist(), ((speed * np.sin(course)) * dt).tolist()
    turned = heading + speed * np.sin(slip) / half_length * dt
    for row, vehicle in enumerate(vehicles):
        position = vehicle.position
        position[0] += dx[row]
        position[1] += dy[row]
        if vehicle.impact is not None:
            vehicle.position += vehicle.impact
            vehicle.crashed = True
            vehicle.impact = None
        vehicle.heading = turned[row]
        vehicle.speed += vehicle.action["acceleration"] * dt
    frame = Frame(network, road)
    if not np.isfinite(frame.places).all() or not np.isfinite(turned).all():
        for vehicle in vehicles:
            vehicle.on_state_update()
        return frame
    for vehicle, lane in zip(vehicles, _closest(frame, turned), strict=True):
        vehicle.lane_index = network.keys[lane]
        vehicle.lane = network.lanes[lane]
    return frame


def _clip_actions(vehicle: Vehicle) -> None:
    """`Vehicle.clip_actions`."""
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
    """`RoadNetwork.get_closest_lane_index` of every vehicle."""
    network = frame.network
    count = len(heading)
    best, nearest = [math.inf] * count, [-1] * count
    if len(network.axis):
        s, r = frame.on_axis
        s, r = s[:count], r[:count]
        angle = np.abs(wrap_to_pi(heading[:, None] - network.heading))
        distance = np.abs(r) + np.maximum(s - network.length, 0) + np.maximum(0 - s, 0) + 1.0 * angle
        columns = distance.argmin(axis=1)
        best = distance[np.arange(count), columns].tolist()
        nearest = network.axis[columns].tolist()
    if not network.others:
        return nearest
    headings, boxes = heading.tolist(), frame.boxes[:count]
    vehicles = frame.road.vehicles
    for row in range(count):
        found, lane = best[row], nearest[row]
        last = network.number.get(id(vehicles[row].lane), -1)
        if last >= 0 and not network.is_axis[last]:  # where it was is where it is, most of the time
            found, lane = min((found, lane), (_distance(frame, row, last, headings[row]), last))
        for column in np.flatnonzero(boxes[row] <= found).tolist():
            other = network.others[column]
            if other != last:
                found, lane = min((found, lane), (_distance(frame, row, other, headings[row]), other))
        nearest[row] = lane
    return nearest


def _distance(frame: Frame, row: int, lane: int, heading: float) -> float:
    return frame.network.distance(lane, *frame.coordinates(row, lane), heading)


def collide(road: Road, dt: float) -> None:
    """Let everybody collide with everybody, as `Road.step` does, but without the pairs that cannot touch."""
    vehicles, things = road.vehicles, road.vehicles + road.objects
    if not _can_collide(things):
        for number, vehicle in enumerate(road.vehicles):
            for other in road.vehicles[number + 1 :]:
                vehicle.handle_collisions(other, dt)
            for other in road.objects:
                vehicle.handle_collisions(other, dt)
        return
    count = len(vehicles)
    places = np.array([thing.position for thing in things], float).reshape(-1, 2)
    radius = np.array([thing.diagonal for thing in things], float) / 2
    checks = np.array([thing.check_collisions for thing in things], bool)
    ghosts = np.array([not thing.collidable for thing in things], bool)
    speed = np.array([vehicle.speed for vehicle in vehicles], float)
    # Of two that neither of them look for collisions, nothing is asked.
    rows = np.arange(len(things))
    first, second = np.nonzero((rows > rows[:count, None]) & (checks | checks[:count, None]))
    offset = places[second] - places[first]
    reach = np.maximum(radius[first] + radius[second] + speed[first] * dt, 0.0) + _MARGIN
    near = offset[:, 0] * offset[:, 0] + offset[:, 1] * offset[:, 1] <= reach * reach
    near &= ~(ghosts[first] | ghosts[second])
    near |= ~np.isfinite(offset).all(axis=1)
    for number in np.flatnonzero(near).tolist():
        one, two = vehicles[first[number]], things[second[number]]
        if not _stay_apart(one, two, dt):
            one.handle_collisions(two, dt)


def _can_collide(things: list[RoadObject]) -> bool:
    """Whether all collide as highway-env has it, and all that this depends on are numbers of the usual kinds."""
    if not all(kind.collides and kind.is_of(thing) for kind, thing in zip(kinds_of(things), things, strict=True)):
        return False
    try:
        return are_plain(things) and are_numbers(chain.from_iterable(map(_OUTLINE, things)))
    except AttributeError:  # highway-env may never ask for what somebody's object lacks
        return False


def _stay_apart(one: RoadObject, two: RoadObject, dt: float) -> bool:
    """Whether some axis surely separates two outlines, now and until the next moment."""
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
    """`RegulatedRoad.enforce_road_rules`, foreseeing each vehicle once; False where one is not known."""
    vehicles = road.vehicles
    if not all(
        kind.predicts and kind.is_of(vehicle) for kind, vehicle in zip(kinds_of(vehicles), vehicles, strict=True)
    ):
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
    foreseen = [vehicle.predict_trajectory_constant_speed(times) for vehicle in vehicles]
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


def _conflict(one: Vehicle, two: Vehicle, first: Path, second: Path) -> bool:
    """The rest of `RegulatedRoad.is_conflict_possible`."""
    for place, heading, other_place, other_heading in zip(*first, *second, strict=False):
        if np.linalg.norm(other_place - place) > one.LENGTH:
            continue
        if utils.rotated_rectangles_intersect(
            (place, 1.5 * one.LENGTH, 0.9 * one.WIDTH, heading),
            (other_place, 1.5 * two.LENGTH, 0.9 * two.WIDTH, other_heading),
        ):
            return True
    return False
