"""Where trials run is chosen by name: one of ours, or somebody's own, on every way to a hunt."""

from __future__ import annotations

import json

import pytest

MINE = """
class Broken:
    def __init__(self, settings, *, parallel):
        raise RuntimeError("no cluster\\nhere")


class Refuses:
    def __init__(self, settings, *, parallel):
        from crashhunt.errors import UsageError

        raise UsageError("nobody answers at 10.0.0.1", fix="start it")
"""
WORDS = ("run", "h", "2", "4", "40", "--scenario", "toy", "--seed", "3", "--arg", "speed=5", "--no-snapshot")


@pytest.fixture
def mine(toy):
    (toy.folder / "mine.py").write_text(MINE)
    return toy


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nope", "'nope' is not a registered name of executors; give one of fresh, pool, "),
        ("pol", "did you mean 'pool'?"),
        ("pool:3", "--executor pool:3: 'pool' takes no argument; write --executor pool"),
        ("mine:Nothing", "'mine:Nothing': mine has no attribute 'Nothing'"),
        ("elsewhere:Pool:3", "No module named 'elsewhere'"),
        ("mine:Broken:x", "'mine:Broken' takes no argument"),
    ],
)
def test_what_there_is_not_is_one_line(mine, name, message):
    commands = [WORDS] if name != "nope" else [WORDS, ("suite", "run", "s.toml", "s"), ("rerun", "made")]
    (mine.folder / "s.toml").write_text('[[hunts]]\nid = "a"\nscenario = "toy"\n')
    (mine.folder / "made").mkdir()
    (mine.folder / "made" / "request.json").write_text("{}")
    for words in commands:
        done = mine.crashhunt(*words, "--executor", name, expect=2)
        assert message in done.err
        assert done.err.count("\n") == 1
    assert not (mine.folder / "h").exists()
    assert not (mine.folder / "s").exists()


def test_one_that_cannot_be_made_states_why(mine):
    done = mine.crashhunt(*WORDS, "--executor", "mine:Broken", "--json", expect=2)
    message = "the executor 'mine:Broken' cannot be created: RuntimeError: no cluster here"
    assert done.json["error"]["message"] == message
    assert "mine.py, line" in done.json["error"]["where"]
    done = mine.crashhunt(*WORDS, "--executor", "mine:Refuses", expect=2)
    assert done.err.strip().endswith("crashhunt: nobody answers at 10.0.0.1; start it")
    assert json.loads(mine.crashhunt("status", "h", "--json").out)["hunts"][0]["state"] == "error"
