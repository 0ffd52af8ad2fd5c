"""`AGENT.NAME`: one parser, one meaning, for run, replay, rerun and suites."""

from __future__ import annotations

import re

import pytest

from crashhunt.base.errors import ArgumentError
from crashhunt.plans import Owners, Takes

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
