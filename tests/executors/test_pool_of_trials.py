"""Which trials a pool starts and cancels, and how often it starts its fork server again, without any process."""

from __future__ import annotations

import signal
import subprocess
from types import SimpleNamespace

import pytest
from toy_trials import settings_for

from crashhunt.errors import CrashhuntError
from crashhunt.executors import PoolExecutor, _fork_server_link
from crashhunt.executors._trial_attempts import TrialAttempt
from crashhunt.trial import Outcome, TrialResult, TrialSpec


@pytest.fixture
def pool(tmp_path):
    executor = PoolExecutor(settings_for(tmp_path, crash_on=(), timeout_s=9.0))
    yield executor
    executor.close()


def test_trials_up_to_the_given_number_and_errors_remain(pool):
    specs = [TrialSpec(number, 1, {}, {}, 9) for number in range(4)]
    pool._waiting.extend(map(TrialAttempt, specs))
    for spec in specs:
        pool._done.put(TrialResult(spec, Outcome.SURVIVED))
    pool._done.put(CrashhuntError("the disk is full", fix="free some space"))
    pool.cancel(above=1)
    assert [attempt.spec.number for attempt in pool._waiting] == [0, 1]
    ended = pool.completed(0)
    assert [next(ended).spec.number for _ in range(2)] == [0, 1]
    with pytest.raises(CrashhuntError, match="the disk is full"):
        next(ended)


@pytest.fixture
def started(pool, monkeypatch):
    """The numbers of the trials that the pool has started, in processes that run forever."""
    numbers = []

    def give(worker, attempt):
        worker.attempt = attempt
        numbers.append(attempt.spec.number)

    pool._link = SimpleNamespace(ready=True, fork=lambda *_: None, kill=lambda *_: None, end=lambda: None)
    monkeypatch.setattr(pool, "_send_trial", give)
    return numbers


def test_as_many_trials_run_as_there_are_slots_that_are_not_held_back(pool, started):
    pool._parallel, pool.held_back = 3, 1
    pool._waiting.extend(TrialAttempt(TrialSpec(number, 1, {}, {}, 9)) for number in range(5))
    pool._assign_trials()
    assert started == [0, 1]
    pool.held_back = 0
    pool._assign_trials()
    assert started == [0, 1, 2]


def test_trial_that_was_killed_runs_alone(pool, started):
    pool._parallel = 3
    specs = [TrialSpec(number, 1, {}, {}, 9) for number in range(3)]
    pool._waiting.extend(
        [TrialAttempt(specs[0]), TrialAttempt(specs[1], [(-signal.SIGKILL, 5)]), TrialAttempt(specs[2])]
    )
    for expected in ([0], [0, 1], [0, 1, 2]):
        for _ in range(2):  # while it runs, nothing else starts
            pool._assign_trials()
            assert started == expected
        for worker in pool._workers.values():
            worker.attempt = None


@pytest.mark.parametrize(
    ("code", "deaths", "says"),
    [
        (-signal.SIGKILL, 1, ""),
        (-signal.SIGKILL, 2, "the process that starts the workers was killed by SIGKILL, 3 times: no memory"),
        (None, 1, ""),  # it does not end
        (1, 0, "the process that starts the workers exited with 1: no memory"),
        (-signal.SIGSEGV, 0, "the process that starts the workers was killed by SIGSEGV: no memory"),
    ],
)
def test_fork_server_that_is_killed_starts_again_twice(tmp_path, monkeypatch, code, deaths, says):
    def wait(timeout_s):
        if code is None:
            raise subprocess.TimeoutExpired("it", timeout_s)
        return code

    ended = []
    link = _fork_server_link.ForkServerLink.__new__(_fork_server_link.ForkServerLink)
    link._settings, link._late, link._snapshot, link._importing = "settings", False, True, ""
    link.deaths, link.unfit = deaths, False
    link._job, link._log = tmp_path / "job", tmp_path / "log"
    link._log.write_text("first\nno memory\n")
    link._kept = SimpleNamespace(process=SimpleNamespace(wait=wait), end=lambda: ended.append(True))
    link.control = SimpleNamespace(close=lambda: None)
    monkeypatch.setattr(_fork_server_link, "ForkServerLink", lambda *words, **more: (words, more))
    if says:
        with pytest.raises(CrashhuntError) as caught:
            link.restart()
        assert caught.value.message == says
    else:
        assert link.restart() == (("settings",), {"late": False, "deaths": deaths + 1, "snapshot": True})
    assert ended == [True]
