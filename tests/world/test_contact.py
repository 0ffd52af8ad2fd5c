"""Who drives into whom and when, in steps whose answer is known, however the map lies."""

from __future__ import annotations

import math

import pytest
from scenes import scene

from crashhunt.world import _contact, _geometry, first_contact

TURNS = [0.0, 0.8, -2.6]


def step(turned, before, after, *, seconds=1.0, **more):
    """Two scenes with a step between them, on a map that is turned; each vehicle is (x, y, heading, speed)."""
    c, s = math.cos(turned), math.sin(turned)

    def at(vehicles, time_s):
        rows = [
            (name, x * c - y * s, x * s + y * c, heading + turned, speed)
            for name, (x, y, heading, speed) in zip(("ego", "other"), vehicles, strict=True)
        ]
        return scene(*rows, time_s=time_s, swept=True, **more)

    return at(before, 10.0), at(after, 10.0 + seconds)


def touched(turned, before, after, **more):
    previous, present = step(turned, before, after, **more)
    mine, theirs = first_contact(previous, present, 0, 1), first_contact(previous, present, 1, 0)
    assert (mine is None) == (theirs is None)
    if mine is not None:
        assert theirs.share == pytest.approx(mine.share, abs=1e-6)
        assert (theirs.speed, theirs.other_speed) == pytest.approx((mine.other_speed, mine.speed), abs=1e-4)
    return mine


@pytest.mark.parametrize("turned", TURNS)
def test_who_passes_next_to_or_stays_behind_touches_no_one(turned):
    assert touched(turned, [(0, 0, 0, 20), (12, 2.01, 0, 4)], [(18, 0, 0, 16), (15, 2.01, 0, 2)]) is None
    assert touched(turned, [(0, 0, 0, 20), (12, 2.0, 0, 4)], [(18, 0, 0, 16), (15, 2.0, 0, 2)]) is None
    assert touched(turned, [(0, 0, 0, 20), (12, -1.99, 0, 4)], [(18, 0, 0, 16), (15, -1.99, 0, 2)]) is not None
    assert touched(turned, [(0, 0, 0, 20), (30, 0, 0, 4)], [(18, 0, 0, 16), (33, 0, 0, 2)]) is None
    # Bumper to bumper in the end, to rounding, is no touch; a tenth of a millimetre more is.
    assert touched(turned, [(0, 0, 0, 7), (12, 0, 0, 0)], [(7, 0, 0, 7), (12, 0, 0, 0)]) is None
    assert touched(turned, [(0, 0, 0, 7), (12, 0, 0, 0)], [(7.0001, 0, 0, 7), (12, 0, 0, 0)]).share == pytest.approx(
        1, abs=1e-3
    )


@pytest.mark.parametrize("turned", TURNS)
def test_head_on_it_is_the_one_that_was_asked_about(turned):
    previous, present = step(turned, [(0, 0, 0, 10), (12, 0, math.pi, 10)], [(8, 0, 0, 10), (4, 0, math.pi, 10)])
    for row, other in ((0, 1), (1, 0)):
        found = first_contact(previous, present, row, other)
        assert found.drives_into
        assert found.share == pytest.approx(12 / 16, abs=1e-6)


@pytest.mark.parametrize("turned", TURNS)
def test_side_by_side_it_is_who_moves_towards_the_other(turned):
    """Neither has the other one in front: both drift, one of them more."""
    before = [(0, 0, 0, 10), (1, 2.5, 0, 10)]
    drifts = touched(turned, before, [(10, 0.9, 0, 10), (11, 2.5, 0, 10)])
    assert drifts.drives_into
    assert drifts.share == pytest.approx(0.5 / 0.9, abs=0.2)
    assert not touched(turned, before, [(10, 0, 0, 10), (11, 1.6, 0, 10)]).drives_into
    assert touched(turned, before, [(10, 0.8, 0, 10), (11, 2.6, 0, 10)]).drives_into
    assert not touched(turned, before, [(10, -0.1, 0, 10), (11, 1.5, 0, 10)]).drives_into
    # Both stand: whoever has the other's centre ahead.
    still = [(0, 0, 0, 0), (1, 1.9, 0, 0)]
    assert touched(turned, still, still).drives_into
    assert not touched(turned, still[::-1], still[::-1]).drives_into


@pytest.mark.parametrize("turned", TURNS)
def test_without_a_scene_before_the_present_one_decides(turned):
    _, apart = step(turned, *[[(0, 0, 0, 10), (5, 0, 0, 8)]] * 2)
    assert first_contact(None, apart, 0, 1) is None
    _, present = step(turned, *[[(0, 0, 0, 10), (4.9, 0, 0, 8)]] * 2)
    found = first_contact(None, present, 0, 1)
    assert (found.share, found.time_s, found.drives_into, found.speed, found.other_speed) == (1, 11, True, 10, 8)
    assert (found.x, found.y) == (0, 0)
    assert not first_contact(None, present, 1, 0).drives_into
    # From the side, neither in front of the other: it is who moves more towards the other.
    for heading, x, other_heading, drives_into in ((0.1, 1.5, 0, True), (0, -1.5, -0.1, False)):
        _, beside = step(turned, *[[(0, 0, heading, 10), (x, 1.95, other_heading, 10)]] * 2)
        assert first_contact(None, beside, 0, 1).drives_into is drives_into
        assert first_contact(None, beside, 1, 0).drives_into is not drives_into


def test_who_was_not_there_or_was_put_there_did_not_drive():
    before = scene(("ego", 0, 0, 0, 10), ("other", 12, 0, 0, 0), time_s=0.0)
    there = scene(("ego", 10, 0, 0, 10), ("other", 12, 0, 0, 0), time_s=1.0, swept=True)
    assert first_contact(before, there, 0, 1).share == pytest.approx(0.7, abs=1e-6)
    fresh = scene(("other", 12, 0, 0, 0), time_s=0.0)
    assert first_contact(fresh, there, 0, 1).share == 1
    # 1.5 times as far as its speed explains, and a metre; sideways twelve metres more.
    for turned in TURNS:
        for x, share in ((15.9, 7 / 15.9), (16.1, 1.0)):
            found = touched(turned, [(0, 0, 0, 10), (12, 0, 0, 0)], [(x, 0, 0, 10), (12, 0, 0, 0)])
            assert found.share == pytest.approx(share, abs=1e-6)
    slowing = scene(("ego", 12, 0, 0, 0), ("other", 14, 0, 0, 0), time_s=1.0, swept=True)
    assert first_contact(before, slowing, 0, 1) is not None  # it is the faster of both scenes that counts
    wide = scene(("ego", 10, 27, 0, 10), ("other", 12, 0, 0, 0), time_s=1.0, swept=True)
    assert first_contact(before, wide, 0, 1) is None


@pytest.mark.parametrize("turned", TURNS)
@pytest.mark.parametrize("side", [1, -1])
def test_a_quarter_of_a_circle_is_driven_along(turned, side):
    """Centre on a circle of 20 m to that side; who stands on the chord is passed, who stands on the arc is not."""
    radius, half, quarter = 20.0, 2.5, math.pi / 2
    speed = radius * quarter
    before, after = (half, 0, 0, speed), (radius, (radius + half) * side, quarter * side, speed)

    def standing(angle, away):
        """A car along the tangent at an angle of the arc, so far outside of it."""
        reach = radius + away
        x, y, heading = reach * math.sin(angle), side * (radius - reach * math.cos(angle)), side * angle
        return x + half * math.cos(heading), y + half * math.sin(heading), heading, 0

    for angle in (0.3, math.pi / 4, 1.2):
        on_arc = standing(angle, 0.0)
        found = touched(turned, [before, on_arc], [after, on_arc])
        # Their centres are 5 m apart along the arc when they touch, give or take what the bend makes of bumpers.
        expected = (angle - 2 * math.atan(half / radius)) / quarter
        if expected > 0:
            assert found.share == pytest.approx(expected, abs=0.02)
            assert found.drives_into
        for away in (3.0, -3.0):
            beside = standing(angle, away)
            assert touched(turned, [before, beside], [after, beside]) is None
    # On the straight way from its beginning to its end, 5.9 m inside of the arc.
    chord = standing(math.pi / 4, -(radius - radius / math.sqrt(2)))
    assert touched(turned, [before, chord], [after, chord]) is None


def test_a_long_vehicle_touches_with_each_of_its_parts():
    """A bus that turns off: its rear is still in the street when its front has left it."""
    spine = ((30.0, 10.0, 0.0), (30.0, 4.0, 0.0), (30.0, 0.0, 0.0), (24.0, 0.0, 0.0))

    def at(x, time_s, **more):
        bus = ("bus", 30, 10, math.pi / 2, 0)
        return scene(("ego", x, 0, 0, 20), bus, sizes={"bus": (16.0, 2.5)}, time_s=time_s, swept=True, **more)

    straight = first_contact(at(10, 0.0), at(20, 1.0), 0, 1)
    assert straight is None
    found = first_contact(at(10, 0.0, spines={1: spine}), at(20, 1.0, spines={1: spine}), 0, 1)
    assert found is None
    found = first_contact(at(10, 0.0, spines={1: spine}), at(28, 1.0, spines={1: spine}), 0, 1)
    assert found.share == pytest.approx(14 / 18, abs=1e-6)
    assert found.drives_into
    assert (found.x, found.y) == pytest.approx((24, 0), abs=1e-4)
    assert (found.speed, found.other_speed) == pytest.approx((20, 0))
    # Only its front part can drive into somebody with its front; here the ego hits it in the back.
    backwards = first_contact(at(10, 0.0, spines={1: spine}), at(28, 1.0, spines={1: spine}), 1, 0)
    assert not backwards.drives_into
    above = tuple((x, y, 6.0) for x, y, _ in spine)
    high = {"spines": {1: above}, "heights": (0.0, 6.0)}
    assert first_contact(at(10, 0.0, **high), at(28, 1.0, **high), 0, 1) is None


def test_a_bridge_is_no_obstacle_unless_the_lower_one_is_tall():
    def at(x, time_s, heights, **tall):
        return scene(("ego", x, 0, 0, 20), ("other", 16, 1, math.pi / 2, 0), heights=heights, tall=tall, time_s=time_s)

    def found(heights, **tall):
        return first_contact(at(0, 0.0, heights, **tall), at(18, 1.0, heights, **tall), 0, 1)

    assert found((0.0, 0.0)) is not None
    assert found((0.0, 4.0)) is None
    assert found((0.0, 4.0), ego=4.2) is not None
    assert found((0.0, 4.0), other=4.2) is None
    assert found((4.0, 0.0), other=4.2) is not None
    assert found((4.0, 0.0), ego=4.2) is None


@pytest.mark.parametrize("turned", TURNS)
@pytest.mark.parametrize("who", ["person 0", "reverses", "spins"])
@pytest.mark.parametrize("away", [4.0, 6.0, 8.0])
def test_who_does_not_drive_as_cars_do_goes_straight(turned, who, away):
    """Who steps aside, reverses, or turns by more than a bend can: at constant speed, straight to where it is then."""
    c, s = math.cos(turned), math.sin(turned)
    after = {"person 0": (6.0, 8.0, 0.0), "reverses": (-6.0, -8.0, 0.9), "spins": (6.0, 8.0, 2.9)}[who]
    before = {"person 0": (0.0, 0.0, 0.0), "reverses": (0.0, 0.0, 0.9), "spins": (0.0, 0.0, 0.0)}[who]
    way = math.copysign(1, after[0])

    def at(x, y, heading, time_s):
        # The other one is square too, with a side across the way, so far from where it begins.
        across = math.atan2(8, 6)
        rows = [(who, x, y, heading), ("other", way * (away + 0.5) * 0.6, way * (away + 0.5) * 0.8, across)]
        rows = [  # of a centre, the front bumper
            (
                name,
                (x * c - y * s) + 0.5 * math.cos(h + turned),
                (x * s + y * c) + 0.5 * math.sin(h + turned),
                h + turned,
                10,
            )
            for name, x, y, h in rows
        ]
        return scene(*rows, sizes={who: (1.0, 1.0), "other": (1.0, 1.0)}, time_s=time_s, swept=True)

    found = first_contact(at(*before, 0.0), at(*after, 1.0), 0, 1)
    heading = before[2] + (after[2] - before[2]) * (found.share if found else 0) - math.atan2(8, 6)
    reach = (abs(math.cos(heading)) + abs(math.sin(heading))) / 2  # of its corner, along the way
    assert found.share == pytest.approx((away - reach) / 10, abs=0.005)


@pytest.mark.parametrize("end", [(6.0, 1.0, 0.4), (5.0, -2.0, -0.9), (7.0, 4.0, 0.0)], ids=["left", "right", "jump"])
def test_which_way_it_moves_is_how_its_place_changes(end):
    """What decides between two that touch side by side."""
    way = _contact._Way((1.0, 2.0, 0.3, 4.0, 1.8), (1.0 + end[0], 2.0 + end[1], 0.3 + end[2], 4.0, 1.8), bends=True)
    assert way.reach == pytest.approx(math.hypot(4.0, 1.8) / 2)
    for share in (0.1, 0.5, 0.9):
        before, after = (_geometry.center(way.at(share + change)) for change in (-1e-6, 1e-6))
        rate = [(now - was) / 2e-6 for was, now in zip(before, after, strict=True)]
        assert way.moving(share) == pytest.approx(rate, abs=1e-5)
    assert way.moving(1.0) == pytest.approx(way.moving(1 - 1e-9), abs=1e-6)
    if any(way.jump):  # at once, at the end
        assert math.hypot(*way.jump) > 1.5
        old, new = _geometry.center(way.at(1 - 1e-9)), _geometry.center(way.at(1.0))
        assert (new[0] - old[0], new[1] - old[1]) == pytest.approx(way.jump, abs=1e-6)


def test_what_brushes_past_in_a_bend_has_not_touched():
    """Between two scenes nobody knows a bend to the millimetre; what is there in the end, or in a straight, counts."""
    turn, radius = 0.4, 50.0
    speed = 40.0

    def on_circle(angle, reach=radius):
        x, y = reach * math.sin(angle), radius - reach * math.cos(angle)
        return x + 2.5 * math.cos(angle), y + 2.5 * math.sin(angle), angle

    def found(overlap, ends_at=turn):
        other = (*on_circle(turn * 0.9, radius + 2.0 - overlap), 0)
        before, after = (*on_circle(-0.02), speed), (*on_circle(ends_at), speed)
        return first_contact(*step(0.0, [before, other], [after, other]), 0, 1)

    assert found(-0.2) is None
    assert found(0.15, turn + 0.3) is None
    assert found(1.2, turn + 0.3) is not None
    assert found(0.15) is not None  # in the end they do touch
