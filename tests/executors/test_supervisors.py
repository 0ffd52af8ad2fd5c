"""What a supervisor makes of its zygote's messages and of a trial's files; a thread stands for the zygote."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import threading
import time
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import pytest
from toy_trials import settings_for

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, HostError
from crashhunt.episode import Parts, run_episode, scratch_of
from crashhunt.executors import _escape_search, _supervisor, _time_limits
from crashhunt.executors._protocol import encode_report
from crashhunt.executors._supervisor import EndedTrial, Supervisor
from crashhunt.executors._trial_attempts import LostTrialError
from crashhunt.recording import BlackBox, Recording, read_black_box
from crashhunt.scenario import AgentSetup
from crashhunt.trial import CRASHES, Collision, Outcome, TrialResult, TrialSpec

PID = 4321  # of the process of each trial, as its zygote reports it


def spec(number=3, speed=5.0):
    return TrialSpec(number, 7, {"ego": {"speed": speed}}, {}, 12)


class Zygote:
    """A thread that runs each trial, and then does to its folder what `harms` has for its number.

    Attributes:
        jobs: what the supervisor has sent.
        before: messages before the first trial.
        says: what the answer of a trial has in addition, by number.
        harms: function that is called with the folder of a trial and its black box; True leaves out the report.
    """

    def __init__(self, settings):
        self.jobs, self.says, self.harms, self.report = [], {}, {}, {}
        self.parts = Parts(settings)
        self.ours, self.theirs = socket.socketpair()
        self.thread = threading.Thread(target=self.serve, daemon=True)

    def start(self, *messages):
        for message in messages:
            self.theirs.sendall(json.dumps(message).encode() + b"\n")
        self.thread.start()
        return self

    def serve(self):
        with suppress(OSError), self.theirs.makefile("rb") as lines:
            for line in lines:
                job = json.loads(line)
                self.jobs.append(job)
                if "spec" in job:
                    answer = self.run(job)
                    self.theirs.sendall(answer[:9])  # it may arrive in parts
                    self.theirs.sendall(answer[9:])

    def run(self, job):
        given, folder = TrialSpec.from_json(job["spec"]), scratch_of(self.parts.settings.scratch, job["spec"]["number"])
        assert str(folder) == job["folder"]
        box = BlackBox(folder / layout.BLACK_BOX, begun=job["reserved"])
        box.begin(pid=PID, trial=given.number, started=time.monotonic())
        result = run_episode(
            given, simulator=self.parts.simulator(), make_agent=self.parts.agent, box=box,
            oracles=self.parts.oracles(), crash_on=CRASHES,
        )  # fmt: skip
        (folder / layout.RUN_LOG).write_text("printed")
        data = {**result.to_json()}
        del data["spec"]
        report = {"result": data, "notices": ["a notice"], **self.report}
        if not self.harms.get(given.number, lambda *_: None)(folder, box):
            box.report(encode_report(report))
        box.close()
        said = {"ended": 0, "pid": PID, **self.says.get(given.number, {})}
        return json.dumps(said).encode() + b"\n"

    def end(self):
        self.ours.close()
        with suppress(OSError):
            self.theirs.shutdown(socket.SHUT_RDWR)
        if self.thread.is_alive():
            self.thread.join()
        self.theirs.close()


@pytest.fixture
def settings(tmp_path):
    return settings_for(tmp_path, oracles=("overlap",), timeout_s=60.0)


@pytest.fixture
def zygote(settings):
    found = Zygote(settings)
    found.parts.settings = settings
    yield found
    found.end()


def test_supervisor_gives_each_trial_a_folder_and_returns_its_result(zygote, settings):
    supervisor = Supervisor(settings, zygote.start({"ready": 99}).ours)
    zygote.says = {4: {"notices": ["of the zygote"]}, 5: {"unfit": True}}
    began = time.monotonic()
    first, second, third = (supervisor.run(spec(number)) for number in (3, 4, 5))
    assert (first.result.outcome, first.result.steps, first.result.kept) == (Outcome.SURVIVED, 12, False)
    assert first.result.worker == os.getpid()
    assert 0 < first.result.wall_s <= time.monotonic() - began
    assert [one.notices for one in (first, second, third)] == [
        ("a notice",), ("a notice", "of the zygote"), ("a notice",),
    ]  # fmt: skip
    assert supervisor.retires
    assert [job["tries_copy"] for job in zygote.jobs] == [True, False, False]
    assert [job["wants_map"] for job in zygote.jobs] == [True] * 3
    # The files of the last trial are those of the next one, whose pages are in memory.
    assert [path.name for path in settings.scratch.glob("trial-*")] == [scratch_of(settings.scratch, 5).name]


def test_kept_trial_keeps_its_folder_and_what_was_reported(zygote, settings):
    supervisor = Supervisor(replace(settings, keep_trials=True), zygote.start({"ready": 99}).ours)
    zygote.report = {"map": "[]", "entered": ["b"], "responses": [1], "braking": {"how": "x"}}
    zygote.harms = {3: lambda folder, box: (folder / "forged.json").touch()}
    ended = supervisor.run(spec(3, speed=40.0))
    folder = scratch_of(settings.scratch, 3)
    assert ended.result.kept
    assert ended.braking == {"how": "x"}
    assert json.loads((folder / layout.ENTERED).read_text()) == ["b"]
    assert json.loads((folder / layout.RESPONSES).read_text()) == [1]
    assert not (folder / "forged.json").exists()  # a file there has a meaning, and this one is not ours
    assert (settings.scratch / layout.MAP).read_text() == "[]"
    zygote.report = {"map": "[1]"}
    supervisor.run(spec(4))
    assert (settings.scratch / layout.MAP).read_text() == "[]"
    assert (scratch_of(settings.scratch, 4) / layout.MAP).read_text() == "[1]"
    assert not (folder / layout.MAP).exists()
    assert zygote.jobs[1]["wants_map"] is False
    for number in (3, 4):
        assert Recording(read_black_box(scratch_of(settings.scratch, number) / layout.BLACK_BOX)).steps > 0


def scribble(folder, box):
    box.report(encode_report({"result": {}, "notices": []}))
    return True


@pytest.mark.parametrize(
    ("harm", "says", "message"),
    [
        (lambda folder, box: os.truncate(folder / layout.BLACK_BOX, 70) or True, {}, "its recording was truncated"),
        (lambda folder, box: box.begin(pid=PID, trial=8, started=0.0) or True, {}, "its recording was overwritten"),
        (lambda folder, box: box.announce_damage() or True, {}, "could not report the result, as it is damaged"),
        (scribble, {}, "the process damaged its result: "),
        (lambda folder, box: True, {"ended": 3}, "the process exited with 3 after the last step"),
        (lambda folder, box: True, {"ended": -signal.SIGSEGV}, "the process died of SIGSEGV after the last step"),
        (lambda folder, box: None, {"ended": 3}, "the process exited with 3 after the last step"),
    ],
)
def test_trial_that_has_harmed_its_files_is_no_survivor(zygote, settings, harm, says, message):
    supervisor = Supervisor(settings, zygote.start({"ready": 99}).ours)
    zygote.harms, zygote.says = {3: harm}, {3: says}
    result = supervisor.run(spec()).result
    assert result.outcome in (Outcome.AGENT_ERROR, Outcome.PROCESS_DIED)
    assert result.kept
    assert result.failure.agent == "ego"
    assert message in result.failure.message
    assert (scratch_of(settings.scratch, 3) / layout.RUN_LOG).read_text() == "printed"
    assert supervisor.run(spec(4)).result.outcome is Outcome.SURVIVED


def move(folder, box):
    folder.rename(folder.with_name("elsewhere"))


def test_folder_that_was_moved_is_restored(zygote, settings):
    supervisor = Supervisor(replace(settings, keep_trials=True), zygote.start({"ready": 99}).ours)
    zygote.harms = {3: move}
    assert supervisor.run(spec()).result.outcome is Outcome.SURVIVED
    folder = scratch_of(settings.scratch, 3)
    assert Recording(read_black_box(folder / layout.BLACK_BOX)).steps == 12
    assert (folder / layout.RUN_LOG).read_text() == "printed"
    assert (folder / layout.STACK).read_text() == ""


def test_trial_whose_process_was_killed_is_lost(zygote, settings):
    supervisor = Supervisor(settings, zygote.start({"ready": 99}).ours)
    zygote.harms, zygote.says = {3: lambda *_: True}, {3: {"ended": -signal.SIGTERM}}
    with pytest.raises(LostTrialError) as caught:
        supervisor.run(spec())
    assert caught.value.exit_code == -signal.SIGTERM
    assert not supervisor.retires
    zygote.harms[4] = lambda folder, box: box.announce_no_room() or True
    with pytest.raises(LostTrialError):  # there is room again
        supervisor.run(spec(4))
    zygote.theirs.shutdown(socket.SHUT_RDWR)
    with pytest.raises(LostTrialError):
        supervisor.run(spec(5))
    assert supervisor.retires


def test_zygote_that_does_not_get_ready_is_an_error(zygote, settings, monkeypatch):
    theirs = zygote.theirs
    theirs.sendall(json.dumps(CrashhuntError("no map", fix="draw one").to_json()).encode() + b"\n")
    with pytest.raises(CrashhuntError, match="no map"):
        Supervisor(settings, zygote.ours).run(spec())
    monkeypatch.setattr(_supervisor, "_LOOK_EVERY_S", 0.01)
    slow = Supervisor(settings, zygote.ours)
    messages = iter([None, None, {"ready": 99}])
    monkeypatch.setattr(slow, "_next", lambda timeout_s: next(messages))
    slow._await_zygote()
    assert slow._zygote_pid == 99
    monkeypatch.setattr(_supervisor, "START_UP_S", 0.02)
    never, looks = Supervisor(replace(settings, timeout_s=0.02), zygote.ours), iter(range(100))
    monkeypatch.setattr(never, "_next", lambda timeout_s: None if next(looks) < 0 else time.sleep(timeout_s))
    with pytest.raises(CrashhuntError, match=r"its start takes more than 0.04 s"):
        never.run(spec())


def test_trial_that_hangs_is_killed_once_and_a_stopped_zygote_resumes(zygote, settings, monkeypatch):
    resumed, hangs, sent = [], iter([False, True]), []
    supervisor = Supervisor(settings, zygote.ours)
    supervisor._zygote_pid = 99
    messages = iter([None, {"ready": 99}, None, {"ended": -9, "pid": PID}])
    monkeypatch.setattr(_supervisor, "resume", resumed.append)
    monkeypatch.setattr(supervisor, "_next", lambda timeout_s: next(messages))
    monkeypatch.setattr(supervisor, "_has_hung", lambda box, given_at, paused_s: next(hangs))
    monkeypatch.setattr(supervisor, "_send", sent.append)
    assert supervisor._wait(None, 0.0) == ({"ended": -9, "pid": PID}, True)
    assert sent == [{"kill": True}]
    assert resumed == [99, 99]


def test_time_in_which_all_processes_are_suspended_does_not_count(zygote, settings, monkeypatch):
    supervisor, asked, now = Supervisor(settings, zygote.ours), [], 100.0
    clock = SimpleNamespace(monotonic=lambda: now)

    def look(timeout_s):
        nonlocal now
        now += next(steps)
        return None if len(asked) < 4 else {"ended": 0, "pid": PID}

    steps = iter([0.1, 500.0, 0.1, 30.0, 0.1])  # a container that is suspended twice
    monkeypatch.setattr(_time_limits, "time", clock)
    monkeypatch.setattr(_supervisor, "resume", lambda pid: None)
    monkeypatch.setattr(supervisor, "_next", look)
    monkeypatch.setattr(supervisor, "_has_hung", lambda box, given_at, paused_s: asked.append(paused_s))
    assert supervisor._wait(None, 100.0) == ({"ended": 0, "pid": PID}, False)
    assert asked == [0.0, 500.0, 500.0, 530.0]
    watch = _time_limits.ImportWatch(1.0)
    watch.begin("x")
    now += 1000.0
    assert not watch.has_hung
    for _ in range(62):
        assert not watch.has_hung
        now += 1.0
    assert watch.has_hung


def test_time_limit_of_a_trial_begins_with_its_own_recording(settings, zygote, monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(_supervisor, "has_hung", lambda header, **given: asked.append((header, given)) or True)
    supervisor = Supervisor(settings, zygote.ours)
    supervisor._folder._stack = os.open(tmp_path / "stack", os.O_RDWR | os.O_CREAT)
    try:
        for header in (None, SimpleNamespace(pid=os.getpid()), SimpleNamespace(pid=PID)):
            assert supervisor._has_hung(SimpleNamespace(header=lambda found=header: found), 5.0)
            assert asked[-1][0] is header
        assert [given["begun"] for _, given in asked] == [False, False, True]
        given = asked[-1][1]
        assert (given["given_at"], given["limit_s"], given["has_words"]()) == (5.0, settings.timeout_s, False)
        os.write(supervisor._folder._stack, b"File")
        assert given["has_words"]()
    finally:
        os.close(supervisor._folder._stack)


def test_modules_of_an_agent_are_those_that_nothing_else_uses(settings, zygote):
    agents = {name: AgentSetup(agent=agent) for name, agent in
              {"a": "mine:Agent", "b": "shared:Agent", "c": "keep-lane"}.items()}  # fmt: skip
    scenario = SimpleNamespace(agents=agents, modules=lambda: ("shared",))
    supervisor = Supervisor(SimpleNamespace(scenario=scenario, scratch=None), zygote.ours)
    assert supervisor._modules() == {"a": "mine"}


class Running:
    """In place of a supervisor: each trial ends with the next of `ends`."""

    def __init__(self, *ends):
        self.ends, self.specs, self.retires = list(ends), [], False

    def run(self, given):
        self.specs.append(given)
        end = self.ends.pop(0)
        if isinstance(end, Exception):
            raise end
        return end


FINE = TrialResult(spec(), Outcome.SURVIVED, steps=12)
HIT = Collision("ego", "collider", "ego", "b", ("overlap",), "overlap", 1.0, 2.0)
CRASH = replace(FINE, outcome=Outcome.COLLISION, collision=HIT)


def test_answer_of_a_supervisor_has_the_result_or_why_there_is_none(settings):
    def answer(end):
        (found,) = _supervisor._answers(Running(end), settings, spec())
        return found

    assert answer(EndedTrial(FINE)) == {"result": FINE.to_json(), "retires": False}
    assert answer(EndedTrial(FINE, ("a", "b")))["notices"] == ["a", "b"]
    assert answer(LostTrialError(-15)) == {"lost": -15}
    assert answer(FileNotFoundError(2, "gone")) == {"lost": -signal.SIGKILL}
    error = CrashhuntError("no map", fix="draw one")
    assert answer(error) == error.to_json()
    full = answer(OSError(28, "No space left on device", "/scratch/box"))["error"]
    assert full["message"] == "the trial cannot be kept: No space left on device"
    assert full["where"] == "/scratch/box"
    assert full["fix"]
    assert "where" in answer(OSError(22, "odd"))["error"]
    assert not answer(OSError(22, "odd"))["error"]["message"].startswith("the trial cannot be kept")


def test_supervisor_answers_before_it_searches_for_an_escape(settings, monkeypatch):
    asked, escaped = replace(settings, find_escapes=True), replace(CRASH, why_no_escape="it was killed")
    monkeypatch.setattr(_supervisor, "with_escape", lambda *_: escaped)

    def answers(end, given=asked, *, retires=False):
        supervisor = Running(EndedTrial(end))
        supervisor.retires = retires
        return list(_supervisor._answers(supervisor, given, spec()))

    found = {"result": escaped.to_json(), "retires": False}
    assert answers(CRASH) == [{"result": CRASH.to_json(), "searches": True}, found]
    for unchanged in (answers(FINE), answers(CRASH, settings), answers(CRASH, retires=True)):
        assert len(unchanged) == 1
        assert unchanged[0]["result"] != escaped.to_json()


def test_escape_is_searched_in_trials_of_their_own(settings, monkeypatch, tmp_path):
    asked = replace(settings, find_escapes=True)
    monkeypatch.setattr(_escape_search, "read_black_box", lambda path: path.parent)
    monkeypatch.setattr(_escape_search, "Recording", lambda path: path)
    found = []

    def find_escape(result, recording, braking, run, borders):
        found.append((result, recording, braking))
        done, recorded = run(replace(spec(), seed=8))
        assert (done, recorded) == (FINE, scratch_of(settings.scratch, supervisor.specs[-1].number))
        return 9

    monkeypatch.setattr("crashhunt.crashes.find_escape", find_escape)
    supervisor = Running(LostTrialError(-9), LostTrialError(-9), EndedTrial(FINE))
    ended = EndedTrial(CRASH, braking={"how": "emergency", "deceleration": 7})
    assert _escape_search.with_escape(supervisor, asked, ended).escape == 9
    first = (1 << 40) + (os.getpid() << 16)
    assert [(one.number, one.seed) for one in supervisor.specs] == [(first + more, 8) for more in range(3)]
    (_, recording, braking) = found[0]
    assert recording == scratch_of(settings.scratch, 3)
    assert (braking.how, braking.deceleration) == ("emergency", 7.0)
    supervisor = Running(EndedTrial(FINE))
    _escape_search.with_escape(supervisor, asked, EndedTrial(CRASH, braking={"how": "x", "deceleration": None}))
    assert found[-1][2].deceleration is None
    supervisor = Running(EndedTrial(FINE))
    _escape_search.with_escape(supervisor, asked, EndedTrial(CRASH))
    assert found[-1][2] is None
    for supervisor in (Running(*[LostTrialError(-9)] * 3), Running(LostTrialError(-9))):
        supervisor.retires = False
        if len(supervisor.ends) == 1:
            supervisor.run = lambda given, lost=supervisor: setattr(lost, "retires", True) or Running.run(lost, given)
        result = _escape_search.with_escape(supervisor, asked, EndedTrial(CRASH))
        assert result.escape is None
        times = ", 3 times" if len(supervisor.specs) == 3 else ""
        assert result.why_no_escape == f"the process that searched was killed by SIGKILL{times}"
        assert supervisor.ends == []
    assert len(found) == 5


@pytest.mark.parametrize("last", ["retires", "error", "end"])
def test_supervisor_serves_until_it_retires_or_has_no_result(settings, monkeypatch, last):
    class Left(BaseException):
        pass

    def leave(code):
        raise Left(code)

    ours, theirs = socket.socketpair()
    answers = [{"result": 1}, {"result": 2}] if last != "error" else [{"result": 1}, {"error": 2}]
    died = []
    found = SimpleNamespace(retires=False)

    def answer(supervisor, given, trial):
        assert (supervisor, given) == (found, settings)
        said.append(trial.number)
        found.retires = last == "retires" and len(said) == 2
        yield answers[(len(said) - 1) % 2]

    said = []
    monkeypatch.setattr(os, "_exit", leave)
    monkeypatch.setattr(os, "setsid", lambda: died.append("own session"))
    monkeypatch.setattr(_supervisor, "die_with", died.append)
    monkeypatch.setattr(_supervisor, "Supervisor", lambda given, zygote, conditions: found)
    monkeypatch.setattr(_supervisor, "_answers", answer)
    with ours, theirs:
        for number in range(3):
            ours.sendall(json.dumps(spec(number).to_json()).encode() + b"\n")
        ours.shutdown(socket.SHUT_WR)
        with pytest.raises(Left) as caught:
            _supervisor.be_supervisor(theirs, None, settings, None, 77)
        assert caught.value.args == (0,)
        assert died == ["own session", 77]
        expected = 3 if last == "end" else 2
        assert said == list(range(expected))
        theirs.close()
        assert len(ours.makefile("rb").read().splitlines()) == expected


class Conditions:
    """The conditions of a host that begin to fail when they are told to."""

    broken = False

    def check(self):
        if self.broken:
            raise HostError("the current folder was deleted", fix="restore it")


def test_failure_of_a_trial_is_no_result_if_the_host_is_the_cause(zygote, settings):
    conditions = Conditions()
    supervisor = Supervisor(settings, zygote.start({"ready": 99}).ours, conditions)
    fails = lambda folder, box: True  # noqa: E731
    zygote.harms, zygote.says = dict.fromkeys((3, 4), fails), {3: {"ended": 3}, 4: {"ended": 3}}
    assert supervisor.run(spec(3)).result.outcome is Outcome.PROCESS_DIED
    conditions.broken = True
    with pytest.raises(HostError):
        supervisor.run(spec(4))
    assert supervisor.run(spec(5)).result.outcome is Outcome.SURVIVED  # it did not need the folder
    zygote.theirs.shutdown(socket.SHUT_RDWR)
    with pytest.raises(HostError):  # instead of a lost trial
        supervisor.run(spec(6))


def test_supervisor_does_not_create_the_directory_of_a_deleted_hunt(zygote, settings):
    conditions = Conditions()
    supervisor = Supervisor(settings, zygote.start({"ready": 99}).ours, conditions)
    shutil.rmtree(settings.scratch)
    assert supervisor.run(spec(3)).result.outcome is Outcome.SURVIVED  # an agent may have deleted it
    conditions.broken = True
    shutil.rmtree(settings.scratch)
    with pytest.raises(HostError):
        supervisor.run(spec(4))
    assert not settings.scratch.exists()
