"""The compiled kernel: runs sub-steps of a road with the bits of highway-env, at the cost of the arithmetic alone.

The kernel computes what highway-env's methods compute, vehicle after vehicle and in the same order of operations. For
functions such as sine and cosine, it calls the inner loops of NumPy's own functions. A self-test compares all functions
with NumPy on random numbers, once per process. If the self-test fails, or if the kernel was not compiled, the
accelerator is not used, and highway-env's own code runs.
"""

from __future__ import annotations

import importlib
from functools import cache
from itertools import product
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from array import array
    from collections.abc import Callable, Sequence

    from highway_env.road.road import Road
    from highway_env.vehicle.kinematics import Vehicle
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray


_MODULE = "_crashhunt_highway"
_INTERFACE = 6


class Traffic(Protocol):
    """The vehicles and objects of a road in the kernel."""

    def is_current(self, road: Road, /) -> bool:
        """Return whether the kernel still has the objects of the road, with unchanged properties except their state."""

    def read(self) -> bool:
        """Read the state of all vehicles; return False if a value is unusual, so that the kernel must not be used."""

    def act(self) -> None:
        """Compute the result of `Road.act` for all vehicles."""

    def step(self, dt: float, /) -> bool:
        """Compute `Road.step`; return False before the search for lanes if a number is no longer finite."""

    def run(self, count: int, dt: float, stops: bool, /) -> tuple[int, bool]:
        """Run several sub-steps; return the number of complete sub-steps, and whether `step` would have returned False.

        If the kernel stops at crashes, the sub-step in which a vehicle crashes is the last one.
        """

    def collide(self, dt: float, /) -> None:
        """Compute the last part of `Road.step`, after the movement: check all pairs for collisions."""

    def conflicts(self) -> list[tuple[int, int, bool]] | None:
        """Return the pairs of vehicles with a possible conflict, and for each pair whether the conflict is certain.

        The result is None if highway-env's own code must decide.
        """

    def fill_times(self, *given: object) -> None:
        """Fill the grid that `compute_ttc_grid` returns."""

    def neighbour_vehicles(
        self, vehicle: RoadObject, lane: int, /
    ) -> tuple[RoadObject | None, RoadObject | None] | None:
        """Return the objects ahead and behind on a lane; None if the road does not have the vehicle."""

    def close_objects_to(
        self, vehicle: RoadObject, distance: float, sees_behind: bool, is_sorted: bool, only_vehicles: bool, /
    ) -> list[RoadObject] | None:
        """Return all objects that `Road.close_objects_to` finds; None if the road does not have the vehicle."""

    def describe(
        self, cells: NDArray[np.float64], objects: list[RoadObject], absolute: int, features: bytes,
        scales: array[float], clips: bool, /,
    ) -> bool:  # fmt: skip
        """Write a row of features for each object, from the point of view of the first, but for some absolute rows.

        Returns:
            Whether all rows were written; False if highway-env's own code must run, such as for an error in a route.
        """

    def completed(self) -> int:
        """Return the number of complete sub-steps of the last call of `run`, which may have raised an error."""


class CompiledNetwork(Protocol):
    """The lanes of a road in the kernel."""

    def mark_cells(self, *grid: object) -> tuple[bytearray, list[tuple[int, float]]]:
        """Return a byte for each cell that contains a point of a lane, and the lanes with points near a cell border."""


class Contents(Protocol):
    """The contents of some containers at one time, for a later comparison."""

    def is_same(self) -> bool:
        """Return whether all containers still have the same members in order, and all arrays the same bytes."""


Poses = tuple[list[tuple[float, float]], list[float], list[float]]
_Check = tuple[str, Any, "Sequence[tuple[float, ...]]"]  # the kernel's name of a function, NumPy's function, arguments


class _Module(Protocol):
    INTERFACE: int
    Network: Callable[..., CompiledNetwork]
    Traffic: Callable[..., Traffic]
    Contents: Callable[[list[object]], Contents]

    def bind(self, *given: object) -> None: ...

    def bind_turn(self, rounds: int, /) -> None: ...

    def mirrored_poses(self, things: list[Any], halves: list[float], /) -> Poses | None: ...

    def compute(self, name: str, numbers: tuple[float, ...], /) -> float: ...


@cache
def _load_kernel() -> tuple[_Module | None, str]:
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
    # NumPy's BLAS rounds a product of vectors or of matrices once or twice, and NumPy squares or raises to the power
    # of 2: find out.
    objects = (np.float64, np.int64, np.float32, np.ndarray, np.zeros, _derivatives)
    wrong = ""
    for fused, product_fused, step in product((True, False), (True, False), (0, 8)):
        try:
            module.bind(*objects, functions, fused, product_fused, step)
        except OSError as error:
            return None, str(error)
        wrong = _differs(module)
        if not wrong:
            _bind_turn(module)
            return module, ""
    return None, f"on this processor, it computes {wrong} otherwise than NumPy"


def _bind_turn(module: _Module) -> None:
    """Determine how NumPy rounds a product of a matrix and a vector.

    If no known way gives NumPy's bits, highway-env computes the dynamic bicycle model.
    """
    rng = np.random.default_rng(2)
    numbers = [(a, b, 20 * c, d) for a, b, c, d in rng.normal(size=(300, 4)).tolist()]
    numbers += [(-0.0, 1.0, 0.0, -0.0), (0.0, -1.0, 0.0, 0.0), (1.0, -0.0, -0.0, 0.0)]
    right = [np.array(((a, b), (-b, a))) @ np.array([c, d]) for a, b, c, d in numbers]
    for rounds in (3, 2, 1, 0):
        module.bind_turn(rounds)
        if rounds == 0 or all(
            module.compute("turned", (*row, c, d)).hex() == float(value).hex()
            for (a, b, c, d), values in zip(numbers, right, strict=True)
            for row, value in zip(((a, b), (-b, a)), values, strict=True)
        ):
            return


def _derivatives(vehicle: Vehicle, dt: float) -> None:
    """Move a vehicle by highway-env's dynamic bicycle model, without the search for its lane."""
    road, vehicle.road = vehicle.road, None
    try:
        vehicle.step(dt)
    finally:
        vehicle.road = road


def kernel() -> _Module | None:
    """Return the compiled kernel; None if it cannot be used in this process."""
    return _load_kernel()[0]


def why_not() -> str:
    """Return the reason why the kernel is not used; empty if it is used."""
    return _load_kernel()[1]


def _differs(module: _Module) -> str:
    """Return the name of a function whose result differs from NumPy's in any bit; empty if there is none."""
    rng = np.random.default_rng(1)
    count = 600  # where two ways of rounding differ at all, they do so for about one number in twenty
    numbers = (rng.normal(size=count) * 10.0 ** rng.integers(-9, 4, count)).tolist()
    others = (rng.normal(size=count) * 10.0 ** rng.integers(-9, 4, count)).tolist()
    inside = np.clip(numbers, -1, 1).tolist()
    positive = [abs(x) for x in numbers]
    fours = list(zip(numbers, others, reversed(numbers), rng.permutation(others).tolist(), strict=True))
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
            fours,
        ),
    ]
    triples = [tuple(row) for row in rng.permutation(numbers * 6).reshape(-1, 6).tolist()]
    checks += [
        ("dot3", lambda a, b, c, *others: np.dot([a, b, c], np.array(others)), triples),
        ("product", lambda a, b, c, d: (np.array([[a, b], [-b, a]]) @ np.full((4, 2), (c, d)).T)[0, 1], fours),
        ("product", lambda a, b, c, d: (np.array([[-b, a], [a, b]]) @ np.full((4, 2), (c, d)).T)[1, 2], fours),
        ("square", lambda x: x**2, [(x,) for x in numbers]),
        ("square", lambda x: np.float64(x) ** 2, [(x,) for x in numbers]),
    ]
    for name, function, arguments in checks:
        for values in arguments:
            if module.compute(name, values).hex() != float(function(*values)).hex():
                return name
    return ""
