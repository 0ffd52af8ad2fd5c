"""Agents that do not start are refused in one line, and only where no trial could make them start."""

from __future__ import annotations

from dataclasses import replace

import pytest

from crashhunt.base import layout
from crashhunt.errors import ArgumentError
from crashhunt.hunts import Preflight
from crashhunt.plans import Request, plan
from crashhunt.trial import Failure, Outcome, TrialResult, TrialSpec


def settings_of(**arguments):
    _, settings = plan(Request(trials=20, max_steps=5, scenario="loop", arguments=arguments, seed=1))
    return settings


def result(number, message="there is no file 'x'", *, outcome=Outcome.INVALID, agent="ego", kind="ValueError"):
    failure = Failure(kind, message, f'Traceback:\n  File "/s/code/my.py", line {7}, in x\n', agent)
    spec = TrialSpec(number, 1, {"ego": {"speed": 15.0}}, {}, max_steps=5)
    return TrialResult(spec, outcome, failure=failure if outcome is Outcome.INVALID else None)


def test_what_fails_in_every_trial_in_the_same_way_is_refused():
    preflight = Preflight(settings_of(speed="15"), 20, code=("/s/code",))
    assert [preflight.filter_setup_failures(result(number, kind="KeyError")) for number in range(3)] == [[], [], []]
    with pytest.raises(
        ArgumentError, match="KeepLaneWithSpeed does not start: KeyError: there is no file 'x'"
    ) as caught:
        preflight.filter_setup_failures(result(3, kind="KeyError"))
    assert caught.value.where == "my.py:7"
    assert caught.value.exit_code == 2


def test_constructor_that_needs_more_than_it_is_given_is_not_blamed_on_a_line_of_crashhunt():
    failure = result(0, "missing 1 required positional argument: 'a'", kind="TypeError")
    called = f'Traceback:\n  File "{layout.PACKAGE}/episode/_run.py", line 272, in agent\n'
    failed = replace(failure, failure=replace(failure.failure, traceback=called))
    with pytest.raises(ArgumentError, match="missing 1 required") as caught:
        Preflight(settings_of(speed="15"), 1).filter_setup_failures(failed)
    assert caught.value.where == "agent ego"


def test_a_hunt_of_one_trial_is_refused_after_one():
    with pytest.raises(ArgumentError, match="there is no file 'x'; correct the agent"):
        Preflight(settings_of(speed="15"), 1).filter_setup_failures(result(0))


def test_files_are_named_as_they_were_given():
    preflight = Preflight(settings_of(speed="15"), 1, files={"w.onnx": "/s/files/0-w.onnx"})
    with pytest.raises(ArgumentError, match=r"'w.onnx' has nine outputs"):
        preflight.filter_setup_failures(result(0, "'/s/files/0-w.onnx' has nine outputs"))


def test_policy_trained_in_another_environment_names_the_scenario_as_the_fix():
    message = "'m.zip' was trained on observations of shape (5, 5), but those of this scenario have shape (8, 7)"
    with pytest.raises(ArgumentError, match="choose a --scenario with the environment in which it was trained"):
        Preflight(settings_of(speed="15"), 1).filter_setup_failures(result(0, message))


@pytest.mark.parametrize(
    "other",
    [result(9, outcome=Outcome.SURVIVED), result(9, "another reason"), result(9, agent=""), result(9, kind="KeyError")],
)
def test_as_soon_as_one_is_otherwise_all_are_accounted_for(other):
    preflight = Preflight(settings_of(speed="15"), 20)
    held = [result(number) for number in range(3)]
    assert [preflight.filter_setup_failures(one) for one in held] == [[], [], []]
    assert preflight.filter_setup_failures(other) == [*held, other]
    assert preflight.filter_setup_failures(held[0]) == [held[0]]


def test_where_an_argument_varies_another_value_may_do():
    preflight = Preflight(settings_of(speed="5:15"), 20)
    assert preflight.filter_setup_failures(result(0)) == [result(0)]
