"""Meta-actions: what they are called, and which one stands for an acceleration."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces

from crashhunt.agents._protocol import meta_actions, wanted_meta_action
from crashhunt.simulators import SpeedAndLaneChange

NAMES = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")


def test_meta_actions_are_known_by_the_names_of_the_space():
    speeds = spaces.Discrete(3)
    speeds.meanings = ("SLOWER", "IDLE", "FASTER")  # of which none is a lane change
    assert meta_actions(speeds) == {"LANE_LEFT": 1, "IDLE": 1, "LANE_RIGHT": 1, "FASTER": 2, "SLOWER": 0}
    assert meta_actions(spaces.Discrete(5)) == {name: number for number, name in enumerate(NAMES)}
    for space in (None, SpeedAndLaneChange().space, spaces.Dict({"a": speeds})):
        assert meta_actions(space) is None
    for space in (spaces.Discrete(3), spaces.Box(-1, 1, (5,), np.float32)):
        with pytest.raises(ValueError, match="meta-actions"):
            meta_actions(space)


def test_an_acceleration_becomes_a_meta_action_and_a_lane_change_comes_first():
    assert [wanted_meta_action(a) for a in (-0.8, -0.7, 0.4, 0.6)] == ["SLOWER", "IDLE", "IDLE", "FASTER"]
    assert [wanted_meta_action(-3.0, change) for change in (1, -1)] == ["LANE_LEFT", "LANE_RIGHT"]
