"""Motions of the manoeuvres of UN R157, against closed forms of what each manoeuvre is."""

from __future__ import annotations

import math
from itertools import islice, pairwise

import numpy as np
import pytest
from conftest import examples
from hypothesis import assume, given, settings, strategies as st

from crashhunt.world import START_M, manoeuvre_motions

LENGTH_M, WIDTH_M, MOTORCYCLE_M = 4.3, 1.9, 2.2
LANES = [(-5.25, -1.75), (-1.75, -5.25)]  # own and next
KMH = 3.6

lanes, step_lengths = st.sampled_from(LANES), st.sampled_from([0.05, 0.1, 0.25])
kmh, headways, small = st.floats(20, 130), st.floats(0.5, 3), st.floats(-1, 1)


def tracks(manoeuvre, values, of_lanes, step_s, steps=200):
    """Return the columns x, y, heading and speed of each road user, from the step in which it appears."""
    found = {}
    for row in islice(manoeuvre_motions(manoeuvre, values, *of_lanes, step_s), steps + 1):
        for name, state in row.items():
            found.setdefault(name, []).append((state.x, state.y, state.heading, state.speed))
    return {name: np.array(rows).T for name, rows in found.items()}


def drives_straight(track, step_s):
    """Whether the position changes along the road by the speed of the same step."""
    x, _, heading, speed = track
    return np.allclose(np.diff(x), speed[1:] * step_s) and not heading.any()


def is_at(track, x, y, heading, speed):
    return all(np.allclose(*pair) for pair in zip(track, (x, y, heading, speed), strict=True))


@settings(max_examples=examples(25))
@given(lanes, step_lengths, kmh, st.floats(0, 20), st.floats(0.3, 2), st.floats(1, 50), st.booleans())
def test_vehicle_cuts_in_with_its_gap_when_the_lateral_speed_is_full(
    own_next, step_s, ego, slower, full, gap, absolute
):
    other = {"other_kmh": ego - slower} if absolute else {"slower_kmh": slower}
    values = {"ego_kmh": ego, "lateral_mps": full, "gap_m": gap} | other
    x, y, _, speed = track = tracks("cut_in", values, own_next, step_s)["other"]
    assert drives_straight(track, step_s)
    assert speed * KMH == pytest.approx(ego - slower)
    own_y, next_y = own_next
    lateral = np.diff(y) / step_s * np.sign(own_y - next_y)
    begun = next(step for step in range(1, 200) if lateral[step - 1] > full - 1e-9)
    assert x[begun] - LENGTH_M - START_M - ego / KMH * begun * step_s == pytest.approx(gap)
    assert y[begun] == pytest.approx(next_y)
    assert lateral[:begun] == pytest.approx(np.minimum(full, 1.5 * step_s * np.arange(1, begun + 1)))
    arrives = begun + math.floor(3.5 / full / step_s - 1e-9)
    assert lateral[begun:arrives] == pytest.approx(full)
    assert y[arrives + 1 :] == pytest.approx(own_y)


@settings(max_examples=examples(25))
@given(lanes, step_lengths, kmh, headways, st.floats(5, 100), st.floats(0.5, 3))
def test_vehicle_leaves_the_lane_or_stops_behind_the_standing_one(own_next, step_s, ego, headway, front, full):
    speed, (own_y, next_y) = ego / KMH, own_next
    last = math.ceil(front / (speed * step_s) - 1)  # the step after which its front would reach the standing vehicle
    aside = min(full * max(0, last) * step_s, 3.5)
    assume(abs(front / (speed * step_s) % 1 - 0.5) < 0.49)
    assume(abs(aside - WIDTH_M) > 1e-6)
    values = {"ego_kmh": ego, "headway_s": headway, "front_m": front, "lateral_mps": full}
    found = tracks("cut_out", values, own_next, step_s, steps=400)
    leader, standing = found["leader"], found["standing"]
    assert drives_straight(leader, step_s)
    assert leader[0, 0] - LENGTH_M - START_M == pytest.approx(headway * speed)
    assert (standing == standing[:, [0]]).all()
    assert standing[:, 0] == pytest.approx([leader[0, 0] + front + LENGTH_M, own_y, 0, 0])
    moves = np.arange(401) if aside > WIDTH_M else np.minimum(np.arange(401), max(0, last))
    assert leader[0] == pytest.approx(leader[0, 0] + speed * step_s * moves)
    assert leader[1] == pytest.approx(own_y + math.copysign(1, next_y - own_y) * np.minimum(full * step_s * moves, 3.5))


@settings(max_examples=examples(10))
@given(lanes, step_lengths, kmh, headways, st.floats(0.5, 8))
def test_vehicle_ahead_brakes_to_a_stand(own_next, step_s, ego, headway, rate):
    times = np.arange(201) * step_s
    for given_rate in (rate, lambda time_s: rate if time_s < 1 else 0.0):
        values = {"ego_kmh": ego, "headway_s": headway, "decel_mps2": given_rate}
        track = tracks("deceleration", values, own_next, step_s)["leader"]
        braked = times if given_rate == rate else np.minimum(times, math.ceil(1 / step_s) * step_s)
        assert drives_straight(track, step_s)
        assert track[3] == pytest.approx(np.maximum(0, ego / KMH - rate * braked))
        assert track[0, 0] - LENGTH_M - START_M == pytest.approx(headway * ego / KMH)
        assert track[1] == pytest.approx(own_next[0])


@settings(max_examples=examples(10))
@given(lanes, step_lengths, kmh, headways, small, st.floats(2, 20), st.floats(-20, 20))
def test_vehicle_ahead_swerves_and_another_drives_in_the_next_lane(
    own_next, step_s, ego, headway, swerve, period, beside
):
    values = {"ego_kmh": ego, "headway_s": headway, "swerve_m": swerve, "period_s": period, "beside_m": beside}
    found, times = tracks("lane_keeping", values, own_next, step_s), np.arange(201) * step_s
    x, y = START_M + ego / KMH * times, own_next[0] + swerve * np.sin(2 * np.pi * times / period)
    assert is_at(found["leader"], x + headway * ego / KMH + LENGTH_M, y, 0, ego / KMH)
    assert is_at(found["beside"], x + beside, own_next[1], 0, ego / KMH)


@settings(max_examples=examples(10))
@given(lanes, step_lengths, kmh, headways, small, st.floats(1, 160), st.floats(2, 20))
def test_speed_of_the_vehicle_ahead_oscillates_or_follows_a_profile(
    own_next, step_s, ego, headway, offset, slower, period
):
    values = {"ego_kmh": ego, "headway_s": headway, "offset_m": offset, "slower_kmh": slower, "period_s": period}
    track, times = tracks("following", values, own_next, step_s)["leader"], np.arange(201) * step_s
    wave = np.sin(np.pi * times / period) ** 2
    assert track[3] * KMH == pytest.approx(np.maximum(0, ego - slower * wave), abs=1e-6)
    assert track[:2, 0] == pytest.approx([START_M + headway * ego / KMH + LENGTH_M, own_next[0] + offset])
    assert drives_straight(track, step_s)
    jumps = values | {"slower_kmh": lambda time_s: slower if 2 <= time_s < 7 else 0.0}
    found = tracks("following", jumps, own_next, step_s)["leader"][3]
    down, up = np.maximum(0, 10 * (times - 2 + step_s)), np.maximum(0, 10 * (times - 7 + step_s))
    lost = min(slower, ego) / KMH
    exact = (np.abs(times - 2) > step_s / 2) & (np.abs(times - 7) > step_s / 2)  # where rounding decides the step
    assert found[exact] == pytest.approx(ego / KMH - np.clip(np.minimum(down, lost) - up, 0, None)[exact], abs=1e-6)


@settings(max_examples=examples(10))
@given(lanes, st.floats(10, 200), small, st.floats(1, 30), kmh, st.floats(1, 200))
def test_what_stands_in_the_lane_is_as_far_as_the_arguments_say(own_next, distance, offset, between, ego, seen):
    values = {"ego_kmh": ego, "distance_m": distance, "offset_m": offset, "between_m": between, "seen_m": seen}
    y, end = own_next[0] + offset, START_M + distance + MOTORCYCLE_M
    assert is_at(tracks("blocked_lane", values, own_next, 0.1, 1)["standing"], START_M + distance + LENGTH_M, y, 0, 0)
    found = tracks("multiple_targets", values, own_next, 0.1, 1)
    assert is_at(found["motorcycle"], end, y, 0, 0)
    assert is_at(found["standing"], end + between + LENGTH_M, own_next[0], 0, 0)
    rows = [*islice(manoeuvre_motions("detection_range", values, *own_next, 0.1), 400)]
    appears = max(0, math.ceil((distance - seen) / (ego / KMH * 0.1) - 1e-9))
    assert [bool(row) for row in rows] == [step >= appears for step in range(400)]
    assert is_at(tracks("detection_range", values, own_next, 0.1, 400)["motorcycle"], end, y, 0, 0)


@settings(max_examples=examples(25))
@given(lanes, st.sampled_from([-1, 1]), kmh, st.floats(20, 120), st.floats(1, 12), small)
def test_person_is_at_the_impact_when_a_constant_speed_arrives(own_next, side, ego, distance, walk, impact):
    values = {"distance_m": distance, "walk_kmh": walk, "impact_m": impact, "from_side": side}
    right, left = min(LANES[0]) - 3.5, max(LANES[0]) + 3.5  # where the person stands before and after
    times, walks = np.arange(401) * 0.1, walk / KMH
    for speed in (ego / KMH, 0.5, 0.0):
        (x, y, heading, walked) = tracks("pedestrian", values | {"ego_kmh": speed * KMH}, own_next, 0.1, 400)[
            "person walker"
        ]
        begin = own_next[0] + side * (impact + walks * distance / speed) if speed else left if side > 0 else right
        place = begin - side * walks * times
        assert y == pytest.approx(np.clip(place, right, left))
        assert x == pytest.approx(START_M + distance)
        assert heading == pytest.approx(-side * math.pi / 2)
        clear = np.minimum(np.abs(place - right), np.abs(place - left)) > 1e-6
        assert walked[clear] == pytest.approx(np.where((place > right) & (place < left), walks, 0)[clear])
    profile = values | {"ego_kmh": ego, "walk_kmh": lambda time_s: walk + time_s}
    y = tracks("pedestrian", profile, own_next, 0.1, 400)["person walker"][1]
    arrives = math.ceil(distance / (ego / KMH) / 0.1 - 1e-9)
    assert y[arrives] == pytest.approx(own_next[0] + side * impact)
    inside = [
        step for step, (one, other) in enumerate(pairwise(y)) if right < min(one, other) and max(one, other) < left
    ]
    assert -side * np.diff(y)[inside] == pytest.approx((walk + times[inside]) / KMH * 0.1)
