"""Readers of the parts ``ego`` and ``actors``: the controlled vehicle, and the actors around it."""

from __future__ import annotations

import math
from math import cos, sin
from typing import TYPE_CHECKING

import libsumo
import numpy as np
from libsumo import _libsumo as sumo

from crashhunt.simulators import (
    MAX_JERK_MPS3,
    MAX_STEERING_RAD,
    MAX_STEERING_RATE_RADPS,
    WHEELBASE_SHARE,
    bicycle_steering,
    center_of,
    kind_number,
    wrapped,
)
from crashhunt.sumo._reader_protocol import NO_VALUE, Reader
from crashhunt.sumo._relations import PathAhead, Relations
from crashhunt.world import PERSON, VehicleData, is_person

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.native import Draft
    from crashhunt.sumo._reader_protocol import AgentMoment, ReaderSetup
    from crashhunt.world import Actor

_BRAKE_LIGHT, _RIGHT, _LEFT, _HAZARD = 8, 1, 2, 4  # bits of SUMO's signals
_UNKNOWN = ("", 0.0, 0.0, 0)  # lane, offset, acceleration and signals of an actor that SUMO does not have


def vehicle_data_of(vehicle: str) -> VehicleData:
    """Return the size and the limits of a vehicle."""
    length = float(sumo.vehicle_getLength(vehicle))
    wheelbase = WHEELBASE_SHARE * length
    return VehicleData(
        length=length,
        width=float(sumo.vehicle_getWidth(vehicle)),
        wheelbase=wheelbase,
        rear_axle_offset=wheelbase / 2,
        max_speed=float(sumo.vehicle_getMaxSpeed(vehicle)),
        max_acceleration=float(sumo.vehicle_getAccel(vehicle)),
        max_deceleration=float(sumo.vehicle_getDecel(vehicle)),
        emergency_deceleration=float(sumo.vehicle_getEmergencyDecel(vehicle)),
        kind=str(sumo.vehicle_getVehicleClass(vehicle)),
        max_steering=MAX_STEERING_RAD,
        max_steering_rate=MAX_STEERING_RATE_RADPS,
        max_jerk=MAX_JERK_MPS3,
    )


def _known(value: float) -> float:
    return 0.0 if value == NO_VALUE else value


class EgoReader(Reader):
    """Reads the controlled vehicle."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        self._last: list[float] = []  # heading and speed, which the core may change
        self._place: tuple[float, float] | None = None
        self._driven_m = 0.0

    def observe(self, moment: AgentMoment) -> NDArray[np.float64]:
        """Return the columns of ``ego``."""
        return np.array(self._values(moment))

    def write(self, draft: Draft, place: int, moment: AgentMoment) -> None:
        """Write the columns of ``ego``."""
        setup = self._setup
        if setup.steering is None and not setup.graph.is_left_hand:
            facts = setup.start_m, setup.start_s, setup.step_length_s, _lane_index(moment.lane)
            if draft.ego(place, self._last, facts):
                return
        draft.put(place, self._values(moment))

    def _values(self, moment: AgentMoment) -> tuple[float, ...]:
        setup, scene, row = self._setup, moment.scene, moment.row
        agent, actor = setup.agent, scene.roster.actors[row]
        heading, speed = scene.headings[row], scene.speeds[row]
        acceleration, yaw_rate = _known(sumo.vehicle_getAcceleration(agent)), 0.0
        if self._last:  # SUMO reports no acceleration of a vehicle that it has moved to a position
            acceleration = (speed - self._last[1]) / setup.step_length_s
            yaw_rate = wrapped(heading - self._last[0]) / setup.step_length_s
        self._last[:] = heading, speed
        steering = setup.steering() if setup.steering is not None else bicycle_steering(yaw_rate, speed, actor.length)
        x, y = center_of(scene, row)
        distance = sumo.vehicle_getDistance(agent) - setup.start_m
        if setup.steering is not None:  # SUMO measures along the lane, even if the vehicle crosses it
            self._driven_m += math.dist((x, y), self._place) if self._place is not None else 0.0
            self._place, distance = (x, y), self._driven_m
        return (
            x, y, wrapped(heading), speed,
            acceleration, yaw_rate, steering, actor.length, actor.width,
            _lane_index(moment.lane),
            setup.offset_of(agent),
            distance, scene.time_s - setup.start_s,
        )  # fmt: skip


def _lane_index(lane: str) -> float:
    return float(lane.rpartition("_")[2] or 0)


class ActorsReader(Reader):
    """Reads the actors around the controlled vehicle."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        self._path = PathAhead(setup.agent, setup.graph, setup.settings["radius"])
        self._limits = setup.settings["radius"], setup.limit, setup.step_length_s
        self._speeds: dict[str, float] = {}
        self._actors: tuple[Actor, ...] = ()
        self._who: tuple[list[float], list[str]] = [], []
        self._rows: list[int] = []  # the core may change them, and the speeds
        self._relations: Relations | None = None
        if setup.settings["relation"]:
            self._relations = Relations(self._path, setup.graph, setup.conflicts, setup.settings["radius"])

    @property
    def ids(self) -> tuple[str, ...]:
        """Identifiers of the actors in the rows, as in scenes."""
        return tuple([self._actors[row].id for row in self._rows])

    def enter(self, actors: tuple[Actor, ...]) -> None:
        """Set the actors in sight."""
        if actors is not self._actors:
            kinds, ids = self._who
            kinds[:], ids[:] = [kind_number(actor.kind) for actor in actors], [actor.id for actor in actors]
            self._actors = actors

    def write(self, draft: Draft, place: int, moment: AgentMoment) -> None:
        """Write the columns of ``actors``."""
        scene = moment.scene
        self.enter(scene.roster.actors)
        is_usual = not (scene.heights or moment.hidden or self._setup.graph.is_left_hand or self._relations)
        facts = self._path.update(moment.lane).facts
        if not (is_usual and draft.actors(place, self._who, self._limits, (self._speeds, self._rows), facts)):
            draft.put_array(place, self.observe(moment))

    def observe(self, moment: AgentMoment) -> NDArray[np.float64]:
        """Return the columns of ``actors``."""
        scene, row = moment.scene, moment.row
        headings, speeds, actors = scene.headings, scene.speeds, scene.roster.actors
        own_x, own_y = center_of(scene, row)
        own_cos, own_sin = cos(headings[row]), sin(headings[row])
        path, relations = self._path.update(moment.lane), self._relations
        if relations is not None:
            relations.update(own_x, own_y, headings[row])
        found, last_speeds = [], dict(self._speeds)
        self._speeds.clear()
        near = self._actors_near(moment)
        for _, other, x, y in near:
            actor, heading, speed = actors[other], headings[other], speeds[other]
            lane, offset, acceleration, signals = _state_of(actor.id, self._setup)
            if (last := last_speeds.get(actor.id)) is not None:
                acceleration = (speed - last) / self._setup.step_length_s
            self._speeds[actor.id] = speed
            ahead = (x - own_x) * own_cos + (y - own_y) * own_sin
            indicator = _indicator(signals)
            is_same = lane in path.lanes or (ahead < 0.0 and path.is_entered_from(lane))
            values: tuple[float, ...] = (
                1.0, x, y, wrapped(heading), speed * cos(heading), speed * sin(heading), acceleration,
                actor.length, actor.width, kind_number(actor.kind), float(is_same),
                ahead, offset, float(bool(signals & _BRAKE_LIGHT)), indicator,
            )  # fmt: skip
            if relations is not None:
                values += relations.of(lane, x, y, heading, is_same=is_same)
            found.append(values)
        self._actors, self._rows[:] = actors, [other for _, other, _, _ in near]
        rows = np.zeros(self._setup.shape)
        if found:
            rows[: len(found)] = found
        return rows


def _state_of(actor: str, setup: ReaderSetup) -> tuple[str, float, float, int]:
    """Return the lane, the lateral offset, the acceleration and the signals of an actor."""
    try:
        if is_person(actor):
            return sumo.person_getLaneID(actor.removeprefix(PERSON)), 0.0, 0.0, 0
        lane = sumo.vehicle_getLaneID(actor)
        return lane, setup.offset_of(actor), _known(sumo.vehicle_getAcceleration(actor)), sumo.vehicle_getSignals(actor)
    except libsumo.TraCIException:  # an actor of a recording that is played back
        return _UNKNOWN


def lights_of(vehicle: str) -> tuple[int, int]:
    """Return the brake light (0 or 1) and the indicator of a vehicle; the indicator as in ``actors``."""
    signals = sumo.vehicle_getSignals(vehicle)
    return int(bool(signals & _BRAKE_LIGHT)), int(_indicator(signals))


def _indicator(signals: int) -> float:
    if signals & _HAZARD or (signals & _LEFT and signals & _RIGHT):
        return 2.0
    return 1.0 if signals & _LEFT else -1.0 if signals & _RIGHT else 0.0
