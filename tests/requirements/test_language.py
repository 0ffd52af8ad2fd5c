"""The language of requirements: what is a formula, and where an error points."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from crashhunt.errors import CrashhuntError, FormulaError
from crashhunt.requirements import parse

MISTAKES = [
    ("", "the requirement is empty"),
    (" \n", "the requirement is empty"),
    ("always (gap_m > 1",
     "the requirement ends too early; close the parenthesis\n  always (gap_m > 1\n                   ^"),
    ("gap > 1 and", "the requirement ends too early; add what is missing"),
    ("alway (gap > 1)", "'alway' is not a function; did you mean 'always'?\n  alway (gap > 1)\n  ^^^^^"),
    ("alwas x > 1", "'alwas' is unknown; did you mean 'always'?\n  alwas x > 1\n  ^^^^^"),
    ("x > 1 ans y > 2", "'ans' is not expected here; did you mean 'and'?\n  x > 1 ans y > 2\n        ^^^"),
    ("maxi(x, y) > 1", "'maxi' is not a function; did you mean 'max'?"),
    ("max(x) > 1", "max has 1 arguments; give it 2 or more"),
    ("abs() > 1", "abs has 0 arguments; give it 1 argument"),
    ("always gap_m >> 1", "'>' is not expected here"),
    ("x = 3", "'=' is not an operator; write == to compare\n  x = 3\n    ^"),
    ("3", "this is a number, not a condition; compare it"),
    ("(gap > 1) + 2 > 3", "this is a condition, not a number"),
    ("abs(x > 1) > 2", "this is a condition, not a number"),
    ("and > 3", "'and' has no operand before it"),
    ("x > 1e999", "this number is too large"),
    ("x > " + "9" * 400, "this number is too large"),
    ("always[5:2] x > 1",
     "a window ends at 2 s, before it begins at 5 s; swap its bounds\n  always[5:2] x > 1\n        ^^^^^"),
    ("always[-1:2] x > 1", "a window begins before 0 s"),
    ("always[0:5s] x > 1", "'5s' is not a bound of a window; write a window as [begin:end] in seconds"),
    ("always[0,5] x > 1", "',' is not a bound of a window"),
    ("always[inf:inf] x > 1", "a window cannot begin at infinity"),
    ("observation[ego,x] > 3",
     "the index in brackets is not a number; give the number that crashhunt signals lists, such as observation[3]"),
    ("abs(info[a) > 3", "the index in brackets is not a number"),
    ("x ≥ 1", "'≥' is not expected here"),
    ("x\x00 > 1", "'\\x00' is not expected here"),
    ("not " * 2000 + "x > 1", "the requirement has more than 200 nested operators"),
    ("x" + " + x" * 2000 + " > 1", "the requirement has more than 200 nested operators"),
    ("x > 1 " * 10_000, "the requirement has 60000 characters; give a formula of at most 10000"),
    (3, "a requirement is int, not text"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), MISTAKES, ids=[message for _, message in MISTAKES])
def test_a_mistake_is_shown_with_its_place_and_its_fix(text, message):
    with pytest.raises(FormulaError) as refused:
        parse(text)
    assert str(refused.value).startswith(message)
    assert "\n" not in refused.value.line
    assert all(len(line) <= 190 for line in refused.value.excerpt.splitlines())


@given(st.text(st.sampled_from("ax1.>=<!()[]:-+*/ \n,é") | st.characters(), max_size=30))
def test_any_text_is_a_formula_or_refused(text):
    try:
        parse(text)
    except CrashhuntError as error:
        assert error.fix


@given(
    st.lists(st.sampled_from([*"()[]:,", "always", "until", "not", "and", "->", "x", "1.5", ">", "-", "max", "inf"]))
)
def test_any_row_of_words_is_a_formula_or_refused(words):
    try:
        parse(" ".join(words))
    except CrashhuntError as error:
        assert error.fix


def test_names_of_signals_have_dots_and_indices_and_may_begin_like_an_operator():
    assert parse("always info.speed > observation[3] and android and until_now").signals == (
        "info.speed", "observation[3]", "android", "until_now",
    )  # fmt: skip


def test_a_requirement_is_printed_as_its_text():
    assert str(parse("always  (x > 1)")) == "always  (x > 1)"


def test_the_horizon_is_the_latest_time_that_windows_name():
    assert parse("always[0:70] eventually[0:30] (x > 1)").horizon_s == 100
    assert parse("always[5:inf] (x > 1 -> once[0:50] (x > 2))").horizon_s == 5


def explained(text, **signals):
    return [
        (one.text, one.holds, one.first, one.last, one.worst, dict(one.values))
        for one in parse(text).explain(signals, 1.0)
    ]


def test_a_violation_is_explained_by_the_parts_that_cause_it():
    assert explained(
        "always (cut_in -> eventually[0:2] (headway_s >= 2))",
        cut_in=[False, True, False, False, False], headway_s=[3.0, 1.0, 1.5, 1.25, 2.0],
    ) == [
        ("cut_in", True, 1, 1, 1, {"cut_in": 1.0}),
        ("(headway_s >= 2)", False, 1, 3, 2, {"headway_s": 1.5}),
    ]  # fmt: skip
    assert explained("always (x > 0) and always (y > 0)", x=[1, 1], y=[1, -1]) == [
        ("(y > 0)", False, 1, 1, 1, {"y": -1.0})
    ]
    assert explained("x > 5 until y > 0", x=[6, 1], y=[0, 0])[0][:2] == ("x > 5 until y > 0", False)
    assert explained("not eventually (x > 3)", x=[1, 4, 5, 1]) == [("(x > 3)", True, 1, 2, 1, {"x": 4.0})]
    assert explained("always (x > 0)", x=[1]) == []
