"""Geometry against brute force, and the oracles on scenes whose answers are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scenes import scene

from crashhunt.oracles import Overlap, ReportedCollision, TooClose, merge_findings
from crashhunt.trial import Collision, Outcome
from crashhunt.world import (
    Actor,
    Contact,
    Roster,
    Scene,
    approaches,
    closest_approach,
    corners,
    outlines_overlap,
    rectangle_gap,
)

rectangles = st.tuples(
    st.floats(-15, 15), st.floats(-15, 15), st.floats(-math.pi, math.pi), st.floats(0.5, 14), st.floats(0.4, 3)
)


def outline(rectangle, points=0):
    """Points of the border of a rectangle: its corners, or many."""
    x, y, heading, length, width = rectangle
    forward = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-forward[1], forward[0]])
    front = np.array([x, y])
    ring = [front + left * width / 2, front - forward * length + left * width / 2]
    ring += [front - forward * length - left * width / 2, front - left * width / 2]
    if not points:
        return np.array(ring)
    steps = np.linspace(0, 1, points)[:, None]
    return np.concatenate([a + steps * (b - a) for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)])


def inside(points, rectangle, margin=0.0):
    x, y, heading, length, width = rectangle
    c, s = math.cos(heading), math.sin(heading)
    along = (points[:, 0] - x) * c + (points[:, 1] - y) * s
    across = (points[:, 1] - y) * c - (points[:, 0] - x) * s
    return (along < -margin) & (along > -length + margin) & (np.abs(across) < width / 2 - margin)


def relative(one, two):
    """Two rectangles as the vectorised functions want them."""

    def center(rectangle):
        x, y, heading, length, _ = rectangle
        return np.array([x - length / 2 * math.cos(heading), y - length / 2 * math.sin(heading)])

    c, s = math.cos(one[2]), math.sin(one[2])
    dx, dy = center(two) - center(one)
    offset = np.array([[dx * c + dy * s, dy * c - dx * s]])
    turn = np.array([two[2] - one[2]])
    return offset, turn, np.array([[one[3] / 2, one[4] / 2]]), np.array([[two[3] / 2, two[4] / 2]])


def border_distance(one, two):
    a, b = outline(one, 120), outline(two, 120)
    return float(np.sqrt(((a[:, None] - b[None]) ** 2).sum(axis=2)).min())


@given(rectangles, rectangles)
@settings(deadline=None)
def test_overlap_and_gap_agree_with_points_of_the_outlines(one, two):
    overlap = outlines_overlap(one, two)
    assert overlap == outlines_overlap(two, one)
    offset, turn, half_one, half_two = relative(one, two)
    gap = float(rectangle_gap(offset, turn, half_one, half_two)[0])
    distance = border_distance(one, two)
    deep = inside(outline(two, 120), one, 0.05).any() or inside(outline(one, 120), two, 0.05).any()
    if deep:
        assert overlap
        assert gap == 0
    if gap > 0:
        assert not overlap or gap < 1e-6
        assert gap <= distance + 1e-9
        assert distance - gap < 0.2  # between neighbouring points of both outlines


@given(rectangles, rectangles)
def test_a_near_miss_is_as_near_as_points_of_the_outlines_say(one, two):
    roster = Roster((Actor("ego", "car", *one[3:]), Actor("other", "car", *two[3:])))
    scene = Scene(0.0, roster, [one[:2], two[:2]], [one[2], two[2]], [0.5, 0.0])
    found = TooClose(gap_m=6.0, speed=0.0).check(scene, ["ego"])
    distance = border_distance(one, two)
    if outlines_overlap(one, two) or distance > 6.2:
        assert found == []
    elif 0.1 < distance < 6.0:
        said = float(found[0].event.what.split()[3])
        assert -0.01 < distance - said < 0.2


def test_the_closest_approach_of_known_scenes():
    far = scene(("ego", 0, 0, 0, 20), ("a", 45, 0, 0, 10))  # 40 m apart, closing at 10 m/s
    near = scene(("ego", 20, 0, 0, 20), ("a", 55, 0, 0, 10))  # 30 m
    beside = scene(("ego", 40, 0, 0, 20), ("a", 40, 3.5, 0, 10))  # 1.5 m to the side, and it stays so
    times, gaps, brakes = approaches([view.frame for view in (far, near, beside)], "ego")
    assert times == pytest.approx([4.0, 3.0, math.inf])
    assert gaps == pytest.approx([40.0, 30.0, 1.5])
    assert brakes == pytest.approx([10 / 8, 10 / 6, 0.0])
    found = closest_approach([far, near, beside], ["ego"])
    assert (found.time_to_collision_s, found.gap_m) == pytest.approx((3.0, 1.5))
    assert found.required_deceleration == pytest.approx(10 / 6)
    alone = closest_approach([scene(("ego", 0, 0, 0, 20))], ["ego"])
    assert (alone.time_to_collision_s, alone.gap_m, alone.required_deceleration) == (math.inf, math.inf, 0.0)
    assert closest_approach([scene(("a", 0, 0, 0, 20))], ["ego"]) == alone


def test_neighbors_are_sorted_and_complete():
    view = scene(("a", 0, 0, 0, 1), ("b", 3, 4, 0, 1), ("c", 1, 0, 0, 1), ("d", -2, 0, 0, 1))
    assert view.neighbors(0) == [(1.0, 2), (4.0, 3), (25.0, 1)]
    assert corners(view, 1) == pytest.approx(np.array([[3, 5], [-2, 5], [-2, 3], [3, 3]]))


def test_two_witnesses_of_one_crash_are_one_finding():
    contact = Contact("ego", "a", "junction", "x_0", 20.0, 10.0)
    view = scene(("ego", 0, 0, 0, 20), ("a", 4, 0, 0, 10), ("b", 4, 1, 0, 10), contacts=(contact,))
    findings = [*ReportedCollision().check(view, ["ego"]), *Overlap().check(view, ["ego"])]
    assert len(findings) == 3
    merged = merge_findings(findings)
    assert merged.outcome is Outcome.COLLISION
    assert merged.collision.seen_by == ("overlap", "reported")
    assert (merged.collision.victim, merged.collision.kind, merged.collision.lane) == ("a", "junction", "x_0")
    assert merge_findings([]) is None
    assert ReportedCollision().check(view, ["b"]) == []


def test_a_collision_written_before_its_time_was_known_is_read():
    old = {"agent": "ego", "role": "alone", "collider": "ego", "seen_by": ["x"], "collider_speed": None}
    assert math.isnan(Collision.from_json(old).time_s)
