"""Copies, replays and audits that are killed from outside, as by the kernel where memory runs out: asked again."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import sqlite3
import threading
import time
from contextlib import closing, contextmanager, suppress

import pytest
from conftest import wait_for

from crashhunt.base.processes import children_of

TOY = """
title = "A toy"
schema = 1
simulator = "toy"
step_length_s = 0.1

[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"

[arguments.gap_m]
default = 15.0

[arguments.step_wall_s]
default = 0.003
"""
HUNT = ("1", "2", "60", "--scenario", "toy.toml", "--seed", "4", "--arg", "speed=9", "--keep-going", "--json")
GAPS_M = [30, pytest.param(15, marks=pytest.mark.nightly)]  # of the latter copies crash, which takes time to confirm


@pytest.fixture
def folder(shell):
    (shell.folder / "toy.toml").write_text(TOY)
    return shell.folder


def copies_of_worker(hunt):
    """The copies of the trials of a hunt, and theirs: hunt, keeper, fork server, template, zygote, trial, copies."""
    level = [hunt]
    for _ in range(5):
        level = [child for pid in level for child in children_of(pid)]
    found = []
    while level:
        level = [child for pid in level for child in children_of(pid)]
        found += level
    return found


@contextmanager
def kills(hunt, is_wanted):
    """Send SIGKILL to all copies of the trials of a hunt, while something holds; yields what was killed."""
    killed, over = set(), threading.Event()

    def watch():
        while not over.is_set():
            for pid in copies_of_worker(hunt) if is_wanted() else ():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    killed.add(pid)
            time.sleep(0.001)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


def is_running(folder, number):
    return any((folder / "h").glob(f".scratch-*/trial-{number:06d}"))


def table(shell, directory):
    """The trials of a hunt without the times that they took, and what the ledger has of their copies."""
    rows = list(csv.DictReader(io.StringIO(shell.crashhunt("trials", directory).out)))
    with closing(sqlite3.connect(shell.folder / directory / "ledger.sqlite")) as ledger:
        results = [json.loads(text) for (text,) in ledger.execute("SELECT result FROM trials ORDER BY number")]
    copies = [(one.get("stress"), one.get("branches")) for one in results]
    return [{name: value for name, value in row.items() if name != "wall_s"} for row in rows], copies


def hunt_and_kill(shell, words, number=0):
    """Run a hunt in ``h``, and kill the copies of one of its trials; return what it prints."""
    process = shell.start("run", "h", *words)
    with kills(process.pid, lambda: is_running(shell.folder, number)) as killed:
        out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert killed
    return json.loads(out), err


@pytest.mark.nightly
@pytest.mark.long
@pytest.mark.parametrize("gap_m", GAPS_M)
def test_margin_of_a_trial_whose_copies_are_killed_is_open_until_they_are_asked_again(shell, folder, gap_m):
    probed = (*HUNT, "--set", f"gap_m={gap_m}", "--probe", "2s")
    undisturbed = shell.crashhunt("run", "u", *probed).json
    wanted, wanted_copies = table(shell, "u")
    report, err = hunt_and_kill(shell, probed)
    assert report["outcomes"] == undisturbed["outcomes"]
    assert (report["probes"]["trials"], report["probes"]["not_fully_asked"], report["unanswered"]) == (1, 1, 1)
    assert "1 trial was not fully probed: a copy was killed by SIGKILL" in err
    assert "Run the same command to run it again." in err
    assert "probes: a copy of a trial was killed by SIGKILL, and another is asked" in err
    assert "left out from here on" not in err
    rows, copies = table(shell, "h")
    assert (rows[0]["stress_margin"], rows[0]["stress_asked"]) == ("", "asked 0 of 2")
    assert rows[1] == wanted[1], "the copies of the next trial were not asked, or what was killed changed it"
    stress = copies[0][0]
    assert (stress["margin"], stress["margin_upper_bound"]) == (None, 1.0)
    (row, _) = json.loads(shell.crashhunt("trials", "h", "--format", "json").out)
    assert row["stress_margin"] is None
    assert "not fully asked 1 trial" in " ".join(shell.crashhunt("status", "h").out.split())
    assert shell.crashhunt("check", "h").code == 0

    # Resumed, and killed before the copies have answered: the ledger has what it had.
    process = shell.start("run", "h", *probed)
    wait_for(lambda: is_running(folder, 0), every_s=0.005)
    process.kill()
    process.communicate()
    assert table(shell, "h") == (rows, copies)

    again = shell.crashhunt("run", "h", *probed).json
    assert (again["unanswered"], again["trials_run"]) == (0, 2)
    assert again["outcomes"] == undisturbed["outcomes"]
    assert again["probes"] | {"crashes": []} == undisturbed["probes"] | {"crashes": []}
    assert table(shell, "h") == (wanted, wanted_copies)
    assert again["steps_total"] == undisturbed["steps_total"]
    assert shell.crashhunt("check", "h").code == 0
