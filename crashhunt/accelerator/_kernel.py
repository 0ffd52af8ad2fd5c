"""The compiled kernel: sub-steps of a road with the bits of highway-env, at the price of their arithmetic.

The kernel computes what highway-env's methods compute, vehicle after vehicle and in the same order of operations. For
sine, cosine and their like it calls the inner loops of NumPy's own functions. A self-test compares all functions with
NumPy on random numbers, once per process. Where it fails, or where the kernel was not compiled, Python code with arrays
does the work.
"""

from __future__ import annotations

import importlib
import math
from functools import cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from highway_env.road.lane import CircularLane, SineLane
from highway_env.vehicle.objects import Landmark

from crashhunt.accelerator._vehicle_arrays import PARAMETERS_OF, connected_lanes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from highway_env.road.lane import AbstractLane
    from highway_env.road.road import Road
    from highway_env.vehicle.objects import RoadObject

    from crashhunt.accelerator._network import Network
    from crashhunt.accelerator._vehicle_arrays import Crowd
    from crashhunt.accelerator._versions import Kind


__all__ = ["Roster", "Traffic", "kernel", "why_not"]


_MODULE = "_crashhunt_highway"
_INTERFACE = 1
_MODELS = {"": 0, "nothing": 1, "controlled": 2, "idm": 3}
_PARAMETERS = (
    "LENGTH", "WIDTH", "MAX_SPEED", "MIN_SPEED",
    "TAU_PURSUIT", "KP_LATERAL", "KP_HEADING", "MAX_STEERING_ANGLE", "KP_A",
    "COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED", "TIME_WANTED", "ACC_MAX", "POLITENESS",
    "LANE_CHANGE_DELAY", "LANE_CHANGE_MIN_ACC_GAIN", "LANE_CHANGE_MAX_BRAKING_IMPOSED", "DELTA",
)  # fmt: skip
"""The parameters in the order of the kernel."""
_USED = {"": 2, "nothing": 4, "controlled": 9, "idm": 19}
"""The number of leading parameters that a model of decision uses."""


class Traffic(Protocol):
    """The vehicles and objects of a road in the kernel."""

    def read(self) -> bool:
        """Read the state of all vehicles; return False if a value is unusual, and the kernel must not be used."""

    def act(self) -> None:
        """Do what `Road.act` does."""

    def step(self, dt: float, /) -> bool:
        """Do what `Road.step` does; return False before the search for lanes if a number is no longer finite."""

    def run(self, count: int, dt: float, /) -> tuple[int, bool]:
        """Do several sub-steps; return the number of complete ones, and whether `step` would have returned False."""

    def completed(self) -> int:
        """Return the number of complete sub-steps of the last `run`, which may have raised an error."""


_Check = tuple[str, Any, "Sequence[tuple[float, ...]]"]  # the kernel's name of a function, NumPy's function, arguments


class _Module(Protocol):
    INTERFACE: int
    Network: Callable[..., object]
    Traffic: Callable[..., Traffic]

    def bind(
        self, number: type, whole: type, array: type, functions: list[np.ufunc], fused: bool, exponent_step: int, /
    ) -> None: ...

    def compute(self, name: str, /, *numbers: float) -> float: ...


@cache
def _found() -> tuple[_Module | None, str]:
    """Return the kernel, or None and the reason why it is not used."""
    try:
        module: _Module = importlib.import_module(_MODULE)
    except ImportError:
        return None, "it is not built"
    if module.INTERFACE != _INTERFACE:
        return None, f"it is of another version of crashhunt ({module.INTERFACE} instead of {_INTERFACE})"
    functions = [np.sin, np.cos, np.tan, np.arcsin, np.arctan, np.arctan2, np.power]
    if not all(type(function) is np.ufunc for function in functions):
        return None, "a function of NumPy has been replaced"
    # NumPy's BLAS rounds a scalar product once or twice, and NumPy squares or raises to the power of 2: find out.
    wrong = ""
    for fused in (False, True):
        for step in (0, 8):
            try:
                module.bind(np.float64, np.int64, np.ndarray, functions, fused, step)
            except OSError as error:
                return None, str(error)
            wrong = _differs(module)
            if not wrong:
                return module, ""
    return None, f"on this processor, it computes {wrong} otherwise than NumPy"


def kernel() -> _Module | None:
    """Return the compiled kernel; None if it cannot be used in this process."""
    return _found()[0]


def why_not() -> str:
    """Return why the kernel is not used; empty if it is used."""
    return _found()[1]


def _differs(module: _Module) -> str:
    """Return the name of a function whose result has other bits than NumPy's; empty if there is none."""
    rng = np.random.default_rng(1)
    count = 600  # where two ways of rounding differ at all, they do so for about one number in twenty
    numbers = (rng.normal(size=count) * 10.0 ** rng.integers(-9, 4, count)).tolist()
    others = (rng.normal(size=count) * 10.0 ** rng.integers(-9, 4, count)).tolist()
    inside = np.clip(numbers, -1, 1).tolist()
    positive = [abs(x) for x in numbers]
    checks: list[_Check] = [
        ("sin", np.sin, [(x,) for x in numbers]),
        ("cos", np.cos, [(x,) for x in numbers]),
        ("tan", np.tan, [(x,) for x in numbers]),
        ("arctan", np.arctan, [(x,) for x in numbers]),
        ("arcsin", np.arcsin, [(x,) for x in inside]),
        ("arctan2", np.arctan2, list(zip(numbers, others, strict=True))),
        ("power", np.power, list(zip(positive, rng.uniform(0, 6, count).tolist(), strict=True))),
        ("power", np.power, [(x, exponent) for x in positive for exponent in (0.5, 2.0, 4.0)]),
        ("power", lambda x, _: np.power(x, 2), [(x, 2.0) for x in numbers]),
        ("remainder", lambda x, y: np.float64(x) % y, [(x, 2 * np.pi) for x in numbers]),
        (
            "dot",
            lambda a, b, c, d: np.dot(np.array([a, b]), np.array([c, d])),
            list(zip(numbers, others, reversed(numbers), rng.permutation(others).tolist(), strict=True)),
        ),
    ]
    for name, function, arguments in checks:
        for values in arguments:
            if module.compute(name, *values).hex() != float(function(*values)).hex():
                return name
    return ""


class Roster:
    """The vehicles and objects of a road in the kernel, with everything that must stay the same while they are there.

    Args:
        crowd: The vehicles and objects.
        network: The lanes of their road.

    Attributes:
        traffic: The vehicles in the kernel; None if it does not know them.
    """

    def __init__(self, crowd: Crowd, network: Network) -> None:
        self._ids = list(map(id, crowd.things))
        self._kinds = crowd.kinds
        self._looks_further = crowd.road.neighbour_vehicles_connected_lanes
        self.traffic = self._in_kernel(crowd, network)
        if self.traffic is None:
            return
        kinds = crowd.kinds
        #: one thing of each class, for the parameters of the class
        self._examples = [crowd.things[kinds.index(kind)] for kind in dict.fromkeys(kinds)]
        self._fixed = [kind.fixed for kind in kinds]
        self._is_shared = all(map(_is_disjoint, self._fixed, map(vars, crowd.things)))
        self._thinking = [crowd.things[row] for row in crowd.idm]
        self._parameters, self._deltas = self._read()

    def is_of(self, road: Road, things: list[RoadObject], kinds: list[Kind]) -> bool:
        """Whether the kernel still knows the vehicles and objects of a road, apart from their state."""
        return (
            self._kinds == kinds
            and self._ids == list(map(id, things))
            and self._looks_further == road.neighbour_vehicles_connected_lanes
            and (self.traffic is None or self._is_current(road, things))
        )

    def _is_current(self, road: Road, things: list[RoadObject]) -> bool:
        return (
            self._is_shared
            and all(map(_is_disjoint, self._fixed, map(vars, things)))
            and all(vehicle.road is road for vehicle in road.vehicles)
            and self._read() == (self._parameters, self._deltas)
        )

    def _read(self) -> tuple[list[tuple[object, ...]], list[object]]:
        """Return the parameters of each class with their types, and the exponents of all drivers."""
        found = []
        for thing, kind in zip(self._examples, dict.fromkeys(self._kinds), strict=True):
            numbers = PARAMETERS_OF[kind.base](thing)
            found += [numbers, tuple(map(type, numbers))]
        return found, list(map(_DELTA, self._thinking))

    def _in_kernel(self, crowd: Crowd, network: Network) -> Traffic | None:
        module = kernel()
        if module is None or not (crowd.drives and crowd.moves and crowd.collides and crowd.tame):
            return None
        if crowd.sliding or crowd.numpy_limits:
            return None
        models = [*crowd.how, *[""] * (len(crowd.things) - len(crowd.vehicles))]
        parameters = np.array([crowd.numbers[name] for name in _PARAMETERS]).T.copy()
        used = np.array([_USED[model] for model in models])
        if (np.isnan(parameters) & (np.arange(len(_PARAMETERS)) < used[:, None])).any():
            return None
        looks_further = bool(self._looks_further)
        lanes = network.compiled.get(looks_further)
        if lanes is None:
            connected = [
                connected_lanes(network, number) if looks_further else [] for number in range(len(network.keys))
            ]
            lanes = network.compiled[looks_further] = module.Network(
                network.keys, network.lanes, network.index, _table(network), connected if looks_further else []
            )
        landmarks = bytes(isinstance(thing, Landmark) for thing in crowd.things)
        return module.Traffic(lanes, crowd.things, bytes(map(_MODELS.__getitem__, models)), landmarks, parameters)


_DELTA = attrgetter("DELTA")
_is_disjoint = frozenset.isdisjoint


def _table(network: Network) -> bytes:
    """Return the numbers of all lanes, in the order of the kernel's structure ``Lane``."""
    roads: dict[tuple[str, str], int] = {}
    rows = []
    for number, ((start, end, of_road), lane) in enumerate(zip(network.keys, network.lanes, strict=True)):
        left = number - 1 if of_road > 0 else -1
        right = network.index.get((start, end, of_road + 1), -1)
        rows.append([*_geometry(lane), left, right, roads.setdefault((start, end), len(roads))])
    return np.array(rows, float).tobytes()


def _geometry(lane: AbstractLane) -> list[float]:
    limit = math.nan if lane.speed_limit is None else lane.speed_limit
    if isinstance(lane, CircularLane):
        x, y = lane.center.tolist()
        shape = [2, x, y, 0, 0, 0, 0, lane.length, lane.width, 0, limit, bool(lane.forbidden), 0, 0, 0]
        return [*shape, lane.radius, lane.start_phase, lane.direction]
    vectors = (lane.start, lane.direction, lane.direction_lateral)
    shape = [*[number for vector in vectors for number in vector.tolist()], lane.length, lane.width, lane.heading]
    wave = [lane.amplitude, lane.pulsation, lane.phase] if isinstance(lane, SineLane) else [0, 0, 0]
    return [int(isinstance(lane, SineLane)), *shape, limit, bool(lane.forbidden), *wave, 0, 0, 0]
