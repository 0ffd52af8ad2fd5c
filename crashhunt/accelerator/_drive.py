"""Decisions of vehicles: `Road.act`, with the arithmetic of all vehicles in arrays.

highway-env's vehicles decide one after another, and a vehicle reads the target lanes of the vehicles before it. All
other inputs of a decision, such as positions and accelerations, stay constant meanwhile. So they are computed first,
for all vehicles together.
"""

from __future__ import annotations

import math
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from highway_env.vehicle.kinematics import Vehicle

from crashhunt.accelerator._network import wrap_to_pi
from crashhunt.accelerator._vehicle_arrays import ASK, MANY
from crashhunt.accelerator._versions import are_numbers, originals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from highway_env.road.road import LaneIndex, Road
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.accelerator._vehicle_arrays import Crowd, Frame


__all__ = ["decide"]


_AIM = attrgetter("target_lane_index")
_WHOLE = 2**53  # floats represent all integers up to this number exactly


def decide(road: Road, frame: Frame, crowd: Crowd) -> bool:
    """Let all vehicles decide; return False, with nothing changed, if a vehicle is unknown or an error occurs.

    Args:
        road: The road.
        frame: The positions of its vehicles.
        crowd: The vehicles; the accelerator knows how all of them decide.
    """
    decisions = _Decisions(road, frame, crowd)
    if not decisions.are_usual:
        return False
    try:
        decisions.take()
    except (
        Exception
    ):  # highway-env's own code must then fail at the same vehicle, after the decisions of the vehicles before it
        decisions.undo()
        return False
    return True


class _Decisions:
    def __init__(self, road: Road, frame: Frame, crowd: Crowd) -> None:
        self.road = road
        self.frame = frame
        self.crowd = crowd
        self.network = frame.network
        vehicles, index, number = crowd.vehicles, self.network.index, self.network.number
        self.idm = [row for row in crowd.idm if not vehicles[row].crashed]
        self.rows = sorted(crowd.controlled + self.idm) if crowd.controlled else self.idm
        lanes = crowd.lanes
        self.lanes = np.array([number.get(id(v.lane), -1) for v in vehicles]) if lanes is None else lanes
        self.aims = list(map(_AIM, map(vehicles.__getitem__, self.rows)))
        self.wanted = [getattr(vehicle, "target_speed", 0) for vehicle in vehicles]
        self.timers = [vehicles[row].timer for row in self.idm]
        #: whether all inputs are floats, ints or NumPy floats, and all lanes belong to this road
        self.are_usual = _are_speeds(self.wanted) and are_numbers(self.timers)
        try:
            targets = list(map(index.get, self.aims))
        except TypeError:  # highway-env accepts a list as a lane index, which is not hashable
            targets = [None]
        self.are_usual &= None not in targets and bool((self.lanes >= 0).all())
        if not self.are_usual:
            return
        self.targets = np.array(targets, int)
        self.along, self.across = frame.coordinates_of(self.rows, self.targets)
        over = self.along > self.network.every_length[self.targets] - 5 / 2
        self.leaving = [self.rows[number] for number in np.flatnonzero(over).tolist()]
        #: the routes of vehicles near the end of their target lane, with a copy of the remaining parts
        self.routes = [(vehicles[row].route, list(vehicles[row].route or ())) for row in self.leaving]
        if self.leaving:
            routes = [id(vehicles[row].route) for row in self.rows if vehicles[row].route]
            self.are_usual = len(set(routes)) == len(routes)  # with a shared route, one vehicle's change affects others
        #: the accelerations to compute: rows of the drivers with the parameters, of the vehicles, of those ahead
        self.asked: tuple[list[int], list[int], list[int]] = ([], [], [])
        #: index in `asked` of a vehicle's acceleration on another lane, by the vehicle's row and that lane
        self.elsewhere: dict[tuple[int, LaneIndex], int] = {}
        #: previous target lanes of vehicles near the end of their target lane
        self.before: dict[int, LaneIndex] = {}
        self.directions = np.empty((len(crowd.headings), 2))
        np.cos(crowd.headings, out=self.directions[:, 0])
        np.sin(crowd.headings, out=self.directions[:, 1])
        self.velocities = crowd.speeds[:, None] * self.directions

    def take(self) -> None:
        """Choose lanes one after another, then steer and accelerate."""
        if not self.rows:
            return
        vehicles = self.crowd.vehicles
        for row in self.leaving:
            self.before[row] = vehicles[row].target_lane_index
            vehicles[row].follow_road()
        elsewhere = [row for row in self.idm if vehicles[row].lane_index != vehicles[row].target_lane_index]
        there = set(elsewhere)
        thinking = [
            row for row in self.idm
            if vehicles[row].timer > vehicles[row].LANE_CHANGE_DELAY
            and vehicles[row].enable_lane_change and row not in there
        ]  # fmt: skip
        self._ask_all(elsewhere)
        self.tame = not thinking or (self.crowd.tame and math.isfinite(np.add.reduce(self.velocities, None)))
        ways = {row: self._ways(row) for row in thinking}
        accelerations = [*self._accelerations(), 0.0]  # index -1: the acceleration of a missing vehicle is 0
        for row in sorted(elsewhere + thinking):
            if row in ways:
                self._choose(row, ways[row], accelerations)
            elif vehicles[row].enable_lane_change:
                self._turn_back(row)
        number_of = {row: number for number, row in enumerate(self.idm)}
        for row in elsewhere + thinking:
            if (key := vehicles[row].target_lane_index) != vehicles[row].lane_index:
                number = number_of[row]
                accelerations[number] = min(accelerations[number], accelerations[self.elsewhere[row, key]])
        self._look_again({*self.leaving, *elsewhere, *thinking})
        self._act(accelerations[: len(self.idm)])

    def undo(self) -> None:
        """Restore all vehicles; their actions need no restoring, because `_act` sets them last."""
        vehicles = self.crowd.vehicles
        for row, key in zip(self.rows, self.aims, strict=True):
            vehicles[row].target_lane_index = key
        for row, timer in zip(self.idm, self.timers, strict=True):
            vehicles[row].timer = timer
        for route, rest in self.routes:
            if type(route) is list:  # highway-env removes parts of lists only
                route[:] = rest

    def _act(self, accelerations: list[float]) -> None:
        vehicles = self.crowd.vehicles
        if self.idm:
            limit = self.crowd.numbers["ACC_MAX"][self.idm]
            accelerations = np.array(accelerations).clip(-limit, limit).tolist()
        found: dict[int, float] = dict(zip(self.idm, accelerations, strict=True))
        for row, angle in zip(self.rows, self._steer(), strict=True):
            vehicle = vehicles[row]
            if row in found:
                vehicle.action = {"steering": angle, "acceleration": found[row]}
            else:
                acceleration = vehicle.KP_A * (vehicle.target_speed - vehicle.speed)
                vehicle.action = {"steering": angle, "acceleration": acceleration}

    def _neighbours(self, row: int, key: LaneIndex) -> tuple[RoadObject | None, RoadObject | None]:
        vehicle = self.crowd.vehicles[row]
        found = self.frame.neighbours(vehicle, row, key or vehicle.lane_index)
        if found is None:
            found = originals["Road.neighbour_vehicles"](self.road, vehicle, key)
        return found

    def _ask(self, driver: int, vehicle: RoadObject | None, ahead: RoadObject | None) -> int:
        """Request an acceleration, as by `IDMVehicle.acceleration`; return its index."""
        if vehicle is None or not isinstance(vehicle, Vehicle):
            return -1
        drivers, whose, behind = self.asked
        drivers.append(driver)
        whose.append(self.frame.row[id(vehicle)])
        behind.append(-1 if ahead is None else self.frame.row[id(ahead)])
        return len(drivers) - 1

    def _ask_all(self, elsewhere: list[int]) -> None:
        """Request the accelerations of all vehicles on their lanes, and on their target lanes if these differ."""
        vehicles, idm = self.crowd.vehicles, self.idm
        lanes = self.lanes[idm]
        columns = self.network.axis_columns[lanes]
        ahead = [ASK] * len(idm)
        if len(idm) >= MANY and columns.min() >= 0 and not self.road.neighbour_vehicles_connected_lanes:
            ahead = self.frame.ahead[idm, columns].tolist()
        keys = self.network.keys
        for number, (row, lane) in enumerate(zip(idm, lanes.tolist(), strict=True)):
            key = vehicles[row].lane_index
            if ahead[number] == ASK or key != keys[lane]:
                found = self._neighbours(row, key)[0]
                ahead[number] = -1 if found is None else self.frame.row[id(found)]
        self.asked = list(idm), list(idm), ahead
        for row in elsewhere:
            key = vehicles[row].target_lane_index
            self.elsewhere[row, key] = self._ask(row, vehicles[row], self._neighbours(row, key)[0])

    def _ways(self, row: int) -> list[tuple[LaneIndex, tuple[int, ...]]]:
        """Return the neighbouring lanes that a vehicle can reach, each with the accelerations that MOBIL compares."""
        vehicle = self.crowd.vehicles[row]
        found = []
        for key in self.road.network.side_lanes(vehicle.lane_index):
            lane = self.network.index[key]
            if abs(vehicle.speed) < 1 or not self.network.is_reachable(lane, *self.frame.coordinates(row, lane)):
                continue
            ahead, behind = self._neighbours(row, key)
            self.elsewhere[row, key] = own_then = self._ask(row, vehicle, ahead)
            asked = [own_then, self._ask(row, behind, vehicle)]
            # With politeness 0 the gain of others has no effect. But 0 times infinity is NaN, so compute it then.
            if vehicle.POLITENESS != 0 or not self.tame:
                old_ahead, old_behind = self._neighbours(row, vehicle.lane_index)
                pairs = ((behind, ahead), (old_behind, vehicle), (old_behind, old_ahead))
                asked += [self._ask(row, *pair) for pair in pairs]
            found.append((key, tuple(asked)))
        return found

    def _choose(self, row: int, ways: list[tuple[LaneIndex, tuple[int, ...]]], accelerations: list[float]) -> None:
        """Do what `IDMVehicle.change_lane_policy` does when the timer allows a lane change."""
        vehicle = self.crowd.vehicles[row]
        vehicle.timer = 0
        own = accelerations[self.idm.index(row)]
        for key, asked in ways:
            if self._recommends(vehicle, key, own, *[accelerations[number] for number in asked]):
                vehicle.target_lane_index = key

    def _recommends(
        self, vehicle: Vehicle, key: LaneIndex, own_now: float, own_then: float, behind_then: float, *others: float
    ) -> bool:
        """Return the result of `IDMVehicle.mobil`."""
        limit = -vehicle.LANE_CHANGE_MAX_BRAKING_IMPOSED
        if behind_then < limit:
            return False
        route = vehicle.route
        if route and route[0][2] is not None:
            current = vehicle.target_lane_index[2]
            if np.sign(key[2] - current) != np.sign(route[0][2] - current):
                return False
            return not own_then < limit
        gain = own_then - own_now
        if others:
            behind_now, old_now, old_then = others
            gain = gain + vehicle.POLITENESS * (behind_then - behind_now + old_then - old_now)
        return not gain < vehicle.LANE_CHANGE_MIN_ACC_GAIN

    def _turn_back(self, row: int) -> None:
        """Do what `change_lane_policy` does during a lane change: abort it if another vehicle has the same target."""
        vehicles = self.crowd.vehicles
        vehicle = vehicles[row]
        lane, target = vehicle.lane_index, vehicle.target_lane_index
        if lane[:2] != target[:2]:
            return
        for number, (other, aims) in enumerate(zip(vehicles, self.crowd.aims, strict=True)):
            if number == row or not aims or other.lane_index == target:
                continue
            wanted = other.target_lane_index
            if number > row:  # in highway-env, this vehicle has not updated its target lane yet
                wanted = self.before.get(number, wanted)
            if wanted == target and 0 < self._lane_distance(row, number) < self._desired_gap(row, number):
                vehicle.target_lane_index = lane
                return

    def _lane_distance(self, row: int, other: int) -> float:
        """Return the result of `RoadObject.lane_distance_to`."""
        lane = int(self.lanes[row])
        return self.frame.coordinates(other, lane)[0] - self.frame.coordinates(row, lane)[0]

    def _desired_gap(self, row: int, other: int) -> float:
        """Return the result of `IDMVehicle.desired_gap`."""
        rows, others = np.array([row]), np.array([other])
        return float(self._desired_gaps(rows, rows, others)[0])

    def _desired_gaps(
        self, drivers: NDArray[np.intp], whose: NDArray[np.intp], ahead: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Return the desired gaps of vehicles ``whose`` behind ``ahead``, with the parameters of ``drivers``."""
        comfort, braking, wanted, time = self.crowd.of_gaps[:, drivers]
        speed, limit = self.crowd.speeds[whose], -comfort * braking
        closing = np.vecdot(self.velocities[whose] - self.velocities[ahead], self.directions[whose])
        gap: NDArray[np.float64] = wanted + speed * time + speed * closing / (2 * np.sqrt(limit))
        return gap

    def _accelerations(self) -> list[float]:
        """Return the requested accelerations, as `IDMVehicle.acceleration` computes them."""
        if not self.asked[0]:
            return []
        drivers, whose, ahead = map(np.array, self.asked)
        low, high = self.network.limit[:, self.lanes]
        wanted = np.abs(_not_zero(np.array(self.wanted, float).clip(low, high)))
        comfort, delta = self.crowd.of_speeds[:, drivers]
        found = comfort * (1 - np.power((np.maximum(self.crowd.speeds, 0)[whose] / wanted[whose]), delta))
        some = np.flatnonzero(ahead >= 0)
        if len(some):
            drivers, whose, ahead = drivers[some], whose[some], ahead[some]
            lanes = self.lanes[whose]
            distance = self.frame.coordinates_of(ahead, lanes)[0] - self.frame.coordinates_of(whose, lanes)[0]
            gap = self._desired_gaps(drivers, whose, ahead)
            found[some] -= comfort[some] * np.power(gap / _not_zero(distance), 2)
        listed: list[float] = found.tolist()
        return listed

    def _look_again(self, rows: set[int]) -> None:
        """Update the coordinates of vehicles whose target lane may have changed."""
        index, vehicles = self.network.index, self.crowd.vehicles
        for number, row in enumerate(self.rows if rows else ()):
            if row in rows:
                lane = self.targets[number] = index[vehicles[row].target_lane_index]
                self.along[number], self.across[number] = self.frame.coordinates(row, lane)

    def _steer(self) -> list[float]:
        """Return the steering angles of all vehicles, as `ControlledVehicle.steering_control` computes them."""
        rows = self.rows
        pursuit, lateral, turning, length, most = self.crowd.of_steering[:, rows]
        heading, speed = self.crowd.headings[rows], self.crowd.speeds[rows]
        ahead = self.network.headings_at(self.targets, self.along + speed * pursuit)
        speed = _not_zero(speed)
        command = np.arcsin((-lateral * self.across / speed).clip(-1, 1))
        reference = ahead + command.clip(-np.pi / 4, np.pi / 4)
        rate = turning * wrap_to_pi(reference - heading)
        slip = np.arcsin((length / 2 / speed * rate).clip(-1, 1))
        angles: list[float] = np.arctan(2 * np.tan(slip)).clip(-most, most).tolist()
        return angles


def _not_zero(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the result of `highway_env.utils.not_zero` for each element."""
    return np.where(np.abs(x) > 1e-2, x, np.where(x >= 0, 1e-2, -1e-2))


def _are_speeds(values: Sequence[object]) -> bool:
    """Whether all target speeds are usual numbers, or NumPy integers that a float represents exactly."""
    return are_numbers(values) or all(map(_is_speed, values))


def _is_speed(value: object) -> bool:
    return are_numbers((value,)) or (isinstance(value, np.int64) and -_WHOLE < int(value) < _WHOLE)
