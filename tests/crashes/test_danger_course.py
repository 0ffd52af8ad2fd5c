"""The danger of a crash over time, where the agent is not there all the time, and some steps have no scene."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.crashes import closest_actors, danger_course, most_dangerous
from crashhunt.recording import Prologue, StepRecord
from crashhunt.report._encounter_words import about_danger
from crashhunt.world import Actor, Roster, Scene

CARS = tuple(Actor(name, "car", 5.0, 2.0) for name in ("ego", "ahead"))
BOTH, ALONE = Roster(CARS), Roster(CARS[1:])
DT = 0.1


def recording(steps, there):
    """The ego follows with 10 m between them, at 10 m/s."""
    scenes = []
    for step in range(steps):
        ahead = (15.0 + step, 0.0)
        scenes.append(
            Scene(step * DT, BOTH, [(float(step), 0.0), ahead], [0.0, 0.0], [10.0, 10.0])
            if step in there
            else Scene(step * DT, ALONE, [ahead], [0.0], [10.0])
        )
    records = [StepRecord(number, scene) for number, scene in enumerate(scenes)]
    records.append(StepRecord(steps, None))
    return SimpleNamespace(all_steps=records, scenes=lambda: scenes, prologue=Prologue((), DT))


def test_there_is_none_where_the_agent_is_not_and_at_the_end_where_no_one_knows():
    found = danger_course(recording(100, range(20, 90)), "ego")
    assert found.steps == range(100)
    assert np.isnan(found.own[:20]).all()
    assert np.isnan(found.own[90:]).all()
    assert found.own[21:60] == pytest.approx(np.exp(-1 / 1.2), abs=0.02)
    assert found.greatest.other == "ahead"
    assert 20 <= found.greatest.step < 90
    assert found.of_step(30) == (found.own[30], 0.0)
    assert found.of_step(100) is None
    assert np.isnan(found.behind[50:]).all()  # 4 s before the agent is seen for the last time
    assert (found.behind[20:50] == 0.0).all()
    assert danger_course(recording(5, ()), "ego") is None


@pytest.mark.parametrize(
    ("agents", "steps", "other"), [(["ego"], 30, "ahead"), (["ahead"], 30, None), (["ego"], 0, None)]
)
def test_most_dangerous_moment_is_of_an_agent_with_an_actor_in_its_way(agents, steps, other):
    trial = recording(steps, range(20))
    trial.agents = agents
    found = most_dangerous(trial)
    assert (found and (found.agent, found.other)) == (other and ("ego", other))


@pytest.mark.parametrize("turn", [0.0, 0.9, -2.3])
def test_lane_change_counts_the_vehicle_behind_in_the_target_lane(turn):
    """The ego jumps in front of a faster vehicle, 2 m ahead of it; its own way leads through no actor."""
    c, s = math.cos(turn), math.sin(turn)

    def course(other_speed=20.0, ahead=7.0, lane=0.0, heading=0.0):
        scenes = []
        for step in range(40):
            end = (step - 20) * DT
            poses = [
                (ahead + 10.0 * end, -3.2 if step < 20 else 0.0, 0.0),
                (other_speed * end, lane, heading),
            ]
            points = [(c * x - s * y, s * x + c * y) for x, y, _ in poses]
            scenes.append(Scene(step * DT, BOTH, points, [h + turn for *_, h in poses], [10.0, other_speed]))
            if end > 0:
                break
        records = [StepRecord(number, scene) for number, scene in enumerate(scenes)]
        return danger_course(
            SimpleNamespace(all_steps=records, scenes=lambda: scenes, prologue=Prologue((), DT)), "ego"
        )

    found = course()
    assert found.own[20] == pytest.approx(math.exp(-2.0 / 20.0 / 1.2))
    assert (found.greatest.step, found.greatest.other) == (20, "ahead")
    assert found.nearest[0] == "ahead"
    assert found.nearest[1] == pytest.approx(1.0, abs=1e-6)  # a step later
    for other in (course(lane=6.4), course(heading=math.pi), course(ahead=-7.0, other_speed=9.0)):
        assert other.greatest.step != 20 or other.greatest.danger == 0.0
    calm = replace(found, greatest=found.greatest._replace(danger=0.0))
    assert "no actor" not in about_danger(calm, partner="ahead")
    assert about_danger(found, partner="ahead").startswith("Criticality of ego: at most")
    assert about_danger(found, partner="behind").startswith("Criticality of ego before the contact: at most")
    at_contact = replace(found, greatest=found.greatest._replace(step=found.steps[-1]))
    assert about_danger(at_contact, partner="behind").startswith("Criticality of ego: at most")
    words = about_danger(calm)
    assert "no actor was on its way; ahead came nearest, 1.0 m away after step 21" in words
    assert "no actor came within 50 m" in about_danger(
        replace(found, greatest=found.greatest._replace(danger=0.0), nearest=None)
    )


@pytest.mark.parametrize(
    ("mover", "bends", "counts"), [("ego", False, True), ("ahead", False, False), ("ego", True, False)]
)
def test_gradual_lane_change_counts_the_vehicle_behind_in_the_target_lane(mover, bends, counts):
    """The mover needs 3 s for 3.2 m to the side; the ego is ahead of the other vehicle all the time."""
    scenes = []
    for step in range(60):
        time_s = step * DT
        aside = 3.2 * min(1.0, max(0.0, (time_s - 1.0) / 3.0))
        turned = 0.1 * time_s * bends
        poses = {"ego": (20.0 + 10.0 * time_s, 0.0), "ahead": (12.0 * time_s, -3.2)}
        sides = {"ego": -aside, "ahead": aside}
        points = [(x, y + (sides[name] if name == mover else 0.0)) for name, (x, y) in poses.items()]
        scenes.append(Scene(time_s, BOTH, points, [turned, turned], [10.0, 12.0]))
    records = [StepRecord(number, scene) for number, scene in enumerate(scenes)]
    course = danger_course(SimpleNamespace(all_steps=records, scenes=lambda: scenes, prologue=Prologue((), DT)), "ego")
    entered = next(n for n, one in enumerate(scenes) if abs(one.points[0][1] - one.points[1][1]) <= 2.0)
    gap_m = scenes[entered].points[0][0] - 5.0 - scenes[entered].points[1][0]
    assert gap_m > 0
    expected = math.exp(-gap_m / 12.0 / 1.2)
    if counts:
        assert course.own[entered] == pytest.approx(expected)
        assert (course.greatest.step, course.greatest.other) == (entered, "ahead")
        assert not course.own[entered + 1] >= expected  # the moment of the change counts, not each step after it
    else:
        assert course.greatest.danger == 0.0


def test_least_time_and_gap_have_the_name_of_their_actor():
    """Time to collision with one vehicle, gap to another; of two that are equally near, none is named."""
    names = Roster(tuple(Actor(name, "car", 5.0, 2.0) for name in ("ego", "slow", "side", "other side")))

    def closest(*places):
        points = [(0.0, 0.0), (30.0, 0.0), *places]
        scenes = [Scene(0.0, names, points, [0.0] * 4, [10.0, 4.0, 10.0, 10.0])]
        records = [StepRecord(0, scenes[0])]
        found = SimpleNamespace(all_steps=records, scenes=lambda: scenes, prologue=Prologue((), DT))
        return closest_actors(found, "ego")

    assert closest((1.0, 3.5), (1.0, -4.0)) == [("slow", "side")]
    assert closest((1.0, 4.0), (1.0, -3.5)) == [("slow", "other side")]
    assert closest((1.0, 3.5), (1.0, -3.5)) == [("slow", "")]
    assert closest_actors(recording(3, (1,)), "ego") == [("", ""), ("", "ahead"), ("", "")]


@pytest.mark.parametrize("turn", [0.0, 1.2, -2.3])
@pytest.mark.parametrize(("ahead_m", "behind_m", "nearest"), [(3.0, 3.5, "ahead"), (3.5, 3.0, "behind")])
def test_nearest_actor_is_the_one_with_the_least_gap_between_outlines(turn, ahead_m, behind_m, nearest):
    """The three stand in a line; a point is the middle of a front."""
    c, s = math.cos(turn), math.sin(turn)
    fronts = (0.0, ahead_m + 5.0, -5.0 - behind_m)
    standing = Roster((*CARS, Actor("behind", "car", 8.0, 2.5)))
    scene = Scene(0.0, standing, [(c * x, s * x) for x in fronts], [turn] * 3, [0.0] * 3)
    trial = SimpleNamespace(all_steps=[StepRecord(0, scene)], scenes=lambda: [scene], prologue=Prologue((), DT))
    assert danger_course(trial, "ego").nearest == (nearest, pytest.approx(3.0), 0)
