"""Properties of the language of requirements, on generated formulas and texts."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from formulas import random_formula, random_trace, written
from hypothesis import given, strategies as st

from crashhunt.base.errors import FormulaError
from crashhunt.requirements import parse
from crashhunt.requirements._formula import Compare, Temporal, Until, nodes_of

trees = st.builds(lambda draw, depth: random_formula(draw, depth), st.randoms(use_true_random=False), st.integers(0, 4))
traces = st.builds(random_trace, st.randoms(use_true_random=False), st.integers(1, 12))


def without_spans(node):
    if isinstance(node, tuple):
        return tuple(map(without_spans, node))
    if not is_dataclass(node):
        return node
    return type(node).__name__, *(without_spans(getattr(node, one.name)) for one in fields(node) if one.name != "span")


def arrays(trace):
    return {name: np.array(values) for name, values in trace.items()}


@given(trees)
def test_text_of_each_part_is_parsed_to_the_same_part(tree):
    requirement = parse(written(tree))
    for node in nodes_of(requirement.formula):
        text = requirement.text[slice(*node.span)]
        if isinstance(node, Compare | Temporal | Until):
            assert without_spans(parse(text).formula) == without_spans(node)


@given(trees, traces, st.sampled_from(["", "[0:2]", "[1:3]"]))
def test_not_always_is_eventually_not_and_not_historically_is_once_not(tree, trace, window):
    text, signals = written(tree), arrays(trace)
    for every, some in (("always", "eventually"), ("historically", "once")):
        left = parse(f"not {every}{window} ({text})").values(signals, 1.0)
        assert left.tolist() == parse(f"{some}{window} (not ({text}))").values(signals, 1.0).tolist()


@pytest.mark.parametrize(
    "text",
    [
        "not " * 2400 + "true",
        "(" * 4000 + "true" + ")" * 4000,
        "-" * 9000 + "x > 1",
        "true" + " -> true" * 1200,
        "x" + "+x" * 4000 + "> 1",
        "always " * 1400 + "x",
    ],
)
def test_deep_formulas_are_refused_or_evaluated(text):
    try:
        requirement = parse(text)
    except FormulaError as error:
        assert "more than 200 nested operators" in str(error)
    else:
        assert requirement.satisfied({"x": [1.0]}, 1.0)
