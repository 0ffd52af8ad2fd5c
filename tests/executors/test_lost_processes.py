"""Processes of a pool that are killed at the moment at which something is written to them."""

from __future__ import annotations

import os
import select
import signal
import time

import pytest
from conftest import mostly_nightly
from toy_trials import settings_for

from crashhunt.base.processes import children_of
from crashhunt.executors import PoolExecutor
from crashhunt.trial import Outcome, TrialSpec

DEADLINE_S = 300.0


@pytest.fixture
def pool(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = PoolExecutor(settings_for(tmp_path))
    yield found
    found.close()


def run(pool, number):
    """Run a trial to its end."""
    pool.submit(TrialSpec(number, number, {"ego": {"speed": 5.0}}, {}, max_steps=20))
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        for result in pool.completed(0.1):
            return result
    raise AssertionError("the trial did not end")


def kill(pid, until=None):
    """Kill a process, and wait until it, or another one, is dead; its parent may not have reaped it."""
    end = os.pidfd_open(until or pid)
    try:
        os.kill(pid, signal.SIGKILL)
        assert select.select([end], [], [], DEADLINE_S)[0]
    finally:
        os.close(end)


def victim(pool, name, supervisor):
    """Return a process of a pool that has run one trial and runs none."""
    (fork_server,) = children_of(pool._link._kept.process.pid)
    (template,) = set(children_of(fork_server)) - {supervisor}
    (zygote,) = children_of(template)
    return {"fork server": fork_server, "template": template, "supervisor": supervisor, "zygote": zygote}[name]


@pytest.mark.parametrize(
    "name", mostly_nightly(["fork server", "template", "supervisor", "zygote"], always=["template", "zygote"])
)
def test_process_that_dies_before_it_is_written_to_costs_no_trial(pool, monkeypatch, name):
    first = run(pool, 0)
    give, killed = pool._send_trial, []

    def kill_and_give(worker, attempt):
        if not killed:
            killed.append(victim(pool, name, first.worker))
            kill(killed[0])
        give(worker, attempt)

    monkeypatch.setattr(pool, "_send_trial", kill_and_give)
    second = run(pool, 1)
    assert killed
    assert second.outcome is Outcome.SURVIVED
    assert second.worker != first.worker
    assert "trial 1 was ended by SIGKILL from outside, and is run again" in pool.notes()


def test_fork_server_that_dies_before_it_is_asked_for_a_supervisor_costs_no_trial(pool, monkeypatch):
    first = run(pool, 0)
    kill(first.worker)
    deadline = time.monotonic() + DEADLINE_S
    while pool._workers and time.monotonic() < deadline:
        time.sleep(0.002)
    hire, killed = pool._start_worker, []

    def kill_and_hire(link):
        if not killed:
            killed.extend(children_of(link._kept.process.pid))
            kill(killed[0], until=link._kept.process.pid)  # the keeper has the socket as well
        return hire(link)

    monkeypatch.setattr(pool, "_start_worker", kill_and_hire)
    assert run(pool, 1).outcome is Outcome.SURVIVED
    assert killed
    assert "the process that starts the workers was killed from outside, and was started again" in pool.notes()
