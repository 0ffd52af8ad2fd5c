"""Every outcome is told apart, saved with its evidence, confirmed and replayed, in real processes; some on SUMO."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from crashhunt.recording import read_log

if TYPE_CHECKING:
    from pathlib import Path

QUIET = ("--set", "vehicles=10")
TOY = ("--scenario", "toy")
QUICK = ("--no-snapshot", "--json")
FAULTS = [
    ("Raises", "agent_error", "ValueError", "no plan"),
    ("ExitsPython", "agent_error", "SystemExit", "1"),
    ("Nan", "agent_error", "bad action", "nan"),
    ("OutOfSpace", "agent_error", "bad action", "(10.0, 2)"),
    ("ReturnsNone", "agent_error", "bad action", "None"),
    ("Exits3", "process_died", "exit code", "exited with 3 in ego's act() of step 20"),
    ("Exits0", "process_died", "exit code", "exited with 0 in ego's act() of step 20"),
    ("Segfaults", "process_died", "signal", "SIGSEGV in ego's act() of step 20"),
    ("Hangs", "hang", "timeout", "ego's act() of step 20"),
    ("HangsHoldingTheInterpreter", "hang", "timeout", "ego's act() of step 20"),
]


def crash_of(folder: Path) -> dict[str, Any]:
    (path,) = (folder / "crashes").glob("*/crash.json")
    found: dict[str, Any] = json.loads(path.read_text())
    return {**found, "path": path.parent}


ON_SUMO = ("Segfaults",)
# By day, an exception and a signal. Tests of executors have other ends of processes and hangs, also of what holds the
# interpreter; tests of episodes have what is no action.
AT_NIGHT = (
    "ExitsPython", "Nan", "OutOfSpace", "ReturnsNone", "Exits3", "Exits0", "Hangs", "HangsHoldingTheInterpreter",
)  # fmt: skip


@pytest.mark.parametrize(
    ("agent", "outcome", "kind", "message"),
    [pytest.param(*fault, id=fault[0], marks=[pytest.mark.nightly] * (fault[0] in AT_NIGHT)) for fault in FAULTS],
)
def test_a_software_fault_is_found_saved_and_replayed(toy, agent, outcome, kind, message):
    where = QUIET if agent in ON_SUMO else TOY
    limit = ("--timeout", "2" if agent in ON_SUMO else "1") if outcome == "hang" else ()
    words = ("run", "h", "1", "8", "200", "--agent", f"faulty:{agent}", *where, *limit, "--json")
    report = toy.crashhunt(*words).json
    assert report["stopped_because"] == "crash"
    (found,) = report["crashes"]
    assert (found["outcome"], found["step"], found["confirmed"]) == (outcome, 19, True)

    crash = crash_of(toy.folder / "h")
    assert crash["category"] == "software fault"
    assert crash["failure"]["kind"] == kind
    assert message in crash["failure"]["message"]
    assert crash["failure"]["agent"] == "ego"
    run_log = (crash["path"] / "run.log").read_text()
    assert "about to go wrong" in run_log
    error_log = (crash["path"] / "error.log").read_text()
    assert message in error_log
    if outcome == "agent_error" and kind != "bad action":
        assert "go_wrong" in error_log  # the traceback
    if outcome == "hang" or agent == "Segfaults":
        assert "go_wrong" in crash["failure"]["traceback"]  # the stack, by faulthandler
    if outcome == "process_died":
        assert "about to go wrong" in crash["failure"]["last_output"]
        recording = read_log(crash["path"] / "log.mcap")  # which ends with the step before
        assert recording.steps == 19
        assert recording.actions("ego").shape == (19, 2)
        assert recording.observations("ego").shape[0] == 20  # what it was shown when it died
        assert not recording.all_steps[-1].whole

    verdict = toy.crashhunt("replay", "h", "--json").json
    assert verdict["verdict"] == "reproduced"
    assert verdict["steps_recorded"] == verdict["steps_replayed"] == 19
    assert verdict["digest_recorded"] == verdict["digest_replayed"] == crash["digest"]
    assert verdict["divergence"] is None


def test_an_agent_that_does_not_start_is_refused_at_once(toy):
    """It once was so many trials that could not be set up."""
    done = toy.crashhunt("run", "h", "1", "500", "100", "--agent", "faulty:FailsToStart", *TOY, "--json", expect=2)
    assert done.json["error"]["message"] == "faulty:FailsToStart does not start: RuntimeError: no weights"
    assert done.json["error"]["where"] == "faulty.py:82"
    (hunt,) = toy.crashhunt("status", "h", "--json").json["hunts"]
    assert (hunt["state"], hunt["trials_run"], hunt["crashes"]) == ("error", 0, 0)
    assert "no weights" in hunt["detail"]


def test_process_that_dies_in_the_constructor_of_an_agent_is_no_crash(toy):
    done = toy.crashhunt("run", "h", "1", "500", "100", "--agent", "faulty:DiesAtStart", *TOY, *QUICK, expect=2)
    message = done.json["error"]["message"]
    assert message.startswith("faulty:DiesAtStart does not start: ")
    assert "exited with 7" in message
    assert not [*toy.folder.glob("h/crashes/*")]


def test_crash_on_decides_what_counts(toy):
    words = ("run", "h", "1", "2", "60", "--agent", "faulty:Raises", *TOY, "--json")
    report = toy.crashhunt(*words, "--crash-on", "collision,hang", "--no-snapshot").json
    assert report["stopped_because"] == "all_trials"
    assert report["outcomes"] == {"agent_error": 2}
    assert report["crashes"] == []
    assert sorted(path.name for path in (toy.folder / "h" / "trials").iterdir()) == [f"{n:06d}" for n in range(2)]
    assert "no plan" in (toy.folder / "h" / "trials" / "000001" / "error.log").read_text()
