"""A disturbance as plain data and in words."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given, strategies as st

from crashhunt.trial import (
    CELLS,
    KINDS,
    SENSOR_KINDS,
    Disturbance,
    Outcome,
    TrialResult,
    TrialSpec,
    check_disturbances,
    in_effect,
)
from crashhunt.trial._disturbance import in_turn, why_not

texts = st.text(max_size=9)
disturbances = st.builds(
    Disturbance,
    st.integers(1, 10**6),
    st.sampled_from(CELLS) | texts,
    st.sampled_from(sorted(KINDS)) | texts,
    st.floats(0, 1e6),
    st.floats(1e-3, 1e6),
    texts,
    texts,
)


@given(st.lists(disturbances).map(tuple), st.lists(disturbances).map(tuple), st.none() | st.floats(-1e9, 0))
def test_a_disturbed_trial_survives_json_and_can_be_reported(planned, happened, likely):
    spec = TrialSpec(3, 1, {}, {}, 9, disturbances=planned)
    result = TrialResult(spec, Outcome.SURVIVED, steps=9, disturbances=happened, log_likelihood=likely)
    data = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert TrialResult.from_json(data) == result
    for one in planned + happened:
        assert one.words
        assert one.place


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"step": "1"}, "step"),
        ({"step": 0}, "out of its range"),
        ({"how_long": 0.0}, "out of its range"),
        ({"how_long": 1e999}, "out of its range"),
        ({"how_strong": -1e999}, "out of its range"),
        ({"who": 3}, "who"),
        ({"agent": None}, "agent"),
    ],
)
def test_data_that_make_no_sense_are_refused(change, says):
    data = Disturbance(1, "ahead", "brake", 2.0, 1.0, "ego").to_json()
    check_disturbances([data])
    with pytest.raises(ValueError, match=says):
        check_disturbances([data | change])


@pytest.mark.parametrize(
    ("disturbance", "words"),
    [
        (Disturbance(1, "ahead", "brake", 4.0, 2.0, "ego"), "the actor ahead of ego brakes with 4 m/s² for 2 s"),
        (Disturbance(1, "left", "cut_in", 0.0, 2.0, "ego", "b"), "b cuts in on ego within 2 s"),
        (Disturbance(1, "above", "fly", 2.0, 1.0, "{ego}"), "the actor above of {ego}: fly 2 for 1 s"),
    ],
)
def test_words_name_the_actor_or_its_place_and_unknown_kinds_as_they_are(disturbance, words):
    assert disturbance.words == words


def test_what_had_an_effect_began_by_the_end_with_an_actor_there():
    there, nobody = Disturbance(5, "ahead", "brake", 4.0, 2.0, "ego", "b"), Disturbance(3, "ahead", "brake", 4.0, 2.0)
    result = TrialResult(TrialSpec(3, 1, {}, {}, 9), Outcome.COLLISION, steps=5)
    assert in_effect(result, [nobody, there]).disturbances == (there,)
    assert in_effect(result, [nobody]).disturbances == ()
    result = TrialResult(TrialSpec(3, 1, {}, {}, 9), Outcome.COLLISION, steps=4)
    assert not in_effect(result, [there]).disturbed


def test_disturbances_are_in_the_order_of_step_agent_and_kind():
    ordered = [
        Disturbance(step=1, who="ahead", what="brake", how_strong=1.0, how_long=1.0, agent="b"),
        Disturbance(step=2, who="ahead", what="brake", how_strong=1.0, how_long=1.0, agent="a"),
        Disturbance(step=2, who="ahead", what="stop", how_strong=1.0, how_long=1.0, agent="a"),
        Disturbance(step=2, who="ahead", what="brake", how_strong=1.0, how_long=1.0, agent="b"),
    ]
    assert in_turn(reversed(ordered)) == tuple(ordered)


def test_disturbance_is_active_for_its_duration():
    one = Disturbance(step=3, who="ahead", what="brake", how_strong=1.0, how_long=0.2)
    assert [step for step in range(9) if one.is_active(step, 0.1)] == [3, 4]


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({}, ""),
        ({"how_strong": 0.0}, ""),
        ({"how_strong": -1.0}, "the strength is -1"),
        ({"how_strong": math.inf}, "the strength is inf"),
        ({"how_long": 0.0}, "the duration is 0"),
        ({"how_long": math.inf}, "the duration is inf"),
        ({"who": "itself"}, "brake is not about 'itself'"),
        ({"what": "late_action"}, "late_action is not about 'ahead'"),
        ({"what": "dawdle", "how_strong": 1.5}, "dawdle of 1.5 is more than all"),
        ({"what": "of a later version", "who": "itself"}, ""),
    ],
    ids=str,
)
def test_invalid_disturbance_has_a_reason_and_a_fix(given, reason):
    one = Disturbance(**{"step": 1, "who": "ahead", "what": "brake", "how_strong": 1.0, "how_long": 1.0} | given)
    found = why_not(one)
    assert (found is None) == (not reason)
    assert found is None or (found[0] == reason and found[1].startswith(("give ", "it is about ")))


@pytest.mark.parametrize(
    ("what", "unit", "words"),
    [
        ("brake", "m/s²", "x brakes with 0.25 m/s² for 2 s"),
        ("stop", "m/s²", "x stops with 0.25 m/s² and stands, for 2 s in all"),
        ("dawdle", "", "x drives 25 % slower than it did for 2 s"),
        ("speed", "", "x wants to drive 25 % faster for 2 s"),
        ("cut_in", "m/s²", "x cuts in on ego within 2 s and brakes with 0.25 m/s²"),
        ("late_merge", "m", "x merges only in the last 0.25 m of its lane, for 2 s"),
        ("step_out", "m/s", "x steps out onto the road with 0.25 m/s, and is back after 2 s"),
        ("ignore_priority", "", "x heeds neither red lights nor priority for 2 s"),
        ("late_observation", "s", "ego sees everything 0.25 s late for 2 s"),
        ("noisy_observation", "", "what ego sees is up to 25 % off for 2 s"),
        ("unseen", "", "ego does not see x for 2 s"),
        ("late_action", "s", "what ego does takes effect 0.25 s late for 2 s"),
    ],
)
def test_words_have_the_strength_in_its_unit(what, unit, words):
    one = Disturbance(1, "ahead", what, 0.25, 2.0, "ego", "x")
    assert (KINDS[what].unit, one.words) == (unit, words)


def test_shares_end_at_one_and_late_merges_are_worse_if_shorter():
    assert [name for name, kind in KINDS.items() if kind.most == 1.0] == ["dawdle", "noisy_observation"]
    assert [name for name, kind in KINDS.items() if kind.less_is_worse] == ["late_merge"]
    assert {"late_observation", "noisy_observation", "late_action"} == SENSOR_KINDS


def test_delays_take_place_in_whole_steps_and_other_strengths_as_they_are():
    delay = Disturbance(1, "itself", "late_action", 0.37, 1.04, "ego")
    found = delay.took_place("ego", 0.37, 0.1)
    assert (found.vehicle, found.how_strong, found.how_long) == ("ego", 0.4, 1.0)
    assert delay.took_place("ego", 0.02, 0.1).how_strong == 0.1  # one step at least
    assert delay.took_place("ego", 0.0, 0.1).how_strong == 0.0
    assert delay.took_place("ego", 0.37).how_long == 1.04
    brake = Disturbance(1, "ahead", "brake", 4.0, 1.04, "ego").took_place("x", 3.33, 0.1)
    assert (brake.how_strong, brake.how_long) == (3.33, 1.0)


def test_missing_disturbances_are_valid_and_other_data_are_not():
    check_disturbances(None)
    check_disturbances([])
    for wrong in ({}, "brake", ["brake"]):
        with pytest.raises(ValueError, match="disturbance"):
            check_disturbances(wrong)
