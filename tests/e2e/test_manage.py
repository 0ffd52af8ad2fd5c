"""Status, logs, rerun, trials and compare on single hunts."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import sqlite3
import subprocess
import time
from contextlib import closing

import pytest
from conftest import CRASHHUNT, keeps_going, wait_for

KEEP = ("--scenario", "toy", "--seed", "4", "--keep-going")


def state(shell, hunt: str = "h") -> dict:
    (found,) = shell.crashhunt("status", hunt, "--json").json["hunts"]
    return found


def started(shell, *words: str):
    process = shell.begin("run", "h", "2", "50000", "50", *KEEP, "--set", "step_wall_s=0.001", *words)
    ledger = shell.folder / "h/ledger.sqlite"
    wait_for(lambda: ledger.exists() and state(shell)["trials_run"] >= 5, every_s=0.05)
    return process


@pytest.mark.nightly
def test_watching_ends_with_the_hunt(toy):
    process = started(toy, "--timeout", "9")
    watching = subprocess.Popen(
        [str(CRASHHUNT), "status", "h", "--watch"],
        cwd=toy.folder,
        env=toy.environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    time.sleep(1.5)
    assert watching.poll() is None
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=300)
    out, _ = watching.communicate(timeout=300)
    assert watching.returncode == 0
    assert "interrupted" in out


@pytest.mark.nightly
def test_logs_are_found_wherever_they_are(shell):
    words = ("--agent", "faulty:Raises", "--arg", "at=12", "--set", "vehicles=10", "--seed", "1", "--keep-going")
    shell.crashhunt("run", "h", "1", "2", "40", *words)
    everything = shell.crashhunt("logs", "h").out
    for title in ("==> state <==", "==> trial 0, run <==", "==> trial 0, error <==", "==> trial 1, error <=="):
        assert title in everything
    assert "about to go wrong" in everything
    only = shell.crashhunt("logs", "h", "--trial", "1", "--errors-only").out
    assert "ValueError: no plan" in only
    assert "trial 0" not in only
    assert "about to go wrong" not in shell.crashhunt("logs", "h", "--type", "state").out
    nothing = shell.crashhunt("logs", "h", "--trial", "77")
    assert nothing.out == ""
    assert nothing.err.startswith("trial 77 printed nothing, or its log was not kept; ")
    assert "contradict" in shell.crashhunt("logs", "h", "--errors-only", "--type", "run", expect=2).err


@pytest.mark.nightly
def test_trials_that_could_not_be_set_up_run_again(toy):
    (toy.folder / "moody.py").write_text(
        "import pathlib\nclass Agent:\n    def __init__(self, number: int = 0):\n"
        "        if number % 3 == 0 and not pathlib.Path('mended').exists(): raise RuntimeError('no weights')\n"
        "    def reset(self, seed): pass\n    def act(self, observation): return 4.0, 0\n"
    )
    words = ("--scenario", "toy", "--seed", "4", "--agent", "moody:Agent", "--arg", "number=0:20")
    toy.crashhunt("run", "h", "2", "8", "20", *words)
    before = rows(toy, "h")
    failed = {row["number"] for row in before if row["outcome"] == "invalid"}
    assert 0 < len(failed) < 8
    (toy.folder / "mended").touch()
    again = toy.crashhunt("rerun", "h", "--json").json
    assert [hunt["outcomes"] for hunt in again["hunts"]] == [{"survived": 8}]
    kept = [row for row in rows(toy, "h") if row["number"] not in failed]
    assert kept == [row for row in before if row["number"] not in failed]
    with closing(sqlite3.connect(toy.folder / "h/ledger.sqlite")) as database:
        assert {number for (number,) in database.execute("SELECT number FROM replaced")} == failed
    assert toy.crashhunt("rerun", "h", "--json").json["hunts"][0]["trials_run"] == 8


@pytest.mark.nightly
def test_a_hunt_whose_scenario_is_gone_runs_again_from_its_snapshot(toy):
    toy.crashhunt("run", "h", "1", "5", "50", *KEEP, "--arg", "speed=4")
    (toy.folder / "toy/scenario.toml").unlink()
    done = toy.crashhunt("rerun", "h", "--to", "again", "--json").json
    assert done["hunts"][0]["outcomes"] == {"survived": 5}
    assert [row["digest"] for row in rows(toy, "again")] == [row["digest"] for row in rows(toy, "h")]


@pytest.mark.nightly
def test_a_hunt_of_ones_own_scenario_begins_again(toy):
    toy.crashhunt("run", "h", "1", "4", "99", *KEEP)
    before = [row["digest"] for row in rows(toy, "h")]
    for number in range(2):  # the second time, the scenario is that of what was set aside the first time
        done = toy.crashhunt("rerun", "h", "--all", "--json").json
        assert done["replaced"] == [f"h.replaced-{number}"]
        assert [row["digest"] for row in rows(toy, "h")] == before
    assert toy.crashhunt("replay", "h.replaced-0", "--json").json["verdict"] == "reproduced"


def rows(shell, hunt: str, *words: str) -> list[dict]:
    return json.loads(shell.crashhunt("trials", hunt, "--format", "json", *words).out)


def test_tables_of_trials(toy, made_once):
    made_once(keeps_going, toy)
    table = rows(toy, "h")
    assert [row["number"] for row in table] == list(range(12))
    assert {"ego.speed", "scenario.gap_m", "seed", "outcome", "steps", "digest", "time_to_collision_s"} <= table[
        0
    ].keys()
    assert all(4 <= row["ego.speed"] <= 14 for row in table)
    plain = list(csv.DictReader(toy.crashhunt("trials", "h").out.splitlines()))
    assert [float(row["ego.speed"]) for row in plain] == [row["ego.speed"] for row in table]
    crashes = [row for row in table if row["outcome"] == "collision"]
    assert 0 < len(crashes) < 12
    assert rows(toy, "h", "--outcome", "collision") == crashes
    said = toy.crashhunt("trials", "h", "--format", "parquet", "--out", "t.parquet")
    assert "t.parquet has 12 trials" in said.err
    import polars as pl  # which takes a while, wherever this is not run

    frame = pl.read_parquet(toy.folder / "t.parquet")
    assert frame["number"].to_list() == list(range(12))
    assert frame["ego.speed"].to_list() == [row["ego.speed"] for row in table]
    assert frame["digest"].to_list() == [row["digest"] for row in table]
    toy.crashhunt("trials", "h", "--format", "jsonl", "--out", "t.jsonl")
    assert [json.loads(line) for line in (toy.folder / "t.jsonl").read_text().splitlines()] == table
    for words, says in (
        (("--format", "parquet"), "cannot be printed on a terminal"),
        (("--outcome", "boom"), "--outcome: there is no outcome 'boom'"),
        (("--out", "no/where.csv"), "cannot be written"),
    ):
        assert says in toy.crashhunt("trials", "h", *words, expect=2).err
    assert not list(toy.folder.glob(".*.part"))


def test_the_shortest_few_of_a_kind_are_kept(toy, made_once):
    made_once(keeps_going, toy)
    before, folder = rows(toy, "h"), toy.folder / "h" / "crashes"
    crashes = sorted((row for row in before if row["outcome"] == "collision"), key=lambda row: row["steps"])
    assert len(crashes) == len(list(folder.iterdir())) > 2
    shutil.copytree(toy.folder / "h", toy.folder / "k")
    folder = toy.folder / "k" / "crashes"
    told = toy.crashhunt("run", "k", "1", "12", "99", "--scenario", "toy", "--seed", "5", *KEEP[-1:], "--keep", "2")
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        f"{row['number']:06d}-collision" for row in crashes[:2]
    )
    assert f"{len(crashes)} crashes of 1 type" in told.out
    assert rows(toy, "k") == before
    (group,) = toy.crashhunt("crashes", "k", "--json").json["groups"]
    assert (group["count"], len(group["members"])) == (len(crashes), 2)
    assert "2 crashes are intact" in toy.crashhunt("check", "k").out
    told = toy.crashhunt("run", "k", "1", "12", "99", "--scenario", "toy", "--seed", "5", *KEEP[-1:], "--keep", "1")
    assert len(list(folder.iterdir())) == 1
    assert f"{len(crashes)} crashes of 1 type" in told.out
    shutil.rmtree(next(folder.iterdir()))  # one that is missing is not one that was given up
    assert "crashed, and its bundle is missing" in toy.crashhunt("check", "k", expect=1).out
