"""Trials run again: each run by its index, whatever ends first; stops, errors and files of the runs."""

from __future__ import annotations

import queue
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt import trial_reruns
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.errors import CrashhuntError
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import CRASHES, Outcome, Overruled, TrialResult, TrialSpec
from crashhunt.trial_reruns import (
    Budget,
    NotUnderstoodError,
    OutOfTimeError,
    Reruns,
    SharedReruns,
    StoppedError,
    call_in_threads,
    run_alone,
)


def spec(number):
    return TrialSpec(number, 7, {"ego": {"speed": 5.0}}, {}, 12)


def survived(number):
    return TrialResult(spec(number), Outcome.SURVIVED, steps=12)


@pytest.fixture
def worker(tmp_path):
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="keep-lane")})
    return WorkerSettings(scenario=scenario, oracles=(), crash_on=CRASHES, scratch=tmp_path, keep_trials=True)


class Executor:
    """Each call of `completed` yields the trials with the next of the numbers in `ends`."""

    def __init__(self, *ends):
        self.ends, self.submitted, self.cancelled, self.closed = list(ends), {}, [], 0

    def submit(self, given):
        self.submitted[given.number] = given

    def completed(self, timeout_s):
        for number in self.ends.pop(0) if self.ends else [*self.submitted]:
            yield TrialResult(self.submitted.get(number, spec(number)), Outcome.SURVIVED, steps=12)

    def cancel(self, *, above=-1):
        self.cancelled.append(above)

    def close(self):
        self.closed += 1


@pytest.fixture
def runs(worker, monkeypatch):
    """Makes reruns whose trials end as given; returns them with their executor."""

    def make(*ends, **more):
        executor = Executor(*ends)
        monkeypatch.setattr(trial_reruns, "PoolExecutor", lambda *given, **_: executor)
        return Reruns(worker, "current", **more), executor

    return make


def test_trials_of_one_caller_end_in_any_order(runs):
    made, executor = runs([], [6, 99], [5, 7])
    found = [(one.place, one.result) for one in made.run([spec(number) for number in (5, 6, 7)])]
    assert found == [(1, survived(6)), (0, survived(5)), (2, survived(7))]
    assert ([*executor.submitted], executor.cancelled) == ([5, 6, 7], [])


def test_trials_that_are_not_needed_or_not_awaited_are_cancelled(runs):
    made, executor = runs([6], [8, 7, 5])
    found = list(made.run([spec(number) for number in (5, 6, 7, 8)], needed=lambda index: index < 2))
    assert [one.place for one in found] == [1, 0]
    assert executor.cancelled == [6]
    made, executor = runs([6], [5])
    begun = made.run([spec(5), spec(6)])
    next(begun)
    begun.close()
    assert executor.cancelled == [-1]
    stops = iter([False, True])
    made, executor = runs([5], stopped=lambda: next(stops))
    found = []
    with pytest.raises(StoppedError):
        found.extend(made.run([spec(5), spec(6)]))
    assert executor.cancelled == [-1]


def test_runs_with_numbers_of_their_own_may_repeat_a_trial(runs):
    made, executor = runs([2], [1], numbered=True)
    found = [(one.place, one.result) for one in made.run([spec(5), spec(5)])]
    assert found == [(1, survived(5)), (0, survived(5))]
    list(made.run([spec(5)]))
    assert [*executor.submitted] == [1, 2, 3]


def test_result_of_a_cancelled_trial_is_no_result_of_a_later_run(runs):
    made, _ = runs([5], [6, 7], [7])
    begun = made.run([spec(5), spec(6)])
    next(begun)
    begun.close()
    assert [one.result.spec.number for one in made.run([spec(7)])] == [7]


def test_files_of_a_run_exist_until_the_next_one(runs, worker):
    for number in (5, 6):
        scratch_of(worker.scratch, number).mkdir()
    made, _ = runs([5], [6])
    for ended in made.run([spec(5), spec(6)]):
        assert ended.folder == scratch_of(worker.scratch, ended.result.spec.number)
        assert ended.folder.is_dir()
        assert ended.recording is None
        assert ended.lanes == []
    assert list(worker.scratch.iterdir()) == []


def test_trial_that_ran_without_a_part_of_its_specification_is_refused(runs):
    made, executor = runs([5])
    executor.submit = lambda given: None  # it runs the trial without the change
    with pytest.raises(NotUnderstoodError, match="too old"):
        list(made.run([replace(spec(5), overruled=Overruled("ego", 3))]))


def test_one_trial_that_is_run_alone_ends_with_its_process(worker, monkeypatch):
    made, executor = [], Executor()
    monkeypatch.setattr(trial_reruns, "PoolExecutor", lambda given, **_: made.append(given) or executor)
    unplaced = replace(worker, scratch=Path())
    for ended in run_alone(unplaced, spec(3)):
        assert (ended.result, ended.folder) == (survived(3), scratch_of(made[0].scratch, 3))
        assert made[0].scratch.is_dir()
    assert executor.closed == 1
    assert not made[0].scratch.exists()
    with pytest.raises(StoppedError):
        list(run_alone(unplaced, spec(3), lambda: True))
    assert executor.closed == 2


def test_reruns_with_the_code_of_a_snapshot_are_new_processes(worker, monkeypatch):
    made = []
    monkeypatch.setattr(trial_reruns, "PoolExecutor", lambda given, **more: made.append(more))
    for where in ("snapshot", "current"):
        Reruns(worker, where, parallel=2)
    assert made == [{"parallel": 2, "snapshot": True}, {"parallel": 2, "snapshot": False}]


class Failing:
    """Reports once that it can run no trial, as a pool does, and no trial ends."""

    def __init__(self, *given, **_):
        self.errors, self.submitted = queue.SimpleQueue(), []

    def submit(self, given):
        self.submitted.append(given)
        if len(self.submitted) == 1:
            self.errors.put(CrashhuntError("the simulator cannot be created", fix="install it"))

    def completed(self, timeout_s):
        try:
            raise self.errors.get(timeout=timeout_s / 10)
        except queue.Empty:
            return iter(())

    def close(self):
        pass


def test_executor_that_fails_once_fails_every_thread(worker, monkeypatch, tmp_path):
    monkeypatch.setattr(trial_reruns, "PoolExecutor", Failing)
    shared, looks = SharedReruns(tmp_path / "shared", parallel=2), iter(range(200))
    with ThreadPoolExecutor(2) as threads:
        begun = [threads.submit(shared.run, worker, spec(3), lambda: next(looks, None) is None) for _ in range(4)]
    for run in begun:
        with pytest.raises(CrashhuntError, match="cannot be created"):
            run.result()
    shared.close()


def test_threads_share_the_processes_of_equal_settings(worker, monkeypatch, tmp_path):
    made = []

    def executor(given, *, parallel, snapshot):
        made.append((given.scratch.name, snapshot, parallel, found := Executor()))
        return found

    monkeypatch.setattr(trial_reruns, "PoolExecutor", executor)
    shared = SharedReruns(tmp_path / "shared", parallel=2)
    for scratch in ("a", "b"):  # which is not the folder of the runs
        ended = shared.run(replace(worker, scratch=tmp_path / scratch), spec(3))
        assert ended.result == survived(3)
    shared.run(replace(worker, timeout_s=3.0), spec(4))
    assert [one[:3] for one in made] == [("shared-0", True, 2), ("shared-1", True, 2)]
    with pytest.raises(StoppedError):
        shared.run(worker, spec(3), lambda: True)
    assert made[0][3].cancelled == []  # which would cancel the runs of other threads
    shared.close()
    assert [one[3].closed for one in made] == [1, 1]


def test_budget_names_what_has_ended_it(monkeypatch):
    now, stops = [5.0], []
    monkeypatch.setattr(trial_reruns.time, "monotonic", lambda: now[0])
    budget = Budget(lambda: bool(stops), 2.0)
    assert (budget.require(), budget.why) == (False, "")
    now[0] = 7.0
    with pytest.raises(OutOfTimeError):
        budget.require()
    assert budget.why == "the time is over"
    stops.append(True)
    with pytest.raises(StoppedError) as caught:
        budget.require()
    assert not isinstance(caught.value, OutOfTimeError)
    assert budget.why == "stopped"


def test_calls_in_threads_return_in_the_order_of_the_items():
    first, ended = threading.Event(), []

    def call(item):
        if item == 0:
            assert first.wait(300)
        first.set()
        return -item

    assert call_in_threads(call, [0, 1, 2], 2, ended=ended.append) == [0, -1, -2]
    assert sorted(ended) == [-2, -1, 0]
    with pytest.raises(ZeroDivisionError):
        call_in_threads(lambda item: 1 // item, [1, 0], 2)
