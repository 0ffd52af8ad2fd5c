"""A command that the tests fork does what one does that a shell starts."""

from __future__ import annotations

import json
import re

import pytest

WORDS = ("--scenario", "toy", "--agent", "faulty:Raises", "--arg", "at=5", "--seed", "1", "--json")


def told(shell, hunt: str, run) -> tuple:
    done = run("run", hunt, "1", "1", "9", *WORDS)
    (snapshot,) = (shell.folder / hunt / "snapshots").iterdir()
    manifest, environment = (
        json.loads((snapshot / f"{name}.json").read_text()) for name in ("manifest", "environment")
    )
    (crash,) = done.json["crashes"]
    err = re.sub(r"\d+:\d\d \(", "M:SS (", done.err.replace(hunt, "h"))  # how long it took
    err = re.sub(r"^hunting: .*\n", "", err, flags=re.MULTILINE)  # how far it was when somebody looked
    return manifest["files"], manifest["paths"], environment, crash | {"path": ""}, err


def test_its_snapshot_output_and_digests_are_the_same(toy):
    forked, started = told(toy, "forked", toy.crashhunt), told(toy, "started", toy.process)
    # Of what is installed, a fork has imported what other commands need as well.
    assert set(forked[2].pop("loaded")) >= set(started[2].pop("loaded")) > {"numpy"}
    assert forked == started


@pytest.mark.parametrize("words", [("--help",), ("run", "h"), ("status", "nowhere", "--json"), ("--version",)])
def test_its_exit_code_and_output_are_the_same(shell, words):
    assert shell.crashhunt(*words, expect=None) == shell.process(*words, expect=None)


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
