"""The first contact of two actors between two scenes: its time, the touched sides, and the collider.

The module computes when two moving rectangles first overlap. Scenes are one step apart (0.1 s to 1 s). A test of only
the scenes would miss contacts between two scenes, and would report other contacts too late.

Each rectangle follows a cubic curve between its poses (`_Way`). Conservative advancement (Mirtich, Impulse-based
dynamic simulation of rigid body systems, 1996) repeatedly moves forward in time. Each move is the gap divided by a
bound of the approach speed, so no contact is skipped. A fixed small time step would be slower and could miss a short
overlap. Bisection finds the time of the overlap to within 1e-9 of a step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Literal

from crashhunt.world._geometry import Level, Rectangle, center, levels, outlines, same_level, separation
from crashhunt.world._scene import Scene, is_person

if TYPE_CHECKING:
    from collections.abc import Sequence

STANDS_MPS = 0.1
"""An actor that moves more slowly than this stands, in m/s."""

MAX_CONTACT_GAP_M = 1.0
"""A reported collision of actors whose outlines are further apart than this is no contact of the outlines, in m."""

Face = Literal["front", "rear", "left", "right"]
"""A side of an actor, as seen from its driver."""

_JUMP_M = 1.5  # sideways in one step: less is drift within a lane, more is an instantaneous lane change
_LANES_M = 12.0  # sideways in one step: more is a teleport, not a lane change
_MAX_TURN_RAD = 2.0  # rad in one step: more is not a bend that a cubic describes
_STEP_M = 1e-3  # of relative motion: shorter overlaps are not searched for
_MIN_OVERLAP_M = 1e-9  # m: smaller overlaps are rounding errors
_FRONT_COSINE = math.cos(math.pi / 4)  # an actor within 45° of straight ahead is in front
_CURVE_SHARE = 1 / 32  # of distance times turn: a quarter of the height of a bend above its chord
_DRIFT_MPS = 1e-3  # towards each other: a smaller difference is a rounding error
_SLACK_M = 0.4  # upper bound of the tolerance for unknown ways between scenes
_KINK, _NO_TURN = 0.02, 0.01  # tolerance as a share of the distance, reached at this turn in rad: lanes have corners


@dataclass(frozen=True, slots=True)
class Touch:
    """The first contact of two actors."""

    time_s: float  # simulation time of the contact, in s
    share: float  # time of the contact as a share of the step, from 0 to 1; 1 is the present scene
    drives_into: bool  # whether the first actor drives into the second; otherwise the second drives into the first
    x: float  # x of the first actor's front bumper, in m
    y: float  # y of the first actor's front bumper, in m
    speed: float  # speed of the first actor, in m/s
    other_speed: float  # speed of the second actor, in m/s
    face: Face  # the side of the first actor that is touched
    other_face: Face  # the side of the second actor that is touched
    turn: float  # heading of the second actor minus heading of the first actor, in rad, from -pi to pi
    jumps: bool = False  # whether the first actor causes the contact by an instantaneous lane change
    other_jumps: bool = False  # whether the second actor causes the contact by an instantaneous lane change
    gap_m: float = 0.0  # a lower bound of the distance between their outlines; 0 if they touch

    @property
    def is_sideways(self) -> bool:
        """Whether an instantaneous lane change causes the contact."""
        return self.jumps or self.other_jumps


@dataclass(frozen=True, slots=True)
class _Party:
    """An actor at the time of the contact."""

    rectangle: Rectangle  # the part of the actor that is touched
    leads: bool  # whether this is the front part of the actor
    trails: bool  # whether this is the back part of the actor
    velocity: tuple[float, float]  # velocity of this part, without a jump sideways, in m/s
    jump: tuple[float, float] = (0.0, 0.0)  # sideways jump of the actor at the contact, in m

    @property
    def stands(self) -> bool:
        return math.hypot(*self.velocity) < STANDS_MPS

    def face(self, x: float, y: float) -> Face:
        """Return the side of the rectangle that faces the given direction."""
        c, s = math.cos(self.rectangle[2]), math.sin(self.rectangle[2])
        ahead, left = x * c + y * s, y * c - x * s
        if abs(ahead) > _FRONT_COSINE and (self.leads if ahead > 0 else self.trails):
            return "front" if ahead > 0 else "rear"
        return "left" if left > 0 else "right"


class _Way:
    """The motion of one rectangle from one scene to the next.

    The centre of the rectangle follows a cubic curve whose tangents are the headings at both ends. The heading of a
    vehicle is the direction of the lane below its centre rather than below its bumper. If the end is further to the
    side than any bend explains, the vehicle has changed lanes instantaneously. As in SUMO, the vehicle then moves in
    its old lane first, and jumps to the new lane at the end.
    """

    __slots__ = ("_heading", "_size", "end", "jump", "legs", "points", "reach", "slack", "turn")

    def __init__(self, start: Rectangle, end: Rectangle, *, bends: bool) -> None:
        self.end = end
        self._heading, self._size = start[2], start[3:]
        self.reach = math.hypot(start[3], start[4]) / 2
        (x0, y0), (x1, y1) = center(start), center(end)
        self.turn = turn = math.remainder(end[2] - start[2], math.tau)
        middle = start[2] + turn / 2
        dx, dy = x1 - x0, y1 - y0
        self.jump = (0.0, 0.0)
        if bends and abs(_sideways_excess(dx, dy, start[2], turn)) > _JUMP_M:
            side = dy * math.cos(middle) - dx * math.sin(middle)
            self.jump = (-side * math.sin(middle), side * math.cos(middle))
            dx, dy = dx - self.jump[0], dy - self.jump[1]
        distance = math.hypot(dx, dy)
        self.slack = _SLACK_M if any(self.jump) else 0.0
        first, second = (x0 + dx / 3, y0 + dy / 3), (x0 + 2 * dx / 3, y0 + 2 * dy / 3)
        # Vehicles that stand, reverse or turn on the spot, as persons do, go straight.
        if bends and abs(turn) < _MAX_TURN_RAD and dx * math.cos(middle) + dy * math.sin(middle) > 0:
            # With these handles the cubic is almost exactly an arc where the motion is one.
            third = distance * (
                2 / 3 * math.tan(turn / 4) / math.sin(turn / 2) if abs(turn) > _MIN_OVERLAP_M else 1 / 3
            )
            first = (x0 + third * math.cos(start[2]), y0 + third * math.sin(start[2]))
            second = (x0 + dx - third * math.cos(end[2]), y0 + dy - third * math.sin(end[2]))
            self.slack += min(_SLACK_M, distance * (abs(turn) * _CURVE_SHARE + _KINK * min(1.0, abs(turn) / _NO_TURN)))
        self.points = ((x0, y0), first, second, (x0 + dx, y0 + dy))
        self.legs = tuple((b[0] - a[0], b[1] - a[1]) for a, b in pairwise(self.points))

    def at(self, share: float) -> Rectangle:
        """Return the rectangle at a share of the step; for a share of 1, after the jump."""
        if share >= 1.0:
            return self.end
        rest = 1 - share
        a, b, c, d = rest**3, 3 * rest * rest * share, 3 * rest * share * share, share**3
        (x0, y0), (x1, y1), (x2, y2), (x3, y3) = self.points
        heading, (length, width) = self._heading + share * self.turn, self._size
        x = a * x0 + b * x1 + c * x2 + d * x3 + length / 2 * math.cos(heading)
        y = a * y0 + b * y1 + c * y2 + d * y3 + length / 2 * math.sin(heading)
        return x, y, heading, length, width

    def moving(self, share: float) -> tuple[float, float]:
        """Return the direction and the speed of the centre, in m per step, without a jump."""
        rest = 1 - share
        a, b, c = 3 * rest * rest, 6 * rest * share, 3 * share * share
        (x0, y0), (x1, y1), (x2, y2) = self.legs
        return a * x0 + b * x1 + c * x2, a * y0 + b * y1 + c * y2


def poses_between(start: Rectangle, end: Rectangle, shares: Sequence[float], *, bends: bool = True) -> list[Rectangle]:
    """Return the rectangles of an actor at some shares of a step, on the path that contacts are computed with.

    Args:
        start: pose at the beginning of the step: x and y of the front in m, heading in rad, length and width in m.
        end: pose at the end of the step, in the same form.
        shares: shares of the step, from 0 to 1; an instantaneous lane change takes place at 1.
        bends: whether the actor drives along a curve; persons do not.
    """
    way = _Way(start, end, bends=bends)
    return [way.at(share) for share in shares]


def first_contact(previous: Scene | None, present: Scene, row: int, other: int) -> Touch | None:
    """Return the first contact of two actors after the previous scene and up to the present scene.

    Without a previous scene, only the present scene is examined.

    Returns:
        The first contact; None if the actors do not touch, or pass each other on different levels.
    """
    pair = (row, other)
    before = _rows_before(previous, present, pair)
    ways = _ways(previous, present, pair, before)
    return _first_touch(previous, present, pair, before, ways)


def contact_at(
    previous: Scene | None, present: Scene, row: int, other: int, *, swept: bool = True, grazing: bool = False
) -> Touch:
    """Return the contact of two actors that are known to have collided, computed as in `first_contact`.

    Args:
        previous: the scene one step before; if None, only the present scene is examined.
        present: the scene of the contact.
        row: row of the first actor in the present scene.
        other: row of the second actor in the present scene.
        swept: whether actors drive along curves, as in `Scene`. If False, actors move in straight lines without jumps,
            and the time is an estimate.
        grazing: whether a contact counts that is so slight that the estimated ways between the scenes leave it open.

    Returns:
        The contact. If the outlines do not touch, as in some collisions reported by simulators, the positions at the
        end of the step are used.
    """
    pair = (row, other)
    before = _rows_before(previous, present, pair)
    ways = _ways(previous, present, pair, before, bends=swept)
    found = _first_touch(previous, present, pair, before, ways)
    if found is None and grazing:
        for way in chain.from_iterable(ways):
            way.slack = 0.0
        found = _first_touch(previous, present, pair, before, ways)
    return found or _touch(previous, present, pair, before, ways, (1.0, *_nearest(ways)))


def _ways(
    previous: Scene | None,
    present: Scene,
    pair: tuple[int, int],
    before: tuple[int, int] | None,
    *,
    bends: bool = True,
) -> list[list[_Way]]:
    """Return the motions of the parts of both actors."""
    ways: list[list[_Way]] = []
    for place, who in enumerate(pair):
        if previous is None or before is None:
            ways.append([_Way(end, end, bends=False) for end in outlines(present, who)])
            continue
        pieces = max(_pieces(present, who), _pieces(previous, before[place]))
        drives = bends and not is_person(present.roster.actors[who].id)
        starts, ends = outlines(previous, before[place], parts=pieces), outlines(present, who, parts=pieces)
        ways.append([_Way(start, end, bends=drives) for start, end in zip(starts, ends, strict=True)])
    return ways


def _first_touch(
    previous: Scene | None,
    present: Scene,
    pair: tuple[int, int],
    before: tuple[int, int] | None,
    ways: list[list[_Way]],
) -> Touch | None:
    best: tuple[float, int, int] | None = None
    heights = [levels(present, who, parts=len(way)) for who, way in zip(pair, ways, strict=True)]
    for one, way in enumerate(ways[0]):
        for two, other_way in enumerate(ways[1]):
            if present.heights and not _same_level(present, pair, (way, other_way), heights[0][one], heights[1][two]):
                continue
            share = _first_share(way, other_way, until=best[0] if best else 1.0, still=before is None)
            if share is not None and (best is None or share < best[0]):
                best = share, one, two
    return None if best is None else _touch(previous, present, pair, before, ways, best)


def _nearest(ways: list[list[_Way]]) -> tuple[int, int]:
    """Return the parts of both actors that are nearest to each other at the end of the step."""
    return min(
        ((one, two) for one in range(len(ways[0])) for two in range(len(ways[1]))),
        key=lambda parts: separation(ways[0][parts[0]].end, ways[1][parts[1]].end)[0],
    )


def _touch(
    previous: Scene | None,
    present: Scene,
    pair: tuple[int, int],
    before: tuple[int, int] | None,
    ways: list[list[_Way]],
    best: tuple[float, int, int],
) -> Touch:
    """Return the contact at a share of the step, between one part of each actor."""
    share, *parts = best
    time_s, step_s, speeds = present.time_s, 0.0, [present.speeds[who] for who in pair]
    if previous is not None and before is not None:
        step_s = present.time_s - previous.time_s
        time_s = previous.time_s + share * step_s
        speeds = [
            _speed_at(share, previous.speeds[was], now, way[0], step_s)
            for was, now, way in zip(before, speeds, ways, strict=True)
        ]
    parties = []
    for speed, way, part in zip(speeds, ways, parts, strict=True):
        touching = way[part]
        if step_s > 0:
            vx, vy = touching.moving(share)
            velocity = vx / step_s, vy / step_s
        else:
            velocity = speed * math.cos(touching.end[2]), speed * math.sin(touching.end[2])
        jump = touching.jump if share >= 1.0 else (0.0, 0.0)
        parties.append(
            _Party(touching.at(share), leads=part == 0, trails=part == len(way) - 1, velocity=velocity, jump=jump)
        )
    first, second = parties
    x, y, jumps = _direction(first, second)
    front_x, front_y, heading, *_ = ways[0][0].at(share)
    return Touch(
        time_s=time_s,
        share=share,
        drives_into=_drives_into(first, second, x, y, jumps=jumps),
        x=front_x,
        y=front_y,
        speed=speeds[0],
        other_speed=speeds[1],
        face=first.face(x, y),
        other_face=second.face(-x, -y),
        turn=math.remainder(ways[1][0].at(share)[2] - heading, math.tau),
        jumps=jumps and any(first.jump),
        other_jumps=jumps and any(second.jump),
        gap_m=max(0.0, separation(first.rectangle, second.rectangle)[0]),
    )


def _speed_at(share: float, was: float, now: float, way: _Way, step_s: float) -> float:
    """Return the speed of an actor at a share of a step, in m/s.

    Simulators integrate differently. By default, a vehicle of SUMO drives the whole step at the new speed; in other
    simulators, the acceleration is constant. The distance driven in the step shows which of the two methods, or which
    mixture, was used.
    """
    (x0, y0), *_, (x1, y1) = way.points
    mean, driven = (was + now) / 2, math.hypot(x1 - x0, y1 - y0) / step_s
    steady = min(1.0, max(0.0, (driven - mean) / (now - mean))) if abs(now - mean) > _MIN_OVERLAP_M else 0.0
    return steady * now + (1 - steady) * ((1 - share) * was + share * now)


def lane_jump(previous: Scene, present: Scene, actor: str) -> float:
    """Return how far an actor jumped sideways between two scenes, in m to its left; 0 if it did not jump.

    SUMO changes lanes in an instant. A movement that a bend explains is not a jump, and neither is a teleport.
    """
    was, row = previous.roster.index.get(actor), present.roster.index.get(actor)
    if was is None or row is None or is_person(actor) or _rows_before(previous, present, (row, row)) is None:
        return 0.0
    pieces = max(_pieces(present, row), _pieces(previous, was))
    way = _Way(outlines(previous, was, parts=pieces)[0], outlines(present, row, parts=pieces)[0], bends=True)
    middle = previous.headings[was] + way.turn / 2
    return way.jump[1] * math.cos(middle) - way.jump[0] * math.sin(middle)


def reachable_m(speed: float, time_s: float) -> float:
    """Return the maximum distance that an actor with a speed can drive in a step; a longer movement is a teleport."""
    return 1.5 * speed * time_s + 1.0


def _rows_before(previous: Scene | None, present: Scene, pair: tuple[int, int]) -> tuple[int, int] | None:
    """Return the rows of both actors in the previous scene; None if an actor was absent, or did not drive there."""
    if previous is None:
        return None
    found = []
    for who in pair:
        was = who if previous.roster is present.roster else previous.roster.index.get(present.roster.actors[who].id)
        if was is None:
            return None
        (x, y), (old_x, old_y) = present.points[who], previous.points[was]
        heading = previous.headings[was] + math.remainder(present.headings[who] - previous.headings[was], math.tau) / 2
        ahead = (x - old_x) * math.cos(heading) + (y - old_y) * math.sin(heading)
        far = reachable_m(max(present.speeds[who], previous.speeds[was]), present.time_s - previous.time_s)
        if abs(ahead) > far or math.hypot(x - old_x, y - old_y) > far + _LANES_M:
            return None
        found.append(was)
    return found[0], found[1]


def _pieces(scene: Scene, row: int) -> int:
    spine = scene.spines.get(row)
    return 1 if spine is None else len(spine) - 1


def _sideways_excess(dx: float, dy: float, heading: float, turn: float) -> float:
    """Return the distance to the left, in m, by which a movement exceeds what a bend with this turn explains."""
    across = dy * math.cos(heading) - dx * math.sin(heading)
    end = heading + turn
    across_end = dy * math.cos(end) - dx * math.sin(end)
    # A bend to the left ends left of its first tangent and right of its last one.
    low, high = (across_end, across) if turn >= 0 else (across, across_end)
    return low if low > 0 else min(high, 0.0)


def _same_level(scene: Scene, pair: tuple[int, int], ways: tuple[_Way, _Way], one: Level, two: Level) -> bool:
    lower = scene.roster.actors[pair[0] if one[0] < two[0] else pair[1]]
    return same_level(ways[0].end, one, ways[1].end, two, lower.height)


def _first_share(way: _Way, other: _Way, *, until: float, still: bool) -> float | None:
    """Return the share of the step at which two rectangles first overlap; None if they do not overlap.

    The method is conservative advancement: the rectangles cannot touch before the time that results from the gap
    divided by a bound of the approach speed.
    """
    touching = separation(way.end, other.end)[0] < -_MIN_OVERLAP_M
    if still:
        return 1.0 if touching else None
    fastest = 3 * max(
        math.hypot(leg[0] - moved[0], leg[1] - moved[1]) for leg, moved in zip(way.legs, other.legs, strict=True)
    )
    for each in (way, other):
        fastest += abs(each.turn) * each.reach
    # The way between scenes is known to some centimetres only, so ignore grazing contacts in bends.
    slack = _MIN_OVERLAP_M if touching else _MIN_OVERLAP_M + way.slack + other.slack
    share, apart_at = 0.0, 0.0
    while share < until:
        apart = separation(way.at(share), other.at(share))[0]
        if apart < -slack:
            return _bisect(way, other, apart_at, share)
        if apart >= -_MIN_OVERLAP_M:
            apart_at = share
        if not fastest:
            break
        share += max(apart + slack, _STEP_M) / fastest
    return 1.0 if touching and until >= 1.0 else None


def _bisect(way: _Way, other: _Way, apart: float, together: float) -> float:
    while together - apart > 1e-9:
        middle = (apart + together) / 2
        if separation(way.at(middle), other.at(middle))[0] < -_MIN_OVERLAP_M:
            together = middle
        else:
            apart = middle
    return together


def _direction(first: _Party, second: _Party) -> tuple[float, float, bool]:
    """Return the unit vector from the first to the second rectangle, and whether a jump causes the contact."""
    jump_x, jump_y = first.jump[0] - second.jump[0], first.jump[1] - second.jump[1]
    length = math.hypot(jump_x, jump_y)
    if length > _JUMP_M:
        # Behind a jump the outlines overlap deeply, often in the middle of the same lane. The axis of the least
        # overlap, or the sign of a lateral offset of 1e-14 m, then says nothing. The jump itself is the direction.
        return jump_x / length, jump_y / length, True
    _, x, y = separation(first.rectangle, second.rectangle)
    (own_x, own_y), (its_x, its_y) = center(first.rectangle), center(second.rectangle)
    if abs((its_x - own_x) * x + (its_y - own_y) * y) < _MIN_OVERLAP_M:  # the sign of the axis is a rounding error
        approach = (first.velocity[0] - second.velocity[0]) * x + (first.velocity[1] - second.velocity[1]) * y
        if approach < 0:
            x, y = -x, -y
    return x, y, False


def _drives_into(first: _Party, second: _Party, x: float, y: float, *, jumps: bool) -> bool:
    """Return whether the first actor drives into the second.

    The unit vector (x, y) points from the first to the second actor. With ``jumps``, an instantaneous lane change
    causes the contact.
    """
    if jumps:  # the actor that moves into the other's lane
        own, its = first.jump[0] * x + first.jump[1] * y, -second.jump[0] * x - second.jump[1] * y
        return own > its - _JUMP_M / 2  # both towards each other: the actor in question, as head-on
    if first.stands != second.stands:
        return second.stands  # an actor that stands drives into nothing
    own, its = (first.velocity[0] * x + first.velocity[1] * y, -second.velocity[0] * x - second.velocity[1] * y)
    fronts = first.face(x, y) == "front", second.face(-x, -y) == "front"
    if all(fronts):
        return True  # head-on: the actor in question drives into the other
    if any(fronts) and (own > 0 or its > 0 or first.stands):
        towards, its_towards = (own, its) if fronts[0] else (its, own)
        # The front drives into the other, unless it moves away from it, and the other reverses or slides into it.
        return fronts[0] if towards > 0 or its_towards <= 0 else fronts[1]
    if abs(own - its) > _DRIFT_MPS:
        return own > its
    (own_x, own_y), (its_x, its_y) = center(first.rectangle), center(second.rectangle)
    return (its_x - own_x) * math.cos(first.rectangle[2]) + (its_y - own_y) * math.sin(first.rectangle[2]) > 0
