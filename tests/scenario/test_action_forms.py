"""Tests of the table of action forms, and of the check that an agent can return a form."""

from typing import get_args

import pytest

from crashhunt.base.errors import UsageError
from crashhunt.scenario import ACTIONS, AgentSetup, canonical_action, check_action
from crashhunt.scenario._action_forms import ActionName


def test_scenario_may_name_every_form_of_the_table_and_the_older_name():
    assert {*get_args(ActionName)} == {*ACTIONS, "continuous"}
    assert [AgentSetup(action=name).action_form for name in (None, "continuous", "meta")] == [
        "speed_and_lane", "speed_and_lane", "meta",
    ]  # fmt: skip


def test_every_component_has_a_range_and_a_help_text():
    for form in ACTIONS.values():
        assert len(form.names) == len({*form.names})
        for one in form.components:
            assert one.low < one.high
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
