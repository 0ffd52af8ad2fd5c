"""A missing extra is offered to a user at a terminal, and to no one else."""

from __future__ import annotations

import io
import os
import runpy
import shlex
import subprocess
import sys

import pytest

from crashhunt import cli
from crashhunt.base.errors import UsageError
from crashhunt.base.extras import install_command


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def answered(monkeypatch):
    """Runs a command that needs the extra `video`; returns what was installed and what ran again."""

    def run(answer: str, *words: str, terminal: bool = True, ci: str = "") -> list[list[str]]:
        done: list[list[str]] = []
        monkeypatch.setenv("CI", ci)
        monkeypatch.setattr(sys, "stdin", Terminal(answer) if terminal else io.StringIO(answer))
        monkeypatch.setattr(sys, "stderr", Terminal())
        monkeypatch.setattr(
            subprocess, "run", lambda command, **_: done.append(command) or subprocess.CompletedProcess(command, 0)
        )
        monkeypatch.setattr(os, "execv", lambda _, command: done.append(command[1:]))
        cli._offer_extra(UsageError("a film needs Pillow", fix=install_command("video")), words)
        return done

    return run


def test_extra_is_installed_on_request_and_the_command_runs_again(answered):
    install = shlex.split(install_command("video"))
    assert answered("y\n", "replay", "h", "--gif", "a.gif") == [
        install, ["-P", "-m", "crashhunt", "replay", "h", "--gif", "a.gif"]
    ]  # fmt: skip
    assert answered("\n", "replay", "h") == []
    assert answered("", "replay", "h") == []  # the end of the input


def test_nothing_is_asked_without_a_terminal_in_ci_or_with_json(answered):
    assert answered("y\n", "replay", "h", terminal=False) == []
    assert answered("y\n", "replay", "h", ci="true") == []
    assert answered("y\n", "replay", "h", "--json") == []


def test_an_older_python_is_named_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "version_info", (3, 10, 13))
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(cli.__file__.replace("cli/__init__", "__main__"), run_name="__main__")
    said = "crashhunt needs Python 3.11 or later; in a clone, run scripts/crashhunt\n"
    assert (ended.value.code, capsys.readouterr().err) == (2, said)
