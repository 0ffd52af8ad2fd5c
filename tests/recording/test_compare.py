"""Where two recordings first differ: everything that is compared, one at a time."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest

from crashhunt.recording import (
    AgentChannel,
    Divergence,
    Prologue,
    Recording,
    Tag,
    encode_actors,
    encode_events,
    encode_heights,
    encode_notes,
    encode_spines,
    first_divergence,
    values_around,
)
from crashhunt.recording._blackbox_file import Record
from crashhunt.trial import Disturbance
from crashhunt.world import Actor, Contact, Event, Roster, Scene

AGENTS = (
    AgentChannel("ego", "<f4", (2, 2), "<f8", (2,), ("target_speed", "lane_change"), ("x", "speed")),
    AgentChannel("other", "<f4", (3,), "<f8", (1,)),
)
ACTORS = (Actor("ego", "passenger", 5.0, 2.0), Actor("other", "truck", 12.0, 2.5), Actor("bus", "bus", 18.0, 2.5))
SPINE = ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))


def recorded(steps=3, *, ego_only_at=None, prologue=None):
    records = [Record(Tag.PROLOGUE, 0, (prologue or Prologue(AGENTS, 0.5)).encode())]
    records.append(Record(Tag.ACTORS, 0, encode_actors(ACTORS)))
    records.append(Record(Tag.ROSTER, 0, np.array([0, 1, 2], "<u4").tobytes()))
    for step in range(steps + 1):
        if step:
            observations = np.arange(4, dtype="<f4") + step, np.arange(3, dtype="<f4") + step
            actions = np.array([10.0 + step, 0.0]), np.array([float(step)])
            for number in range(1 if step == ego_only_at else 2):
                records.append(Record(Tag.OBSERVATION, number, observations[number].tobytes()))
                records.append(Record(Tag.ACTION, number, actions[number].tobytes()))
        scene = Scene(
            step / 2, Roster(ACTORS), [(0, 0)] * 3, [0] * 3, [0] * 3,
            (Contact("ego", "other", "collision", "a_0", 3.0, 1.0),), ("bus",), ("a_0", "a_1", "b_0"),
            (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), {2: SPINE},
        )  # fmt: skip
        for tag, payload in (
            (Tag.LANES, "\n".join(scene.lanes).encode()),
            (Tag.EVENTS, encode_events(scene)),
            (Tag.HEIGHTS, encode_heights(scene)),
            (Tag.SPINES, encode_spines(scene)),
        ):
            records.append(Record(tag, 0, payload))
        values = [step * 10.0 + value for value in range(12)]
        head = np.array([step], "<i8").tobytes() + np.array([step / 2, 0.25, -0.5, *values], "<f8").tobytes()
        records.append(Record(Tag.STEP, 0, head))
    return Recording(records)


def changed(step, change):
    """A recording of which one step is otherwise."""
    other = copy.deepcopy(recorded())
    change(other.all_steps[step])
    return other


def found(step, change):
    divergence = first_divergence(recorded(), changed(step, change))
    return divergence and (
        divergence.step,
        divergence.agent,
        divergence.field,
        divergence.recorded,
        divergence.replayed,
    )


@pytest.mark.parametrize("number", [0, 2, 3])
@pytest.mark.parametrize(
    ("name", "value", "other"),
    [
        ("time_s", None, 77.0),
        ("contacts", None, ()),
        ("off_road", "('bus',)", ("ego",)),
        ("lanes", "('a_0', 'a_1', 'b_0')", ("a_0", "a_1", "b_1")),
        ("heights", "[1.0, 2.0, 3.0]", [1.0, 2.0, 3.5]),
        ("grades", "[0.1, 0.2, 0.3]", [0.1, 0.2, 0.0]),
        ("spines", f"{{2: {SPINE}}}", {2: SPINE[::-1]}),
    ],
)
def test_every_part_of_a_scene_is_compared(number, name, value, other):
    step, agent, field, was, now = found(number, lambda step: setattr(step.scene, name, other))
    assert (step, agent, field) == (number, "", name if name == "time_s" else f"scene.{name}")
    assert now == (other if name == "time_s" else str(other))
    assert was == (number / 2 if name == "time_s" else value) or name == "contacts"


def test_disturbances_that_took_place_are_compared():
    def brakes(how_strong):
        def change(step):
            step.more["disturbance"] = [Disturbance(2, "ahead", "brake", how_strong, 1.0, "ego", "bus")]

        return change

    step, agent, field, was, now = found(2, brakes(3.0))
    assert (step, agent, field, was) == (2, "", "disturbance", "nothing")
    assert now == "bus brakes with 3 m/s² for 1 s (ahead of ego)"
    both = [changed(2, brakes(strong)) for strong in (3.0, 3.0, 4.0, 3.0001)]
    assert first_divergence(both[0], both[1]) is None
    divergence = first_divergence(both[0], both[2])
    assert "3 m/s²" in divergence.recorded
    assert "4 m/s²" in divergence.replayed
    divergence = first_divergence(both[0], both[3])  # in words the same
    assert "'how_strong': 3.0," in divergence.recorded
    assert "'how_strong': 3.0001," in divergence.replayed


@pytest.mark.parametrize(("column", "place"), [("x", 0), ("y", 1), ("heading", 2), ("speed", 3)])
def test_a_value_of_an_actor_is_named(column, place):
    def change(step):
        if column in "xy":
            point = list(step.scene.points[1])
            point[place] = -1.0
            step.scene.points[1] = tuple(point)
        else:
            getattr(step.scene, f"{column}s")[1] = -1.0

    was = recorded().scene(2).data[1, place]
    assert found(2, change) == (2, "other", f"scene.{column}", was, -1.0)
    divergence = first_divergence(recorded(), changed(2, change))
    assert divergence.place == ("scene", (place,))
    column_of = [recorded().scene(step).data[1, place] for step in range(4)]
    assert values_around(recorded(), changed(2, change), divergence)[1:-1] == [
        (1, column_of[1], column_of[1]),
        (2, column_of[2], -1.0),
        (3, column_of[3], column_of[3]),
    ]
    assert values_around(recorded(), changed(2, change), divergence)[0][0] == 0
    assert values_around(recorded(), changed(2, change), divergence)[-1] == (4, None, None)


def test_observations_come_before_actions_and_actions_before_the_scene():
    def all_of_it(step):
        step.scene.time_s = 99.0
        step.rewards["other"] = 9.0
        step.actions["other"] = step.actions["other"] + 1
        step.observations["ego"] = step.observations["ego"] + np.array([[0, 0], [0, 8]], "<f4")

    assert found(1, all_of_it) == (1, "ego", "observation[1, speed]", 4.0, 12.0)

    def without_the_observation(step):
        all_of_it(step)
        step.observations["ego"] = recorded().all_steps[1].observations["ego"]

    assert found(1, without_the_observation) == (1, "other", "action[0]", 1.0, 2.0)

    def only_reward_and_scene(step):
        step.scene.time_s = 99.0
        step.rewards["other"] = 9.0

    assert found(1, only_reward_and_scene) == (1, "other", "reward", -0.5, 9.0)

    def action(step):
        step.actions["ego"] = np.array([5.0, 0.0])

    assert found(3, action) == (3, "ego", "action[target_speed]", 13.0, 5.0)
    divergence = first_divergence(recorded(), changed(3, action))
    assert divergence.place == ("action", (0,))
    assert values_around(recorded(), changed(3, action), divergence) == [
        (1, 11.0, 11.0), (2, 12.0, 12.0), (3, 13.0, 5.0), (4, None, None), (5, None, None),
    ]  # fmt: skip
    assert divergence.to_json() == {
        "step": 3, "agent": "ego", "field": "action[target_speed]", "recorded": 13.0, "replayed": 5.0,
    }  # fmt: skip
    assert str(divergence) == "step 3, ego action[target_speed]: recorded 13.0, replayed 5.0"

    def observation(step):
        step.observations["other"] = np.array([2.0, 3.0, 5.0], "<f4")

    assert found(2, observation) == (2, "other", "observation[2]", 4.0, 5.0)
    divergence = first_divergence(recorded(), changed(2, observation))
    assert values_around(recorded(), changed(2, observation), divergence)[1:-1] == [
        (1, 3.0, 3.0), (2, 4.0, 5.0), (3, 5.0, 5.0),
    ]  # fmt: skip


def test_the_sign_of_zero_counts_and_nan_equals_itself():
    def minus(step):
        step.rewards["ego"] = -0.0

    two = recorded(), recorded()
    for each in two:
        each.all_steps[1].rewards["ego"] = 0.0
    assert first_divergence(*two) is None
    minus(two[1].all_steps[1])
    assert first_divergence(*two).field == "reward"
    for each in two:
        each.all_steps[1].rewards["ego"] = float("nan")
    assert first_divergence(*two) is None


def test_who_acts_and_who_is_there():
    without = recorded(ego_only_at=2)
    divergence = first_divergence(recorded(), without)
    assert (divergence.step, divergence.agent, divergence.field) == (2, "other", "observation")
    assert (divergence.recorded, divergence.replayed, divergence.place) == ([2.0, 3.0, 4.0], None, None)
    assert first_divergence(without, recorded()).recorded is None
    assert values_around(recorded(), without, divergence) == []

    def roster(*actors):
        def change(step):
            rows = range(len(actors))
            scene = step.scene
            step.scene = Scene(
                scene.time_s, Roster(actors), [scene.points[row] for row in rows], scene.headings[: len(actors)],
                scene.speeds[: len(actors)], scene.contacts, scene.off_road, scene.lanes,
            )  # fmt: skip

        return change

    ego, other, bus = ACTORS
    assert found(1, roster(ego, bus)) == (1, "other", "presence", 1, 0)
    extra = changed(1, roster(ego, bus))
    assert first_divergence(extra, recorded()).agent == "other"
    assert first_divergence(extra, recorded()).recorded == 0
    assert found(1, roster(other, ego, bus)) == (1, "", "order of actors", ["ego", "other", "bus"], "another")
    longer = dataclasses.replace(other, length=13.0)
    step, agent, field, was, now = found(1, roster(ego, longer, bus))
    assert (step, agent, field, was, now) == (1, "other", "actor", str(other), str(longer))
    value = first_divergence(recorded(), changed(2, lambda step: step.scene.speeds.__setitem__(2, 5.0)))
    gone = changed(1, roster(ego, other))
    assert values_around(recorded(), gone, value)[1] == (1, recorded().scene(1).speeds[2], None)


def test_a_step_that_ended_within_and_lengths():
    def cut(step):
        step.scene = None

    assert found(3, cut) == (3, "", "scene", "present", None)
    cut_off = changed(3, cut)
    assert first_divergence(cut_off, recorded()).replayed == "present"
    assert first_divergence(cut_off, copy.deepcopy(cut_off)) is None
    shorter = first_divergence(recorded(3), recorded(2))
    assert (shorter.step, shorter.agent, shorter.field, shorter.recorded, shorter.replayed) == (3, "", "length", 3, 2)
    longer = first_divergence(recorded(1), recorded(3))
    assert (longer.step, longer.recorded, longer.replayed) == (2, 1, 3)


def test_what_is_no_value_of_any_step():
    another = first_divergence(recorded(), recorded(prologue=Prologue(AGENTS, 0.25)))
    assert (another.step, another.field) == (0, "setup")
    assert '"step_length_s": 0.5' in another.recorded
    assert '"step_length_s": 0.25' in another.replayed
    one = recorded()
    records = list(one.records)
    records[2], records[3] = records[3], records[2]  # lanes before the roster: the same scene, written otherwise
    written = first_divergence(one, Recording(records))
    assert (written.step, written.agent, written.field) == (3, "", "digest")
    assert (written.recorded, written.replayed) == (one.digest, Recording(records).digest)
    notes = Record(Tag.NOTES, 0, encode_notes([Event("teleport", "ego", "gone")]))
    assert first_divergence(one, Recording([*one.records[:3], notes, *one.records[3:]])) is None  # not part of it


def test_difference_in_words_shows_the_beginning_of_a_long_action():
    rows = [[0.1 * step, 20.0, 0.0] for step in range(60)]
    text = str(Divergence(step=290, agent="ego", field="action", recorded=None, replayed=rows))
    assert text.startswith("step 290, ego action: recorded None, replayed [[0.0, 20.0, 0.0], [0.1,")
    assert len(text) < 160
    assert text.endswith("…")
