"""Rectangles in positions whose answer can be read off a sheet of paper, turned every way."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crashhunt.world import outlines_overlap, time_to_contact
from crashhunt.world._geometry import separation

TURNS = [0.0, 0.6, 2.2, -1.9]
CAR = (5.0, 2.0)


def placed(turned, x, y, heading=0.0, size=CAR):
    """A rectangle by its centre, on a map that is turned."""
    c, s = math.cos(turned), math.sin(turned)
    h = heading + turned
    return (
        11 + x * c - y * s + size[0] / 2 * math.cos(h),
        -7 + x * s + y * c + size[0] / 2 * math.sin(h),
        h,
        *size,
    )


# Where the centre of the other one is, its heading, and how far apart the two are: along x, along y.
CLEAR = [
    (8, 0, 0, 3, (1, 0)),
    (-8, 0.5, 0, 3, (-1, 0)),
    (1, 3, 0, 1, (0, 1)),
    (-2, -3.5, 0, 1.5, (0, -1)),
    (1, 4.5, math.pi / 2, 1, (0, 1)),
    (-5, 1, math.pi / 2, 1.5, (-1, 0)),
    (1, 3, math.pi, 1, (0, 1)),
]


@pytest.mark.parametrize("turned", TURNS)
@pytest.mark.parametrize(("x", "y", "heading", "apart", "axis"), CLEAR)
def test_how_far_apart_and_which_way(turned, x, y, heading, apart, axis):
    one, two = placed(turned, 0, 0), placed(turned, x, y, heading)
    c, s = math.cos(turned), math.sin(turned)
    way = axis[0] * c - axis[1] * s, axis[0] * s + axis[1] * c
    assert separation(one, two) == pytest.approx((apart, *way))
    assert separation(two, one) == pytest.approx((apart, -way[0], -way[1]))
    for margin in (0.0, apart - 1e-6):
        assert not outlines_overlap(one, two, margin=margin)
        assert not outlines_overlap(two, one, margin=margin)
    assert outlines_overlap(one, two, margin=apart + 1e-6)
    assert outlines_overlap(two, one, margin=apart + 1e-6)


@pytest.mark.parametrize("turned", TURNS)
def test_a_corner_before_a_side(turned):
    """One of them stands at 45 degrees: the axis that parts them is that of the other one."""
    reach = (5 + 2) / 2 / math.sqrt(2)  # of a turned car, along each axis of the map
    one = placed(turned, 0, 0)
    for x, y, ahead in ((2.5 + reach + 0.7, 0, 1), (0, -1 - reach - 0.7, 0), (-2.5 - reach - 0.7, -0.3, 1)):
        two = placed(turned, x, y, math.pi / 4)
        assert separation(one, two)[0] == separation(two, one)[0] == pytest.approx(0.7)
        along, across = separation(one, two)[1:]
        towards = along * math.cos(turned) + across * math.sin(turned)
        assert abs(towards) == pytest.approx(ahead, abs=1e-9)
    # Corner to corner, diagonally: an axis of the turned one parts them, and none of the other.
    thin = placed(turned, 4.1, 2.6, -math.pi / 4, (20.0, 0.2))
    apart = (4.1 + 2.6 - 3.5) / math.sqrt(2) - 0.1
    assert separation(one, thin) == pytest.approx(
        (apart, math.cos(turned + math.pi / 4), math.sin(turned + math.pi / 4))
    )
    assert separation(thin, one)[0] == pytest.approx(apart)
    assert not outlines_overlap(one, thin)
    assert not outlines_overlap(thin, one)
    assert outlines_overlap(one, thin, margin=apart + 1e-6)
    assert outlines_overlap(thin, one, margin=apart + 1e-6)
    assert not outlines_overlap(one, thin, margin=apart - 1e-6)
    end = placed(turned, 4.1, 2.6, math.pi / 4, (1.0, 9.0))
    apart = (4.1 + 2.6 - 3.5) / math.sqrt(2) - 0.5
    assert separation(one, end)[0] == separation(end, one)[0] == pytest.approx(apart)
    assert not outlines_overlap(one, end)
    assert not outlines_overlap(end, one)


@pytest.mark.parametrize("turned", TURNS)
@pytest.mark.parametrize(("x", "y", "heading", "apart", "axis"), CLEAR)
def test_what_touches_by_rounding_only_does_not_overlap(turned, x, y, heading, apart, axis):
    """Bumper to bumper, and side by side, is no collision; a thousandth of a millimetre is one."""
    one = placed(turned, 0, 0)

    def nearer(by):
        return placed(turned, x - axis[0] * (apart + by), y - axis[1] * (apart + by), heading)

    for two, touches in ((nearer(0.0), False), (nearer(5e-10), False), (nearer(1e-7), True), (nearer(0.5), True)):
        assert outlines_overlap(one, two) is touches
        assert outlines_overlap(two, one) is touches
    assert separation(one, nearer(0.5))[0] == pytest.approx(-0.5)


def test_the_time_of_contact_is_that_of_the_last_axis():
    def time(x, y, vx, vy, turn=0.0, one=(2.5, 1.0), two=(2.5, 1.0)):
        values = (x, y), (vx, vy), turn, one, two
        return time_to_contact(*(np.array([value], dtype=float) for value in values))[0]

    assert time(20, 0, -5, 0) == pytest.approx(3)
    assert time(-20, 0, 5, 0) == pytest.approx(3)
    assert time(20, 0, -5, 0, one=(3.5, 1)) == pytest.approx(2.8)
    assert time(0, 10, 0, -2) == pytest.approx(4)
    assert time(0, -10, 0, 2, math.pi / 2) == pytest.approx(6.5 / 2)
    assert time(15, 10, -5, -4) == pytest.approx(2)  # along x at 2 s, across at 2 s
    assert time(15, 12, -5, -4) == pytest.approx(2.5)
    assert time(20, 2.0, -5, 0) == math.inf  # brushes past
    assert time(20, 1.9, -5, 0) == pytest.approx(3)
    assert time(20, 0, 5, 0) == math.inf
    assert time(20, 0, 0, 0) == math.inf
    assert time(20, 10, -10, 1) == math.inf  # parts across before it is there
    assert time(3, 0, 5, 0) == 0  # overlaps already
    assert time(3, 0, 0, 0) == 0
    assert time(20, 1, -5, 0, math.pi / 4) == pytest.approx((17.5 - 3.5 / math.sqrt(2)) / 5)
    assert time(0, 8, 0, -1, math.pi / 4, (2.5, 1.0), (0.5, 0.5)) == pytest.approx(7 - math.sqrt(0.5))
    assert not math.copysign(1, time(3, 0, 5, 0)) < 0
