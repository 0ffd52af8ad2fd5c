"""Suites: many hunts from one file, also when some cannot run, when somebody interrupts, and when it is killed."""

from __future__ import annotations

import json
import os
import signal
import time
import tomllib

import pytest

SUITE = """
[defaults]
scenario = "toy"
trials = 8
max_steps = 100
seed = 3

[[hunts]]
id = "fast"
runs = 2
arguments.speed = "12:14"

[[hunts]]
id = "slow"
arguments = { speed = 4 }
scenario_arguments.gap_m = 50
"""
BROKEN = """
[[hunts]]
id = "unimportable"
agent = "nothing:There"

[[hunts]]
id = "a-word"
arguments.speed = "fast"

[[hunts]]
id = "raises"
agent = "explodes:Agent"

[[hunts]]
id = "no-scenario"
scenario = "nowhere"
"""
SLOW = """
[defaults]
scenario = "toy"
trials = 80
max_steps = 50
seed = 3
scenario_arguments = { step_wall_s = 0.001 }
arguments.speed = 4
[[hunts]]
id = "a"
[[hunts]]
id = "b"
[[hunts]]
id = "c"
"""


def written(shell, text: str) -> None:
    (shell.folder / "suite.toml").write_text(text, encoding="utf-8")


def states(shell, directory: str = "out") -> dict[str, str]:
    found = shell.crashhunt("status", directory, "--json").json["hunts"]
    return {hunt["dir"].removeprefix(f"{directory}/"): hunt["state"] for hunt in found}


def numbers(shell, hunt: str) -> list[int]:
    return [int(line.partition(",")[0]) for line in shell.crashhunt("trials", hunt).out.splitlines()[1:]]


def wait_for(condition, timeout_s: float = 300.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.05)


def test_every_hunt_stops_at_its_own_first_crash(toy):
    written(toy, SUITE)
    done = toy.crashhunt("suite", "run", "suite.toml", "out", "2", "--json").json
    found = {hunt["dir"].removeprefix("out/"): hunt for hunt in done["hunts"]}
    assert {name: hunt["state"] for name, hunt in found.items()} == {
        "fast/0": "crashed", "fast/1": "crashed", "slow/0": "finished",
    }  # fmt: skip
    assert found["slow/0"]["trials_run"] == found["slow/0"]["trials_planned"] == 8
    seeds = {tomllib.loads((toy.folder / f"out/{name}/hunt.toml").read_text())["seed"] for name in found}
    assert len(seeds) == 2  # a seed a run; the same seed for equal numbers
    assert toy.crashhunt("replay", "out/fast/1", "--json").json["verdict"] == "reproduced"
    # Again, nothing runs.
    before = (toy.folder / "out/slow/0/ledger.sqlite").stat().st_mtime_ns
    assert toy.crashhunt("suite", "run", "suite.toml", "out", "2", "--json").json["hunts"] == done["hunts"]
    assert (toy.folder / "out/slow/0/ledger.sqlite").stat().st_mtime_ns == before


@pytest.mark.nightly  # by day, suites/test_processes.py, cli/test_answers.py and cli/test_status.py
def test_what_cannot_run_leaves_the_others_untouched_and_is_reported(toy):
    written(toy, SUITE + BROKEN)
    (toy.folder / "explodes.py").write_text("raise OSError('no such luck')")
    done = toy.crashhunt("suite", "run", "suite.toml", "out", "2", expect=1)
    assert "4 hunts could not run" in done.out
    found = states(toy)
    assert {name for name, state in found.items() if state == "error"} == {
        "unimportable/0", "a-word/0", "raises/0", "no-scenario/0",
    }  # fmt: skip
    assert found["fast/0"] == "crashed"
    assert found["slow/0"] == "finished"
    logs = toy.crashhunt("logs", "out", "--errors-only").out
    for words in ("No module named 'nothing'", "'fast' is not a number", "no such luck", "nowhere"):
        assert words in logs
    assert "unimportable/0: error" in logs
    compared = toy.crashhunt("compare", "out", "--json")
    assert [hunt["dir"] for hunt in compared.json["hunts"]] == ["out/fast/0", "out/fast/1", "out/slow/0"]
    assert "out/unimportable/0 has not begun, and is excluded" in compared.err
    table = toy.crashhunt("status", "out").out
    assert "out/a-word/0: --arg speed: 'fast' is not a number" in " ".join(table.split())


@pytest.mark.long
@pytest.mark.nightly  # by day, suites/test_processes.py
def test_what_failed_runs_again_and_nothing_else(toy):
    written(toy, SUITE.replace("runs = 2\n", "") + BROKEN.partition('[[hunts]]\nid = "raises"')[0])
    toy.crashhunt("suite", "run", "suite.toml", "out", "2", expect=1)
    (toy.folder / "nothing.py").write_text("from crashhunt.agents import KeepLaneWithSpeed as There")
    finished = (toy.folder / "out/slow/0/ledger.sqlite").read_bytes()
    again = toy.crashhunt("rerun", "out", "--run", "unimportable", "--json").json
    assert [hunt["state"] for hunt in again["hunts"]] == ["crashed"]
    assert again["replaced"] == ["out/unimportable/0.replaced-0"]
    assert "No module named" in (toy.folder / again["replaced"][0] / "error.log").read_text()
    assert (toy.folder / "out/slow/0/ledger.sqlite").read_bytes() == finished
    assert states(toy)["a-word/0"] == "error"


@pytest.mark.nightly
def test_all_runs_again_with_the_same_seeds_and_crashes(toy):
    written(toy, SUITE.replace("runs = 2\n", "") + BROKEN.partition('[[hunts]]\nid = "raises"')[0])
    toy.crashhunt("suite", "run", "suite.toml", "out", "2", expect=1)
    crash = {path.name for path in (toy.folder / "out/fast/0/crashes").iterdir()}
    everything = toy.crashhunt("rerun", "out", "--all", "--parallel", "1", "--json", expect=1).json
    assert len(everything["replaced"]) == len(everything["hunts"]) == 4
    assert {path.name for path in (toy.folder / "out/fast/0/crashes").iterdir()} == crash
    assert toy.crashhunt("replay", "out/fast/0.replaced-0", "--json").json["verdict"] == "reproduced"


@pytest.mark.nightly  # by day, test_hunt.py kills a hunt, and Ctrl-C stops a suite
@pytest.mark.long
def test_killed_and_resumed_without_losing_or_repeating_a_trial(toy):
    written(toy, SLOW.replace("80", "16"))
    process = toy.begin("suite", "run", "suite.toml", "out", "2")
    wait_for(lambda: (toy.folder / "out/a/0/ledger.sqlite").exists() and len(numbers(toy, "out/a/0")) > 3)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    wait_for(lambda: "running" not in states(toy).values())
    killed = states(toy)
    begun = [name for name in "abc" if killed[f"{name}/0"] != "queued"]
    before = {name: dict(digests(toy, f"out/{name}/0")) for name in begun}
    assert any(before.values())
    toy.crashhunt("suite", "run", "suite.toml", "out", "2")
    assert set(states(toy).values()) == {"finished"}
    for name in "abc":
        assert numbers(toy, f"out/{name}/0") == list(range(16))
    for name, rows in before.items():
        after = digests(toy, f"out/{name}/0")
        assert {number: after[number] for number in rows} == rows
    log = toy.crashhunt("logs", "out", "--run", "a/0", "--type", "state").out
    assert log.count("running") == (1 if killed["a/0"] == "finished" else 2)  # as on a machine that is busy


@pytest.mark.nightly
def test_a_damaged_plan_leaves_the_others_untouched(toy):
    from crashhunt.suites import Suite, run_all

    written(toy, SUITE)
    folders = Suite.read(toy.folder / "suite.toml").plan(toy.folder / "out")
    (folders[0] / "request.json").write_text("{}")
    run_all(folders, 2)
    assert states(toy) == {"fast/0": "error", "fast/1": "crashed", "slow/0": "finished"}
    assert "no request.json" in toy.crashhunt("logs", "out", "--errors-only").out


@pytest.mark.nightly  # by day, results/test_directory.py has several claim a directory
@pytest.mark.long
def test_two_at_once_do_not_disturb_each_other(toy):
    written(toy, SLOW.replace("80", "10").replace('[[hunts]]\nid = "c"\n', ""))
    first = toy.begin("suite", "run", "suite.toml", "out", "2", "--json")
    second = toy.begin("suite", "run", "suite.toml", "out", "2", "--json")
    for process in (first, second):
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
    assert set(states(toy).values()) == {"finished"}
    for name in "ab":
        assert numbers(toy, f"out/{name}/0") == list(range(10))
        assert "error" not in toy.crashhunt("logs", "out", "--run", name, "--type", "state").out


def digests(shell, hunt: str) -> dict[int, tuple[str, str]]:
    lines = shell.crashhunt("trials", hunt, "--format", "jsonl").out.splitlines()
    return {row["number"]: (row["digest"], row["wall_s"]) for row in map(json.loads, lines)}


def test_ctrl_c_stops_all_hunts_and_keeps_what_has_finished(toy):
    written(toy, SLOW.replace("80", "5000"))  # so that none ends before it is looked at, on no machine
    process = toy.begin("suite", "run", "suite.toml", "out", "2", "--json")
    wait_for(lambda: (toy.folder / "out/b/0/ledger.sqlite").exists() and len(numbers(toy, "out/b/0")) > 3)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    assert len(json.loads(out)["hunts"]) == 3
    assert "Run the same command to resume" in err
    found = states(toy)
    assert (found["a/0"], found["b/0"], found["c/0"]) == ("interrupted", "interrupted", "queued")


@pytest.mark.nightly  # by day, suites/test_processes.py
def test_the_last_hunts_share_all_slots(toy):
    written(toy, SLOW.replace('[[hunts]]\nid = "b"\n[[hunts]]\nid = "c"\n', "").replace("80", "20"))
    toy.crashhunt("suite", "run", "suite.toml", "out", "2")
    workers = {row["worker"] for row in _results(toy, "out/a/0")}
    assert len(workers) == 2


def _results(shell, hunt: str) -> list[dict]:
    import sqlite3
    from contextlib import closing

    with closing(sqlite3.connect(shell.folder / hunt / "ledger.sqlite")) as database:
        return [json.loads(text) for (text,) in database.execute("SELECT result FROM trials")]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "the key 'hunts' is missing"),
        ("hunts = []", "the file lists no hunts"),
        ("[[hunts]]\nid = 'a'\n[[hunts]]\nid = 'A'", "the id 'A' is used twice"),
        ("[[hunts]]\nscenario = 'toy'", "hunts[0].id = ''"),
        ("[[hunts]]\nid = '../a'", "'../a' is not a valid folder name"),
        ("[[hunts]]\nid = 'a'\nspeed = 3", "unknown key 'speed'"),
        ("[[hunts]]\nid = 'a'\ntrials = 'many'", "trials = 'many'"),
        ("[[hunts]]\nid = 'a'\nruns = 0", "hunts.a.runs = 0"),
        ("[[hunts]]\nid = 'a'\nagent = 'x:Y'\nagents = { ego = 'x:Y' }", "both agent and agents"),
        ("schema = 9\n[[hunts]]\nid = 'a'", "schema = 9"),
        ("[[hunts", "not valid TOML"),
    ],
)
def test_a_mistake_in_the_file_is_one_line(toy, text, says):
    written(toy, text)
    done = toy.crashhunt("suite", "run", "suite.toml", "out", expect=2)
    assert says in done.err
    assert len(done.err.splitlines()) == 1
    assert not (toy.folder / "out").exists()


def test_snapshots_of_a_suite_take_in_what_is_asked_for(toy):
    (toy.folder / "maps").mkdir()
    (toy.folder / "maps" / "town.csv").write_text("1,2")
    written(toy, "[[hunts]]\nid = 'a'\nscenario = 'toy'\ntrials = 1\nsnapshot_roots = ['maps']\nkeep_trials = true")
    toy.crashhunt("suite", "run", "suite.toml", "out", "1")
    assert [path.name for path in toy.folder.glob("out/a/0/snapshots/*/code/**/town.csv")] == ["town.csv"]
    assert (toy.folder / "out/a/0/trials/000000/params.json").exists() or list(toy.folder.glob("out/a/0/crashes/*"))


def test_a_suite_that_has_changed_is_refused(toy):
    from crashhunt.suites import Suite

    written(toy, SUITE)
    Suite.read(toy.folder / "suite.toml").plan(toy.folder / "out")
    toy.crashhunt("run", "single", "1", "1", "5", "--scenario", "toy")
    written(toy, SUITE.replace("speed = 4", "speed = 5"))
    refused = toy.crashhunt("suite", "run", "suite.toml", "out", expect=2)
    assert "the hunt 'slow' was planned in this folder with other settings" in refused.err
    # What cannot be planned leaves nothing behind.
    written(toy, SUITE.replace("speed = 4", "speed = 5").replace("runs = 2", "runs = 3"))
    toy.crashhunt("suite", "run", "suite.toml", "out", expect=2)
    assert not (toy.folder / "out/fast/2").exists()
    assert "the directory contains a hunt" in toy.crashhunt("suite", "run", "suite.toml", "single", expect=2).err
    written(toy, SUITE.replace("seed = 3", "seed = 3\nsnapshot_roots = ['toy']"))
    assert "other settings" in toy.crashhunt("suite", "run", "suite.toml", "out", expect=2).err
    assert "cannot be read" in toy.crashhunt("suite", "run", "nowhere.toml", "out", expect=2).err


def test_the_default_suite_is_a_suite_of_everything(toy):
    from crashhunt.scenario import shipped_scenarios
    from crashhunt.suites import Suite

    text = toy.crashhunt("suite", "defaults").out
    written(toy, text)
    suite = Suite.read(toy.folder / "suite.toml")
    assert sorted(entry.scenario for entry in suite.entries) == sorted(shipped_scenarios())
    # What is commented out is right as well.
    written(toy, text.replace("# arguments", "arguments").replace("# scenario_arguments", "scenario_arguments"))
    assert all(entry.scenario_arguments for entry in Suite.read(toy.folder / "suite.toml").entries)
