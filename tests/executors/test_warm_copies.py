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
    whole = alone[0]["setup_steps"]
    assert whole == (201 if scenario == "loop" else 40)
    assert [one.pop("setup_steps") for one in alone] == [whole] * 8
    paid = [True, True, *[False] * 5, scenario != "loop"]  # a warm-up that is shared is simulated once
    assert [one.pop("setup_steps") for one in shared] == [whole * one for one in paid]
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
    killed, left = [-11, 4, 40, 1], [7, 4, 40, 0]
    copied = [[code, steps, None, fatal] for code, steps, _, fatal in (killed, left)]  # the warm-up is another's
    assert list(ask("deaths").items()) == [
        ("segfaults-2", copied[0]), ("segfaults-0", killed), ("exits-2", copied[1]), ("exits-0", left),
    ]  # fmt: skip


def test_where_copies_are_lost_or_cannot_be_made_trials_are_run_without(ask):
    found = ask("lost")
    assert found["found"] == [["survived", False], ["survived", False], ["survived", True], ["survived", False]]
    assert found["notes"] == [
        "trials in the same traffic do not share its warm-up: no process could be started: too many"
    ]
