"""Hunts whose trials go on with other disturbances where they come near to a crash, on the toy."""

from __future__ import annotations

import csv
import io

import pytest

TOY = """
title = "A toy"
schema = 1
simulator = "toy"
step_length_s = 0.1

[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"

[arguments.gap_m]
default = 12.0
"""


@pytest.mark.nightly
def test_a_hunt_branches_where_trials_come_near_and_confirms_what_it_finds_from_the_start(shell):
    (shell.folder / "toy.toml").write_text(TOY)
    words = ("run", "h", "1", "1", "120", "--scenario", "toy.toml", "--seed", "3", "--arg", "speed=9.5", "--keep-going")
    done = shell.crashhunt(*words, "--disturb", "brake=0.01,stop=0.01", "--branch", "--json")
    found = done.json["branches"]
    assert done.json["crashes"] == []
    assert found["trials"] == 1
    assert found["crashed"] >= found["crashed_trials"] == found["run_again"] == found["confirmed"] > 0
    assert done.json["steps_total"] == 120 + found["steps"]
    crash = found["crashes"][0]
    assert crash["confirmed"]
    assert crash["disturbed"]
    assert (shell.folder / crash["path"]).parent == shell.folder / "h" / "branches"
    again = found["run_again"]
    assert f"likeliest crashes that reproduce from the start: {again} of {again}:" in done.err
    rows = list(csv.DictReader(io.StringIO(shell.crashhunt("trials", "h", "--format", "csv").out)))
    assert sum(int(row["branches"]) for row in rows) == found["branches"]
    assert sum(int(row["branch_crashes"]) for row in rows) == found["crashed"]
    assert "reproduced" in shell.crashhunt("replay", crash["path"]).out
    (state,) = shell.crashhunt("status", "h", "--json").json["hunts"]
    assert state["branches"] == {
        name: value for name, value in found.items() if name not in ("crashes", "not_finished")
    }
    assert "probes" not in state
    told = " ".join(shell.crashhunt("status", "h").out.split())
    assert f"branches {found['branches']} (moments {found['moments']}), crashed {found['crashed']} (in 1 of 1" in told


def test_branches_need_disturbances(shell):
    done = shell.crashhunt("run", "h", "1", "3", "60", "--branch", expect=2)
    assert done.err == (
        "crashhunt: --branch needs disturbances, but the hunt has none; give rates, "
        "such as --disturb brake=0.02,cut_in=0.02\n"
    )
