"""A test of somebody's own suite: what it prints can be pasted."""

from __future__ import annotations

import re

import pytest

from crashhunt.errors import ArgumentError
from crashhunt.testing import assert_survives


@pytest.mark.nightly
def test_what_is_printed_of_a_crash_in_traffic_is_small_and_can_be_pasted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = {"trials": 6, "max_steps": 300, "arguments": {"speed": "17:25"}}
    with pytest.raises(AssertionError, match="ego drove into left") as raised:
        assert_survives("crashhunt.agents:KeepLaneWithSpeed", "loop", **words)
    (call,) = re.findall(r"^    (assert_survives\(.*\))$", str(raised.value), re.MULTILINE)
    assert "'only': [" in call  # the others drive: actors moved as recorded could not be pasted
    with pytest.raises(AssertionError) as again:
        exec(call, {"assert_survives": assert_survives})
    assert str(again.value).splitlines()[1] == str(raised.value).splitlines()[1]


NEEDS = """
class Needs:
    def __init__(self, speed: float):
        self.speed = speed

    def reset(self, seed):
        pass

    def act(self, observation):
        return (self.speed, 0)
"""


def test_an_agent_that_needs_arguments_has_those_of_the_example_and_no_others(toy, monkeypatch):
    monkeypatch.chdir(toy.folder)
    monkeypatch.syspath_prepend(toy.folder)
    (toy.folder / "needs_speed.py").write_text(NEEDS, encoding="utf-8")
    example = {"seed": 1, "arguments": {"ego": {"speed": 21.0}}, "scenario_arguments": {"gap_m": 20.0}}
    with pytest.raises(AssertionError, match="ego drove into leader at step"):
        assert_survives("needs_speed:Needs", "toy", max_steps=80, example=example)
    for wrong, said in (
        ({"arguments": {"eg": {"speed": 21.0}}}, "takes no argument 'eg.speed'"),
        ({"scenario_arguments": {"gap": 20.0}}, "no argument 'gap'; did you mean 'gap_m'"),
    ):
        with pytest.raises(ArgumentError, match=said):
            assert_survives("needs_speed:Needs", "toy", example={**example, **wrong})
