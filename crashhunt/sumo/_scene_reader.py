"""Reads scenes from SUMO: the actors within the range of sight of the controlled vehicles, and contacts."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from libsumo import _libsumo as sumo

from crashhunt.sumo._bent_vehicles import Bends, height_at, is_articulated
from crashhunt.sumo._reported_collisions import ReportedCollisions
from crashhunt.world import PERSON, Actor, Roster, Scene

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.native import Columns, Core, Vehicles
    from crashhunt.world import Spine

    Lists = tuple[list[tuple[float, float]], list[float], list[float]]


SIGHT_M = 150.0
"""A scene contains the actors that were within this distance of a controlled vehicle at the last look around.

Actors further away take no part in a crash, and a town has thousands of them."""

LOOK_AROUND_INTERVAL_STEPS = 10
"""Steps between two looks around. A further look follows when a vehicle enters or leaves.

With steps above 0.1 s, a look around happens every second. Every 10th scene contains the lane of each vehicle, because
reading a string per vehicle is expensive."""

_LOOK_AROUND_S = 1.0  # at a closing speed of 75 m/s, two vehicles approach by half of `SIGHT_M` in this time
_MAX_CLOSING_SPEED_MPS = 75.0
_CENTER_OFFSETS_M = 20.0  # by which two centres are nearer than the front bumpers, at which looks around measure
_SIGHT_SQUARED = SIGHT_M**2
_RAD_PER_DEGREE = math.pi / 180.0
_HEIGHT_EVERY_M = 20.0  # distance between the points of a lane at which heights are read
_FLAT_M = 0.5  # a map with smaller height differences has no bridges and is treated as flat
_NO_VALUE = -1073741824.0  # of SUMO's getters, as in `libsumo.INVALID_DOUBLE_VALUE`
_PARKED_BIT = 2  # of SUMO's stop state: the vehicle is next to the road, and off its lane


class Sight:
    """Reads scenes from SUMO.

    Persons are actors while they walk, ride a bicycle as a person, or wait at the roadside, but not inside vehicles.
    With SUMO's pedestrian model ``nonInteracting``, persons walk through vehicles, so scenes omit them.

    Args:
        controlled: Identifiers of the vehicles around which actors are read.
        step_length_s: Step length, in s.
        lateral: Whether vehicles may leave the centre line of a lane.
        speeds: Speeds in m/s of moved persons, by SUMO id, because SUMO reports 0 for them.
        core: The compiled core, which reads faster; None if it is not available.
        reach_m: Distance within which each scene must contain all actors, in m; 0 for the usual distance.
    """

    def __init__(
        self,
        controlled: Sequence[str],
        step_length_s: float,
        *,
        lateral: bool,
        speeds: dict[str, float],
        core: Core | None = None,
        reach_m: float = 0.0,
    ) -> None:
        self.core = core
        self._controlled = tuple(controlled)
        self._eyes: Vehicles | None = core.Vehicles(self._controlled, [], [], []) if core is not None else None
        self._every = max(1, min(LOOK_AROUND_INTERVAL_STEPS, round(_LOOK_AROUND_S / step_length_s)))
        if reach_m:
            before_it_enters_s = (SIGHT_M - _CENTER_OFFSETS_M - reach_m) / _MAX_CLOSING_SPEED_MPS
            self._every = max(1, min(self._every, int(before_it_enters_s / step_length_s)))
        self._speeds = speeds
        self.leaving: set[str] = set()  # SUMO ids of persons that SUMO still has, but that scenes must hide
        self._high: bool | None = None
        self._bends = Bends(lateral=lateral)
        self._known: dict[str, Actor] = {}
        self._reaches: dict[str, float] = {}  # of the vehicles in it, as in `Roster.reaches`: math.hypot is slow
        self.reset()

    def reset(self) -> None:
        """Delete the state of the previous episode, but keep data that was read from the network."""
        self._known.clear()  # in the next episode, the same id may be another vehicle
        self._articulated: set[str] = set()
        self._bends.reset()
        self._speeds.clear()
        self._collisions = ReportedCollisions()
        self._unparking: frozenset[str] = frozenset()
        self._see((), ())
        self._all_persons: tuple[str, ...] = ()
        self._persons_count: bool | None = None

    def look(self, steps: int, off_road: Sequence[str]) -> Scene:
        """Return the scene after this number of steps."""
        if self._persons_count is None:
            self._persons_count = sumo.simulation_getOption("pedestrian.model") != "nonInteracting"
            self._high = self._is_high() if self._high is None else self._high
        time_to_look = steps % self._every == 0
        if steps and self._eyes is not None and self.plain is not None and self._plain is not None:
            # Most steps need only this one call of the core.
            columns = self._plain.look(self._eyes, _SIGHT_SQUARED if time_to_look else 0.0)
            if isinstance(columns, tuple):
                self._see(columns, ())
                columns = None if self._plain is None else self._plain.read()
            if columns is not None:
                lanes: tuple[str, ...] = ()
                if steps % LOOK_AROUND_INTERVAL_STEPS == 0 or off_road:
                    lanes = tuple(map(sumo.vehicle_getLaneID, self._ids))
                return Scene(
                    sumo.simulation_getTime(), self._roster, off_road=tuple(off_road), lanes=lanes, swept=True,
                    core=self.core, columns=columns,
                )  # fmt: skip
        if (
            time_to_look
            or (self.core.is_coming_or_going() if self.core is not None else _is_coming_or_going())
            or (self._persons_count and self._persons_changed())
        ):
            self.look_around()
        self._update_parked()
        ids, persons = self._ids, self._persons
        contacts = self._collisions.read(persons=bool(self._persons_count))
        lanes = ()
        if steps % LOOK_AROUND_INTERVAL_STEPS == 0 or contacts or off_road:
            lanes = tuple(map(sumo.vehicle_getLaneID, ids))
        columns = self._vehicles.read() if self._vehicles is not None else None
        points, headings, speeds = self._columns() if columns is None else _lists(columns)
        if persons:
            # For persons as for vehicles, the position is that of the front.
            points += map(sumo.person_getPosition, persons)
            headings += [(90.0 - angle) * _RAD_PER_DEGREE for angle in map(sumo.person_getAngle, persons)]
            speeds += map(sumo.person_getSpeed, persons)
            for person in self._speeds.keys() & set(persons) if self._speeds else ():
                speeds[len(ids) + persons.index(person)] = self._speeds[person]
            lanes = (*lanes, *map(sumo.person_getLaneID, persons)) if lanes else ()
        if self.core is not None and self._vehicles is not None and (persons or columns is None):
            columns = self.core.columns(self._vehicles, points, headings, speeds)
        heights: list[float] = []
        grades: list[float] = []
        if self._high:
            heights = [sumo.vehicle_getPosition3D(vehicle)[2] for vehicle in ids]
            heights += [sumo.person_getPosition3D(person)[2] for person in persons]
            slopes = [*map(sumo.vehicle_getSlope, ids), *map(sumo.person_getSlope, persons)]
            # SUMO knows no slope of a vehicle that was moved off every lane.
            grades = [0.0 if slope == _NO_VALUE else math.tan(slope * _RAD_PER_DEGREE) for slope in slopes]
        return Scene(
            sumo.simulation_getTime(), self._roster, points, headings, speeds, contacts, tuple(off_road), lanes,
            heights, grades, self._spines(points, headings) if self._long else {},
            # A teleport that ends in the step in which it starts leaves the vehicle in sight.
            swept=not sumo.simulation_getStartingTeleportNumber(), core=self.core, columns=columns,
        )  # fmt: skip

    @property
    def around(self) -> tuple[Vehicles, int, float]:
        """The controlled vehicles, the steps between two selections, and the squared range (m²); for the core."""
        assert self._eyes is not None
        return self._eyes, self._every, _SIGHT_SQUARED

    @property
    def plain(self) -> tuple[Vehicles, tuple[str, ...]] | None:
        """The ids of the vehicles in sight and their data for the core; None if the core cannot read the scene."""
        if self._plain is None or self._high or self._all_persons or self._unparking:
            return None
        return self._plain, self._ids

    @property
    def roster(self) -> Roster:
        """The actors in sight."""
        return self._roster

    @property
    def known(self) -> dict[str, Actor]:
        """The actors that have been in sight in this episode, by id; also of persons."""
        return self._known

    def know(self, vehicle: str, kind: str, length: float, width: float, height: float, parked: bool) -> Actor:
        """Return the actor of a vehicle that was not known before; all sizes in m."""
        found = self._known[vehicle] = Actor(vehicle, kind, length=length, width=width, height=height, parked=parked)
        self._reaches[vehicle] = math.hypot(length, width / 2)
        if is_articulated(kind, length):
            self._articulated.add(vehicle)
        return found

    def reads_right(self) -> bool:
        """Return whether the core's values are bit-identical to the values of libsumo's getters."""
        if self.core is None or self._vehicles is None:
            return True
        seen = self.core.in_sight(self._eyes, _SIGHT_SQUARED) if self._eyes is not None else self._in_sight()
        numbers = self._vehicles.read()
        read = None if numbers is None else _lists(numbers), self.core.is_coming_or_going(), seen
        found = self._columns(), _is_coming_or_going(), self._in_sight()
        at_once = self._vehicles.look(self._eyes, _SIGHT_SQUARED) if self._eyes is not None else None
        if isinstance(at_once, tuple):
            right = at_once == found[2][0] != self._ids
        else:
            quiet = not (found[1] or sumo.person_getIDCount() or sumo.simulation_getCollisions())
            right = at_once is None or (quiet and self._ids == found[2][0] and repr(_lists(at_once)) == repr(found[0]))
        if not right or repr(read) != repr(found):  # repr() has all digits of each number
            return False
        return repr(self.core.vehicle_states(self._vehicles)) == repr([*map(_state, self._ids)])

    def distrust(self) -> None:
        """Stop using the core, and delete the state of the episode."""
        self.core = None
        self.reset()

    def _see(self, ids: tuple[str, ...], persons: tuple[str, ...]) -> None:
        self._ids, self._persons = ids, persons
        known, actor = self._known.get, self._actor
        actors = [known(vehicle) or actor(vehicle) for vehicle in ids]
        self._roster = roster = Roster((*actors, *map(self._person, persons)) if persons else tuple(actors))
        if not persons:
            roster.reaches = list(map(self._reaches.__getitem__, ids))
        self._long = []
        if self._articulated:
            self._long = [row for row, vehicle in enumerate(ids) if vehicle in self._articulated]
        self._vehicles: Vehicles | None = None
        if self.core is not None:
            self._vehicles = self.core.Vehicles(ids, roster.lengths, roster.widths, roster.reaches)
            roster.vehicles = self._vehicles
        self._plain = None if persons or self._long else self._vehicles

    def adopt(self, vehicles: Vehicles, ids: tuple[str, ...], actors: tuple[Actor, ...]) -> Roster:
        """Set which vehicles are in sight, all of which the core can read, and return their roster."""
        self._ids, self._persons, self._long = ids, (), []
        self._roster, self._vehicles, self._plain = Roster(actors), vehicles, vehicles
        self._roster.vehicles = vehicles
        return self._roster

    def _columns(self) -> Lists:
        ids = self._ids
        # SUMO's angles are in degrees, clockwise from north.
        headings = [(90.0 - angle) * _RAD_PER_DEGREE for angle in map(sumo.vehicle_getAngle, ids)]
        return list(map(sumo.vehicle_getPosition, ids)), headings, list(map(sumo.vehicle_getSpeed, ids))

    def _spines(self, points: Sequence[tuple[float, float]], headings: Sequence[float]) -> dict[int, Spine]:
        found = {}
        for row in self._long:
            place = points[row], headings[row]
            spine = self._bends.spine(self._ids[row], self._roster.actors[row].length, *place, high=bool(self._high))
            if spine is not None:
                found[row] = spine
        return found

    def _persons_changed(self) -> bool:
        """Return whether a person entered, left, or got into a vehicle."""
        if not (sumo.person_getIDCount() or self._all_persons):
            return False
        if sumo.person_getIDList() != self._all_persons:
            return True
        return any(map(sumo.person_getVehicle, self._persons))

    def look_around(self) -> None:
        """Select the actors in sight: the controlled vehicles and all actors near them."""
        found = self.core.in_sight(self._eyes, _SIGHT_SQUARED) if self.core is not None and self._eyes else None
        ids, eyes = found or self._in_sight()
        persons: tuple[str, ...] = ()
        if self._persons_count and (sumo.person_getIDCount() or self._all_persons):
            self._all_persons = sumo.person_getIDList()
            near = _near(self._all_persons, list(map(sumo.person_getPosition, self._all_persons)), eyes)
            persons = tuple([id_ for id_ in near if id_ not in self.leaving and not sumo.person_getVehicle(id_)])
        if ids != self._ids or persons != self._persons:
            self._see(ids, persons)

    def lose(self, vehicle: str) -> None:
        """Remove a vehicle that has been taken off the road; SUMO reports this only after the next step."""
        if vehicle in self._ids:
            self._see(tuple(name for name in self._ids if name != vehicle), self._persons)

    def _update_parked(self) -> None:
        """Update which of the vehicles in sight are parked, that is, not part of the traffic.

        SUMO puts a vehicle that ends its parking back on its lane in one step, and moves it there in the next one.
        """
        ended: tuple[str, ...] = ()
        changed = self._unparking
        if sumo.simulation_getParkingStartingVehiclesNumber() or sumo.simulation_getParkingEndingVehiclesNumber():
            ended = sumo.simulation_getParkingEndingVehiclesIDList()
            changed = changed.union(sumo.simulation_getParkingStartingVehiclesIDList(), ended)
        if not changed:
            return
        self._unparking = frozenset(ended)
        for vehicle in changed.intersection(sumo.vehicle_getIDList(), self._known):
            self._known[vehicle] = replace(self._known[vehicle], parked=_is_parked(vehicle))
        if any(
            self._known[vehicle] is not actor for vehicle, actor in zip(self._ids, self._roster.actors, strict=False)
        ):
            self._see(self._ids, self._persons)

    def _in_sight(self) -> tuple[tuple[str, ...], list[tuple[float, float]]]:
        """Return the vehicles in sight, and the positions of the controlled vehicles that are present."""
        present = sumo.vehicle_getIDList()
        points = list(map(sumo.vehicle_getPosition, present))
        eyes = [points[present.index(eye)] for eye in self._controlled if eye in present]
        return _near(present, points, eyes), eyes

    def _actor(self, vehicle: str) -> Actor:
        found = self._known.get(vehicle)
        if found is None:
            kind = sumo.vehicle_getVehicleClass(vehicle)
            height = sumo.vehicle_getHeight(vehicle) if self._high else 0.0
            size = sumo.vehicle_getLength(vehicle), sumo.vehicle_getWidth(vehicle), height
            found = self.know(vehicle, kind, *size, _is_parked(vehicle))
        return found

    def _person(self, person: str) -> Actor:
        name = PERSON + person
        found = self._known.get(name)
        if found is None:
            kind = sumo.person_getVehicleClass(person)
            height = sumo.person_getHeight(person) if self._high else 0.0
            size = sumo.person_getLength(person), sumo.person_getWidth(person), height
            found = self._known[name] = Actor(name, kind, *size)
        return found

    def _is_high(self) -> bool:
        """Return whether heights in the network differ by more than `_FLAT_M`."""
        low = high = None
        for lane in sumo.lane_getIDList():
            length = sumo.lane_getLength(lane)
            pieces = max(1, math.ceil(length / _HEIGHT_EVERY_M))
            for piece in range(pieces + 1):
                z = height_at(lane, length * piece / pieces)
                low = z if low is None or z < low else low
                high = z if high is None or z > high else high
        return low is not None and high is not None and high - low > _FLAT_M


def _state(vehicle: str) -> tuple[str, float, float, int, int, float, str]:
    """Return the values that the core reads for the observations ``actors`` and ``right_of_way``."""
    return (
        sumo.vehicle_getLaneID(vehicle),
        sumo.vehicle_getLateralLanePosition(vehicle),
        sumo.vehicle_getAcceleration(vehicle),
        sumo.vehicle_getSignals(vehicle),
        sumo.vehicle_getRouteIndex(vehicle),
        sumo.vehicle_getLanePosition(vehicle),
        sumo.vehicle_getRouteID(vehicle),
    )


def _lists(columns: Columns) -> Lists:
    return columns.points, columns.headings, columns.speeds


def _is_coming_or_going() -> bool:
    """Return whether a vehicle entered or left the simulation in the last step, or began or ended parking."""
    return bool(
        sumo.simulation_getDepartedNumber()
        or sumo.simulation_getArrivedNumber()
        or sumo.simulation_getStartingTeleportNumber()
        or sumo.simulation_getEndingTeleportNumber()
        or sumo.simulation_getParkingStartingVehiclesNumber()
        or sumo.simulation_getParkingEndingVehiclesNumber()
    )


def reach_of(kind: str, length: float, width: float) -> float | None:
    """Return the reach of a vehicle in m, as in `Roster.reaches`; None for a vehicle that the core cannot read."""
    return None if is_articulated(kind, length) else math.hypot(length, width / 2)


def _is_parked(vehicle: str) -> bool:
    return bool(sumo.vehicle_getStopState(vehicle) & _PARKED_BIT)


def _near(
    names: Sequence[str], points: Sequence[tuple[float, float]], eyes: Sequence[tuple[float, float]]
) -> tuple[str, ...]:
    """Return the names of the points within `SIGHT_M` of a controlled vehicle, in their original order."""
    seen: set[str] = set()
    for ex, ey in eyes:
        seen.update(
            [
                name
                for name, (x, y) in zip(names, points, strict=True)
                if (x - ex) * (x - ex) + (y - ey) * (y - ey) < _SIGHT_SQUARED
            ]
        )
    return tuple([name for name in names if name in seen])
