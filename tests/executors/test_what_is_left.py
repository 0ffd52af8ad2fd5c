"""The result of a trial whose process died, hung or was killed, as its black box tells it; and notes of executors."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest
from episodes import Episode, write

from crashhunt.base import layout
from crashhunt.episode import scratch_of
from crashhunt.errors import PluginError, UsageError
from crashhunt.executors import _postmortem, _preparation, _protocol, _time_limits, _trial_attempts
from crashhunt.executors._protocol import Notes
from crashhunt.executors._trial_attempts import TrialAttempt
from crashhunt.recording import Phase
from crashhunt.trial import KILLED, Outcome, TrialSpec
from crashhunt.world import Lane

SPEC = TrialSpec(7, 1, {"ego": {}}, {}, 99)
KILL, TERM, SEGV = -signal.SIGKILL, -signal.SIGTERM, -signal.SIGSEGV


@pytest.fixture
def begun(tmp_path):
    """A trial that has written 12 steps of two agents, and what it printed."""
    folder = scratch_of(tmp_path, 7)
    folder.mkdir(parents=True)
    write(Episode(["ego", "left.25"], 12, seed=4), folder / layout.BLACK_BOX)
    (folder / layout.RUN_LOG).write_text("x" * 5000 + "last words")
    (folder / layout.STACK).write_text("File a.py, line 3 in act")
    return tmp_path


@pytest.fixture
def phase(monkeypatch):
    """Sets the phase in which the process ended."""

    def set_phase(value, agent=0):
        def where_it_is(scratch, number):
            from dataclasses import replace

            header = was(scratch, number)
            return header and replace(header, phase=value, agent=agent, started=time.monotonic() - 5)

        monkeypatch.setattr(_postmortem, "where_it_is", where_it_is)

    was = _postmortem.where_it_is
    return set_phase


@pytest.mark.parametrize(
    ("code", "kind", "words"),
    [(SEGV, "signal", "died of SIGSEGV"), (3, "exit code", "exited with 3"), (0, "exit code", "exited with 0"),
     (-99, "signal", "died of signal 99")],
)  # fmt: skip
def test_a_death_in_an_agent_is_that_of_the_step_that_began(begun, phase, code, kind, words):
    phase(Phase.ACT, agent=1)
    result = _postmortem.died(SPEC, begun, code)
    assert (result.outcome, result.steps, result.kept) == (Outcome.PROCESS_DIED, 12, True)
    failure = result.failure
    assert (failure.kind, failure.agent, failure.exit_code) == (kind, "left.25", code)
    assert failure.message == f"the process {words} in left.25's act() of step 13"
    assert failure.traceback == "File a.py, line 3 in act"
    assert failure.last_output.endswith("last words")
    assert len(result.digest) == 32
    assert result.sim_time_s == pytest.approx(20 + 12 * 0.1)
    assert result.closest.gap_m is not None
    assert result.wall_s == pytest.approx(5, abs=2)
    assert result.worker > 0
    assert result.danger is not None


@pytest.mark.parametrize(
    ("at", "words", "agent"),
    [(Phase.SIMULATE, "in the simulator at step 13", ""), (Phase.DONE, "after the last step", "")],
)
def test_a_death_elsewhere_is_no_agents(begun, phase, at, words, agent):
    phase(at)
    result = _postmortem.died(SPEC, begun, SEGV)
    assert result.failure.message == f"the process died of SIGSEGV {words}"
    assert result.failure.agent == agent
    hung = _postmortem.hung(SPEC, begun, 2.5)
    assert (hung.outcome, hung.failure.kind, hung.failure.exit_code) == (Outcome.HANG, "timeout", None)
    assert hung.failure.message.startswith("still running after 2.5 s ")


def test_hang_names_the_function_of_the_user_that_does_not_return(begun, phase):
    lines = ["Thread 0x1 (most recent call first):", '  File "/mine/other.py", line 1 in wait', "",
             "Thread 0x2 (most recent call first):", f'  File "{json.__file__}", line 2 in sleep',
             f'  File "{layout.PACKAGE}/base/text.py", line 3 in near', '  File "/mine/envs.py", line 4 in close',
             '  File "/mine/envs.py", line 5 in step']  # fmt: skip
    (scratch_of(begun, 7) / layout.STACK).write_text("\n".join(lines))
    phase(Phase.SIMULATE)
    message = _postmortem.hung(SPEC, begun, 2.5).failure.message
    assert message == "still running after 2.5 s in the simulator (envs.py, line 4 in close) at step 13"
    phase(Phase.SETUP)
    message = _postmortem.hung(SPEC, begun, 2.5).failure.message
    assert message == "still running after 2.5 s (envs.py, line 4 in close) while the episode was being set up"


@pytest.mark.parametrize(
    ("name", "written"), [("fußball", r"fu\xdfball"), ("道", r"\u9053"), ("🚗", r"\U0001f697"), (r"\udcff", r"\udcff")]
)
def test_letters_outside_of_ascii_in_a_stack_are_as_in_the_path(begun, phase, name, written):
    """`faulthandler` escapes them, so the modules of crashhunt and of the agent were not found in such a folder."""
    lines = ["Current thread 0x1 (most recent call first):", f'  File "/{written}/a.py", line 4 in act']
    (scratch_of(begun, 7) / layout.STACK).write_text("\n".join(["Fatal Python error", "", *lines]))
    phase(Phase.SIMULATE)
    failure = _postmortem.died(SPEC, begun, SEGV, agents={"ego": f"{name}.a"}).failure
    assert failure.traceback.endswith(f'File "/{name}/a.py", line 4 in act')
    assert failure.agent == "ego"


def test_before_the_first_step_it_is_no_crash(begun, tmp_path, phase):
    other = TrialSpec(8, 1, {"ego": {}}, {}, 99)
    nothing = _postmortem.died(other, tmp_path, 3)
    assert (nothing.outcome, nothing.steps, nothing.digest, nothing.kept) == (Outcome.INVALID, 0, "", False)
    assert nothing.failure.message == "the process exited with 3 while the episode was being set up"
    assert (nothing.wall_s, nothing.worker, nothing.setup_steps) == (0.0, 0, None)
    phase(Phase.SETUP)
    assert _postmortem.hung(SPEC, begun, 9).outcome is Outcome.INVALID


def test_a_recording_that_cannot_be_read_is_reported(begun, phase, monkeypatch):
    def fails(path):
        raise ValueError(path)

    monkeypatch.setattr(_postmortem, "read_black_box", fails)
    phase(Phase.ACT)
    result = _postmortem.died(SPEC, begun, 3)
    assert (result.outcome, result.steps) == (Outcome.PROCESS_DIED, 0)
    assert result.failure.message == "the process exited with 3, and its recording cannot be read"


def test_a_process_that_damaged_itself_is_an_error_of_its_only_agent(begun, phase):
    phase(Phase.ACT)
    two = _postmortem.damaged(SPEC, begun, "it overwrote the simulator")
    assert (two.outcome, two.failure.kind, two.failure.agent) == (Outcome.AGENT_ERROR, "damaged process", "")
    assert two.failure.exit_code is None
    write(Episode(["ego"], 3, seed=4), scratch_of(begun, 7) / layout.BLACK_BOX)
    one = _postmortem.damaged(SPEC, begun, "it overwrote the simulator")
    assert (one.failure.agent, one.failure.message, one.steps) == ("ego", "it overwrote the simulator", 3)
    phase(Phase.DONE)
    late = _postmortem.died(SPEC, begun, SEGV)
    assert (late.failure.agent, late.failure.message) == ("ego", "the process died of SIGSEGV after the last step")
    unread = _postmortem.damaged(SPEC, begun, "its recording is no recording", agent="x", recorded=False)
    assert (unread.failure.kind, unread.failure.agent, unread.steps) == ("damaged recording", "x", 0)
    assert unread.kept
    assert unread.failure.last_output.endswith("last words")


def test_a_trial_that_is_killed_from_outside_runs_again_alone(begun, monkeypatch):
    steps = iter([3, 5, 9])
    monkeypatch.setattr(
        _trial_attempts, "where_it_is", lambda *_: SimpleNamespace(step=next(steps), phase=Phase.ACT)
    )  # fmt: skip
    attempt = TrialAttempt(SPEC)
    assert not attempt.alone
    assert attempt.again(begun, SEGV) == ""  # it did that itself
    assert attempt.again(begun, 3) == ""
    assert not attempt.alone
    assert attempt.again(begun, KILL) == "trial 7 was ended by SIGKILL from outside, and is run again"
    assert attempt.alone
    assert "ended by SIGTERM" in attempt.again(begun, TERM)
    assert not attempt.is_killed_from_outside
    assert attempt.again(begun, KILL) == ""  # three are enough
    assert attempt.is_killed_from_outside
    assert attempt.ends == [(KILL, 3), (TERM, 5), (KILL, 9)]
    monkeypatch.undo()
    result = _postmortem.result_of_death(attempt, begun, KILL)
    assert (result.outcome, result.failure.kind, result.failure.exit_code) == (Outcome.INVALID, KILLED, KILL)
    assert result.failure.message == (
        "killed from outside 3 times, each time at another step "
        "(SIGKILL after step 3, SIGTERM after step 5, SIGKILL after step 9)"
    )
    assert result.kept


@pytest.mark.parametrize("header", [None, SimpleNamespace(step=0, phase=Phase.SETUP)])
def test_a_trial_that_is_killed_twice_before_its_first_step_has_a_third_attempt(begun, monkeypatch, header):
    """What forks the processes of trials may have been killed once: both attempts end with it."""
    monkeypatch.setattr(_trial_attempts, "where_it_is", lambda *_: header)
    attempt = TrialAttempt(SPEC)
    assert [bool(attempt.again(begun, KILL)) for _ in range(3)] == [True, True, False]


def test_a_trial_that_is_killed_twice_at_one_step_did_it_itself(begun, tmp_path):
    attempt = TrialAttempt(SPEC)
    assert attempt.again(begun, KILL)
    assert attempt.again(begun, KILL) == ""
    assert not attempt.is_killed_from_outside
    assert _postmortem.result_of_death(attempt, begun, KILL).outcome is not Outcome.SURVIVED
    assert _postmortem.result_of_death(attempt, begun, KILL).failure.kind == "signal"
    nowhere = TrialAttempt(TrialSpec(9, 1, {}, {}, 9))
    assert nowhere.again(tmp_path, KILL)
    assert nowhere.ends == [(KILL, -1)]


def test_the_map_of_a_trial_is_its_own_or_that_of_the_hunt(tmp_path):
    trial = tmp_path / "trial"
    trial.mkdir()
    assert _postmortem.read_map(tmp_path, trial) == []
    lanes = [["a_0", 3.2, [[0.0, 0.0], [5.0, 1.0]]]]
    (tmp_path / layout.MAP).write_text(json.dumps(lanes))
    assert _postmortem.read_map(tmp_path, trial) == [Lane("a_0", 3.2, ((0.0, 0.0), (5.0, 1.0)))]
    (trial / layout.MAP).write_text(json.dumps([["b_0", 3.0, [[0.0, 0.0], [1.0, 1.0]]]]))
    assert [lane.id for lane in _postmortem.read_map(tmp_path, trial)] == ["b_0"]
    (trial / layout.MAP).write_text("[")
    assert len(_postmortem.read_map(tmp_path, trial)) == 1


def test_head_and_tail_of_a_long_output_are_kept(tmp_path):
    log = tmp_path / "run.log"
    assert _postmortem.read_ends(log) == ""
    log.write_text("no map\n" + "x" * 5993)
    assert _postmortem.read_ends(log) == log.read_text()
    log.write_text("no map\n" + "x" * 7000 + "\nno plan\n")
    assert _postmortem.read_ends(log) == f"no map\n{'x' * 1993}\n[1,016 bytes omitted]\n{'x' * 3991}\nno plan\n"


def test_each_note_is_reported_once(tmp_path):
    notes = Notes(tmp_path)
    notes.add("a")
    notes.add("a")
    (tmp_path / layout.NOTICES).write_text("b\na\nc\n")
    assert notes.fresh() == ["a", "b", "c"]
    assert notes.fresh() == []
    notes.add("b")
    notes.add("d")
    assert notes.fresh() == ["d"]


def test_an_executor_that_cannot_be_made_is_one_line(monkeypatch):
    def factory(error):
        def make(settings, *, parallel):
            if error:
                raise error
            return settings, parallel

        return lambda word: make

    monkeypatch.setattr(_protocol, "executor_of", factory(None))
    assert _protocol.make_executor("w", "settings", parallel=3) == ("settings", 3)
    monkeypatch.setattr(_protocol, "executor_of", factory(UsageError("no cluster")))
    with pytest.raises(UsageError, match="no cluster"):
        _protocol.make_executor("w", None, parallel=1)
    monkeypatch.setattr(_protocol, "executor_of", factory(ValueError("no cluster")))
    with pytest.raises(PluginError, match="the executor 'w' cannot be created"):
        _protocol.make_executor("w", None, parallel=1)


@pytest.mark.parametrize(("began_ago_s", "given_ago_s", "hangs"), [(50, 5, False), (5, 50, False), (50, 50, True)])
def test_time_of_a_trial_begins_when_its_process_has_it_and_has_begun(began_ago_s, given_ago_s, hangs):
    now = time.monotonic()
    header = SimpleNamespace(started=now - began_ago_s)

    def is_over(given_ago_s, header=header, begun=True, has_words=True):
        given_at = now - given_ago_s
        return _time_limits.has_hung(header, begun=begun, given_at=given_at, limit_s=10, has_words=lambda: has_words)

    assert is_over(given_ago_s) is hangs
    assert not is_over(65, begun=False)  # it may take a minute to start
    assert is_over(80, begun=False)
    assert is_over(80, header=None)
    assert not is_over(11, SimpleNamespace(started=now - 11), has_words=False)  # it may be writing down where it is
    assert is_over(14, SimpleNamespace(started=now - 14), has_words=False)


def test_a_simulator_that_starts_threads_is_not_forked_once_it_is_there(monkeypatch):
    # The function ends the children of a zygote, and must not end those of this process.
    monkeypatch.setattr(_preparation, "end_descendants", lambda: None)

    def with_threads():
        threading.Thread(target=time.sleep, args=(30,), daemon=True).start()

    def fails():
        raise OSError("no window")

    assert _preparation._is_forkable_with(SimpleNamespace(simulator=lambda: None))
    assert not _preparation._is_forkable_with(SimpleNamespace(simulator=with_threads))
    assert not _preparation._is_forkable_with(SimpleNamespace(simulator=fails))


def test_process_with_pygame_dies_of_the_signal_itself(tmp_path):
    """pygame aborts at a fatal signal, so crashes of agents in highway-env seemed to be SIGABRT."""
    code = f"""
import os, pygame, signal
from crashhunt.executors._trial_process import record_stack
for number in (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE):
    if (pid := os.fork()) == 0:
        with open({str(tmp_path)!r} + f"/{{number:d}}", "w") as stack:
            for _ in range(2):
                record_stack(stack)
            os.kill(os.getpid(), number)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    numbers = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE)
    assert [int(code) for code in done.stdout.split()[-3:]] == [-number for number in numbers]
    for number in numbers:
        assert "most recent call first" in (tmp_path / str(int(number))).read_text()
