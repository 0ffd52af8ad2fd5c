"""Moves vehicles freely in the plane: by a kinematic bicycle model, on a trajectory, or to a pose.

SUMO places the vehicle by ``moveToXY`` with ``keepRoute=2``, and assigns it to the lane below it, so that the other
vehicles react to it there. SUMO's vehicles do not see a vehicle off all lanes, nor the part of it that is on another
lane than its front. `Followers` lets them react to it. SUMO reports no collision of such a vehicle, and it does not
arrive by itself. crashhunt detects collisions by the outlines, and this module detects arrival and leaving the road.
"""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING

import libsumo
import numpy as np
from libsumo import _libsumo as sumo

from crashhunt.base.errors import ActionError
from crashhunt.simulators import MAX_STEERING_RAD, REFERENCE_SHARES, WHEELBASE_SHARE, BicycleModel, MotionState
from crashhunt.sumo._drivable_area import offset_from
from crashhunt.world import Motion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.sumo._drivable_area import DrivableArea

_FREE = 2  # SUMO's keepRoute: the vehicle may leave its route and all lanes
_ARRIVED = 2  # SUMO's reason of a removal: the vehicle has arrived
_MAX_ACCELERATION_MPS2 = 10.0
_MAX_BRAKING_MPS2 = 15.0
_MAX_YAW_RATE_RADPS = 1.5
_OVER_M = 1.0  # a vehicle so far over the side of its lane is in the way of the next lane
_LOOK_S, _MIN_LOOK_M = 0.5, 4.0  # how far ahead a vehicle that keeps its lane looks
_MAX_LANES_AHEAD = 10
_CATCH_UP_S = 1.0  # in which a vehicle makes up for its distance from a pose that it cannot reach in time
_MAX_GAP_M = 5.0  # distance of a pursued trajectory from the vehicle, beyond the way to its first point
_STANDING_M = 0.01  # a vehicle that moves by less in a step does not turn
_KERB_M = 0.1  # an outline that is less off the road drives over no kerb
_CORNERS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))  # counter-clockwise, as shares of half the size
_ALONG_OUTLINE = tuple((ahead, left) for ahead in (1.0, -1.0, 0.5, 0.0, -0.5) for left in (1.0, -1.0))
_MAX_SPEED_ERROR_MPS = 0.01  # far more than a rounding error
_MAX_SLIDE_M, _MAX_TURN_RAD = 0.2, 0.05  # distance of a trajectory's start from the vehicle, as plans predict


class FreeMotion:
    """The motion of one vehicle in an episode, which begins with the vehicle on the road."""

    def __init__(
        self,
        vehicle: str,
        form: str,
        step_length_s: float,
        area: DrivableArea,
        settings: Mapping[str, float | str] = MappingProxyType({}),
    ) -> None:
        self._vehicle, self._form, self._dt, self._area = vehicle, form, step_length_s, area
        self._is_relative = settings.get("frame") == "ego"
        self._is_overruled = False
        self._aim: tuple[float, float] | None = None  # the position of the last target pose
        self._backwards_m = 0.0  # since the vehicle has last moved ahead by as much
        self._pursues = settings.get("tracker") == "pure_pursuit"
        self._half, self._half_width = sumo.vehicle_getLength(vehicle) / 2, sumo.vehicle_getWidth(vehicle) / 2
        self._ahead = 2 * self._half * REFERENCE_SHARES[str(settings.get("reference_point", "center"))]
        heading = math.radians(90.0 - sumo.vehicle_getAngle(vehicle))
        x, y = sumo.vehicle_getPosition(vehicle)
        self.place(x, y, heading, sumo.vehicle_getSpeed(vehicle))
        self.model = BicycleModel(
            wheelbase=WHEELBASE_SHARE * 2 * self._half,
            max_acceleration=sumo.vehicle_getAccel(vehicle),
            max_deceleration=sumo.vehicle_getDecel(vehicle),
            max_speed=sumo.vehicle_getMaxSpeed(vehicle),
        )
        self._kind = sumo.vehicle_getVehicleClass(vehicle)
        route = sumo.vehicle_getRoute(vehicle)
        self._route, self._goal, self._last = sumo.vehicle_getRouteID(vehicle), route[-1], len(route) - 1
        self.edges = frozenset(route)
        """The edges of the route; SUMO gives a vehicle that leaves its route another one."""
        self.events: list[tuple[str, str]] = []
        """The events of the last step, each with its kind and what the vehicle did."""
        self.inside = ""
        """The lane that the outline is inside, but for 0.1 m; empty if there is none, or it is not known yet."""
        self._is_over_kerb: bool | None = None  # not known yet
        sumo.vehicle_setSpeedMode(vehicle, 0)  # SUMO would otherwise report a speed within its own limits

    def place(self, x: float, y: float, heading: float, speed: float) -> None:
        """Set where the motion begins: the middle of the front bumper in m, the heading in rad, the speed in m/s."""
        x, y = x - self._half * math.cos(heading), y - self._half * math.sin(heading)
        self.state = MotionState(x=x, y=y, heading=heading, speed=speed)

    def apply(self, action: NDArray[np.generic]) -> bool:
        """Move the vehicle by an encoded action; return whether it stays on the road and hits no obstacle."""
        self.events.clear()
        state = self._next(action.tolist())
        self._aim = self._pose(action.tolist())[:2] if self._form == "target_pose" else None
        if self._arrives(state):
            sumo.vehicle_remove(self._vehicle, _ARRIVED)
            return True
        self._backwards_m = self._backwards_after(state)
        self.state = state
        front = state.x + self._half * math.cos(state.heading), state.y + self._half * math.sin(state.heading)
        self._return_to_route()
        try:
            sumo.vehicle_moveToXY(self._vehicle, "", -1, *front, 90.0 - math.degrees(state.heading), _FREE)
        except libsumo.TraCIException:
            if self._vehicle not in sumo.vehicle_getIDList():
                raise
            return False  # no lane is within 100 m
        sumo.vehicle_setSpeed(self._vehicle, state.speed)
        if self._area.has_obstacles and (hit := self._area.obstacle_at(self._outline(_CORNERS))):
            self.events.append(("off_road", f"drove into the {hit}"))
            return False
        return self._stays_on_road()

    def settle(self) -> None:
        """Restore the speed if SUMO has changed it in the step, as it does where the lane does not lead on."""
        with suppress(libsumo.TraCIException):  # it has left the road
            if abs(sumo.vehicle_getSpeed(self._vehicle) - self.state.speed) > _MAX_SPEED_ERROR_MPS:
                sumo.vehicle_setPreviousSpeed(self._vehicle, self.state.speed)

    def _return_to_route(self) -> None:
        """Give the vehicle its own route again after it has left the route, for example to overtake."""
        vehicle = self._vehicle
        if sumo.vehicle_getRouteID(vehicle) != self._route and sumo.vehicle_getRoadID(vehicle) in self.edges:
            with suppress(libsumo.TraCIException):  # SUMO may find no way on this route from here
                sumo.vehicle_setRouteID(vehicle, self._route)

    def _stays_on_road(self) -> bool:
        """Return whether the centre is on the road; add an event if the vehicle begins to drive over a kerb.

        At the start of a road, the rear of a vehicle that has just entered may be off the road.
        """
        half, half_width = self._half - _KERB_M, self._half_width - _KERB_M
        self.inside, is_over = self._area.lane_around(self.state, half, half_width, self._kind), False
        if not self.inside:
            if not self._area.contains(self.state.x, self.state.y, self._kind):
                return False
            points = zip(_ALONG_OUTLINE, self._outline(_ALONG_OUTLINE, _KERB_M), strict=True)
            outside = (place for place, point in points if not self._area.contains(*point, self._kind))
            first = next(outside, None)
            is_over = first is not None
            if first is not None and self._is_over_kerb is False:
                self.events.append(("kerb", f"drove over the kerb with {_words_of([first, *outside])}"))
        self._is_over_kerb = is_over
        return True

    def _outline(self, places: Sequence[tuple[float, float]], inset_m: float = 0.0) -> list[tuple[float, float]]:
        """Return points of the vehicle's outline.

        A place says how far a point is ahead and to the left of the centre, as shares of half the size. The points are
        ``inset_m`` inside of the outline.
        """
        state, (cos, sin) = self.state, (math.cos(self.state.heading), math.sin(self.state.heading))
        half, half_width = self._half - inset_m, self._half_width - inset_m
        return [
            (
                state.x + ahead * half * cos - left * half_width * sin,
                state.y + ahead * half * sin + left * half_width * cos,
            )
            for ahead, left in places
        ]

    def steering(self) -> float:
        """Return the steering angle of the last step in rad, positive to the left."""
        return self.state.steering

    def check(self, action: NDArray[np.float64]) -> None:
        """Check that the vehicle can follow an encoded trajectory or target pose in the next step.

        Raises:
            ActionError: the vehicle would jump, turn on the spot, drive backwards, or has no point to follow. Poses
                of an agent that was overruled may be anywhere.
        """
        state, values, dt = self.state, action.tolist(), self._dt
        if self._form == "trajectory" and values[-1][0] < dt:
            message = f"the trajectory ends {values[-1][0]:g} s from now, before the step of {dt:g} s"
            raise ActionError(message, fix="return points beyond the end of the step")
        if self._is_overruled:
            return
        if self._pursues:
            gap = min(math.dist(point[1:3], (state.x, state.y)) for point in self._in_map(action).tolist())
            reach = _MAX_GAP_M + values[0][0] * max(state.speed, values[0][4])  # it may have yet to drive to the first
            if gap > reach:
                message = f"the trajectory is {gap:.1f} m away from the vehicle"
                raise ActionError(message, fix=f"return a point within {reach:.1f} m")
            return
        refusal = self._refusal(self._next(values))
        if refusal is not None:
            raise refusal

    def _refusal(self, after: MotionState) -> ActionError | None:
        """Return why the vehicle cannot get to a state within a step; None if it can."""
        state, dt = self.state, self._dt
        dx, dy = after.x - state.x, after.y - state.y
        moved = math.hypot(dx, dy)
        most = (state.speed + _MAX_ACCELERATION_MPS2 * dt) * dt + _MAX_SLIDE_M
        least = (state.speed - _MAX_BRAKING_MPS2 * dt) * dt - _MAX_SLIDE_M
        if not least <= moved <= most:
            message = f"the {self._words} moves the vehicle by {moved:.3f} m in a step of {dt:g} s"
            least, most = math.ceil(max(0.0, least) * 100) / 100, math.floor(most * 100) / 100
            fix = f"return a pose between {least:.2f} and {most:.2f} m away"
            if self._form == "target_pose":  # which is the end of a curve over several steps
                fix = f"return a later time, or a pose with a way of {least:.2f} to {most:.2f} m in the step"
            return ActionError(message, fix=f"{fix}; positions are those of {self._point}")
        turned = math.remainder(after.heading - state.heading, math.tau)
        if abs(turned) > _MAX_YAW_RATE_RADPS * dt + _MAX_TURN_RAD:
            message = f"the {self._words} turns the vehicle by {turned:.2f} rad in a step of {dt:g} s"
            return ActionError(message, fix=f"turn by at most {_MAX_YAW_RATE_RADPS * dt + _MAX_TURN_RAD:.2f} rad")
        if (backwards := self._backwards_after(after)) > _MAX_SLIDE_M:
            message = f"the {self._words} moves the vehicle backwards by {backwards:.2f} m"
            return ActionError(message, fix=f"return poses ahead of it, or at most {_MAX_SLIDE_M:g} m behind it in all")
        return None

    def _backwards_after(self, after: MotionState) -> float:
        """Return how far the vehicle has moved backwards after a step, in m, less how far it has moved ahead since."""
        state = self.state
        dx, dy = after.x - state.x, after.y - state.y
        return max(0.0, self._backwards_m - dx * math.cos(state.heading) - dy * math.sin(state.heading))

    def motion_of(self, action: NDArray[np.generic]) -> Motion:
        """Return what an encoded action does: the speed after the step, and whether the vehicle leaves its lane."""
        after = self._next(action.tolist())
        path = self._path(_LOOK_S * after.speed)
        aside, direction = offset_from(path, after.x, after.y)
        moves = after.speed * math.sin(after.heading - direction) * _LOOK_S
        border = sumo.lane_getWidth(sumo.vehicle_getLaneID(self._vehicle)) / 2 - _OVER_M if path else math.inf
        leaves = abs(aside + moves) > border and moves * (aside + moves) > 0
        return Motion(speed_mps=after.speed, lane_change=0 if not leaves else 1 if aside + moves > 0 else -1)

    def action_with(self, action: NDArray[np.generic] | None, *, speed_mps: float | None, keeps_lane: bool) -> object:
        """Return the action with another speed after the step, or with the steering that keeps the lane.

        From then on, the vehicle may not be where the agent's plans begin: it pursues poses that it cannot reach.
        """
        self._is_overruled = True
        after = self.state if action is None else self._next(action.tolist())
        acceleration = after.acceleration if speed_mps is None else (speed_mps - self.state.speed) / self._dt
        return self._action(acceleration, self._lane_keeping_angle() if keeps_lane else after.steering)

    def brake(self) -> object:
        """Return the action that brakes as hard as the vehicle can, and steers to the middle of its lane."""
        return self._action(-self.model.max_deceleration, self._lane_keeping_angle())

    def _action(self, acceleration: float, steering: float) -> object:
        """Return the agent's action for an acceleration in m/s² and a steering angle in rad."""
        model = self.model
        acceleration = max(-_MAX_ACCELERATION_MPS2, min(_MAX_ACCELERATION_MPS2, acceleration))
        steering = max(-MAX_STEERING_RAD, min(MAX_STEERING_RAD, steering))
        if self._form == "acceleration_steering":
            return acceleration, steering
        if self._form == "throttle_brake_steering":
            throttle = min(1.0, max(0.0, acceleration) / model.max_acceleration)
            return throttle, min(1.0, max(0.0, -acceleration) / model.max_deceleration), steering / MAX_STEERING_RAD
        state, after = self.state, model.step(self.state, acceleration, steering, self._dt)
        if self._form == "target_pose":  # whose speed after the step is that of the way to the pose
            dx, dy = after.x - state.x, after.y - state.y
            share = after.speed * self._dt / max(math.hypot(dx, dy), 1e-9)
            row = [self._dt, state.x + share * dx, state.y + share * dy, after.heading, after.speed]
            return (*self._as_returned(row)[1:4], self._dt)
        if self._pursues:  # whose acceleration follows from the speed, and whose steering from a point ahead
            turned = math.tan(steering) * _MIN_LOOK_M / (2 * model.wheelbase)
            bearing = state.heading + math.asin(max(-1.0, min(1.0, turned)))
            x, y = state.x + _MIN_LOOK_M * math.cos(bearing), state.y + _MIN_LOOK_M * math.sin(bearing)
            return [self._as_returned([self._dt, x, y, bearing, max(0.0, state.speed + acceleration * self._dt)])]
        return [self._as_returned([self._dt, after.x, after.y, after.heading, after.speed])]

    def _as_returned(self, row: list[float]) -> list[float]:
        """Return a point of a trajectory in the frame, and with the reference point, in which the agent returns it."""
        state, (time, x, y, heading, speed) = self.state, row
        x, y = x + self._ahead * math.cos(heading), y + self._ahead * math.sin(heading)
        if not self._is_relative:
            return [time, x, y, heading, speed]
        cos, sin = math.cos(state.heading), math.sin(state.heading)
        dx, dy = x - state.x, y - state.y
        return [time, dx * cos + dy * sin - self._ahead, dy * cos - dx * sin, heading - state.heading, speed]

    def _in_map(self, points: NDArray[np.generic]) -> NDArray[np.float64]:
        """Return the poses of the centre at the points of a trajectory, in the frame of the map."""
        found = np.array(points, np.float64)
        if self._is_relative:
            state, (x, y) = self.state, found[:, 1:3].T.copy()
            x += self._ahead
            cos, sin = math.cos(state.heading), math.sin(state.heading)
            found[:, 1], found[:, 2] = state.x + x * cos - y * sin, state.y + x * sin + y * cos
            found[:, 3] += state.heading
        if self._ahead:
            found[:, 1] -= self._ahead * np.cos(found[:, 3])
            found[:, 2] -= self._ahead * np.sin(found[:, 3])
        return found

    def _lane_keeping_angle(self) -> float:
        """Return the steering angle to a point ahead on the middle of the lane, in rad (pure pursuit)."""
        state, model = self.state, self.model
        path = self._path(_MIN_LOOK_M + _LOOK_S * state.speed)
        if not path:
            return 0.0
        x, y = path[-1]
        bearing = math.remainder(math.atan2(y - state.y, x - state.x) - state.heading, math.tau)
        return math.atan(2 * model.wheelbase * math.sin(bearing) / max(1.0, math.hypot(x - state.x, y - state.y)))

    def _path(self, length: float) -> list[tuple[float, float]]:
        """Return the middle of the lane from its begin to a distance ahead of the vehicle's front; empty off all lanes.

        At the end of a lane, the path follows the link to the next edge of the route, or else the first link.
        """
        lane = sumo.vehicle_getLaneID(self._vehicle)
        if not lane:
            return []
        rest, path = sumo.vehicle_getLanePosition(self._vehicle) + length, list[tuple[float, float]]()
        route = frozenset(sumo.vehicle_getRoute(self._vehicle))
        for _ in range(_MAX_LANES_AHEAD):
            for start, end in pairwise([tuple(point[:2]) for point in sumo.lane_getShape(lane)]):
                far = math.dist(start, end)
                path.append(start)
                if rest <= far:
                    share = rest / far if far else 0.0
                    return [*path, (start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1]))]
                rest -= far
                last = end
            links = sumo.lane_getLinks(lane)
            if not links:
                return [*path, last]
            link = next((link for link in links if link[0].rpartition("_")[0] in route), links[0])
            lane = link[4] or link[0]
        return path

    @property
    def is_planned(self) -> bool:
        """Whether the actions are poses, which the vehicle may be unable to reach."""
        return self._form in ("trajectory", "target_pose")

    @property
    def _point(self) -> str:
        """The reference point and the frame of the actions, in words."""
        point = "the centre" if not self._ahead else "the rear axle" if self._ahead < 0 else "the front bumper"
        return f"{point}, in the frame of the {'vehicle' if self._is_relative else 'map'}"

    @property
    def _words(self) -> str:
        return self._form.replace("_", " ")

    def _next(self, values: list[float]) -> MotionState:
        """Return the state after a step."""
        if self._form == "trajectory":
            points = self._in_map(np.array(values))
            after = None if self._pursues else self._on_trajectory(points)
            if after is None or (self._is_overruled and self._refusal(after) is not None):
                return self._pursue(points)
            return after
        if self._form == "target_pose":
            (x, y, heading), time_s = self._pose(values), values[3]
            after = self._towards(x, y, heading, time_s)
            is_usual = -_MAX_BRAKING_MPS2 <= after.acceleration <= _MAX_ACCELERATION_MPS2
            if self._is_overruled and not (is_usual and self._refusal(after) is None):
                return self._pursue_pose(x, y, heading, time_s)
            return after
        if self._form == "throttle_brake_steering":
            throttle, brake, share = values
            acceleration = throttle * self.model.max_acceleration - brake * self.model.max_deceleration
            return self.model.step(self.state, acceleration, share * MAX_STEERING_RAD, self._dt)
        acceleration, steering = values
        return self.model.step(self.state, acceleration, steering, self._dt)

    def _pose(self, values: list[float]) -> tuple[float, float, float]:
        """Return the pose of the centre that a target pose means, in the frame of the map."""
        x, y, heading = self._in_map(np.array([[0.0, *values[:3], 0.0]]))[0, 1:4].tolist()
        return x, y, heading

    def _pursue_pose(self, x: float, y: float, heading: float, time_s: float) -> MotionState:
        """Return the state after a step of a bicycle model that follows a pose which it cannot reach in time.

        The vehicle steers to the line ahead of the pose. It takes over the speed with which the poses of the last two
        steps move along its heading, plus what makes up for its distance within a further second.
        """
        state, (cos, sin) = self.state, (math.cos(self.state.heading), math.sin(self.state.heading))
        last_x, last_y = self._aim or (x - state.speed * self._dt * cos, y - state.speed * self._dt * sin)
        speed = max(0.0, min(self.model.max_speed, ((x - last_x) * cos + (y - last_y) * sin) / self._dt))
        ahead = (x - state.x) * cos + (y - state.y) * sin
        speed = max(0.0, speed + (ahead - speed * time_s) / _CATCH_UP_S)
        on = np.arange(0.0, abs(ahead) + 2 * (_MIN_LOOK_M + _LOOK_S * state.speed))
        line = np.broadcast_to((self._dt, x, y, heading, speed), (len(on), 5)).copy()
        line[:, 1:3] += np.outer(on, (math.cos(heading), math.sin(heading)))
        return self._pursue(line)

    def _pursue(self, points: NDArray[np.float64]) -> MotionState:
        """Return the state after a step of a bicycle model that steers to a point ahead on a trajectory.

        The acceleration is the one that reaches the trajectory's speed at the end of the step. The steering angle leads
        on a circle to the first point behind the nearest one that is at least the look-ahead distance away (pure
        pursuit; R. C. Coulter, Implementation of the pure pursuit path tracking algorithm, CMU-RI-TR-92-01, 1992).
        """
        state = self.state
        begin = [(0.0, state.speed)] if points[0, 0] > 0.0 else []  # it leads from the present speed to its first point
        times, speeds = np.array([*begin, *points[:, (0, 4)]]).T
        speed = float(np.interp(self._dt, times, speeds))
        away = np.hypot(points[:, 1] - state.x, points[:, 2] - state.y)
        nearest = int(away.argmin())
        far = away[nearest:] >= _MIN_LOOK_M + _LOOK_S * state.speed
        target = nearest + int(far.argmax()) if far.any() else len(points) - 1
        bearing = math.atan2(points[target, 2] - state.y, points[target, 1] - state.x) - state.heading
        curvature = 2 * math.sin(bearing) / max(1.0, float(away[target]))
        steering = math.atan(curvature * self.model.wheelbase)
        return self.model.step(state, (speed - state.speed) / self._dt, steering, self._dt)

    def _on_trajectory(self, points: NDArray[np.float64]) -> MotionState:
        """Return the state on a trajectory after a step; it leads from the present pose to its first point."""
        state, dt = self.state, self._dt
        times = points[:, 0]
        index = int(np.searchsorted(times, dt))
        after = points[min(index, len(points) - 1)].tolist()
        before = points[index - 1].tolist() if index else [0.0, state.x, state.y, state.heading, state.speed]
        share = 1.0 if after[0] <= before[0] else min(1.0, (dt - before[0]) / (after[0] - before[0]))
        x, y, speed = (before[one] + share * (after[one] - before[one]) for one in (1, 2, 4))
        turned = math.remainder(
            before[3] + share * math.remainder(after[3] - before[3], math.tau) - state.heading, math.tau
        )
        return self._reached(x, y, state.heading + turned, speed)

    def _towards(self, x: float, y: float, heading: float, time_s: float) -> MotionState:
        """Return the state after a step on the cubic curve from the present pose and speed to a pose at a time."""
        state, dt = self.state, self._dt
        heading = state.heading + math.remainder(heading - state.heading, math.tau)
        if time_s <= dt:
            return self._reached(x, y, heading, math.hypot(x - state.x, y - state.y) / dt)
        end_speed = math.hypot(x - state.x, y - state.y) / time_s
        share = dt / time_s
        at, slope = [], []
        for start, end, turn in ((state.x, x, math.cos), (state.y, y, math.sin)):
            leaves = state.speed * turn(state.heading) * time_s
            enters = end_speed * turn(heading) * time_s
            a, b = 2 * start - 2 * end + leaves + enters, -3 * start + 3 * end - 2 * leaves - enters
            at.append(((a * share + b) * share + leaves) * share + start)
            slope.append(((3 * a * share + 2 * b) * share + leaves) / time_s)
        speed = math.hypot(*slope)
        turned = math.remainder(math.atan2(slope[1], slope[0]) - state.heading, math.tau) if speed > 0.1 else 0.0
        return self._reached(at[0], at[1], state.heading + turned, speed)

    def _reached(self, x: float, y: float, heading: float, speed: float) -> MotionState:
        """Return a state at a pose, with the acceleration and the steering angle that lead to it.

        A vehicle that stands keeps its heading: planners take headings from differences of points, and where points
        are a millimetre apart, the heading is arbitrary.
        """
        state = self.state
        moved = math.hypot(x - state.x, y - state.y)
        if moved <= _STANDING_M:
            heading = state.heading
        turned = heading - state.heading
        steering = math.atan2(turned * self.model.wheelbase, moved) if moved > _STANDING_M else 0.0
        acceleration = (speed - state.speed) / self._dt
        return MotionState(x=x, y=y, heading=heading, speed=speed, acceleration=acceleration, steering=steering)

    def _arrives(self, state: MotionState) -> bool:
        """Return whether the front of the vehicle passes the end of its route in a step."""
        edge = sumo.vehicle_getRoadID(self._vehicle)
        if edge != self._goal or sumo.vehicle_getLaneIndex(self._vehicle) < 0:
            return False
        is_on_route = sumo.vehicle_getRouteID(self._vehicle) == self._route
        if is_on_route and sumo.vehicle_getRouteIndex(self._vehicle) != self._last:
            return False  # a ring leads over the last edge several times
        place = sumo.vehicle_getLanePosition(self._vehicle) + math.hypot(state.x - self.state.x, state.y - self.state.y)
        return bool(place > sumo.lane_getLength(sumo.vehicle_getLaneID(self._vehicle)))


def _words_of(places: Sequence[tuple[float, float]]) -> str:
    """Return places of the outline in words: all corners among them, and each side without a corner among them."""
    corners = [f"{'front' if ahead > 0 else 'rear'} {_side_of(left)}" for ahead, left in places if abs(ahead) == 1.0]
    sides = dict.fromkeys(_side_of(left) for _, left in places)
    words = [f"its {' and '.join(corners)} corner{'s' * (len(corners) > 1)}"] if corners else []
    words += [f"its {side} side" for side in sides if not any(corner.endswith(side) for corner in corners)]
    return " and ".join(words)


def _side_of(left: float) -> str:
    return "left" if left > 0 else "right"
