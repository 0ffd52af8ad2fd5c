"""Changes of a recorded trial: its disturbances, its arguments, and what they are called in the report."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt.errors import ArgumentError
from crashhunt.replays._edits import (
    Edits,
    edited_disturbances,
    edited_spec,
    is_about_disturbances,
    with_other_words,
)
from crashhunt.trial import Disturbance, TrialSpec

BRAKE = Disturbance(20, "ahead", "brake", 4.0, 2.0, "ego")
STOP = Disturbance(20, "left", "stop", 3.0, 5.0, "ego")
LATE = Disturbance(40, "itself", "late_action", 0.5, 1.0, "ego")
PLANNED = (BRAKE, STOP, LATE)


def edited(name, text, planned=PLANNED):
    return edited_disturbances(planned, name, text, ("ego",))


def test_edits_of_disturbances_differ_from_edits_of_arguments():
    names = ["disturbances", "disturbances.20", "disturbances_max", "speed"]
    assert [is_about_disturbances(name) for name in names] == [True, True, False, False]


@pytest.mark.parametrize(
    ("name", "text", "found", "words"),
    [
        ("disturbances", "none", (), "disturbances were 3 and are none"),
        ("disturbances", "brake@20=ahead:4:2", (BRAKE,), "disturbances were 3 and are brake@20=ahead:4.0:2.0"),
        ("disturbances.20", "none", (LATE,), "disturbances.20 was 2 and is none"),
        ("disturbances.stop@20", "none", (BRAKE, LATE), "disturbances.stop@20 was stop@20=left:3.0:5.0 and is none"),
        (
            "disturbances.ego.stop@20", "none", (BRAKE, LATE),
            "disturbances.ego.stop@20 was stop@20=left:3.0:5.0 and is none",
        ),
        (
            "disturbances.40.how_strong", "0.25",
            (BRAKE, STOP, Disturbance(40, "itself", "late_action", 0.25, 1.0, "ego")),
            "disturbances.40.how_strong was 0.5 and is 0.25",
        ),
        (
            "disturbances.brake@20.who", "behind", (Disturbance(20, "behind", "brake", 4.0, 2.0, "ego"), STOP, LATE),
            "disturbances.brake@20.who was ahead and is behind",
        ),
        (
            "disturbances.brake@20", "ahead:1:2", (Disturbance(20, "ahead", "brake", 1.0, 2.0, "ego"), STOP, LATE),
            "disturbances.brake@20 was brake@20=ahead:4.0:2.0 and is brake@20=ahead:1.0:2.0",
        ),
        (
            "disturbances.brake@5", "ahead:1:2", (Disturbance(5, "ahead", "brake", 1.0, 2.0, "ego"), *PLANNED),
            "disturbances.brake@5 was none and is brake@5=ahead:1.0:2.0",
        ),
        (
            "disturbances.cut_in@3", "left_ahead:4:2",
            (Disturbance(3, "left ahead", "cut_in", 4.0, 2.0, "ego"), *PLANNED),
            "disturbances.cut_in@3 was none and is cut_in@3=left_ahead:4.0:2.0",
        ),
        ("disturbances.brake@20", "ahead:4:2", PLANNED, ""),
        ("disturbances.40.how_long", "1", PLANNED, ""),
    ],
)  # fmt: skip
def test_edit_changes_the_named_disturbances_only(name, text, found, words):
    assert edited(name, text) == (found, [words] if words else [])


@pytest.mark.parametrize(
    ("name", "text", "fix"),
    [
        ("disturbances.21", "none", "20"),
        ("disturbances.brake@21.who", "ahead", "brake@20"),
        ("disturbances.20", "4", "write none, or disturbances."),
        ("disturbances.20.how_strong", "4", "write disturbances.brake@20.how_strong"),
        ("disturbances.40.step", "4", "how_strong"),
        ("disturbances.40.how_strong", "x", "give a number from 0 on"),
        ("disturbances.40.how_strong", "-1", "give a number from 0 on"),
        ("disturbances.40.how_strong", "inf", "give a number from 0 on"),
        ("disturbances.40.how_long", "0", "give seconds above 0"),
        ("disturbances.40.who", "above", "ahead"),
        ("disturbances.40.who", "ahead", "itself"),  # a delay of actions is of the agent
        ("disturbances", "x", "write disturbances=none"),
    ],
)
def test_edit_that_cannot_be_made_has_a_fix(name, text, fix):
    with pytest.raises(ArgumentError) as caught:
        edited(name, text)
    assert fix in caught.value.fix
    assert "--set disturbances" in caught.value.message


def test_edit_of_a_trial_without_disturbances_shows_the_form():
    with pytest.raises(ArgumentError) as caught:
        edited("disturbances.3", "none", ())
    assert "KIND@STEP" in caught.value.fix


def test_other_words_in_hunt_toml_replace_what_was_given_and_remove_what_has_no_rate():
    drawn = Disturbance(7, "ahead", "stop", 3.0, 5.0, "ego")
    planned = (drawn, BRAKE)
    before = ("stop=0.1", "brake@20=ahead:4:2")
    assert with_other_words(planned, before, before, ("ego",)) == (planned, [], [])
    found, changed, ignored = with_other_words(planned, before, ("stop=0.1", "brake@30=ahead:4:2"), ("ego",))
    assert [(one.step, one.what) for one in found] == [(7, "stop"), (30, "brake")]
    assert changed == ["disturb was stop=0.1,brake@20=ahead:4:2 and is stop=0.1,brake@30=ahead:4:2"]
    assert ignored == []
    kinds = ("stop=0.1", "late_action=1")  # of two kinds that were drawn, one has a rate no more
    assert with_other_words((drawn, LATE), kinds, kinds[:1], ("ego",))[0] == (drawn,)
    found, changed, ignored = with_other_words(planned, before, (), ("ego",))
    assert (found, len(changed), ignored) == ((), 1, [])
    found, changed, ignored = with_other_words(planned, before, ("stop=0.2", before[1]), ("ego",))
    assert (found, changed) == (planned, [])
    assert "disturb was stop=0.1 and is stop=0.2 in hunt.toml; a replay keeps what was drawn" in ignored[0]


def settings(**given):
    agents = {"ego": SimpleNamespace(agent="keep-lane", arguments={"speed": spec("5.0", "float")})}
    plain = {
        "agents": agents, "scenario_arguments": {"gap_m": spec("20.0", "float")}, "max_steps": 100,
        "crash_on": ("hang",), "events": {}, "oracles": (), "disturb": (), "seed": 1, "scenario": "toy",
    }  # fmt: skip
    return SimpleNamespace(**plain | given)


def spec(text, kind):
    return SimpleNamespace(spec=text, kind=kind)


RECORDED = TrialSpec(3, 7, {"ego": {"speed": 5.0}}, {"gap_m": 21.5}, 100)


def test_trial_without_edits_is_the_recorded_one():
    assert edited_spec(RECORDED, settings(), settings(), {}) == (RECORDED, Edits())


def test_edited_arguments_are_reported_with_their_owner():
    trial, edits = edited_spec(RECORDED, settings(), settings(), {"speed": "8", "gap_m": "20"})
    assert (trial.arguments, trial.scenario_arguments) == ({"ego": {"speed": 8.0}}, {"gap_m": 20.0})
    assert edits.agents == ("ego.speed was 5.0 and is 8.0",)
    assert edits.others == ("gap_m was 21.5 and is 20.0",)
    assert edits.all == (*edits.agents, *edits.others)
    assert RECORDED.arguments == {"ego": {"speed": 5.0}}


def test_edited_disturbances_are_other_traffic():
    recorded = replace(RECORDED, disturbances=PLANNED)
    trial, edits = edited_spec(recorded, settings(), settings(), {"disturbances.40": "none", "speed": "8"})
    assert trial.disturbances == (BRAKE, STOP)
    assert edits.others == ("disturbances.40 was late_action@40=itself:0.5:1.0 and is none",)
    assert edits.agents == ("ego.speed was 5.0 and is 8.0",)


def test_edits_of_hunt_toml_apply_or_are_reported_as_ignored():
    agents = {"ego": SimpleNamespace(agent="idm", arguments={"speed": spec("6.0", "float")})}
    now = settings(agents=agents, max_steps=50, crash_on=("hang", "collision"), seed=9)
    trial, edits = edited_spec(RECORDED, now, settings(), {})
    assert (trial.arguments["ego"]["speed"], trial.max_steps) == (6.0, 50)
    assert edits.agents == ("agents.ego.agent was keep-lane and is idm", "ego.speed was 5.0 and is 6.0")
    assert edits.others == ("max_steps was 100 and is 50", "crash_on was hang and is hang,collision")
    assert edits.ignored == ("seed was 1 and is 9 in hunt.toml; a replay keeps that of the recorded trial",)
    longer = edited_spec(RECORDED, settings(max_steps=200), settings(), {})[1]
    assert (longer.agents, longer.others) == (("max_steps was 100 and is 200",), ())  # it leaves nothing out


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"speed": "5:8"}, "'5:8' is not a single value"),
        ({"sped": "5"}, "did you mean 'ego.speed'"),
        ({"speed": "fast"}, "fast"),
        ({"disturbances.brake@101": "ahead:1:1"}, "brake@101 cannot happen: the trial has 100 steps"),
    ],
)
def test_edit_that_no_trial_can_have_is_refused(changes, says):
    with pytest.raises(ArgumentError) as caught:
        edited_spec(RECORDED, settings(), settings(), changes)
    assert says in str(caught.value)
