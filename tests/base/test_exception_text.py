"""Exceptions of any class and size have a text of bounded length, made in bounded time."""

from __future__ import annotations

import linecache
import os
import sys
import time
import traceback

import pytest

from crashhunt.base.exceptions import MAX_TRACEBACK_CHARACTERS, class_name, format_error, in_words, message_of
from crashhunt.errors import CallError, SimulatorError, UsageError

MANY = 50_000
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


class Meta(type):
    __name__ = property(lambda cls: 1 / 0)

    def __hash__(cls):
        raise ValueError


class Liar(Exception, metaclass=Meta):  # noqa: N818
    __class__ = property(lambda self: 1 / 0)

    def __str__(self):  # noqa: PLE0307
        sys.exit(3)


class Text(str):
    __slots__ = ()

    def __len__(self):
        raise ValueError

    def __getitem__(self, key):
        raise ValueError


class Odd(Exception):  # noqa: N818
    def __str__(self):
        return Text("odd")


@pytest.mark.parametrize(
    "make",
    [
        lambda: fail(ValueError("no")),
        lambda: fail(ValueError()),
        lambda: fail(KeyError("a\nb")),
        lambda: deep(900),
        lambda: deep(10**9),
        from_another,
        while_another,
        lambda: with_note(ValueError("x"), ["one", "two\nlines"]),
        lambda: compile("def f(:", "mine.py", "exec"),
        lambda: fail(ExceptionGroup("several", [ValueError(1), ExceptionGroup("more", [KeyError(2)])])),
        lambda: chained(20, how="__context__"),
        lambda: fail(Odd()),
        lambda: fail(KeyboardInterrupt()),
    ],
)
def test_ordinary_exception_is_formatted_as_python_does(make):
    error = raised(make)
    assert format_error(error) == "".join(traceback.format_exception(error))


@pytest.mark.parametrize(
    ("make", "shown"),
    [
        (lambda: fail(ValueError("ab\n" * (LONG // 3))), ["ValueError: ab\nab\n", "(29950000 characters are"]),
        (lambda: fail(KeyError(list(range(4 * MANY)))), ["KeyError: (list of 200000 elements)"]),
        (lambda: chained(MANY, how="__context__"), ["ValueError: 49999\n", "ValueError: 0\n", "(49984 exceptions"]),
        (lambda: chained(MANY, how="__cause__"), ["direct cause of", "ValueError: 49999\n", "ValueError: 0\n"]),
        (
            lambda: fail(ExceptionGroup("several", [ValueError(number) for number in range(MANY)])),
            ["several (50000 sub-exceptions)\n  1 of 50000: ValueError: 0\n", "(49990 more exceptions are"],
        ),
        (lambda: with_note(ValueError("x"), ["note"] * MANY), ["ValueError: x\nnote\n", "(49990 more notes"]),
        (lambda: with_note(ValueError("x"), ["n" * LONG]), ["ValueError: x\nnn", "characters are omitted)"]),
        (lambda: with_note(ValueError("x"), Liar), ["ValueError: x\n"]),
        (lambda: fail(type("N" * LONG, (Exception,), {})("x")), ["N" * 200 + ": x\n"]),
        (lambda: fail(SyntaxError("bad", ("f.py", 1, 1, "x " * LONG, 1, 2))), ["SyntaxError: bad (f.py"]),
        (lambda: fail(Liar()), ["Liar: (its message cannot be had: SystemExit)"]),
        (lambda: exec(compile("\n1/0", "/dev/zero", "exec")), ['File "/dev/zero", line 2', "ZeroDivisionError"]),
    ],
)  # fmt: skip
def test_large_or_odd_exception_is_cut_before_it_is_formatted(make, shown, monkeypatch):
    error = raised(make)
    asked = []
    real = traceback.format_exception
    monkeypatch.setattr(traceback, "format_exception", lambda one: asked.append(one) or real(one))
    began = time.process_time()
    text = format_error(error)
    assert time.process_time() - began < 2.0  # of which Python itself needs much more, or does not end at all
    assert len(text) < MAX_TRACEBACK_CHARACTERS + 100
    for part in shown:
        assert part in text
    is_small = type(error) is ZeroDivisionError
    assert len(asked) == is_small  # the others, Python would take too long for
    assert len(message_of(error)) < 10_100
    assert len(in_words(error)) < 1_300


@pytest.mark.parametrize(("count", "left_out"), [(51, 35), (60, 44)])
def test_long_chain_shows_both_ends_in_order(count, left_out):
    text = format_error(raised(lambda: chained(count, how="__context__")))
    numbers = [int(line.removeprefix("ValueError: ")) for line in text.splitlines() if line.startswith("ValueError")]
    assert numbers == [*range(8), *range(count - 8, count)]
    assert f"… ({left_out} exceptions in between are omitted) …" in text
    assert text.count("During handling of the above exception") == 15


def test_chain_follows_the_cause_and_respects_from_none():
    newest = ValueError("newest")
    newest.__context__ = KeyError("hidden")
    newest.__cause__ = TypeError("the cause " + "x" * 20_000)
    text = format_error(newest)
    assert "hidden" not in text
    assert text.index("TypeError: the cause") < text.index("direct cause of") < text.index("ValueError: newest")
    newest.__cause__ = None
    newest.__context__ = KeyError("x" * 20_000)
    newest.__suppress_context__ = True
    assert "KeyError" not in format_error(newest)
    newest.__suppress_context__ = False
    newest.__context__.__context__ = newest  # a circle
    assert format_error(newest).count("ValueError: newest") == 1


def test_long_traceback_shows_both_ends():
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(60_000)
    try:
        error = raised(lambda: deep(50_000))
    finally:
        sys.setrecursionlimit(limit)
    began = time.process_time()
    text = format_error(error)
    assert time.process_time() - began < 0.5
    assert text.startswith('Traceback (most recent call last):\n  File "')
    assert "in raised\n" in text
    assert "… (49903 frames are omitted) …\n" in text
    assert text.endswith('    raise ValueError("bottom")\nValueError: bottom\n')


def test_source_that_is_a_pipe_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    error = raised(lambda: exec(compile("1/0", str(tmp_path / "pipe"), "exec")))
    assert format_error(error).endswith("in <module>\nZeroDivisionError: division by zero\n")
    linecache.clearcache()


def test_class_and_message_are_those_of_the_exception():
    assert class_name(raised(lambda: fail(Liar()))) == "Liar"
    assert type(message_of(Odd())) is str
    assert message_of(Odd()) == "odd"
    assert message_of(ValueError("abcdef"), 2) == "ab… (4 more characters are left out)"
    assert message_of(ValueError("ab"), 2) == "ab"
    assert message_of(ValueError(1, "b" * 3)) == "(1, 'bbb')"
    assert message_of(ValueError({}, [0] * 200_000)) == "(list of 200000 elements)"
    assert in_words(ValueError("two\n lines")) == "ValueError: two lines"


@pytest.mark.parametrize("kind", [UsageError, SimulatorError, CallError])
def test_copy_of_an_error_has_its_text(kind):
    # Gymnasium's AsyncVectorEnv raises `type(error)(error)` in the main process.
    error = kind("speed is 3", fix="give 2", where="hunt.toml")
    assert str(kind(error)) == str(error) == "hunt.toml: speed is 3; give 2"
    assert str(kind(error, fix="give 1")) == "hunt.toml: speed is 3; give 1"
    assert kind(error).to_json() == error.to_json()
