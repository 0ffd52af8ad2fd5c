"""A command that the tests fork does what one does that a shell starts."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

WORDS = ("--scenario", "toy", "--agent", "faulty:Raises", "--arg", "at=5", "--seed", "1", "--json")
TELLS = """
import inspect, json, pathlib, sys

from faulty import Raises

class Agent(Raises):
    def __init__(self):
        super().__init__(at=5)
        ours = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == "crashhunt"}
        files = {
            name: [found.__file__, found.__spec__.origin, found.__loader__.path, list(getattr(found, "__path__", []))]
            for name, found in ours.items()
        }
        code = {
            f"{name}.{inner}": function.__code__.co_filename
            for name, module in ours.items()
            for inner, function in vars(module).items()
            if inspect.isfunction(function) and function.__module__ == name
        }
        said = ours["crashhunt.world"].__doc__
        again = "-again" * ("/snapshots/" in ours["crashhunt"].__file__)
        pathlib.Path(f"{sys.argv[0]}{again}.json").write_text(json.dumps([files, code, said]))
"""
FORK_SERVER = "crashhunt.executors._fork_server"


def told(shell, hunt: str, run) -> tuple:
    (shell.folder / "tells.py").write_text(TELLS)
    done = run("run", hunt, "1", "1", "9", "--scenario", "toy", "--agent", "tells:Agent", "--seed", "1", "--json")
    (snapshot,) = (shell.folder / hunt / "snapshots").iterdir()
    manifest, environment = (
        json.loads((snapshot / f"{name}.json").read_text()) for name in ("manifest", "environment")
    )
    (crash,) = done.json["crashes"]
    err = re.sub(r"\d+:\d\d \(", "M:SS (", done.err.replace(hunt, "h"))  # how long it took
    err = re.sub(r"^(running: |confirming ).*\n", "", err, flags=re.MULTILINE)  # progress, which depends on the time
    run("replay", hunt)
    processes = (FORK_SERVER, f"{FORK_SERVER}-again")
    imported = [imported_by(shell, process, hunt) for process in processes]
    return manifest["files"], manifest["paths"], environment, crash | {"path": ""}, err, imported


def imported_by(shell, process: str, hunt: str) -> list:
    """What a process of the hunt had of crashhunt, where it was from, and what one of it said."""
    return json.loads((shell.folder / f"{process}.json").read_text().replace(f"/{hunt}/", "/h/"))


@pytest.mark.nightly  # of forks of the tests themselves
def test_its_snapshot_output_and_digests_are_the_same(toy):
    forked, started = told(toy, "forked", toy.crashhunt), told(toy, "started", toy.process)
    # Of what is installed, a fork has imported what other commands need as well.
    assert set(forked[2].pop("loaded")) >= set(started[2].pop("loaded")) > {"numpy"}
    assert forked[:-1] == started[:-1]
    for (files, code, said), (files_of_started, code_of_started, said_of_started) in zip(
        forked[-1], started[-1], strict=True
    ):
        # Forks have in addition imported what a trial imports that ends in a collision, from the same folder.
        assert {name: files[name] for name in files_of_started} == files_of_started
        for replaced in ("episode._failures._contents_of", "executors._preparation._rehearse"):  # by the tests' server
            code_of_started.pop(f"crashhunt.{replaced}", None)
        assert {name: code[name] for name in code_of_started} == code_of_started
        folder = Path(files["crashhunt"][0]).parent
        assert all(Path(path).is_relative_to(folder) for path, *_ in files.values())
        assert said == said_of_started
    # And if what is in a snapshot is not what is here, it is what runs.
    (file,) = (toy.folder / "forked" / "snapshots").glob("*/code/crashhunt/world/__init__.py")
    file.write_text(file.read_text(encoding="utf-8").replace('"""', '"""Not here. ', 1), encoding="utf-8")
    toy.crashhunt("replay", "forked", "--force", "--trust", expect=None)
    *_, said = imported_by(toy, f"{FORK_SERVER}-again", "forked")
    assert said.startswith("Not here. ")


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(("--help",), marks=pytest.mark.nightly),
        ("run", "h"),
        pytest.param(("--version",), marks=pytest.mark.nightly),
        pytest.param(("status", "nowhere", "--json"), marks=pytest.mark.nightly),
    ],
)
def test_its_exit_code_and_output_are_the_same(shell, words):
    assert shell.crashhunt(*words, expect=None) == shell.process(*words, expect=None)


@pytest.mark.nightly  # of forks of the tests themselves
def test_nothing_of_it_reaches_the_next(toy):
    (toy.folder / "other").mkdir()
    (toy.folder / "other" / "faulty.py").write_text("from crashhunt.agents import KeepLaneWithSpeed as Raises\n")
    toy.crashhunt("run", "h", "1", "1", "9", *WORDS)
    folder, toy.folder = toy.folder, toy.folder / "other"
    (toy.folder / "toy").symlink_to(folder / "toy")
    done = toy.crashhunt("run", "h", "1", "1", "9", "--scenario", "toy", "--agent", "faulty:Raises", "--json")
    assert done.json["crashes"] == []


def test_variables_that_python_reads_when_it_starts_start_one(shell):
    (shell.folder / "sitecustomize.py").write_text("print('started')")
    shell.environment["PYTHONPATH"] = str(shell.folder)
    assert shell.crashhunt("--version").out.startswith("started\n")
