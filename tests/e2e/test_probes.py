"""Hunts that ask copies of their trials how little it would take, on the toy."""

from __future__ import annotations

import csv
import io
import sys

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux only")

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


def test_a_hunt_tells_how_little_it_would_take_and_confirms_it_from_the_start(shell):
    (shell.folder / "toy.toml").write_text(TOY)
    words = ("run", "h", "1", "3", "60", "--scenario", "toy.toml", "--seed", "4", "--arg", "speed=9", "--keep-going")
    done = shell.crashhunt(*words, "--probe", "2s", "--json")
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
    assert "Stress margin of 3 trials: least 0." in done.err
    assert (
        "of the 3 mildest disturbances with which a trial crashed, 3 made it crash from the start as well" in done.err
    )
    rows = list(csv.DictReader(io.StringIO(shell.crashhunt("trials", "h", "--format", "csv").out)))
    assert min(float(row["stress_margin"]) for row in rows) == found["least"]
    assert "reproduced" in shell.crashhunt("replay", crash["path"]).out


def test_how_often_has_to_be_a_time(shell):
    for text in ("0", "often"):
        done = shell.crashhunt("run", "h", "1", "3", "60", f"--probe={text}", expect=2)
        assert done.err == f"crashhunt: --probe is {text}; give a time above 0, such as 4s, or leave it out\n"
