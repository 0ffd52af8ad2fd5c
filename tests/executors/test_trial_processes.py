"""What the process of a trial reports, in which copies of itself it asks, and how it ends where something fails."""

from __future__ import annotations

import colorsys
import json
import os
import signal
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
from toy_trials import settings_for

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, HostError, RecorderError
from crashhunt.episode import FirstCopy
from crashhunt.executors import _trial_process
from crashhunt.executors._trial_process import TrialProcess, notices_of_late_imports
from crashhunt.simulators import FullBraking
from crashhunt.trial import Collision, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.world import Lane

SPEC = TrialSpec(3, 7, {"ego": {}}, {}, 12, only=("b",))
FINE = TrialResult(SPEC, Outcome.SURVIVED, steps=12)
HIT = Collision("ego", "collider", "ego", "b", ("overlap",), "overlap", 1.0, 2.0)
CRASH = replace(FINE, outcome=Outcome.COLLISION, collision=HIT)


class Simulator:
    """Has everything that a report may be about."""

    notices = ("of the simulator",)
    entered = ("b", "c")

    def __init__(self):
        self.called = []

    def lanes(self):
        return [Lane("a_0", 3.2, ((0.0, 0.0), (5.0, 1.0)))]

    def full_braking(self, agent):
        return FullBraking(None, "emergency", 7.0) if agent == "ego" else None

    def tidy(self):
        self.called.append("tidy")


@pytest.fixture
def process(tmp_path, monkeypatch):
    """The process of a trial, which has the test's own output and signals; its supports are those of `Simulator`."""

    def make(**given):
        settings = settings_for(tmp_path, crash_on=(Outcome.COLLISION,), scratch=tmp_path, timeout_s=9.0, **given)
        found = TrialProcess.__new__(TrialProcess)
        found._settings, found._notices, found._reference, found._fork_runners = settings, ["a notice"], None, ()
        found._box, found._pid, found._has_begun, found._shared = None, 0, False, None
        found._simulator = found._parts = found._lights = None
        found._modules = frozenset(sys.modules)
        found._opened = None
        found._home = tmp_path
        return found

    monkeypatch.setattr(_trial_process, "supports", lambda simulator, what: what.__name__ in simulator.can)
    return make


ALL = ("ReportsNotices", "HasMap", "SupportsExclusion", "SupportsFullBraking")


def reported(process, result, *, can=ALL, wants_map=False):
    simulator = Simulator()
    simulator.can = can
    return process._report(result, simulator, {"wants_map": wants_map})


def test_report_of_a_kept_trial_has_what_the_hunt_needs(process):
    found = reported(process(find_escapes=True), CRASH)
    expected = CRASH.to_json()
    del expected["spec"]
    assert json.loads(found.pop("map")) == [["a_0", 3.2, [[0.0, 0.0], [5.0, 1.0]]]]
    assert found == {
        "result": expected, "notices": ["a notice", "of the simulator"], "entered": ["b", "c"],
        "braking": {"how": "emergency", "deceleration": 7.0},
    }  # fmt: skip
    assert "braking" not in reported(process(), CRASH)
    assert reported(process(), CRASH, can=()).keys() == {"result", "notices"}
    everyone = replace(CRASH, spec=replace(SPEC, only=None))
    assert "entered" not in reported(process(), everyone)
    other = replace(CRASH, collision=replace(HIT, agent="x"))
    assert reported(process(find_escapes=True), other)["braking"] is None
    driven = process()
    driven._reference = SimpleNamespace(responses=[1])
    assert reported(driven, CRASH)["responses"] == [1]
    assert "responses" not in reported(driven, FINE)


def test_a_module_that_is_imported_late_is_reported_once(process, monkeypatch):
    seen = []
    monkeypatch.setattr(
        _trial_process, "notices_of_late_imports", lambda before, code: seen.append((before, code)) or ["late"]
    )
    made = process(code=("/code",))
    assert reported(made, FINE)["notices"] == ["a notice", "of the simulator", "late"]
    assert seen == [(made._modules, ("/code",))]


def test_report_of_a_trial_that_is_not_kept_is_short(process):
    assert reported(process(find_escapes=True), FINE).keys() == {"result", "notices"}
    assert "map" in reported(process(), FINE, wants_map=True)
    assert "map" not in reported(process(), replace(FINE, outcome=Outcome.INVALID), wants_map=True)
    for kept in (
        reported(process(keep_trials=True), FINE),
        reported(process(), replace(FINE, failure=Failure("ValueError", "odd"))),
        reported(process(audit=1.0), FINE),
    ):
        assert kept.keys() >= {"map", "entered"}


def test_copies_of_a_trial_are_those_that_the_settings_ask_for(process, monkeypatch):
    made = []

    def maker(name):
        def make(*given):
            made.append((name, given))
            return SimpleNamespace(fork_runner=SimpleNamespace(what=name, stop=lambda why: made.append((name, why))))

        return make

    for name in ("Prober", "Brancher", "OnsetForcer"):
        monkeypatch.setattr(_trial_process, name, maker(name))

    def copies(**given):
        made.clear()
        found = process(**given)
        copies = found._copies()
        assert [one.what for one in found._fork_runners] == [name for name, _ in made]
        return found, [name for name, _ in made], len(copies), [words for _, words in made]

    crash_on = (Outcome.COLLISION,)
    _, names, there, _ = copies()
    assert (names, there) == ([], 0)
    found, names, there, ((every_s, on, delay, budget, notify, _),) = copies(probe_s=2.0)
    assert (names, there) == (["Prober"], 1)
    assert (every_s, on, delay, budget) == (2.0, crash_on, found._delay, _trial_process.BUDGET)
    notify("later")
    assert found._notices == ["a notice", "later"]
    _, names, there, (probed, branched) = copies(probe_s=2.0, branch=(1.0,))
    assert (names, there) == (["Prober", "Brancher"], 2)
    assert probed[3] == _trial_process.BUDGET_BESIDE != _trial_process.BUDGET
    assert branched[:2] == ((1.0,), crash_on)
    found, names, there, (forced,) = copies(force=("brake",))
    assert (names, there) == (["OnsetForcer"], 1)
    assert forced[:4] == (("brake",), crash_on, 9.0, found._delay)
    found._cannot_copy("it has threads")
    assert found._notices[-1] == "OnsetForcer are left out: it has threads"
    assert made[-1] == ("OnsetForcer", "it has threads")
    assert found._fork_runners == ()


def test_time_in_copies_is_added_to_the_limit(process, monkeypatch):
    found, added = process(), []
    monkeypatch.setattr(_trial_process.watchdog, "extend", lambda seconds: added.append(("watchdog", seconds)))
    found._box = SimpleNamespace(
        delay=lambda seconds: added.append(("box", seconds)), detach=lambda: added.append("detached")
    )
    found._delay(2.5)
    assert added == [("box", 2.5), ("watchdog", 2.5)]
    monkeypatch.setattr(_trial_process, "copying", lambda: True)
    found._stop_recording()
    monkeypatch.setattr(_trial_process, "copying", lambda: False)
    found._stop_recording()
    assert added[2:] == ["detached"]
    found._box = None
    found._stop_recording()


def test_agent_of_an_edited_trial_is_handed_over_or_overruled(process, monkeypatch):
    found = process()
    found._parts = SimpleNamespace(agent=lambda *given: given)
    monkeypatch.setattr(_trial_process, "HandedOver", lambda agent, how: ("handed over", agent, how))

    class Driver:
        def __init__(self, *given):
            self.given = given

    monkeypatch.setattr(_trial_process, "CompetentDriver", Driver)
    monkeypatch.setattr(_trial_process, "overruled_agent", lambda *given: Driver(*given))
    over, hand = SimpleNamespace(agent="ego"), SimpleNamespace(agent="ego")
    plain = ("ego", "simulator", {"a": 1})
    given = SimpleNamespace(overruled=None, handover=None)
    assert found._other_agent(given, *plain) == plain
    given.handover = hand
    assert found._other_agent(given, *plain) == ("handed over", plain, hand)
    assert found._other_agent(given, "x", "simulator", {}) == ("x", "simulator", {})
    given.handover, given.overruled = None, over
    assert found._other_agent(given, "x", "simulator", {}) == ("x", "simulator", {})
    assert found._reference is None
    driver = found._other_agent(given, *plain)
    assert driver.given == (plain, "simulator", over)
    assert found._reference is driver
    monkeypatch.setattr(_trial_process, "overruled_agent", lambda *given: "another")
    assert found._other_agent(given, *plain) == "another"
    assert found._reference is None


class Left(BaseException):
    """In place of the end of this process."""


@pytest.mark.parametrize(
    ("error", "begun", "users", "tampered", "said"),
    [
        (None, True, False, False, []),
        (ValueError("ours"), True, False, False, ["fault"]),
        (CrashhuntError("no map", fix="draw one"), False, True, True, ["no map"]),
        (CrashhuntError("no map", fix="draw one"), True, True, False, ["damage"]),
        (ValueError("theirs"), True, True, False, ["damage"]),
        (ValueError("theirs"), True, False, True, ["damage"]),
    ],
)
def test_process_ends_with_a_report_or_an_announcement(process, monkeypatch, error, begun, users, tampered, said):
    def leave(code):
        raise Left(code)

    def run(job, reset):
        found._has_begun = begun
        if error:
            raise error
        return 0

    found, heard = process(), []
    found._box = SimpleNamespace(
        announce_damage=lambda: heard.append("damage"),
        begin=lambda **given: heard.append(("begin", given["pid"], given["trial"])),
        report=heard.append,
    )
    found._pid = 41
    monkeypatch.setattr(_trial_process, "_leave", leave)
    monkeypatch.setattr(_trial_process, "block_signals", lambda: None)
    monkeypatch.setattr(_trial_process, "has_users_code", lambda error: users)
    monkeypatch.setattr(_trial_process, "are_functions_replaced", lambda: tampered)
    monkeypatch.setattr(_trial_process, "encode_report", lambda report, dumps: report["fault"])
    monkeypatch.setattr(found, "_run", run)
    job = {"spec": SPEC.to_json()}
    with pytest.raises(Left, match="0"):
        found.run(job)
    if said in ([], ["damage"]):
        assert heard == said
        return
    assert heard[:-1] == [("begin", 41, 3)] * (not begun)
    fault = heard[-1]
    assert (fault["error"]["message"] == "no map") is (said == ["no map"])
    found._box = None
    with pytest.raises(Left, match="0"):
        found.run(job)


def test_process_that_fails_while_it_reports_announces_damage(process, monkeypatch):
    def leave(code):
        raise Left(code)

    calls, times = [], []

    def block():
        calls.append(True)
        if len(calls) <= times[0]:
            raise ValueError

    heard = []
    found = process()
    found._box = SimpleNamespace(announce_damage=lambda: heard.append("damage"))
    monkeypatch.setattr(_trial_process, "_leave", leave)
    monkeypatch.setattr(_trial_process, "block_signals", block)
    monkeypatch.setattr(found, "_run", None)
    for fails, code in ((1, 0), (2, 0), (3, 1)):
        times[:] = [fails]
        calls.clear()
        heard.clear()
        with pytest.raises(Left) as caught:
            found.run({})
        assert caught.value.args == (code,)
        assert heard == ["damage"] * (code == 0)


def test_trial_runs_in_its_folder_and_reports(process, monkeypatch, tmp_path):
    found = process()
    called, ran = [], []
    simulator = SimpleNamespace(can=())
    found._parts = SimpleNamespace(
        simulator=lambda: simulator, agent="make agent", oracles=lambda: "oracles", reporting_agents=()
    )
    found._shared = SimpleNamespace(separate=lambda: called.append("separate"))
    found._stack = "stack"

    class Box:
        def __init__(self, path, *, begun):
            called.append(("box", path, begun))

        def begin(self, *, pid, trial, started):
            called.append(("begin", pid, trial))

        def announce_no_room(self):
            called.append("no room")

        def report(self, text):
            called.append(text)

    def run_episode(spec, **given):
        ran.append((spec, given))
        if isinstance(ran[0], str):
            raise RecorderError("no room", fix="x")
        return replace(FINE, setup_s=1.0)

    monkeypatch.setattr(_trial_process, "BlackBox", Box)
    monkeypatch.setattr(_trial_process, "run_episode", run_episode)
    monkeypatch.setattr(_trial_process, "block_signals", lambda: called.append("block"))
    monkeypatch.setattr(_trial_process.watchdog, "arm", lambda *given: called.append(("arm", *given)))
    monkeypatch.setattr(_trial_process, "begin_records", lambda: None)
    monkeypatch.setattr(_trial_process, "end_records", lambda: None)
    monkeypatch.setattr(os, "setsid", lambda: called.append("own session"))
    monkeypatch.setattr(os, "chdir", lambda path: called.append(("in", path)))
    monkeypatch.setattr(found, "_redirect", lambda folder: called.append(("redirect", folder)))
    monkeypatch.setattr(_trial_process, "encode_report", lambda report, dumps: report["result"])
    asked = SimpleNamespace(what="probes", why_not="a thread", stop=lambda why: None)
    found._copies = lambda: setattr(found, "_fork_runners", (asked,)) or ["prober"]
    job = {"spec": SPEC.to_json(), "folder": str(tmp_path), "reserved": 64, "wants_map": False,
           "tries_copy": True}  # fmt: skip
    assert found._run(job, None) == 0
    expected = [
        "own session", "separate", ("redirect", str(tmp_path)), ("box", str(tmp_path / layout.BLACK_BOX), 64),
        ("in", tmp_path),
        ("begin", os.getpid(), 3), ("arm", 9.0, "stack"), "block",
    ]  # fmt: skip
    assert called[:-1] == expected
    data = called[-1]
    assert (data["digest"], data["outcome"]) == (FINE.digest, "survived")
    assert data["setup_s"] > 1.0
    assert data["wall_s"] > 0
    assert found._notices[-1] == "probes are left out from here on: a thread"
    ((spec, given),) = ran
    assert spec == SPEC
    assert {name: given[name] for name in ("simulator", "make_agent", "oracles", "crash_on", "reset")} == {
        "simulator": simulator, "make_agent": "make agent", "oracles": "oracles", "crash_on": (Outcome.COLLISION,),
        "reset": None,
    }  # fmt: skip
    first, probes = given["asking"]
    assert (type(first), probes) == (FirstCopy, "prober")
    for more in ({"tries_copy": False}, {}):
        called.clear()
        if not more:
            found._copies = lambda: setattr(found, "_fork_runners", ()) or []
        found._run(job | more, "reset")
        assert "separate" not in called
        assert ran[-1][1]["asking"] == (["prober"] if more else [])
        assert ran[-1][1]["reset"] == "reset"
    ran.insert(0, "fails")
    called.clear()
    assert found._run(job, None) == 0
    assert called[-1] == "no room"


def test_simulator_of_a_zygote_is_made_ready_once(process, monkeypatch):
    found, ready = process(), []
    simulator = Simulator()
    simulator.can = ("RestoresState", "PreparesProcess")
    simulator.ready_process = lambda: simulator.called.append("ready")
    parts = SimpleNamespace(load=lambda: simulator.called.append("load"), simulator=lambda: simulator)
    monkeypatch.setattr(_trial_process, "Parts", lambda settings: parts)
    monkeypatch.setattr(_trial_process, "ready_recorder", ready.append)
    assert found.make_simulator() is found.make_simulator() is simulator
    assert simulator.called == ["load", "tidy", "ready"]
    assert ready == [simulator]


def test_output_of_a_trial_is_in_its_folder(process, monkeypatch, tmp_path):
    found, redirected, closed, handled = process(), [], [], []
    found._stack = (tmp_path / "null").open("w")
    monkeypatch.setattr(_trial_process, "_dup2", lambda *given, **more: redirected.append((given[1], more)))
    monkeypatch.setattr(_trial_process, "_close", lambda descriptor: closed.append(descriptor) or os.close(descriptor))
    monkeypatch.setattr("faulthandler.disable", lambda: handled.append("disabled"))
    monkeypatch.setattr("signal.signal", lambda *given: handled.append(given))
    monkeypatch.setattr("faulthandler.enable", lambda file: handled.append(file))
    monkeypatch.setattr("faulthandler.register", lambda number, file: handled.append((number, file)))
    folder = tmp_path / "trial"
    folder.mkdir()
    with found._stack:
        (folder / layout.RUN_LOG).write_text("before")
        found._redirect(folder)
        assert redirected == [(1, {}), (2, {}), (found._stack.fileno(), {"inheritable": False})]
    assert len(closed) == 2
    assert (folder / layout.RUN_LOG).read_text() == "before"
    assert (folder / layout.STACK).stat().st_mode & 0o777 == 0o644
    fatal = [(number, signal.SIG_DFL) for number in (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE)]
    assert handled == ["disabled", *fatal, found._stack, (signal.SIGUSR1, found._stack)]


def test_folder_that_is_gone_is_a_fault_of_the_machine(process, tmp_path):
    found = process()
    found._home = tmp_path / "gone"
    with pytest.raises(HostError, match="in which trials run cannot be entered: No such file or directory; restore it"):
        found._enter_home()


def test_module_that_only_a_trial_imports_from_outside_of_the_snapshot_is_reported(tmp_path, monkeypatch):
    code, mine, installed = tmp_path / "code", tmp_path / "my code", tmp_path / "site-packages"
    monkeypatch.setitem(sys.modules, "colorsys", colorsys)
    before = frozenset(sys.modules)
    places = {"kept": code / "kept.py", "late": mine / "late.py", "big": mine / "big" / "__init__.py"}
    for name, file in {**places, "lib": installed / "lib.py", "big.part": mine / "big" / "part.py"}.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(__file__=str(file)))
    monkeypatch.setitem(sys.modules, "built_in", SimpleNamespace())
    sys.modules["colorsys"] = sys.modules.pop("colorsys")  # an agent may import a module again
    found = notices_of_late_imports(before, (str(code),))
    assert [notice.split("'")[1] for notice in found] == ["big", "late"]
    assert all(notice.endswith(f"add --snapshot-root '{mine}'") for notice in found)
    assert notices_of_late_imports(before, ()) == []  # without a snapshot
