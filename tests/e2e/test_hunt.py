"""The hunt as a whole: exact counts, resuming, refusing, stopping, signals."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
from contextlib import suppress
from pathlib import Path

import pytest
from conftest import mostly_nightly, wait_for

FINE = ("--no-snapshot", "--scenario", "toy", "--agent", "faulty:Fine", "--seed", "5", "--set", "step_wall_s=0.0005")
LONG = ("30", *FINE[:-1], "step_wall_s=0.01")  # 0.3 s a trial, most of it asleep


def ledger(folder: Path) -> dict[int, str]:
    database = sqlite3.connect(f"file:{folder / 'ledger.sqlite'}?mode=ro", uri=True)
    try:
        return dict(database.execute("SELECT number, result FROM trials"))
    finally:
        database.close()


def count(folder: Path) -> int:
    try:
        return len(ledger(folder))
    except sqlite3.Error:
        return 0


def session_is_gone(pid: int) -> bool:
    """Whether no process of the session that `pid` began is left."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == pid and fields[0] != "Z":
                return False
    return True


@pytest.mark.parametrize(
    ("parallel", "trials"),  # by day, hunts/test_whole_hunts.py hunts with one and three workers
    [pytest.param("1", 3, marks=pytest.mark.nightly), pytest.param("3", 2, marks=pytest.mark.nightly), ("0", 5)],
)
def test_exactly_so_many_trials_run(toy, parallel, trials):
    # The smallest time limit that fits is no hang.
    report = toy.crashhunt("run", "h", parallel, str(trials), "30", *FINE, "--timeout", "5", "--json").json
    assert report["outcomes"] == {"survived": trials}
    assert report["trials_planned"] == report["trials_run"] == trials
    assert report["stopped_because"] == "all_trials"
    assert report["steps_total"] == 30 * trials
    assert sorted(ledger(toy.folder / "h")) == list(range(trials))
    assert not [*(toy.folder / "h").glob(".scratch*")]


def test_a_crash_stops_everything_at_once_even_hung_workers(toy):
    words = ("run", "h", "3", "30", "2000", "--agent", "faulty:HangsUnlessFirst", "--arg", "number=0:100")
    # Trial 0 of this seed gets number 0 with the grid; all others hang in C with the interpreter held.
    words = (*words, "--sampler", "grid", "--points", "101", "--scenario", "toy", "--set", "gap_m=30", "--no-snapshot")
    process = toy.begin(*words, "--timeout", "120", "--json")
    crashes = toy.folder / "h" / "crashes"
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    report = json.loads(out)
    assert [crash["trial"] for crash in report["crashes"]] == [0]
    assert report["outcomes"] == {"agent_error": 1}
    assert report["wall_s"] < 100, "the hung workers were waited for"
    assert [path.name for path in crashes.iterdir()] == ["000000-agent_error"]


def test_an_interrupt_keeps_what_has_finished_and_the_same_command_continues(toy):
    words = ("run", "h", "2", "14", *LONG, "--json")
    process = toy.begin(*words, start_new_session=True)
    wait_for(lambda: count(toy.folder / "h") >= 4)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    assert json.loads(out)["stopped_because"] == "interrupted"
    wait_for(lambda: session_is_gone(process.pid))
    before = ledger(toy.folder / "h")
    assert 4 <= len(before) < 14
    assert toy.crashhunt(*words).json["trials_run"] == 14
    after = ledger(toy.folder / "h")
    assert sorted(after) == list(range(14))
    assert {key: after[key] for key in before} == before  # nothing that had finished ran again


def libraries_of(pid: int) -> int:
    """How many shared libraries a process has loaded, which says how far its imports are on any machine."""
    with suppress(OSError):
        return len({line.split()[-1] for line in Path(f"/proc/{pid}/maps").read_text().splitlines() if ".so" in line})
    return 0


@pytest.mark.parametrize("libraries", mostly_nightly([9, 12, 22, 26, 32], always=(12, 26)))
def test_an_interrupt_while_it_starts_is_not_lost(toy, libraries):
    toy.environment = toy.unmeasured  # which takes longer to start, and loses it
    process = toy.start("run", "h", "2", "100000", "300", *FINE, start_new_session=True)
    # Before that, Python itself starts, and where it imports `site`, it fails with an exit code of its own.
    wait_for(lambda: libraries_of(process.pid) >= libraries or (toy.folder / "h").exists())
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode in (130, -signal.SIGINT)  # the latter where Python itself had not started yet
    wait_for(lambda: session_is_gone(process.pid))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run", "h", "2", "ten", "10"), "'ten'"),
        (("run", "no/such/parent", "2", "3", "10"), "no/such/parent"),
        (("run", "faulty.py", "2", "3", "10"), "is a file"),
        (("run", ".", "2", "3", "10"), "not empty"),
        (("run", "h", "2", "3", "10", "--scenario", "lop"), "did you mean 'loop'"),
        (("run", "h", "2", "3", "10", "--agent", "nowhere:Agent"), "No module named 'nowhere'"),
        (("run", "h", "2", "3", "10", "--agent", "faulty:Raise"), "did you mean 'Raises'"),
        (("run", "h", "2", "3", "10", "--arg", "sped=3"), "did you mean 'speed'"),
        (("run", "h", "2", "3", "10", "--arg", "speed=9:3"), "3:9"),
        (("run", "h", "2", "3", "10", "--arg", "speed=fast"), "'fast'"),
        (("run", "h", "2", "3", "10", "--arg", "vehicles=3"), "--set vehicles="),
        (("run", "h", "2", "3", "10", "--crash-on", "boredom"), "'boredom'"),
        (("run", "h", "2", "3", "10", "--sampler", "magic"), "'magic'"),
        (("run", "h", "2", "3", "10", "--agent", "recorded"), "--arg log="),
        (("replay", "h"), "does not exist"),
        (("replay", "."), "no crash"),
    ],
)
def test_bad_input_is_one_clear_line_and_leaves_nothing_behind(shell, words, says):
    done = shell.crashhunt(*words, "--json", expect=2)
    assert says in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert sorted(path.name for path in shell.folder.iterdir() if path.name != "__pycache__") == ["faulty.py"]
    assert set(done.json) == {"error"}
    assert set(done.json["error"]) == {"message", "fix", "where"}


@pytest.mark.parametrize(
    ("words", "says"),
    [((), "COMMAND"), (("frobnicate",), "frobnicate"), (("replay", "h"), "does not exist")],
)
def test_bad_input_prints_no_json_unless_asked(shell, words, says):
    done = shell.crashhunt(*words, expect=2)
    assert says in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert done.out == ""


def test_a_name_that_is_no_text_is_refused_before_anything_is_made(shell):
    done = shell.crashhunt("run", os.fsdecode(b"bad\xff"), "1", "1", "5", expect=2)
    assert (
        done.err
        == "crashhunt: the argument 'bad\\udcff' is not valid UTF-8; rename the file, or write the argument in UTF-8\n"
    )
    assert [path.name for path in shell.folder.iterdir()] == ["faulty.py"]
