"""Vehicles of SUMO's that err: each is commanded as long as its disturbance lasts, and then drives by itself again.

SUMO's own checks stay on wherever they can: a vehicle that brakes hard still heeds whoever is ahead of it, and never
brakes harder than the ``decel`` of its type. A cut-in is made however small the gap, but not into the side of somebody.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.simulators.sumo._stepping_out import JunctionLanes, SteppingOut, can_step_out, roadside
from crashhunt.trial import steps_of
from crashhunt.world import is_person

if TYPE_CHECKING:
    from collections.abc import Collection

    from crashhunt.simulators._protocol import Disturbing
    from crashhunt.simulators.sumo._driving import Driving
    from crashhunt.trial import Disturbance
    from crashhunt.world import Scene

__all__ = ["SumoDisturbances"]

_IN_LANE_M, _BESIDE_M, _CROSSING_M = 100.0, 50.0, 80.0  # who is further away than that is not meant
_LEFT, _RIGHT, _AHEAD = 0, 1, 2  # bits of SUMO's vehicle.getNeighbors
_GENTLY = 1.5  # m/s²; how a dawdler slows down
_NEITHER_RED_NOR_PRIORITY = 7  # speed mode: safe speed and physical limits, and nothing at junctions
_NOT_AT_ALL = 0  # lane change mode
_NOT_INTO_OTHERS = 256  # lane change mode: none of its own accord, and a commanded one unless somebody is there
_FOR_EVER_S = 3600.0  # a command to change lanes holds for so long
_LATERAL_M = 1.6  # half a lane: who is less to the side is ahead


class SumoDisturbances:
    """Finds who is meant, and commands them.

    Args:
        controlled: the vehicles that are driven from outside, which are never meant.
        step_length_s: of the simulation.
        driving: knows to which side traffic keeps.

    Attributes:
        speeds: in m/s, of persons who are moved, by their ids in SUMO, which takes them for standing.
    """

    def __init__(self, controlled: Collection[str], step_length_s: float, driving: Driving) -> None:
        self._controlled = controlled
        self._dt = step_length_s
        self._driving = driving
        self.speeds: dict[str, float] = {}
        self._junctions = JunctionLanes()

    def whom(self, disturbance: Disturbance, scene: Scene) -> str:
        """Return who is at a place around an agent; empty where nobody is who is not controlled."""
        try:
            if disturbance.what == "ignore_priority":
                found = self._crossing(disturbance.agent, disturbance.who, scene)
            elif disturbance.what == "step_out":
                reach_m = disturbance.how_strong * disturbance.how_long / 2
                found = roadside(scene, disturbance.agent, disturbance.who, reach_m, self._junctions)
            else:
                found = _at(disturbance.agent, disturbance.who, left_hand=self._driving.left_hand)
        except libsumo.TraCIException:  # the agent has just arrived
            return ""
        return "" if found in self._controlled else found

    def disturb(self, vehicle: str, disturbance: Disturbance) -> Disturbing | None:
        """Command a vehicle; None where it cannot do that."""
        strong = disturbance.how_strong
        try:
            if disturbance.what == "step_out":
                if not can_step_out(vehicle, disturbance.agent, strong * disturbance.how_long / 2, self._junctions):
                    return None
                steps = steps_of(disturbance.how_long, self._dt)
                return SteppingOut(vehicle, disturbance.agent, strong, steps, self._dt, self.speeds)
            if disturbance.what == "late_merge":
                return _late_merge(vehicle, strong)
            decel = float(sumo.vehicle_getDecel(vehicle))
            if disturbance.what in ("brake", "stop"):
                return _Slows(vehicle, min(strong, decel), self._dt, how_strong=min(strong, decel))
            if disturbance.what == "dawdle":
                target = max(0.0, 1.0 - strong) * sumo.vehicle_getSpeed(vehicle)
                return _Slows(vehicle, min(_GENTLY, decel), self._dt, how_strong=strong, target=target)
            if disturbance.what == "speed":
                return _Speeds(vehicle, strong)
            if disturbance.what == "cut_in":
                if disturbance.who in ("ahead", "behind"):
                    return None  # as it is in the lane of the agent already
                # Lanes are counted from the side that traffic keeps to.
                side = 1 if disturbance.who.startswith("left") == self._driving.left_hand else -1
                return _cut_in(vehicle, side, disturbance.how_long, min(strong, decel), self._dt)
            return _Ignores(vehicle, self._dt)
        except libsumo.TraCIException:
            return None

    def _crossing(self, agent: str, who: str, scene: Scene) -> str:
        """The nearest one on a way that crosses the agent's at the junction that both come to."""
        here = scene.roster.index.get(agent)
        way = _way(agent)
        if here is None or not way:
            return ""
        foes = set(sumo.lane_getInternalFoes(way))
        (x, y), present = scene.points[here], sumo.vehicle_getIDList()
        found = []
        for row, actor in enumerate(scene.roster.actors):
            if actor.id == agent or is_person(actor.id) or actor.id in self._controlled or actor.id not in present:
                continue
            dx, dy = scene.points[row][0] - x, scene.points[row][1] - y
            if dx * dx + dy * dy > _CROSSING_M**2 or _place(scene, here, row) != who or _way(actor.id) not in foes:
                continue
            found.append((dx * dx + dy * dy, actor.id))
        return min(found)[1] if found else ""


class _Slows:
    """Brakes down to a speed, and keeps to it, or to what is possible of it."""

    def __init__(self, vehicle: str, deceleration: float, dt: float, *, how_strong: float, target: float = 0.0) -> None:
        self.how_strong = how_strong
        self._vehicle = vehicle
        self._change = deceleration * dt
        self._target = target
        self._command()

    def keep(self) -> None:
        with _gone():
            self._command()

    def end(self) -> None:
        with _gone():
            sumo.vehicle_setSpeed(self._vehicle, -1.0)

    def _command(self) -> None:
        speed = sumo.vehicle_getSpeed(self._vehicle)
        if speed < self._target:  # whoever it drives behind was slower; SUMO lets it drive no faster than is safe
            sumo.vehicle_setSpeed(self._vehicle, min(self._target, sumo.vehicle_getAllowedSpeed(self._vehicle)))
        else:
            sumo.vehicle_setSpeed(self._vehicle, max(self._target, speed - self._change))


class _Speeds:
    """Wants to drive faster than before, and keeps its distance as before."""

    def __init__(self, vehicle: str, share: float) -> None:
        self.how_strong = share
        self._vehicle = vehicle
        self._before = sumo.vehicle_getSpeedFactor(vehicle)
        sumo.vehicle_setSpeedFactor(vehicle, (1.0 + share) * self._before)

    def keep(self) -> None:
        pass

    def end(self) -> None:
        with _gone():
            sumo.vehicle_setSpeedFactor(self._vehicle, self._before)


class _CutsIn:
    """Changes lanes as soon as nobody is in the very place, and may brake there."""

    def __init__(self, vehicle: str, lane: str, deceleration: float, dt: float, how_long: float) -> None:
        self.how_strong = deceleration
        self._vehicle = vehicle
        self._lane = lane
        self._before = sumo.vehicle_getLaneChangeMode(vehicle)
        self._change = deceleration * dt
        sumo.vehicle_setLaneChangeMode(vehicle, _NOT_INTO_OTHERS)
        sumo.vehicle_changeLane(vehicle, int(lane.rpartition("_")[2]), how_long)

    def keep(self) -> None:
        with _gone():
            if self._change and sumo.vehicle_getLaneID(self._vehicle) == self._lane:
                speed = sumo.vehicle_getSpeed(self._vehicle)
                sumo.vehicle_setSpeed(self._vehicle, max(0.0, speed - self._change))

    def end(self) -> None:
        with _gone():
            sumo.vehicle_setLaneChangeMode(self._vehicle, self._before)
            if self._change:
                sumo.vehicle_setSpeed(self._vehicle, -1.0)


class _MergesLate:
    """Stays in a lane that ends until little of it is left, and then changes as soon as nobody is in the very place."""

    def __init__(self, vehicle: str, target: int, length: float, how_strong: float) -> None:
        self.how_strong = how_strong
        self._vehicle = vehicle
        self._edge = sumo.vehicle_getRoadID(vehicle)
        self._target = target
        self._length = length
        self._before = sumo.vehicle_getLaneChangeMode(vehicle)
        sumo.vehicle_setLaneChangeMode(vehicle, _NOT_AT_ALL)
        self._is_waiting = True

    def keep(self) -> None:
        with _gone():
            if self._is_waiting and (
                sumo.vehicle_getRoadID(self._vehicle) != self._edge
                or self._length - sumo.vehicle_getLanePosition(self._vehicle) <= self.how_strong
            ):
                self._is_waiting = False
                sumo.vehicle_setLaneChangeMode(self._vehicle, _NOT_INTO_OTHERS)
                if sumo.vehicle_getRoadID(self._vehicle) == self._edge:
                    sumo.vehicle_changeLane(self._vehicle, self._target, _FOR_EVER_S)

    def end(self) -> None:
        with _gone():
            sumo.vehicle_setLaneChangeMode(self._vehicle, self._before)
            if not self._is_waiting:  # the command would hold it in its lane for good
                sumo.vehicle_changeLane(self._vehicle, sumo.vehicle_getLaneIndex(self._vehicle), 0.0)


class _Ignores:
    """Drives on at a junction as if it were not there; SUMO wants the speed commanded for that."""

    how_strong = 1.0

    def __init__(self, vehicle: str, dt: float) -> None:
        self._vehicle = vehicle
        self._dt = dt
        self._before = sumo.vehicle_getSpeedMode(vehicle)
        sumo.vehicle_setSpeedMode(vehicle, _NEITHER_RED_NOR_PRIORITY)
        self._command()

    def keep(self) -> None:
        with _gone():
            self._command()

    def end(self) -> None:
        with _gone():
            sumo.vehicle_setSpeedMode(self._vehicle, self._before)
            sumo.vehicle_setSpeed(self._vehicle, -1.0)

    def _command(self) -> None:
        allowed, speed = sumo.vehicle_getAllowedSpeed(self._vehicle), sumo.vehicle_getSpeed(self._vehicle)
        faster = speed + sumo.vehicle_getAccel(self._vehicle) * self._dt
        slower = speed - sumo.vehicle_getDecel(self._vehicle) * self._dt
        sumo.vehicle_setSpeed(self._vehicle, max(0.0, slower, min(allowed, faster)))


class _gone:  # noqa: N801 - it is used as a statement
    """Passes over that a vehicle has left."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: object, error: object, _trace: object) -> bool:
        return isinstance(error, libsumo.TraCIException)


def _at(agent: str, who: str, *, left_hand: bool) -> str:
    """Who is at a place around an agent, along the lanes; empty where nobody is."""
    if who in ("ahead", "behind"):
        ask = sumo.vehicle_getLeader if who == "ahead" else sumo.vehicle_getFollower
        found = ask(agent, _IN_LANE_M)
        return str(found[0]) if found is not None and found[0] and found[1] <= _IN_LANE_M else ""
    side, _, along = who.partition(" ")
    # What SUMO calls left is the lane with the next higher number, wherever that lies.
    bit = _LEFT if (side == "left") != left_hand else _RIGHT
    near = []
    for ahead in (0, _AHEAD):
        for vehicle, gap in sumo.vehicle_getNeighbors(agent, bit | ahead):
            gap += _min_gap(vehicle, agent, leads=bool(ahead))
            place = "" if gap < 0 else "ahead" if ahead else "behind"
            if place == along and gap <= _BESIDE_M:
                near.append((gap, vehicle))
    return min(near)[1] if near else ""


def _min_gap(vehicle: str, agent: str, *, leads: bool) -> float:
    """What SUMO has taken from the distance of bumpers: the gap that the one behind likes to keep, in m."""
    return float(sumo.vehicle_getMinGap(agent if leads else vehicle))


def _way(vehicle: str) -> str:
    """The lane inside the next junction that a vehicle comes to; that on which it is, where it is inside one."""
    lane = str(sumo.vehicle_getLaneID(vehicle))
    if lane.startswith(":"):
        return lane
    links = sumo.vehicle_getNextLinks(vehicle)
    return str(links[0][4]) if links else ""


def _place(scene: Scene, here: int, row: int) -> str:
    """The place of one actor around another, as the crow flies."""
    from math import cos, sin

    (x, y), (own_x, own_y), heading = scene.points[row], scene.points[here], scene.headings[here]
    dx, dy = x - own_x, y - own_y
    ahead, left = dx * cos(heading) + dy * sin(heading), dy * cos(heading) - dx * sin(heading)
    half = scene.roster.actors[here].length / 2
    side = "" if abs(left) <= _LATERAL_M else "left" if left > 0 else "right"
    along = "ahead" if ahead > half else "behind" if ahead < -half else ""
    return f"{side} {along}".strip()


def _cut_in(vehicle: str, side: int, how_long: float, deceleration: float, dt: float) -> _CutsIn | None:
    """Have a vehicle change lanes, where there is a lane that it may use."""
    edge, lane = sumo.vehicle_getRoadID(vehicle), sumo.vehicle_getLaneIndex(vehicle) + side
    if edge.startswith(":") or not 0 <= lane < sumo.edge_getLaneNumber(edge):
        return None
    target = f"{edge}_{lane}"
    allowed = sumo.lane_getAllowed(target)
    if allowed and sumo.vehicle_getVehicleClass(vehicle) not in allowed:
        return None
    return _CutsIn(vehicle, target, deceleration, dt, how_long)


def _late_merge(vehicle: str, how_strong: float) -> _MergesLate | None:
    """Have a vehicle put off that it leaves a lane that ends; None where its lane does not."""
    lane = sumo.vehicle_getLaneID(vehicle)
    known = next((one for one in libsumo.vehicle.getBestLanes(vehicle) if one[0] == lane), None)
    if known is None or not known[3]:
        return None
    _, length, _, offset, *_ = known
    left = length - sumo.vehicle_getLanePosition(vehicle)
    if left <= 0:
        return None
    target = sumo.vehicle_getLaneIndex(vehicle) + (1 if offset > 0 else -1)
    return _MergesLate(vehicle, target, length, min(how_strong, left))
