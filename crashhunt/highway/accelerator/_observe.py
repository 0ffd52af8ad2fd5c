"""Observations: `KinematicObservation.observe` and similar methods without data frames; search for close objects."""

from __future__ import annotations

import math
from array import array
from collections import OrderedDict
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from highway_env import utils
from highway_env.road.lane import AbstractLane
from highway_env.vehicle.kinematics import Vehicle

from crashhunt.highway.accelerator._kernel_objects import are_plain
from crashhunt.highway.accelerator._supported import are_numbers, kind_of, kinds_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from highway_env.envs.common.abstract import AbstractEnv
    from highway_env.envs.common.observation import (
        ExitObservation,
        KinematicObservation,
        KinematicsGoalObservation,
        OccupancyGridObservation,
    )
    from highway_env.vehicle.controller import MDPVehicle
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.highway.accelerator._lane_network import Network
    from crashhunt.highway.accelerator._roads import RoadState


_CODES = {name: code for code, name in enumerate(("presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h"))}
"""The features in the order of the kernel."""
_LANE_FEATURES = ("long_off", "lat_off", "ang_off")
_DESTINATION_FEATURES = ("cos_d", "sin_d")
_UNCOMPILED_FEATURES = frozenset((*_LANE_FEATURES, *_DESTINATION_FEATURES))
"""The features that highway-env's own code computes."""
_KNOWN_FEATURES = _UNCOMPILED_FEATURES.union(_CODES)


def close_objects(
    state: RoadState,
    vehicle: Vehicle,
    distance: float,
    count: int | None,
    *,
    see_behind: bool,
    sort: bool,
    vehicles_only: bool,
) -> list[RoadObject] | None:
    """Return the result of `Road.close_objects_to`; None if highway-env's own code must run."""
    if not are_numbers((distance,)):
        return None
    found = state.traffic.close_objects_to(vehicle, distance, see_behind, sort, vehicles_only)
    return found[:count] if found and count else found


def observe(kinematic: KinematicObservation, state: RoadState | None) -> NDArray[np.generic] | None:
    """Return the result of `KinematicObservation.observe`; None if highway-env's own code must run."""
    close = _close_to_observer(
        kinematic, state, sort=kinematic.order == "sorted", vehicles_only=not kinematic.include_obstacles
    )
    return None if state is None or close is None else _visible_rows(kinematic, state, close)


def observe_exit(kinematic: ExitObservation, state: RoadState | None) -> NDArray[np.generic] | None:
    """Return the result of `ExitObservation.observe`; None if highway-env's own code must run."""
    close = _close_to_observer(kinematic, state, sort=True, vehicles_only=True)
    if state is None or close is None:
        return None
    lane = state.owner.road.network.get_lane(("1", "2", -1))
    before_exit = lane.local_coordinates(kinematic.observer_vehicle.position)[0]
    return _visible_rows(kinematic, state, close, {"x": float(before_exit)})


def _close_to_observer(
    kinematic: KinematicObservation, state: RoadState | None, *, sort: bool, vehicles_only: bool
) -> list[RoadObject] | None:
    """Return the objects that an observation shows; None if highway-env's own code must run."""
    rows, distance = kinematic.vehicles_count, kinematic.env.PERCEPTION_DISTANCE
    if state is None or not state.roster.describes or type(rows) is not int or rows < 2:
        return None
    see_behind = kinematic.see_behind
    return close_objects(
        state, kinematic.observer_vehicle, distance, rows - 1, see_behind=see_behind, sort=sort,
        vehicles_only=vehicles_only,
    )  # fmt: skip


def _visible_rows(
    kinematic: KinematicObservation,
    state: RoadState,
    close: list[RoadObject],
    replaced: Mapping[str, float] = MappingProxyType({}),
) -> NDArray[np.generic] | None:
    """Return the rows of the agent and of close objects; None if highway-env's own code must run.

    ``replaced`` has features that replace the agent's own.
    """
    features, vehicle = kinematic.features, kinematic.observer_vehicle
    if not _are_known(features):
        return None
    late = _UNCOMPILED_FEATURES.intersection(features)
    if late and not all(isinstance(thing, Vehicle) for thing in close):
        return None
    ranges = (kinematic.features_range or _default_ranges(kinematic)) if kinematic.normalize else {}
    scales = _scales_of(features, ranges)
    if scales is None:
        return None
    shown = np.zeros((kinematic.vehicles_count, len(features)))
    codes = bytes([_CODES.get(name, 0) for name in features])
    clip, things = bool(kinematic.clip), [vehicle, *close]
    absolute = len(things) if kinematic.absolute else 1
    if not state.traffic.describe(shown, things, absolute, codes, scales, clip):
        return None
    if kinematic.normalize:
        kinematic.features_range = ranges
    if late or replaced:
        _fill_in(kinematic, shown, things, late, replaced)
    if kinematic.order == "shuffled":
        kinematic.env.np_random.shuffle(shown[1:])
    return shown.astype(np.float32)


def _fill_in(
    kinematic: KinematicObservation,
    shown: NDArray[np.float64],
    things: list[Vehicle],
    late: frozenset[str],
    replaced: Mapping[str, float],
) -> None:
    """Write the features that the kernel does not know into the rows of vehicles, and those that replace others."""
    features, ranges = kinematic.features, kinematic.features_range if kinematic.normalize else {}
    values = {(0, name): value for name, value in replaced.items() if name in features}
    for row, thing in enumerate(things if late else ()):
        found = _late_values(thing, with_destination=row == 0 or kinematic.observe_intentions)
        values |= {(row, name): found[name] for name in late}
    for (row, name), value in values.items():
        scaled = value
        if name in ranges:
            scaled = utils.lmap(np.float64(value), [ranges[name][0], ranges[name][1]], [-1, 1])
            scaled = np.clip(scaled, -1, 1) if kinematic.clip else scaled
        shown[row, features.index(name)] = scaled


def _late_values(thing: Vehicle, *, with_destination: bool) -> dict[str, float]:
    """Return the features of a vehicle's lane and destination, which only highway-env's own code computes."""
    destination = thing.destination_direction.tolist() if with_destination else (0.0, 0.0)
    return dict(
        zip((*_LANE_FEATURES, *_DESTINATION_FEATURES), (*thing.lane_offset.tolist(), *destination), strict=True)
    )


def _scales_of(features: list[str], ranges: object) -> array[float] | None:
    """Return the kernel's scales of features; None if a range is unusual."""
    if type(ranges) is not dict:
        return None
    scales = array("d", bytes(16 * len(features)))
    for name, limits in ranges.items():
        if name in features:
            low, high = limits[0], limits[1]
            if not are_numbers((low, high)) or not math.isfinite(high - low) or high == low:
                return None
            column = 2 * features.index(name)
            scales[column], scales[column + 1] = low, high - low
    return scales


def observe_goal(kinematic: KinematicsGoalObservation) -> dict[str, NDArray[np.float64]] | None:
    """Return the result of `KinematicsGoalObservation.observe`; None if highway-env's own code must run.

    A step observes three times, so only the vehicle and its goal are read, and not the road.
    """
    vehicle, features = kinematic.observer_vehicle, kinematic.features
    goal = getattr(vehicle, "goal", None)
    if vehicle is None or goal is None or type(features) is not list or not _CODES.keys() >= set(features):
        return None
    things = [vehicle, goal]
    kinds = kinds_of(things)
    if not are_plain(things, kinds) or not all(
        kind.describes and kind.is_of(thing) and are_numbers((thing.heading, thing.speed))
        # `to_dict` would compute the destination of a route, which may fail. It has no heading of a goal.
        and not getattr(thing, "route", None) and (isinstance(thing, Vehicle) or "heading" not in features)
        for thing, kind in zip(things, kinds, strict=True)
    ):  # fmt: skip
        return None
    here, there = (np.array([values[name] for name in features]) for values in map(_vehicle_values, things))
    scales = kinematic.scales
    return OrderedDict(observation=here / scales, achieved_goal=here / scales, desired_goal=there / scales)


def _vehicle_values(thing: RoadObject) -> dict[str, float]:
    """Return those values of highway-env's `to_dict` that the kernel knows."""
    (x, y), heading = thing.position.tolist(), float(thing.heading)
    c, s = float(np.cos(thing.heading)), float(np.sin(thing.heading))
    vx, vy = (float(thing.speed) * c, float(thing.speed) * s) if isinstance(thing, Vehicle) else (0.0, 0.0)
    return {"presence": 1.0, "x": x, "y": y, "vx": vx, "vy": vy, "heading": heading, "cos_h": c, "sin_h": s}


def observe_grid(grid: OccupancyGridObservation, state: RoadState | None) -> NDArray[np.generic] | None:
    """Return the result of `OccupancyGridObservation.observe`; None if highway-env's own code must run.

    The features of all vehicles are normalized in one array, without a data frame. highway-env writes the vehicles in
    reverse order, so that the first vehicle in a cell remains.
    """
    observer, features = grid.observer_vehicle, grid.features
    shown = [name for name in features if name != "on_road"] if type(features) is list else None
    if state is None or not state.roster.describes or observer is None or grid.absolute or shown is None:
        return None
    vehicles = grid.env.road.vehicles
    if not vehicles or not _CODES.keys() >= set(shown):
        return None
    ranges = grid.features_range or {
        "vx": [-2 * Vehicle.MAX_SPEED, 2 * Vehicle.MAX_SPEED],
        "vy": [-2 * Vehicle.MAX_SPEED, 2 * Vehicle.MAX_SPEED],
    }
    names = list(dict.fromkeys((*shown, "x", "y")))
    scales = _scales_of(names, ranges)
    if scales is None or not _UNCOMPILED_FEATURES.isdisjoint(ranges):
        return None
    table = np.zeros((1 + len(vehicles), len(names)))
    codes = bytes(map(_CODES.__getitem__, names))
    if not state.traffic.describe(table, [observer, *vehicles], 1, codes, scales, False):
        return None
    columns = dict(zip(names, table[1:].T, strict=True))
    places = [
        utils.lmap(columns[name], [-1, 1], [ranges[name][0], ranges[name][1]]) if name in ranges else columns[name]
        for name in ("x", "y")
    ]
    if not np.isfinite(places).all():
        return None
    grid.features_range = ranges
    _fill_cells(grid, columns, places)
    found = grid.grid
    if grid.clip:
        found = np.clip(found, -1, 1)
    if grid.as_image:
        found = ((np.clip(found, -1, 1) + 1) / 2 * 255).astype(np.uint8)
    seen: NDArray[np.generic] = np.nan_to_num(found).astype(np.uint8 if grid.as_image else np.float32)
    return seen


def _fill_cells(
    grid: OccupancyGridObservation, columns: dict[str, NDArray[np.float64]], places: list[NDArray[np.float64]]
) -> None:
    """Write the features of vehicles into the cells in which the vehicles are."""
    grid.grid.fill(np.nan)
    width, height = grid.grid.shape[-2:]
    cells = [grid.pos_to_index(place, relative=True) for place in zip(*places, strict=True)]
    for layer, name in enumerate(grid.features):
        if name == "on_road":
            grid.fill_road_layer_by_lanes(layer)
            continue
        for (first, second), value in zip(reversed(cells), reversed(columns[name].tolist()), strict=True):
            if 0 <= first < width and 0 <= second < height:
                grid.grid[layer, first, second] = value


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


def _default_ranges(kinematic: KinematicObservation) -> dict[str, list[float]]:
    side = kinematic.env.road.network.all_side_lanes(kinematic.observer_vehicle.lane_index)
    width = AbstractLane.DEFAULT_WIDTH * len(side)
    return {
        "x": [-5.0 * Vehicle.MAX_SPEED, 5.0 * Vehicle.MAX_SPEED],
        "y": [-width, width],
        "vx": [-2 * Vehicle.MAX_SPEED, 2 * Vehicle.MAX_SPEED],
        "vy": [-2 * Vehicle.MAX_SPEED, 2 * Vehicle.MAX_SPEED],
    }
