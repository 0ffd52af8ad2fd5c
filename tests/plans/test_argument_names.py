"""`AGENT.NAME`: one parser, one meaning, for run, replay, rerun and suites."""

from __future__ import annotations

import json
import re
import tomllib

import pytest

from crashhunt.base.errors import ArgumentError
from crashhunt.plans import Owners, Takes, takes_of

TWO = Owners({"ego": Takes(("speed", "gain")), "ego.2": Takes(("speed", "x"))}, ("vehicles", "gain"))
OPEN = Owners({"ego": Takes(("speed",), open=True, defaults={"speed": 5.0})}, ("vehicles", "speed"))


@pytest.mark.parametrize(
    ("owners", "word", "owner"),
    [
        (TWO, "ego.speed", ("ego", "speed")),
        (TWO, "ego.2.speed", ("ego.2", "speed")),
        (TWO, "x", ("ego.2", "x")),
        (TWO, "vehicles", ("", "vehicles")),
        (TWO, "scenario.gain", ("", "gain")),
        (TWO, "ego.gain", ("ego", "gain")),
        (TWO, "ego.x", None),
        (TWO, "ego.2.gain", None),
        (TWO, "nothing", None),
        (TWO, "scenario.speed", None),
        (OPEN, "ego.anything", ("ego", "anything")),
        (OPEN, "anything", ("ego", "anything")),
        (OPEN, "vehicles", ("", "vehicles")),  # what the scenario declares is not what an agent merely would take
        (Owners({"scenario": Takes(("a",))}, ("a",)), "scenario.a", ("scenario", "a")),
    ],
)
def test_a_name_has_one_owner(owners, word, owner):
    assert owners.of(word, option="--set") == owner


@pytest.mark.parametrize(
    ("owners", "word", "message"),
    [
        (TWO, "speed", "--set speed: several agents take it; write --set ego.speed=… or --set ego.2.speed=…"),
        (TWO, "gain", "--set gain: ego and scenario have it; write --set ego.gain=… or --set scenario.gain=…"),
        (OPEN, "speed", "--set speed: ego and scenario have it; write --set ego.speed=… or --set scenario.speed=…"),
    ],
)
def test_a_name_that_several_have_is_nobodys(owners, word, message):
    with pytest.raises(ArgumentError, match=re.escape(message)):
        owners.of(word, option="--set")


def test_code_is_asked_only_where_the_record_does_not_know():
    asked = []

    def ask(agent):
        asked.append(agent)
        return Takes(("model",), open=agent == "ego.2")

    assert TWO.of_record("ego.speed", ask, option="--set") == ("ego", "speed")
    assert asked == []
    assert TWO.of_record("ego.model", ask, option="--set") == ("ego", "model")
    assert asked == ["ego"]
    assert TWO.of_record("ego.unknown", ask, option="--set") is None
    assert TWO.of_record("ego.2.unknown", ask, option="--set") == ("ego.2", "unknown")
    assert TWO.of_record("ego.model", None, option="--set") is None


AGENTS = """
print("imported")


class Agent:
    def __init__(self, speed=5.0, model=None):
        self.speed = speed

    def reset(self, seed):
        pass

    def act(self, observation):
        return self.speed, 0


class Open(Agent):
    def __init__(self, speed=5.0, *, observation_space, **more):
        self.speed = more.get("faster", speed)
"""


def test_an_agent_states_what_it_takes(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(AGENTS)
    assert takes_of("mine:Agent", folder=tmp_path) == Takes(("speed", "model"), defaults={"speed": 5.0})
    assert takes_of("mine:Open", (str(tmp_path),)) == Takes(("speed",), open=True, defaults={"speed": 5.0})
    assert takes_of("mine:Gone", folder=tmp_path) == Takes(open=True)  # whoever runs it will say so
    assert "speed" in takes_of("keep-lane").names


TOYS = """
schema = 1
simulator = "toy"
[arguments.gap_m]
default = 60.0
[agents.ego]
agent = "mine:Agent"
[agents.other]
agent = "mine:Open"
"""


@pytest.fixture
def two(shell):
    (shell.folder / "mine.py").write_text(AGENTS)
    (shell.folder / "toys").mkdir()
    (shell.folder / "toys" / "scenario.toml").write_text(TOYS)
    return shell


def asked(shell, hunt):
    told = tomllib.loads((shell.folder / hunt / "hunt.toml").read_text())
    return {
        agent: {n: s["spec"] for n, s in chosen.get("arguments", {}).items()}
        for agent, chosen in told["agents"].items()
    }


@pytest.mark.nightly  # by day, the tests of each name below
@pytest.mark.long
def test_run_rerun_suite_and_replay_mean_the_same(two):
    where = ("--scenario", "toys", "--seed", "1", "--crash-on", "collision")
    two.crashhunt("run", "h", "1", "1", "90", *where, "--arg", "other.speed=25", "--arg", "ego.speed=4")
    assert asked(two, "h") == {"ego": {"speed": "4.0"}, "other": {"speed": "25.0"}}
    for words, says in (
        (("--arg", "speed=3"), "several agents take it; write --arg ego.speed=… or --arg other.speed=…"),
        (("--arg", "ego.sped=3"), "takes no argument 'sped'; did you mean 'speed'?"),
    ):
        assert says in two.crashhunt("run", "x", "1", "1", "9", *where, *words, expect=2).err
    refused = (
        ("speed=3", "several agents take it; write --set ego.speed=… or --set other.speed=…"),
        ("ego.unknown=3", "has no argument 'ego.unknown'"),
        ("ego.sped=3", "did you mean 'ego.speed'?"),
    )
    for command in (("rerun", "h", "--to", "x"), ("replay", "h")):
        for word, says in refused:
            done = two.crashhunt(*command, "--set", word, expect=2)
            assert says in done.err
            assert len(done.err.strip().splitlines()) == 1
    assert not (two.folder / "x").exists()

    # One agent's argument, and nobody else's: bare where one only has it, and open agents take what they are given.
    changes = ("--set", "ego.speed=6", "--set", "other.faster=30", "--set", "gap_m=50")
    two.crashhunt("rerun", "h", "--to", "g", *changes)
    assert asked(two, "g") == {"ego": {"speed": "6.0"}, "other": {"faster": "30", "speed": "25.0"}}
    request = json.loads((two.folder / "g" / "request.json").read_text())["request"]
    assert request["arguments"] == {"other.speed": "25.0", "ego.speed": "6", "other.faster": "30"}
    assert request["scenario_arguments"] == {"gap_m": "50"}
    # What has no plain default, as `model`, is in no record, but the code knows it.
    done = two.crashhunt("replay", "h", *changes, "--set", "ego.model=x", "--json", expect=None)
    assert done.json["edits"] == [
        "ego.speed was 4.0 and is 6.0", "other.faster was (not there) and is 30",
        "ego.model was (not there) and is x", "gap_m was 60.0 and is 50.0",
    ]  # fmt: skip
    assert "several agents take it" in two.crashhunt("replay", "h", "--set", "model=x", expect=2).err  # one takes any
    for drivers in ("--from-log", "--code=current"):
        code = 2 if drivers == "--from-log" else None
        done = two.crashhunt("replay", "h", drivers, "--set", "ego.model=x", expect=code)
        assert ("has no argument 'ego.model'" in done.err) == (code == 2)  # recorded actions have no code to ask

    (two.folder / "s.toml").write_text(
        '[[hunts]]\nid = "a"\nscenario = "toys"\ntrials = 1\nmax_steps = 5\nseed = 1\n'
        'arguments = { "ego.speed" = 6, "other.faster" = 30 }\nscenario_arguments.gap_m = 50\n'
    )
    two.crashhunt("suite", "run", "s.toml", "s", "1")
    assert asked(two, "s/a/0") == {"ego": {"speed": "6.0"}, "other": {"faster": "30", "speed": "5.0"}}
    two.crashhunt("rerun", "s", "--all", "--set", "other.speed=7", "--parallel", "1")
    assert asked(two, "s/a/0") == {"ego": {"speed": "6.0"}, "other": {"faster": "30", "speed": "7.0"}}
