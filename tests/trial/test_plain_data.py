"""Errors, trials and results: what crosses process boundaries and files."""

from __future__ import annotations

import inspect
import json
import math
import pickle

import pytest
from hypothesis import given, strategies as st

from crashhunt.base import errors
from crashhunt.errors import CrashhuntError
from crashhunt.trial import CRASHES, Collision, Escape, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.world import Actor, ActorState, ClosestApproach, Path, Paths

ALL_ERRORS = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, CrashhuntError)]


@pytest.mark.parametrize("kind", ALL_ERRORS)
def test_an_error_keeps_its_parts_across_processes(kind):
    error = kind("the value 3 is bad", fix="give 4", where="here")
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), copy.to_json()) == (kind, str(error), error.to_json())
    assert str(error) == "here: the value 3 is bad; give 4"
    assert kind.__name__ in errors.__doc__


numbers = st.floats(allow_nan=False)
finite = st.floats(allow_nan=False, allow_infinity=False)
values = st.one_of(st.booleans(), st.integers(-(2**53), 2**53), finite, st.text())
names = st.lists(st.text()).map(tuple)
hits = st.builds(Collision, st.text(), st.text(), st.text(), st.text(), names, x=finite)
ways = st.builds(
    Path,
    st.builds(Actor, st.text(), st.text(), finite, finite),
    st.integers(0, 99),
    st.tuples(
        st.builds(ActorState, *[finite] * 6)
    ),  # a named tuple: what has a default would be any number, of any size
)
results = st.builds(
    TrialResult,
    spec=st.builds(
        TrialSpec,
        number=st.integers(0, 10**9),
        seed=st.integers(0, 2**31 - 1),
        arguments=st.dictionaries(st.text(), st.dictionaries(st.text(), values)),
        scenario_arguments=st.dictionaries(st.text(), values),
        max_steps=st.integers(1, 10**9),
        only=st.none() | names,
        script=st.none() | st.builds(Paths, finite, st.integers(0, 99), st.just(()), st.tuples(ways)),
    ),
    outcome=st.sampled_from(Outcome),
    steps=st.integers(0, 10**9),
    sim_time_s=st.floats(0, 1e9),
    digest=st.text("0123456789abcdef", min_size=32, max_size=32),
    closest=st.builds(ClosestApproach, numbers, numbers.map(abs), st.floats(0, 1e9)),
    collision=st.none() | hits,
    failure=st.none() | st.builds(Failure, st.text(), st.text(), exit_code=st.none() | st.integers(-64, 255)),
    wall_s=st.floats(0, 1e6),
    worker=st.integers(0, 2**22),
    kept=st.booleans(),
)


@given(results)
def test_a_result_survives_strict_json(result):
    text = json.dumps(result.to_json(), allow_nan=False)
    assert repr(TrialResult.from_json(json.loads(text))) == repr(result).replace("-inf", "inf")
    assert isinstance(result.summary, str)


def test_outcomes_are_distinguished():
    assert {str(outcome) for outcome in CRASHES} == {
        "collision", "off_road", "agent_error", "simulator_error", "process_died", "hang",
    }  # fmt: skip
    assert Outcome.COLLISION.category == Outcome.OFF_ROAD.category == "traffic crash"
    assert Outcome.HANG.category == Outcome.AGENT_ERROR.category == "software fault"
    assert Outcome.INVALID.category == Outcome.FINISHED.category == "no crash"


def test_what_never_happened_is_null_in_json():
    assert ClosestApproach().to_json() == {"time_to_collision_s": None, "gap_m": None, "required_deceleration": 0.0}
    assert math.isinf(ClosestApproach.from_json(ClosestApproach().to_json()).gap_m)


def test_specification_without_arguments_has_none():
    found = TrialSpec.from_json({"number": 3, "seed": 7, "max_steps": 9})
    assert found == TrialSpec(3, 7, {}, {}, max_steps=9)


def test_failure_and_escape_of_which_little_is_written_have_empty_values():
    assert Failure.from_json({}) == Failure("", "")
    assert Escape.from_json({"step": 3}) == Escape(step=3, too_late=None, braking=None, how="")
