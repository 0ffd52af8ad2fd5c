"""The simplest agents: constant, at random and recorded."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from gymnasium import spaces
from seen import seen

from crashhunt import recording
from crashhunt.agents import KeepLaneWithSpeed, RandomAgent, Recorded
from crashhunt.simulators import MetaAction, SpeedAndLaneChange

NAMES = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")


def test_a_constant_speed_is_held_within_2_5_where_actions_are_meta_actions():
    assert KeepLaneWithSpeed(12.0, action_space=SpeedAndLaneChange().space).act(seen(3.0)) == (12.0, 0)
    agent = KeepLaneWithSpeed(12.0, action_space=MetaAction().space)
    said = [NAMES[agent.act(seen(speed))] for speed in (9.4, 9.6, 14.4, 14.6)]
    assert said == ["FASTER", "IDLE", "IDLE", "SLOWER"]


def test_random_actions_are_held_for_so_many_steps_and_come_from_the_seed():
    def drawn(agent, seed, steps=40):
        agent.reset(seed)
        return [agent.act(None) for _ in range(steps)]

    agent = RandomAgent(spaces.Discrete(1000), hold_steps=4)
    first = drawn(agent, 1)
    assert [len(set(first[begin : begin + 4])) for begin in range(0, 40, 4)] == [1] * 10
    assert len(set(first)) > 8
    agent.reset(1)
    agent.act(None)  # in the middle of holding
    assert drawn(agent, 1) == first == drawn(RandomAgent(spaces.Discrete(1000), hold_steps=4), 1)
    assert drawn(agent, 2) != first
    assert len(set(drawn(RandomAgent(spaces.Discrete(1000), hold_steps=1), 1))) > 20
    assert len(set(drawn(RandomAgent(spaces.Discrete(1000)), 1, steps=20))) == 2
    with pytest.raises(ValueError, match="hold_steps"):
        RandomAgent(spaces.Discrete(2), hold_steps=0)


def test_recorded_actions_of_one_agent_come_in_order_and_again_after_a_reset(monkeypatch):
    kept = {"ego": [(1.0, 0), (2.0, 1)], "second": [(9.0, 0)]}
    monkeypatch.setattr(recording, "read_log", lambda path: SimpleNamespace(actions=kept.__getitem__), raising=False)
    agent = Recorded("log.mcap")
    for _ in range(2):
        agent.reset(0)
        assert [agent.act(None), agent.act(None)] == kept["ego"]
    with pytest.raises(IndexError, match="has 2 actions"):
        agent.act(None)
    assert Recorded("log.mcap", agent="second").act(None) == (9.0, 0)
