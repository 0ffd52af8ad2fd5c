"""What the tab key offers, asked of the completers themselves."""

from __future__ import annotations

from argparse import Namespace

import pytest

from crashhunt.cli import _completion, make_parser


@pytest.fixture
def offer():
    """Return what the completer of an option or a place of a command offers."""
    parser = make_parser()
    _completion._attach(parser)
    (verbs,) = (action for action in parser._actions if action.dest == "COMMAND" or action.choices)

    def offer(command, name, prefix="", **given):
        for action in verbs.choices[command]._actions:
            if name in (*action.option_strings, str(action.metavar)):
                found = list(action.completer(prefix=prefix, parsed_args=Namespace(**given)))
                return [word for word in found if word.startswith(prefix)]
        raise KeyError(name)

    return offer


def test_names_are_those_that_are_registered(offer):
    assert {"idm", "keep-lane"} <= set(offer("run", "--agent"))
    assert {"sobol", "optuna:tpe"} <= set(offer("run", "--sampler"))
    assert {"merge", "loop"} <= set(offer("run", "--scenario"))
    assert "brake=" in offer("run", "--disturb")
    assert "determinism" in offer("guide", "TOPIC")
    assert {"survived", "invalid"} <= set(offer("trials", "--outcome"))
    assert "survived" not in offer("run", "--crash-on")


def test_last_of_several_is_completed_without_those_that_are_there(offer):
    found = offer("run", "--crash-on", "hang,col")
    assert found == ["hang,collision"]
    assert "hang,hang" not in offer("run", "--crash-on", "hang,")
    assert "hang" in offer("run", "--crash-on", "")


def test_crashes_and_runs_are_those_of_the_directory(offer, tmp_path):
    for place in ("crashes/2-x", "crashes/1-y", "near-misses/0-z", "branches/3-w"):
        (tmp_path / "h" / place).mkdir(parents=True)
        (tmp_path / "h" / place / "crash.json").touch()
    (tmp_path / "h" / "crashes" / "empty").mkdir()
    for run in ("town/1", "town/0"):
        (tmp_path / "s" / run).mkdir(parents=True)
        (tmp_path / "s" / run / "hunt.toml").touch()
    found = offer("show", "--crash", directory=tmp_path / "h")
    assert found == sorted(found)
    assert {"1-y", "2-x"} <= set(found)
    assert "empty" not in found
    assert offer("show", "--crash", directory=None) == []
    assert offer("logs", "--run", directory=tmp_path / "s") == ["town/0", "town/1"]
    assert offer("logs", "--run", directory=None) == []


def test_arguments_are_those_of_the_scenario_file(offer, tmp_path):
    file = tmp_path / "scenario.toml"
    file.write_text("[arguments.a]\n[arguments.b]\n[agents.x.arguments.c]\n[agents.y.arguments.c]\n[agents.z]\n")
    for name in (str(tmp_path), str(file)):
        assert offer("run", "--set", scenario=name) == ["a=", "b="]
        assert offer("run", "--arg", scenario=name) == ["c="]
    assert "vehicles=" in offer("run", "--set", scenario=None)
    for text in ("[[", "arguments = 5"):
        file.write_text(text)
        assert offer("run", "--set", scenario=str(tmp_path)) == []
    assert offer("run", "--arg", scenario=str(tmp_path / "x.sumocfg")) == []


def test_paths_are_folders_and_files_of_the_right_kind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("hunts/deep", ".hidden"):
        (tmp_path / folder).mkdir(parents=True)
    for file in ("a.zip", "a.txt", ".b.zip", "hunts/c.zip"):
        (tmp_path / file).touch()
    inside = _completion._paths(".zip")
    assert inside("") == ["a.zip", "hunts/"]
    assert inside("a") == ["a.zip"]
    assert inside("hunts/") == ["hunts/c.zip", "hunts/deep/"]
    assert inside("hunts/d") == ["hunts/deep/"]
    assert inside(".") == [".b.zip", ".hidden/"]
    assert inside("nowhere/") == inside("~no such user/") == []
    assert inside(f"{tmp_path}/h") == [f"{tmp_path}/hunts/"]
    assert "tmp/" in [name.lstrip("/") for name in inside("/t")]
    assert _completion._paths("")("a") == ["a.txt", "a.zip"]


def test_nothing_is_completed_unless_a_shell_asks(monkeypatch):
    monkeypatch.delenv("_ARGCOMPLETE", raising=False)
    parser = make_parser()
    _completion.complete(parser)
    assert not any(hasattr(action, "completer") for action in parser._actions)
