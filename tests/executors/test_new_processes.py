"""Trials in new Python processes, all trials of one caller, and the answers of a pool: no process is started."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
from toy_trials import settings_for

from crashhunt.base.errors import CrashhuntError
from crashhunt.executors import PoolExecutor, _fork_server_link, _fresh, _pool, _worker_environment
from crashhunt.executors._fresh import FreshProcessExecutor
from crashhunt.executors._trial_attempts import TrialAttempt
from crashhunt.trial import Outcome, TrialResult, TrialSpec

KILL = -signal.SIGKILL


def spec(number):
    return TrialSpec(number, 7, {"ego": {}}, {}, 12)


def survived(number):
    return TrialResult(spec(number), Outcome.SURVIVED, steps=12)


@pytest.fixture
def settings(tmp_path):
    return settings_for(tmp_path, crash_on=(), scratch=tmp_path, timeout_s=9.0)


@pytest.fixture
def pools(monkeypatch):
    """The pools that were made, one for each trial; a trial runs until its result is in `found`."""
    made = []

    class Pool:
        def __init__(self, settings, *, snapshot, may_repeat):
            assert snapshot
            self.settings, self.may_repeat, self.found, self.told = settings, may_repeat, [], []
            self.runs, self.repeats, self.closed = True, False, 0
            made.append(self)

        def submit(self, given):
            self.number = given.number

        def completed(self, timeout_s):
            assert timeout_s == 0.0
            while self.found:
                yield self.found.pop()

        def where(self):
            return {self.number: "step 3"}

        def notes(self):
            return self.told

        def close(self):
            self.closed += 1

    monkeypatch.setattr(_fresh, "PoolExecutor", Pool)
    monkeypatch.setattr(_fresh, "_LOOK_EVERY_S", 0.001)
    return made


def test_as_many_new_processes_run_as_asked(settings, pools):
    executor = FreshProcessExecutor(settings, parallel=2)
    assert executor.capacity == 2
    for number in range(4):
        executor.submit(spec(number))
    assert [(pool.number, pool.settings) for pool in pools] == [(0, settings), (1, settings)]
    assert executor.where() == {0: "step 3", 1: "step 3"}
    assert list(executor.completed(0.01)) == []
    pools[0].told = ["a"]
    pools[1].found, pools[1].told = [survived(1)], ["a", "b"]
    assert list(executor.completed(5)) == [survived(1)]
    assert [(pool.number, pool.closed) for pool in pools] == [(0, 0), (1, 1), (2, 0)]
    assert sorted(executor.notes()) == ["a", "b"]
    assert executor.notes() == []
    executor.cancel(above=0)
    assert [pool.closed for pool in pools] == [0, 1, 1]
    pools[0].found = [survived(0)]
    assert list(executor.completed(5)) == [survived(0)]
    executor.submit(spec(5))
    executor.close()
    assert pools[-1].closed == 1
    assert list(executor.completed(0)) == []


def test_trial_that_was_killed_runs_again_and_alone(settings, pools):
    executor = FreshProcessExecutor(settings, parallel=3)
    for number in range(4):
        executor.submit(spec(number))
    first, second, third = pools
    second.repeats, second.runs = True, False
    assert not second.may_repeat()
    third.repeats, third.runs = True, False
    first.found = [survived(0)]
    assert list(executor.completed(0)) == [survived(0)]
    assert len(pools) == 3  # nothing begins while a trial waits for others to end
    assert second.may_repeat()
    assert not third.may_repeat()  # it is the next one
    second.found = [survived(1)]
    assert list(executor.completed(0)) == [survived(1)]
    assert third.may_repeat()
    third.runs = True
    third.found = [survived(2)]
    assert list(executor.completed(0)) == [survived(2)]
    assert [pool.number for pool in pools] == [0, 1, 2, 3]
    executor.close()


def test_code_below_a_folder_with_a_colon_is_imported_through_a_link(settings, monkeypatch, tmp_path):
    """A hunt may be named by its time, such as 2026-11-29T12:30, but a colon separates the paths in PYTHONPATH."""
    monkeypatch.delenv("PYTHONPATH", raising=False)
    code = tmp_path / "hunt-12:30" / "snapshots" / "0f" / "code"
    code.mkdir(parents=True)
    (code / "twelve_thirty.py").write_text("print('imported')")
    for _ in range(2):  # in the second process, the link exists
        found = _worker_environment.snapshot_environment(replace(settings, code=(str(code),)))
        ran = subprocess.run([sys.executable, "-m", "twelve_thirty"], env=found, capture_output=True, text=True)
        assert (ran.stdout, ran.stderr) == ("imported\n", "")


def test_code_of_a_snapshot_is_compiled_outside_of_it_and_few_are_kept(settings, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", "/mine")
    plain = _worker_environment.snapshot_environment(settings)
    assert plain["PYTHONPATH"] == "/mine"
    assert plain["PYTHONHASHSEED"] == "0"
    assert {plain[f"{name}_NUM_THREADS"] for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR")} == {"1"}
    compiled = tmp_path / "crashhunt/compiled"
    for number in range(20):
        (compiled / f"{number}").mkdir(parents=True)
        os.utime(compiled / f"{number}", (number, number))
    ours = replace(settings, code=("/hunt/snapshots/abc/snapshots/0f/code", "/more"))
    found = _worker_environment.snapshot_environment(ours)
    assert found["PYTHONPATH"] == os.pathsep.join((*ours.code, "/mine"))
    assert found["PYTHONPYCACHEPREFIX"] == str(compiled / "0f")
    assert found["PYTHONDONTWRITEBYTECODE"] == ""
    assert {path.name for path in compiled.iterdir()} == {"0f", *(str(number) for number in range(5, 20))}
    for other in (replace(ours, code=("/elsewhere/code",)), replace(ours, sealed=())):
        found = _worker_environment.snapshot_environment(other)
        assert found["PYTHONDONTWRITEBYTECODE"] == "1"
        assert found.get("PYTHONPYCACHEPREFIX") == os.environ.get("PYTHONPYCACHEPREFIX")


@pytest.fixture
def pool(settings):
    executor = PoolExecutor(settings, parallel=2)
    yield executor
    executor.close()


@pytest.fixture
def worker(pool):
    """A supervisor of a pool; `end` is its end of the connection."""
    pool._link = SimpleNamespace(
        fork=lambda slot, theirs: forked.append((slot, os.dup(theirs.fileno()))), deaths=2, end=lambda: None, killed=[]
    )
    pool._link.kill = pool._link.killed.append
    forked = []
    found = pool._start_worker(pool._link)
    ((slot, descriptor),) = forked
    assert found.slot == slot
    end = socket.socket(fileno=descriptor)
    end.setblocking(False)
    pool._send_trial(found, TrialAttempt(spec(3)))
    assert json.loads(end.recv(1 << 16)) == spec(3).to_json()
    assert not found.socket.getblocking()
    found_end = SimpleNamespace(worker=found, end=end)
    with end:
        yield found_end


def test_answer_of_a_supervisor_is_put_together_and_counts(pool, worker):
    text = json.dumps({"result": survived(3).to_json(), "notices": ["a"], "retires": False}).encode() + b"\n"
    worker.end.sendall(text[:20])
    pool._read_messages(worker.worker)
    assert list(pool.completed(0)) == []
    worker.end.sendall(text[20:] + text)
    pool._read_messages(worker.worker)
    assert list(pool.completed(0)) == [survived(3)]  # the second answers no trial
    assert (pool.notes(), pool._link.deaths) == (["a"], 0)
    assert not worker.worker.retired
    pool._read_messages(worker.worker)  # nothing
    pool._send_trial(worker.worker, TrialAttempt(spec(4)))
    worker.end.recv(1 << 16)
    worker.end.sendall(text.replace(b'"retires": false', b'"retires": true'))
    pool._read_messages(worker.worker)
    assert worker.worker.retired
    assert worker.end.recv(10) == b""  # it is told to end


def test_trial_that_a_supervisor_lost_runs_again(pool, worker):
    worker.end.sendall(b'{"lost": -15}\n')
    pool._read_messages(worker.worker)
    assert [attempt.spec.number for attempt in pool._waiting] == [3]
    assert worker.worker.retired
    assert pool.notes() == ["trial 3 was ended by SIGTERM from outside, and is run again"]
    for _ in range(2):
        pool._end_attempt(pool._waiting.popleft(), KILL)
    (result,) = pool.completed(0)
    assert result.failure.exit_code == KILL


def test_result_of_a_trial_counts_if_the_search_for_its_escape_dies(pool, worker):
    worker.end.sendall(json.dumps({"result": survived(3).to_json(), "searches": True}).encode() + b"\n")
    pool._read_messages(worker.worker)
    assert list(pool.completed(0)) == []
    pool._ended(worker.worker.slot, KILL)
    why = "the process that searched was killed by SIGKILL"
    assert list(pool.completed(0)) == [replace(survived(3), why_no_escape=why)]
    assert not pool._waiting


def test_trial_waits_until_it_may_run_again(pool):
    forked, may = [], []
    pool._link = SimpleNamespace(
        ready=True, fork=lambda slot, end: forked.append(slot), kill=lambda slot: None, end=lambda: None
    )
    pool._may_repeat = lambda: bool(may)
    pool._waiting.append(TrialAttempt(spec(3), [(KILL, 2)]))
    assert (pool.repeats, pool.runs) == (True, False)
    pool._assign_trials()
    assert forked == []
    may.append(True)
    pool._assign_trials()
    assert (forked, pool.repeats, pool.runs) == ([1], True, True)


def test_error_of_a_supervisor_is_one_of_the_pool(pool, worker):
    worker.end.sendall(json.dumps(CrashhuntError("no map", fix="x").to_json()).encode() + b"\n")
    with pytest.raises(CrashhuntError, match="no map"):
        pool._read_messages(worker.worker)


@pytest.mark.parametrize("code", [0, 3, -signal.SIGTERM])
def test_end_of_a_supervisor_ends_its_trial(pool, worker, code):
    pool._ended(99, code)  # another one
    assert pool._waiting == type(pool._waiting)()
    pool._ended(worker.worker.slot, code)
    (attempt,) = pool._waiting
    assert attempt.ends == [(code if code < 0 else KILL, -1)]
    assert pool._workers == {}
    assert worker.worker.socket.fileno() == -1


def test_last_words_of_a_supervisor_count(pool, worker):
    worker.end.sendall(json.dumps({"result": survived(3).to_json()}).encode() + b"\n")
    pool._ended(worker.worker.slot, 0)
    assert list(pool.completed(0)) == [survived(3)]
    assert not pool._waiting


def test_cancelled_trial_ends_its_supervisor(pool, worker):
    pool.cancel(above=3)
    assert (pool._link.killed, worker.worker.retired) == ([], False)
    pool.cancel(above=2)
    assert (pool._link.killed, worker.worker.retired, worker.worker.attempt) == ([worker.worker.slot], True, None)


def test_fork_server_that_ended_is_replaced_and_its_trials_run_again(pool, worker, monkeypatch):
    ours, theirs = socket.socketpair()
    fresh, fresh_theirs = socket.socketpair()
    new = SimpleNamespace(control=fresh, end=lambda: None, kill=lambda slot: None)
    pool._link.control, pool._link.unfit = ours, False
    pool._link.restart = lambda: new
    pool._link.receive = lambda: None
    pool._selector.register(ours, _pool.selectors.EVENT_READ)
    pool._waiting.extend(TrialAttempt(spec(number)) for number in (9, 2))
    with ours, theirs, fresh, fresh_theirs:
        pool._read_fork_server()
        assert pool._link is new
        assert [attempt.spec.number for attempt in pool._waiting] == [2, 3, 9]
        assert pool._workers == {}
        assert "the process that starts the workers was killed from outside, and was started again" in pool.notes()
        new.receive = lambda: [{"slot": 5, "pid": 1, "exit_code": 0}]
        pool._read_fork_server()
        assert pool._link is new


def test_messages_of_a_fork_server_are_read_until_there_are_no_more():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    link = _pool.ForkServerLink.__new__(_pool.ForkServerLink)
    link.control, link.ready, link.unfit, link._importing = ours, False, False, ""
    with ours, theirs:
        assert link.receive() == []
        theirs.send(b'{"importing": "a module"}')
        theirs.send(b'{"slot": 1, "pid": 2, "exit_code": 3}')
        assert link.receive() == [{"slot": 1, "pid": 2, "exit_code": 3}]
        assert (link.ready, link.unfit, link._importing) == (False, False, "a module")
        theirs.send(b'{"ready": 5}')
        theirs.send(b'{"unfit": true}')
        link.receive()
        assert (link.ready, link.unfit, link._importing) == (True, True, "a module")
        theirs.send(json.dumps(CrashhuntError("no map", fix="x").to_json()).encode())
        with pytest.raises(CrashhuntError, match="no map"):
            link.receive()
        link.kill(4)
        link.fork(7, ours)
        assert json.loads(theirs.recv(100)) == {"kill": 4}
        data, descriptors, _, _ = socket.recv_fds(theirs, 100, 1)
        assert json.loads(data) == {"slot": 7}
        os.close(descriptors[0])
        theirs.close()
        assert link.receive() is None


@pytest.mark.parametrize("snapshot", [False, True])
def test_fork_server_is_started_with_its_job(settings, monkeypatch, snapshot):
    started = []

    class Kept:
        def __init__(self, module, words, *, environment, inherited, stdin, stdout, stderr):
            with open(words[1]) as file:
                started.append((module, json.load(file), environment, inherited == [int(words[0])]))
            stdout.write(b"it cannot")

        def end(self):
            started.append("ended")

    monkeypatch.setattr(_fork_server_link, "Kept", Kept)
    monkeypatch.setattr(_fork_server_link, "snapshot_environment", lambda given: {"OF": "snapshot"})
    link = _fork_server_link.ForkServerLink(settings, late=True, deaths=1, snapshot=snapshot)
    ((module, job, environment, inherited),) = started
    assert module == "crashhunt.executors._fork_server"
    assert job == {
        "settings": settings.to_json(),
        "sys_path": [] if snapshot else _fork_server_link.sys.path,
        "late": True,
    }
    assert (environment == {"OF": "snapshot"}) is snapshot
    assert environment.get("PYTHONHASHSEED") == (None if snapshot else "0")
    assert inherited
    assert (link.ready, link.unfit, link.deaths, link._importing) == (False, False, 1, "")
    assert not link.control.getblocking()
    link._kept.process = SimpleNamespace(wait=lambda timeout_s: 1)
    link.unfit, made = True, []
    monkeypatch.setattr(_fork_server_link, "ForkServerLink", lambda given, **more: made.append((given, more)) or "next")
    assert link.restart() == "next"
    assert made == [(settings, {"late": True, "deaths": 1, "snapshot": snapshot})]
    assert started[-1] == "ended"
    assert list(settings.scratch.iterdir()) == []
    link._log.touch()
    link.unfit, link._importing = False, "a module"
    with pytest.raises(CrashhuntError, match="a module: its process exited with 1 meanwhile, 2 times"):
        link.restart()


def test_pool_serves_in_a_thread_of_its_own(pool, monkeypatch):
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    made = []

    class Link:
        """Starts a supervisor that ends each trial at once."""

        def __init__(self, settings, *, snapshot):
            made.append((settings, snapshot))
            self.control, self.ready, self.deaths, self.ended, self.ends = ours, False, 0, 0, []

        def receive(self):
            ours.recv(100)
            self.ready = True
            return [{"slot": 99, "pid": 1, "exit_code": 0}]

        def fork(self, slot, end):
            self.ends.append(os.dup(end.fileno()))
            os.write(self.ends[-1], json.dumps({"result": survived(3).to_json(), "retires": True}).encode() + b"\n")

        def kill(self, slot):
            pass

        def end(self):
            self.ended += 1

    monkeypatch.setattr(_pool, "ForkServerLink", Link)
    with ours, theirs:
        pool.submit(spec(3))
        assert pool.capacity == 2
        assert list(pool.completed(0.05)) == []  # the fork server is not ready
        theirs.send(b"ready")
        assert list(pool.completed(20)) == [survived(3)]
        assert made == [(pool._settings, False)]
        thread = pool._thread
        pool.close()
        assert not thread.is_alive()
        assert pool._link.ended == 1
        pool._link.end = lambda: None
        pool._thread = None
        for end in pool._link.ends:
            os.close(end)
    pool._wake_up, pool._woken = socket.socketpair()  # for the fixture, which closes it again


def test_pool_starts_no_more_supervisors_than_it_has_slots(pool):
    forked = []
    pool._link = SimpleNamespace(
        ready=True, fork=lambda slot, end: forked.append(slot), kill=lambda slot: None, end=lambda: None
    )
    for number in range(5):
        pool._waiting.append(TrialAttempt(spec(number)))
    pool._assign_trials()
    assert forked == [1, 2]
    assert [attempt.spec.number for attempt in pool._waiting] == [2, 3, 4]
    for worker in pool._workers.values():
        worker.retired = True
        worker.attempt = None
    pool._link.ready = False
    pool._assign_trials()
    assert forked == [1, 2]
    pool._link.ready = True
    pool._assign_trials()
    assert forked == [1, 2, 3, 4]  # those that have retired hold no slot
