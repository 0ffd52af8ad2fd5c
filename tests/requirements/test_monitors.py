"""A monitor finds a violation at the first step at which it is certain, and never one that a later step undoes."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest
from conftest import examples
from formulas import SIGNALS, ByDefinition, random_formula, random_trace, written
from hypothesis import given, settings, strategies as st

from crashhunt.errors import CrashhuntError
from crashhunt.requirements import Monitor, parse


def first_alarm(requirement, trace, step_s=1.0):
    monitor = Monitor(requirement, step_s)
    for at in range(len(trace["a"])):
        if monitor.add([trace[name][at] for name in monitor.signals]):
            return at
    return None


def first_certain(tree, trace):
    """The first sample up to which the greatest possible value is below zero, by the definition of intervals."""
    for at in range(len(trace["a"])):
        seen = {name: values[: at + 1] for name, values in trace.items()}
        if ByDefinition(seen, truth=True, later=True).value(tree, 0)[1] < 0:
            return at
    return None


def assert_at_the_certain_step(seed: int, depth: int, count: int) -> None:
    draw = Random(seed)
    tree, trace = random_formula(draw, depth, bound=3), random_trace(draw, count)
    assert first_alarm(parse(written(tree)), trace) == first_certain(tree, trace)


@given(seed=st.integers(0, 2**32))
@settings(max_examples=examples(200))
def test_a_violation_is_found_at_the_first_step_at_which_it_is_certain(seed):
    assert_at_the_certain_step(seed, 3, 10)


@given(seed=st.integers(0, 2**32))
@settings(max_examples=100)
def test_an_invariant_is_violated_at_the_first_certain_step(seed):
    draw = Random(seed)
    inner, trace = random_formula(draw, 2, bound=3), random_trace(draw, 10)
    tree = ("always", draw.choice([None, (0, 4), (2, 7)]), inner)
    assert first_alarm(parse(written(tree)), trace) == first_certain(tree, trace)


@pytest.mark.nightly
@pytest.mark.timeout(3600)  # a minute on an idle machine
def test_20_000_violations_are_found_at_the_first_certain_step():
    for seed in range(20_000):
        assert_at_the_certain_step(seed, 4, 14)


@given(seed=st.integers(0, 2**32))
@settings(max_examples=examples(200))
def test_no_later_sample_undoes_a_violation(seed):
    draw = Random(seed)
    requirement, trace = parse(written(random_formula(draw, 3, bound=3))), random_trace(draw, 8)
    at = first_alarm(requirement, trace)
    if at is not None:
        for _ in range(5):
            later = random_trace(draw, draw.randint(0, 8))
            whole = {name: np.array(trace[name][: at + 1] + later[name]) for name in SIGNALS}
            assert not requirement.satisfied(whole, 1.0)


def test_a_monitor_keeps_the_trace_with_its_boolean_signals():
    monitor = Monitor(parse("always (cut_in -> x > 0)"), 0.5)
    assert [monitor.add(row) for row in ([False, -1.0], [True, 1.0], [True, -0.5])] == [False, False, True]
    trace = monitor.trace()
    assert trace["cut_in"].dtype == bool
    assert monitor.requirement.robustness(trace, 0.5) == -0.5


@pytest.mark.parametrize(("text", "row"), [("1 / x > 1", [0.0]), ("sqrt(x) > 1", [-1.0]), ("x - x > 1", [np.inf])])
def test_a_term_without_a_value_is_an_error_at_its_sample(text, row):
    monitor = Monitor(parse(f"always ({text})"), 1.0)
    monitor.add([4.0])
    with pytest.raises(CrashhuntError, match="at sample 1: "):
        monitor.add(row)


def test_a_long_trace_is_monitored_in_bounded_time():
    """Of an unbounded operator inside, only the first samples are evaluated at each step; the end decides the rest."""
    monitor = Monitor(parse("always (x > 0 -> once (x < 0))"), 1.0)
    assert not any(monitor.add([-1.0 if not at else 1.0]) for at in range(4500))


def test_a_window_that_does_not_fit_the_step_length_is_refused_before_the_first_sample():
    with pytest.raises(CrashhuntError, match="not a multiple of the step length"):
        Monitor(parse("always[0:1] (x > 1)"), 0.3)
