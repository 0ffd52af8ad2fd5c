"""Tests of the choice of a form of actions: command line, then scenario, then the agent's class."""

from types import SimpleNamespace

import pytest

from crashhunt.base.errors import UsageError
from crashhunt.plans import Request, plan, with_settings
from crashhunt.plans._choices import chosen_actions, chosen_observations, notes_on_declarations
from crashhunt.scenario import load_scenario, with_observations

AGENTS = """
class Accelerates:
    action = "acceleration"
    def reset(self, seed): ...
    def act(self, observation): return (0.0, 0)

class Strict(Accelerates):
    actions = ("acceleration", "sumo")

class Other(Accelerates):
    action = "teleport"

class Busy(Accelerates):
    action = {"its own": "purpose"}
    def actions(self): ...
"""


@pytest.fixture(autouse=True)
def _module(tmp_path, monkeypatch):
    (tmp_path / "acting_agents.py").write_text(AGENTS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)


def asked(agent, scenario="loop", **options):
    agents = {"ego": f"acting_agents:{agent}"} if ":" not in agent else {"ego": agent}
    return Request(trials=1, max_steps=1, scenario=scenario, agents=agents, seed=1, **options)


def test_class_chooses_the_form_that_nothing_else_chooses():
    scenario, settings = plan(asked("Accelerates"))
    assert scenario.agents["ego"].action == settings.agents["ego"].action == "acceleration"
    again = with_settings(load_scenario("loop"), settings)
    assert again.agents["ego"].action_form == "acceleration"
    assert not any("precedence" in note for note in scenario.notes)


def test_class_named_by_the_user_takes_precedence_over_the_scenario_and_the_scenario_over_its_own_agent():
    scenario, settings = plan(asked("Accelerates", "motorway"))
    assert scenario.agents["ego"].action_form == settings.agents["ego"].action == "acceleration"
    signatures = {"ego": SimpleNamespace(action="acceleration", observation=("ego",), actions=None, unread={})}
    scenario = with_observations(load_scenario("motorway"), {"ego": ("actors",)})
    assert chosen_actions("", scenario, signatures) == {}
    assert chosen_observations((), scenario, signatures) == {"ego": ("actors",)}
    assert chosen_observations((), scenario, signatures, ("ego",)) == {"ego": ("ego",)}
    (note,) = notes_on_declarations(scenario, signatures)
    assert "meta, which takes precedence over acceleration of crashhunt.agents:NumpyPolicy" in note


def test_command_line_takes_precedence_over_scenario_and_class():
    scenario, settings = plan(asked("Accelerates", "motorway", action="speed_and_lane"))
    assert scenario.agents["ego"].action_form == settings.agents["ego"].action == "speed_and_lane"


def test_agent_without_a_declaration_leaves_the_settings_as_they_are():
    scenario, settings = plan(asked("Busy"))
    assert (scenario.agents["ego"].action, settings.agents["ego"].action) == (None, None)


@pytest.mark.parametrize(
    ("agent", "options", "message"),
    [
        ("Strict", {"action": "meta"}, "Strict returns actions of the form acceleration or sumo, not meta"),
        ("Other", {}, "action of acting_agents:Other: 'teleport' is not a form of actions"),
        ("Accelerates", {"action": "trajectory:visible=back"}, "^--action: trajectory:visible is 'back'; give front"),
        ("crashhunt.agents:CarFollowing", {"action": "acceleration"}, "speed_and_lane or meta, not acceleration"),
        (
            "Busy",
            {"action": "trajectory", "disturb": ("late_action=0.1",)},
            "ego returns a trajectory, which cannot be",
        ),
        (
            "Busy",
            {"action": "trajectory:frame=ego", "disturb": ("brake=0.1", "late_observation=0.1")},
            "does not begin where the vehicle is; give --action trajectory:tracker=pure_pursuit, or omit late",
        ),
        (
            "Busy",
            {"action": "trajectory", "disturb": ("noisy_observation=0.1",)},
            "does not begin where the vehicle is; give --action trajectory:tracker=pure_pursuit, or omit noisy",
        ),
    ],
)
def test_form_that_an_agent_cannot_return_is_refused_before_the_first_trial(agent, options, message):
    with pytest.raises(UsageError, match=message):
        plan(asked(agent, **options))
