"""Exceptions of any class and size have a text of bounded length."""

from __future__ import annotations

import pickle
import sys
import traceback

import pytest

from crashhunt.base.exceptions import MAX_TRACEBACK_CHARACTERS, class_name, format_error, in_words, message_of
from crashhunt.errors import CallError, CrashhuntError, FormulaError, InternalError, SimulatorError, UsageError

LONG = 30_000_000  # characters


def raised(make):
    try:
        make()
    except BaseException as error:
        return error
    raise AssertionError("did not raise")


def fail(error):
    raise error


def deep(levels):
    if levels == 0:
        raise ValueError("bottom")
    deep(levels - 1)


def chained(count, *, how):
    newest = ValueError(0)
    for number in range(1, count):
        error = ValueError(number)
        setattr(error, how, newest)
        newest = error
    raise newest


def with_note(error, notes):
    error.__notes__ = notes
    raise error


def from_another():
    try:
        deep(1)
    except ValueError as error:
        raise KeyError("top") from error


def while_another():
    try:
        deep(1)
    except ValueError:
        raise KeyError("top") from None


class Mute(Exception):  # noqa: N818
    def __str__(self):  # noqa: PLE0307
        sys.exit(3)


@pytest.mark.parametrize(
    "make",
    [
        lambda: fail(ValueError("no")),
        lambda: fail(ValueError()),
        lambda: fail(KeyError("a\nb")),
        lambda: deep(900),
        from_another,
        while_another,
        lambda: with_note(ValueError("x"), ["one", "two\nlines"]),
        lambda: compile("def f(:", "mine.py", "exec"),
        lambda: fail(ExceptionGroup("several", [ValueError(1), ExceptionGroup("more", [KeyError(2)])])),
        lambda: chained(20, how="__context__"),
        lambda: fail(KeyboardInterrupt()),
    ],
)
def test_ordinary_exception_is_formatted_as_python_does(make):
    error = raised(make)
    assert format_error(error) == "".join(traceback.format_exception(error))


@pytest.mark.parametrize(
    ("make", "shown"),
    [
        (lambda: fail(ValueError("ab\n" * (LONG // 3))), ["ValueError: ab\nab\n", "characters are omitted)"]),
        (lambda: with_note(ValueError("x"), ["n" * LONG]), ["ValueError: x\nnn", "characters are omitted)"]),
        (lambda: chained(900, how="__cause__"), ["ValueError: 0\n", "ValueError: 899\n"]),
        (lambda: fail(ExceptionGroup("several", [ValueError(number) for number in range(900)])), ["ValueError: 0\n"]),
        (lambda: fail(type("N" * LONG, (Exception,), {})("x")), ["NNN", "characters are omitted)"]),
        (lambda: fail(Mute()), ["Mute: (its message cannot be had: SystemExit)"]),
    ],
)
def test_text_of_a_large_or_mute_exception_is_bounded(make, shown):
    error = raised(make)
    text = format_error(error)
    assert len(text) < MAX_TRACEBACK_CHARACTERS + 100
    for part in shown:
        assert part in text
    assert len(message_of(error)) < 10_100
    assert len(in_words(error)) < 1_300


def test_endless_recursion_shows_its_last_frames():
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(30_000)
    try:
        error = raised(lambda: deep(20_000))
    finally:
        sys.setrecursionlimit(limit)
    text = format_error(error)
    assert text.startswith('Traceback (most recent call last):\n  File "')
    assert "in raised\n" not in text
    assert text.endswith('    raise ValueError("bottom")\nValueError: bottom\n')


def test_class_and_message_are_those_of_the_exception():
    assert class_name(raised(lambda: fail(Mute()))) == "Mute"
    assert message_of(ValueError("abcdef"), 2) == "ab… (4 more characters are left out)"
    assert message_of(ValueError("ab"), 2) == "ab"
    assert message_of(ValueError(1, "b" * 3)) == "(1, 'bbb')"
    assert in_words(ValueError("two\n lines")) == "ValueError: two lines"


@pytest.mark.parametrize("kind", [UsageError, SimulatorError, CallError, FormulaError])
def test_copy_of_an_error_has_its_text(kind):
    # Gymnasium's AsyncVectorEnv raises `type(error)(error)` in the main process.
    error = kind("speed is 3", fix="give 2", where="hunt.toml")
    assert str(kind(error)) == str(error) == "hunt.toml: speed is 3; give 2"
    assert str(kind(error, fix="give 1")) == "hunt.toml: speed is 3; give 1"
    assert str(kind(error, where="x")) == "x: speed is 3; give 2"
    assert str(kind("speed is 3")) == "speed is 3"
    assert str(kind("speed is 3", where="a\nb")) == "$'a\\x0ab': speed is 3"
    for same in (kind(error), pickle.loads(pickle.dumps(error)), kind.from_json(error.to_json())):
        assert (type(same), same.to_json()) == (kind, error.to_json())


def test_traceback_of_a_defect_crosses_processes_and_json():
    fault = InternalError("crashhunt itself failed", fix="report it", where="trial 3")
    fault.traceback = "Traceback: here"
    for same in (pickle.loads(pickle.dumps(fault)), CrashhuntError.from_json(fault.to_json())):
        assert (type(same), str(same), same.traceback) == (InternalError, str(fault), "Traceback: here")
    older = CrashhuntError.from_json({"error": {"message": "failed"}})  # versions before this one wrote fewer keys
    assert (type(older), str(older)) == (CrashhuntError, "failed")


def test_explained_error_has_the_names_of_the_user():
    error = UsageError("max_steps is 3", fix="give 2", where="max_steps")
    error.explain("", lambda text: text.replace("max_steps", "--steps"))
    assert (str(error), error.args) == ("--steps: --steps is 3; give 2", ("--steps is 3", "give 2", "--steps"))
    error.explain("give 5", str.upper)
    assert str(error) == "--STEPS: --STEPS IS 3; give 5"


@pytest.mark.parametrize(("begin", "end"), [(0, 3), (59, 61), (60, 60), (61, 62), (150, 300), (395, 400)])
def test_place_in_a_long_formula_is_marked_below_it(begin, end):
    text = "".join(chr(0x4E00 + number) for number in range(399)) + "\n"
    shown, marks = (line[2:] for line in FormulaError("no", text=text, begin=begin, end=end).excerpt.split("\n"))
    marked = "".join(char for char, mark in zip(shown, marks, strict=False) if mark == "^")
    assert marked == (text[begin : min(max(end, begin + 1), begin + 60)]).replace("\n", " ")
    assert shown == text[max(0, begin - 60) : min(end, begin + 60) + 60].replace("\n", " ")
    assert marks.strip(" ^") == ""


def test_python_does_not_format_a_message_of_a_million_lines(monkeypatch):
    monkeypatch.setattr(traceback, "format_exception", lambda *_, **__: pytest.fail("it takes seconds"))
    try:
        raise ValueError("ab\n" * 1_000_000)
    except ValueError as error:
        text = format_error(error)
    assert text.startswith("Traceback (most recent call last):\n")
    assert f'File "{__file__}"' in text
    assert "characters are omitted) …" in text
    assert text.endswith("ab\n\n")
