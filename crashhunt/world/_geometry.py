"""Outlines: oriented rectangles, whether they overlap, how far apart they are, and when they will touch."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.world._outlines import Rectangle

__all__ = ["outlines_overlap", "rectangle_gap", "separation", "time_to_contact"]

_TOUCH = 1e-9  # m; less is rounding, not overlap


def outlines_overlap(one: Rectangle, two: Rectangle, *, margin: float = 0.0) -> bool:
    """Whether two outlines overlap, by the separating axis theorem.

    Args:
        one: an outline.
        two: another.
        margin: answer True for all that are nearer than this as well, and some that are a little further apart, in m.
    """
    x1, y1, h1, l1, w1 = one
    x2, y2, h2, l2, w2 = two
    c1, s1, c2, s2 = cos(h1), sin(h1), cos(h2), sin(h2)
    dx, dy = (x2 - l2 / 2 * c2) - (x1 - l1 / 2 * c1), (y2 - l2 / 2 * s2) - (y1 - l1 / 2 * s1)
    along, across = abs(c1 * c2 + s1 * s2), abs(c1 * s2 - s1 * c2)
    if abs(-dx * s1 + dy * c1) >= (w1 + l2 * across + w2 * along) / 2 - _TOUCH + margin:
        return False
    if abs(dx * c1 + dy * s1) >= (l1 + l2 * along + w2 * across) / 2 - _TOUCH + margin:
        return False
    if abs(-dx * s2 + dy * c2) >= (w2 + l1 * across + w1 * along) / 2 - _TOUCH + margin:
        return False
    return abs(dx * c2 + dy * s2) < (l2 + l1 * along + w1 * across) / 2 - _TOUCH + margin


def separation(one: Rectangle, two: Rectangle) -> tuple[float, float, float]:
    """Return how far apart two rectangles are along the axis on which they are furthest apart, and that axis.

    Returns:
        The distance in m, negative where they overlap, never more than the real gap; and x and y of the unit vector
        from the first to the second.
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
    """Return the distance between pairs of rectangles; 0 where they overlap.

    Args:
        offset: shape (n, 2), from the centre of the first to that of the second, in the frame of the first, in m.
        turn: shape (n,), heading of the second in the frame of the first, in rad.
        half_one: shape (n, 2), half length and half width of the first, in m.
        half_two: likewise of the second.

    Returns:
        Shape (n,), in m.
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


def time_to_contact(
    offset: NDArray[np.float64],
    velocity: NDArray[np.float64],
    turn: NDArray[np.float64],
    half_one: NDArray[np.float64],
    half_two: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return when pairs of rectangles first touch, both going on at constant velocity; infinite where never.

    On every separating axis the projections overlap during one interval of time; the outlines touch when all four do.
    Source: the swept separating axis test, D. Eberly: Intersection of convex objects, the method of separating axes.

    Args:
        offset: as in `rectangle_gap`.
        velocity: shape (n, 2), of the second relative to the first, in the frame of the first, in m/s.
        turn: as in `rectangle_gap`.
        half_one: as in `rectangle_gap`.
        half_two: as in `rectangle_gap`.

    Returns:
        Shape (n,), in s; 0 where they overlap already.
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
    """The distance of points from rectangles around the origin."""
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
    """How far apart the projections are on each of the four axes, shape (4, n); positive somewhere: no overlap."""
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
