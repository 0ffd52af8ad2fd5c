"""The units of arguments, as far as this version of crashhunt knows them."""

from __future__ import annotations

import pytest

from crashhunt.plans import AgentSettings, HuntSettings
from crashhunt.report._argument_words import argument_units


@pytest.mark.parametrize("agent", ["crashhunt.agents:OfALaterVersion", "an-agent-that-is-not-installed", "mine:Agent"])
def test_agent_that_is_unknown_here_has_no_units(tmp_path, agent):
    """As in an archive of another machine."""
    agents = {"a": AgentSettings(agent=agent), "b": AgentSettings(agent="crashhunt.agents:KeepLaneWithSpeed")}
    settings = HuntSettings(scenario="x", scenario_digest="", trials=1, max_steps=1, seed=1, agents=agents)
    assert argument_units(tmp_path, settings) == {("b", "speed"): "m/s"}
