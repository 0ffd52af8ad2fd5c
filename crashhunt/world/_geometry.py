"""Outlines of actors: oriented rectangles, whether they overlap, their distance, and when they will touch."""

from __future__ import annotations

import math
from itertools import pairwise
from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.world._scene import Scene


_MIN_OVERLAP_M = 1e-9  # m; less is rounding, not overlap


def outlines_overlap(one: Rectangle, two: Rectangle, *, margin: float = 0.0) -> bool:
    """Return whether two outlines overlap, by the separating axis theorem.

    Args:
        one: the first outline.
        two: the second outline.
        margin: distance in m below which two outlines count as overlapping; some pairs slightly above it also count.
    """
    x1, y1, h1, l1, w1 = one
    x2, y2, h2, l2, w2 = two
    c1, s1, c2, s2 = cos(h1), sin(h1), cos(h2), sin(h2)
    dx, dy = (x2 - l2 / 2 * c2) - (x1 - l1 / 2 * c1), (y2 - l2 / 2 * s2) - (y1 - l1 / 2 * s1)
    along, across = abs(c1 * c2 + s1 * s2), abs(c1 * s2 - s1 * c2)
    if abs(-dx * s1 + dy * c1) >= (w1 + l2 * across + w2 * along) / 2 - _MIN_OVERLAP_M + margin:
        return False
    if abs(dx * c1 + dy * s1) >= (l1 + l2 * along + w2 * across) / 2 - _MIN_OVERLAP_M + margin:
        return False
    if abs(-dx * s2 + dy * c2) >= (w2 + l1 * across + w1 * along) / 2 - _MIN_OVERLAP_M + margin:
        return False
    return abs(dx * c2 + dy * s2) < (l2 + l1 * along + w1 * across) / 2 - _MIN_OVERLAP_M + margin


def separation(one: Rectangle, two: Rectangle) -> tuple[float, float, float]:
    """Return the distance of two rectangles along the axis on which it is greatest, and this axis.

    Returns:
        The distance in m, which is negative if the rectangles overlap, and never more than the real gap. Then x and y
        of the unit vector from the first to the second rectangle.
    """
    x1, y1, h1, l1, w1 = one
    x2, y2, h2, l2, w2 = two
    c1, s1, c2, s2 = cos(h1), sin(h1), cos(h2), sin(h2)
    dx, dy = (x2 - l2 / 2 * c2) - (x1 - l1 / 2 * c1), (y2 - l2 / 2 * s2) - (y1 - l1 / 2 * s1)
    along, across = abs(c1 * c2 + s1 * s2), abs(c1 * s2 - s1 * c2)
    best, best_x, best_y = -1e300, 1.0, 0.0
    for x, y, reach in (
        (c1, s1, (l1 + l2 * along + w2 * across) / 2),
        (-s1, c1, (w1 + l2 * across + w2 * along) / 2),
        (c2, s2, (l2 + l1 * along + w1 * across) / 2),
        (-s2, c2, (w2 + l1 * across + w1 * along) / 2),
    ):
        distance = dx * x + dy * y
        apart = abs(distance) - reach
        if apart > best:
            sign = -1.0 if distance < 0 else 1.0
            best, best_x, best_y = apart, sign * x, sign * y
    return best, best_x, best_y


def rectangle_gap(
    offset: NDArray[np.float64],
    turn: NDArray[np.float64],
    half_one: NDArray[np.float64],
    half_two: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the distance between pairs of rectangles; 0 if they overlap.

    Args:
        offset: shape (n, 2), from the centre of the first rectangle to the centre of the second, in the frame of the
            first, in m.
        turn: shape (n,), heading of the second rectangle in the frame of the first, in rad.
        half_one: shape (n, 2), half length and half width of the first rectangle, in m.
        half_two: shape (n, 2), half length and half width of the second rectangle, in m.

    Returns:
        The distances, shape (n,), in m.
    """
    cosine, sine = np.cos(turn), np.sin(turn)
    # Between two convex outlines that do not overlap, a corner of one of them is nearest to the other.
    back_x = -(offset[:, 0] * cosine + offset[:, 1] * sine)
    back_y = offset[:, 0] * sine - offset[:, 1] * cosine
    nearest = np.full(len(turn), np.inf)
    for sign_x in (-1.0, 1.0):
        for sign_y in (-1.0, 1.0):
            x, y = sign_x * half_two[:, 0], sign_y * half_two[:, 1]
            one = _outside(offset[:, 0] + x * cosine - y * sine, offset[:, 1] + x * sine + y * cosine, half_one)
            x, y = sign_x * half_one[:, 0], sign_y * half_one[:, 1]
            two = _outside(back_x + x * cosine + y * sine, back_y - x * sine + y * cosine, half_two)
            nearest = np.minimum(nearest, np.minimum(one, two))
    apart = _separations(offset, cosine, sine, half_one, half_two).max(axis=0) > 0
    return np.where(apart, nearest, 0.0)


def outline_gap(one: Rectangle, two: Rectangle) -> float:
    """Return the distance between two outlines, in m; 0 if they overlap."""
    (x, y), (other_x, other_y) = center(one), center(two)
    c, s, dx, dy = cos(one[2]), sin(one[2]), other_x - x, other_y - y
    offset, turn = np.array([[dx * c + dy * s, dy * c - dx * s]]), np.array([two[2] - one[2]])
    halves = (np.array([[length / 2, width / 2]]) for *_, length, width in (one, two))
    return float(rectangle_gap(offset, turn, *halves)[0])


def time_to_contact(
    offset: NDArray[np.float64],
    velocity: NDArray[np.float64],
    turn: NDArray[np.float64],
    half_one: NDArray[np.float64],
    half_two: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return when pairs of rectangles first touch if both move at constant velocity; infinite for never.

    On every separating axis, the projections overlap during one interval of time. The outlines touch while all four
    projections overlap. Source (swept separating axis test): Eberly, Intersection of convex objects, the method of
    separating axes.

    Args:
        offset: shape (n, 2), from the centre of the first rectangle to the centre of the second, in the frame of the
            first, in m.
        velocity: shape (n, 2), velocity of the second rectangle relative to the first, in the frame of the first, in
            m/s.
        turn: shape (n,), heading of the second rectangle in the frame of the first, in rad.
        half_one: shape (n, 2), half length and half width of the first rectangle, in m.
        half_two: shape (n, 2), half length and half width of the second rectangle, in m.

    Returns:
        The times, shape (n,), in s; 0 if the rectangles overlap already.
    """
    cosine, sine = np.cos(turn), np.sin(turn)
    along, across = np.abs(cosine), np.abs(sine)
    zero, one = np.zeros_like(turn), np.ones_like(turn)
    axes = (
        (one, zero, half_one[:, 0] + half_two[:, 0] * along + half_two[:, 1] * across),
        (zero, one, half_one[:, 1] + half_two[:, 0] * across + half_two[:, 1] * along),
        (cosine, sine, half_two[:, 0] + half_one[:, 0] * along + half_one[:, 1] * across),
        (-sine, cosine, half_two[:, 1] + half_one[:, 0] * across + half_one[:, 1] * along),
    )
    enter, leave = np.zeros_like(turn), np.full_like(turn, np.inf)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for axis_x, axis_y, reach in axes:
            distance = offset[:, 0] * axis_x + offset[:, 1] * axis_y
            speed = velocity[:, 0] * axis_x + velocity[:, 1] * axis_y
            still = np.abs(speed) < 1e-12
            first, last = (-reach - distance) / speed, (reach - distance) / speed
            inside = np.abs(distance) < reach
            begin = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(first, last))
            end = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(first, last))
            enter, leave = np.maximum(enter, begin), np.minimum(leave, end)
    return np.where(enter < leave, enter + 0.0, np.inf)  # no minus zero


def _outside(x: NDArray[np.float64], y: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances of points from rectangles around the origin."""
    distance: NDArray[np.float64] = np.hypot(
        np.maximum(np.abs(x) - half[:, 0], 0.0), np.maximum(np.abs(y) - half[:, 1], 0.0)
    )
    return distance


def _separations(
    offset: NDArray[np.float64],
    cosine: NDArray[np.float64],
    sine: NDArray[np.float64],
    half_one: NDArray[np.float64],
    half_two: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the gaps of the projections on the four axes, shape (4, n); a positive gap means no overlap."""
    along, across = np.abs(cosine), np.abs(sine)
    x, y = offset[:, 0], offset[:, 1]
    return np.stack(
        (
            np.abs(x) - half_one[:, 0] - half_two[:, 0] * along - half_two[:, 1] * across,
            np.abs(y) - half_one[:, 1] - half_two[:, 0] * across - half_two[:, 1] * along,
            np.abs(x * cosine + y * sine) - half_two[:, 0] - half_one[:, 0] * along - half_one[:, 1] * across,
            np.abs(-x * sine + y * cosine) - half_two[:, 1] - half_one[:, 0] * across - half_one[:, 1] * along,
        )
    )


_HALF_LANE_M = 1.6  # an actor with a smaller lateral offset is ahead or behind, not to the side


def place_words(ahead_m: float, left_m: float, length_m: float) -> str:
    """Return a place around a vehicle, such as ``left ahead``; empty if it is within the vehicle's length and lane."""
    side = "" if abs(left_m) <= _HALF_LANE_M else "left" if left_m > 0 else "right"
    along = "ahead" if ahead_m > length_m / 2 else "behind" if ahead_m < -length_m / 2 else ""
    return f"{side} {along}".strip()


# What actors cover: rectangles, seen from above, and at which height.

LEVEL_M = 3.0
"""Height difference beyond which two actors are on different levels; the height of the lower one, if that is more."""

Rectangle = tuple[float, float, float, float, float]
"""x and y of the front bumper's centre (m), heading (rad), length and width (m)."""

Level = tuple[float, float]
"""z of the front of a rectangle (m), and how far the road rises a metre there, ahead."""


def center(rectangle: Rectangle) -> tuple[float, float]:
    """Return the centre of a rectangle."""
    x, y, heading, length, _ = rectangle
    return x - length / 2 * cos(heading), y - length / 2 * sin(heading)


def outlines(scene: Scene, row: int, *, parts: int = 0) -> list[Rectangle]:
    """Return the outline of an actor: one rectangle, or several from front to back for a long vehicle in a bend.

    Args:
        scene: the scene that contains the actor.
        row: row of the actor in the scene.
        parts: number of pieces into which a straight actor is cut; 0 to leave it whole. A bent actor has its own number
            of pieces.
    """
    actor = scene.roster.actors[row]
    spine = scene.spines.get(row)
    if spine is not None:
        return [
            (x, y, math.atan2(y - back_y, x - back_x), math.hypot(x - back_x, y - back_y), actor.width)
            for (x, y, _), (back_x, back_y, _) in pairwise(spine)
        ]
    (x, y), heading, length = scene.points[row], scene.headings[row], actor.length
    if parts < 2:
        return [(x, y, heading, length, actor.width)]
    length /= parts
    c, s = math.cos(heading) * length, math.sin(heading) * length
    return [(x - c * part, y - s * part, heading, length, actor.width) for part in range(parts)]


def levels(scene: Scene, row: int, *, parts: int = 0) -> list[Level]:
    """Return the height of each rectangle of `outlines`; all heights are equal on a flat map."""
    spine = scene.spines.get(row)
    if not scene.heights:
        return [(0.0, 0.0)] * (len(spine) - 1 if spine is not None else max(1, parts))
    if spine is not None:
        found = []
        for (x, y, z), (back_x, back_y, back_z) in pairwise(spine):
            found.append((z, (z - back_z) / max(math.hypot(x - back_x, y - back_y), 1e-6)))
        return found
    z, grade = scene.heights[row], scene.grades[row]
    length = scene.roster.actors[row].length / max(1, parts)
    return [(z - grade * length * part, grade) for part in range(max(1, parts))]


def same_level(one: Rectangle, level: Level, two: Rectangle, other_level: Level, lower_m: float) -> bool:
    """Return whether two rectangles are on the same level; False if one rectangle is on a bridge above the other.

    If both rectangles are on the same road, the slopes of the road at the rectangles predict the difference of their
    heights. The rectangles are on different levels if the difference deviates from this prediction. A level is the
    height of a rectangle, in m, and the slope of the road there. ``lower_m`` is the height of the lower actor itself.
    """
    dx, dy = two[0] - one[0], two[1] - one[1]
    ahead = level[1] * (dx * math.cos(one[2]) + dy * math.sin(one[2]))
    behind = other_level[1] * (dx * math.cos(two[2]) + dy * math.sin(two[2]))
    return abs(other_level[0] - level[0] - (ahead + behind) / 2) < max(LEVEL_M, lower_m)


def on_one_level(scene: Scene, row: int, other: int) -> bool:
    """Return whether any part of an actor is on the same level as any part of another actor."""
    if not scene.heights:
        return True
    actors = scene.roster.actors
    lower = actors[row if scene.heights[row] < scene.heights[other] else other].height
    pairs = [list(zip(outlines(scene, who), levels(scene, who), strict=True)) for who in (row, other)]
    return any(same_level(*mine, *theirs, lower) for mine in pairs[0] for theirs in pairs[1])


def corners(scene: Scene, row: int) -> NDArray[np.float64]:
    """Return the outline of an actor: shape (4, 2), counter-clockwise from the front left, in m.

    For a long vehicle in a bend, the shape is (2 n, 2): along its left side to the back, and along its right side to
    the front.
    """
    left_side: list[NDArray[np.float64]] = []
    right_side: list[NDArray[np.float64]] = []
    for x, y, heading, length, width in outlines(scene, row):
        forward = np.array([math.cos(heading), math.sin(heading)])
        left = np.array([-forward[1], forward[0]]) * (width / 2)
        front = np.array([x, y])
        if not left_side:
            left_side, right_side = [front + left], [front - left]
        back = front - length * forward
        left_side.append(back + left)
        right_side.append(back - left)
    return np.array([*left_side, *reversed(right_side)])
