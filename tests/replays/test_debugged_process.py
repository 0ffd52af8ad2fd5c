"""What becomes of a replay in the terminal whose process ends in some way; the process is made up."""

from __future__ import annotations

import builtins
import json
import os
import random
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.oracles import RequirementOracle
from crashhunt.panels import Text
from crashhunt.replays import Look, _debugger
from crashhunt.trial import Collision, Outcome, TrialResult, TrialSpec

SPEC = TrialSpec(4, 1, {}, {}, 90)
HIT = Collision("b", "collider", "b", "ego", ("overlap",), "overlap", 1.0, 2.0)
RESULT = TrialResult(SPEC, Outcome.COLLISION, steps=30, collision=HIT)
DONE = {"result": TrialResult(SPEC, Outcome.SURVIVED, steps=12).to_json()}


@dataclass
class Worker:
    scratch: Path = Path()
    code: tuple[str, ...] = ()

    def to_json(self):
        return {"scratch": str(self.scratch)}


@pytest.fixture
def ends(monkeypatch):
    """Each process ends with the next of `codes`, and leaves `answers` behind; `jobs` are what they were given."""
    found = SimpleNamespace(codes=[], answers=[], jobs=[], streams=[], talks=False)

    class Kept:
        def __init__(self, module, words, *, environment, apart, **streams):
            self.folder = Path(words[0])
            found.jobs.append(json.loads((self.folder / layout.JOB).read_text()))
            found.streams.append(streams)
            self.process = self

        def wait(self):
            (self.folder / "log").write_text("first\nlast words\n" if found.talks else "")
            if answer := found.answers.pop(0):
                (self.folder / layout.ANSWER).write_text(json.dumps(answer))
            return found.codes.pop(0)

        def end(self):
            pass

    monkeypatch.setattr(_debugger, "Kept", Kept)
    monkeypatch.setattr(_debugger, "snapshot_environment", lambda settings: {})
    monkeypatch.setattr(_debugger, "read_black_box", lambda path: [])
    monkeypatch.setattr(_debugger, "Recording", lambda records: "recording")
    return found


def rerun():
    return SimpleNamespace(bundle=SimpleNamespace(result=RESULT, driver="ego", id="000004-collision"), worker=Worker(),
                           spec=SPEC)  # fmt: skip


def test_a_process_that_was_killed_from_outside_runs_twice_again(ends, capsys):
    ends.codes, ends.answers = [-signal.SIGKILL, -signal.SIGKILL, 0], [None, None, DONE]
    result, recording = _debugger.debug(rerun(), Look(until=12))
    assert (result.outcome, result.steps, recording) == (Outcome.SURVIVED, 12, "recording")
    assert capsys.readouterr().err.count("crashhunt runs it again") == 2
    (job, *_) = ends.jobs
    assert (job["spec"]["max_steps"], job["stop_at"], job["agent"], job["other"]) == (12, 0, "ego", "b")
    assert job["pause_before"] == 12
    ends.codes, ends.answers = [-signal.SIGKILL] * 3, [None] * 3
    with pytest.raises(CrashhuntError, match="ended before the last step, with signal 9") as caught:
        _debugger.debug(rerun(), Look(until=50))
    assert caught.value.where == "000004-collision"
    assert ends.jobs[-1]["pause_before"] == 30  # the crash comes first


def test_process_is_confined_before_it_makes_anything(monkeypatch, tmp_path):
    def confine(settings):
        raise CrashhuntError(f"{settings} is confined")

    job = {"settings": "a stranger's", "spec": SPEC.to_json(), "stop_at": 5}
    (tmp_path / layout.JOB).write_text(json.dumps(job))
    monkeypatch.setattr(_debugger.sys, "argv", ["", str(tmp_path)])
    monkeypatch.setattr(_debugger, "WorkerSettings", SimpleNamespace(from_json=lambda data: data))
    monkeypatch.setattr(_debugger, "Parts", None)
    monkeypatch.setattr(_debugger, "seal", confine)
    _debugger.main()
    assert json.loads((tmp_path / layout.ANSWER).read_text())["error"]["message"] == "a stranger's is confined"


def test_at_a_debugger_nothing_runs_again_by_itself(ends):
    ends.codes, ends.answers = [-signal.SIGKILL], [None]
    with pytest.raises(CrashhuntError):
        _debugger.debug(rerun(), Look(until=12, stop_at=5))
    assert [job["stop_at"] for job in ends.jobs] == [5]


@pytest.mark.parametrize(("code", "answer", "says"), [
    (3, None, "with exit code 3"), (-signal.SIGSEGV, None, "with signal 11"),
    (0, CrashhuntError("it does not fit", fix="correct it").to_json(), "it does not fit"),
])  # fmt: skip
def test_an_end_of_its_own_is_an_error_at_once(ends, code, answer, says):
    ends.codes, ends.answers = [code], [answer]
    with pytest.raises(CrashhuntError, match=says):
        _debugger.debug(rerun(), Look(until=12))
    assert len(ends.jobs) == 1


def test_last_line_of_a_quiet_process_is_part_of_the_error(ends):
    ends.codes, ends.answers, ends.talks = [3], [None], True
    with pytest.raises(CrashhuntError, match=r"with exit code 3: last words$"):
        _debugger.debug(rerun(), Look(until=12, quiet=True))


def test_debugger_in_the_agent_reads_the_terminal_only_if_its_prompt_is_shown(ends):
    ends.codes, ends.answers = [0, 0, 0], [DONE, DONE, DONE]
    _debugger.debug(rerun(), Look(until=12))
    _debugger.debug(rerun(), Look(until=12, quiet=True))
    _debugger.debug(rerun(), Look(until=12, to_stderr=True, panels=(5, Path("pictures"))))
    shown, quiet, apart = ends.streams
    assert set(shown.values()) == {None}  # those of the terminal
    assert apart == {"stdin": None, "stdout": 2, "stderr": None}
    assert [job["panels"] for job in ends.jobs] == [None, None, [5, str(Path("pictures").resolve())]]
    assert quiet["stdin"] == subprocess.DEVNULL
    assert quiet["stdout"] is quiet["stderr"] is not None


def test_leaving_the_debugger_and_closing_the_window_are_interrupts(ends, monkeypatch):
    ends.codes, ends.answers = [_debugger._LEFT_EXIT_CODE], [None]
    with pytest.raises(KeyboardInterrupt):
        _debugger.debug(rerun(), Look(until=12))
    monkeypatch.setenv("DISPLAY", ":0")
    ends.codes, ends.answers = [-signal.SIGSEGV], [None]
    with pytest.raises(KeyboardInterrupt):
        _debugger.debug(rerun(), Look(until=12, window=1.0))
    monkeypatch.delenv("DISPLAY")
    with pytest.raises(UsageError, match="needs a display, but DISPLAY is not set"):
        _debugger.debug(rerun(), Look(until=12, window=1.0))


def test_panels_are_those_of_agents_that_draw_from_the_first_step_on(monkeypatch, tmp_path):
    class Draws:
        def panels(self):
            return {"plan": Text("left")}

    class Fails:
        def panels(self):
            raise ValueError("no plan yet")

    saved = []
    monkeypatch.setattr(_debugger, "save_panels", lambda folder, step, panels: saved.append((folder, step, panels)))
    episode = SimpleNamespace(names=["a", "b", "c"], agents={"a": Draws(), "b": object(), "c": Fails()}, steps=0)
    space = SimpleNamespace(meanings=("LEFT", "RIGHT"))
    actions = {name: SimpleNamespace(space=space) for name in episode.names}
    episode.simulator = SimpleNamespace(actions=actions, scene=lambda: SimpleNamespace(time_s=0.0))
    observer = _debugger._Panels(3, tmp_path)
    observer.begin(episode)
    for step in range(1, 5):
        episode.steps = step - 1
        for number in range(3):
            observer.action(number, None)
    assert [(folder, step, panels[0][0]) for folder, step, panels in saved] == [
        (tmp_path, 3, "a/plan"), (tmp_path, 3, "c/panels"), (tmp_path, 4, "a/plan"), (tmp_path, 4, "c/panels"),
    ]  # fmt: skip
    assert "no plan yet" in " ".join(saved[1][2][0][1].text.split())
    assert "LEFT" in (tmp_path / "meanings.jsonl").read_text()


def test_film_shows_both_sides_of_the_comparisons_of_a_requirement(monkeypatch, tmp_path):
    saved = []
    monkeypatch.setattr(_debugger, "save_panels", lambda _, step, panels: saved.append((step, *panels)))
    oracle = RequirementOracle("near", "always (reward > 0 -> speed * 2 < 8 - reward)")
    values = iter([None, (1.0, 2.0), (3.0, 2.0), (1.0, 9.0)])
    source = SimpleNamespace(step_length_s=0.5, reader=lambda names, agent: lambda: next(values))
    oracle.read_signals(source, ["ego"])
    for _ in range(4):
        oracle.check(SimpleNamespace(roster=SimpleNamespace(index={}), agent_lanes={}), ["ego"])
    observer = _debugger._Panels(2, tmp_path, [oracle])
    simulator = SimpleNamespace(step_length_s=0.5, scene=lambda: SimpleNamespace(time_s=60.0))
    observer.begin(SimpleNamespace(names=(), simulator=simulator))
    observer.end("result")
    assert [(step, label) for step, (label, _) in saved] == [
        (2, "reward > 0"), (3, "reward > 0"), (2, "speed * 2 < 8 - reward"), (3, "speed * 2 < 8 - reward"),
    ]  # fmt: skip
    curve = saved[-1][1][1]
    assert {name: list(values) for name, values in curve.series.items()} == {
        "speed * 2": [4.0, 4.0, 18.0], "8 - reward": [7.0, 5.0, 7.0],
    }  # fmt: skip
    assert list(curve.x) == [60.5, 61.0, 61.5]
    assert curve.draw().shape == (160, 240, 3)


class Left(BaseException):
    """In place of the end of this process."""


@pytest.fixture
def leaves(monkeypatch):
    """`os._exit` raises, with the exit code."""

    def leave(code):
        raise Left(code)

    monkeypatch.setattr(os, "_exit", leave)


def code_of(function, *arguments):
    with pytest.raises(Left) as caught:
        function(*arguments)
    return caught.value.args[0]


class Agent:
    def reset(self, seed):
        self.seed = seed

    def act(self, observation):
        return observation * 2


def test_debugger_stops_in_one_step_of_one_vehicle(monkeypatch, capsys):
    agents = {"ego": Agent(), "other": Agent()}
    plain = dict(agents)
    stop = _debugger._Stop("ego", 3)
    stop.backwards = "backwards"
    stop.begin(SimpleNamespace(agents=agents))
    called = []

    def runcall(debugger, function, observation):
        at_hand = {name: getattr(builtins, name) for name in ("agent", "observation", "scene", "step")}
        called.append((at_hand, debugger.step, debugger.backwards))
        return function(observation)

    monkeypatch.setattr(_debugger._Debugger, "runcall", runcall)
    for step in range(5):
        stop.scene(step, f"scene {step}", ())
        replaced = [name for name in agents if agents[name] is not plain[name]]
        assert replaced == (["ego"] if step == 2 else [])
        agents["ego"].reset(7)
        assert agents["ego"].act(21) == 42
        assert plain["ego"].seed == 7
    at_hand = {"agent": plain["ego"], "observation": 21, "scene": "scene 2", "step": 3}
    assert called == [(at_hand, 3, "backwards")]
    assert capsys.readouterr().out == "step 3, ego: at hand are agent, observation, scene and step\n"
    for name in at_hand:
        delattr(builtins, name)
    stop.stop_at(5)
    stop.scene(4, "scene 4", ())
    assert agents["ego"] is not plain["ego"]
    assert stop.end("result") == "result"
    assert agents == plain
    absent = _debugger._Stop("gone", 3)
    absent.begin(SimpleNamespace(agents=agents))
    absent.scene(2, None, ())
    assert agents == plain


def test_command_back_goes_by_the_number_that_is_given(capsys, leaves):
    went = []
    debugger = _debugger._Debugger()
    debugger.step = 30
    debugger.do_back("5")
    assert "there is no earlier copy of the process" in capsys.readouterr().out
    debugger.backwards = SimpleNamespace(go=lambda step: went.append(step) or "not so far")
    for words in ("5", "", " 1 ", "0", "x"):
        debugger.do_back(words)
    assert went == [25, 29, 29, 29, 29]
    assert capsys.readouterr().out == "*** not so far\n" * 5
    assert code_of(debugger.set_quit) == _debugger._LEFT_EXIT_CODE
    assert capsys.readouterr().out == "\n"  # the shell's prompt begins a line


def test_copies_wait_before_each_of_the_last_steps_and_the_user_goes_back_to_those(monkeypatch, tmp_path, leaves):
    backwards = _debugger.Backwards(None, 60, tmp_path)
    left_behind = []
    monkeypatch.setattr(backwards, "_leave_behind", left_behind.append)
    for step in range(70):
        backwards.scene(step, None, ())
    assert left_behind == list(range(10, 60))
    assert backwards.go(20) == "it goes back nowhere from here"
    backwards._first = 10
    assert backwards.go(9) == "it goes back to step 10 at most"
    flushed = []
    monkeypatch.setattr(sys, "stdout", SimpleNamespace(flush=lambda: flushed.append(True)))
    assert code_of(backwards.go, 10) == _debugger._BACK_EXIT_CODE
    assert flushed  # an exit without cleanup would lose what the debugger printed
    assert (tmp_path / "back").read_text() == "10"


def test_copy_that_is_gone_back_to_continues_where_it_was(monkeypatch, tmp_path, leaves):
    forked = SimpleNamespace(pid=0, status=0, ignored=[])

    def waited(pid, options):
        forked.ignored.append(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)
        assert (pid, options) == (forked.pid, 0)
        os.read(descriptor, 3)  # the fork has read further
        return pid, forked.status

    def fork():
        random.seed(99)
        return forked.pid

    stopped, died = [], []
    monkeypatch.setattr(_debugger, "threads", lambda: [1])
    monkeypatch.setattr(os, "fork", fork)
    monkeypatch.setattr(os, "waitpid", waited)
    monkeypatch.setattr(os, "kill", lambda pid, number: died.append((pid, number)))
    monkeypatch.setattr(_debugger, "die_with", died.append)
    monkeypatch.setitem(sys.modules, "torch", None)
    (tmp_path / "agent.txt").write_text("abcdef")
    descriptor = os.open(tmp_path / "agent.txt", os.O_RDONLY)
    try:
        os.read(descriptor, 1)
        backwards = _debugger.Backwards(SimpleNamespace(stop_at=stopped.append), 30, tmp_path)
        drawn = random.getstate()
        for step in (20, 21):  # as the fork
            backwards._leave_behind(step)
        assert (backwards._first, died) == (20, [os.getpid()] * 2)
        assert random.getstate() == drawn
        died.clear()
        forked.pid, before = 4321, signal.getsignal(signal.SIGINT)
        for code in (0, 3, _debugger._LEFT_EXIT_CODE):
            forked.status = code << 8
            assert code_of(backwards._leave_behind, 20) == code
        forked.status = int(signal.SIGTERM)
        assert code_of(backwards._leave_behind, 20) == -signal.SIGTERM
        assert died == [(os.getpid(), signal.SIGTERM)]
        forked.status = _debugger._BACK_EXIT_CODE << 8
        (tmp_path / "back").write_text("19")
        assert code_of(backwards._leave_behind, 20) == _debugger._BACK_EXIT_CODE  # the user goes back further
        os.lseek(descriptor, 1, os.SEEK_SET)
        (tmp_path / "back").write_text("20")
        backwards._leave_behind(20)
        assert stopped == [20]
        assert backwards._last == 20
        assert signal.getsignal(signal.SIGINT) is before
        assert all(forked.ignored)
        assert os.read(descriptor, 2) == b"bc"
        monkeypatch.setattr(_debugger, "threads", lambda: [1, 2])
        backwards._leave_behind(22)  # another thread is not in a fork
        assert backwards._first == 0
    finally:
        os.close(descriptor)


def test_one_line_is_read_at_a_time(monkeypatch):
    typed = [b"p", b" ", b"1", b"\n", b"c"]
    asked = []

    def read(descriptor, count):
        asked.append((descriptor, count))
        return typed.pop(0) if typed else b""

    monkeypatch.setattr(os, "read", read)
    line = _debugger.OneLine()
    assert [line.readline() for _ in range(3)] == ["p 1\n", "c", ""]
    assert set(asked) == {(0, 1)}


class Simulator:
    """A simulator with a window."""

    window_open = True

    def __init__(self):
        self.followed, self.fails = [], False

    def open_window(self):
        self.opened = True

    def follow(self, agent, other):
        if self.fails:
            raise RuntimeError("connection closed")
        self.followed.append((agent, other))


def test_window_follows_both_and_pauses_once_before_the_crash(monkeypatch, capsys, leaves):
    simulator, slept, lines = Simulator(), [], ["\n", "\n", "", ""]
    monkeypatch.setattr(_debugger.time, "sleep", slept.append)
    monkeypatch.setattr(_debugger.sys, "stdin", SimpleNamespace(readline=lambda: lines.pop(0)))
    window = _debugger._open_window(simulator, {"agent": "ego", "other": "b", "window": 0.25, "pause_before": 3})
    assert simulator.opened
    window.begin(None)
    for step in range(4):
        window.scene(step, None, ())
    window.leave()
    assert simulator.followed == [("ego", "b")] * 4
    assert slept == [0.25] * 3
    said = "step 3 is next. Press Enter to see what happens: Press Enter to close the window: "
    assert capsys.readouterr().out == said
    window.leave()  # the input has ended
    assert capsys.readouterr().out == "Press Enter to close the window: \n"
    error = TrialResult(SPEC, Outcome.SIMULATOR_ERROR, steps=1)
    assert window.end(error) is error
    simulator.fails = True
    with pytest.raises(RuntimeError):
        window.begin(None)
    simulator.window_open = False
    assert code_of(window.begin, None) == code_of(window.end, error) == _debugger._LEFT_EXIT_CODE
    assert window.end(RESULT) is RESULT
    assert capsys.readouterr().err == "the window was closed\n" * 2
    with pytest.raises(UsageError, match="the simulator object has no window"):
        _debugger._open_window(object(), {})
