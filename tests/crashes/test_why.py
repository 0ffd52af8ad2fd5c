"""What is counted of runs without something, by hand."""

from __future__ import annotations

import json

import pytest

from crashhunt.crashes import Factor, LeftOut, Why
from crashhunt.crashes._judgement import wilson


def factor(*endings):
    return Factor(
        "other", "left.3", "braked", 7, 5.0, tuple(LeftOut(number, end) for number, end in enumerate(endings))
    )


@pytest.mark.parametrize(
    ("endings", "counts", "needed"),
    [
        (("none", "same", "other", "unclear", "same"), (4, 3, 2), None),
        (("none", "none", "unclear"), (2, 0, 0), True),
        (("same", "other"), (2, 2, 1), False),
        (("unclear",), (0, 0, 0), None),
        ((), (0, 0, 0), None),
    ],
)
def test_only_clear_runs_say_something(endings, counts, needed):
    found = factor(*endings)
    assert (found.clear, found.crashed, found.same) == counts
    assert found.needed is needed
    assert (found.interval is None) == (counts[0] == 0)


@pytest.mark.parametrize(
    ("found", "of", "interval"),  # of the tables in Newcombe 1998, or 1.96² worked out by hand
    [(81, 263, (0.2553, 0.3662)), (15, 148, (0.0624, 0.1605)), (0, 20, (0.0, 0.1611)), (1, 29, (0.0061, 0.1718))],
)
def test_the_interval_is_wilsons(found, of, interval):
    assert wilson(found, of) == pytest.approx(interval, abs=5e-5)
    low, high = wilson(of - found, of)
    assert (1 - high, 1 - low) == pytest.approx(interval, abs=5e-5)


def test_it_comes_back_from_json():
    why = Why((factor("none", "same"), Factor("seed", "seed", "drawn", was=3)), 20, 4, "it was interrupted")
    assert why.runs == 2
    assert Why.from_json(json.loads(json.dumps(why.to_json()))) == why
