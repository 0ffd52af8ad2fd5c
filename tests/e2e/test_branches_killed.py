"""Whoever of a hunt with branches is killed: nothing of it goes on, and the hunt can."""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from crashhunt.base.processes import children_of

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks need Linux")

HUNT = (
    "run", "h", "1", "1", "60", "--scenario", "toy", "--arg", "speed=9.5", "--set", "step_wall_s=0.005", "--seed", "3",
    "--disturb", "brake=0.05,stop=0.05", "--branch", "--keep-going",
)  # fmt: skip


def tree(pid: int) -> list[list[int]]:
    """Processes below one, by how far."""
    levels = [[pid]]
    while levels[-1]:
        levels.append([child for parent in levels[-1] for child in children_of(parent)])
    return levels[:-1]


def go_on(pids: list[int]) -> list[int]:
    """Those that have not ended; they may not have been reaped."""
    found = []
    for pid in pids:
        with suppress(OSError):
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
                found.append(pid)
    return found


def wait_for(condition, timeout_s=300.0):
    deadline = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < deadline, "it did not come to that"
        time.sleep(0.01)
    return found


def with_copies(process):
    """The processes of a hunt as soon as a worker of it has a copy asleep that is asked, or another."""
    levels = tree(process.pid)
    return levels if len(levels) > 3 and sum(map(len, levels[3:])) > 1 else None


NIGHTLY = [pytest.param(level, marks=pytest.mark.nightly) for level in (1, 2, 3)]


@pytest.mark.nightly  # by day, episode/test_branching.py ends copies with their process
@pytest.mark.long
@pytest.mark.parametrize("level", [0, *NIGHTLY])  # the hunt, what workers are forked from, a worker, a copy
def test_the_one_that_is_killed_nothing_continues_and_the_hunt_reaches_its_end(toy, level):
    process = toy.start(*HUNT)
    levels = wait_for(lambda: with_copies(process))
    victim = levels[level][-1]
    os.kill(victim, signal.SIGKILL)
    below = [pid for level_of in levels[1:] for pid in level_of]
    if level:
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
        assert "Traceback" not in err
    else:
        process.communicate(timeout=300)
        wait_for(lambda: not go_on(below), timeout_s=60.0)
        (state,) = toy.crashhunt("status", "h", "--json").json["hunts"]
        assert (state["state"], state["branches"]["run_again"]) == ("killed", None)
        toy.crashhunt(*HUNT)
    assert not go_on(below)
    (state,) = toy.crashhunt("status", "h", "--json").json["hunts"]
    assert sum(state["outcomes"].values()) == 1
    assert state["branches"]["run_again"] == state["branches"]["confirmed"] is not None
    assert not [*(toy.folder / "h").glob(".scratch*")]
    assert toy.crashhunt("check", "h").code == 0
