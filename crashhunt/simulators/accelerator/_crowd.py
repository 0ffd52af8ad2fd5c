"""Everybody on a road, with what of them stays as it is for as long as nobody else's code runs."""

from __future__ import annotations

from functools import cached_property
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from highway_env.vehicle.controller import ControlledVehicle

from crashhunt.simulators.accelerator._frame import are_plain
from crashhunt.simulators.accelerator._known import NUMBERS_OF, are_numbers, kinds_of

if TYPE_CHECKING:
    from highway_env.road.road import Road
    from highway_env.vehicle.kinematics import Vehicle
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.simulators.accelerator._known import Kind

    Pairs = tuple[NDArray[np.bool_], NDArray[np.float64]]  # who may touch whom, and within which distance

__all__ = ["Crowd"]

_COLLIDES, _MOVES = attrgetter("collides"), attrgetter("moves")
_STEEP = 20.0  # what has an exponent above need not be finite
_POSE = attrgetter("heading", "speed")
_NAMES = NUMBERS_OF["idm"]  # which all others have the first of
_READ = {how: attrgetter(*names) for how, names in NUMBERS_OF.items()}


class Crowd:
    """Looked at when it is made; `move` keeps up to date where everybody is, and says so here.

    Args:
        road: with its vehicles and objects.

    Attributes:
        drives: whether it is known how all vehicles decide, and all that they reckon with are numbers.
        moves: whether it is known how all vehicles move.
        collides: whether it is known how all collide.
        things: the vehicles, and the objects after them, of which all others have one entry each.
        places: shape (things, 2), in m.
        headings: in rad.
        speeds: in m/s.
        lanes: the numbers of the lanes on which vehicles are, once `move` has found them.
        idm: the rows of vehicles that decide by themselves.
        controlled: the rows of vehicles that keep to a speed and a lane.
        sliding: the rows of vehicles that move by the dynamic model.
        of_numpy: the rows of vehicles whose speeds are NumPy's floats, as which they stay.
        timed: the vehicles that count the time since they last thought of changing lanes.
    """

    def __init__(self, road: Road) -> None:
        self.road = road
        self.things: list[RoadObject] = road.vehicles + road.objects
        self.vehicles: list[Vehicle] = list(road.vehicles)
        self.kinds = kinds = kinds_of(self.things)
        self.drives = self.moves = self.collides = False
        if not are_plain(self.things, kinds) or not self._read(kinds):
            return
        poses = list(map(_POSE, self.things))
        if not are_numbers(chain.from_iterable(poses)):
            return
        count = len(self.vehicles)
        self.how = [kind.drives for kind in kinds[:count]]
        here = all(vehicle.road is road for vehicle in self.vehicles)
        self.collides = all(map(_COLLIDES, kinds))
        self.moves = here and all(map(_MOVES, kinds[:count]))
        self.drives = here and self.collides and all(self.how)
        self.places = np.array([thing.position for thing in self.things], float).reshape(-1, 2)
        self.headings, self.speeds = np.array(poses, float).reshape(-1, 2).T.copy()
        self.idm = [row for row, how in enumerate(self.how) if how == "idm"]
        self.controlled = [row for row, how in enumerate(self.how) if how == "controlled"]
        self.of_numpy = {row for row, (_, speed) in enumerate(poses[:count]) if type(speed) is np.float64}
        self.lanes: NDArray[np.intp] | None = None
        self.sliding = [row for row, kind in enumerate(kinds[:count]) if kind.slides]
        self.timed = [vehicle for vehicle, kind in zip(self.vehicles, kinds, strict=False) if kind.times]

    def _read(self, kinds: list[Kind]) -> bool:
        """Read the numbers that a class usually has for all of its vehicles."""
        shared: dict[int, int] = {}  # of each class, where its numbers are among those found
        found: list[tuple[float, ...]] = []
        which: list[int] = []
        try:
            for kind, thing in zip(kinds, self.things, strict=True):
                own = not kind.fixed.isdisjoint(vars(thing))
                if own and not kind.is_of(thing):
                    return False
                number = None if own else shared.get(id(kind))
                if number is None:
                    number = len(found)
                    found.append(_READ[kind.base](thing))
                    if not own:
                        shared[id(kind)] = number
                which.append(number)
            deltas = [thing.DELTA for thing, kind in zip(self.things, kinds, strict=True) if kind.base == "idm"]
        except AttributeError:  # highway-env may never ask for what somebody's vehicle lacks
            return False
        if not are_numbers(chain.from_iterable(found)) or not are_numbers(deltas):
            return False
        whole = [row + (np.nan,) * (len(_NAMES) - len(row)) for row in found]
        self.numbers = dict(zip(_NAMES, np.array(whole, float).reshape(-1, len(_NAMES))[which].T, strict=True))
        self.numbers["DELTA"] = delta = np.full(len(kinds), np.nan)
        delta[[row for row, kind in enumerate(kinds) if kind.base == "idm"]] = deltas
        return True

    @cached_property
    def row(self) -> dict[int, int]:
        """The row of everybody by their identity."""
        return {id(thing): row for row, thing in enumerate(self.things)}

    @cached_property
    def aims(self) -> list[bool]:
        """Which vehicles have a lane that they want to be on."""
        return [isinstance(vehicle, ControlledVehicle) for vehicle in self.vehicles]

    @cached_property
    def tame(self) -> bool:
        """Whether every acceleration that drivers reckon with is finite, as long as everybody's velocity is."""
        found = self.of_gaps[:, self.idm]
        comfort, braking, *_ = found
        steep = np.abs(self.numbers["DELTA"][self.idm])
        return bool(np.isfinite(found).all() and (comfort * braking < 0).all() and (steep < _STEEP).all())

    @cached_property
    def of_steering(self) -> NDArray[np.float64]:
        """Shape (5, things)."""
        return self._table("TAU_PURSUIT", "KP_LATERAL", "KP_HEADING", "LENGTH", "MAX_STEERING_ANGLE")

    @cached_property
    def of_speeds(self) -> NDArray[np.float64]:
        """Shape (2, things)."""
        return self._table("COMFORT_ACC_MAX", "DELTA")

    @cached_property
    def of_gaps(self) -> NDArray[np.float64]:
        """Shape (4, things)."""
        return self._table("COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED", "TIME_WANTED")

    def _table(self, *names: str) -> NDArray[np.float64]:
        return np.array([self.numbers[name] for name in names])

    @cached_property
    def pairs(self) -> Pairs | None:
        """Which vehicles ask whether they touch which things, and within which distance of standing vehicles.

        None where a number is of no usual kind. Of shape (vehicles, things), in m.
        """
        things, count = self.things, len(self.vehicles)
        try:
            diagonals = [thing.diagonal for thing in things]
        except AttributeError:
            return None
        if not are_numbers(diagonals):
            return None
        radius = np.array(diagonals, float) / 2
        checks = np.array([bool(thing.check_collisions) for thing in things], bool)
        ghosts = np.array([not thing.collidable for thing in things], bool)
        rows = np.arange(len(things))
        # Of two that neither of them look for collisions, nothing is asked.
        asked = (rows > rows[:count, None]) & (checks | checks[:count, None]) & ~(ghosts | ghosts[:count, None])
        return asked, radius[:count, None] + radius
