"""What becomes of a replay in the terminal whose process ends in some way; the process is made up."""

from __future__ import annotations

import json
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, UsageError
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
    found = SimpleNamespace(codes=[], answers=[], jobs=[], streams=[])

    class Kept:
        def __init__(self, module, words, *, environment, apart, **streams):
            self.folder = Path(words[0])
            found.jobs.append(json.loads((self.folder / layout.JOB).read_text()))
            found.streams.append(streams)
            self.process = self

        def wait(self):
            (self.folder / "log").touch()
            if answer := found.answers.pop(0):
                (self.folder / layout.ANSWER).write_text(json.dumps(answer))
            return found.codes.pop(0)

        def end(self):
            pass

    monkeypatch.setattr(_debugger, "Kept", Kept)
    monkeypatch.setattr(_debugger, "snapshot_environment", lambda settings: {})
    monkeypatch.setattr(_debugger, "_module_in", lambda code: "module")
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


def test_debugger_in_the_agent_reads_the_terminal_only_if_its_prompt_is_shown(ends):
    ends.codes, ends.answers = [0, 0], [DONE, DONE]
    _debugger.debug(rerun(), Look(until=12))
    _debugger.debug(rerun(), Look(until=12, quiet=True))
    shown, quiet = ends.streams
    assert set(shown.values()) == {None}  # those of the terminal
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
    with pytest.raises(UsageError, match="needs a display"):
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
    episode.simulator = SimpleNamespace(actions={name: SimpleNamespace(space=space) for name in episode.names})
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
