"""Tests of the table of action forms, and of the check that an agent can return a form."""

import pytest

from crashhunt.base.errors import UsageError
from crashhunt.scenario import ACTIONS, AgentSetup, action_settings, canonical_action, check_action


def test_scenario_may_name_every_form_of_the_table_and_the_older_name():
    assert [AgentSetup(action=name).action_form for name in ACTIONS] == [*ACTIONS]
    assert [AgentSetup(action=name).action_form for name in (None, "continuous", "meta")] == [
        "speed_and_lane", "speed_and_lane", "meta",
    ]  # fmt: skip


def test_every_component_has_a_range_and_a_help_text():
    for form in ACTIONS.values():
        assert len(form.names) == len({*form.names})
        for one in form.components:
            assert one.low < one.high
            assert one.low == -one.high or one.low >= 0 or one.name == "speed_override"  # left and right are alike
            assert one.help
            assert one.range.count("|") == (one.high - one.low if one.whole else 0)


def test_layout_of_one_component_has_no_parentheses():
    assert [ACTIONS[name].layout for name in ("meta", "acceleration")] == ["meta_action", "(acceleration, lane_change)"]


def test_agent_that_names_its_forms_is_refused_with_another_form():
    check_action("acceleration", (), "any:Agent")
    check_action(None, ("continuous",), "old:Agent")
    with pytest.raises(UsageError, match="my:Agent returns actions of the form meta or sumo, not speed_and_lane") as it:
        check_action("continuous", ("meta", "sumo"), "my:Agent")
    assert it.value.fix == "choose the action meta or sumo, or another agent"
    assert canonical_action("trajectory") == "trajectory"


def test_settings_follow_the_name_of_the_form():
    defaults = {"reference_point": "center", "tracker": "interpolation", "visible": "front"}
    assert action_settings("trajectory:frame=ego") == {"frame": "ego", **defaults}
    usual = {"lane_change_duration_s": 0.0, "visible": "front"}
    assert action_settings(None) == action_settings("continuous") == usual
    setup = AgentSetup(action="speed_and_lane:lane_change_duration_s=3")
    assert setup.action_settings == {**usual, "lane_change_duration_s": 3}
    assert canonical_action("target_pose:frame=ego") == "target_pose"


@pytest.mark.parametrize(
    ("name", "message", "fix"),
    [
        ("fly", "--action: 'fly' is not a form of actions", "give one of"),
        (
            "trajectory:frame=ego:frame=map",
            "--action: trajectory has the setting 'frame' twice",
            "name each setting once",
        ),
        ("meta:frame=ego", "--action: meta has no setting 'frame'", "no settings"),
        ("trajectory:frame=moon", "--action: trajectory:frame is 'moon'", "give map or ego"),
        ("acceleration:lane_change_duration_s=-1", "lane_change_duration_s is '-1'", "a number in s within 0 and 20"),
        ("acceleration:lane_change_duration_s", "lane_change_duration_s is ''", "a number in s within 0 and 20"),
        ("acceleration:lane_change_duration_s=nan", "lane_change_duration_s is 'nan'", "within 0 and 20"),
    ],
)
def test_setting_that_does_not_exist_or_fit_is_refused(name, message, fix):
    with pytest.raises(UsageError, match=message) as caught:
        action_settings(name, where="--action")
    assert fix in caught.value.fix


def test_unknown_setting_of_a_recorded_form_names_the_action():
    with pytest.raises(UsageError, match=r"^action: trajectory:visible is 'of_a_later_version'"):
        action_settings("trajectory:visible=of_a_later_version")
