"""What the README shows is run: its files are written as they stand there, its commands are called."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", TEXT, re.DOTALL)


COMMANDS = ("run", "replay", "show", "report", "export", "status", "logs", "rerun", "trials", "compare", "check")
SAYS = {
    "run": ("confirmed: a fresh process", "150 of 150 trials"),
    "replay": ("reproduced: ", "fixed: no crash", "does not show a fix: hunt there"),
    "check": ("1 crash are as written",),
    "show": ("When they touched, ",),
    "export": ("crash.zip (",),
    "suite": ("nightly/town/1",),
    "rerun": ("firm: finished",),
    "compare": ("after crashes less: of 150 trials with the same seeds, 13 crash only in before",),
}


def commands() -> list[str]:
    """The commands behind a prompt, continuation lines joined."""
    found = []
    for kind, block in BLOCKS:
        if kind == "console":
            found += re.findall(r"^\$ (.*)$", block.replace("\\\n", " "), re.MULTILINE)
    return found


@pytest.fixture
def shown(shell):
    """A folder with the files of the README."""
    for _, block in BLOCKS:
        name = re.match(r"(?:# |<!-- )(\w+\.\S+\w)", block)
        if name:
            (shell.folder / name[1]).write_text(block, encoding="utf-8")
    shutil.copy(ROOT / "scenarios/intersection/intersection.net.xml", shell.folder / "town.net.xml")
    return shell


@pytest.mark.timeout(900)  # a minute and a half of hunts, and more on a machine with something else to do
def test_every_command_does_what_it_says(shown):
    ran = []
    for command in commands():
        program, *words = shlex.split(command)
        ran.append(program)
        if program == "scripts/crashhunt":
            # The answer to one of them is no: a crash of other traffic cannot be compared.
            out = shown.crashhunt(*words, expect=int("replay" in words and "--scenario" in words)).out
            assert any(line in out for line in SAYS[words[0]]), out
        else:
            assert program == ".venv/bin/python"
            done = subprocess.run(
                [sys.executable, *words], cwd=shown.folder, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, done.stderr
            assert re.search(r"'outcome': '\w+'|^[\d.]+ s: \[|13 crashes>", done.stdout), done.stdout
    assert len(ran) == 21


def test_the_shown_scenario_is_valid(shown):
    (toml,) = (block for kind, block in BLOCKS if kind == "toml" and 'simulator = "sumo"' in block)
    folder = shown.folder / "mine"
    shutil.copytree(ROOT / "scenarios/loop", folder)
    (folder / "scenario.toml").write_text(toml, encoding="utf-8")
    traffic = folder / "traffic.rou.xml"  # it shows one argument of several
    traffic.write_text(re.sub(r"\$\{(?!vehicles\b)\w+\}", "0.1", traffic.read_text()))
    found = shown.crashhunt("run", "out", "1", "1", "5", "--scenario", "mine", "--json").json
    assert found["outcomes"] == {"survived": 1}


def test_every_option_that_is_mentioned_exists(shell):
    helps = "".join(shell.crashhunt(command, "--help").out for command in COMMANDS)
    known = {*re.findall(r"--[a-z-]+", helps), "--help"}
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", TEXT)) <= known
