"""First contacts between two scenes: against brute force, and in cases whose answers are known."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from conftest import examples
from hypothesis import given, settings, strategies as st

from crashhunt.oracles import Overlap, ReportedCollision, merge_findings
from crashhunt.trial import CRASHES
from crashhunt.world import Actor, Contact, Roster, Scene, first_contact, outlines_overlap

CAR = (5.0, 1.8)


def scene(time_s, *actors, contacts=(), **more):
    """Each actor is (id, x, y, heading, speed), a car where no size follows."""
    roster = Roster(tuple(Actor(name, "passenger", *(size or CAR)) for name, _, _, _, _, *size in actors))
    points = [(float(x), float(y)) for _, x, y, *_ in actors]
    headings, speeds = [float(actor[3]) for actor in actors], [float(actor[4]) for actor in actors]
    return Scene(time_s, roster, points, headings, speeds, contacts, swept=True, **more)


def found(*scenes, agent="ego"):
    for before, after in pairwise(scenes):
        after.follow(before)
    present = scenes[-1]
    findings = [each for oracle in (ReportedCollision(), Overlap()) for each in oracle.check(present, [agent])]
    finding = merge_findings([each for each in findings if each.outcome in CRASHES])
    return finding and finding.collision


def bend(name, x, y, heading, speed, turn, size, time_s):
    """A vehicle whose centre drives on a circle, as (before, after) of a step."""

    def front(x, y, heading):
        return x + size[0] / 2 * math.cos(heading), y + size[0] / 2 * math.sin(heading)

    chord = speed * time_s * (math.sin(turn / 2) / (turn / 2) if abs(turn) > 1e-9 else 1.0)
    after = x + chord * math.cos(heading + turn / 2), y + chord * math.sin(heading + turn / 2)
    return (
        (name, *front(x, y, heading), heading, speed, *size),
        (name, *front(*after, heading + turn), heading + turn, speed, *size),
    )


def on_the_way(before, after, share, turn, size):
    """The exact rectangle of `bend` within the step."""
    _, x0, y0, h0, speed, *_ = before
    x0, y0 = x0 - size[0] / 2 * math.cos(h0), y0 - size[0] / 2 * math.sin(h0)
    part = turn * share
    chord = speed * 1.0 * share * (math.sin(part / 2) / (part / 2) if abs(part) > 1e-9 else 1.0)
    x, y = x0 + chord * math.cos(h0 + part / 2), y0 + chord * math.sin(h0 + part / 2)
    h = h0 + part
    return x + size[0] / 2 * math.cos(h), y + size[0] / 2 * math.sin(h), h, *size


cars = st.tuples(
    st.floats(-25, 25), st.floats(-25, 25), st.floats(-3.1, 3.1), st.floats(0, 20), st.floats(-0.6, 0.6),
    st.tuples(st.floats(0.3, 12), st.floats(0.3, 2.5)),
)  # fmt: skip


@given(cars, cars)
@settings(max_examples=examples(80))
def test_the_first_contact_agrees_with_a_thousand_samples_of_the_step(one, two):
    motions = [bend(name, *car[:5], car[5], 1.0) for name, car in (("ego", one), ("other", two))]
    before, after = (scene(float(time), *(motion[time] for motion in motions)) for time in (0, 1))

    def apart(share, shrink):
        rectangles = []
        for motion, car in zip(motions, (one, two), strict=True):
            x, y, h, length, width = on_the_way(*motion, share, car[4], car[5])
            less = min(shrink, width / 2.1, length / 2.1)
            x, y = x - less * math.cos(h), y - less * math.sin(h)
            rectangles.append((x, y, h, length - 2 * less, width - 2 * less))
        return not outlines_overlap(*rectangles)

    touch = first_contact(before, after, 0, 1)
    seen = Overlap()
    after.follow(before)
    assert bool(seen.check(after, ["ego"])) == (touch is not None)  # the broad phase leaves nothing out
    # An arc and a cubic part by some centimetres, and in bends what brushes past does not count.
    tolerance = 0.03 + sum(abs(car[4]) * car[3] for car in (one, two)) / 16
    brushing = tolerance + 0.4 * sum(car[4] != 0 for car in (one, two))
    deep = next((number / 1000 for number in range(1001) if not apart(number / 1000, brushing)), None)
    if deep is not None and min(*one[5], *two[5]) > 2.1 * brushing:
        assert touch is not None
        assert touch.share <= deep + 0.002
    if touch is not None:
        grown = -tolerance - 0.03
        assert not apart(touch.share, grown)
        assert touch.time_s == pytest.approx(touch.share)
        assert touch.speed == pytest.approx(one[3])


def test_who_drives_through_another_between_two_steps_is_seen():
    before = scene(0.0, ("ego", 0, 0, 0, 20), ("other", 12, 0, 0, 2))
    after = scene(1.0, ("ego", 20, 0, 0, 20), ("other", 14, 0, 0, 2))
    hit = found(before, after)
    assert (hit.role, hit.collider, hit.victim, hit.seen_by) == ("collider", "ego", "other", ("overlap",))
    assert (hit.time_s, hit.x, hit.collider_speed, hit.victim_speed) == pytest.approx((7 / 18, 140 / 18, 20, 2))


@pytest.mark.parametrize("contacts", [(), (Contact("other", "ego", "collision", "a_0", 4.0, 25.0),)])
def test_who_ends_up_ahead_of_the_vehicle_that_it_rear_ended_was_not_hit_by_it(contacts):
    before = scene(0.0, ("ego", 0, 0, 0, 25), ("other", 20, 0, 0, 4))
    after = scene(1.0, ("ego", 25, 0, 0, 25), ("other", 24, 0, 0, 4), contacts=contacts)
    hit = found(before, after)
    assert (hit.role, hit.collider, hit.victim) == ("collider", "ego", "other")
    assert (hit.collider_speed, hit.victim_speed, hit.time_s) == pytest.approx((25, 4, 15 / 21))
    assert found(before, after, agent="other").role == "victim"


def test_scenes_that_are_no_way_are_not_swept():
    before = scene(0.0, ("ego", 0, 0, 0, 20), ("other", 12, 0, 0, 2))
    after = scene(1.0, ("ego", 20, 0, 0, 20), ("other", 14, 0, 0, 2))
    after.swept = False
    assert found(before, after) is None


def test_a_person_who_steps_aside_is_not_swept_along_a_bend():
    before = scene(0.0, ("ego", 0, 0, 0, 12), ("person 0", 9, -1.6, 0, 1, 0.2, 0.5))
    after = scene(1.0, ("ego", 12, 0, 0, 12), ("person 0", 9.2, -2.2, -math.pi / 2, 1, 0.2, 0.5))
    assert found(before, after) is None
    into = scene(1.0, ("ego", 12, 0, 0, 12), ("person 0", 9.2, -0.7, math.pi / 2, 1, 0.2, 0.5))
    hit = found(before, into)
    assert (hit.role, hit.victim) == ("collider", "person 0")


def heights(view, *values, grades=None):
    view.heights, view.grades = values, grades or (0.0,) * len(values)
    return view
