"""Agents that are overruled from a step on: which decision is whose, in both languages of actions."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from gymnasium import spaces

from crashhunt import recording
from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.episode import overruled_agent
from crashhunt.episode._action_override import HandedOver
from crashhunt.simulators import FullBraking, MetaAction, SpeedAndLaneChange, action_form
from crashhunt.trial import Handover, Overruled

WORDS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")


class Driver:
    """Says one thing after another."""

    def __init__(self, *says):
        self.says, self.asked, self.seeds, self.closed = says, [], [], 0

    def reset(self, seed):
        self.seeds.append(seed)

    def act(self, observation):
        self.asked.append(observation)
        return self.says[(len(self.asked) - 1) % len(self.says)]

    def close(self):
        self.closed += 1


class Lanes:
    """A simulator whose vehicles have target speeds and lanes."""

    def __init__(self, form=None, *, brakes="full"):
        self.actions = {"ego": form or SpeedAndLaneChange()}
        self.speed = 7.5
        if brakes:
            self.full_braking = lambda agent: FullBraking(brakes, "fully") if agent == "ego" else None

    def scene(self):
        roster = SimpleNamespace(index={"other": 0, "ego": 1})
        return SimpleNamespace(speeds=[99.0, self.speed], roster=roster)


def said(agent, steps=5):
    agent.reset(3)
    return [agent.act(step) for step in range(steps)]


def test_it_brakes_from_the_step_after_on_and_the_driver_is_asked_until_then():
    driver = Driver("drive")
    agent = overruled_agent(driver, Lanes(), Overruled("ego", 2))
    assert said(agent) == ["drive", "drive", "full", "full", "full"]
    assert driver.asked == [0, 1]
    assert said(agent, 3) == ["drive", "drive", "full"]  # another episode
    assert driver.seeds == [3, 3]
    agent.close()
    assert driver.closed == 1
    assert said(overruled_agent(Driver("drive"), Lanes(), Overruled("ego", 0)), 2) == ["full", "full"]
    overruled_agent(SimpleNamespace(act=None, reset=None), Lanes(), Overruled("ego", 0)).close()  # it has nothing open


@pytest.mark.parametrize(("side", "change"), [("left", 1), ("right", -1)])
def test_it_changes_lanes_in_its_first_decision(side, change):
    agent = overruled_agent(Driver("drive"), Lanes(), Overruled("ego", 1, side))
    assert said(agent, 4) == ["drive", (0.0, change), "full", "full"]
    meta = overruled_agent(Driver("drive"), Lanes(MetaAction(WORDS)), Overruled("ego", 1, side))
    assert said(meta, 3) == ["drive", WORDS.index(f"LANE_{side.upper()}"), "full"]


def test_which_no_one_knows_how_to_overrule_is_refused():
    unknown = action_form(spaces.Box(-1.0, 1.0, (2,)))
    for simulator, overruled, what in (
        (Lanes(brakes=""), Overruled("ego", 1), "ego cannot be made to brake"),
        (Lanes(), Overruled("other", 1), "other cannot be made to brake"),
        (Lanes(unknown), Overruled("ego", 1, "left"), "ego cannot be made to change to the left lane"),
        (Lanes(MetaAction(("IDLE", "LANE_LEFT"))), Overruled("ego", 1, "right"), "change to the right lane"),
        (Lanes(unknown), Overruled("ego", 1, keeps="lane"), "lanes and speeds"),
        (Lanes(MetaAction(("GO", "STOP"))), Overruled("ego", 1, keeps="speed"), "lanes and speeds"),
    ):
        with pytest.raises(InvalidEpisodeError, match=what):
            overruled_agent(Driver("drive"), simulator, overruled)


def test_it_is_kept_in_its_lane_or_at_the_speed_that_it_had_and_asked_on():
    for keeps, expected in (("lane", (20.0, 0)), ("speed", (7.5, -1))):
        driver, simulator = Driver((20.0, -1)), Lanes()
        agent = overruled_agent(driver, simulator, Overruled("ego", 1, keeps=keeps))
        agent.reset(3)
        first, second = agent.act(0), agent.act(1)
        simulator.speed = 2.0  # the speed is that of the first decision that is not its own
        assert (first, second, agent.act(2)) == ((20.0, -1), expected, expected)
        assert driver.asked == [0, 1, 2]
        agent.close()
        assert (driver.seeds, driver.closed) == ([3], 1)
    backwards = Lanes()
    backwards.speed = -1.0
    assert said(overruled_agent(Driver((20.0, 0)), backwards, Overruled("ego", 0, keeps="speed")), 1) == [(0.0, 0)]


def test_of_words_those_are_passed_over_that_would_change_what_is_kept():
    idle = WORDS.index("IDLE")
    for keeps, lost in (("lane", ("LANE_LEFT", "LANE_RIGHT")), ("speed", ("FASTER", "SLOWER"))):
        agent = overruled_agent(Driver(*range(5)), Lanes(MetaAction(WORDS)), Overruled("ego", 0, keeps=keeps))
        assert said(agent) == [idle if word in lost else number for number, word in enumerate(WORDS)]


def test_a_driver_takes_over_after_the_recorded_actions_and_begins_there(monkeypatch):
    kept = SimpleNamespace(actions=lambda agent: [f"{agent} {step}" for step in range(3)])
    monkeypatch.setattr(recording, "read_log", lambda path: kept, raising=False)
    driver = Driver("drive")
    agent = HandedOver(driver, Handover(agent="ego", log="log.mcap", after=3))
    for episode in (1, 2):
        assert said(agent) == ["ego 0", "ego 1", "ego 2", "drive", "drive"]
        assert driver.asked == [3, 4] * episode
        assert driver.seeds == [3] * episode
    agent.close()
    assert driver.closed == 1
    HandedOver(SimpleNamespace(act=None, reset=None), Handover(agent="ego", log="log.mcap", after=3)).close()
