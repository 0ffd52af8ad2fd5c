"""`AGENT.NAME`: one parser, one meaning, for run, replay, rerun and suites."""

from __future__ import annotations

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


def asked(shell, hunt):
    told = tomllib.loads((shell.folder / hunt / "hunt.toml").read_text())
    return {
        agent: {n: s["spec"] for n, s in chosen.get("arguments", {}).items()}
        for agent, chosen in told["agents"].items()
    }
