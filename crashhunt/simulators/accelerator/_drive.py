"""How vehicles decide: `Road.act`, with everybody's arithmetic done at once.

Vehicles decide one after another, and may see where those before them now want to go; lanes are therefore chosen in
their order. Steering and acceleration depend on nothing that changes meanwhile.
"""

from __future__ import annotations

import math
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from highway_env.utils import not_zero
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle

from crashhunt.simulators.accelerator._frame import MANY
from crashhunt.simulators.accelerator._known import are_numbers, kinds_of, originals
from crashhunt.simulators.accelerator._network import wrap_to_pi

if TYPE_CHECKING:
    from highway_env.road.road import LaneIndex, Road
    from highway_env.vehicle.behavior import IDMVehicle
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.simulators.accelerator._frame import Frame

__all__ = ["decide"]

_STEERING = attrgetter("speed", "heading", "TAU_PURSUIT", "KP_LATERAL", "KP_HEADING", "LENGTH", "MAX_STEERING_ANGLE")
_FOLLOWING = attrgetter("COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DELTA", "DISTANCE_WANTED", "TIME_WANTED")
_THINKING = attrgetter(
    "ACC_MAX", "POLITENESS", "LANE_CHANGE_DELAY", "LANE_CHANGE_MIN_ACC_GAIN", "LANE_CHANGE_MAX_BRAKING_IMPOSED", "timer"
)
_WHOLE = 2**53  # up to here, floats hold whole numbers


def decide(road: Road, frame: Frame) -> bool:
    """Let all vehicles decide; False where one of them is not known, and nothing was done."""
    vehicles = road.vehicles
    kinds, others = kinds_of(vehicles), kinds_of(road.objects)
    if not all(kind.drives and kind.is_of(vehicle) for kind, vehicle in zip(kinds, vehicles, strict=True)):
        return False
    if not all(kind.collides and kind.is_of(thing) for kind, thing in zip(others, road.objects, strict=True)):
        return False
    try:
        decisions = _Decisions(road, frame, [kind.drives for kind in kinds])
    except AttributeError:  # highway-env may never ask for what somebody's vehicle lacks
        return False
    if not decisions.are_usual:
        return False
    decisions.take()
    return True


class _Decisions:
    def __init__(self, road: Road, frame: Frame, drives: list[str]) -> None:
        self.road = road
        self.frame = frame
        self.network = frame.network
        self.drives = drives
        drivers = [(vehicle, how) for vehicle, how in zip(road.vehicles, drives, strict=True) if how != "nothing"]
        self.steering = {id(vehicle): _STEERING(vehicle) for vehicle, _ in drivers}
        self.following = {id(vehicle): _FOLLOWING(vehicle) for vehicle, how in drivers if how == "idm"}
        read = [*self.steering.values(), *self.following.values()]
        read += [_THINKING(vehicle) for vehicle, how in drivers if how == "idm"]
        read += [(vehicle.KP_A,) for vehicle, _ in drivers]
        read += [(thing.heading, thing.speed) for thing in frame.things]
        #: whether all that they reckon with are numbers of the usual kinds, whose road is this one
        self.are_usual = (
            are_numbers(chain.from_iterable(read))
            and all(_is_speed(vehicle.target_speed) for vehicle, _ in drivers)
            and all(vehicle.road is road for vehicle in road.vehicles)
        )
        if not self.are_usual:
            return
        self.headings = np.array([thing.heading for thing in frame.things], float)
        self.speeds = np.array([thing.speed for thing in frame.things], float)
        self.directions = np.stack((np.cos(self.headings), np.sin(self.headings)), axis=1)
        self.velocities = self.speeds[:, None] * self.directions

    def take(self) -> None:
        """Choose lanes one after another, then steer and accelerate."""
        steering: list[tuple[int, int | None]] = []  # row, lane
        following: list[tuple[int, IDMVehicle, Vehicle]] = []  # row, who follows, whom
        changing: list[int] = []  # which of these follow somebody on another lane as well
        index = self.network.index
        for row, vehicle in enumerate(self.road.vehicles):
            drives = self.drives[row]
            if drives == "nothing" or (drives == "idm" and vehicle.crashed):
                continue
            self._follow_road(row, vehicle)
            if drives == "idm":
                if vehicle.enable_lane_change and (
                    vehicle.lane_index != vehicle.target_lane_index or vehicle.timer > vehicle.LANE_CHANGE_DELAY
                ):
                    self._change_lane(row, vehicle)
                lane, target = vehicle.lane_index, vehicle.target_lane_index
                following.append((row, vehicle, self._neighbours(row, vehicle, lane)[0]))
                if lane != target:
                    changing.append(len(following))
                    following.append((row, vehicle, self._neighbours(row, vehicle, target)[0]))
            steering.append((row, index.get(vehicle.target_lane_index)))
        if not steering:
            return
        angles = self._steer(steering)
        accelerations = self._accelerate_all(following) if following else []
        second = set(changing)
        wanted: dict[int, float] = {}
        for number, ((row, _, _), acceleration) in enumerate(zip(following, accelerations, strict=True)):
            wanted[row] = min(wanted[row], acceleration) if number in second else acceleration
        for (row, _), angle in zip(steering, angles, strict=True):
            vehicle = self.road.vehicles[row]
            action = {"steering": angle}
            if self.drives[row] == "idm":
                limit = vehicle.ACC_MAX
                action["acceleration"] = _clip(wanted[row], -limit, limit)
            else:
                action["acceleration"] = vehicle.KP_A * (vehicle.target_speed - vehicle.speed)
            vehicle.action = action

    def _neighbours(self, row: int, vehicle: Vehicle, key: LaneIndex) -> tuple[RoadObject | None, RoadObject | None]:
        found = self.frame.neighbours(vehicle, row, key or vehicle.lane_index)
        if found is None:
            found = originals["Road.neighbour_vehicles"](self.road, vehicle, key)
        return found

    def _follow_road(self, row: int, vehicle: Vehicle) -> None:
        key = vehicle.target_lane_index
        lane = self.network.index.get(key)
        if lane is None:  # such as a key without a number
            found = self.road.network.get_lane(key)
            s, length = float(found.local_coordinates(vehicle.position)[0]), found.length
        else:
            s, length = self.frame.coordinates(row, lane)[0], self.network.lengths[lane]
        if s > length - 5 / 2:
            vehicle.follow_road()

    def _change_lane(self, row: int, vehicle: Vehicle) -> None:
        """`IDMVehicle.change_lane_policy`, where it is time to think of that."""
        lane, target = vehicle.lane_index, vehicle.target_lane_index
        if lane != target:
            if lane[:2] == target[:2]:
                for other in self.road.vehicles:
                    if (
                        other is not vehicle
                        and other.lane_index != target
                        and isinstance(other, ControlledVehicle)
                        and other.target_lane_index == target
                    ):
                        distance = self._lane_distance(row, vehicle, other)
                        if 0 < distance < self._desired_gap(row, vehicle, vehicle, other):
                            vehicle.target_lane_index = lane
                            break
            return
        vehicle.timer = 0
        for key in self.road.network.side_lanes(lane):
            number = self.network.index[key]
            if not self.network.is_reachable(number, *self.frame.coordinates(row, number)):
                continue
            if abs(vehicle.speed) < 1:
                continue
            if self._mobil(row, vehicle, key):
                vehicle.target_lane_index = key

    def _mobil(self, row: int, vehicle: Vehicle, key: LaneIndex) -> bool:
        """`IDMVehicle.mobil`; accelerations that cannot decide anything are not computed."""
        ahead, behind = self._neighbours(row, vehicle, key)
        limit = -vehicle.LANE_CHANGE_MAX_BRAKING_IMPOSED
        behind_then = self._acceleration(vehicle, behind, vehicle)
        if behind_then < limit:
            return False
        old_ahead, old_behind = self._neighbours(row, vehicle, vehicle.lane_index)
        own_then = self._acceleration(vehicle, vehicle, ahead)
        route = vehicle.route
        if route and route[0][2] is not None:
            current = vehicle.target_lane_index[2]
            if np.sign(key[2] - current) != np.sign(route[0][2] - current):
                return False
            return not own_then < limit
        gain = own_then - self._acceleration(vehicle, vehicle, old_ahead)
        if vehicle.POLITENESS != 0:
            behind_now = self._acceleration(vehicle, behind, ahead)
            old_now = self._acceleration(vehicle, old_behind, vehicle)
            old_then = self._acceleration(vehicle, old_behind, old_ahead)
            gain = gain + vehicle.POLITENESS * (behind_then - behind_now + old_then - old_now)
        return not gain < vehicle.LANE_CHANGE_MIN_ACC_GAIN

    def _lane_distance(self, row: int, vehicle: Vehicle, other: RoadObject) -> float:
        """`RoadObject.lane_distance_to`."""
        lane = self.network.number.get(id(vehicle.lane))
        if lane is None:
            return float(vehicle.lane_distance_to(other))
        return self.frame.coordinates(self.frame.row[id(other)], lane)[0] - self.frame.coordinates(row, lane)[0]

    def _desired_gap(self, row: int, driver: IDMVehicle, vehicle: Vehicle, other: RoadObject) -> float:
        """`IDMVehicle.desired_gap`, with the driver's parameters."""
        limit = -driver.COMFORT_ACC_MAX * driver.COMFORT_ACC_MIN
        faster = self.velocities[row] - self.velocities[self.frame.row[id(other)]]
        closing = float(np.dot(faster, self.directions[row]))
        speed = vehicle.speed
        return float(driver.DISTANCE_WANTED + speed * driver.TIME_WANTED + speed * closing / (2 * math.sqrt(limit)))

    def _acceleration(self, driver: IDMVehicle, vehicle: Vehicle, ahead: RoadObject) -> float:
        """`IDMVehicle.acceleration`: of a vehicle behind another one, with the driver's parameters."""
        if not vehicle or not isinstance(vehicle, Vehicle):
            return 0
        speed, comfort = vehicle.speed, driver.COMFORT_ACC_MAX
        ratio = max(speed, 0) / abs(not_zero(_target_speed(vehicle)))
        wanted = comfort * (1 - float(np.power(ratio, driver.DELTA)))
        if ahead:
            row = self.frame.row[id(vehicle)]
            gap = self._desired_gap(row, driver, vehicle, ahead)
            distance = self._lane_distance(row, vehicle, ahead)
            wanted -= comfort * float(np.power(gap / not_zero(distance), 2))
        return float(wanted)

    def _accelerate_all(self, following: list[tuple[int, IDMVehicle, Vehicle]]) -> list[float]:
        """The same for many who follow for themselves."""
        table = np.array([self.following[id(vehicle)] for _, vehicle, _ in following], float).T
        comfort, braking, delta, distance_wanted, time_wanted = table
        rows = np.array([row for row, _, _ in following])
        speed = self.speeds[rows]
        target = np.array([not_zero(_target_speed(vehicle)) for _, vehicle, _ in following], float)
        wanted = comfort * (1 - np.power(np.maximum(speed, 0) / np.abs(target), delta))
        behind = [number for number, (_, _, ahead) in enumerate(following) if ahead]
        if behind:
            number_of = self.frame.row
            some = np.array(behind)
            own, others = rows[some], np.array([number_of[id(following[number][2])] for number in behind])
            speed, comfort = speed[some], comfort[some]
            closing = np.vecdot(self.velocities[own] - self.velocities[others], self.directions[own])
            limit = -comfort * braking[some]
            gap = distance_wanted[some] + speed * time_wanted[some] + speed * closing / (2 * np.sqrt(limit))
            distance = self._lane_distances([following[number] for number in behind], own, others)
            wanted[some] -= comfort * np.power(gap / distance, 2)
        found: list[float] = wanted.tolist()
        return found

    def _lane_distances(
        self, pairs: list[tuple[int, IDMVehicle, Vehicle]], own: NDArray[np.intp], others: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """`RoadObject.lane_distance_to` of many pairs, of which none is zero."""
        if len(pairs) < MANY:
            return np.array([not_zero(self._lane_distance(*pair)) for pair in pairs])
        number_of, column_of = self.network.number, self.network.axis_column
        columns = [column_of.get(number_of.get(id(vehicle.lane), -1), -1) for _, vehicle, _ in pairs]
        if -1 in columns:
            return np.array([not_zero(self._lane_distance(*pair)) for pair in pairs])
        along = self.frame.on_axis[0]
        distance: NDArray[np.float64] = along[others, columns] - along[own, columns]
        return np.where(np.abs(distance) > 1e-2, distance, np.where(distance >= 0, 1e-2, -1e-2))

    def _places(
        self, steering: list[tuple[int, int | None]], speed: NDArray[np.float64], pursuit: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How far to the side of their lanes vehicles are, and how these run where they look at."""
        vehicles, column_of = self.road.vehicles, self.network.axis_column
        columns = [column_of.get(lane, -1) if lane is not None else -1 for _, lane in steering]
        if len(steering) >= MANY and -1 not in columns:
            return self.frame.on_axis[1][[row for row, _ in steering], columns], self.network.heading[columns]
        places, ahead = [], []
        for (row, lane), v, tau in zip(steering, speed.tolist(), pursuit.tolist(), strict=True):
            if lane is None:
                key = vehicles[row].target_lane_index
                found = self.road.network.get_lane(key)
                s, r = map(float, found.local_coordinates(vehicles[row].position))
                ahead.append(float(found.heading_at(s + v * tau)))
            else:
                s, r = self.frame.coordinates(row, lane)
                ahead.append(self.network.heading_at(lane, s + v * tau))
            places.append(r)
        return np.array(places), np.array(ahead)

    def _steer(self, steering: list[tuple[int, int | None]]) -> list[float]:
        """`ControlledVehicle.steering_control` of many."""
        vehicles = self.road.vehicles
        table = np.array([self.steering[id(vehicles[row])] for row, _ in steering], float).T
        speed, heading, pursuit, lateral, turning, length, most = table
        places, ahead = self._places(steering, speed, pursuit)
        speed = np.where(np.abs(speed) > 1e-2, speed, np.where(speed >= 0, 1e-2, -1e-2))
        command = np.arcsin(np.clip(-lateral * places / speed, -1, 1))
        reference = ahead + np.clip(command, -np.pi / 4, np.pi / 4)
        rate = turning * wrap_to_pi(reference - heading)
        slip = np.arcsin(np.clip(length / 2 / speed * rate, -1, 1))
        found_angles: list[float] = np.clip(np.arctan(2 * np.tan(slip)), -most, most).tolist()
        return found_angles


def _is_speed(value: object) -> bool:
    """Whether a target speed is a usual number, or a whole one of NumPy's that a float holds: one out of a list."""
    return are_numbers((value,)) or (isinstance(value, np.int64) and -_WHOLE < int(value) < _WHOLE)


def _target_speed(vehicle: Vehicle) -> float:
    target = getattr(vehicle, "target_speed", 0)
    lane = vehicle.lane
    if lane and lane.speed_limit is not None:
        return _clip(target, 0, lane.speed_limit)
    return float(target)


def _clip(value: float, low: float, high: float) -> float:
    """`numpy.clip` of one number; what is not a number stays so."""
    return float(low if value < low else high if value > high else value)
