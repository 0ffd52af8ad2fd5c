"""What actors cover, at which height, and who is above whom."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import scene

from crashhunt.world import corners, levels, on_one_level, outlines
from crashhunt.world._geometry import same_level

BUS = {"bus": (12.0, 2.5)}
SPINE = ((30.0, 5.0, 2.0), (26.0, 5.0, 1.6), (26.0, -3.0, 0.8))  # a right angle, on a ramp of a tenth


def bent(**more):
    return scene(("ego", 0, 0, 0.5, 10), ("bus", 30, 5, 0, 5), sizes=BUS, spines={1: SPINE}, **more)


def test_a_straight_one_is_one_rectangle_or_as_many_as_are_asked_for():
    view = scene(("ego", 1, 2, math.pi / 2, 10), ("bus", 30, 5, math.pi, 5), sizes=BUS)
    assert outlines(view, 0) == outlines(view, 0, parts=1) == [(1, 2, math.pi / 2, 5, 2)]
    pieces = outlines(view, 1, parts=3)
    assert np.array(pieces) == pytest.approx(
        np.array([(30, 5, math.pi, 4, 2.5), (34, 5, math.pi, 4, 2.5), (38, 5, math.pi, 4, 2.5)])
    )
    assert np.array(outlines(view, 0, parts=2)) == pytest.approx(
        np.array([(1, 2, math.pi / 2, 2.5, 2), (1, -0.5, math.pi / 2, 2.5, 2)])
    )


def test_a_bent_one_is_a_rectangle_for_each_part():
    assert np.array(outlines(bent(), 1)) == pytest.approx(np.array([(30, 5, 0, 4, 2.5), (26, 5, math.pi / 2, 8, 2.5)]))
    assert outlines(bent(), 1, parts=7) == outlines(bent(), 1)
    assert outlines(bent(), 0) == [(0, 0, 0.5, 5, 2)]


def test_heights_of_the_parts():
    flat = bent()
    assert levels(flat, 0) == [(0, 0)]
    assert levels(flat, 0, parts=4) == [(0, 0)] * 4
    assert levels(flat, 1) == levels(flat, 1, parts=5) == [(0, 0)] * 2
    ramp = bent(heights=(7.0, 2.0), grades=(0.2, 0.1))
    assert levels(ramp, 0) == [(7, 0.2)]
    assert np.array(levels(ramp, 0, parts=2)) == pytest.approx(np.array([(7, 0.2), (6.5, 0.2)]))
    assert np.array(levels(ramp, 1)) == pytest.approx(np.array([(2, 0.1), (1.6, 0.1)]))
    upright = scene(("bus", 0, 0, 0, 0), sizes=BUS, spines={0: ((0, 0, 3.0), (0, 0, 3.0))}, heights=(3.0,))
    assert levels(upright, 0) == [(3, 0)]  # a part without a length has no grade either


@pytest.mark.parametrize("turned", [0.0, 1.0, math.pi])
def test_the_corners_go_round_to_the_left(turned):
    c, s = math.cos(turned), math.sin(turned)

    def on_map(*points):
        return np.array([(10 + x * c - y * s, 20 + x * s + y * c) for x, y in points])

    view = scene(("ego", 10, 20, turned, 1))
    assert corners(view, 0) == pytest.approx(on_map((0, 1), (-5, 1), (-5, -1), (0, -1)))
    points = [(0.0, 0.0), (-6.0, 0.0), (-12.0, 0.0)]
    spine = tuple((float(x), float(y), 0.0) for x, y in on_map(*points))
    view = scene(("bus", 10, 20, turned, 1), sizes=BUS, spines={0: spine})
    expected = on_map((0, 1.25), (-6, 1.25), (-12, 1.25), (-12, -1.25), (-6, -1.25), (0, -1.25))
    assert corners(view, 0) == pytest.approx(expected)


def test_a_ramp_between_two_is_allowed_for():
    one, ahead = (7, -20, 0, 5, 2), (40, 0, 0, 5, 2)

    def same(z, grade=0.0, other_grade=0.0, *, two=ahead, tall=0.0):
        moved = (two[0] + one[0], two[1] + one[1], *two[2:])
        return same_level(one, (1.0, grade), moved, (1.0 + z, other_grade), tall)

    assert same(2.99)
    assert same(-2.99)
    assert not same(3.0)
    assert not same(-3.0)
    assert same(4.0, tall=4.1)
    assert not same(4.0, tall=4.0)
    assert same(6.9, 0.1, 0.1)  # 4 m of it are the road's
    assert not same(7.1, 0.1, 0.1)
    assert not same(0.9, 0.1, 0.1)
    assert same(4.9, 0.1, 0.0)
    assert same(4.9, 0.0, 0.1)
    assert not same(5.1, 0.1, 0.0)
    assert not same(5.1, 0.0, 0.1)
    # The other one comes down the ramp: ahead of it, the road falls.
    assert same(6.9, 0.1, -0.1, two=(40, 0, math.pi, 5, 2))
    assert not same(6.9, 0.1, 0.1, two=(40, 0, math.pi, 5, 2))
    slanted = (24, 32, math.atan2(4, 3), 5, 2)
    assert same(2.9 + (2.4 + 4) / 2, 0.1, 0.1, two=slanted)
    assert not same(3.1 + (2.4 + 4) / 2, 0.1, 0.1, two=slanted)
    aside = (0, 40, math.pi / 2, 5, 2)
    assert same(4.9, 0.5, 0.1, two=aside)  # the grade of the first is along x, where the other one is not
    assert not same(5.1, 0.5, 0.1, two=aside)
    assert same_level((0, 0, math.pi / 2, 5, 2), (0, 0.1), (0, 40, math.pi / 2, 5, 2), (6.9, 0.1), 0.0)
    assert not same_level((0, 0, math.pi / 2, 5, 2), (0, 0.1), (0, 40, math.pi / 2, 5, 2), (-1.0, 0.1), 0.0)


def test_who_is_on_one_level():
    pair = ("ego", 0, 0, 0, 10), ("bus", 2, 0, 0, 5)
    assert on_one_level(scene(*pair, sizes=BUS), 0, 1)
    assert on_one_level(scene(*pair, sizes=BUS, heights=(0.0, 2.0)), 0, 1)
    assert not on_one_level(scene(*pair, sizes=BUS, heights=(0.0, 4.0)), 0, 1)
    for heights, tall, answer in (
        ((0.0, 4.0), {"ego": 4.5}, True),
        ((0.0, 4.0), {"bus": 4.5}, False),
        ((4.0, 0.0), {"ego": 4.5}, False),
        ((4.0, 0.0), {"bus": 4.5}, True),
    ):
        view = scene(*pair, sizes=BUS, heights=heights, tall=tall)
        assert on_one_level(view, 0, 1) is answer
        assert on_one_level(view, 1, 0) is answer
    # One part of a train is enough.
    spine = ((2.0, 0.0, 9.0), (-4.0, 0.0, 9.0), (-10.0, 0.0, 1.0))
    assert not on_one_level(scene(*pair, sizes=BUS, heights=(0.0, 9.0), spines={1: spine[:2]}), 0, 1)
    low = ((2.0, 0.0, 9.0), (-4.0, 0.0, 2.0), (-10.0, 0.0, 2.0))
    assert on_one_level(scene(*pair, sizes=BUS, heights=(0.0, 9.0), spines={1: low}), 0, 1)
