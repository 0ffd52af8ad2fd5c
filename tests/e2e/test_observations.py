"""Agents that observe parts, on the toy, from the command line to the replay."""

from __future__ import annotations

import pytest

from crashhunt.crashes import read_bundle
from crashhunt.trial import Outcome

AGENT = '''
class Follows:
    """Drives fast, and brakes late for the actor ahead in its lane."""

    observation = ("ego", "actors:rows=6")

    def __init__(self, columns, agent_id, observation_space, speed: float = 25.0):
        self.columns, self.space, self.speed = columns, observation_space, speed
        assert agent_id == "ego"

    def reset(self, seed):
        pass

    def act(self, observation):
        assert self.space.contains(observation)
        rows, of = observation["actors"], self.columns["actors"]
        gap = min(rows[rows[:, of["ahead"]] > 0, of["ahead"]], default=1e9)
        return (0.0 if gap < 6.0 else self.speed, 0)
'''
WORDS = ("1", "2", "60", "--scenario", "toy", "--agent", "follows:Follows", "--seed", "5", "--no-snapshot")


@pytest.fixture
def hunted(toy, made_once):
    return made_once(hunt, toy)


def hunt(shell):
    (shell.folder / "follows.py").write_text(AGENT)
    shell.crashhunt("run", "h", *WORDS, "--disturb", "noisy_observation=0.5")


def test_crash_of_a_hunt_with_parts_replays(hunted):
    (crash,) = (hunted.folder / "h" / "crashes").iterdir()
    result = read_bundle(crash).result
    assert (result.outcome, result.spec.digest_of_changes) == (Outcome.COLLISION, True)
    assert hunted.crashhunt("replay", "h", "--json").json["verdict"] == "reproduced"
    assert hunted.crashhunt("replay", "h", "--from-log", "--json").json["verdict"] == "reproduced"


def test_parts_that_the_class_names_are_in_the_settings_and_in_the_log(hunted):
    assert 'observation = [\n    "ego",\n    "actors:rows=6",\n]' in (hunted.folder / "h" / "hunt.toml").read_text()
    fields = "observation[ego,speed],observation[actors,0,ahead],speed"
    table = hunted.crashhunt("replay", "h", "--print", fields, "--json").json["table"]
    seen, driven = [row["observation[ego,speed]"] for row in table], [row["speed"] for row in table]
    assert (
        [None, driven[0]] == seen[:2] != driven[:2]
    )  # an observation shows the state before its step; later, it has noise
    assert table[0]["observation[actors,0,ahead]"] is None
    refused = hunted.crashhunt("replay", "h", "--print", "observation[ego,sped]", expect=2)
    assert "did you mean 'observation[ego,speed]'?" in refused.err


def test_command_line_takes_precedence_over_the_class(hunted):
    refused = hunted.crashhunt("run", "x", *WORDS, "--observe", "ego,actor", expect=2)
    assert "--observe: 'actor' is not a part of observations; did you mean 'actors'?" in refused.err
    done = hunted.crashhunt("run", "x", *WORDS, "--observe", "ego", "--keep", "0", "--json")
    assert done.json["outcomes"] == {"agent_error": 1}  # it needs the actors
    assert "'actors'" in hunted.crashhunt("logs", "x").out


@pytest.mark.parametrize(
    ("part", "what"),
    [("signals", "has no part 'signals'"), ("actors:relation=true", "does not have 'actors:relation=true'")],
)
def test_simulator_without_the_part_refuses_in_one_line_and_leaves_nothing_behind(shell, part, what):
    refused = shell.crashhunt("run", "x", "1", "1", "5", "--scenario", "highway", "--observe", part, expect=2)
    assert f"--observe: the simulator of this scenario {what}" in refused.err
    assert refused.err.count("\n") == 1
    assert not (shell.folder / "x").exists()


def test_parts_are_listed_with_columns_and_units(shell):
    listed = {one["name"]: one for one in shell.crashhunt("list", "observations", "--json").json["observations"]}
    ego = listed["ego"]
    assert dict(zip(ego["columns"], ego["units"], strict=True))["yaw_rate"] == "rad/s"
    assert "SUMO" in ego["locator"]
    text = shell.crashhunt("list", "observations").out
    assert "steering" in text
    assert "settings, such as actors:rows=32:" in text
