"""What actors cover: rectangles, seen from above, and at which height."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.world._scene import Scene

__all__ = ["LEVEL_M", "Level", "Rectangle", "corners", "levels", "on_one_level", "outlines", "same_level"]

LEVEL_M = 3.0
"""Two of whom one is so much higher than the other, or more where the lower one is taller, are on different levels."""

Rectangle = tuple[float, float, float, float, float]
"""x and y of the front bumper's centre (m), heading (rad), length and width (m)."""

Level = tuple[float, float]
"""z of the front of a rectangle (m), and how far the road rises a metre there, ahead."""


def outlines(scene: Scene, row: int, *, parts: int = 0) -> list[Rectangle]:
    """Return what an actor covers: one rectangle, or for a long vehicle in a bend several, from front to back.

    Args:
        scene: where.
        row: the actor.
        parts: into how many pieces one that is straight is cut; 0 leaves it whole. One that is bent has its own number.
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
    """Return the height of each rectangle of `outlines`; of a flat map all the same."""
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
    """Whether nothing but distance is between two rectangles; False where one is on a bridge above the other.

    Between two that are on one road, it rises about as much as the grades at both of them say.

    Args:
        one: a rectangle.
        level: its height.
        two: another.
        other_level: its height.
        lower_m: how tall the lower one is, in m.
    """
    dx, dy = two[0] - one[0], two[1] - one[1]
    ahead = level[1] * (dx * math.cos(one[2]) + dy * math.sin(one[2]))
    behind = other_level[1] * (dx * math.cos(two[2]) + dy * math.sin(two[2]))
    return abs(other_level[0] - level[0] - (ahead + behind) / 2) < max(LEVEL_M, lower_m)


def on_one_level(scene: Scene, row: int, other: int) -> bool:
    """Whether any part of two actors is on the level of a part of the other."""
    if not scene.heights:
        return True
    actors = scene.roster.actors
    lower = actors[row if scene.heights[row] < scene.heights[other] else other].height
    pairs = [list(zip(outlines(scene, who), levels(scene, who), strict=True)) for who in (row, other)]
    return any(same_level(*mine, *theirs, lower) for mine in pairs[0] for theirs in pairs[1])


def corners(scene: Scene, row: int) -> NDArray[np.float64]:
    """Return the outline of an actor: shape (4, 2), counter-clockwise from the front left, in m.

    Of a long vehicle in a bend it is shape (2 n, 2): down its left side, and up its right.
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
