"""Two on the road: how they stand, and when braking is too late, in cases that can be calculated by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from crashhunt.crashes import Encounter, last_escape
from crashhunt.crashes._encounter import Position
from crashhunt.recording import Prologue, StepRecord
from crashhunt.world import Actor, Roster, Scene

CAR = (5.0, 2.0)


def recording(*steps, dt=0.1, sizes=None, turned=0.0, **more):
    """Each step is a dict of id to (x, y, heading, speed), or None where the process ended within it."""
    c, s = math.cos(turned), math.sin(turned)

    def scene(number, rows):
        actors = tuple(Actor(name, "passenger", *(sizes or {}).get(name, CAR)) for name in rows)
        points = [(x * c - y * s, x * s + y * c) for x, y, *_ in rows.values()]
        headings, speeds = [row[2] + turned for row in rows.values()], [float(row[3]) for row in rows.values()]
        return Scene(number * dt, Roster(actors), points, headings, speeds, **more)

    records = [StepRecord(number, rows and scene(number, rows)) for number, rows in enumerate(steps)]
    return SimpleNamespace(
        all_steps=records,
        scenes=lambda: [record.scene for record in records if record.scene is not None],
        prologue=Prologue((), dt),
    )


def follow(*, speed, gap, leader=0.0, dt=0.1, **more):
    """The ego behind a leader, both at constant speed, until they touch."""
    steps = []
    while True:
        time = len(steps) * dt
        own, ahead = speed * time, gap + 5.0 + leader * time
        steps.append({"ego": (own, 0.0, 0.0, speed), "other": (ahead, 0.0, 0.0, leader)})
        if ahead - 5.0 <= own - 1e-6:
            return recording(*steps, dt=dt, **more)


@pytest.mark.parametrize("turned", [0.0, 1.2, -2.0])
@pytest.mark.parametrize("leader", [0.0, 4.0, 9.0])
def test_the_last_escape_behind_a_leader_that_moves_on(leader, turned):
    """Against a leader at constant speed, it is the difference of speeds that has to be braked away."""
    speed, braking, dt = 20.0, 6.0, 0.1
    needed = (speed - leader) ** 2 / (2 * braking)
    episode = follow(speed=speed, gap=needed + 25, leader=leader, turned=turned)
    found = last_escape(episode, "ego", "other", braking=braking)
    gaps = {moment.step: moment.gap_m for moment in Encounter(episode, "ego", "other").moments}
    slack = (speed - leader) * dt
    assert gaps[found] >= needed - 0.01
    assert gaps[found + 1] < needed + 0.01 + slack * 0.01
    harder = last_escape(episode, "ego", "other", braking=9.0)
    assert harder > found
    assert gaps[harder] >= (speed - leader) ** 2 / 18 - 0.01 > gaps[harder + 1] - 0.02


def test_the_leader_continues_where_the_recording_ends():
    """It brakes in the end of the recording: what counts after it is its last speed."""
    steps, own, ahead = [], 0.0, 30.0
    for number in range(60):
        leader = 12.0 if number < 20 else max(6.0, 12.0 - (number - 20) * 1.0)
        steps.append({"ego": (own, 0.0, 0.0, 15.0), "other": (ahead, 0.0, 0.0, leader)})
        if ahead - 5 <= own:
            break
        own, ahead = own + 1.5, ahead + leader * 0.1
    for braking in (3.0, 5.0, 7.0):

        def avoids(start, braking=braking):
            speed, at, number = 15.0, 1.5 * start, start
            while speed > 0:
                slower = max(0.0, speed - braking * 0.1)
                at, speed, number = at + (speed + slower) / 20, slower, number + 1
                recorded = number < len(steps)
                rear = (steps[number]["other"][0] if recorded else ahead + (number - len(steps) + 1) * leader * 0.1) - 5
                if at > rear:
                    return False
            return True

        expected = max(start for start in range(len(steps) - 1) if avoids(start))
        assert last_escape(recording(*steps), "ego", "other", braking=braking) == expected
    standing = follow(speed=15.0, gap=40.0)
    assert last_escape(standing, "ego", "other", braking=5.0) == int((40 - 22.5) / 1.5)


def test_looking_back_has_an_end():
    slow = follow(speed=1.0, gap=60.0, dt=1.0)
    assert last_escape(slow, "ego", "other", braking=0.01) is None  # it would take 50 m
    assert last_escape(slow, "ego", "other", braking=0.0167) is None  # 30 m: more than 30 s before
    assert last_escape(slow, "ego", "other", braking=0.018) is not None  # 28 m


def test_an_outline_that_is_met_within_a_step_counts():
    """At 40 m/s it jumps over a motorcycle between two steps."""
    steps = [{"ego": (20.0 * n, 0.0, 0.0, 40.0), "other": (68.0, 7.5 - 2.0 * n, -math.pi / 2, 4.0)} for n in range(5)]
    episode = recording(*steps, dt=0.5, sizes={"other": (2.0, 0.6)})
    assert last_escape(episode, "ego", "other", braking=60.0) == 2
    assert last_escape(episode, "ego", "other", braking=4.0) is None


@pytest.mark.parametrize("turned", [0.0, 2.2])
def test_braking_follows_the_path_that_was_driven(turned):
    """The other vehicle stands around a corner, and not on the straight line ahead."""
    radius, speed, dt = 20.0, 10.0, 0.1

    def on_path(distance):
        angle = min(max(0.0, distance) / radius, math.pi / 2)
        beyond = max(0.0, distance - radius * math.pi / 2)
        x, y = radius * math.sin(angle) + min(0.0, distance), radius - radius * math.cos(angle) + beyond
        return x, y, angle

    steps = []
    for n in range(400):
        steps.append({"ego": (*on_path(n * speed * dt - 30), speed), "other": (20.0, 35.0, math.pi / 2, 0.0)})
        if steps[-1]["ego"][1] >= 30.0:
            break
    episode = recording(*steps, turned=turned)
    whole = 30 + radius * math.pi / 2 + 10  # to the rear of who stands
    for braking in (4.0, 8.0):
        found = last_escape(episode, "ego", "other", braking=braking)
        assert found * speed * dt == pytest.approx(whole - speed**2 / (2 * braking), abs=1.2)


def test_where_the_other_one_is():
    def at(x, y, heading=0.0, size=CAR, own=CAR):
        sizes = {"ego": own, "other": size}
        centre = {"ego": (own[0] / 2, 0, 0, 1)}
        front = x + size[0] / 2 * math.cos(heading), y + size[0] / 2 * math.sin(heading)
        episode = recording({**centre, "other": (*front, heading, 1)}, sizes=sizes, turned=0.7)
        return Encounter(episode, "ego", "other").position(0)

    assert at(8, 0).place == at(6, 5).place == at(5.1, 5).place == "ahead"
    assert at(-8, 0).place == at(-6, -5).place == "behind"
    assert at(0, 3).place == at(4.9, 1.4).place == at(-4.9, 1.4).place == at(5.1, 5.2).place == "left"
    assert at(0, -3).place == at(4.9, -1.4).place == at(5.5, -6).place == "right"
    narrow = {"own": (5.0, 0.5), "size": (5.0, 0.5)}
    assert (at(0, 0.8, **narrow).place, at(0, -0.8, **narrow).place) == ("left", "right")
    assert at(4.9, 1.3).place == "ahead"  # more ahead than beside, and it is not 4/3 m aside
    assert at(-4.9, -1.3).place == "behind"
    assert at(3.4, 3, math.pi / 2).place == "left"  # across: their lengths overlap by 3.5 m
    assert at(3.6, 3, math.pi / 2).place == "ahead"
    assert at(9.9, 1.7, size=(15.0, 3.0)).place == at(4.9, 1.6, own=(5.0, 3.0), size=(5.0, 1.5)).place == "left"
    assert at(10.1, 1.7, size=(15.0, 3.0)).place == "ahead"
    assert at(8, 0, 3.0).turn == pytest.approx(3.0)
    assert at(8, 0, -3.5).turn == pytest.approx(math.tau - 3.5)
    assert Encounter(recording(), "ego", "other").position(0) is None
    assert Encounter(recording(), "ego", "other").manner(0) is None


def test_where_it_faces():
    faces = {math.radians(degrees): face for degrees, face in (
        (0, "same"), (44, "same"), (-44, "same"), (46, "left"), (-46, "right"), (134, "left"), (-134, "right"),
        (136, "other"), (-136, "other"), (180, "other"),
    )}  # fmt: skip
    assert {turn: Position("ahead", turn).faces for turn in faces} == faces


def test_moments_are_of_the_steps_in_which_both_were_there():
    both = {"ego": (0.0, 0.0, 0.0, 12.0), "other": (17.0, 0.0, 0.0, 4.0)}
    steps = [{"ego": (0.0, 0.0, 0.0, 12.0)}, both, {"other": both["other"]}, {"third": (9, 9, 0, 0), **both}, None]
    moments = Encounter(recording(*steps, dt=0.5), "ego", "other").moments
    assert [(moment.step, moment.time_s) for moment in moments] == [(1, 0.5), (3, 1.5)]
    for moment in moments:
        assert (moment.speed, moment.other_speed, moment.gap_m, moment.closing_speed) == pytest.approx((12, 4, 12, 8))
        assert moment.time_to_collision_s == pytest.approx(1.5)
        assert moment.required_deceleration == pytest.approx(64 / 24)


@pytest.mark.parametrize("turned", [0.0, 1.0])
def test_a_moment_of_two_that_cross_part_or_overlap(turned):
    def moment(ego, other, **more):
        (found,) = Encounter(recording({"ego": ego, "other": other}, turned=turned, **more), "ego", "other").moments
        return found

    crossing = moment((0, 0, 0, 10), (12, -20, math.pi / 2, 8))
    assert crossing.gap_m == pytest.approx(math.hypot(11, 19))
    dx, dy = 12 + 2.5, -22.5
    assert crossing.closing_speed == pytest.approx((dx * 10 - dy * 8) / math.hypot(dx, dy))
    assert crossing.time_to_collision_s == math.inf  # the ego is past when the other one comes
    assert crossing.required_deceleration == 0
    meets = moment((0, 0, 0, 10), (21, -14, math.pi / 2, 8))
    assert meets.time_to_collision_s == pytest.approx(2.0)
    assert meets.required_deceleration == pytest.approx(math.hypot(10, 8) / 4)
    parting = moment((0, 0, 0, 4), (15, 0, 0, 10))
    assert (parting.closing_speed, parting.time_to_collision_s) == (pytest.approx(-6), math.inf)
    inside = moment((0, 0, 0, 10), (4, 0, 0, 8))
    assert (inside.gap_m, inside.time_to_collision_s, inside.required_deceleration) == (0, 0, 0)
    same = moment((0, 0, 0, 10), (0, 0, 0, 8))
    assert same.closing_speed == 0


def test_a_bent_one_is_measured_by_its_parts():
    spine = ((30.0, 10.0, 0.0), (30.0, 0.0, 0.0), (21.0, 0.0, 0.0))
    step = {"ego": (0.0, 0.0, 0.0, 10.0), "other": (30.0, 10.0, math.pi / 2, 0.0)}
    sizes = {"other": (19.0, 2.5)}
    (straight,) = Encounter(recording(step, sizes=sizes), "ego", "other").moments
    assert straight.gap_m == pytest.approx(28.75)
    (bent,) = Encounter(recording(step, sizes=sizes, spines={1: spine}), "ego", "other").moments
    assert (bent.gap_m, bent.time_to_collision_s) == pytest.approx((21, 2.1))
    (seen_from_it,) = Encounter(recording(step, sizes=sizes, spines={1: spine}), "other", "ego").moments
    assert (seen_from_it.gap_m, seen_from_it.time_to_collision_s) == pytest.approx((21, 2.1))
    far = {**step, "ego": (-90.0, 0.0, 0.0, 10.0)}
    (away,) = Encounter(recording(far, sizes=sizes, spines={1: spine}), "ego", "other").moments
    assert away.gap_m == pytest.approx(118.75)  # as if it were straight
    assert away.time_to_collision_s == math.inf
    # The spine of a third actor changes nothing.
    third = {**step, "tram": (99.0, 99.0, 0.0, 0.0)}
    (unbent,) = Encounter(recording(third, sizes=sizes, spines={2: spine}), "ego", "other").moments
    assert unbent.gap_m == pytest.approx(28.75)


@pytest.mark.parametrize(("speed_at_the_end", "found"), [(10.0, 0), (0.0, None)])
def test_crash_within_two_steps_has_an_escape_and_a_stop_short_of_the_other_is_no_crash(speed_at_the_end, found):
    """The rear of the other vehicle is 0.5 m ahead of the agent at the end."""
    other = (14.5, 0.0, 0.0, 0.0)
    steps = [{"ego": (0.0, 0.0, 0.0, 10.0), "other": other}, {"ego": (9.0, 0.0, 0.0, speed_at_the_end), "other": other}]
    assert last_escape(recording(*steps, dt=1.0), "ego", "other", braking=20.0) == found
