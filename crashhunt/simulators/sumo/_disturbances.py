"""Vehicles of SUMO's that err: each is commanded as long as its disturbance lasts, and then drives by itself again.

SUMO's own checks stay on wherever they can: a vehicle that brakes hard still heeds whoever is ahead of it, and never
brakes harder than the ``decel`` of its type. A cut-in is made however small the gap, but not into the side of somebody.
"""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.trial import steps_of
from crashhunt.world import PERSON, is_person

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from crashhunt.simulators._protocol import ActiveDisturbance
    from crashhunt.simulators.sumo._driving import Driving
    from crashhunt.trial import Disturbance
    from crashhunt.world import Scene


__all__ = ["JunctionLanes", "SteppingOut", "SumoDisturbances", "can_step_out", "roadside"]


# A person of SUMO's who steps out onto the road and back, as nobody does there of their own accord.
#
# SUMO 1.28 maps a person that is moved to the best lane nearby. Where that is a crossing or a walking area that the
# person was not on, SUMO guesses a path across it, and the process may die in this step or the next one: 90 of 480
# step-outs that began on a crossing or a walking area, 121 of 1,860 that began within 12 m of a junction. So a person
# steps out only where its own lane remains the best one all the way, which `can_step_out` predicts.

_AHEAD_M, _ASIDE_M = 60.0, 15.0  # who is further away than that is not meant
_INNER_M = 1.6  # half a lane: who is less to the side is in the way already
_WALKS = 2  # SUMO's type of a stage
# How SUMO scores lanes to which it may map a person: weights of distance, in lane widths, and of angle, in half turns.
_BY_DISTANCE, _BY_ANGLE, _LANE_WIDTH_M = 0.5, 0.35, 3.2
_MARGIN = 0.05
"""A lane whose score is by less than this below that of the person's own counts as the better one. SUMO gives up to 0.1
each to lanes on the person's route and to its own lane, which is left out here: of 981 persons that stepped out with a
margin of -0.05, two were mapped to a crossing, whose scores were 0.04 and 0.05 above that of their own lane."""
_END_M, _MARGIN_AT_THE_END = 1.0, 0.2
"""At the end of its lane the person's own lane may have neither, while another one has both."""
_AMBIGUOUS_M, _TOLERANCE_M = 0.1, 0.05
"""SUMO maps to no lane whose nearest point is by more than that nearer than the foot of a perpendicular."""
_LOOK_EVERY_M = 0.5
_WALKING_AREA = re.compile(r"_w\d+_\d+$")  # as netconvert calls them


def roadside(scene: Scene, agent: str, who: str, reach_m: float, junctions: JunctionLanes) -> str:
    """Return the nearest person who walks on one side of the road ahead of an agent and can step out there.

    Args:
        scene: as it is now.
        agent: a controlled vehicle.
        who: ``left ahead`` or ``right ahead``; nobody is anywhere else.
        reach_m: how far the person gets in half of its time.
        junctions: of the network.

    Returns:
        The identifier of the actor; empty where there is none.
    """
    here = scene.roster.index.get(agent)
    if here is None:
        return ""
    (x, y), heading = scene.points[here], scene.headings[here]
    found = []
    for row, actor in enumerate(scene.roster.actors):
        if not actor.id.startswith(PERSON):
            continue
        dx, dy = scene.points[row][0] - x, scene.points[row][1] - y
        ahead, left = dx * math.cos(heading) + dy * math.sin(heading), dy * math.cos(heading) - dx * math.sin(heading)
        place = f"{'left' if left > 0 else 'right'} ahead"
        if place == who and 0 < ahead <= _AHEAD_M and _INNER_M < abs(left) <= _ASIDE_M and _walks(actor.id):
            found.append((ahead, actor.id))
    return next((actor for _, actor in sorted(found) if can_step_out(actor, agent, reach_m, junctions)), "")


def can_step_out(actor: str, agent: str, reach_m: float, junctions: JunctionLanes) -> bool:
    """Return whether SUMO keeps a person on its own lane while it steps out.

    SUMO scores each lane nearby by distance, angle and route (``Helper::moveToXYMap``); here the same score is compared
    for the person's lane and those of junctions, at points along its way, with what is uncertain held against it.

    Args:
        actor: a person who walks.
        agent: whose way it steps into.
        reach_m: how far it gets.
        junctions: of the network.
    """
    person = actor.removeprefix(PERSON)
    if str(sumo.person_getRoadID(person)).startswith(":"):
        return False  # on a crossing, a walking area or inside a junction
    lane = str(sumo.person_getLaneID(person))
    way = _Way.of(person, agent)
    far = min(way.far_m, reach_m)
    shape = sumo.lane_getShape(lane)
    nearby = junctions.near(way.start, far)
    at_the_end = sumo.lane_getLength(lane) - sumo.person_getLanePosition(person) < _END_M
    margin = _MARGIN_AT_THE_END if at_the_end else _MARGIN
    count = max(1, math.ceil(far / _LOOK_EVERY_M))
    for index in range(count + 1):
        point = way.at(far * index / count)
        own = _nearest(shape, point)
        for other in nearby:
            theirs = _nearest(other.shape, point)
            if theirs.ambiguous_m > _AMBIGUOUS_M + _TOLERANCE_M:
                continue  # SUMO does not map to it
            if own.ambiguous_m > _AMBIGUOUS_M - _TOLERANCE_M:
                return False
            for angle in (way.angle, way.angle + 180.0):  # out and back
                turned = 0.0 if other.walking_area else _between(angle, theirs.angle)
                aligned = (_between(angle, own.angle) - turned) / 180.0
                closer = (own.distance_m - theirs.distance_m) / _LANE_WIDTH_M
                if _BY_DISTANCE * closer + _BY_ANGLE * aligned + margin > 0.0:
                    return False
    return True


class JunctionLanes:
    """The lanes inside junctions on which persons may be, of the network that is loaded; they are read once."""

    def __init__(self) -> None:
        self._lanes: list[_JunctionLane] | None = None

    def near(self, point: tuple[float, float], radius_m: float) -> list[_JunctionLane]:
        """Return those to which SUMO might map a person that gets so far from a point."""
        if self._lanes is None:
            self._lanes = [
                _JunctionLane(tuple(libsumo.lane.getShape(lane)), walking_area=_is_walking_area(lane))
                for lane in sumo.lane_getIDList()
                if lane.startswith(":") and _may_walk(lane)
            ]
        (x, y), reach = point, radius_m + _ASIDE_M + _LANE_WIDTH_M
        return [
            lane
            for lane in self._lanes
            if lane.left <= x + reach and lane.right >= x - reach and lane.low <= y + reach and lane.high >= y - reach
        ]


class _JunctionLane:
    """A lane inside a junction, with the box around it."""

    __slots__ = ("high", "left", "low", "right", "shape", "walking_area")

    def __init__(self, shape: tuple[tuple[float, float], ...], *, walking_area: bool) -> None:
        self.shape = shape
        self.walking_area = walking_area
        self.left, self.right = min(x for x, _ in shape), max(x for x, _ in shape)
        self.low, self.high = min(y for _, y in shape), max(y for _, y in shape)


class _Nearest(NamedTuple):
    """The point of a lane that is nearest to another point: distance, direction of the lane in SUMO's degrees.

    ``ambiguous_m`` is by how much that point is nearer than the foot of a perpendicular: above 0 beyond the ends.
    """

    distance_m: float
    angle: float
    ambiguous_m: float


def _nearest(shape: Sequence[tuple[float, float]], point: tuple[float, float]) -> _Nearest:
    x, y = point
    distance, angle, perpendicular = math.inf, 0.0, math.inf
    last = len(shape) - 2
    for index, ((x0, y0), (x1, y1)) in enumerate(pairwise(shape)):
        dx, dy = x1 - x0, y1 - y0
        square = dx * dx + dy * dy
        share = ((x - x0) * dx + (y - y0) * dy) / square if square > 0 else 0.0
        foot = min(1.0, max(0.0, share))
        found = math.hypot(x - x0 - foot * dx, y - y0 - foot * dy)
        if found < distance:
            distance, angle = found, math.degrees(math.atan2(dx, dy))
        if (share >= 0 or index > 0) and (share <= 1 or index < last):
            perpendicular = min(perpendicular, found)
    return _Nearest(distance, angle, perpendicular - distance)


def _between(one: float, other: float) -> float:
    """The angle between two directions, 0 to 180."""
    found = abs(one - other) % 360.0
    return min(found, 360.0 - found)


def _is_walking_area(lane: str) -> bool:
    return bool(_WALKING_AREA.search(lane))


def _may_walk(lane: str) -> bool:
    allowed = libsumo.lane.getAllowed(lane)
    return "pedestrian" in allowed if allowed else "pedestrian" not in libsumo.lane.getDisallowed(lane)


class _Way(NamedTuple):
    """The straight way from where a person is to the middle of an agent's way."""

    start: tuple[float, float]
    direction: tuple[float, float]
    far_m: float

    @classmethod
    def of(cls, person: str, agent: str) -> _Way:
        """Return that of a person and an agent, as they are now."""
        start: tuple[float, float] = sumo.person_getPosition(person)
        heading = math.radians(90.0 - sumo.vehicle_getAngle(agent))
        own_x, own_y = sumo.vehicle_getPosition(agent)
        dx, dy = start[0] - own_x, start[1] - own_y
        left = dy * math.cos(heading) - dx * math.sin(heading)
        side = -1.0 if left > 0 else 1.0
        return cls(start, (-side * math.sin(heading), side * math.cos(heading)), abs(left))

    @property
    def angle(self) -> float:
        """Its direction, in SUMO's degrees."""
        return 90.0 - math.degrees(math.atan2(self.direction[1], self.direction[0]))

    def at(self, out_m: float) -> tuple[float, float]:
        """Return the point that is so far out."""
        return self.start[0] + out_m * self.direction[0], self.start[1] + out_m * self.direction[1]


def _walks(actor: str) -> bool:
    stage = libsumo.person.getStage(actor.removeprefix(PERSON))
    return bool(stage.type == _WALKS)


class SteppingOut:
    """Walks straight to the middle of the agent's way, stands there, and is back where it began when the time is over.

    SUMO's persons walk on their sidewalks only: this one is moved, never further in a step than a person walks in it.
    SUMO has forgotten afterwards where it was going, and is told again.

    Args:
        actor: a person who walks.
        agent: whose way it is.
        speed: in m/s; no more than what the person can do.
        steps: in how many it goes out and comes back.
        step_length_s: of the simulation.
        speeds: of persons of whom SUMO does not know how fast they are, by their ids there; ours is added.
    """

    def __init__(
        self, actor: str, agent: str, speed: float, steps: int, step_length_s: float, speeds: dict[str, float]
    ) -> None:
        person = actor.removeprefix(PERSON)
        self.how_strong = min(speed, float(sumo.person_getMaxSpeed(person)))
        self._person = person
        self._dt = step_length_s
        self._speeds = speeds
        self._left = steps
        self._walk = libsumo.person.getStage(person)
        self._edge = str(sumo.person_getRoadID(person))
        self._start, self._way, self._far = _Way.of(person, agent)
        self._out = 0.0
        self._command()

    def keep(self) -> None:
        """Go on, where it has not left, and where SUMO has not mapped it to a junction after all."""
        try:
            if str(sumo.person_getRoadID(self._person)).startswith(":"):
                self._speeds.pop(self._person, None)
            else:
                self._command()
        except libsumo.TraCIException:
            self._speeds.pop(self._person, None)

    def end(self) -> None:
        """Have it go on where it was going."""
        self._speeds.pop(self._person, None)
        edges = tuple(self._walk.edges)
        try:
            rest = edges[edges.index(self._edge) :] if self._edge in edges else edges
            libsumo.person.appendWalkingStage(self._person, rest, self._walk.arrivalPos)
            if libsumo.person.getRemainingStages(self._person) > 1:
                libsumo.person.removeStage(self._person, 0)
        except libsumo.TraCIException:
            pass  # it has left

    def _command(self) -> None:
        self._left -= 1  # steps after this one
        reach = self.how_strong * self._dt
        before = self._out
        # As far as it comes, and no further than from where it is back in time.
        self._out = min(self._far, before + reach, self._left * reach)
        away = self._out - before
        towards = self._way if away >= 0 else (-self._way[0], -self._way[1])
        (x, y), (way_x, way_y) = self._start, self._way
        angle = 90.0 - math.degrees(math.atan2(towards[1], towards[0]))
        sumo.person_moveToXY(self._person, "", x + self._out * way_x, y + self._out * way_y, angle, 2, 100.0)
        self._speeds[self._person] = abs(away) / self._dt


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

    def resolve_target(self, disturbance: Disturbance, scene: Scene) -> str:
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

    def disturb(self, vehicle: str, disturbance: Disturbance) -> ActiveDisturbance | None:
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
