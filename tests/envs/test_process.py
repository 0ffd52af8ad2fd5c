"""The connection between an environment and the process of its episodes, with a thread in place of that process."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from multiprocessing.connection import Pipe
from types import SimpleNamespace

import pytest

from crashhunt.envs import _process
from crashhunt.envs._process import RemoteEpisodes
from crashhunt.errors import SimulatorError, UsageError


class Episodes:
    """Episodes without a simulator: the observation is the sum of all actions."""

    observation_space, action_space, step_length_s, agent = "observations", "actions", 0.5, "ego"

    def __init__(self, start: int) -> None:
        self.sum = start

    def reset(self, seed, arguments):
        self.sum = seed
        return self.sum, arguments

    def step(self, action):
        if action == "wrong":
            raise UsageError("action is wrong", fix="give a number")
        if action == "odd":
            raise _OddError
        self.sum += action
        return self.sum, 1.0, False, {}

    def picture(self):
        return "picture"


class _OddError(Exception):
    """An error that cannot be pickled."""

    def __reduce__(self):
        raise TypeError

    def __str__(self):
        return "odd"


class FakeProcess:
    """Takes the place of `subprocess.Popen`."""

    returncode, pid = -9, 77

    def __init__(self) -> None:
        self.waits: list[float | None] = []
        self.killed = 0
        self.hangs = False

    def wait(self, timeout=None):
        self.waits.append(timeout)
        if self.hangs and not self.killed:
            raise subprocess.TimeoutExpired("it", timeout)

    def kill(self):
        self.killed += 1


def connected(here):
    """Return remote episodes at one end of a pipe."""
    made = object.__new__(RemoteEpisodes)
    made._connect(here)
    made._name, made.pid, made._process = "the environment", 77, FakeProcess()
    made._end = lambda: _process._end(made._process, here, os.getpid())
    return made


@pytest.fixture
def remote():
    """Remote episodes that a thread serves."""
    here, there = Pipe()
    served = []
    thread = threading.Thread(target=lambda: served.append(_process._serve(there, lambda: False, None)), daemon=True)
    thread.start()
    made = connected(here)
    made.served, made.thread = served, thread
    found = made._ask("made", f"{__name__}:Episodes", 5)
    assert found == {
        "observation_space": "observations", "action_space": "actions", "step_length_s": 0.5, "agent": "ego",
    }  # fmt: skip
    yield made
    made.close()
    thread.join(10)
    assert not thread.is_alive()


def test_answers_are_those_of_the_other_process(remote):
    assert remote.reset(7, {"a": 1}) == (7, {"a": 1})
    assert remote.step(2) == (9, 1.0, False, {})
    assert remote.picture() == "picture"
    assert remote._ask("agent_name") == "ego"
    assert remote.is_closed is False


def test_errors_are_raised_here_and_end_nothing(remote):
    remote.reset(7, {})
    with pytest.raises(UsageError, match="action is wrong; give a number"):
        remote.step("wrong")
    with pytest.raises(SimulatorError, match="_OddError: odd"):
        remote.step("odd")
    assert remote.step(1)[0] == 8


def test_answer_to_an_interrupted_request_is_skipped(remote):
    remote.reset(7, {})

    def interrupt():
        raise KeyboardInterrupt

    answers = remote._answers
    for waits in ([interrupt], [answers.poll, interrupt]):  # the second time, after the answer to the first
        remote._answers = SimpleNamespace(poll=lambda waits=waits: waits.pop(0)())
        with pytest.raises(KeyboardInterrupt):
            remote.step(1)
    remote._answers = answers
    assert remote.step(1)[0] == 10
    assert remote.is_closed is False


def test_interrupt_within_a_message_ends_the_process(remote, monkeypatch):
    pipe = remote._pipe

    class Interrupted:
        closed = False

        def send(self, message):
            pipe.send(message)

        def recv_bytes(self):
            raise KeyboardInterrupt

    remote._pipe = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        remote.picture()
    remote._pipe = pipe
    assert remote.is_closed
    with pytest.raises(
        SimulatorError, match=r"^the environment was interrupted in the middle of a message; make a new"
    ):
        remote.picture()


@pytest.mark.parametrize(
    ("code", "how"),
    [(-9, " by signal 9"), (3, " with exit code 3"), (0, " with exit code 0"), (None, "")],
)
def test_end_of_the_process_is_reported_with_its_cause(code, how):
    here, there = Pipe()
    remote = connected(here)
    remote._process.returncode = code
    there.close()
    for _ in range(2):
        with pytest.raises(SimulatorError) as caught:
            remote.picture()
        # A fake process is no child of this one, but a fork of such a child: a copy of an environment.
        assert str(caught.value) == f"the environment ended{how}; make a new environment"


def test_closed_environment_states_that(remote):
    remote.close()
    assert remote.is_closed
    with pytest.raises(SimulatorError, match="the environment has been closed; make a new environment"):
        remote.picture()
    remote.thread.join(10)
    assert remote.served[0].sum == 5


def test_process_that_does_not_end_is_killed(remote):
    remote._process.hangs = True
    remote.close()
    assert remote._process.killed == 1
    assert remote._process.waits == [5.0, None]


def test_fork_of_the_owner_only_closes_its_connection():
    here, there = Pipe()
    process = FakeProcess()
    _process._end(process, here, os.getpid() + 1)
    assert here.closed
    assert (process.waits, process.killed) == ([], 0)
    there.close()


def test_copies_are_closed_where_a_later_one_cannot_be_made(remote, monkeypatch):
    asked = []

    class Copy:
        closed = 0

        def close(self):
            self.closed += 1

    copies = [Copy(), Copy()]

    def branch(self, name, seed):
        asked.append((name, seed))
        if len(asked) > 2:
            raise SimulatorError("no memory", fix="wait")
        return copies[len(asked) - 1]

    monkeypatch.setattr(RemoteEpisodes, "_branch", branch)
    with pytest.raises(SimulatorError, match="no memory"):
        remote.branch([4, 5, 6])
    assert asked == [(f"copy {n} of 3 of the environment", 3 + n) for n in (1, 2, 3)]
    assert [copy.closed for copy in copies] == [1, 1]


def test_handle_of_a_process_waits_for_its_end_and_kills_it():
    with subprocess.Popen(["sleep", "60"]) as sleeper:
        process = _process._Fork(sleeper.pid)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.001)
        process.kill()
        process.wait(300)
        process.wait(300)  # at once
        process.kill()  # nothing any more
        assert sleeper.wait(300) == -9


def test_program_without_standard_input_may_have_descriptor_0(remote, monkeypatch):
    passed, closed, killed = [], [], []
    with monkeypatch.context() as patch:
        patch.setattr(_process, "send_handle", lambda pipe, handle, pid: passed.append(handle))
        for handle in (-1, 0, 1):
            assert remote._ask("agent_name", passes=handle) == "ego"
        assert passed == [0, 1]
        patch.setattr(_process, "os", SimpleNamespace(pidfd_open=lambda pid: 0, close=closed.append))
        patch.setattr(_process, "select", SimpleNamespace(select=lambda *_: ([0], [], [])))
        patch.setattr(_process.signal, "pidfd_send_signal", lambda *words: killed.append(words))
        process = _process._Fork(77)
        process.kill()
        for _ in range(2):
            process.wait(1.0)
        process.kill()  # nothing any more
    assert (killed, closed) == ([(0, signal.SIGKILL)], [0])
