"""Hunts whose folders are deleted while they run: they end with the reason, and resume as if nothing had happened."""

from __future__ import annotations

import json
import shutil

import pytest

AGENT = """
import os
import shutil
from pathlib import Path


class Agent:
    def __init__(self):
        self.step = 0

    def reset(self, seed):
        pass

    def act(self, observation):
        self.step += 1
        for line in Path("delete").read_text().splitlines() if self.step == 3 else ():
            shutil.rmtree(line)
        return 10.0, 0
"""


def hunt(toy, expect):
    words = "run ../hunt 1 2 5 --scenario ../toy --agent agent:Agent --keep-going --set gap_m=60 --json --seed 1"
    done = toy.crashhunt(*words.split(), "--no-snapshot", expect=expect)
    return json.loads(done.out)


@pytest.fixture
def home(toy):
    """The current folder of the commands, with the agent and its list of the folders that it deletes."""
    toy.folder = toy.folder / "home"
    return write_home(toy.folder)


def write_home(folder, *, delete=""):
    folder.mkdir(exist_ok=True)
    (folder / "agent.py").write_text(AGENT, encoding="utf-8")
    (folder / "delete").write_text(str(delete), encoding="utf-8")
    return folder


def test_hunt_whose_directory_was_deleted_fails(toy, home):
    directory = home.parent / "hunt"
    write_home(home, delete=directory)
    error = hunt(toy, 2)["error"]
    assert "deleted" in error["message"]
    shutil.rmtree(directory, ignore_errors=True)
    write_home(home)
    assert hunt(toy, 0)["outcomes"] == {"survived": 2}
