"""The help of `run`: the most used options first, all others by name, and all of them in six groups."""

from __future__ import annotations

import argparse
import re

import pytest

from crashhunt.cli import make_parser
from crashhunt.cli._short_help import short_help

GROUPS = ["what is tested", "search", "faults and probes", "what is kept", "how it runs", "output"]


def run_parser():
    actions = make_parser()._actions
    (commands,) = [action for action in actions if isinstance(action, argparse._SubParsersAction)]
    return commands.choices["run"]


def options_of(parser):
    return {action.option_strings[-1] for action in parser._actions if action.option_strings}


@pytest.mark.parametrize(("width", "lines"), [(80, 48), (120, 42)])
def test_short_help_names_every_option_on_two_screens(monkeypatch, width, lines):
    monkeypatch.setenv("COLUMNS", str(width))
    parser = run_parser()
    text = short_help(parser)
    shown = text.splitlines()
    assert len(shown) <= lines
    assert max(map(len, shown)) <= width
    named = re.findall(r"--[a-z-]+", text)
    assert {*named} == options_of(parser) - {"--help"}
    described = re.findall(r"^  (--[a-z-]+)", text, re.MULTILINE)
    assert len(described) == 10
    assert [line.strip().partition(":")[0] for line in shown if line.strip().partition(":")[0] in GROUPS] == GROUPS


@pytest.mark.parametrize("width", [1, 2, 3])
def test_short_help_is_shown_in_the_narrowest_terminal(monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    parser = run_parser()
    assert {*re.findall(r"--[a-z-]+", short_help(parser))} == options_of(parser) - {"--help"}


def test_full_help_describes_every_option_in_six_groups(toy):
    parser = run_parser()
    full = toy.crashhunt("run", "--help-all").out
    assert options_of(parser) <= {*re.findall(r"--[a-z-]+", full)}
    titles = [group.title for group in parser._action_groups]
    assert titles[2:] == GROUPS
    sizes = [len(group._group_actions) for group in parser._action_groups[2:]]
    assert min(sizes) >= 2
    assert max(sizes) <= 12
    assert toy.crashhunt("run", "-h").out == toy.crashhunt("run", "--help").out
    assert "crashhunt run --help-all describes all options." in toy.crashhunt("run", "--help").out


def test_mistakes_are_reported_as_before(toy):
    said = toy.crashhunt("run", "h", "1", "1", "9", "--scenaro", "toy", expect=2).err
    assert said == "crashhunt: there is no option '--scenaro'; did you mean '--scenario'? see crashhunt run --help\n"
    assert "required: DIR, PARALLEL, TRIALS, MAX_STEPS; see crashhunt run --help" in toy.crashhunt("run", expect=2).err
