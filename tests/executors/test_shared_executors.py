"""An executor that several threads share: an error that it reports once is an error for each of them."""

from __future__ import annotations

import queue
from concurrent.futures import ThreadPoolExecutor

import pytest

from crashhunt.episode import WorkerSettings
from crashhunt.errors import CrashhuntError
from crashhunt.executors import SharedExecutors
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import CRASHES, TrialSpec

SPEC = TrialSpec(3, 7, {"ego": {"speed": 5.0}}, {}, 12)


class Failing:
    """Reports once that it can run no trial, as a pool does, and no trial ends."""

    def __init__(self, settings, *, parallel):
        self.errors, self.submitted = queue.SimpleQueue(), []

    def submit(self, spec):
        self.submitted.append(spec)
        if len(self.submitted) == 1:
            self.errors.put(CrashhuntError("the simulator cannot be created", fix="install it"))

    def completed(self, timeout_s):
        try:
            raise self.errors.get(timeout=timeout_s / 10)
        except queue.Empty:
            return iter(())

    def close(self):
        pass


def test_executor_that_fails_once_fails_every_thread(tmp_path, monkeypatch):
    monkeypatch.setattr("crashhunt.executors._fresh.snapshot_executor", Failing)
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="keep-lane")})
    settings = WorkerSettings(scenario=scenario, oracles=(), crash_on=CRASHES, scratch=tmp_path)
    shared, looks = SharedExecutors(tmp_path, parallel=2), iter(range(200))
    with ThreadPoolExecutor(2) as threads:
        runs = [threads.submit(shared.run, settings, SPEC, lambda: next(looks, None) is None) for _ in range(4)]
    for run in runs:
        with pytest.raises(CrashhuntError, match="cannot be created"):
            run.result()
    shared.close()
