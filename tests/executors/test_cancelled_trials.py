"""What a cancelled trial leaves of the others: those that wait, and those that have ended."""

from __future__ import annotations

import pytest

from crashhunt.episode import WorkerSettings
from crashhunt.errors import CrashhuntError
from crashhunt.executors import PoolExecutor
from crashhunt.executors._postmortem import Attempt
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import Outcome, TrialResult, TrialSpec


@pytest.fixture
def pool(tmp_path):
    toy = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="keep-lane")})
    settings = WorkerSettings(scenario=toy, oracles=(), crash_on=(), scratch=tmp_path, timeout_s=9.0)
    executor = PoolExecutor(settings)
    yield executor
    executor.close()


def test_trials_up_to_the_given_number_and_errors_remain(pool):
    specs = [TrialSpec(number, 1, {}, {}, 9) for number in range(4)]
    pool._waiting.extend(map(Attempt, specs))
    for spec in specs:
        pool._done.put(TrialResult(spec, Outcome.SURVIVED))
    pool._done.put(CrashhuntError("the disk is full", fix="free some space"))
    pool.cancel(above=1)
    assert [attempt.spec.number for attempt in pool._waiting] == [0, 1]
    ended = pool.completed(0)
    assert [next(ended).spec.number for _ in range(2)] == [0, 1]
    with pytest.raises(CrashhuntError, match="the disk is full"):
        next(ended)
