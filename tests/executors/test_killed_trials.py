"""A trial whose process is killed from outside, by another process and at chosen steps."""

from __future__ import annotations

import os
import shutil
import signal
import time
from pathlib import Path

import pytest
from conftest import FAULTY
from toy_trials import settings_for

from crashhunt.executors import FreshProcessExecutor, PoolExecutor
from crashhunt.trial import KILLED, Outcome, TrialSpec

STEPS = 60


@pytest.fixture
def settings(tmp_path, monkeypatch):
    shutil.copy(FAULTY, tmp_path)
    monkeypatch.chdir(tmp_path)
    return settings_for(tmp_path, "faulty:Waits")


def run_and_kill(executor, spec, steps):
    """Run a trial whose process gets SIGKILL when it has done each of some numbers of steps, at which it waits."""
    steps, waits = list(steps), Path("waits")
    Path("wait-at").write_text(str(steps[0]))
    executor.submit(spec)
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        found = list(executor.completed(0.0))
        if found:
            return found[0]
        header = executor.where().get(spec.number)
        if waits.exists() and header is not None and header.pid == int(waits.read_text()):
            waits.unlink()
            steps.pop(0)
            Path("wait-at").write_text(str(steps[0]) if steps else "")
            os.kill(header.pid, signal.SIGKILL)
        time.sleep(0.002)
    raise AssertionError("the trial did not end")


@pytest.mark.parametrize("kind", [PoolExecutor, pytest.param(FreshProcessExecutor, marks=pytest.mark.nightly)])
def test_trial_killed_three_times_at_different_steps_is_invalid_and_no_crash(settings, kind):
    spec = TrialSpec(4, 7, {"ego": {"speed": 5.0}}, {}, max_steps=STEPS)
    executor = kind(settings, parallel=1)
    try:
        result = run_and_kill(executor, spec, (4, 16, 30))
        assert result.outcome is Outcome.INVALID
        assert result.was_killed_from_outside
        assert (result.failure.kind, result.failure.exit_code) == (KILLED, -signal.SIGKILL)
        assert result.summary.startswith("killed from outside 3 times, each time at another step (SIGKILL after step ")
        assert (result.steps, result.digest) == (0, "")
        notes = executor.notes()
        assert "trial 4 was ended by SIGKILL from outside, and is run again" in notes
        # The next trial is not affected, and neither is one that is killed twice only.
        after = run_and_kill(executor, TrialSpec(5, 7, spec.arguments, spec.scenario_arguments, STEPS), (4, 16))
        assert (after.outcome, after.steps) == (Outcome.SURVIVED, STEPS)
        assert not after.was_killed_from_outside
    finally:
        executor.close()
