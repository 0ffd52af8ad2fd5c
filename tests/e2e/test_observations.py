"""Agents that observe parts, on SUMO, from the command line to the replay."""

from __future__ import annotations

from contextlib import closing

import pytest

from crashhunt.crashes import read_bundle
from crashhunt.ledger import Ledger

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
        near = (rows[:, of["same_lane"]] > 0) & (rows[:, of["ahead"]] > 0)
        gap = min(rows[near, of["ahead"]], default=1e9)
        return (0.0 if gap < 6.0 else self.speed, 0)


class Writes(Follows):
    """Tries to change what it has seen."""

    def act(self, observation):
        observation["ego"][0] = 7.0
'''
WORDS = ("4", "60", "--scenario", "intersection", "--seed", "5", "--keep-going", "--keep", "1")


def digests(shell, folder):
    """The digest of each trial."""
    rows = shell.crashhunt("trials", folder).out.splitlines()
    place = rows[0].split(",").index("digest")
    return [row.split(",")[place] for row in rows[1:]]


@pytest.fixture
def hunted(shell, made_once):
    return made_once(hunt, shell)


def hunt(shell):
    (shell.folder / "follows.py").write_text(AGENT)
    shell.crashhunt("run", "h", "2", *WORDS, "--agent", "follows:Follows", "--disturb", "noisy_observation=0.5")


def test_hunt_with_parts_is_the_same_on_any_number_of_workers_and_replays(hunted):
    hunted.crashhunt("run", "other", "1", *WORDS, "--agent", "follows:Follows", "--disturb", "noisy_observation=0.5")
    assert digests(hunted, "h") == digests(hunted, "other")
    (crash,) = (hunted.folder / "h" / "crashes").iterdir()
    assert read_bundle(crash).result.spec.digest_of_changes
    done = hunted.crashhunt("replay", "h", "--json").json
    assert done["verdict"] == "reproduced"
    assert hunted.crashhunt("replay", "h", "--from-log", "--json").json["verdict"] == "reproduced"


@pytest.mark.parametrize(("observed", "of_changes"), [("ego,actors:rows=6", True), ("kinematics", False)])
def test_digest_covers_the_changes_of_parts_and_whole_default_observations(hunted, observed, of_changes):
    words = ("--agent", "follows:Follows", "--observe", observed, "--scenario", "intersection")
    hunted.crashhunt("run", "x", "1", "1", "5", *words, expect=None)
    with closing(Ledger(hunted.folder / "x" / "ledger.sqlite")) as ledger:
        assert ledger.result(0).spec.digest_of_changes is of_changes


def test_parts_that_the_class_names_are_in_the_settings_and_in_the_log(hunted):
    assert 'observation = [\n    "ego",\n    "actors:rows=6",\n]' in (hunted.folder / "h" / "hunt.toml").read_text()
    fields = "observation[ego,speed],observation[actors,0,ahead],speed"
    table = hunted.crashhunt("replay", "h", "--print", fields, "--json").json["table"]
    seen, driven = [row["observation[ego,speed]"] for row in table], [row["speed"] for row in table]
    same = [now == before for now, before in zip(seen[1:], driven[:-1], strict=True)]
    assert all(same[:3])  # an observation shows the state before its step; later, it has noise
    assert table[0]["observation[actors,0,ahead]"] is None
    refused = hunted.crashhunt("replay", "h", "--print", "observation[ego,sped]", expect=2)
    assert "did you mean 'observation[ego,speed]'?" in refused.err


def test_command_line_takes_precedence_over_the_class(hunted):
    refused = hunted.crashhunt("run", "x", "1", *WORDS, "--observe", "ego,actor", expect=2)
    assert "--observe: 'actor' is not a part of observations; did you mean 'actors'?" in refused.err
    done = hunted.crashhunt("run", "x", "1", "1", "5", "--agent", "follows:Follows", "--observe", "ego", "--json")
    assert done.json["outcomes"] == {"agent_error": 1}  # it needs the actors
    assert "'actors'" in hunted.crashhunt("logs", "x").out


def test_observation_cannot_be_changed_by_the_agent(hunted):
    done = hunted.crashhunt("run", "x", "1", "1", "5", "--agent", "follows:Writes", "--json")
    assert done.json["outcomes"] == {"agent_error": 1}


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
