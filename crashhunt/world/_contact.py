"""The first contact of two actors between two scenes, and which one drives into the other.

Computes when two moving rectangles first overlap. Scenes are steps apart (0.1 s to 1 s), so a test of the scenes alone
misses contacts in between and reports others too late.

Each rectangle follows a cubic between its poses (`_Way`). Conservative advancement then moves forward in time by the
gap divided by a bound of the approach speed, so no contact is skipped (B. Mirtich, Impulse-based dynamic simulation of
rigid body systems, 1996). A fixed small time step would be slower and could miss a short overlap. Bisection finds the
time of the overlap to within 1e-9 of a step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from crashhunt.world._geometry import levels, outlines, same_level, separation
from crashhunt.world._scene import is_person

if TYPE_CHECKING:
    from crashhunt.world._geometry import Level, Rectangle
    from crashhunt.world._scene import Scene

__all__ = ["Touch", "first_contact"]

_JUMP_M = 1.5  # sideways in one step: less is drift within a lane, more is an instantaneous lane change
_LANES_M = 12.0  # sideways in one step: more is a teleport, not a lane change
_TURN = 2.0  # rad in one step: more is not a bend that a cubic describes
_STEP_M = 1e-3  # of relative motion: shorter overlaps are not searched for
_TOUCH = 1e-9  # m: smaller overlaps are rounding errors
_FRONT = math.cos(math.pi / 4)  # an actor within 45° of straight ahead is in front
_CURVE = 1 / 32  # of distance times turn: a quarter of the height of a bend above its chord
_SLACK_M = 0.4  # upper bound of the tolerance for unknown ways between scenes
_KINK, _NO_TURN = 0.02, 0.01  # tolerance as a share of the distance, reached at this turn in rad: lanes have corners


@dataclass(frozen=True, slots=True)
class Touch:
    """The first contact of two actors.

    Args:
        time_s: simulation time, in s.
        share: of the step, from 0 to 1; 1 is the present scene.
        drives_into: whether the first actor drives into the second; otherwise the second drives into the first.
        x: of the first actor's front bumper, in m.
        y: likewise.
        speed: of the first actor, in m/s.
        other_speed: of the second actor, in m/s.
    """

    time_s: float
    share: float
    drives_into: bool
    x: float
    y: float
    speed: float
    other_speed: float


_Party = tuple["Rectangle", bool, tuple[float, float]]
"""A rectangle in contact, whether it is the front part of its vehicle, and its direction of motion."""


class _Way:
    """The motion of one rectangle from one scene to the next.

    Its centre follows a cubic with the headings at both ends as tangents. The heading of a vehicle is the direction of
    the lane below its centre rather than below its bumper. Where the end is further to the side than any bend
    explains, the vehicle has changed lanes instantaneously. As in SUMO, it then moves in its old lane first, and jumps
    to the new one at the end.
    """

    __slots__ = ("_heading", "_size", "end", "jump", "legs", "points", "reach", "slack", "turn")

    def __init__(self, start: Rectangle, end: Rectangle, *, bends: bool) -> None:
        self.end = end
        self._heading, self._size = start[2], start[3:]
        self.reach = math.hypot(start[3], start[4]) / 2
        (x0, y0), (x1, y1) = _center(start), _center(end)
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
        if bends and abs(turn) < _TURN and dx * math.cos(middle) + dy * math.sin(middle) > 0:
            # With these handles the cubic is almost exactly an arc where the motion is one.
            third = distance * (2 / 3 * math.tan(turn / 4) / math.sin(turn / 2) if abs(turn) > _TOUCH else 1 / 3)
            first = (x0 + third * math.cos(start[2]), y0 + third * math.sin(start[2]))
            second = (x0 + dx - third * math.cos(end[2]), y0 + dy - third * math.sin(end[2]))
            self.slack += min(_SLACK_M, distance * (abs(turn) * _CURVE + _KINK * min(1.0, abs(turn) / _NO_TURN)))
        self.points = ((x0, y0), first, second, (x0 + dx, y0 + dy))
        self.legs = tuple((b[0] - a[0], b[1] - a[1]) for a, b in pairwise(self.points))

    def at(self, share: float) -> Rectangle:
        """Return the rectangle at a share of the step; at 1, after the jump."""
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
        """Return direction and speed of the centre, in m per step; at a jump, the jump."""
        if share >= 1.0 and any(self.jump):
            return self.jump
        rest = 1 - share
        a, b, c = 3 * rest * rest, 6 * rest * share, 3 * share * share
        (x0, y0), (x1, y1), (x2, y2) = self.legs
        return a * x0 + b * x1 + c * x2, a * y0 + b * y1 + c * y2


def first_contact(previous: Scene | None, present: Scene, row: int, other: int) -> Touch | None:
    """Return when two actors first touch, after the previous scene and up to the present one.

    Args:
        previous: the scene one step before; None looks at the present one only.
        present: the scene.
        row: one actor.
        other: another.

    Returns:
        The first contact; None where they do not touch, or pass on different levels.
    """
    pair = (row, other)
    before = _rows_before(previous, present, pair)
    ways: list[list[_Way]] = []
    for place, who in enumerate(pair):
        if previous is None or before is None:
            ways.append([_Way(end, end, bends=False) for end in outlines(present, who)])
            continue
        pieces = max(_pieces(present, who), _pieces(previous, before[place]))
        bends = not is_person(present.roster.actors[who].id)
        starts, ends = outlines(previous, before[place], parts=pieces), outlines(present, who, parts=pieces)
        ways.append([_Way(start, end, bends=bends) for start, end in zip(starts, ends, strict=True)])
    best: tuple[float, int, int] | None = None
    heights = [levels(present, who, parts=len(way)) for who, way in zip(pair, ways, strict=True)]
    for one, way in enumerate(ways[0]):
        for two, other_way in enumerate(ways[1]):
            if present.heights and not _same_level(present, pair, (way, other_way), heights[0][one], heights[1][two]):
                continue
            share = _first_share(way, other_way, until=best[0] if best else 1.0, still=before is None)
            if share is not None and (best is None or share < best[0]):
                best = share, one, two
    if best is None:
        return None
    share, one, two = best
    touching = ways[0][one], ways[1][two]
    speeds, time_s = [present.speeds[who] for who in pair], present.time_s
    if previous is not None and before is not None:
        time_s = previous.time_s + share * (time_s - previous.time_s)
        speeds = [(1 - share) * previous.speeds[was] + share * now for was, now in zip(before, speeds, strict=True)]
        moving = [way.moving(share) for way in touching]
    else:
        moving = [
            (speed * math.cos(way.end[2]), speed * math.sin(way.end[2]))
            for speed, way in zip(speeds, touching, strict=True)
        ]
    x, y, *_ = ways[0][0].at(share)
    first, second = (way.at(share) for way in touching)
    drives_into = _drives_into((first, one == 0, moving[0]), (second, two == 0, moving[1]))
    return Touch(time_s=time_s, share=share, drives_into=drives_into, x=x, y=y, speed=speeds[0], other_speed=speeds[1])


def reachable_m(speed: float, time_s: float) -> float:
    """Return the distance that an actor of this speed can cover in a step; after a larger one it has been moved."""
    return 1.5 * speed * time_s + 1.0


def _rows_before(previous: Scene | None, present: Scene, pair: tuple[int, int]) -> tuple[int, int] | None:
    """Return both rows in the previous scene; None where an actor was absent, or was moved instead of driving."""
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
    """Return how far to the left, in m, a displacement is outside of the ends of all bends by a turn."""
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
    """Return the share of the step at which two rectangles first overlap; None where they do not.

    Conservative advancement: during the gap divided by a bound of the approach speed, no contact is possible.
    """
    touching = separation(way.end, other.end)[0] < -_TOUCH
    if still:
        return 1.0 if touching else None
    fastest = 3 * max(
        math.hypot(leg[0] - moved[0], leg[1] - moved[1]) for leg, moved in zip(way.legs, other.legs, strict=True)
    )
    for each in (way, other):
        fastest += abs(each.turn) * each.reach
    # The way between scenes is known to some centimetres only, so ignore grazing contacts in bends.
    slack = _TOUCH if touching else _TOUCH + way.slack + other.slack
    share, apart_at = 0.0, 0.0
    while share < until:
        apart = separation(way.at(share), other.at(share))[0]
        if apart < -slack:
            return _bisect(way, other, apart_at, share)
        if apart >= -_TOUCH:
            apart_at = share
        if not fastest:
            break
        share += max(apart + slack, _STEP_M) / fastest
    return 1.0 if touching and until >= 1.0 else None


def _bisect(way: _Way, other: _Way, apart: float, together: float) -> float:
    while together - apart > 1e-9:
        middle = (apart + together) / 2
        if separation(way.at(middle), other.at(middle))[0] < -_TOUCH:
            together = middle
        else:
            apart = middle
    return together


def _drives_into(first: _Party, second: _Party) -> bool:
    """Return whether the first drives into the second: the second is in front of it, or it moves towards it faster."""
    (own, own_leads, own_moving), (other, other_leads, other_moving) = first, second
    _, x, y = separation(own, other)
    own_front = own_leads and x * math.cos(own[2]) + y * math.sin(own[2]) > _FRONT
    other_front = other_leads and -x * math.cos(other[2]) - y * math.sin(other[2]) > _FRONT
    if own_front or other_front:
        return own_front  # head-on: the actor in question drives into the other
    more = (own_moving[0] + other_moving[0]) * x + (own_moving[1] + other_moving[1]) * y
    if abs(more) > _STEP_M:
        return more > 0
    (x, y), (other_x, other_y) = _center(own), _center(other)
    return (other_x - x) * math.cos(own[2]) + (other_y - y) * math.sin(own[2]) > 0


def _center(rectangle: Rectangle) -> tuple[float, float]:
    x, y, heading, length, _ = rectangle
    return x - length / 2 * math.cos(heading), y - length / 2 * math.sin(heading)
