from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import unicodedata
from importlib import resources
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import pytest
from browsers import needed
from hypothesis import given, strategies as st

from crashhunt.base.text import (
    command_line,
    count_of,
    format_number,
    format_percent,
    in_lines,
    one_line,
    out_of,
    unescape_letters,
    visible,
)

SPOKEN = "\x1b[2J\x1b]0;title\x07 up\x1b[1A\r\x9b2K \u202eesrever\u2066 a\u0085b\u2028c [bold red]x[/] z"
HOSTILE = f"{SPOKEN} \udc80"


def obeyed(text: str, allowed: str = "\n") -> list[str]:
    """What a terminal would not simply show."""
    kinds = ("Cc", "Cf", "Cs", "Zl", "Zp")
    return [c for c in text if c not in allowed and unicodedata.category(c) in kinds and c not in "\u200c\u200d"]


@given(st.text(st.characters(exclude_categories=())))
def test_nothing_is_obeyed(text):
    assert not obeyed(visible(text), "\n\t")
    assert not obeyed(one_line(text), "")
    assert len(in_lines([text, text]).splitlines()) <= 2
    assert visible(visible(text)) == visible(text)


@given(st.text(st.characters(exclude_categories=("Cc", "Cf", "Cs", "Zl", "Zp"))))
def test_what_is_visible_stays(text):
    assert visible(text) == text


def test_examples():
    assert visible("a\x1b[1m\tb\r\nc\rd") == "a\\x1b[1m\tb\nc\\rd"
    assert one_line("  a:\n    b\r\n\tc \n") == "  a: b c"
    assert visible("ü 漢字 👩\u200d🚗") == "ü 漢字 👩\u200d🚗"


def test_printed_command_is_one_line_that_a_shell_reads_back():
    words = ["plain", "a b", "", "new\nline", "end\n", "it's \\n\t\x1b[2J", "ü\u202e漢\u2028x", "byte \udcff2", SPOKEN]
    line = in_lines([command_line(*words)])
    assert not obeyed(line, "")
    told = subprocess.run(["bash", "-c", f"printf '%s\\0' {line}"], stdout=subprocess.PIPE, check=True).stdout
    assert [os.fsdecode(word) for word in told.split(b"\0")[:-1]] == words


def test_printed_command_quotes_only_what_needs_it():
    assert command_line("crashhunt", "replay", Path("a/ü b"), "c-1.zip") == "crashhunt replay 'a/ü b' c-1.zip"


AGENT = f"""
class Rude:
    def __init__(self, name: str = {SPOKEN!a}):
        pass
    def reset(self, seed):
        print({SPOKEN!a})
    def act(self, observation):
        raise ValueError({SPOKEN!a} + "\\nlast line")
"""


def test_an_agent_cannot_speak_to_the_terminal(toy):
    (toy.folder / "rude.py").write_text(AGENT)
    done = [toy.crashhunt("run", "h", "1", "1", "9", "--scenario", "toy", "--agent", "rude:Rude", "--seed", "1")]
    assert "ValueError" in done[0].out
    done += [toy.crashhunt(command, "h", expect=None) for command in ("show", "logs", "status", "replay")]
    for one in done:
        assert not obeyed(one.out + one.err), one
        assert "\\x1b[2J" in one.out or one is done[3]
    # Files keep what was said.
    assert "\x1b[2J" in next((toy.folder / "h" / "crashes").glob("*/run.log")).read_text(errors="replace")


def test_the_screen_shows_what_is_there():
    from rich.console import Console

    from crashhunt.cli._status import show_states
    from crashhunt.report import Watcher
    from crashhunt.results import HuntState

    shown = StringIO()
    console = Console(file=shown, force_terminal=True, color_system=None, width=200)
    state = HuntState(dir=HOSTILE, state="error", detail=HOSTILE)
    show_states([state], console)
    assert "[bold red]" in shown.getvalue()
    assert not obeyed(shown.getvalue())
    assert Watcher(console, HOSTILE)


def untrusted(folder):
    """The refusal of a crash in an archive, whose index says what it likes about who made it."""
    from crashhunt.crashes import refuse_untrusted

    bundle = SimpleNamespace(hunt=folder, path=folder, snapshot="none", authentication_code="")
    return refuse_untrusted(bundle, where=str(folder / HOSTILE), made_by=f"{HOSTILE}\nTrust it: yes")


def test_refusal_reports_in_one_line_who_made_an_archive(tmp_path, capsys, monkeypatch):
    from crashhunt.cli import _replay, main

    def refuse(*_: object) -> None:
        raise untrusted(tmp_path)

    monkeypatch.setattr(_replay, "opened_crash", refuse)
    with pytest.raises(SystemExit):
        main(["replay", "x.zip"])
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "Trust it: yes made it, and this would run its code" in said
    assert not obeyed(said)


def test_question_of_trust_has_one_line_for_who_made_an_archive(tmp_path, monkeypatch):
    from crashhunt.cli import _trust

    terminal = StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True, readline=lambda: "n\n"))
    assert not _trust.ask_to_trust(untrusted(tmp_path), as_json=False)
    described, question = terminal.getvalue().splitlines()
    assert "Trust it: yes made it, and this would run its code" in described
    assert question == "Trust this code from now on and run it? [y/N] "
    assert not obeyed(described)


def test_trials_are_a_share_of_the_planned_ones_only_where_they_are_fewer():
    assert [out_of(3, 8), out_of(8, 8), out_of(9, 8), out_of(0, 0), out_of(3, 0)] == ["3 of 8", "8 of 8", "9", "0", "3"]
    assert out_of(3, 8, "/") == "3/8"


@pytest.mark.parametrize(
    ("stack", "text"),
    [
        ("stra\\xdfe/\\u6f22.py", "straße/漢.py"), ("\\U0001f697", "🚗"), ("a\\x0ab \\x7f", "a\\x0ab \\x7f"),
        ("\\x80", "\x80"), ("\\ud7ff\\ud800\\udfff\\ue000", "\ud7ff\\ud800\\udfff\ue000"),
        ("\\U0010ffff\\U00110000", "\U0010ffff\\U00110000"), ("\\xd", "\\xd"),
    ],
)  # fmt: skip
def test_letters_of_a_stack_are_shown_and_what_is_none_stays_escaped(stack, text):
    assert unescape_letters(stack) == text


def test_one_step_is_no_plural():
    assert [count_of(number, "step") for number in (0, 1, 2)] == ["0 steps", "1 step", "2 steps"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (0.0010014, "0.001"), (0.0123, "0.0123"), (0.36142, "0.361"), (0.09999, "0.1"), (1.2344, "1.23"),
        (123.4, "123"), (1234.4, "1,234"), (999.6, "1,000"), (4.6123e7, "4.61e7"), (4.2e-6, "4.2e-6"),
        (-0.25, "-0.25"), (1.2345e21, "1.23e21"), (123_456.0, "123,456"), (1e-12, "1e-12"),
        (math.inf, "any number"), (12.0, "12"),
    ],
)  # fmt: skip
def test_numbers_have_three_significant_digits(value, text):
    assert format_number(value) == text


def test_browser_writes_numbers_as_python_does():
    values = [0.0, 0.00123456, 0.36142, 12, 12.345, 999.4, 999.6, 1234.4, -0.25, -1234.6, 1234567.8, 2e6, 4.2e-6, 1e-12]
    script = resources.files("crashhunt.report").joinpath("numbers.js").read_text(encoding="utf-8")
    script += f"; console.log(JSON.stringify({values}.map(formatNumber)))"
    done = subprocess.run([needed("node"), "-e", script], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [format_number(value) for value in values]
    assert format_percent(0.12345) == "12.3 %"
