from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from crashhunt.triage._lanes import LaneMap
from crashhunt.world import Actor, Roster, Scene

ROSTER = Roster((Actor("ego", "passenger", 5.0, 2.0),))


def lane(*middle, width=3.2):
    """The borders of a lane around a centre line."""
    line = np.array(middle, float)
    along = np.gradient(line, axis=0)
    along /= np.hypot(*along.T)[:, None]
    left = np.stack((-along[:, 1], along[:, 0]), axis=1) * width / 2
    return line - left, line + left


def arc(radius, start, end):
    """Points of a bend to the left around (0, radius)."""
    return [(radius * math.sin(a), radius - radius * math.cos(a)) for a in np.linspace(start, end, 60)]


def turned(points, angle, x, y):
    c, s = math.cos(angle), math.sin(angle)
    return [(x + c * px - s * py, y + s * px + c * py) for px, py in points]


def drive(poses):
    return [Scene(k / 10, ROSTER, [(x, y)], [heading], [10.0]) for k, (x, y, heading) in enumerate(poses)]


TWO = [[(0, 0), (200, 0)], [(0, 3.2), (200, 3.2)]]


@given(st.floats(-3.1, 3.1), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.booleans(), st.booleans())
@settings(deadline=None, max_examples=40)
def test_who_changes_to_the_lane_beside_is_seen_wherever_the_road_lies(angle, x, y, at_once, changes):
    lanes = LaneMap([lane(*turned(points, angle, x, y)) for points in TWO], turned([(100, 0)], angle, x, y)[0])
    side = [0.0] * 5 + ([0.0, 3.2] if at_once else list(np.linspace(0, 3.2, 20))) + [3.2] * 5
    side = side if changes else [0.9 * math.sin(k) for k in range(30)]  # it only drifts
    points = turned([(80 + k, aside) for k, aside in enumerate(side)], angle, x, y)
    scenes = drive([(*point, angle) for point in points])
    assert lanes.leaves_sideways(scenes, "ego") is changes
    assert not lanes.leaves_sideways(scenes, "nobody")


@pytest.mark.parametrize("goes_over", [True, False])
@pytest.mark.parametrize("side", [1, -1])
def test_who_touches_before_half_a_lane_is_crossed_reaches_over(goes_over, side):
    lanes = LaneMap([lane(*[(x, y * side) for x, y in points]) for points in TWO], (100.0, 0.0))
    aside = np.linspace(0, 1.2 if goes_over else 0.5, 20) * side
    scenes = drive([(80 + k, y, 0.06 * side) for k, y in enumerate(aside)])
    assert lanes.reaches_over(scenes, "ego") is goes_over
    assert not lanes.leaves_sideways(scenes, "ego")
    assert not lanes.reaches_over(scenes, "nobody")
    beyond = drive([(80 + k, -y, 0.06 * side) for k, y in enumerate(aside)])  # there is no lane on that side
    assert not lanes.reaches_over(beyond, "ego")
    still = drive([(80 + k, 1.2 * side, 0.0) for k in range(20)])  # it drives so all the time
    assert not lanes.reaches_over(still, "ego")


def test_a_bend_is_no_change_of_lanes():
    lanes = LaneMap([lane(*arc(20, 0, 2)), lane(*arc(23.2, 0, 2))], (15, 10))
    way = [(x, y, a) for (x, y), a in zip(arc(20, 0.1, 1.9), np.linspace(0.1, 1.9, 60), strict=True)]
    assert not lanes.leaves_sideways(drive(way), "ego")


def test_who_turns_off_or_leaves_at_the_end_of_a_lane_does_not_change_lanes():
    straight, turn, beyond = [(-40, 0), (60, 0)], [(-40, 0), (0, 0), *arc(8, 0.1, 1.5)], [(60, 3.2), (120, 3.2)]
    lanes = LaneMap([lane(*straight), lane(*turn), lane(*beyond)], (0, 0))
    way = [(float(x), 0.0, 0.0) for x in range(-10, 0)]
    way += [(x, y, a) for (x, y), a in zip(arc(8, 0, 1.4), np.linspace(0, 1.4, 60), strict=True)]
    assert not lanes.leaves_sideways(drive(way), "ego")
    ahead = [(float(x), 0.0, 0.0) for x in range(50, 60)] + [(62.0, 3.2, 0.0), (70.0, 3.2, 0.0)]
    assert not lanes.leaves_sideways(drive(ahead), "ego")


def test_who_leaves_the_road_does_not_change_lanes():
    lanes = LaneMap([lane(*points) for points in TWO], (100, 0))
    away = drive([(100.0 + k, -0.4 * k, 0.0) for k in range(10)])
    assert not lanes.leaves_sideways(away, "ego")


@pytest.mark.parametrize(("angle", "cross"), [(90, True), (45, True), (180, True), (0, False), (20, False)])
def test_where_lanes_cross(angle, cross):
    a = math.radians(angle)
    other = [(-50 * math.cos(a), -50 * math.sin(a)), (50 * math.cos(a), 50 * math.sin(a))]
    lanes = LaneMap([lane((-50, 0), (50, 0)), lane(*other)], (0, 0))
    assert lanes.cross((0, 0)) is cross
    assert not lanes.cross((40, 1.0 if angle < 90 else 0.0)) or angle == 180


def test_what_is_far_away_or_no_lane_is_left_out():
    assert not LaneMap([lane((1000, 0), (1100, 0)), (np.zeros((1, 2)), np.zeros((1, 2)))], (0, 0))
    assert not LaneMap([], (0, 0)).cross((0, 0))
