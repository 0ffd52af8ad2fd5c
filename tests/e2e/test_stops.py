"""A stop is never a crash, and leaves nothing behind; only the hunt's own failures end it, in one line."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest
from conftest import wait_for

from crashhunt.base.processes import children_of

CRASHHUNT = Path(sys.executable).parent / "crashhunt"
FINE = ("--scenario", "toy", "--arg", "speed=5", "--seed", "3")
SLOW = ("--set", "step_wall_s=0.02")


def rows(hunt: Path) -> dict[int, str]:
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"file:{hunt}/ledger.sqlite?mode=ro", uri=True)) as database:
        return dict(database.execute("SELECT number, outcome FROM trials"))
    return {}


def tree(pid: int) -> list[int]:
    return [pid, *(below for child in children_of(pid) for below in tree(child))]


def left_in(folder: Path) -> list[int]:
    """Processes that work in a folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cwd"):
        with suppress(OSError):
            if path.readlink() == folder:
                found.append(int(path.parent.name))
    return found


STOPS = [(number, target) for number in (signal.SIGTERM, signal.SIGHUP) for target in ("every process", "the group")]


@pytest.mark.nightly
@pytest.mark.parametrize(("number", "target"), STOPS)
def test_a_stop_of_everybody_at_once_is_no_crash(toy, number, target):
    words = ("run", "h", "2", "8", "30", *FINE, *SLOW, "--json")
    process = toy.start(*words, start_new_session=True)
    wait_for(lambda: len(rows(toy.folder / "h")) >= 2)
    if target == "every process":  # as systemd and SLURM do; the workers come first
        for pid in reversed(tree(process.pid)):
            with suppress(ProcessLookupError):  # the process of a trial that has ended meanwhile
                os.kill(pid, number)
    else:  # as timeout does: the process, and then its group, so that the process is told twice
        os.kill(process.pid, number)
        time.sleep(0.05)
        os.killpg(process.pid, number)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    assert json.loads(out)["stopped_because"] == "interrupted"
    assert set(rows(toy.folder / "h").values()) == {"survived"}
    wait_for(lambda: not left_in(toy.folder))
    assert toy.crashhunt(*words).json["outcomes"] == {"survived": 8}


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(("status", "h"), marks=pytest.mark.nightly),
        pytest.param(("trials", "h"), marks=pytest.mark.nightly),
        ("scenarios",),
        ("--help",),
        pytest.param(("run", "-h"), marks=pytest.mark.nightly),
        pytest.param(("--version",), marks=pytest.mark.nightly),
    ],
)
def test_output_that_cannot_be_written_is_one_line(toy, words):
    if "h" in words:
        toy.crashhunt("run", "h", "1", "1", "5", *FINE)
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [CRASHHUNT, *words],
            cwd=toy.folder,
            env=toy.environment,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    assert "standard output (/dev/full) cannot be written: No space left on device; free some space or" in done.stderr
    assert done.stderr.count("\n") == 1
