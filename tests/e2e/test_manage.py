"""Status, logs, rerun, trials and compare on single hunts."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import time
from contextlib import closing

import pytest
from conftest import CRASHHUNT, keeps_going

from crashhunt.ledger import Ledger
from crashhunt.statistics import RateTest

KEEP = ("--scenario", "toy", "--seed", "4", "--keep-going")


def state(shell, hunt: str = "h") -> dict:
    (found,) = shell.crashhunt("status", hunt, "--json").json["hunts"]
    return found


def started(shell, *words: str):
    process = shell.begin("run", "h", "2", "50000", "50", *KEEP, "--set", "step_wall_s=0.001", *words)
    deadline = time.monotonic() + 300
    while not (shell.folder / "h/ledger.sqlite").exists() or state(shell)["trials_run"] < 5:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return process


@pytest.mark.nightly  # by day, hunts/test_states_and_reports.py, and test_hunt.py kills a hunt
def test_a_hunt_is_running_until_its_process_is_gone(toy):
    process = started(toy)
    found = state(toy)
    assert (found["state"], found["owner_alive"], found["trials_planned"]) == ("running", True, 50000)
    assert found["rate_per_s"] > 0
    assert 0 < found["seconds_left"] < 50000 * 10  # s: of a trial each, on a loaded machine too
    # Nobody else's business: the workers are stopped first, so that nothing is left to end by itself.
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    found = state(toy)
    assert (found["state"], found["owner_alive"], found["seconds_left"]) == ("killed", False, None)
    toy.crashhunt("run", "h", "2", str(found["trials_run"]), "50", *KEEP, "--set", "step_wall_s=0.001")
    assert state(toy)["state"] in ("finished", "crashed")


@pytest.mark.nightly  # by day, hunts/test_states_and_reports.py
def test_a_process_id_that_another_process_has_now_is_not_the_owner(toy):
    process = started(toy)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    with closing(Ledger(toy.folder / "h/ledger.sqlite", writable=True)) as ledger:
        owner = ledger.facts()["owner"]
        assert owner["pid"] == process.pid
        ledger.note(owner=owner | {"pid": os.getpid()})
        assert state(toy)["state"] == "killed"
        # On another machine, only its heartbeat tells.
        ledger.note(owner=owner | {"host": "elsewhere"}, heartbeat=time.time())
        assert state(toy)["state"] == "running"
        ledger.note(heartbeat=time.time() - 3600)
        assert state(toy)["state"] == "killed"


@pytest.mark.nightly  # by day, hunts/test_states_and_reports.py and hunts/test_whole_hunts.py
def test_every_end_has_its_state(toy):
    toy.crashhunt("run", "fine", "1", "5", "50", "--scenario", "toy", "--arg", "speed=4", "--seed", "1")
    toy.crashhunt("run", "crash", "1", "50", "99", "--scenario", "toy", "--arg", "speed=14", "--seed", "1")
    toy.crashhunt("run", "none", "1", "5", "50", "--scenario", "toy", "--set", "fail_reset=true", expect=3)
    found = {hunt["dir"]: hunt for hunt in toy.crashhunt("status", "fine", "crash", "none", "--json").json["hunts"]}
    assert {name: hunt["state"] for name, hunt in found.items()} == {
        "fine": "finished", "crash": "crashed", "none": "error",
    }  # fmt: skip
    assert (found["crash"]["crashes"], found["none"]["errors"]) == (1, 5)
    assert "fails as its scenario arguments demand" in found["none"]["detail"]
    (lost,) = (toy.folder / "crash/crashes").glob("*/crash.json")
    lost.unlink()
    (found,) = toy.crashhunt("status", "crash", "--json").json["hunts"]
    assert (found["state"], found["crashes"]) == ("crashed", 1)
    # All below a folder, and one that nobody can read hides no other.
    (toy.folder / "fine/ledger.sqlite").write_bytes(b"nonsense" * 1000)
    found = {hunt["dir"]: hunt["state"] for hunt in toy.crashhunt("status", ".", "--json", expect=2).json["hunts"]}
    assert found == {"fine": "error", "crash": "crashed", "none": "error"}
    assert "there is no hunt in 'toy'" in toy.crashhunt("status", "toy", expect=2).err
    assert "does not exist" in toy.crashhunt("status", "nowhere", expect=2).err


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


@pytest.mark.nightly  # by day, hunts/test_logs.py and cli/test_answers_on_crashes.py
def test_logs_follow_what_runs(toy):
    process = started(toy)
    following = subprocess.Popen(
        [str(CRASHHUNT), "logs", "h", "--follow", "--type", "state"], cwd=toy.folder, env=toy.environment,
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert following.stdout is not None
    out = ""
    while "running" not in out:
        line = following.stdout.readline()
        assert line, out
        out += line
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    out += following.communicate(timeout=300)[0]
    assert out.count("running") == 1
    assert "interrupted" in out


def test_trials_that_could_not_be_set_up_run_again(toy):
    (toy.folder / "moody.py").write_text(
        "import pathlib\nclass Agent:\n    def __init__(self, number: int = 0):\n"
        "        if number % 3 == 0 and not pathlib.Path('mended').exists(): raise RuntimeError('no weights')\n"
        "    def reset(self, seed): pass\n    def act(self, observation): return 4.0, 0\n"
    )
    words = ("--scenario", "toy", "--seed", "4", "--agent", "moody:Agent", "--arg", "number=0:20")
    toy.crashhunt("run", "h", "2", "20", "20", *words)
    before = rows(toy, "h")
    failed = {row["number"] for row in before if row["outcome"] == "invalid"}
    assert 0 < len(failed) < 20
    (toy.folder / "mended").touch()
    again = toy.crashhunt("rerun", "h", "--json").json
    assert [hunt["outcomes"] for hunt in again["hunts"]] == [{"survived": 20}]
    kept = [row for row in rows(toy, "h") if row["number"] not in failed]
    assert kept == [row for row in before if row["number"] not in failed]
    with closing(sqlite3.connect(toy.folder / "h/ledger.sqlite")) as database:
        assert {number for (number,) in database.execute("SELECT number FROM replaced")} == failed
    assert toy.crashhunt("rerun", "h", "--json").json["hunts"][0]["trials_run"] == 20


@pytest.mark.nightly  # by day, the README does
def test_another_version_of_a_hunt_runs_elsewhere(toy):
    toy.crashhunt("run", "h", "2", "4", "99", *KEEP, "--arg", "speed=14", "--set", "gap_m=20:30")
    done = toy.crashhunt("rerun", "h", "--to", "slower", "--set", "speed=4", "--set", "trials=3", "--json").json
    assert [(hunt["dir"], hunt["outcomes"]) for hunt in done["hunts"]] == [("slower", {"survived": 3})]
    # The same seeds, and the same traffic.
    for old, new in zip(rows(toy, "h"), rows(toy, "slower"), strict=False):
        assert (old["seed"], old["scenario.gap_m"]) == (new["seed"], new["scenario.gap_m"])
    assert state(toy)["state"] == "crashed"
    assert "exists already" in toy.crashhunt("rerun", "h", "--to", "slower", expect=2).err
    assert "a hunt cannot change its settings" in toy.crashhunt("rerun", "h", "--set", "speed=4", expect=2).err
    assert "trials=many" in toy.crashhunt("rerun", "h", "--to", "x", "--set", "trials=many", expect=2).err
    wrong = toy.crashhunt("rerun", "h", "--to", "x", "--set", "sped=4", expect=2)
    assert "--set: the hunt has no argument 'sped'; did you mean 'ego.speed'?" in wrong.err
    assert not (toy.folder / "x").exists()


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
    assert [row["number"] for row in table] == list(range(25))
    assert {"ego.speed", "scenario.gap_m", "seed", "outcome", "steps", "digest", "time_to_collision_s"} <= table[
        0
    ].keys()
    assert all(4 <= row["ego.speed"] <= 14 for row in table)
    plain = list(csv.DictReader(toy.crashhunt("trials", "h").out.splitlines()))
    assert [float(row["ego.speed"]) for row in plain] == [row["ego.speed"] for row in table]
    crashes = [row for row in table if row["outcome"] == "collision"]
    assert 0 < len(crashes) < 25
    assert rows(toy, "h", "--outcome", "collision") == crashes
    said = toy.crashhunt("trials", "h", "--format", "parquet", "--out", "t.parquet")
    assert "t.parquet has 25 trials" in said.err
    import polars as pl  # which takes a while, wherever this is not run

    frame = pl.read_parquet(toy.folder / "t.parquet")
    assert frame["number"].to_list() == list(range(25))
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
    told = toy.crashhunt("run", "k", "2", "25", "99", "--scenario", "toy", "--seed", "4", *KEEP[-1:], "--keep", "2")
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        f"{row['number']:06d}-collision" for row in crashes[:2]
    )
    assert f"{len(crashes)} crashes of 1 type" in told.out
    assert rows(toy, "k") == before
    (group,) = toy.crashhunt("crashes", "k", "--json").json["groups"]
    assert (group["count"], len(group["members"])) == (len(crashes), 2)
    assert "2 crashes are intact" in toy.crashhunt("check", "k").out
    told = toy.crashhunt("run", "k", "2", "25", "99", "--scenario", "toy", "--seed", "4", *KEEP[-1:], "--keep", "1")
    assert len(list(folder.iterdir())) == 1
    assert f"{len(crashes)} crashes of 1 type" in told.out
    shutil.rmtree(next(folder.iterdir()))  # one that is missing is not one that was given up
    assert "crashed, and its bundle is missing" in toy.crashhunt("check", "k", expect=1).out


def rate_of_none(trials):
    """The upper end for no crash in so many trials."""
    test = RateTest()
    test.add(0, 1, trials)
    return test.interval().high


@pytest.mark.nightly  # by day, statistics/test_comparison.py and test_gate.py
def test_which_of_two_agents_crashes_less(toy):
    for name, speed in (("fast", "14"), ("slow", "4")):
        words = (*KEEP, "--keep", "1", "--arg", f"speed={speed}", "--set", "gap_m=20:30")
        toy.crashhunt("run", name, "2", "9", "99", *words)
    shutil.copytree(toy.folder / "fast", toy.folder / "again")  # the same trials
    found = toy.crashhunt("compare", "fast", "slow", "again", "--json", "--html", "c.html").json
    fast, slow, again = found["hunts"]
    assert fast["crashes"] == again["crashes"] > 7  # eight decide
    assert (slow["crashes"], slow["crash_rate"], slow["median_steps_to_crash"]) == (0, 0.0, None)
    assert slow["interval"][0] == 0.0
    assert slow["interval"][1] == pytest.approx(rate_of_none(9))  # as `crashhunt rate` reports it
    against_slow, against_again = found["pairs"]
    assert (against_slow["only_first"], against_slow["only_second"]) == (fast["crashes"], 0)
    assert against_slow["p_value"] == pytest.approx(2 * 0.5 ** fast["crashes"])
    assert against_slow["verdict"].startswith("slow crashes less")
    assert against_slow["answer"] == "second"
    assert against_slow["evidence"] > 20
    assert against_slow["difference"]["high"] < 0
    assert against_again["difference"]["low"] < 0 < against_again["difference"]["high"]
    assert (against_again["both"], against_again["p_value"]) == (fast["crashes"], 1.0)
    assert "the difference may be 0" in against_again["verdict"]
    page = (toy.folder / "c.html").read_text()
    assert "slow crashes less" in page
    assert "<figcaption>scenario.gap_m</figcaption>" in page
    assert "http" not in page
    (head, *lines) = toy.crashhunt("compare", "fast", "slow", "--csv").out.splitlines()
    assert head.startswith("dir,state,trials,crashes,crash_rate,rate_low,rate_high")
    assert len(lines) == 2


@pytest.mark.nightly  # by day, statistics/test_comparison.py
def test_an_interval_only_where_trials_are_independent(toy):
    toy.crashhunt("run", "first", "1", "40", "99", "--scenario", "toy", "--seed", "4", "--arg", "speed=14")
    words = ("--scenario", "toy", "--seed", "4", "--sampler", "grid", "--arg", "speed=4:14", "--points", "5")
    toy.crashhunt("run", "grid", "1", "5", "99", *words, "--keep-going", "--keep", "1")
    toy.crashhunt("run", "other", "1", "2", "99", "--scenario", "toy", "--seed", "99", "--keep-going")
    found = toy.crashhunt("compare", "first", "grid", "other")
    assert "first: no crash rate: the hunt stops at its first crash" in found.out
    assert "grid: no interval: the sampler grid does not draw" in found.out
    assert "first and other have no seed in common" in found.out
    assert "a single hunt cannot be compared" in toy.crashhunt("compare", "first", expect=2).err
    assert "does not exist" in toy.crashhunt("compare", "first", "nowhere", expect=2).err
