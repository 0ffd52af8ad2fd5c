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
from typing import TYPE_CHECKING

import pytest
from conftest import mostly_nightly

from crashhunt.base.processes import children_of
from crashhunt.recording import Phase, read_header

if TYPE_CHECKING:
    from collections.abc import Callable

CRASHHUNT = Path(sys.executable).parent / "crashhunt"
FINE = ("--scenario", "toy", "--arg", "speed=5", "--seed", "3")
SLOW = ("--set", "step_wall_s=0.02")


def wait_for(condition: Callable[[], object], timeout_s: float = 300.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not come to that"
        time.sleep(0.02)


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


def boxes(hunt: Path) -> list[Path]:
    """The black box of the first trial, while it runs."""
    return [*hunt.glob(".scratch-*/trial-000000/blackbox.bin")]


def is_running(box: Path) -> bool:
    header = read_header(box)
    return header is not None and header.phase in (Phase.ACT, Phase.SIMULATE)


STOPS = [(number, whom) for number in (signal.SIGTERM, signal.SIGHUP) for whom in ("every process", "the group")]
BY_DAY = [(signal.SIGHUP, "every process")]


@pytest.mark.nightly
@pytest.mark.parametrize(("number", "whom"), mostly_nightly(STOPS, BY_DAY))
def test_a_stop_of_everybody_at_once_is_no_crash(toy, number, whom):
    words = ("run", "h", "2", "8", "30", *FINE, *SLOW, "--json")
    process = toy.start(*words, start_new_session=True)
    wait_for(lambda: len(rows(toy.folder / "h")) >= 2)
    if whom == "every process":  # as systemd and SLURM do; the workers come first
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


@pytest.mark.nightly  # by day, executors/test_killed_trials.py, and hunts/test_hunt_parts.py has the note
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_trial_that_was_killed_from_outside_is_run_again(toy, number):
    words = ("run", "h", "1", "2", "40", *FINE, *SLOW, "--json")
    process = toy.start(*words)
    wait_for(lambda: any(is_running(box) for box in boxes(toy.folder / "h")))
    (box,) = boxes(toy.folder / "h")
    os.kill(read_header(box).pid, number)
    out, err = process.communicate(timeout=300)
    report = json.loads(out)
    assert report["outcomes"] == {"survived": 2}, err
    assert f"was ended by {number.name} from outside, and is run again" in report["notes"][0]
    assert report["notes"][0] in toy.crashhunt("logs", "h").out


@pytest.mark.nightly  # by day, executors/test_pool_of_trials.py and executors/test_new_processes.py
def test_when_the_fork_server_is_killed_another_one_takes_over(toy):
    process = toy.start("run", "h", "2", "6", "40", *FINE, *SLOW, "--json")
    wait_for(lambda: len(rows(toy.folder / "h")) >= 1)
    os.kill(tree(process.pid)[2], signal.SIGKILL)
    out, err = process.communicate(timeout=300)
    assert json.loads(out)["outcomes"] == {"survived": 6}, err
    assert "was started again" in out


def test_a_killed_hunt_takes_every_process_along(toy):
    process = toy.start("run", "h", "2", "1000", "40", *FINE, *SLOW)
    wait_for(lambda: len(rows(toy.folder / "h")) >= 1)
    process.kill()
    process.communicate()
    wait_for(lambda: not left_in(toy.folder))


@pytest.mark.nightly  # by day, a hunt that is killed
def test_a_killed_replay_leaves_no_process(toy):
    toy.crashhunt("run", "h", "1", "1", "20", "--scenario", "toy", "--agent", "faulty:Raises", "--arg", "at=5")
    for children in (1, 2):  # the keeper as it starts, and what it keeps
        process = toy.start("replay", "h")
        wait_for(lambda process=process, least=children + 1: len(tree(process.pid)) >= least)
        process.kill()
        process.communicate()
        wait_for(lambda: not left_in(toy.folder))


@pytest.mark.nightly  # by day, hunts/test_hunt_parts.py, and replays/test_verdicts.py stops a confirmation
def test_an_interrupt_while_a_hang_is_confirmed_ends_it_at_once(toy):
    words = ("run", "h", "1", "1", "20", "--scenario", "toy", "--agent", "faulty:Hangs", "--arg", "at=5")
    process = toy.begin(*words, "--timeout", "3", "--json")
    wait_for(lambda: list((toy.folder / "h" / "crashes").glob("*-hang")))
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=300)
    (crash,) = json.loads(out)["crashes"]
    assert crash["confirmed"] is None, "it waited for the hang"
    assert toy.crashhunt(*words, "--timeout", "2", "--json").json["crashes"][0]["confirmed"] is True


@pytest.mark.nightly  # by day, ledger/test_ledger_cases.py, and hunts/test_hunt_parts.py has the note
def test_a_ledger_that_is_removed_is_written_again(toy):
    process = toy.begin("run", "h", "2", "1000", "20", *FINE, *SLOW, "--json")
    wait_for(lambda: len(rows(toy.folder / "h")) >= 3)
    before = rows(toy.folder / "h")
    for path in (toy.folder / "h").glob("ledger.sqlite*"):
        path.unlink()
    wait_for(lambda: len(rows(toy.folder / "h")) > len(before))
    process.send_signal(signal.SIGINT)
    report = json.loads(process.communicate(timeout=300)[0])
    assert "written anew" in report["notes"][0]
    after = rows(toy.folder / "h")
    assert before.items() <= after.items()
    assert len(after) == report["trials_run"]


@pytest.mark.nightly  # by day, ledger/test_ledger_cases.py, and cli/test_answers.py ends a command with an error
def test_another_ledger_in_its_place_ends_the_hunt(toy):
    process = toy.begin("run", "h", "2", "1000", "20", *FINE, *SLOW, "--json")
    wait_for(lambda: len(rows(toy.folder / "h")) >= 1)
    (toy.folder / "other").write_bytes(b"")
    (toy.folder / "other").rename(toy.folder / "h" / "ledger.sqlite")
    out, err = process.communicate(timeout=300)
    assert process.returncode == 2
    assert "another file replaced the ledger" in json.loads(out)["error"]["message"]
    assert err.count("\n") == 2  # the first says that it hunts


@pytest.mark.nightly  # by day, hunts/test_hunt_loop.py
def test_a_bundle_without_a_row_gets_one(toy):
    words = ("run", "h", "1", "3", "20", "--scenario", "toy", "--agent", "faulty:Raises", "--arg", "at=5")
    first = toy.crashhunt(*words, "--keep-going", "--json").json
    from crashhunt.ledger import Ledger

    with closing(Ledger(toy.folder / "h" / "ledger.sqlite", writable=True)) as ledger:
        ledger.replace([1])
    assert set(rows(toy.folder / "h")) == {0, 2}
    second = toy.crashhunt(*words, "--keep-going", "--json").json
    assert second["trials_run"] == 3
    assert second["crashes"] == first["crashes"]


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(("status", "h"), marks=pytest.mark.nightly),
        pytest.param(("trials", "h"), marks=pytest.mark.nightly),
        ("scenarios",),
        ("--help",),
        ("run", "-h"),
        ("--version",),
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


@pytest.mark.nightly  # by day, base/test_limits.py has the fix
def test_too_few_files_are_one_line(toy):
    command = ["bash", "-c", 'ulimit -n 16; exec "$0" "$@"', str(CRASHHUNT), "run", "h", "2", "4", "20", *FINE]
    done = subprocess.run(command, cwd=toy.folder, env=toy.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "Too many open files" in done.stderr
    assert "ulimit -n" in done.stderr
    assert done.stderr.count("\n") == 1
    wait_for(lambda: not left_in(toy.folder))


@pytest.mark.nightly  # by day, ledger/test_ledger_reads.py and base/test_limits.py
def test_limit_on_the_size_of_files_is_named(toy):
    command = ["bash", "-c", 'ulimit -f 1000; exec "$0" "$@"', str(CRASHHUNT), "run", "h", "1", "1", "20", *FINE]
    done = subprocess.run(command, cwd=toy.folder, env=toy.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "the limit on the size of a file is 0.9766 MiB: raise it with ulimit -f" in done.stderr
    assert done.stderr.count("\n") == 1
