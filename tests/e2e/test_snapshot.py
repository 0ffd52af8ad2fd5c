"""What a hunt keeps of the code that it ran, with real git work trees."""

from __future__ import annotations

import os
import shutil

import pytest
from repositories import make_repository

AGENT = """
from pathlib import Path

import numpy as np

from planner import tuning
from planner.linked import OFFSET

class Planner:
    def __init__(self, weights: str = "", mode: str = "a"):
        self.table = np.load(weights)["speeds"] if weights else np.full(100, 8.0)
        self.data = float((Path(__file__).parent / "data.txt").read_text())

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step == tuning.LAST:
            raise ValueError("out of ideas")
        return float(self.table[self.step]) + self.data + OFFSET, 0
"""
RUN = ("run", "../out", "1", "1", "80", "--agent", "planner.agents:Planner", "--scenario", "../toy", "--seed", "1")


@pytest.fixture
def project(toy):
    """A git work tree: src layout, a dirty file, an untracked one, an ignored one, links, an old hunt."""
    tree = toy.folder / "my project"
    package = tree / "src" / "planner"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "agents.py").write_text(AGENT)
    (package / "tuning.py").write_text("LAST = 1000\n")
    (package / "data.txt").write_text("0.5")
    (package / "deleted.py").write_text("")
    (package / "real.py").write_text("OFFSET = 0.25\n")
    (package / "linked.py").symlink_to("real.py")
    (tree / "outside").symlink_to("/etc")
    (tree / ".gitignore").write_text("*.secret\nbuild/\n")
    make_repository(tree)
    (package / "tuning.py").write_text("LAST = 20\n")  # dirty
    (package / "untracked.py").write_text("")
    (package / "deleted.py").unlink()
    (tree / "token.secret").write_text("s3cr3t")
    (tree / "build").mkdir()
    (tree / "build" / "big.bin").write_bytes(bytes(1000))
    os.mkfifo(tree / "pipe")
    toy.environment["PYTHONPATH"] = str(tree / "src")
    toy.folder = tree
    return toy


def test_a_crash_replays_when_the_project_is_gone(project):
    project.crashhunt(*RUN)
    shutil.rmtree(project.folder)
    project.folder = project.folder.parent
    del project.environment["PYTHONPATH"]
    shutil.copytree(project.folder / "out", project.folder / "elsewhere")
    shutil.rmtree(project.folder / "out")
    assert project.crashhunt("replay", "elsewhere", "--json").json["verdict"] == "reproduced"
