"""A person of SUMO's who steps out onto the road and back, as nobody does there of their own accord.

SUMO 1.28 maps a person that is moved to the best lane nearby. Where that is a crossing or a walking area that the
person was not on, SUMO guesses a path across it, and the process may die in this step or the next one: 90 of 480
step-outs that began on a crossing or a walking area, 121 of 1,860 that began within 12 m of a junction. So a person
steps out only where its own lane remains the best one all the way, which `can_step_out` predicts.
"""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.world import PERSON

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.world import Scene

__all__ = ["JunctionLanes", "SteppingOut", "can_step_out", "roadside"]

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
