"""Manner and fault from the paths that were driven: bends, turns, overtaking on the opposite lane; truth is planted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import mostly_nightly
from test_contact_record import record
from test_fault import Map, rotated

from crashhunt.crashes._fault import fault_in
from crashhunt.world import Event

LENGTH_M = 5.0


def arc(center, radius, start, end):
    """Points on a circle, from one angle in degrees to another."""
    angles = np.radians(np.linspace(start, end, max(3, int(abs(end - start) / 4))))
    return [(center[0] + radius * math.cos(a), center[1] + radius * math.sin(a)) for a in angles]


def ring(radius):
    return arc((0, 0), radius, 0, 4 * 360)


def hairpin(radius):
    return [(-80, -radius), *arc((0, 0), radius, -90, 90), (-80, radius)]


def s_bend(radius):
    left, right = arc((0, radius), radius, -90, 90), arc((0, 3 * radius), radius, 270, 90)
    return [(-80, 0), *left, *right, (60, 4 * radius)]


def turn(radius, way=1):
    """A left turn in a junction, or a right one."""
    return [(-80, 0), *((x, way * y) for x, y in arc((0, radius), radius, -90, 0)), (radius, way * 80)]


def loop_ramp(radius):
    """An on-ramp that turns by 270° to the right."""
    return [(-80, 0), *((x, -y) for x, y in arc((0, radius), radius, -90, 180)), (-radius, 3 * radius)]


PATHS = {
    **{f"ring of {radius} m": ring(radius) for radius in (3.5, 5, 8, 15)},
    **{f"hairpin of {radius} m": hairpin(radius) for radius in (1.6, 3, 6)},
    **{f"S-bend of {radius} m": s_bend(radius) for radius in (4, 7)},
    **{f"left turn of {radius} m": turn(radius) for radius in (4, 8)},
    **{f"right turn of {radius} m": turn(radius, -1) for radius in (3, 5)},
    "loop ramp of 9 m": loop_ramp(9),
}
NARROWEST = ("ring of 3.5 m", "hairpin of 1.6 m", "S-bend of 4 m", "left turn of 4 m", "right turn of 3 m")


class Way:
    """Poses along a path as SUMO sets them: the front is on the path, and the rear is behind it on the path."""

    def __init__(self, points, aside=0.0):
        self.points = np.array(points, float)
        legs = np.diff(self.points, axis=0)
        self.at = np.append(0.0, np.cumsum(np.hypot(*legs.T)))
        self.aside = aside

    def point(self, driven):
        return np.array([np.interp(driven, self.at, column) for column in self.points.T])

    def pose(self, driven, aside=0.0):
        front, back = self.point(driven), self.point(driven - LENGTH_M)
        heading = math.atan2(front[1] - back[1], front[0] - back[0])
        dx, dy = self.point(driven + 0.1) - self.point(driven - 0.1)
        norm = math.hypot(dx, dy)
        return front[0] - aside * dy / norm, front[1] + aside * dx / norm, heading

    def drive(self, speed, driven, aside=lambda t: 0.0):
        return lambda t: (*self.pose(driven + speed * t, aside(t)), speed)


def borders(points, width=3.2, aside=0.0):
    points = np.array(points, float)
    directions = np.gradient(points, axis=0)
    normals = np.stack((-directions[:, 1], directions[:, 0]), axis=1) / np.hypot(*directions.T)[:, None]
    return points + (aside - width / 2) * normals, points + (aside + width / 2) * normals


def bends(path):
    """Return places within the bends of a path, in m from its beginning."""
    way = Way(path)
    legs = np.diff(way.points, axis=0)
    turns = np.abs(np.diff(np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))))
    inside = way.at[1:-1][turns > 1e-3]
    middle = [place for place in inside if 46 < place < way.at[-1] - LENGTH_M]
    return middle[:: max(1, len(middle) // 3)]


def in_every_view(case):
    """Manner, follower and verdict, which are the same wherever the road leads."""
    said = [(one.manner, one.follower, fault_in(one).verdict) for one in (case, *(rotated(case, a) for a in (0.9,)))]
    assert len(set(said)) == 1
    return said[0]


@pytest.mark.parametrize("name", mostly_nightly(PATHS, NARROWEST))
@pytest.mark.parametrize("step_s", [pytest.param(0.1, marks=pytest.mark.nightly), 0.5])
def test_contact_in_one_lane_of_a_bend_is_a_rear_end(name, step_s):
    path = PATHS[name]
    way = Way(path)
    lanes = Map([borders(path)], (0.0, 0.0))
    for place in bends(path):
        behind, ahead = way.drive(5.0, place - LENGTH_M), way.drive(2.0, place)
        case = record(behind, ahead, step_s=step_s, seconds=5.0, lanes=lanes)
        assert in_every_view(case) == ("rear end", "ego", "ego"), place
        case = record(ahead, behind, step_s=step_s, seconds=5.0, lanes=lanes)
        assert in_every_view(case) == ("rear end", "other", "the other"), place


@pytest.mark.parametrize("name", mostly_nightly(PATHS, NARROWEST))
def test_vehicle_that_stands_in_a_bend_is_hit_from_behind(name):
    path = PATHS[name]
    way = Way(path)
    lanes = Map([borders(path)], (0.0, 0.0))
    for place in bends(path):
        came = way.drive(5.0, place)
        behind = way.drive(5.0, place - LENGTH_M)

        def stops(t, came=came):
            return *came(min(0.0, t + 5.0))[:3], 5.0 if t < -5 else 0.0

        case = record(behind, stops, step_s=0.1, lanes=lanes)
        assert in_every_view(case) == ("rear end", "ego", "ego")
        case = record(behind, way.drive(0.0, place), step_s=0.1, seconds=6.0, lanes=lanes)  # since the beginning
        assert in_every_view(case) == ("rear end", "ego", "ego")


def road(*, left_hand=False, between=None, width=3.2):
    """A road along the x axis with a lane for each direction; with ``between``, so far from the middle each."""
    side = 1.0 if left_hand else -1.0
    aside = width / 2 if between is None else between
    east = borders([(-400, side * aside), (400, side * aside)], width)
    west = borders([(400, -side * aside), (-400, -side * aside)], width)
    return Map([east, west], (0.0, 0.0))


def lane(y, speed, *, x=0.0, west=False, before=None, until_s=0.0):
    """Drives along the x axis, on another lane until a time."""
    way = -1.0 if west else 1.0
    return lambda t: (x + way * speed * t, before if before is not None and t < until_s - 1e-9 else y,
                      math.pi if west else 0.0, speed)  # fmt: skip


def oncoming(y=1.6, speed=12.0):
    return lane(y, speed, x=5.0 - LENGTH_M, west=True)


def rules(case):
    return [finding.rule for finding in fault_in(case).findings]


@pytest.mark.parametrize("left_hand", [False, True])
@pytest.mark.parametrize(("since_s", "step_s"), [(-0.0, 0.1), (-0.3, 0.5), (-2.0, 0.1), (-30.0, 0.5)])
def test_vehicle_that_overtakes_on_the_opposite_lane_is_at_fault_in_the_head_on_crash(left_hand, since_s, step_s):
    """Or that drives the wrong way without overtaking: both use the lane of the other direction."""
    y = -1.6 if left_hand else 1.6
    overtakes = lane(y, 15.0, x=-0.5, before=-y, until_s=since_s)
    lanes = road(left_hand=left_hand)
    case = record(overtakes, oncoming(y), lanes=lanes, step_s=step_s)
    assert in_every_view(case) == ("head-on", "", "ego")
    assert rules(case) == ["wrong way"]
    (found,) = fault_in(case).findings
    assert found.words.startswith("ego drove against the direction of its lane")
    assert found.source.startswith("Vienna, articles 10 and 11")
    case = record(oncoming(y), overtakes, lanes=lanes, step_s=step_s)
    assert in_every_view(case) == ("head-on", "", "the other")


@pytest.mark.parametrize("left_hand", [False, True])
def test_vehicle_that_is_partly_in_the_oncoming_lane_is_at_fault(left_hand):
    side = -1.0 if left_hand else 1.0
    lanes = road(left_hand=left_hand)

    def crash(aside, its_aside, **more):
        """Lanes are 3.2 m wide and vehicles 2 m: beyond 0.6 m towards the middle, a vehicle is over the line."""
        own, its = side * (-1.6 + aside), side * (1.6 - its_aside)
        return record(lane(own, 15.0), lane(its, 12.0, x=5.0 - LENGTH_M, west=True), lanes=lanes, step_s=0.1, **more)

    straddles = crash(1.3, 0.1)
    assert in_every_view(straddles) == ("head-on", "", "ego")
    (found,) = fault_in(straddles).findings
    assert found.words == (
        "ego was partly in the oncoming lane for the last 3.0 s, and other was wholly in its own lane"
    )
    assert in_every_view(crash(0.1, 1.3))[2] == "the other"
    for aside, its_aside in ((1.0, 0.8), (0.8, 0.8), (0.69, 0.6), (1.7, 0.8)):  # both over the line, or by too little
        assert in_every_view(crash(aside, its_aside))[2] == "nobody can tell", (aside, its_aside)

    # The other had been over the line until 1 s before, so that ego may have made room for it.
    returns = lane(side * 1.6, 12.0, x=5.0 - LENGTH_M, west=True, before=side * 0.4, until_s=-1.0)
    case = record(lane(-0.3 * side, 15.0), returns, lanes=lanes, step_s=0.1)
    assert in_every_view(case)[2] == "nobody can tell"


def test_vehicle_over_the_line_where_lanes_cross_has_no_verdict():
    crossed = Map([*road().borders, borders([(1.0, -90), (1.0, 90)])], (0.0, 0.0))
    case = record(lane(-0.3, 15.0), oncoming(), lanes=crossed, step_s=0.1)
    assert in_every_view(case)[2] == "nobody can tell"


def test_head_on_crash_without_one_vehicle_on_the_wrong_side_has_no_verdict():
    crash = (lane(1.6, 15.0), oncoming())
    narrow = road(between=0.3)  # both lanes hold both vehicles
    assert in_every_view(record(lane(0.0, 15.0), oncoming(0.0), lanes=narrow, step_s=0.1)) == (
        "head-on",
        "",
        "nobody can tell",
    )
    one_way = Map([borders([(-400, 1.6), (400, 1.6)])], (0.0, 0.0))
    assert in_every_view(record(*crash, lanes=one_way, step_s=0.1))[2] == "the other"  # that is the wrong way there
    swapped = record(lane(0.1, 15.0), oncoming(-0.1), lanes=road(), step_s=0.1)
    assert in_every_view(swapped) == ("head-on", "", "nobody can tell")
    unknown = record(*crash, lanes=Map([], (0.0, 0.0)), step_s=0.1)
    assert in_every_view(unknown) == ("head-on", "", "nobody can tell")
    parked = record(lambda t: (5.0, 1.6, math.pi, 0.0), lane(1.6, 15.0), lanes=one_way, step_s=0.1)
    assert "wrong way" not in rules(parked)

    def comes_from_the_side(t):
        return -12.0 * t, 1.6 + 5.0 * max(0.0, -1.5 - t), math.pi, 12.0

    case = record(lane(1.6, 15.0), comes_from_the_side, lanes=road(), step_s=0.1)
    assert fault_in(case).verdict == "nobody can tell"


def test_wrong_way_that_has_ended_blames_no_vehicle():
    event = ((-6.0, Event("wrong_way", "ego", "ego drove the wrong way on lane ba_0")),)

    def crosses(t):
        return 0.0, -1.6 + 8 * t, math.pi / 2, 8.0

    returned = record(lane(-1.6, 15.0, before=1.6, until_s=-4.0), crosses, lanes=road(), step_s=0.1, events=event)
    assert (returned.manner, fault_in(returned).verdict) == ("crossing from the right", "nobody can tell")
    still = record(lane(1.6, 15.0), crosses, lanes=road(), step_s=0.1, events=event)
    assert fault_in(still).verdict == "ego"


def test_vehicle_that_overtakes_is_at_fault_when_it_returns_into_the_overtaken_one():
    returns = lane(-1.6, 15.0, x=2.0, before=1.6, until_s=0.0)
    case = record(returns, lane(-1.6, 6.0), lanes=road(), step_s=0.1)
    assert in_every_view(case) == ("side swipe", "", "ego")
    assert case.lane_changers(3.0) == ("ego",)
    cuts_in = lane(-1.6, 9.0, x=LENGTH_M, before=1.6, until_s=-1.0)
    case = record(lane(-1.6, 14.0), cuts_in, lanes=road(), step_s=0.1)
    assert in_every_view(case) == ("rear end", "ego", "the other")
    assert case.lane_changers(3.0) == ("other",)
    pulls_out = lane(1.6, 9.0, x=LENGTH_M, before=-1.6, until_s=-1.0)  # ahead of a vehicle that overtakes already
    case = record(lane(1.6, 14.0), pulls_out, lanes=road(), step_s=0.1)
    assert in_every_view(case) == ("rear end", "ego", "the other")


def test_vehicle_behind_another_one_that_overtakes_drives_into_its_back():
    event = ((-3.0, Event("wrong_way", "other", "other drove the wrong way on lane ba_0")),)
    case = record(lane(1.6, 14.0), lane(1.6, 8.0, x=LENGTH_M), lanes=road(), step_s=0.1, events=event)
    assert in_every_view(case) == ("rear end", "ego", "ego")


@pytest.mark.parametrize("radius", [3.0, 12.0])
def test_head_on_crash_in_a_hairpin_is_one_at_any_angle(radius):
    path = hairpin(radius)
    lanes = Map([borders(path), borders(hairpin(radius + 3.2)[::-1])], (0.0, 0.0))
    own, its = Way(path), Way(path[::-1])
    for place in bends(path):
        oncomes = its.drive(4.0, its.at[-1] - place - 0.3)
        case = record(own.drive(4.0, place), oncomes, lanes=lanes, step_s=0.1, seconds=5.0)
        assert in_every_view(case) == ("head-on", "", "the other")


def test_crossing_and_merging_vehicles_are_not_on_one_path():
    east, north = Way([(-80, 0), (80, 0)]), Way([(0, -80), (0, 80)])
    joins = Way([(0, -80), *arc((6, -6), 6, 180, 90), (80, 0)])  # turns right into the road
    left = Way([(80, 3), *arc((3, -3), 6, 90, 180), (-3, -80)])  # turns left across it
    for other, at, manner in (
        (north, 82.0, "crossing from the right"),
        (joins, 76.0, "crossing from the right"),
        (left, 84.0, "crossing from the left"),
    ):
        for place in np.arange(at, at + 4, 0.5):
            x = float(other.point(place)[0])
            case = record(east.drive(9.0, 80 + x - 1), other.drive(6.0, place), step_s=0.1)
            if case.turn >= math.radians(46):
                assert case.manner in (manner, "head-on"), (place, case.manner)
            assert not any(case._shared_paths.values())


@pytest.mark.parametrize("radius", [8.0, 15.0])
def test_lane_change_in_a_bend_is_one(radius):
    """To the neighbouring lane of a ring, into a vehicle there, or ahead of it."""
    lanes = Map([borders(ring(radius), aside=aside) for aside in (0.0, 3.2)], (0.0, 0.0))
    way = Way(ring(radius))
    for place in bends(ring(radius)):
        changes = way.drive(5.0, place, lambda t: 3.2 if t < -1e-9 else 0.0)
        case = record(changes, way.drive(5.0, place - 1.0), lanes=lanes, step_s=0.1, seconds=5.0)
        assert (case.manner, case.lane_changers(3.0)) == ("side swipe", ("ego",))
        assert fault_in(case).verdict in ("ego", "nobody can tell")
        cuts_in = way.drive(3.0, place + LENGTH_M, lambda t: 3.2 if t < -0.6 else 0.0)
        case = record(way.drive(7.0, place), cuts_in, lanes=lanes, step_s=0.1, seconds=5.0)
        assert (case.manner, case.lane_changers(3.0)) == ("rear end", ("other",))
        assert fault_in(case).verdict in ("the other", "nobody can tell")
