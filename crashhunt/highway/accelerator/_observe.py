"""Observations: `KinematicObservation.observe` and similar methods without data frames; search for close objects."""

from __future__ import annotations

import math
from array import array
from collections import OrderedDict
from typing import TYPE_CHECKING

import numpy as np
from highway_env import utils
from highway_env.road.lane import AbstractLane
from highway_env.vehicle.kinematics import Vehicle

from crashhunt.highway.accelerator._frames import TrafficFrame, are_plain
from crashhunt.highway.accelerator._supported import are_numbers, kind_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from highway_env.envs.common.abstract import AbstractEnv
    from highway_env.envs.common.observation import (
        ExitObservation,
        KinematicObservation,
        KinematicsGoalObservation,
        OccupancyGridObservation,
    )
    from highway_env.road.road import Road
    from highway_env.vehicle.controller import MDPVehicle
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.highway.accelerator._lane_network import Network
    from crashhunt.highway.accelerator._roads import RoadState


_BASIC_FEATURES = frozenset(("presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h"))
_LANE_FEATURES = ("long_off", "lat_off", "ang_off")
_DESTINATION_FEATURES = ("cos_d", "sin_d")
_UNCOMPILED_FEATURES = frozenset(
    (*_LANE_FEATURES, *_DESTINATION_FEATURES)
)  # highway-env's own code computes them, if they are shown
_KNOWN_FEATURES = _BASIC_FEATURES | _UNCOMPILED_FEATURES
_SORTED_BASIC_FEATURES = sorted(_BASIC_FEATURES)
_CODES = {name: code for code, name in enumerate(("presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h"))}
"""The features in the order of the kernel."""
_OBJECT_FEATURES = _BASIC_FEATURES - {"heading"}


def close_objects(
    frame: TrafficFrame,
    vehicle: Vehicle,
    distance: float,
    count: int | None,
    *,
    see_behind: bool,
    sort: bool,
    vehicles_only: bool,
) -> list[RoadObject] | None:
    """Return the result of `Road.close_objects_to`; None if highway-env's own code must run."""
    lane = frame.network.number.get(id(vehicle.lane))
    row = frame.row.get(id(vehicle))
    kind = kind_of(type(vehicle))
    if lane is None or row is None or not kind.collides or not kind.is_of(vehicle):
        return None
    road: Road = frame.road
    total = len(road.vehicles) if vehicles_only else len(frame.things)
    offset = frame.places[:total] - frame.places[row]
    squared = offset[:, 0] * offset[:, 0] + offset[:, 1] * offset[:, 1]
    limit = -2 * vehicle.LENGTH
    own = frame.coordinates(row, lane)[0]
    found: list[tuple[float, int]] = []
    for number in np.flatnonzero(squared <= (distance + 1e-3) ** 2).tolist():
        if number == row or not np.linalg.norm(offset[number]) < distance:
            continue
        ahead = frame.coordinates(number, lane)[0] - own
        if (number < len(road.vehicles) and see_behind) or limit < ahead:
            found.append((abs(ahead), number))
    if sort:
        found.sort(key=lambda item: item[0])
    if count:
        found = found[:count]
    return [frame.things[number] for _, number in found]


def observe_in_kernel(kinematic: KinematicObservation, state: RoadState) -> NDArray[np.generic] | None:
    """Return the result of `KinematicObservation.observe`; None if the kernel does not know a part of it."""
    features, rows, env = kinematic.features, kinematic.vehicles_count, kinematic.env
    if not _are_known(features) or not _BASIC_FEATURES.issuperset(features) or not state.roster.describes:
        return None
    if type(rows) is not int or rows < 2 or not are_numbers((env.PERCEPTION_DISTANCE,)):
        return None
    ranges = kinematic.features_range
    if kinematic.normalize:
        ranges = ranges or _default_ranges(kinematic)
        if type(ranges) is not dict:
            return None
    scales = array("d", bytes(16 * len(features)))
    for name, limits in ranges.items() if kinematic.normalize else ():
        if name in features:
            low, high = limits[0], limits[1]
            if not are_numbers((low, high)) or not math.isfinite(high - low) or high == low:
                return None
            column = 2 * features.index(name)
            scales[column], scales[column + 1] = low, high - low
    shown = np.zeros((rows, len(features)))
    found = state.traffic.observe(
        shown,
        kinematic.observer_vehicle,
        bytes(map(_CODES.__getitem__, features)),
        scales,
        env.PERCEPTION_DISTANCE,
        kinematic.see_behind,
        kinematic.order == "sorted",
        kinematic.include_obstacles,
        kinematic.absolute,
        kinematic.clip,
    )
    if found is None:
        return None
    kinematic.features_range = ranges
    if kinematic.order == "shuffled":
        env.np_random.shuffle(shown[1:])
    return shown.astype(np.float32)


def observe(kinematic: KinematicObservation, frame: TrafficFrame | None) -> NDArray[np.generic] | None:
    """Return the result of `KinematicObservation.observe`; None if highway-env's own code must run."""
    env, vehicle = kinematic.env, kinematic.observer_vehicle
    if frame is None or not _is_known(kinematic):
        return None
    close = env.road.close_objects_to(
        vehicle,
        env.PERCEPTION_DISTANCE,
        count=kinematic.vehicles_count - 1,
        see_behind=kinematic.see_behind,
        sort=kinematic.order == "sorted",
        vehicles_only=not kinematic.include_obstacles,
    )
    shown = _visible_rows(kinematic, frame, close, {})
    return None if shown is None else shown.astype(np.float32)


def observe_exit(kinematic: ExitObservation, frame: TrafficFrame | None) -> NDArray[np.generic] | None:
    """Return the result of `ExitObservation.observe`; None if highway-env's own code must run."""
    env, vehicle = kinematic.env, kinematic.observer_vehicle
    if frame is None or not env.road or not _is_known(kinematic):
        return None
    before_exit = env.road.network.get_lane(("1", "2", -1)).local_coordinates(vehicle.position)[0]
    close = env.road.close_vehicles_to(
        vehicle, env.PERCEPTION_DISTANCE, count=kinematic.vehicles_count - 1, see_behind=kinematic.see_behind
    )
    shown = _visible_rows(kinematic, frame, close, {"x": float(before_exit)})
    return None if shown is None else shown.astype(kinematic.space().dtype)


def _is_known(kinematic: KinematicObservation) -> bool:
    return _are_known(kinematic.features) and _is_plain(kinematic.observer_vehicle, kinematic.features)


def _visible_rows(
    kinematic: KinematicObservation, frame: TrafficFrame, close: list[RoadObject], replaced: dict[str, float]
) -> NDArray[np.float64] | None:
    """Return the rows of the agent and of close objects; None if highway-env's own code must run.

    The close objects come nearest first; if there are too many, only the last ones are used. ``replaced`` has features
    that replace the agent's own.
    """
    vehicle, features = kinematic.observer_vehicle, kinematic.features
    close = close[-kinematic.vehicles_count + 1 :]
    if not all(_is_plain(thing, features) and _arrives(thing, frame.network) for thing in (vehicle, *close)):
        return None
    late = _UNCOMPILED_FEATURES.intersection(features)
    own = _vehicle_values(vehicle, late)
    rows = [own | replaced]
    for thing in close:
        values = _vehicle_values(thing, late)
        if not kinematic.absolute:
            for name in ("x", "y", "vx", "vy"):
                values[name] -= own[name]
        if not kinematic.observe_intentions:
            values |= dict.fromkeys(_DESTINATION_FEATURES, 0.0)
        rows.append(values)
    shown = np.zeros((max(len(rows), kinematic.vehicles_count), len(features)))
    for column, name in enumerate(features):
        shown[: len(rows), column] = [values[name] for values in rows]
    if kinematic.normalize:
        _normalize(kinematic, shown, len(rows))
    if kinematic.order == "shuffled":
        kinematic.env.np_random.shuffle(shown[1:])
    return shown


def observe_goal(kinematic: KinematicsGoalObservation) -> dict[str, NDArray[np.float64]] | None:
    """Return the result of `KinematicsGoalObservation.observe`; None if highway-env's own code must run."""
    vehicle, features = kinematic.observer_vehicle, kinematic.features
    goal = getattr(vehicle, "goal", None)
    if vehicle is None or goal is None or type(features) is not list or not _BASIC_FEATURES.issuperset(features):
        return None
    things = [vehicle, goal]
    if not are_plain(things) or not all(_is_plain(thing, features) for thing in things):
        return None
    if any(
        getattr(thing, "route", None) for thing in things
    ):  # `to_dict` would compute the destination, which may fail
        return None
    here, there = (
        np.array([values[name] for name in features]) for values in (_vehicle_values(vehicle), _vehicle_values(goal))
    )
    scales = kinematic.scales
    return OrderedDict(observation=here / scales, achieved_goal=here / scales, desired_goal=there / scales)


def observe_grid(grid: OccupancyGridObservation, frame: TrafficFrame | None) -> NDArray[np.generic] | None:
    """Return the result of `OccupancyGridObservation.observe`; None if highway-env's own code must run.

    The features of all vehicles are normalized in one array, without a data frame. highway-env writes the vehicles in
    reverse order, so that the first vehicle in a cell remains.
    """
    observer, features = grid.observer_vehicle, grid.features
    shown = [name for name in features if name != "on_road"] if type(features) is list else None
    if frame is None or grid.absolute or shown is None or not _BASIC_FEATURES.issuperset(shown):
        return None
    vehicles = grid.env.road.vehicles
    if observer is None or not vehicles or type(observer.position) is not np.ndarray:
        return None
    if not all(
        _is_plain(thing, _SORTED_BASIC_FEATURES) and _arrives(thing, frame.network) for thing in (observer, *vehicles)
    ):
        return None
    own = _vehicle_values(observer)
    columns = {
        name: np.array([values[name] for values in map(_vehicle_values, vehicles)]) for name in _SORTED_BASIC_FEATURES
    }
    for name in ("x", "y", "vx", "vy"):
        columns[name] = columns[name] - own[name]
    ranges = grid.features_range or {
        "vx": [-2 * Vehicle.MAX_SPEED, 2 * Vehicle.MAX_SPEED],
        "vy": [-2 * Vehicle.MAX_SPEED, 2 * Vehicle.MAX_SPEED],
    }
    if type(ranges) is not dict or not _UNCOMPILED_FEATURES.isdisjoint(ranges):
        return None
    for name, limits in ranges.items():
        if name in columns:
            columns[name] = utils.lmap(columns[name], [limits[0], limits[1]], [-1, 1])
    places = [
        utils.lmap(columns[name], [-1, 1], [ranges[name][0], ranges[name][1]]) if name in ranges else columns[name]
        for name in ("x", "y")
    ]
    if not np.isfinite(places).all():
        return None
    grid.features_range = ranges
    grid.grid.fill(np.nan)
    width, height = grid.grid.shape[-2:]
    cells = [grid.pos_to_index(place, relative=True) for place in zip(*places, strict=True)] if shown else []
    for layer, name in enumerate(features):
        if name == "on_road":
            grid.fill_road_layer_by_lanes(layer)
            continue
        for (first, second), value in zip(reversed(cells), reversed(columns[name].tolist()), strict=True):
            if 0 <= first < width and 0 <= second < height:
                grid.grid[layer, first, second] = value
    found = grid.grid
    if grid.clip:
        found = np.clip(found, -1, 1)
    if grid.as_image:
        found = ((np.clip(found, -1, 1) + 1) / 2 * 255).astype(np.uint8)
    seen: NDArray[np.generic] = np.nan_to_num(found).astype(np.uint8 if grid.as_image else np.float32)
    return seen


def fill_lanes(grid: OccupancyGridObservation, network: Network, layer: int, reach: float) -> bool:
    """Compute the result of `OccupancyGridObservation.fill_road_layer_by_lanes`, for all lanes together.

    If a point is so near to a cell border that rounding matters, highway-env's own code decides. Lanes are followed for
    ``reach`` m in both directions.

    Returns:
        Whether the layer was filled; False, with nothing changed, if the grid is too large or not finite.
    """
    observer, cells = grid.observer_vehicle, grid.grid.shape[-2:]
    spacing = float(np.amin(grid.grid_step))
    given = (
        observer.position.tolist(),
        (math.cos(observer.heading), math.sin(observer.heading)),
        float(reach),
        spacing,
        grid.grid_size[:, 0].tolist(),
        grid.grid_step.tolist(),
        cells,
        grid.align_to_vehicle_axes,
    )
    try:
        marks, unsure = network.in_kernel(looks_further=False).mark_cells(*map(_as_tuple, given))
    except (OverflowError, TypeError, ValueError):
        return False
    grid.grid[layer][np.frombuffer(marks, bool).reshape(cells)] = 1
    for number, point in unsure:
        first, second = grid.pos_to_index(network.lanes[number].position(point, 0))
        if 0 <= first < cells[0] and 0 <= second < cells[1]:
            grid.grid[layer, first, second] = 1
    return True


def fill_times(
    env: AbstractEnv, state: RoadState, vehicle: MDPVehicle, quantum: float, horizon: float
) -> NDArray[np.float64] | None:
    """Return the result of `compute_ttc_grid`; None if highway-env's own code must run.

    ``quantum`` is the time between two cells, and ``horizon`` that of the last cell, in s.
    """
    network, things = state.owner.network, env.road.vehicles
    kind, speeds = kind_of(type(vehicle)), getattr(vehicle, "target_speeds", None)
    row = next((row for row, thing in enumerate(things) if thing is vehicle), None)
    if row is None or not kind.is_of(vehicle) or not kind.chooses or type(speeds) is not np.ndarray:
        return None
    if speeds.ndim != 1 or speeds.dtype.kind not in "fi" or not np.isfinite(speeds).all():
        return None
    count = len(env.road.network.all_side_lanes(env.vehicle.lane_index))
    own = len(env.road.network.all_side_lanes(vehicle.lane_index))
    relations = bytearray(len(network.keys))
    try:
        for key in {thing.lane_index for thing in things}:
            if env.road.network.is_connected_road(vehicle.lane_index, key, route=vehicle.route, depth=3):
                relations[network.index[key]] = 1 if len(env.road.network.all_side_lanes(key)) == own else 2
    except LookupError:  # highway-env may not get as far as an error in the route
        return None
    grid = np.zeros((speeds.size, count, int(horizon / quantum)))
    lanes, times = grid.shape[1:]
    try:
        state.traffic.fill_times(grid, lanes, times, quantum, row, speeds.astype(float).tobytes(), bytes(relations))
    except ValueError:  # an observer on a wider road than the agent
        return None
    return grid


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _are_known(features: object) -> bool:
    """Return whether there are features, all known and unique; a data frame repeats the column of an equal feature."""
    if type(features) is not list or not features or not _KNOWN_FEATURES.issuperset(features):
        return False
    return len(set(features)) == len(features)


def _arrives(thing: RoadObject, network: Network) -> bool:
    """Return whether the end of a vehicle's route is on the road; otherwise highway-env's `to_dict` fails."""
    route = getattr(thing, "route", None)
    if not route:
        return True
    try:
        start, end, number = route[-1]
        return (start, end, 0 if number is None else number) in network.index
    except (LookupError, TypeError, ValueError):
        return False


def _is_plain(thing: RoadObject, features: list[str]) -> bool:
    kind = kind_of(type(thing))
    if not kind.describes or not kind.is_of(thing) or not are_numbers((thing.heading, thing.speed)):
        return False
    return isinstance(thing, Vehicle) or _OBJECT_FEATURES.issuperset(features)


def _vehicle_values(thing: RoadObject, late: Iterable[str] = ()) -> dict[str, float]:
    """Return those values of highway-env's `to_dict` that observations use.

    ``late`` has the features of the lane and the destination that are shown.
    """
    x, y = thing.position.tolist()
    c, s = float(np.cos(thing.heading)), float(np.sin(thing.heading))
    vx, vy = (float(thing.speed) * c, float(thing.speed) * s) if isinstance(thing, Vehicle) else (0.0, 0.0)
    values = {
        "presence": 1.0,
        "x": x,
        "y": y,
        "vx": vx,
        "vy": vy,
        "heading": float(thing.heading),
        "cos_h": c,
        "sin_h": s,
    }
    if late:
        values |= zip(_LANE_FEATURES, thing.lane_offset.tolist(), strict=True)
        values |= zip(_DESTINATION_FEATURES, thing.destination_direction.tolist(), strict=True)
    return values


def _default_ranges(kinematic: KinematicObservation) -> dict[str, list[float]]:
    side = kinematic.env.road.network.all_side_lanes(kinematic.observer_vehicle.lane_index)
    width = AbstractLane.DEFAULT_WIDTH * len(side)
    return {
        "x": [-5.0 * Vehicle.MAX_SPEED, 5.0 * Vehicle.MAX_SPEED],
        "y": [-width, width],
        "vx": [-2 * Vehicle.MAX_SPEED, 2 * Vehicle.MAX_SPEED],
        "vy": [-2 * Vehicle.MAX_SPEED, 2 * Vehicle.MAX_SPEED],
    }


def _normalize(kinematic: KinematicObservation, shown: NDArray[np.float64], rows: int) -> None:
    if not kinematic.features_range:
        kinematic.features_range = _default_ranges(kinematic)
    for name, limits in kinematic.features_range.items():
        if name in kinematic.features:
            column = kinematic.features.index(name)
            scaled = utils.lmap(shown[:rows, column], [limits[0], limits[1]], [-1, 1])
            shown[:rows, column] = np.clip(scaled, -1, 1) if kinematic.clip else scaled
