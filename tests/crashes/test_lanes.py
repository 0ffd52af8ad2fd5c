from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import examples
from hypothesis import given, settings, strategies as st

from crashhunt.crashes._lanes import LaneMap, _Lane
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


def drive_along(poses):
    return [Scene(k / 10, ROSTER, [(x, y)], [heading], [10.0]) for k, (x, y, heading) in enumerate(poses)]


TWO = [[(0, 0), (200, 0)], [(0, 3.2), (200, 3.2)]]


@given(st.floats(-3.1, 3.1), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.booleans(), st.booleans())
@settings(deadline=None, max_examples=examples(40))
def test_who_changes_to_the_lane_next_to_is_seen_wherever_the_road_lies(angle, x, y, at_once, changes):
    lanes = LaneMap([lane(*turned(points, angle, x, y)) for points in TWO], turned([(100, 0)], angle, x, y)[0])
    side = [0.0] * 5 + ([0.0, 3.2] if at_once else list(np.linspace(0, 3.2, 20))) + [3.2] * 5
    side = side if changes else [0.9 * math.sin(k) for k in range(30)]  # it only drifts
    points = turned([(80 + k, aside) for k, aside in enumerate(side)], angle, x, y)
    scenes = drive_along([(*point, angle) for point in points])
    assert lanes.leaves_sideways(scenes, "ego") is changes
    assert not lanes.leaves_sideways(scenes, "nobody")


@pytest.mark.parametrize("goes_over", [True, False])
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("angle", [0.0, 1.1, -2.4])
def test_who_touches_before_half_a_lane_is_crossed_reaches_over(goes_over, side, angle):
    sides = [[(x, y * side) for x, y in points] for points in TWO]
    (around,) = turned([(100.0, 0.0)], angle, 30, -80)
    lanes = LaneMap([lane(*turned(points, angle, 30, -80)) for points in sides], around)

    def drive(poses):
        """Drive the poses on the road that leads in another direction."""
        points = turned([(x, y) for x, y, _ in poses], angle, 30, -80)
        return drive_along([(*point, heading + angle) for point, (_, _, heading) in zip(points, poses, strict=True)])

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
    assert not lanes.leaves_sideways(drive_along(way), "ego")


def test_who_turns_off_or_leaves_at_the_end_of_a_lane_does_not_change_lanes():
    straight, turn, beyond = [(-40, 0), (60, 0)], [(-40, 0), (0, 0), *arc(8, 0.1, 1.5)], [(60, 3.2), (120, 3.2)]
    lanes = LaneMap([lane(*straight), lane(*turn), lane(*beyond)], (0, 0))
    way = [(float(x), 0.0, 0.0) for x in range(-10, 0)]
    way += [(x, y, a) for (x, y), a in zip(arc(8, 0, 1.4), np.linspace(0, 1.4, 60), strict=True)]
    assert not lanes.leaves_sideways(drive_along(way), "ego")
    ahead = [(float(x), 0.0, 0.0) for x in range(50, 60)] + [(62.0, 3.2, 0.0), (70.0, 3.2, 0.0)]
    assert not lanes.leaves_sideways(drive_along(ahead), "ego")
    # Where a lane leads straight on, it has changed lanes in the step over the border.
    lanes = LaneMap([lane(*straight), lane(*beyond), lane((60, 0), (120, 0))], (60, 0))
    assert lanes.leaves_sideways(drive_along(ahead), "ego")


def test_who_leaves_the_road_does_not_change_lanes():
    lanes = LaneMap([lane(*points) for points in TWO], (100, 0))
    away = drive_along([(100.0 + k, -0.4 * k, 0.0) for k in range(10)])
    assert not lanes.leaves_sideways(away, "ego")


@pytest.mark.parametrize(
    ("angle", "cross"), [(90, True), (45, True), (180, False), (160, False), (0, False), (20, False)]
)
def test_where_lanes_cross(angle, cross):
    a = math.radians(angle)
    other = [(-50 * math.cos(a), -50 * math.sin(a)), (50 * math.cos(a), 50 * math.sin(a))]
    lanes = LaneMap([lane((-50, 0), (50, 0)), lane(*other)], (0, 0))
    assert lanes.cross((0, 0)) is cross
    assert not lanes.cross((40, 1.0 if angle < 90 else 0.0))


def test_what_is_far_away_or_no_lane_is_excluded():
    assert not LaneMap([lane((1000, 0), (1100, 0)), (np.zeros((1, 2)), np.zeros((1, 2)))], (0, 0))
    assert not LaneMap([], (0, 0)).cross((0, 0))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("angle", [0.0, 0.9, -2.4])
def test_a_lane_change_began_where_it_first_moved_towards_the_other_lane(side, angle):
    (around,) = turned([(100.0, 0.0)], angle, 7, 9)
    lanes = LaneMap([lane(*turned([(x, y * side) for x, y in points], angle, 7, 9)) for points in TWO], around)

    def began(aside):
        points = turned([(80 + k, y * side) for k, y in enumerate(aside)], angle, 7, 9)
        return lanes.change_began(drive_along([(*point, angle) for point in points]), "ego")

    crossed = [0.0] * 6 + [0.17 * k for k in range(1, 19)] + [3.2] * 5
    assert began(crossed) == 5
    assert began([0.0] * 6 + [0.18 * k for k in range(1, 19)]) == 5  # one scene faster
    assert began(crossed[:14]) == 5  # it reaches over the side by then
    assert began([0.3, 0.2, 0.1, *crossed]) == 8  # the drift the other way is no part of it
    assert began([0.0] * 20) is None
    assert began([-0.05 * k for k in range(20)]) is None  # no lane lies on that side
    gone = LaneMap([], around)
    assert gone.change_began(drive_along([(0.0, 0.0, 0.0)] * 3), "ego") is None


def test_a_lane_change_is_found_by_the_place_of_its_last_scene():
    lanes = LaneMap([lane(*points) for points in TWO], (100, 0))
    there, back = [0.0] * 4 + [3.2] * 4, [0.0] * 4
    scenes = drive_along([(80 + k, y, 0.0) for k, y in enumerate(there + back)])
    assert lanes.left_sideways(scenes[:8], "ego") == 4
    assert lanes.left_sideways(scenes, "ego") == 8
    assert lanes.left_sideways(scenes[4:8], "ego") is None


@pytest.mark.parametrize(("away", "near"), [(59.0, True), (61.0, False)])
def test_lanes_within_sixty_metres_count(away, near):
    for x, y in ((-away, 0.0), (100.0 + away, 0.0), (50.0, -1.6 - away), (50.0, 1.6 + away)):
        assert bool(LaneMap([lane((0, 0), (100, 0))], (x, y))) is near


def test_of_lanes_over_each_other_the_one_whose_middle_is_nearest_is_driven():
    """It leaves the wide lane only, whose neighbour it enters; from the narrow one beside its way, it would not."""
    lanes = LaneMap([lane((0, 0), (200, 0)), lane((0, 1.0), (200, 1.0)), lane((0, 3.2), (200, 3.2))], (100, 0))
    scenes = drive_along([(80, 0.9, 0.0), (81, 2.0, 0.0)])
    assert not lanes.leaves_sideways(scenes, "ego")  # of the lane at 1.0, it has not left the side
    assert lanes.leaves_sideways(drive_along([(80, 0.4, 0.0), (81, 2.0, 0.0)]), "ego")


@given(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=2, max_size=6, unique=True),
    st.floats(0.5, 3.0),
    st.floats(0.0, 1.0),
    st.floats(-math.pi, math.pi),
)
def test_box_around_a_lane_leaves_out_no_point_in_it(points, half_width, share, direction):
    middle = np.array(points)
    aside = half_width * np.array([math.cos(direction), math.sin(direction)])
    lane = _Lane(middle - aside, middle + aside)
    for corner in middle:
        for turn in range(8):
            angle = direction + turn * math.pi / 4
            point = corner + share * lane.half_width * np.array([math.cos(angle), math.sin(angle)])
            assert abs(lane.place(point).aside_m) > lane.half_width or lane.may_hold(point)
