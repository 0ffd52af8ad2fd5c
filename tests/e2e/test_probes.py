"""Hunts that ask copies of their trials how little it would take, on the toy."""

from __future__ import annotations

import csv
import io
import sys

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks need Linux")

TOY = """
title = "A toy"
schema = 1
simulator = "toy"
step_length_s = 0.1

[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"

[arguments.gap_m]
default = 15.0
"""


@pytest.mark.nightly  # by day, episode/test_fork.py probes, and test_branches.py confirms
@pytest.mark.long
def test_a_hunt_reports_how_little_it_would_take_and_confirms_it_from_the_start(shell):
    (shell.folder / "toy.toml").write_text(TOY)
    words = ("run", "h", "1", "3", "60", "--scenario", "toy.toml", "--seed", "4", "--arg", "speed=9", "--keep-going")
    besides = "--disturb", "noisy_observation@52=itself:0.01:0.1"  # after the probe, and before the crash
    done = shell.crashhunt(*words, *besides, "--probe", "2s", "--json")
    found = done.json["probes"]
    assert done.json["crashes"] == []
    assert done.json["outcomes"] == {"survived": 3}
    assert found["trials"] == 3
    assert 0 < found["least"] <= found["median"] < 1
    assert found["run_again"] == found["confirmed"] == 3
    assert done.json["steps_total"] == 3 * 60 + found["steps"]
    crash = found["crashes"][0]
    assert crash["confirmed"]
    assert (shell.folder / crash["path"]).parent == shell.folder / "h" / "probes"
    assert "Robustness margin of 3 trials: least 0." in done.err
    assert "crashes by the mildest disturbance that reproduce from the start: 3 of 3" in done.err
    assert done.err.count(", leader brakes with ") == 3
    rows = list(csv.DictReader(io.StringIO(shell.crashhunt("trials", "h", "--format", "csv").out)))
    assert min(float(row["stress_margin"]) for row in rows) == found["least"]
    assert "reproduced" in shell.crashhunt("replay", crash["path"]).out
    shell.crashhunt("export", "h", "crash.zip", "--crash", "1")
    assert "ego drove into leader" in shell.crashhunt("show", "crash.zip").out
    state = shell.crashhunt("status", "h", "--json").json["hunts"][0]
    assert state["crashes"] == 0
    least = min(rows, key=lambda row: float(row["stress_margin"]))
    assert state["probes"] == {
        **{name: found[name] for name in ("trials", "least", "probes", "steps", "left_out", "run_again", "confirmed")},
        "trial": int(least["number"]), "crashed_trials": 3, "not_fully_asked": 0,
    }  # fmt: skip
    assert "branches" not in state
    told = " ".join(shell.crashhunt("status", "h").out.split())
    assert f"least robustness margin {found['least']:.2f} (trial {least['number']}); probes {found['probes']}" in told
    assert "made to crash 3 of 3 trials, confirmed 3 of 3" in told
    assert shell.crashhunt("check", "h").code == 0
    (shell.folder / "h" / "probes" / "000001-collision" / "log.mcap").unlink()
    (damaged,) = shell.crashhunt("check", "h", "--json", expect=1).json["hunts"]
    assert [finding["lost"] for finding in damaged["findings"]] == ["probes/000001-collision"]
    assert damaged["damaged_crashes"] == []
    shell.crashhunt(*words, "--overwrite", "--seed", "5")
    assert not (shell.folder / "h" / "probes").exists()  # which were of the hunt before


def test_how_often_has_to_be_a_time(shell):
    for text in ("0", "often"):
        done = shell.crashhunt("run", "h", "1", "3", "60", f"--probe={text}", expect=2)
        assert done.err == f"crashhunt: --probe is {text}; give a time above 0, such as 4s, or omit the option\n"


THREADS = """
import threading

class Threads:
    def __init__(self, after: int = 0):
        self.left, self.stop = after, threading.Event()
    def reset(self, seed):
        pass
    def act(self, observation):
        if self.left == 0:
            threading.Thread(target=self.stop.wait, daemon=True).start()
        self.left -= 1
        return 5.0, 0
    def close(self):
        self.stop.set()
"""


@pytest.mark.nightly  # by day, hunts/test_preflight.py, episode/test_fork.py and episode/test_forks.py
def test_an_agent_that_cannot_be_copied_is_refused_at_its_first_step(shell):
    """One that can be at first is told of once, and the hunt goes on."""
    (shell.folder / "toy.toml").write_text(TOY)
    (shell.folder / "threads.py").write_text(THREADS)
    words = ("--scenario", "toy.toml", "--agent", "threads:Threads", "--seed", "1", "--probe", "1s", "--overwrite")
    done = shell.crashhunt("run", "h", "1", "2", "30", *words, expect=2)
    why = "a process with several threads cannot be forked: 1 further thread runs"
    said = f"--probe: trials with threads:Threads cannot be copied: {why}; correct threads:Threads, or omit --probe"
    assert said in done.err
    done = shell.crashhunt("run", "h", "1", "2", "30", *words, "--arg", "after=15", "--json")
    assert done.json["trials_run"] == 2
    assert done.err.count(f"probes are left out from here on: {why}") == 1
