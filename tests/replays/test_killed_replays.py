"""Replays that are killed from outside say nothing about their crash: neither that it is flaky, nor how to avoid it."""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt.crashes import list_bundles
from crashhunt.recording import Phase, read_header
from crashhunt.replays import confirm
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult

WHY = "killed from outside 3 times, each time at another step (SIGKILL after step 2, …)"


def hunted(toy):
    """One crash, for `made_once`: ego drives into the leader, and braking would have helped."""
    words = ("--scenario", "toy", "--arg", "speed=14", "--set", "step_wall_s=0.01", "--seed", "1")
    toy.crashhunt("run", "h", "1", "1", "300", "--no-snapshot", *words)


@pytest.fixture
def bundle(toy, made_once):
    made_once(hunted, toy)
    (found,) = list_bundles(toy.folder / "h")
    assert found.confirmed
    assert found.result.escape is not None
    return found


class Killed:
    """In place of an executor: every trial is killed."""

    def __init__(self, settings, *, parallel):
        pass

    def submit(self, spec):
        self.spec = spec

    def completed(self, timeout_s):
        yield TrialResult(self.spec, Outcome.INVALID, failure=Failure(KILLED, WHY, exit_code=-9))

    def close(self):
        pass


@pytest.mark.nightly
def test_unknown_escape_is_reported_and_searched_again(bundle, toy):
    unknown = replace(
        bundle.result, escape=None, why_no_escape="the process that searched was killed by SIGKILL, 2 times"
    )
    replace(bundle, result=unknown).write()
    (read,) = list_bundles(toy.folder / "h")
    assert read.result.why_no_escape
    said = (
        "The last step at which braking would have helped is unknown: the process that searched was killed by SIGKILL, "
        "2 times."
    )
    assert said in " ".join(toy.crashhunt("show", "h").out.split())
    words = ("run", "h", "1", "1", "300", "--scenario", "toy", "--arg", "speed=14", "--set", "step_wall_s=0.01")
    toy.crashhunt(*words, "--seed", "1")
    (read,) = list_bundles(toy.folder / "h")
    assert not read.result.why_no_escape
    assert read.result.escape == bundle.result.escape


def kill_replays(whom, trials="trial-000000"):
    """Start a thread that sends SIGKILL to a process that `whom` names, once for each trial; return what ends it.

    `whom` is called with the header of the recording of each trial of the replays of this process, the scratch folder
    and the number of kills, and returns a process or None.
    """
    usual = Path(tempfile.gettempdir())
    over = threading.Event()
    killed = []

    def watch():
        while not over.wait(0.002):
            for box in usual.glob(f"crashhunt-temporary-*/{os.getpid()}-*/rerun-*/{trials}/blackbox.bin"):
                with suppress(ProcessLookupError, FileNotFoundError):  # it has just ended
                    header = read_header(box)
                    if header is None or header.pid in killed:  # a killed one has another parent for a moment
                        continue
                    pid = whom(box.parent.parent, header, len(killed))
                    if pid is not None:
                        os.kill(pid, signal.SIGKILL)
                        killed.append(header.pid)

    thread = threading.Thread(target=watch)
    thread.start()

    def end():
        over.set()
        thread.join()
        return len(killed)

    return end


def parent_of(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("above", "kills", "why"),
    [
        (0, 2, ""),
        (0, 3, "the process that searched was killed by SIGKILL, 3 times"),
        (1, 1, "the process that searched was killed by SIGKILL"),
    ],
)
def test_search_for_the_escape_that_is_killed_is_done_again(bundle, above, kills, why):
    """Killed are trials of the search, or the zygote that forks them (1 above)."""

    def whom(scratch, header, before):
        if before == kills or header.phase != Phase.SIMULATE:
            return None
        pid = header.pid
        for _ in range(above):
            pid = parent_of(pid)
        return pid

    end = kill_replays(whom, "trial-1*")
    began = time.monotonic()
    try:
        found = confirm(replace(bundle, confirmed=None))
    finally:
        count = end()
    assert time.monotonic() - began < 60
    assert (count, found.confirmed) == (kills, True)
    assert found.result.why_no_escape == why
    assert found.result.escape == (None if why else bundle.result.escape)
