"""A test of somebody's own suite: what it prints can be pasted."""

from __future__ import annotations

import pytest

from crashhunt.errors import ArgumentError
from crashhunt.testing import assert_survives

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
