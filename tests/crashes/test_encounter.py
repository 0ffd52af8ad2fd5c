from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from conftest import examples
from hypothesis import given, settings, strategies as st

from crashhunt.crashes import Encounter, last_escape
from crashhunt.recording import Prologue, StepRecord
from crashhunt.world import Actor, Roster, Scene

ROSTER = Roster((Actor("ego", "passenger", 5.0, 2.0), Actor("other", "passenger", 5.0, 2.0)))


def recording(*scenes: tuple[tuple[float, float, float, float], tuple[float, float, float, float]]):
    """Each scene is (x, y, heading, speed) of the two; one tenth of a second apart."""
    steps = [
        StepRecord(
            number,
            Scene(number / 10, ROSTER, [v[:2] for v in pair], [float(v[2]) for v in pair], [float(v[3]) for v in pair]),
        )
        for number, pair in enumerate(scenes)
    ]
    return SimpleNamespace(all_steps=steps, prologue=Prologue((), 0.1))


def rear_end(*, speed: float, gap: float, other_speed: float = 0.0):
    """The ego drives at constant speed into somebody ahead, until they touch."""
    scenes, step = [], 0
    while True:
        own, other = step * speed / 10, gap + 5.0 + step * other_speed / 10
        scenes.append(((own, 0.0, 0.0, speed), (other, 0.0, 0.0, other_speed)))
        if other - 5.0 <= own:
            return recording(*scenes)
        step += 1


def test_the_moments_before_a_rear_end_collision():
    moments = Encounter(rear_end(speed=20, gap=39, other_speed=10), "ego", "other").moments
    assert moments[0].gap_m == pytest.approx(39)
    assert moments[0].closing_speed == pytest.approx(10)
    assert moments[0].time_to_collision_s == pytest.approx(3.9)
    assert moments[0].required_deceleration == pytest.approx(100 / 78)
    assert moments[-1].gap_m == 0
    last = moments[-2]
    assert 0 < last.time_to_collision_s < 0.2
    assert last.required_deceleration == pytest.approx(10 / (2 * last.time_to_collision_s))
    assert [moment.step for moment in moments] == list(range(len(moments)))


@given(st.floats(8, 30), st.floats(3, 9))
@settings(deadline=None, max_examples=examples(30))
def test_the_last_escape_is_where_the_braking_distance_states(speed, braking):
    """v² / (2 b) is what is needed to stop; the last step with more room than that is the last escape."""
    episode = rear_end(speed=speed, gap=speed**2 / (2 * braking) + 3.3 * speed)
    found = last_escape(episode, "ego", "other", braking=braking)
    assert found is not None
    gaps = {moment.step: moment.gap_m for moment in Encounter(episode, "ego", "other").moments}
    needed = speed**2 / (2 * braking)
    assert gaps[found] >= needed - 0.1
    assert gaps[found + 1] < needed + 0.1


def test_where_brakes_do_not_help_there_is_no_escape():
    assert last_escape(rear_end(speed=30, gap=20), "ego", "other", braking=8.0) is None
    assert last_escape(recording(((0, 0, 0, 5), (3, 0, 0, 0))), "ego", "other", braking=8.0) is None
    assert Encounter(recording(), "ego", "other").moments == []


@pytest.mark.parametrize(
    ("other", "manner"),
    [
        ((20, 0, 0), "ahead"),
        ((-20, 0, 0.1), "behind"),
        ((20, 3, math.pi), "oncoming"),
        ((10, -10, math.pi / 2), "crossing from the right"),
        ((10, 10, -math.pi / 2), "crossing from the left"),
        ((1, 3, 0), "left"),
        ((1, -3, 0), "right"),
    ],
)
@pytest.mark.parametrize("turned", [0.0, 1.0, 3.0, -2.0])
def test_the_manner_of_an_encounter_does_not_depend_on_the_map(other, manner, turned):
    x, y, heading = other
    c, s = math.cos(turned), math.sin(turned)
    placed = (x * c - y * s, x * s + y * c, heading + turned, 5.0)
    assert Encounter(recording(((0, 0, turned, 5), placed)), "ego", "other").manner(0) == manner
