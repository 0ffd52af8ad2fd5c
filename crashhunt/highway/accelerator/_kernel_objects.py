"""The vehicles and objects of a road in the compiled kernel, and all their properties that must stay unchanged."""

from __future__ import annotations

import math
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from highway_env.vehicle.objects import Landmark, Obstacle

from crashhunt.highway.accelerator._kernel import Traffic, kernel
from crashhunt.highway.accelerator._supported import NUMBERS_OF, VehicleClass, are_numbers, kinds_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from highway_env.road.road import Road
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.highway.accelerator._lane_network import Network

    Row = tuple[object, ...]


_POLICY_CODES = {"": 0, "nothing": 1, "controlled": 2, "idm": 3, "linear": 4}
_FOREIGN_POLICY_CODE = 5
_PARAMETERS = (
    "LENGTH", "WIDTH", "MAX_SPEED", "MIN_SPEED",
    "TAU_PURSUIT", "KP_LATERAL", "KP_HEADING", "MAX_STEERING_ANGLE", "KP_A",
    "COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED", "TIME_WANTED", "ACC_MAX", "POLITENESS",
    "LANE_CHANGE_DELAY", "LANE_CHANGE_MIN_ACC_GAIN", "LANE_CHANGE_MAX_BRAKING_IMPOSED",
)  # fmt: skip
"""The parameters in the order of the kernel, which adds ``DELTA``."""
_GAP_PARAMETERS = ("COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED", "TIME_WANTED")
_MAX_EXPONENT = 20.0  # with a larger IDM exponent, an acceleration may overflow
_PARAMETER_READERS: dict[str, Callable[[RoadObject], Row]] = {
    how: attrgetter(*names) for how, names in NUMBERS_OF.items()
}
_READ_DELTA = attrgetter("DELTA")
_FLOAT = np.dtype(np.float64)
assert all(_PARAMETERS[: len(names)] == names for names in NUMBERS_OF.values())


class KernelObjects:
    """The vehicles and objects of a road in the kernel, and their properties that must stay unchanged meanwhile.

    Attributes:
        traffic: The vehicles in the kernel; None if the kernel does not know them.
        decides: Whether the kernel knows how all vehicles make decisions.
        moves: Whether the kernel knows how all vehicles move.
        predicts: Whether all vehicles predict their paths with highway-env's own methods.
        describes: Whether all vehicles and objects describe themselves with highway-env's own methods.
        kinds: The properties of the class of each vehicle and object.
    """

    def __init__(self, road: Road, network: Network) -> None:
        things: list[RoadObject] = road.vehicles + road.objects
        kinds = self.kinds = kinds_of(things)
        vehicles = kinds[: len(road.vehicles)]
        self._ids = list(map(id, things))
        self._distinct = list(dict.fromkeys(kinds))
        self._looks_further = road.neighbour_vehicles_connected_lanes
        self.decides = all(kind.drives for kind in vehicles)
        self.moves = all(kind.moves for kind in vehicles)
        self.predicts = all(kind.predicts for kind in vehicles)
        self.describes = all(kind.describes for kind in kinds)
        self.traffic = self._in_kernel(road, things, network)

    def is_of(self, road: Road) -> bool:
        """Return whether the kernel still has the vehicles and objects of a road; their state is not compared."""
        if self._looks_further != road.neighbour_vehicles_connected_lanes:
            return False
        if self.traffic is not None:
            return all(kind.own.current for kind in self._distinct) and self.traffic.is_current(road)
        things = road.vehicles + road.objects
        return self._ids == list(map(id, things)) and self.kinds == kinds_of(things)

    def _in_kernel(self, road: Road, things: list[RoadObject], network: Network) -> Traffic | None:
        module, kinds = kernel(), self.kinds
        if module is None or not all(kind.collides for kind in kinds) or not are_plain(things, kinds):
            return None
        count = len(road.vehicles)
        # Drivers evaluate a vehicle among the objects like a vehicle, which the kernel does not know.
        if not all(vehicle.road is road for vehicle in road.vehicles) or any(kind.base for kind in kinds[count:]):
            return None
        parameters = _read_parameters(things, kinds)
        if parameters is None:
            return None
        models = [_POLICY_CODES[kind.drives] if kind.drives else _FOREIGN_POLICY_CODE for kind in kinds[:count]]
        models += [_POLICY_CODES[""]] * (len(kinds) - count)
        flags = bytes(map(_flags_of, things, kinds))
        lanes = network.in_kernel(looks_further=bool(self._looks_further))
        fixed = [kind.fixed for kind in kinds]
        return module.Traffic(lanes, things, bytes(models), flags, parameters, road, fixed, _examples(things, kinds))


def are_plain(things: list[RoadObject], kinds: list[VehicleClass]) -> bool:
    """Return whether all positions have the usual type, no objects share an array, and no object occurs twice."""
    if not all(kind.plain for kind in kinds):
        return False
    positions = [thing.position for thing in things]
    return len(set(map(id, things))) == len(set(map(id, positions))) == len(things) and all(map(_is_place, positions))


def _is_place(position: NDArray[np.float64]) -> bool:
    # An unpickled array has an equal dtype that is another object.
    is_array = type(position) is np.ndarray and (position.dtype is _FLOAT or position.dtype == _FLOAT)
    return is_array and position.shape == (2,)


def _examples(things: list[RoadObject], kinds: list[VehicleClass]) -> list[tuple[RoadObject, tuple[str, ...]]]:
    """Return the objects with own parameters and one object of each other class, with the names of the parameters."""
    found: list[tuple[RoadObject, tuple[str, ...]]] = []
    seen: set[int] = set()
    for thing, kind in zip(things, kinds, strict=True):
        if not kind.fixed.isdisjoint(vars(thing)) or id(kind) not in seen:
            found.append((thing, NUMBERS_OF[kind.base]))
            if kind.fixed.isdisjoint(vars(thing)):
                seen.add(id(kind))
    return found


def _flags_of(thing: RoadObject, kind: VehicleClass) -> int:
    return isinstance(thing, Landmark) | 2 * kind.slides | 4 * kind.times | 8 * isinstance(thing, Obstacle)


def _read_parameters(things: list[RoadObject], kinds: list[VehicleClass]) -> bytes | None:
    """Return the kernel's row of parameters for each object; None if a parameter is missing or unusual."""
    shared: dict[int, Row] = {}  # of objects without parameters of their own, by class
    rows = []
    try:
        for thing, kind in zip(things, kinds, strict=True):
            own = not kind.fixed.isdisjoint(vars(thing))
            if own and not kind.is_of(thing):
                return None
            row = None if own else shared.get(id(kind))
            if row is None:
                row = _PARAMETER_READERS[kind.base](thing)
                # A limit that is a NumPy float makes speeds NumPy floats.
                if not are_numbers(row) or any(type(number) is np.float64 for number in row[2:4]):
                    return None
                if not own:
                    shared[id(kind)] = row
            delta = _READ_DELTA(thing) if kind.times else math.nan
            if not are_numbers((delta,)):
                return None
            rows.append((*row, *[math.nan] * (len(_PARAMETERS) - len(row)), delta))
    except AttributeError:  # a user's vehicle may lack a parameter that highway-env never reads
        return None
    numbers = np.array(rows, float).reshape(len(rows), len(_PARAMETERS) + 1)
    # With their types, as a road may have no object, and an empty list becomes floats.
    used = np.array([len(NUMBERS_OF[kind.base]) for kind in kinds], int)
    times = np.array([kind.times for kind in kinds], bool)
    if not _is_tame(numbers[times]):
        return None
    missing = np.isnan(numbers[:, :-1]) & (np.arange(len(_PARAMETERS)) < used[:, None])
    return None if missing.any() else numbers.tobytes()


def _is_tame(rows: NDArray[np.float64]) -> bool:
    """Return whether the parameters of drivers guarantee finite accelerations at finite velocities."""
    comfort, braking, wanted, time = (rows[:, _PARAMETERS.index(name)] for name in _GAP_PARAMETERS)
    return bool(
        np.isfinite([comfort, braking, wanted, time]).all()
        and (comfort * braking < 0).all()
        and (np.abs(rows[:, -1]) < _MAX_EXPONENT).all()
    )
