"""The description of a contact: drawn encounters in every direction, mirrored, swapped, at every phase of a step."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
from conftest import examples
from hypothesis import assume, given, settings, strategies as st

from crashhunt.world import Actor, Roster, Scene, contact_at, first_contact, lane_jump

OPPOSITE = {"left": "right", "right": "left", "front": "front", "rear": "rear"}


@dataclass(frozen=True)
class Mover:
    """A vehicle that drives straight on, and jumps to its left at the end of the step.

    Its centre is at x, y at time 0, in m; heading in rad, speed in m/s, sizes in m.
    """

    x: float
    y: float
    heading: float
    speed: float
    length: float = 5.0
    width: float = 2.0
    jump: float = 0.0

    def front(self, time_s, *, jumped):
        ahead = self.speed * time_s + self.length / 2
        c, s = math.cos(self.heading), math.sin(self.heading)
        aside = self.jump if jumped else 0.0
        return self.x + ahead * c - aside * s, self.y + ahead * s + aside * c


@dataclass(frozen=True)
class View:
    """How the map lies: rotated, moved, and mirrored if flip is -1."""

    turn: float
    shift: tuple[float, float]
    flip: float

    def point(self, x, y):
        c, s, y = math.cos(self.turn), math.sin(self.turn), self.flip * y
        return c * x - s * y + self.shift[0], s * x + c * y + self.shift[1]

    def heading(self, heading):
        return self.flip * heading + self.turn

    def face(self, face):
        return OPPOSITE[face] if self.flip < 0 else face


VIEWS = st.builds(
    View,
    turn=st.floats(-math.pi, math.pi),
    shift=st.tuples(st.floats(-5000, 5000), st.floats(-5000, 5000)),
    flip=st.sampled_from((1.0, -1.0)),
)
PHASES, STEPS = st.floats(0.03, 0.97), st.sampled_from((0.1, 0.2, 0.5, 1.0))
LENGTHS, WIDTHS = st.floats(2.0, 14.0), st.floats(1.2, 2.6)


def scenes(view, one, two, step_s, phase):
    """The two scenes around time 0."""
    roster = Roster(tuple(Actor(name, "car", each.length, each.width) for name, each in (("a", one), ("b", two))))
    found = []
    for time_s, jumped in ((-phase * step_s, False), ((1 - phase) * step_s, True)):
        points = [view.point(*each.front(time_s, jumped=jumped)) for each in (one, two)]
        headings = [view.heading(each.heading) for each in (one, two)]
        found.append(Scene(100 + time_s, roster, points, headings, [one.speed, two.speed], swept=True))
    return found


def described(view, one, two, step_s, phase):
    """The contact as seen from the first; from the second, it must be the same."""
    before, after = scenes(view, one, two, step_s, phase)
    touch, back = first_contact(before, after, 0, 1), first_contact(before, after, 1, 0)
    assert touch is not None
    assert back is not None
    assert back.share == pytest.approx(touch.share, abs=1e-6)
    assert (back.face, back.other_face) == (touch.other_face, touch.face)
    assert back.turn == pytest.approx(-touch.turn, abs=1e-9)
    assert (back.speed, back.other_speed) == pytest.approx((touch.other_speed, touch.speed), abs=1e-6)
    assert (back.jumps, back.other_jumps) == (touch.other_jumps, touch.jumps)
    assert contact_at(before, after, 0, 1) == touch
    assert touch.gap_m == pytest.approx(0.0, abs=1e-6)
    return touch, back


@settings(max_examples=examples(150), deadline=None)
@given(
    view=VIEWS, step_s=STEPS, phase=PHASES, lengths=st.tuples(LENGTHS, LENGTHS), widths=st.tuples(WIDTHS, WIDTHS),
    slower=st.floats(0.0, 20.0), faster=st.floats(0.5, 15.0), aside=st.floats(-0.9, 0.9), turn=st.floats(-0.3, 0.3),
)  # fmt: skip
def test_rear_end_has_a_faster_collider_behind(view, step_s, phase, lengths, widths, slower, faster, aside, turn):
    behind = Mover(0, 0, 0, slower + faster, lengths[0], widths[0])
    ahead = Mover(sum(lengths) / 2, aside * sum(widths) / 2, 0, slower, lengths[1], widths[1])
    touch, back = described(view, behind, ahead, step_s, phase)
    assert (touch.face, touch.other_face, touch.drives_into, back.drives_into) == ("front", "rear", True, False)
    assert touch.time_s == pytest.approx(100.0, abs=1e-5)
    assert (touch.speed, touch.other_speed) == pytest.approx((behind.speed, ahead.speed), abs=1e-6)
    assert (touch.x, touch.y) == pytest.approx(view.point(lengths[0] / 2, 0.0), abs=1e-4)
    assert not touch.is_sideways
    bent = replace(ahead, heading=turn, speed=min(ahead.speed, behind.speed * 0.5))
    bent = replace(bent, x=bent.x + 0.2 + 0.5 * bent.width)  # a leader that begins to turn off
    before, after = scenes(view, behind, bent, step_s, phase)
    found = first_contact(before, after, 0, 1)
    if found is not None:
        assert (found.drives_into, found.turn) == (True, pytest.approx(view.flip * turn, abs=1e-9))


@settings(max_examples=examples(150), deadline=None)
@given(
    view=VIEWS, step_s=STEPS, phase=PHASES, speed=st.floats(0.5, 20.0), its=st.floats(0.0, 25.0),
    along=st.floats(-0.9, 0.9), side=st.sampled_from((1, -1)), rounding=st.sampled_from((0.0, 1e-14, -1e-14, 0.3)),
    lane_m=st.floats(2.9, 3.8),
)  # fmt: skip
def test_actor_that_jumps_into_a_lane_drives_into_the_actor_there(
    view, step_s, phase, speed, its, along, side, rounding, lane_m
):
    """SUMO changes lanes at the end of a step, and leaves a lateral offset of 0 or of a rounding error."""
    end = (1 - phase) * step_s
    jumper = Mover(-speed * end, -side * lane_m, 0, speed, jump=side * lane_m)
    there = Mover(along * 5.0 - its * end, rounding, 0, its)
    before, after = scenes(view, jumper, there, step_s, phase)
    touch, back = first_contact(before, after, 0, 1), first_contact(before, after, 1, 0)
    assert (touch.share, touch.jumps, touch.other_jumps) == (1.0, True, False)
    assert (back.share, back.jumps, back.other_jumps) == (1.0, False, True)
    assert (touch.drives_into, back.drives_into) == (True, False)
    left, right = view.face("left"), view.face("right")
    faces = (left, right) if side > 0 else (right, left)
    assert (touch.face, touch.other_face) == faces
    assert (back.face, back.other_face) == faces[::-1]
    assert lane_jump(before, after, "a") == pytest.approx(view.flip * side * lane_m, abs=1e-6)
    assert lane_jump(before, after, "b") == 0.0


@settings(max_examples=examples(60), deadline=None)
@given(view=VIEWS, step_s=STEPS, phase=PHASES, speed=st.floats(0.5, 20.0), along=st.floats(-0.9, 0.9))
def test_two_that_jump_into_one_lane_drive_into_each_other(view, step_s, phase, speed, along):
    end = (1 - phase) * step_s
    left = Mover(-speed * end, 3.2, 0, speed, jump=-3.2)
    right = Mover(along * 5.0 - speed * end, -3.2, 0, speed, jump=3.2)
    touch, back = described(view, left, right, step_s, phase)
    assert (touch.jumps, touch.other_jumps, touch.drives_into, back.drives_into) == (True, True, True, True)


@settings(max_examples=examples(60), deadline=None)
@given(view=VIEWS, step_s=STEPS, speed=st.floats(0.5, 20.0), slow=st.floats(0.0, 1.0), share=st.floats(0.1, 0.9))
def test_lane_change_after_the_contact_has_no_part_in_it(view, step_s, speed, slow, share):
    """The vehicle drives into the one ahead first, and SUMO changes its lane at the end of the step."""
    lead = speed * slow * 0.5
    assume((speed - lead) * (1 - share) * step_s > 0.5)  # less may be a rounding of the step, and is no contact
    behind, ahead = Mover(0, 0, 0, speed, jump=3.2), Mover(5.0, 0, 0, lead)
    touch, back = described(view, behind, ahead, step_s, share)
    assert (touch.face, touch.other_face, touch.drives_into, back.drives_into) == ("front", "rear", True, False)
    assert touch.share == pytest.approx(share, abs=0.5 / ((speed - lead) * step_s) + 1e-3)
    assert not touch.is_sideways


@settings(max_examples=examples(60), deadline=None)
@given(view=VIEWS, step_s=STEPS, speed=st.floats(5.0, 20.0), deep=st.floats(0.01, 0.3))
def test_slight_contact_before_a_lane_change_counts_if_a_simulator_has_reported_it(view, step_s, speed, deep):
    """Alone, the ways between the scenes leave it open; without the report, only the lane change remains."""
    behind, ahead = Mover(0, 0, 0, speed, jump=3.2), Mover(5.0, 0, 0, 0.0)
    before, after = scenes(view, behind, ahead, step_s, 1.0 - deep / (speed * step_s))
    assert first_contact(before, after, 0, 1) is None
    touch, back = (contact_at(before, after, *rows, grazing=True) for rows in ((0, 1), (1, 0)))
    assert (touch.face, touch.other_face, touch.drives_into, back.drives_into) == ("front", "rear", True, False)
    assert touch.time_s == pytest.approx(100.0, abs=1e-6)
    assert (touch.jumps, touch.gap_m) == (False, pytest.approx(0.0, abs=1e-6))
    unreported = contact_at(before, after, 0, 1)
    assert (unreported.share, unreported.jumps) == (1.0, True)


@settings(max_examples=examples(150), deadline=None)
@given(
    view=VIEWS, step_s=STEPS, phase=PHASES, angle=st.floats(1.1, 2.0), side=st.sampled_from((1, -1)),
    speed=st.floats(3.0, 20.0), its=st.floats(0.0, 1.0), where=st.floats(-0.25, 0.25),
)  # fmt: skip
def test_crossing_is_by_the_front_into_the_side(view, step_s, phase, angle, side, speed, its, where):
    """The other comes from the side, and its flank is hit."""
    heading = side * angle
    c, s = math.cos(heading), math.sin(heading)
    # The middle of the front touches the flank at time 0, so far from the other's centre along its length.
    along, across = where * 8.0, side * 1.0
    crosses = Mover(2.5 + along * c - across * s, along * s + across * c, heading, its * speed * 0.5, 8.0, 2.0)
    crosses = replace(crosses, x=2.5 - along * c + abs(s) * 1.0, y=-along * s - c * math.copysign(1.0, s))
    touch, back = described(view, Mover(0, 0, 0, speed), crosses, step_s, phase)
    assert (touch.drives_into, back.drives_into) == (True, False)
    assert (touch.face, touch.other_face) == ("front", view.face("left" if side > 0 else "right"))
    assert touch.turn == pytest.approx(view.flip * heading, abs=1e-9)


@settings(max_examples=examples(60), deadline=None)
@given(view=VIEWS, step_s=STEPS, phase=PHASES, speed=st.floats(2.0, 20.0), side=st.sampled_from((1, -1)))
def test_actor_that_stands_drives_into_nothing(view, step_s, phase, speed, side):
    stands = Mover(0, 0, 0, 0.0)
    # Its front is scraped along, met by a front, and driven into from the side.
    scraped = Mover(2.5 + 0.5, -side * 3.5, side * math.pi / 2, speed)
    head_on = Mover(5.0, 0.5, math.pi, speed)
    from_side = Mover(0.3, -side * 3.5, side * math.pi / 2, speed)
    for other in (scraped, head_on, from_side):
        touch, back = described(view, stands, other, step_s, phase)
        assert (touch.drives_into, back.drives_into) == (False, True)
    both = described(view, Mover(0, 0, 0, speed), head_on, step_s, phase)
    assert [one.drives_into for one in both] == [True, True]  # head-on, each is the one that is asked about
    assert [(one.face, one.other_face) for one in both] == [("front", "front")] * 2


@settings(max_examples=examples(60), deadline=None)
@given(
    view=VIEWS, step_s=STEPS, was=st.floats(0.0, 20.0), change=st.floats(-6.0, 6.0), phase=PHASES,
    kind=st.sampled_from((-0.3, 0.0, 0.4, 1.0, 1.3)),
)  # fmt: skip
def test_speed_at_the_contact_agrees_with_the_distance(view, step_s, was, change, kind, phase):
    """A share of the step is driven at the new speed, as in SUMO, the rest with a constant acceleration.

    A distance that no such share explains changes nothing: the speed stays between both.
    """
    now = max(0.0, was + change)
    driven = (kind * now + (1 - kind) * (was + now) / 2) * step_s
    assume(driven > 0.05)
    wall = Mover(5.0 + phase * driven, 0, 0, 0.0)
    before, after = scenes(view, Mover(0, 0, 0, was), wall, step_s, 0.0)
    points = [view.point(2.5, 0.0), view.point(2.5 + driven, 0.0)]
    for scene, point, speed in zip((before, after), points, (was, now), strict=True):
        scene.points[0], scene.speeds[0] = point, speed
    touch = first_contact(before, after, 0, 1)
    share, kind = touch.share, min(1.0, max(0.0, kind))
    assert share == pytest.approx(phase, abs=1e-5 / driven + 1e-6)
    expected = kind * now + (1 - kind) * ((1 - share) * was + share * now) if abs(change) > 1e-6 else was
    assert touch.speed == pytest.approx(expected, abs=1e-3)
