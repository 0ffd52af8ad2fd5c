"""The record of a contact: long steps, every phase, mirrored and rotated maps, changes of lane at and after it."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import examples
from hypothesis import given, settings, strategies as st
from test_fault import LANES, Map, rotated

from crashhunt.crashes import find_bundle
from crashhunt.crashes._contact_record import ContactRecord, contact_record, record_in
from crashhunt.crashes._fault import fault_in
from crashhunt.crashes._lanes import LaneMap
from crashhunt.trial import Collision
from crashhunt.world import Actor, Event, Roster, Scene

FROZEN = Path(__file__).parents[1] / "e2e" / "frozen" / "version-1" / "hunt"
ROSTER = Roster((Actor("ego", "passenger", 5.0, 2.0), Actor("other", "passenger", 5.0, 2.0)))
PHASES = st.floats(0.02, 0.98)
STEPS = st.sampled_from((0.1, 0.2, 0.5, 1.0))
ANGLES = st.floats(-math.pi, math.pi)


def record(ego, other, *, step_s=1.0, phase=1.0, seconds=8.0, lanes=LANES, **more):
    """A record from functions of the time: x, y, heading, speed; the contact is at 0, at a share of the last step."""
    scenes = []
    for back in range(round(seconds / step_s), -1, -1):
        time_s = (1 - phase - back) * step_s
        poses = [way(time_s) for way in (ego, other)]
        points, headings = [pose[:2] for pose in poses], [pose[2] for pose in poses]
        scenes.append(Scene(time_s, ROSTER, points, headings, [pose[3] for pose in poses]))
    return ContactRecord(agent="ego", other="other", scenes=scenes, time_s=0.0, began_s=-30.0, lanes=lanes, **more)


def drives(speed, x=0.0, y=0.0, *, changes_s=None, to=0.0):
    """Drives along the x axis; from a time on, it is in another lane."""
    return lambda t: (x + speed * t, to if changes_s is not None and t >= changes_s - 1e-9 else y, 0.0, speed)


def told(case):
    fault = fault_in(case)
    return case.manner, case.collider, case.follower, case.lane_changers(3.0), fault.verdict, fault.findings


def mirrored(case):
    scenes = [
        Scene(one.time_s, one.roster, [(x, -y) for x, y in one.points], [-h for h in one.headings], one.speeds)
        for one in case.scenes
    ]
    borders = [tuple(border * np.array([1.0, -1.0]) for border in pair[::-1]) for pair in case.lanes.borders]
    return replace(case, scenes=scenes, lanes=Map(borders, (case.lanes.around[0], -case.lanes.around[1])))


NUMBER = re.compile(r"\d+\.\d")


def same_in_every_view(case, angle):
    """What is said, which does not depend on the view, but that 0.45 m may be rounded to 0.4 or to 0.5 m.

    By day, one view is rotated and mirrored at once: who depends on one of both says something else there, too.
    """
    said = told(case)
    words = [finding.words for finding in said[-1]]
    views = (lambda: rotated(mirrored(case), angle), lambda: rotated(case, angle), lambda: mirrored(case))
    for view in views[: examples(3)]:
        seen = told(view())
        shown = [finding.words for finding in seen[-1]]
        assert seen[:-1] == said[:-1]
        assert [(one.rule, one.blames, one.source) for one in seen[-1]] == [
            (one.rule, one.blames, one.source) for one in said[-1]
        ]
        assert [NUMBER.sub("#", one) for one in shown] == [NUMBER.sub("#", one) for one in words]
        numbers, others = ([float(one) for one in NUMBER.findall(" ".join(texts))] for texts in (shown, words))
        assert numbers == pytest.approx(others, abs=0.11)
    return said


@settings(max_examples=examples(12), deadline=None)
@given(step_s=STEPS, phase=PHASES, angle=ANGLES, aside=st.floats(-1.4, 1.4))
def test_rear_end_has_a_verdict_at_every_phase_of_every_step(step_s, phase, angle, aside):
    case = record(drives(15.0, y=aside), drives(8.0, x=5.0), step_s=step_s, phase=phase)
    assert case.times[0] >= 4.0 - 1e-6
    manner, collider, follower, changers, verdict, (finding,) = same_in_every_view(case, angle)
    assert (manner, collider, follower, changers, verdict) == ("rear end", "ego", "ego", (), "ego")
    assert finding.rule == "rear end"
    again = record(drives(8.0, x=5.0), drives(15.0), step_s=step_s, phase=phase)
    assert same_in_every_view(again, angle)[:5] == ("rear end", "other", "other", (), "the other")


@settings(max_examples=examples(10), deadline=None)
@given(phase=PHASES, angle=ANGLES, speed=st.floats(1.0, 3.0))
def test_agent_that_starts_off_is_not_driven_into(phase, angle, speed):
    """It stood in all scenes before the contact, and the vehicle ahead crept."""

    def starts(t):
        moves = t > -phase + 1e-9
        return (speed * (t + phase) if moves else 0.0), 0.0, 0.0, (speed if moves else 0.0)

    case = record(starts, drives(0.3, x=5.0 + speed * phase), phase=phase)
    verdict, findings = same_in_every_view(case, angle)[4:]
    assert verdict == "ego"
    assert [finding.rule for finding in findings] == ["rear end"]
    assert case.stood_s("ego") == 0.0


@settings(max_examples=examples(10), deadline=None)
@given(step_s=STEPS, phase=PHASES)
def test_time_of_standing_is_that_of_the_stop_between_scenes(step_s, phase):
    """It brakes by 4 m/s² and stops 5.3 s before the contact."""

    def stops(t):
        left = max(0.0, -5.3 - t)
        return 5.0 - 2.0 * left**2, 0.0, 0.0, 4.0 * left

    case = record(drives(10.0), stops, step_s=step_s, phase=phase, seconds=12.0)
    assert case.stood_s("other") == pytest.approx(5.3, abs=0.03)


def bends(speed, ahead=0.0, radius=9.0):
    """Drives straight on until x is 0, and then on an arc to the left; it is at 16 m of the arc plus ``ahead`` at 0."""

    def way(t):
        along = 16.0 + ahead + speed * t
        turn = max(0.0, along) / radius
        return min(along, 0.0) + radius * math.sin(turn), radius * (1 - math.cos(turn)), turn, speed

    return way


@settings(max_examples=examples(15), deadline=None)
@given(step_s=st.sampled_from((0.1, 0.2, 0.5)), phase=PHASES, angle=ANGLES)
def test_leader_on_a_bend_had_been_ahead_at_every_phase_of_every_step(step_s, phase, angle):
    case = record(bends(9.0), bends(6.0, ahead=4.9), step_s=step_s, phase=phase, lanes=Map((), (0.0, 0.0)))
    manner, collider, follower, _, verdict, (finding,) = same_in_every_view(case, angle)
    assert (manner, collider, follower, verdict, finding.rule) == ("rear end", "ego", "ego", "ego", "rear end")
    assert case.in_its_way_s("other") == pytest.approx(4.0)


@settings(max_examples=examples(10), deadline=None)
@given(step_s=STEPS, angle=ANGLES, side=st.sampled_from((4.0, -4.0)), along=st.floats(-4.5, 4.5), its=st.floats(0, 20))
def test_jump_into_the_next_lane_is_the_fault_of_the_jumper(step_s, angle, side, along, its):
    jumps, stays = drives(10.0, y=-side, changes_s=0.0), drives(its, x=along)
    found = same_in_every_view(record(jumps, stays, step_s=step_s), angle)
    assert found[:5] == ("side swipe", "ego", "", ("ego",), "ego")
    assert "ego moved sideways into other, which was next to it" in found[5][0].words
    found = same_in_every_view(record(stays, jumps, step_s=step_s), angle)
    assert found[:5] == ("side swipe", "other", "", ("other",), "the other")


@settings(max_examples=examples(10), deadline=None)
@given(angle=ANGLES, before_s=st.sampled_from((0.0, 0.5, 1.0, 2.0)))
def test_completed_lane_change_is_no_part_of_both_moved_sideways(angle, before_s):
    """Both jump into the lane between theirs, the other one some steps earlier."""
    jumps = drives(10.0, y=-4.0, changes_s=0.0)
    other = drives(10.0, x=1.0, y=4.0, changes_s=-before_s)
    case = record(jumps, other, step_s=0.5)
    found = same_in_every_view(case, angle)
    words = [finding.words for finding in found[5] if finding.rule == "lane change"]
    if not before_s:
        assert (found[4], words) == ("both", ["both moved sideways into each other"])
    elif before_s < 1.0:
        assert (found[4], words) == ("nobody can tell", [])
    else:
        assert found[4] == "ego"
        assert f"which had changed to the lane next to it {before_s:.1f} s before" in words[0]
    assert case.changed_s("other") == pytest.approx(before_s)
    assert case.changed_s("ego") == 0.0


@settings(max_examples=examples(10), deadline=None)
@given(angle=ANGLES, speed=st.sampled_from((0.3, 0.9, 1.05, 2.0)), leaves=st.booleans())
def test_jump_into_a_part_of_a_vehicle_that_was_long_in_this_lane_is_the_fault_of_the_jumper(angle, speed, leaves):
    """SUMO's vehicles do not see the part of a freely driven vehicle that is in another lane, and jump into it."""

    def drifts(t):  # over the border at y = 2, which its outline reaches at y = 2.9
        return 1.0 + 10.0 * t, 1.95 + (speed if leaves else -speed) * min(0.0, max(t, -2.0)), 0.0, 10.0

    case = record(drives(10.0, y=-4.0, changes_s=0.0), drifts, step_s=0.05)
    found = same_in_every_view(case, angle)
    assert case.reached_in_s("ego") == pytest.approx(4.0 if leaves or speed < 0.45 else 0.9 / speed, abs=0.06)
    words = [finding.words for finding in found[5]]
    if leaves or speed < 0.91:
        assert (found[4], len(words)) == ("ego", 1)
        assert re.search(r"other, (a part of )?which had (been in|changed to)", words[0])
    else:
        assert (found[4], words) == ("nobody can tell", [])


@settings(max_examples=examples(10), deadline=None)
@given(phase=st.floats(0.1, 0.9), angle=ANGLES)
def test_lane_change_after_the_contact_has_no_part_in_it(phase, angle):
    """In a step of 1 s the vehicle drives into the one ahead, and then SUMO changes its lane."""
    end = 1 - phase
    case = record(drives(20.0, changes_s=end, to=4.0), drives(5.0, x=5.0), phase=phase)
    assert case.scenes[-1].points[0][1] == 4.0
    found = same_in_every_view(case, angle)
    assert found[:5] == ("rear end", "ego", "ego", (), "ego")
    assert case.changed_s("ego") is None


@settings(max_examples=examples(10), deadline=None)
@given(phase=st.floats(0.1, 0.7), angle=ANGLES)
def test_type_is_that_of_the_contact_not_of_the_end_of_the_step(phase, angle):
    """The vehicle ahead is driven into, and turns off in the rest of the step."""

    def turns(t):
        turned = 0.0 if t <= 1e-9 else 1.0 * t / (1 - phase)
        return 5.0 + 3.0 * t, 0.0, turned, 3.0

    case = record(drives(20.0), turns, phase=phase)
    assert case.scenes[-1].headings[1] == pytest.approx(1.0)
    assert same_in_every_view(case, angle)[:2] == ("rear end", "ego")


def stood(since_s):
    """Faces the traffic along the x axis; it has stood for some time before the contact."""
    return lambda t: (5.0 - 9.0 * min(0.0, t + since_s), 0.3, math.pi, 9.0 if t < -since_s else 0.0)


@pytest.mark.parametrize(("since_s", "manner"), [(0.5, "head-on"), (1.5, "standing vehicle"), (99, "standing vehicle")])
def test_vehicle_that_has_stood_is_not_met_head_on(since_s, manner):
    case = record(drives(12.0), stood(since_s), step_s=0.1)
    assert (case.manner, case.standing) == (manner, "other" if manner != "head-on" else "")
    swapped = record(stood(since_s), drives(12.0), step_s=0.1)
    assert (swapped.manner, swapped.standing) == (manner, "ego" if manner != "head-on" else "")


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, math.pi])
def test_obstacle_has_no_direction(heading):
    """highway-env's obstacles have a heading, by which they were a rear end, a crossing or head-on."""
    case = record(drives(12.0), lambda _t: (5.0, 0.0, heading, 0.0), step_s=0.1)
    other = replace(ROSTER.actors[1], kind="Obstacle")
    roster = Roster((ROSTER.actors[0], other))
    scenes = [Scene(one.time_s, roster, one.points, one.headings, one.speeds) for one in case.scenes]
    assert replace(case, scenes=scenes).manner == "obstacle"


def test_red_light_ends_where_the_vehicle_has_left_the_junction():
    case = record(drives(10.0), drives(5.0, x=5.0), lanes=LaneMap((), (0.0, 0.0)))
    red = Event("red_light", "ego", "ego ran a red light", lane="after_0")
    inside = replace(red, lane=":c_0_0")
    assert case.is_past(red, -1.0)  # 10 m further, and it is 5 m long
    assert not case.is_past(red, 0.0)
    assert not case.is_past(inside, -1.0)
    in_lane = {lane: replace(case, lane=lane).is_past(inside, 0.0) for lane in (":c_3_0", "after_0", ":d_0_0")}
    assert in_lane == {":c_3_0": False, "after_0": False, ":d_0_0": True}  # it is in the next junction
    assert not replace(case, lane=":d_0_0").is_past(replace(inside, agent="other"), 0.0)


def collision(collider, *speeds):
    role, victim = ("collider", "other") if collider == "ego" else ("victim", "ego")
    return Collision("ego", role, collider, victim, ("reported",), "collision", 0.0, 0.0, "", *speeds)


@pytest.mark.parametrize("collider", ["ego", "other"])
def test_speeds_at_a_contact_within_a_step_are_those_reported(collider):
    """After highway-env's contacts, the vehicles brake until the step ends."""
    speeds = {"ego": 30.0, "other": 20.0}
    hit = collision(collider, *sorted(speeds.values(), reverse=collider == "ego"))
    slowed = {"ego": drives(26.0), "other": drives(17.0, x=5.0)}
    case = record(*slowed.values(), step_s=0.2, swept=False, reported=hit)
    assert {actor: case.speed_at_contact(actor) for actor in speeds} == speeds
    for unknown in (None, replace(hit, collider_speed=math.nan, victim_speed=math.nan)):
        case = record(*slowed.values(), step_s=0.2, swept=False, reported=unknown)
        assert [case.speed_at_contact(actor) for actor in speeds] == [26.0, 17.0]
    swept = record(drives(26.0), drives(17.0, x=5.0), step_s=0.2, reported=hit)
    assert swept.speed_at_contact("ego") == 26.0


@pytest.mark.parametrize(
    ("collider", "speeds", "swept", "verdict"),
    [
        ("ego", (30.0, 20.0), False, True),
        ("ego", (20.0, 30.0), False, False),  # a slower one does not drive into the back of a faster one
        ("ego", (20.0, 20.0), False, True),
        ("other", (20.0, 30.0), False, False),
        ("other", (20.0, 30.0), True, True),  # within a step of SUMO, the scenes say more than its report
    ],
)
def test_contact_within_a_step_that_the_scene_after_it_contradicts_has_no_verdict(collider, speeds, swept, verdict):
    hit = collision(collider, *speeds)
    case = record(drives(26.0), drives(17.0, x=5.0), step_s=0.2, swept=swept, reported=hit)
    assert case.is_disputed is not verdict
    assert (case.manner == "rear end") is verdict
    assert (fault_in(case).verdict == "ego") is verdict


@pytest.mark.parametrize(
    ("gap_m", "reported", "verdict"), [(1.4, "other", False), (1.4, "ego", True), (0.9, "other", True)]
)
def test_reported_collision_that_the_outlines_contradict_has_no_verdict(gap_m, reported, verdict):
    """SUMO reports collisions of vehicles whose outlines do not touch, here with the vehicle ahead as the collider."""
    case = record(drives(15.0), drives(8.0, x=5.0 + gap_m), step_s=0.2, reported=collision(reported))
    assert case.touch.gap_m == pytest.approx(gap_m, abs=0.01)
    assert (case.manner == "rear end") is verdict
    assert (fault_in(case).verdict == "ego") is verdict
    assert bool(case.follower) is verdict


# Distances, speeds and lanes at a contact, as numbers.


def brakes(speed, deceleration):
    """Drives along the x axis, brakes all the time, and has this speed at the contact."""
    return lambda t: (speed * t - deceleration * t**2 / 2, 0.0, 0.0, speed - deceleration * t)


def with_lanes(case, lanes_at):
    """Give the actors the lanes that a function of the time returns."""
    scenes = [
        Scene(one.time_s, one.roster, one.points, one.headings, one.speeds, lanes=lanes_at(one.time_s))
        for one in case.scenes
    ]
    return replace(case, scenes=scenes)


def test_speeds_and_decelerations_before_a_contact():
    case = record(brakes(15.0, 2.0), drives(8.0, x=5.0), step_s=0.5)
    assert [case.speed_mps("ego", before_s) for before_s in (3.0, 1.0, 99.0)] == pytest.approx([21.0, 17.0, 23.0])
    assert (case.slowed("ego", 3.0), case.slowed("other", 3.0)) == pytest.approx((2.0, 0.0))
    assert (case.hardest_braking("ego"), case.hardest_braking("other")) == pytest.approx((2.0, 0.0))
    assert case.slowed("ego", 0.5) == 0.0  # no time has passed
    pressed = record(lambda t: (15 * t, 0.0, 0.0, 10.0 if t > -1.1 else 15.0), drives(8.0, x=5.0), step_s=0.5)
    assert (pressed.hardest_braking("ego"), pressed.slowed("ego", 3.0)) == pytest.approx((10.0, 2.0))


def test_actor_that_was_away_before_is_followed_since_it_came_back():
    case = record(drives(15.0), drives(8.0, x=5.0), step_s=0.5)
    alone = Roster(ROSTER.actors[:1])
    scenes = [
        Scene(one.time_s, alone, one.points[:1], one.headings[:1], one.speeds[:1]) if -3.1 < one.time_s < -1.9 else one
        for one in case.scenes
    ]
    case = replace(case, scenes=scenes)
    assert [scene.time_s for scene in case.before] == [-1.5, -1.0, -0.5]
    assert case.times[0] == pytest.approx(1.5)


def test_lanes_say_who_was_in_a_junction():
    straight = record(drives(10.0), drives(5.0, x=5.0), step_s=0.5)
    case = with_lanes(straight, lambda time_s: (":j_0_0" if -2.1 < time_s < -0.9 else "road_0", "road_0"))
    assert [case.was_in_junction("ego", before_s) for before_s in (0.0, 1.0, 2.0, 2.5)] == [False, True, True, False]
    assert not case.was_in_junction("other", 1.0)
    assert [case.is_between_junctions(*who) for who in (("other",), ("ego",), ("ego", "other"))] == [True, False, False]
    assert not straight.is_between_junctions("ego")  # no simulator but SUMO names its lanes
    assert not straight.was_in_junction("ego", 0.0)
    unknown = with_lanes(straight, lambda time_s: ("" if time_s == -1.0 else "road_0", "road_0"))
    assert not unknown.is_between_junctions("ego")


def test_connections_are_looked_up_by_the_lanes_and_the_last_place():
    rights = SimpleNamespace(places=lambda lanes, x, y: (lanes, x, y))
    case = record(drives(10.0), drives(5.0, x=5.0, y=2.0), step_s=0.5, right_of_way=rights, lane=":j_1_0", seconds=20.0)
    case = with_lanes(case, lambda time_s: ("a_0" if time_s < -12.1 else "" if time_s < -11.1 else "b_0", "c_0"))
    (lanes, x, y), (others, other_x, other_y) = case.links("ego"), case.links("other")
    assert (set(lanes), lanes[-1]) == ({"b_0", ":j_1_0"}, ":j_1_0")  # those of the last 12 s
    assert set(others) == {"c_0"}
    assert (x, y, other_x, other_y) == pytest.approx((-5.0, 0.0, 2.5, 2.0))


@pytest.mark.parametrize("names", [("person 1", "other"), ("ego", "person 1")])
def test_contact_with_a_person_has_its_own_type(names):
    roster = Roster(tuple(replace(actor, id=name) for actor, name in zip(ROSTER.actors, names, strict=True)))
    case = record(drives(15.0), drives(8.0, x=5.0), step_s=0.5)
    scenes = [Scene(one.time_s, roster, one.points, one.headings, one.speeds) for one in case.scenes]
    assert replace(case, scenes=scenes, agent=names[0], other=names[1]).manner == "pedestrian"


@pytest.mark.parametrize(("side", "words"), [(1, "crossing from the right"), (-1, "crossing from the left")])
def test_crossing_at_an_acute_angle_names_its_side(side, words):
    heading = side * math.radians(50)
    c, s = math.cos(heading), math.sin(heading)
    case = record(drives(12.0), lambda t: (4.5 + 6 * c * t, side * 1.0 + 6 * s * t, heading, 6.0), step_s=0.1)
    assert case.manner == words
    assert not case.same_way
    slight = side * math.radians(45.5)
    c, s = math.cos(slight), math.sin(slight)
    assert not record(drives(12.0), lambda t: (4.5 + 6 * c * t, 6 * s * t, slight, 6.0), step_s=0.1).same_way


def test_both_that_jump_into_each_other_are_named_the_agent_first():
    case = record(drives(10.0, y=-4.0, changes_s=0.0), drives(10.0, x=1.0, y=4.0, changes_s=0.0), step_s=0.5)
    assert case.jumpers == ("ego", "other")
    only = record(drives(10.0), drives(10.0, x=1.0, y=4.0, changes_s=0.0), step_s=0.5)
    assert only.jumpers == ("other",)
    assert only.meets_sideways("other")
    assert not only.meets_sideways("ego")


def test_lane_changes_count_from_the_given_time_on():
    case = record(drives(15.0, y=-4.0, changes_s=-2.0), drives(8.0, x=5.0), step_s=0.5)
    assert [case.lane_changers(within_s) for within_s in (1.0, 1.5, 3.0)] == [(), (), ("ego",)]
    assert case.changed_s("ego") == pytest.approx(2.0)
    assert [case.drifted(actor) for actor in ("ego", "other")] == [True, False]
    assert [case.was_off_path("ego", back) for back in (0, 20, -1)] == [True, True, False]


def test_lane_that_is_left_in_the_step_of_a_head_on_contact_counts_where_both_scenes_are_in_the_window():
    """Its centre comes over the border between the last scene before the contact, 0.25 s earlier, and the next one.

    In a side swipe, a part of a vehicle in the next lane is enough, and would hide whether this is noticed.
    """

    def drifts(t):
        return 10.0 * t, 2.0 + 0.2 * t, 0.0, 10.0

    def comes_towards_it(t):
        return 5.0 - 10.0 * t, 3.0, math.pi, 10.0

    case = record(drifts, comes_towards_it, step_s=0.5, phase=0.5)
    assert case.manner == "head-on"
    assert [case.lane_changers(within_s) for within_s in (0.2, 0.3, 3.0)] == [(), ("ego",), ("ego",)]
    assert [case.changed_s(actor) for actor in ("ego", "other")] == [case.times[-1], None]
    assert not case.is_changing("ego")  # it has changed
    ended = replace(case, scenes=case.scenes[:-1])  # and the step of the contact is unknown
    assert ended.lane_changers(3.0) == ()


def test_record_of_scenes_has_their_first_and_last_time():
    scenes = record(drives(15.0), drives(8.0, x=5.0), step_s=0.5).scenes
    found = record_in(scenes, collision("ego"))
    assert (found.time_s, found.began_s, found.swept, found.agent, found.other) == (0.0, -8.0, True, "ego", "other")
    assert record_in(scenes, replace(collision("ego"), kind="crashed")).swept is False
    assert record_in(scenes, replace(collision("ego"), victim="gone")) is None
    assert record_in([], collision("ego")) is None
    gone = Scene(1.0, Roster(ROSTER.actors[:1]), [(0.0, 0.0)], [0.0], [1.0])
    assert record_in([*scenes, gone], collision("ego")) is None


def test_record_of_a_bundle_has_the_time_of_the_touch():
    bundle = find_bundle(FROZEN, "")
    found, hit = contact_record(bundle), bundle.result.collision
    scenes = bundle.recording().scenes()
    assert (found.agent, found.other, found.collider) == ("ego", "leader", "ego")
    assert found.time_s == hit.time_s < scenes[-1].time_s  # within the last step
    assert (found.began_s, len(found.scenes), found.swept) == (scenes[0].time_s, len(scenes), True)
    end_s, step_s = scenes[-1].time_s, bundle.recording().prologue.step_length_s
    for time_s, known in ((end_s + 9, False), (end_s, True), (end_s - step_s, True), (end_s - 1.5 * step_s, False)):
        touched = replace(bundle, result=replace(bundle.result, collision=replace(hit, time_s=time_s)))
        assert contact_record(touched).time_s == (time_s if known else end_s)
    alone = replace(bundle, result=replace(bundle.result, collision=replace(hit, victim="", role="alone")))
    assert contact_record(alone) is None
    assert contact_record(replace(bundle, result=replace(bundle.result, collision=None))) is None
