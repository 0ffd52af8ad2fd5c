"""Fault injection on SUMO: a vehicle receives commands while its disturbance lasts, and then drives by itself again.

SUMO's own checks stay on where possible. A vehicle that brakes hard still keeps a safe speed behind the vehicle ahead,
and never brakes harder than the ``decel`` of its type. A cut-in uses any gap, but never overlaps another vehicle.
"""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.sumo._driving import Driving, VehicleCommand
from crashhunt.trial import steps_of
from crashhunt.world import PERSON, is_person, place_words

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from crashhunt.simulators import ActiveDisturbance
    from crashhunt.trial import Disturbance
    from crashhunt.world import Scene


# The disturbance `step_out`: a person steps out onto the road and back, which SUMO's own persons never do.
#
# SUMO 1.28 maps a moved person to the best lane nearby. If that is a crossing or a walking area that the person was not
# on, SUMO guesses a path across it, and the process may die in this step or the next. That happened in 90 of 480
# step-outs that began on a crossing or a walking area, and in 121 of 1,860 that began within 12 m of a junction. So a
# person steps out only if its own lane remains the best lane all the way, which `can_step_out` predicts.

_AHEAD_M, _ASIDE_M = 60.0, 15.0  # persons further ahead or further to the side are no target
_INNER_M = 1.6  # half a lane: persons nearer to the agent's axis are already in its way
_WALKING_STAGE = 2  # SUMO's type of a walking stage
# Weights in SUMO's score of lanes for a moved person: distance in lane widths, angle in half turns.
_BY_DISTANCE, _BY_ANGLE, _LANE_WIDTH_M = 0.5, 0.35, 3.2
_MARGIN_SHARE = 0.05
"""Safety margin of the score comparison: another lane counts as better even if its score is lower by up to this.

SUMO adds up to 0.1 each to lanes on the person's route and to the person's own lane, and this comparison omits both. Of
981 persons that stepped out with a margin of -0.05, SUMO mapped two to a crossing. The scores of these crossings were
0.04 and 0.05 above those of the persons' lanes."""
_END_M, _MARGIN_AT_THE_END = 1.0, 0.2
"""Near the end of its lane a person needs a larger margin: its own lane may get neither bonus, another lane both."""
_AMBIGUOUS_M, _TOLERANCE_M = 0.1, 0.05
"""SUMO ignores lanes whose nearest point is nearer than the foot of a perpendicular by more than 0.1 m."""
_LOOK_EVERY_M = 0.5  # distance between the points of a person's path at which lanes are compared
_WALKING_AREA = re.compile(r"_w\d+_\d+$")  # netconvert's names of walking areas


def roadside(scene: Scene, agent: str, who: str, reach_m: float, junctions: JunctionLanes) -> str:
    """Return the nearest person who walks on one side of the road ahead of an agent and can step onto the road.

    Only ``left ahead`` and ``right ahead`` have persons. The person can walk ``reach_m`` in half of the disturbance's
    duration.

    Returns:
        The identifier of the actor; empty if no person can step out.
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
    """Return whether SUMO keeps a person on its own lane while the person steps out.

    SUMO scores each lane nearby by distance, angle and route (``Helper::moveToXYMap``). This function compares the same
    score for the person's lane and for junction lanes, at points along the person's path. If the result is uncertain,
    it returns false.
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
    margin = _MARGIN_AT_THE_END if at_the_end else _MARGIN_SHARE
    count = max(1, math.ceil(far / _LOOK_EVERY_M))
    for index in range(count + 1):
        point = way.at(far * index / count)
        own = _nearest(shape, point)
        for other in nearby:
            theirs = _nearest(other.shape, point)
            if theirs.ambiguous_m > _AMBIGUOUS_M + _TOLERANCE_M:
                continue  # SUMO never maps a person to this lane
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
    """The junction lanes of the loaded network on which persons may walk; they are read once."""

    def __init__(self) -> None:
        self._lanes: list[_JunctionLane] | None = None

    def near(self, point: tuple[float, float], radius_m: float) -> list[_JunctionLane]:
        """Return the lanes to which SUMO might map a person within a radius of a point."""
        if self._lanes is None:
            self._lanes = [
                _JunctionLane(tuple(libsumo.lane.getShape(lane)), walking_area=bool(_WALKING_AREA.search(lane)))
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
    """A lane inside a junction, with its bounding box."""

    __slots__ = ("high", "left", "low", "right", "shape", "walking_area")

    def __init__(self, shape: tuple[tuple[float, float], ...], *, walking_area: bool) -> None:
        self.shape = shape
        self.walking_area = walking_area
        self.left, self.right = min(x for x, _ in shape), max(x for x, _ in shape)
        self.low, self.high = min(y for _, y in shape), max(y for _, y in shape)


class _Nearest(NamedTuple):
    """The nearest point of a lane: its distance in m, and the lane's direction there in SUMO's degrees.

    ``ambiguous_m`` is the difference between the distance to the foot of a perpendicular and ``distance_m``. This
    difference is above 0 beyond the ends of the lane.
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
    """Return the angle between two directions, from 0 to 180 degrees."""
    found = abs(one - other) % 360.0
    return min(found, 360.0 - found)


def _may_walk(lane: str) -> bool:
    allowed = libsumo.lane.getAllowed(lane)
    return "pedestrian" in allowed if allowed else "pedestrian" not in libsumo.lane.getDisallowed(lane)


class _Way(NamedTuple):
    """The straight path from a person to the centre line of an agent's path."""

    start: tuple[float, float]
    direction: tuple[float, float]
    far_m: float

    @classmethod
    def of(cls, person: str, agent: str) -> _Way:
        """Return the straight path from a person's current position into the path of an agent."""
        start: tuple[float, float] = sumo.person_getPosition(person)
        heading = math.radians(90.0 - sumo.vehicle_getAngle(agent))
        own_x, own_y = sumo.vehicle_getPosition(agent)
        dx, dy = start[0] - own_x, start[1] - own_y
        left = dy * math.cos(heading) - dx * math.sin(heading)
        side = -1.0 if left > 0 else 1.0
        return cls(start, (-side * math.sin(heading), side * math.cos(heading)), abs(left))

    @property
    def angle(self) -> float:
        """The direction of the path, in SUMO's degrees."""
        return 90.0 - math.degrees(math.atan2(self.direction[1], self.direction[0]))

    def at(self, out_m: float) -> tuple[float, float]:
        """Return the point of the path at a distance from its start."""
        return self.start[0] + out_m * self.direction[0], self.start[1] + out_m * self.direction[1]


def _walks(actor: str) -> bool:
    stage = libsumo.person.getStage(actor.removeprefix(PERSON))
    return bool(stage.type == _WALKING_STAGE)


class SteppingOut:
    """Makes a person walk straight to the middle of the agent's path, stand there, and be back at the start in time.

    SUMO's persons walk on their sidewalks only, so crashhunt moves this person with ``moveToXY``. In each step the
    person moves at most as far as it can walk. SUMO forgets the person's walk, so `end` appends the walk again.

    Args:
        actor: Identifier of a walking person.
        agent: Identifier of the agent into whose path the person walks.
        walks: The walking speed in each step of the way out and back, in m/s, bounded by the person's maximum speed.
        step_length_s: Step length of the simulation, in s.
        speeds: Speeds of moved persons by SUMO id, because SUMO reports 0 for them. The speed of this person is added
            to the collection.
    """

    def __init__(
        self, actor: str, agent: str, walks: Sequence[float], step_length_s: float, speeds: dict[str, float]
    ) -> None:
        person = actor.removeprefix(PERSON)
        most = float(sumo.person_getMaxSpeed(person))
        self.how_strong = min(max(walks), most)
        self._walks = [min(one, most) for one in walks]
        self._is_steady = min(walks) == max(walks)
        self._person = person
        self._dt = step_length_s
        self._speeds = speeds
        self._left = len(walks)
        self._walk = libsumo.person.getStage(person)
        self._edge = str(sumo.person_getRoadID(person))
        self._way = _Way.of(person, agent)
        self._out = 0.0
        self._command()

    def keep(self) -> None:
        """Move the person, unless it has left the simulation or SUMO has mapped it to a junction."""
        try:
            if str(sumo.person_getRoadID(self._person)).startswith(":"):
                self._speeds.pop(self._person, None)
            else:
                self._command()
        except libsumo.TraCIException:
            self._speeds.pop(self._person, None)

    def end(self) -> None:
        """Let the person resume its walk."""
        self._speeds.pop(self._person, None)
        edges = tuple(self._walk.edges)
        try:
            rest = edges[edges.index(self._edge) :] if self._edge in edges else edges
            libsumo.person.appendWalkingStage(self._person, rest, self._walk.arrivalPos)
            if libsumo.person.getRemainingStages(self._person) > 1:
                libsumo.person.removeStage(self._person, 0)
        except libsumo.TraCIException:
            pass  # the person has left the simulation

    def _command(self) -> None:
        self._left -= 1  # number of steps after this step
        later = self._walks[len(self._walks) - self._left :]
        reach = self._walks[-1 - self._left] * self._dt
        before = self._out
        # Walk out at most so far that the remaining steps suffice for the way back.
        back = self._left * reach if self._is_steady else sum(later) * self._dt
        self._out = min(self._way.far_m, before + reach, back)
        away, (way_x, way_y) = self._out - before, self._way.direction
        way = self._way if away >= 0 else self._way._replace(direction=(-way_x, -way_y))
        sumo.person_moveToXY(self._person, "", *self._way.at(self._out), way.angle, 2, 100.0)
        self._speeds[self._person] = abs(away) / self._dt


# Vehicles further away are no target: in the same lane, in a neighbouring lane, on a crossing path.
_IN_LANE_M, _NEIGHBOUR_LANE_M, _CROSSING_M = 100.0, 50.0, 80.0
_LEFT, _RIGHT, _AHEAD = 0, 1, 2  # bits of SUMO's vehicle.getNeighbors
_DAWDLING_DECELERATION_MPS2 = 1.5
_IGNORES_JUNCTIONS = 7  # speed mode: safe speed and physical limits, no checks at junctions
_NO_LANE_CHANGES = 0  # lane change mode
_COMMANDED_LANE_CHANGES = 256  # lane change mode: commanded changes only, and not into another vehicle
_FOR_EVER_S = 3600.0  # how long a command to change lanes holds: longer than any disturbance


class SumoDisturbances:
    """Finds the target actors of disturbances, and disturbs them."""

    def __init__(self, controlled: Collection[str], step_length_s: float, driving: Driving) -> None:
        self._controlled = controlled
        self._dt = step_length_s
        self._driving = driving
        # speeds in m/s of moved persons, by SUMO id, because SUMO reports 0 for them
        self.speeds: dict[str, float] = {}
        self._junctions = JunctionLanes()

    def resolve_target(self, disturbance: Disturbance, scene: Scene) -> str:
        """Return the identifier of the actor at a place around an agent; empty if the place has none or an agent."""
        try:
            if not sumo.vehicle_getLaneID(disturbance.agent):
                return ""  # SUMO still names neighbours of a vehicle that is parked
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
        """Disturb an actor; return None if the actor cannot be disturbed in this way."""
        strong = disturbance.how_strong
        try:
            if disturbance.what == "step_out":
                if not can_step_out(vehicle, disturbance.agent, strong * disturbance.how_long / 2, self._junctions):
                    return None
                steps = steps_of(disturbance.how_long, self._dt)
                strengths = [disturbance.strength_in(step) for step in range(steps)]
                return SteppingOut(vehicle, disturbance.agent, strengths, self._dt, self.speeds)
            if disturbance.what == "late_merge":
                return _late_merge(vehicle, strong)
            decel = float(sumo.vehicle_getDecel(vehicle))
            if disturbance.what in ("brake", "stop"):
                return _Slows(
                    vehicle, min(strong, decel), self._dt, how_strong=min(strong, decel),
                    strengths=[min(one, decel) for one in disturbance.strengths],
                )  # fmt: skip
            if disturbance.what == "dawdle":
                target = max(0.0, 1.0 - strong) * sumo.vehicle_getSpeed(vehicle)
                return _Slows(
                    vehicle, min(_DAWDLING_DECELERATION_MPS2, decel), self._dt, how_strong=strong, target=target
                )
            if disturbance.what == "speed":
                return _Speeds(vehicle, strong)
            if disturbance.what == "cut_in":
                if disturbance.who in ("ahead", "behind"):
                    return None  # the vehicle is already in the agent's lane
                # SUMO numbers lanes from the side on which traffic drives.
                side = 1 if disturbance.who.startswith("left") == self._driving.left_hand else -1
                return _cut_in(vehicle, side, disturbance.how_long, min(strong, decel), self._dt)
            return _Ignores(vehicle, self._dt)
        except libsumo.TraCIException:
            return None

    def _crossing(self, agent: str, who: str, scene: Scene) -> str:
        """Return the nearest vehicle whose path crosses the agent's path at the next junction of both."""
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


class _Slows(VehicleCommand):
    """Makes the vehicle brake to a target speed and keep it where that is safe."""

    def __init__(
        self,
        vehicle: str,
        deceleration: float,
        dt: float,
        *,
        how_strong: float,
        target: float = 0.0,
        strengths: Sequence[float] = (),
    ) -> None:
        super().__init__(vehicle)
        self.how_strong = how_strong
        self._change = deceleration * dt
        self._changes = iter([one * dt for one in strengths])
        self._target = target
        self._command()

    def _command(self) -> None:
        self._change = next(self._changes, self._change)
        speed = sumo.vehicle_getSpeed(self._vehicle)
        if speed < self._target:  # a slower vehicle is ahead; SUMO limits the commanded speed to a safe speed
            self._set_speed(min(self._target, sumo.vehicle_getAllowedSpeed(self._vehicle)))
        else:
            self._set_speed(max(self._target, speed - self._change))


class _Speeds(VehicleCommand):
    """Raises the vehicle's desired speed; the vehicle keeps its distance to others as before."""

    def __init__(self, vehicle: str, share: float) -> None:
        super().__init__(vehicle)
        self.how_strong = share
        self._before = sumo.vehicle_getSpeedFactor(vehicle)
        sumo.vehicle_setSpeedFactor(vehicle, (1.0 + share) * self._before)

    def _release(self) -> None:
        sumo.vehicle_setSpeedFactor(self._vehicle, self._before)


class _CutsIn(VehicleCommand):
    """Makes the vehicle change lanes as soon as no vehicle overlaps it there, and optionally brake in the new lane."""

    def __init__(self, vehicle: str, lane: str, deceleration: float, dt: float, how_long: float) -> None:
        super().__init__(vehicle)
        self.how_strong = deceleration
        self._lane = lane
        self._change = deceleration * dt
        self._before = self._command_lane_changes(_COMMANDED_LANE_CHANGES)
        sumo.vehicle_changeLane(vehicle, int(lane.rpartition("_")[2]), how_long)

    def _command(self) -> None:
        if self._change and sumo.vehicle_getLaneID(self._vehicle) == self._lane:
            speed = sumo.vehicle_getSpeed(self._vehicle)
            self._set_speed(max(0.0, speed - self._change))

    def _release(self) -> None:
        self._release_lane_changes(self._before)
        if self._change:
            super()._release()


class _MergesLate(VehicleCommand):
    """Keeps the vehicle in a lane that ends, and lets it change lanes late.

    The change begins when the rest of the lane is short enough and no vehicle overlaps in the neighbouring lane.
    """

    def __init__(self, vehicle: str, target: int, length: float, how_strong: float) -> None:
        super().__init__(vehicle)
        self.how_strong = how_strong
        self._edge = sumo.vehicle_getRoadID(vehicle)
        self._target = target
        self._length = length
        self._before = self._command_lane_changes(_NO_LANE_CHANGES)
        self._is_waiting = True

    def _command(self) -> None:
        if self._is_waiting and (
            sumo.vehicle_getRoadID(self._vehicle) != self._edge
            or self._length - sumo.vehicle_getLanePosition(self._vehicle) <= self.how_strong
        ):
            self._is_waiting = False
            sumo.vehicle_setLaneChangeMode(self._vehicle, _COMMANDED_LANE_CHANGES)
            if sumo.vehicle_getRoadID(self._vehicle) == self._edge:
                sumo.vehicle_changeLane(self._vehicle, self._target, _FOR_EVER_S)

    def _release(self) -> None:
        self._release_lane_changes(self._before)
        if not self._is_waiting:  # otherwise the command would keep the vehicle in its lane for an hour
            sumo.vehicle_changeLane(self._vehicle, sumo.vehicle_getLaneIndex(self._vehicle), 0.0)


class _Ignores(VehicleCommand):
    """Makes the vehicle ignore red lights and right of way; for that, SUMO needs a commanded speed in every step."""

    def __init__(self, vehicle: str, dt: float) -> None:
        super().__init__(vehicle)
        self._dt = dt
        self._before = self._command_speed_mode(_IGNORES_JUNCTIONS)
        self._command()

    def _release(self) -> None:
        sumo.vehicle_setSpeedMode(self._vehicle, self._before)
        super()._release()

    def _command(self) -> None:
        allowed, speed = sumo.vehicle_getAllowedSpeed(self._vehicle), sumo.vehicle_getSpeed(self._vehicle)
        faster = speed + sumo.vehicle_getAccel(self._vehicle) * self._dt
        slower = speed - sumo.vehicle_getDecel(self._vehicle) * self._dt
        sumo.vehicle_setSpeed(self._vehicle, max(0.0, slower, min(allowed, faster)))


def _at(agent: str, who: str, *, left_hand: bool) -> str:
    """Return the vehicle at a place around an agent, in its lane or a neighbouring lane; empty if there is none."""
    if who in ("ahead", "behind"):
        ask = sumo.vehicle_getLeader if who == "ahead" else sumo.vehicle_getFollower
        found = ask(agent, _IN_LANE_M)
        return str(found[0]) if found is not None and found[0] and found[1] <= _IN_LANE_M else ""
    side, _, along = who.partition(" ")
    # SUMO's "left" is the lane with the next higher number, which lies to the right in left-hand traffic.
    bit = _LEFT if (side == "left") != left_hand else _RIGHT
    near = []
    for ahead in (0, _AHEAD):
        for vehicle, gap in sumo.vehicle_getNeighbors(agent, bit | ahead):
            # SUMO has subtracted the minimum gap of the rear vehicle from the bumper-to-bumper gap.
            gap += float(sumo.vehicle_getMinGap(agent if ahead else vehicle))
            place = "" if gap < 0 else "ahead" if ahead else "behind"
            if place == along and gap <= _NEIGHBOUR_LANE_M:
                near.append((gap, vehicle))
    return min(near)[1] if near else ""


def _way(vehicle: str) -> str:
    """Return the lane of a vehicle inside its next junction, or its current lane if it is inside a junction."""
    lane = str(sumo.vehicle_getLaneID(vehicle))
    if lane.startswith(":"):
        return lane
    links = sumo.vehicle_getNextLinks(vehicle)
    return str(links[0][4]) if links else ""


def _place(scene: Scene, here: int, row: int) -> str:
    """Return the place of one actor relative to another, such as ``left ahead``, from positions and not from lanes."""
    (x, y), (own_x, own_y), heading = scene.points[row], scene.points[here], scene.headings[here]
    dx, dy = x - own_x, y - own_y
    ahead, left = dx * math.cos(heading) + dy * math.sin(heading), dy * math.cos(heading) - dx * math.sin(heading)
    return place_words(ahead, left, scene.roster.actors[here].length)


def _cut_in(vehicle: str, side: int, how_long: float, deceleration: float, dt: float) -> _CutsIn | None:
    """Make a vehicle change lanes; return None if there is no lane that it may use."""
    edge, lane = sumo.vehicle_getRoadID(vehicle), sumo.vehicle_getLaneIndex(vehicle) + side
    if edge.startswith(":") or not 0 <= lane < sumo.edge_getLaneNumber(edge):
        return None
    target = f"{edge}_{lane}"
    allowed = sumo.lane_getAllowed(target)
    if allowed and sumo.vehicle_getVehicleClass(vehicle) not in allowed:
        return None
    return _CutsIn(vehicle, target, deceleration, dt, how_long)


def _late_merge(vehicle: str, how_strong: float) -> _MergesLate | None:
    """Make a vehicle leave an ending lane late; return None if its lane does not end."""
    lane = sumo.vehicle_getLaneID(vehicle)
    known = next((best for best in libsumo.vehicle.getBestLanes(vehicle) if best[0] == lane), None)
    if known is None or not known[3]:
        return None
    _, length, _, offset, *_ = known
    left = length - sumo.vehicle_getLanePosition(vehicle)
    if left <= 0:
        return None
    target = sumo.vehicle_getLaneIndex(vehicle) + (1 if offset > 0 else -1)
    return _MergesLate(vehicle, target, length, min(how_strong, left))
