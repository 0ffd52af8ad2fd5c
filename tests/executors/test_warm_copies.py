"""Trials in the same traffic begin from one warm-up, and nothing about them tells."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from crashhunt.executors import worker_environment

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux only")


@pytest.fixture
def ask(tmp_path):
    """Asks a process of one thread."""

    def ask_it(what):
        here = Path(__file__).parent
        done = subprocess.run(
            [sys.executable, here / "sharing.py", what, tmp_path], capture_output=True, text=True, check=False,
            env={**os.environ, **worker_environment(), "PYTHONPATH": str(here)}, timeout=100,
        )  # fmt: skip
        assert done.stderr == ""
        return json.loads(done.stdout)

    return ask_it


@pytest.mark.parametrize("scenario", ["toy", pytest.param("loop", marks=pytest.mark.nightly)])
def test_a_shared_warm_up_changes_nothing(ask, scenario):
    found = ask(scenario)
    shared, alone = found["4"], found["0"]
    others = [True] if scenario == "loop" else [False]  # where an argument makes it another traffic
    assert [one.pop("shared") for one in shared] == [False, False, True, True, True, True, True, *others]
    assert not any(one.pop("shared") for one in alone)
    assert len({one["digest"] for one in alone}) >= 4
    assert shared == alone
    assert found["log"] == "here\n"
    assert found["kept"] == alone[5]["digest"]
    assert alone[5]["outcome"] == "agent_error"
    assert found["notes"] == []
    assert found["change"] == ""
    assert found["asleep"] == (2 if scenario == "loop" else 3)


def test_of_more_traffics_than_copies_some_are_kept(ask):
    assert ask("turns")["shared"] == [False, False, False, True, True, False, True, True, False]


def test_a_worker_ends_as_the_copy_did_that_ran_its_trial(ask):
    assert ask("deaths") == {"segfaults": [-11, 4, 1], "exits": [7, 4, 0]}


def test_where_copies_are_lost_or_cannot_be_made_trials_are_run_without(ask):
    found = ask("lost")
    assert found["found"] == [["survived", False], ["survived", False], ["survived", True], ["survived", False]]
    assert found["notes"] == [
        "trials in the same traffic do not share its warm-up: no process could be started: too many"
    ]
