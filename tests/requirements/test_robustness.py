"""Formulas have the value of their definition, for every operator and window, and the value that rtamt computes."""

from __future__ import annotations

import importlib.util
import itertools
import math
from random import Random

import numpy as np
import pytest
from conftest import examples
from formulas import SIGNALS, ByDefinition, random_formula, random_trace, written
from hypothesis import given, settings, strategies as st

from crashhunt.errors import CrashhuntError
from crashhunt.requirements import parse


def arrays(trace):
    return {name: np.array(values) for name, values in trace.items()}


def assert_as_defined(seed: int, depth: int = 3, count: int = 12, step_s: float = 1.0) -> None:
    draw = Random(seed)
    tree, trace = random_formula(draw, depth), random_trace(draw, draw.randint(1, count))
    requirement = parse(written(tree, step_s))
    signals = arrays(trace)
    defined = ByDefinition(trace)
    length = len(trace["a"])
    values = requirement.values(signals, step_s)
    assert np.broadcast_to(values, length).tolist() == [defined.value(tree, at)[0] for at in range(length)]
    assert requirement.robustness(signals, step_s) == values[0]
    assert min(map(max, requirement.parts(signals, step_s))) == values[0]
    assert requirement.satisfied(signals, step_s) == (ByDefinition(trace, truth=True).value(tree, 0)[0] > 0)
    assert requirement.satisfied(signals, step_s) == (min(requirement.slack_s(signals, step_s)) > 0)


@given(seed=st.integers(0, 2**32), step_s=st.sampled_from([1.0, 0.1, 1 / 15]))
@settings(max_examples=examples(300))
def test_every_formula_has_the_value_of_its_definition(seed, step_s):
    assert_as_defined(seed, step_s=step_s)


@pytest.mark.nightly
@pytest.mark.timeout(3600)  # a minute on an idle machine
def test_20_000_formulas_have_the_value_of_their_definition():
    for seed in range(20_000):
        assert_as_defined(seed, depth=4, count=25)


def _specified(specification, tree):
    for name in SIGNALS:
        specification.declare_var(name, "float")
    specification.set_sampling_period(1, "s", 0.1)
    specification.spec = written(tree)
    specification.parse()
    return specification


def _mirrored(tree):
    past = {"always": "historically", "eventually": "once", "until": "since"}
    return (past.get(tree[0], tree[0]), *(_mirrored(one) if isinstance(one, tuple) else one for one in tree[1:]))


def _known_to_rtamt(*, past: bool):
    """Yield 20,000 formulas without ``min`` and ``max``, which rtamt does not know, and a trace for each."""
    trees = (random_formula(Random(seed), 3, past=past) for seed in itertools.count())
    known = (tree for tree in trees if "min(" not in written(tree) and "max(" not in written(tree))
    for seed, tree in enumerate(itertools.islice(known, 20_000)):
        draw = Random(seed)
        yield tree, random_trace(draw, draw.randint(2, 25))


@pytest.mark.nightly
@pytest.mark.skipif(importlib.util.find_spec("rtamt") is None, reason="pip install rtamt")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.timeout(3600)  # seven minutes: rtamt parses slowly
def test_20_000_formulas_have_the_value_that_rtamt_computes():
    import rtamt

    for tree, trace in _known_to_rtamt(past=True):
        count = len(trace["a"])
        values = np.broadcast_to(parse(written(tree)).values(arrays(trace), 1.0), count)
        specification = _specified(rtamt.StlDiscreteTimeOfflineSpecification(), tree)
        found = specification.evaluate({"time": [*range(count)], **trace})
        assert values == pytest.approx([value for _, value in found], abs=1e-9)


@pytest.mark.nightly
@pytest.mark.skipif(importlib.util.find_spec("rtamt") is None, reason="pip install rtamt")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.timeout(3600)
def test_20_000_formulas_of_the_past_have_the_value_that_rtamt_computes_sample_by_sample():
    """Of the future, whole traces only are compared: rtamt delays a comparison beside a window twice."""
    import rtamt

    for tree, trace in _known_to_rtamt(past=False):
        of_the_past = _mirrored(tree)
        count = len(trace["a"])
        values = np.broadcast_to(parse(written(of_the_past)).values(arrays(trace), 1.0), count)
        specification = _specified(rtamt.StlDiscreteTimeOnlineSpecification(), of_the_past)
        rows = ([(name, values[at]) for name, values in trace.items()] for at in range(count))
        assert values == pytest.approx([specification.update(at, row) for at, row in enumerate(rows)], abs=1e-9)


def test_the_sign_of_the_robustness_agrees_with_the_truth():
    for seed in range(300):
        draw = Random(seed)
        requirement, signals = parse(written(random_formula(draw, 3))), arrays(random_trace(draw, 8))
        robustness = requirement.robustness(signals, 1.0)
        if robustness:
            assert requirement.satisfied(signals, 1.0) == (robustness > 0)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("always[3:5] (x > 0)", math.inf),  # the trace has three samples
        ("eventually[3:5] (x > 0)", -math.inf),
        ("historically[1:2] (x > 0)", math.inf),
        ("once[1:2] (x > 0)", -math.inf),
        ("(x > 0) until[3:4] (x > 0)", -math.inf),
        ("(x > 0) since[1:1] (x > 0)", -math.inf),
        ("always[1:9] (x > 0)", 2.0),
        ("true", math.inf),
        ("x", 1.0),
        ("0 < x < 3", 1.0),
        ("x == 1", 0.0),
        ("x != 4", 3.0),
        ("x > 0 -> x > 5 -> x > 9", 4.0),  # as x > 0 -> (x > 5 -> x > 9)
        ("always x > 0 and x < 3", 1.0),  # as (always x > 0) and (x < 3)
        ("not x > 3 or x > 9", 2.0),
        ("x - 1 - 1 < 2 * x + 1", 4.0),
        ("x / 2 >= .5e0", 0.0),
        ("max(x, 2, -x) > sqrt(4)", 0.0),
        ("-x < -abs(-3)", -2.0),
    ],
)
def test_windows_are_cut_at_the_end_and_operators_bind_as_documented(text, value):
    assert parse(text).robustness({"x": np.array([1.0, 2.0, 3.0])}, 1.0) == value


def test_a_boolean_signal_is_infinitely_true_and_a_number_is_compared_with_zero():
    text = "always (cut_in -> eventually[0:1] (headway_s >= 2))"
    headway = np.array([1.0, 1.5, 1.25, 3.0])
    for cut_in, value in [(np.array([False, True, False, False]), -0.5), (np.array([0, 1, 0, 0]), -0.5)]:
        assert parse(text).robustness({"cut_in": cut_in, "headway_s": headway}, 1.0) == value
    assert parse("cut_in").robustness({"cut_in": np.array([True])}, 1.0) == math.inf
    assert parse("cut_in").robustness({"cut_in": np.array([3])}, 1.0) == 3.0
    assert not parse("cut_in").satisfied({"cut_in": np.array([0])}, 1.0)


def test_infinite_signals_have_no_undefined_difference():
    signals = {"ttc_s": np.array([math.inf, 4.0]), "limit": np.array([math.inf, 2.0])}
    assert parse("always (ttc_s >= limit)").robustness(signals, 1.0) == 0.0
    assert parse("always (ttc_s >= 2)").robustness(signals, 1.0) == 2.0


def test_windows_of_any_width_are_evaluated_on_long_traces():
    signals = {"x": np.sin(np.arange(200_000.0))}
    for width, holds in ((1, False), (50_000, True)):
        assert parse(f"always[0:100000] eventually[0:{width}] (x > 0)").satisfied(signals, 1.0) == holds


@pytest.mark.parametrize(
    ("text", "signals", "message"),
    [
        ("always (gap > 1)", {"gap_m": [1.0]},
         "'gap' is unknown; did you mean 'gap_m'?\n  always (gap > 1)\n          ^^^"),
        ("x > 1", {"x": [1.0, math.nan]}, "the signal 'x' is NaN at sample 1; give a number for every sample"),
        ("x > y", {"x": [1.0], "y": [1.0, 2.0]}, "the signal 'y' has 2 samples, and 'x' has 1; give signals of"),
        ("x > 1", {"x": []}, "the trace has no sample"),
        ("x > 1", {"x": 3.0}, "the signal 'x' is no row of numbers: float64 ()"),
        ("x > 1", {"x": ["a"]}, "the signal 'x' is no row of numbers: <U1 (1,)"),
        ("1 / x > 1", {"x": [1.0, 0.0]}, "it divides by zero at sample 1: 1 / x; exclude this case"),
        ("sqrt(x) > 1", {"x": [-1.0]}, "it is not a number at sample 0: sqrt(x)"),
        ("x - x > 1", {"x": [math.inf]}, "it is not a number at sample 0: x - x"),
        ("always[0:0.25] (x > 1)", {"x": [1.0]}, "0.25 s, not a multiple of the step length of 0.1 s; give 0.2"),
    ],
)  # fmt: skip
def test_a_trace_that_cannot_be_evaluated_is_refused_in_one_line(text, signals, message):
    with pytest.raises(CrashhuntError) as refused:
        parse(text).robustness(signals, 0.1)
    assert message in str(refused.value)


@pytest.mark.parametrize("step_s", [0, -1.0, math.inf, math.nan, None, "1"])
def test_a_step_length_that_is_not_above_zero_is_refused(step_s):
    with pytest.raises(CrashhuntError, match="step_length_s is"):
        parse("x > 1").robustness({"x": [1.0]}, step_s)


@pytest.mark.parametrize(
    ("text", "sizes"),
    [
        ("always (a > 0 and b > 0)", [1, 1]),
        ("(always (a > 0) -> always (b > 0)) and c > 0", [2, 1]),
        ("not (a > 0 or eventually (b > 0 or c > 0))", [1, 1]),
        ("eventually (a > 0 or (b > 0 and c > 0))", [2]),
        ("a > 0 until b > 0", [1]),
    ],
)
def test_conjuncts_and_disjuncts_are_those_that_a_minimum_would_mix(text, sizes):
    signals = {"a": np.array([1.0, 2.0]), "b": np.array([-1.0, 3.0]), "c": np.array([0.5, -0.5])}
    assert [len(row) for row in parse(text).parts(signals, 1.0)] == sizes


def test_slack_is_the_time_by_which_a_requirement_on_whole_numbers_holds():
    """A stay of at least 2.5 s is required; the robustness of both sides is 0."""
    requirement = parse(
        "always ((gear != 2 and eventually[0.1:0.1] (gear == 2)) -> eventually[0.1:0.1] always[0:2.4] (gear == 2))"
    )

    def stayed(seconds):
        return {"gear": np.array([1] * 10 + [2] * round(10 * seconds) + [3] * 20)}

    assert [requirement.robustness(stayed(seconds), 0.1) for seconds in (2.4, 2.6, 3.0)] == [0, 0, 0]
    assert not requirement.satisfied(stayed(2.4), 0.1)
    # It may leave 0.1 or 0.5 s earlier; a sample of each side counts as well.
    assert requirement.slack_s(stayed(2.6), 0.1) == pytest.approx((0.3,))
    assert requirement.slack_s(stayed(3.0), 0.1) == pytest.approx((0.7,))
    assert requirement.slack_s({"gear": np.ones(50)}, 0.1) == (math.inf,)  # it never has to hold
