"""Hunts whose trials go on with other disturbances where they come near to a crash, on the toy."""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path

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
default = 12.0
"""


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


@pytest.mark.nightly  # by day, the hunt above branches and confirms
@pytest.mark.long
def test_a_hunt_stops_at_what_a_branch_has_found(shell):
    """As it does at any other crash: with --deterministic at the same one, and when it is resumed, at once."""
    (shell.folder / "toy.toml").write_text(TOY)
    words = ("run", "h", "2", "9", "90", "--scenario", "toy.toml", "--seed", "3", "--arg", "speed=9.5|4")
    asked = (*words, "--disturb", "brake=0.01,stop=0.01", "--branch", "--probe", "9s", "--json")
    before = shell.crashhunt(*asked[:3], "3", *asked[4:], "--keep-going").json
    assert (before["stopped_because"], before["trials_run"]) == ("all_trials", 3)
    first = min(Path(crash["path"]).name for crash in before["branches"]["crashes"])
    done = shell.crashhunt(*asked, "--fail-on-crash", expect=1)  # where it was killed before it had looked, likewise
    assert (done.json["stopped_because"], done.json["trials_run"], done.json["crashes"]) == ("crash", 3, [])
    assert done.json["copied"] == f"h/branches/{first}"
    assert (
        f"Trial {int(first[:6])} did not crash, but a copy of it did. The crash reproduces from the start." in done.err
    )
    assert f"Replay it:  crashhunt replay h/branches/{first}" in done.err
    assert "log-likelihood of exactly these disturbances" in done.err
    anew = shell.crashhunt(*asked, "--overwrite", "--deterministic").json
    assert (anew["stopped_because"], anew["copied"]) == ("crash", f"h/branches/{first}")
    assert anew["trials_run"] < 9
    was, now = (next(one for one in run["branches"]["crashes"] if first in one["path"]) for run in (before, anew))
    assert now == was
    (state,) = shell.crashhunt("status", "h", "--json").json["hunts"]
    assert (state["state"], state["crashes"]) == ("crashed", 0)
    assert state["branches"]["run_again"] == state["branches"]["confirmed"] > 0


def test_branches_need_disturbances(shell):
    done = shell.crashhunt("run", "h", "1", "3", "60", "--branch", expect=2)
    assert done.err == (
        "crashhunt: --branch needs disturbances, but the hunt has none; give rates, "
        "such as --disturb brake=0.02,cut_in=0.02\n"
    )
