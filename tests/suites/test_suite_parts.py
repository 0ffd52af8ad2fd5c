"""The parts of a suite without any trial: its file, its plan, the process of a hunt, and which hunts run again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import BusyError, HuntDirectoryError, UntrustedError, UsageError
from crashhunt.plans import AgentSettings, HuntSettings, Request, RunSettings, read_settings, write_settings
from crashhunt.results import hunt_state
from crashhunt.suites import (
    RunRequest,
    Suite,
    SuiteEntry,
    _hunt_reruns,
    _processes,
    _request_file,
    _suite_file as _suite,
    rerun,
)
from crashhunt.suites._processes import slots_of
from crashhunt.suites._request_file import REQUEST, refuse_untrusted_hunt, trust_hunt, write_request

ASKED = RunRequest(
    Request(
        scenario="loop", trials=7, max_steps=9, seed=3, arguments={"ego.speed": "4"}, agents={"ego": "mine:A"},
    ),
    "/somewhere",
)  # fmt: skip


def settings(**more):
    given = {"scenario": "loop", "scenario_digest": "0", "trials": 7, "max_steps": 9, "seed": 3, "run": RunSettings(),
             "agents": {"ego": AgentSettings(agent="keep-lane")}}  # fmt: skip
    return HuntSettings(**given | more)


@pytest.fixture
def hunt(tmp_path):
    """The folder of a planned hunt."""
    folder = tmp_path / "h"
    folder.mkdir()
    write_request(folder, ASKED)
    return folder


# The process of a hunt.


def test_process_of_a_hunt_runs_in_the_folder_of_its_request(hunt, monkeypatch, tmp_path):
    started = []
    monkeypatch.setattr(subprocess, "Popen", lambda command, **given: started.append((command, given)) or "process")
    assert _processes._start(hunt, {"parallel": 2}, {"A": "1"}) == "process"
    write_request(hunt, replace(ASKED, folder=str(tmp_path)))
    (hunt / layout.RUN_LOG).write_text("before")
    _processes._start(hunt, {}, None)
    (command, given), (_, again) = started
    assert command[:4] == [sys.executable, "-P", "-m", "crashhunt.suites._processes"]
    assert command[4:] == [str(hunt.resolve()), '{"parallel": 2}', str(os.getpid())]
    assert (given["cwd"], again["cwd"]) == (None, str(tmp_path))  # a folder that is gone
    assert (given["env"], again["env"]) == ({"A": "1"}, None)
    assert given["start_new_session"] is True
    assert given["stdin"] == subprocess.DEVNULL
    assert given["stdout"] is given["stderr"]
    assert (hunt / layout.RUN_LOG).read_text() == "before"
    assert slots_of(3) == 3
    assert slots_of(0) == len(os.sched_getaffinity(0))


def test_process_of_a_hunt_waits_for_an_earlier_one(hunt, monkeypatch, capsys):
    made, slept, ends_with, busy = [], [], [], [True, True, False]

    def make(*given, **more):
        def run():
            if busy.pop(0):
                raise BusyError("another hunt is running", fix="wait", where="h")
            return "report"

        made.append((given, more))
        return SimpleNamespace(run=run)

    monkeypatch.setattr(_processes, "die_with", lambda *given: ends_with.append(given))
    monkeypatch.setattr(_processes, "_planned", lambda folder, request, run: ("scenario", run, request.trials))
    monkeypatch.setattr("crashhunt.hunts.Hunt", make)
    monkeypatch.setattr("crashhunt.report.describe_hunt", lambda report: f"described {report}")
    monkeypatch.setattr(_processes.time, "sleep", slept.append)
    _processes._main(hunt, {"parallel": 2}, 7)
    assert ends_with == [(7, signal.SIGTERM)]  # a suite that is killed takes its hunts along
    ((given, more),) = made
    assert given == (hunt, "scenario", {"parallel": 2})
    assert (more["command"], more["imported"], more["partner"]) == (["crashhunt", "suite", "run"], 7, None)
    assert slept == [0.5, 0.5]
    assert capsys.readouterr().out == "described report\n"
    busy[:] = [False]
    _processes._main(hunt, {"parallel": 2, "partner": "/other"}, 0)
    assert (made[-1][0], made[-1][1]["partner"]) == (given, Path("/other"))
    assert made[-1][1]["snapshot"].new_code is False
    busy[:] = [False]
    _processes._main(hunt, {"parallel": 2, "continue_with_new_code": True}, 0)
    assert (made[-1][0], made[-1][1]["snapshot"].new_code) == (given, True)
    monkeypatch.setattr(_processes, "_BUSY_S", -1.0)
    busy[:] = [True]
    _processes._main(hunt, {}, 0)
    assert "another hunt is running" in capsys.readouterr().err
    assert hunt_state(hunt).state == "queued"  # the process that runs there records its result


def test_hunt_that_has_begun_keeps_its_settings_and_takes_more_trials(hunt, monkeypatch):
    planned = []
    code = SimpleNamespace(imported="imported")

    def plan(request, *, survey):
        planned.append(request.run)
        return "new scenario", "new settings", code

    snapshot = SimpleNamespace(scenario="kept scenario")
    monkeypatch.setattr(_processes, "plan_with_code", plan)
    monkeypatch.setattr(_processes, "latest_snapshot", lambda folder: snapshot)
    monkeypatch.setattr(_processes, "with_settings", lambda scenario, given: (scenario, given.trials))
    run = {"parallel": 5, "trials": 20}
    assert _processes._planned(hunt, ASKED.request, run) == ("new scenario", "new settings", "imported")
    assert planned == [replace(ASKED.request.run, parallel=5)]
    write_settings(hunt / layout.HUNT, settings(), ["crashhunt"])
    scenario, found, imported = _processes._planned(hunt, ASKED.request, run)
    assert (scenario, imported) == (("kept scenario", 20), None)
    assert (found.trials, found.run.parallel, found.seed) == (20, 5, 3)
    assert _processes._planned(hunt, ASKED.request, {"parallel": 5})[1].trials == 7
    assert len(planned) == 1
    monkeypatch.setattr(_processes, "latest_snapshot", lambda folder: None)
    assert _processes._planned(hunt, ASKED.request, run)[0] == ("new scenario", 20)
    assert run == {"parallel": 5, "trials": 20}


def test_hunt_runs_again_only_where_it_is_trusted(hunt, monkeypatch):
    snapshots = []
    monkeypatch.setattr(_request_file, "latest_snapshot", lambda folder: snapshots[0] if snapshots else None)
    monkeypatch.setattr(_request_file, "is_hunt_trusted", lambda folder, snapshot: snapshot == "trusted")
    monkeypatch.setattr(_request_file, "describe_code", lambda snapshot, given: f"its {snapshot}")
    refuse_untrusted_hunt(hunt)  # its request was written here
    data = json.loads((hunt / REQUEST).read_text())
    (hunt / REQUEST).write_text(json.dumps(data | {"folder": "/other"}))
    with pytest.raises(UntrustedError, match="mine:A, imported from /other") as caught:
        refuse_untrusted_hunt(hunt)
    assert caught.value.where == str(hunt)
    write_request(hunt, ASKED)
    write_settings(hunt / layout.HUNT, settings(), ["crashhunt"])
    snapshots[:] = ["foreign"]
    with pytest.raises(UntrustedError, match="its foreign"):
        refuse_untrusted_hunt(hunt)
    snapshots[:] = ["trusted"]
    refuse_untrusted_hunt(hunt)
    (hunt / REQUEST).unlink()
    refuse_untrusted_hunt(hunt)
    snapshots.clear()
    with pytest.raises(UntrustedError):  # it was killed before it had a snapshot
        refuse_untrusted_hunt(hunt)
    (hunt / REQUEST).write_text("[]")
    with pytest.raises(UntrustedError, match=r"would run code that cannot be described \("):
        refuse_untrusted_hunt(hunt)


def test_trust_in_a_hunt_is_in_all_its_code(hunt, monkeypatch, tmp_path):
    class Snapshot:
        def __init__(self, place):
            self.place = place

        def verify(self):
            verified.append(self.place.name)

    verified, trusted = [], []
    for name in ("b", "a", ".part"):
        (hunt / layout.SNAPSHOTS / name).mkdir(parents=True)
    monkeypatch.setattr(_request_file, "Snapshot", Snapshot)
    monkeypatch.setattr(_request_file, "trust_snapshot", lambda snapshot, path: (snapshot.place.name, path))
    monkeypatch.setattr(_request_file, "add_trusted", lambda *given, **more: trusted.append((given, more)) or "request")
    assert trust_hunt(hunt, tmp_path) == [("a", tmp_path), ("b", tmp_path), "request"]
    assert verified == ["a", "b"]
    (((fingerprint,), more),) = trusted
    assert fingerprint == _request_file._fingerprint(hunt / REQUEST)
    assert more["path"] == str(tmp_path.resolve())
    assert "mine:A" in more["runs"]
    (hunt / REQUEST).unlink()
    assert trust_hunt(hunt, tmp_path) == [("a", tmp_path), ("b", tmp_path)]


# Hunts that run again.


def test_running_hunt_is_not_run_again(hunt, monkeypatch):
    monkeypatch.setattr(_hunt_reruns, "hunt_state", lambda folder: SimpleNamespace(state="running"))
    with pytest.raises(HuntDirectoryError) as caught:
        rerun([hunt], trusted=True)
    assert caught.value.where == str(hunt)
    checked = []
    monkeypatch.setattr(_hunt_reruns, "refuse_untrusted_hunt", checked.append)
    with pytest.raises(HuntDirectoryError):
        rerun([hunt])
    assert checked == [hunt]


def test_request_of_a_hunt_without_one_is_that_of_its_settings(hunt, monkeypatch, tmp_path):
    assert _hunt_reruns._request(hunt) == ASKED
    (hunt / REQUEST).unlink()
    write_settings(hunt / layout.HUNT, settings(), ["crashhunt"])
    found = _hunt_reruns._request(hunt)
    assert (found.request.scenario, found.folder) == ("loop", str(Path.cwd()))
    (tmp_path / "own").mkdir()
    monkeypatch.chdir(tmp_path)
    write_settings(hunt / layout.HUNT, settings(scenario="own"), ["crashhunt"])
    monkeypatch.setattr(_hunt_reruns, "latest_snapshot", lambda folder: None)
    assert _hunt_reruns._request(hunt).request.scenario == str(tmp_path / "own")
    snapshot = SimpleNamespace(path=hunt / "snapshots/0f")
    monkeypatch.setattr(_hunt_reruns, "latest_snapshot", lambda folder: snapshot)
    found = _hunt_reruns._request(hunt)
    assert found.request.scenario == str(hunt / "snapshots/0f/scenario" / layout.SCENARIO)
    moved = _hunt_reruns._with_moved_scenario(found, hunt, tmp_path / "aside")
    assert moved.request.scenario == str(tmp_path / "aside/snapshots/0f/scenario" / layout.SCENARIO)
    assert _hunt_reruns._with_moved_scenario(ASKED, hunt, tmp_path / "aside") is ASKED


def test_changes_of_a_request_name_their_owner(hunt):
    asked = replace(ASKED, request=replace(ASKED.request, agents={}, arguments={"speed": "4"}))
    assert _hunt_reruns._changed(asked, {}, hunt) == asked
    changes = {"trials": "11", "max_steps": "12", "seed": "5", "speed": "6", "vehicles": "9"}
    found = _hunt_reruns._changed(asked, changes, hunt).request
    assert (found.trials, found.max_steps, found.seed) == (11, 12, 5)
    assert found.arguments == {"ego.speed": "6"}
    assert found.scenario_arguments == {"vehicles": "9"}
    assert asked.request.arguments == {"speed": "4"}
    other = replace(asked, request=replace(asked.request, arguments={"ego.speed": "4", "speed": "5"}))
    assert _hunt_reruns._changed(other, {"ego.speed": "7"}, hunt).request.arguments == {"ego.speed": "7"}
    with pytest.raises(UsageError, match="--set trials=many"):
        _hunt_reruns._changed(asked, {"trials": "many"}, hunt)


@pytest.mark.parametrize(("state", "says"), [("running", "is running"), ("error", "ended in an error")])
def test_copy_that_runs_or_failed_is_refused(hunt, monkeypatch, state, says):
    monkeypatch.setattr(_hunt_reruns, "hunt_state", lambda folder: SimpleNamespace(state=state))
    with pytest.raises(HuntDirectoryError, match=says) as caught:
        _hunt_reruns._require_same_request(hunt, ASKED)
    assert caught.value.where == str(hunt)
    with pytest.raises(HuntDirectoryError, match="exists already"):
        _hunt_reruns._require_same_request(hunt, replace(ASKED, folder="/other"))
    (hunt / REQUEST).unlink()
    with pytest.raises(HuntDirectoryError, match="exists already"):
        _hunt_reruns._require_same_request(hunt, ASKED)


# The file of a suite.


def test_entries_of_a_suite_have_the_defaults_that_they_do_not_replace():
    merged = _suite._merged
    defaults = {"agent": "a", "runs": 2, "arguments": {"x": 1, "y": 2}, "agents": {"ego": "b"}}
    assert merged(defaults, {"arguments": {"y": 3}}) == defaults | {"arguments": {"x": 1, "y": 3}}
    found = merged(defaults, {"agents": {"car": "c"}, "runs": 5})
    assert found == {"runs": 5, "arguments": {"x": 1, "y": 2}, "agents": {"car": "c"}}
    assert "agents" not in merged(defaults, {"agent": "c"})
    assert merged({"x": 1}, {"x": {"y": 2}}) == {"x": {"y": 2}}
    assert defaults["arguments"] == {"x": 1, "y": 2}


def suite(tmp_path, text):
    (tmp_path / "suite.toml").write_text(text)
    return Suite.read(tmp_path / "suite.toml")


@pytest.mark.parametrize(
    ("text", "says"),
    [("hunts = [", "TOML"), ("hunts = []", "the file lists no hunts"), ("", "the key 'hunts' is missing"),
     ("[[hunts]]\nid = 'a'\n[[hunts]]\nid = 'A'", "the id 'A' is used twice"),
     ("[[hunts]]\nscenario = 'toy'", r"hunts\[0\].id = ''"),
     ("[[hunts]]\nid = '../a'", r"'\.\./a' is not a valid folder name"),
     ("[[hunts]]\nid = 'a'\ntrials = 'many'", "trials = 'many'"),
     ("[[hunts]]\nid = 'a'\nagent = 'x:Y'\nagents = { ego = 'x:Y' }", "both agent and agents"),
     ("schema = 2\n[[hunts]]\nid = 'a'", "schema = 2"),
     ("[[hunts]]\nid = 'a'\nruns = 0", "hunts.a.runs = 0"), ("[[hunts]]\nid = 'a'\nodd = 1", "odd"),
     ("[[hunts]]\nid = 'a'\n[[hunts]]\nid = 'b'\ntrials = -3", "suite.toml: hunts.b: trials is -3; give at least 0$"),
     ("[[hunts]]\nid = 'a'\nmax_steps = 0", "hunts.a: max_steps is 0; give at least 1"),
     ("[defaults]\ntimeout_s = -1.0\n[[hunts]]\nid = 'a'", "hunts.a: timeout_s is -1; give seconds above 0"),
     ("[[hunts]]\nid = 'a'\nkeep = 2", "hunts.a: keep 2 requires .*; give keep_going = true or distinct as well"),
     ("[[hunts]]\nid = 'a'\nsnapshot_limit_mb = 0", "snapshot_limit_mb is 0; .* above 0, or snapshot_code = false"),
     ("[[hunts]]\nid = 'a'\ntrials = 0", "trials is 0; give .* duration or until_rate"),
     ("[[hunts]]\nid = 'a'\nseed = -1", "hunts.a.seed = -1"),
     ("[[hunts]]\nid = 'a'\nscenario = \"a\\u0000b\"", "null byte")],
)  # fmt: skip
def test_mistake_in_a_suite_names_its_file(tmp_path, text, says):
    with pytest.raises(UsageError, match=says) as caught:
        suite(tmp_path, text)
    assert str(tmp_path / "suite.toml") in caught.value.where
    with pytest.raises(UsageError) as caught:
        Suite.read(tmp_path / "no.toml")
    assert caught.value.where == str(tmp_path / "no.toml")


def test_plan_of_a_suite_has_a_folder_for_each_run(tmp_path):
    found = suite(
        tmp_path, "[[hunts]]\nid = 'a'\nscenario = 'loop'\nruns = 2\nseed = 3\n[[hunts]]\nid = 'b'\nscenario = 'own'"
    )
    assert repr(found) == "<suite of 2 hunts, 3 runs: a, b>"
    folders = found.plan(tmp_path / "out")
    assert [folder.relative_to(tmp_path / "out").as_posix() for folder in folders] == ["a/0", "a/1", "b/0"]
    asked = RunRequest.read(folders[2] / REQUEST)
    assert (asked.request.scenario, asked.folder) == (str(tmp_path / "own"), str(tmp_path))
    assert RunRequest.read(folders[0] / REQUEST).request.scenario == "loop"
    seeds = [RunRequest.read(folder / REQUEST).request.seed for folder in folders]
    assert found.plan(tmp_path / "out") == folders
    assert [RunRequest.read(folder / REQUEST).request.seed for folder in folders] == seeds
    other = suite(tmp_path, "[[hunts]]\nid = 'a'\nscenario = 'loop'\nruns = 2\nseed = 4")
    with pytest.raises(HuntDirectoryError, match="'a'") as caught:
        other.plan(tmp_path / "out")
    assert caught.value.where == str(folders[0])
    with pytest.raises(HuntDirectoryError):
        found.plan(tmp_path / "no/out")
    new_code = [replace(entry, continue_with_new_code=True) for entry in found.entries]  # allowed later
    assert Suite(new_code, folder=tmp_path).plan(tmp_path / "out") == folders
    assert all(RunRequest.read(folder / REQUEST).request.continue_with_new_code for folder in folders)
    assert [RunRequest.read(folder / REQUEST).request.seed for folder in folders] == seeds
    roots = Suite([SuiteEntry(id="a", scenario="loop", snapshot_roots=("code", "/abs"))], folder=tmp_path)
    assert roots.request(roots.entries[0], 0).request.snapshot_roots == (str(tmp_path / "code"), "/abs")
    (tmp_path / layout.HUNT).touch()
    with pytest.raises(HuntDirectoryError):
        found.plan(tmp_path)


def test_hunts_of_a_suite_run_until_they_have_ended(tmp_path, monkeypatch):
    found = suite(tmp_path, "[[hunts]]\nid = 'a'\nscenario = 'loop'\nruns = 5")
    states = ["queued", "interrupted", "killed", "finished", "error"]
    ran, checked, seen = [], [], []
    monkeypatch.setattr(_suite, "hunt_state", lambda folder: SimpleNamespace(state=states[int(folder.name)]))
    monkeypatch.setattr(_suite, "refuse_untrusted_hunt", checked.append)

    def run(folders, parallel, *, watch, machine, is_enough):
        watch()
        ran.append(([folder.name for folder in folders], parallel, machine, is_enough()))

    monkeypatch.setattr(_suite, "run_all", run)
    result = found.run(tmp_path / "out", 3, watch=seen.append, machine={"executor": "fresh"})
    assert [one.state for one in result] == [one.state for one in seen[0]] == states
    assert ran == [(["0", "1", "2"], 3, {"executor": "fresh"}, False)]
    assert [folder.name for folder in checked] == ["0", "1", "2"]
    found.run(tmp_path / "out", trusted=True, stop_on_error=True)
    assert len(checked) == 3
    assert ran[-1][-1]  # as one hunt could not run


def test_finished_hunts_that_a_suite_does_not_run_again_are_reported_with_changed_files(tmp_path, monkeypatch):
    states = ["queued", "finished", "crashed", "error"]
    snapshot = SimpleNamespace(digest="d", scenario=SimpleNamespace(agents={"a": SimpleNamespace(agent="m:A")}))
    compared, changed = [], None
    monkeypatch.setattr(_suite, "hunt_state", lambda hunt: SimpleNamespace(state=states[hunt]))
    monkeypatch.setattr(_suite, "latest_snapshot", lambda hunt: snapshot)
    monkeypatch.setattr(_suite, "code_differences", lambda *given: compared.append(given) or changed)

    def describe(*hunts):
        monkeypatch.setattr(_suite, "find_hunts", lambda directory: hunts)
        return _suite.describe_finished(tmp_path)

    assert describe(0, 3) == ""
    assert describe(1) == "1 hunt had finished before and was not run again"
    assert compared == [(snapshot, ["m:A"])]
    changed = ["my.py has changed"]
    assert describe(0, 1, 2, 3) == (
        "2 hunts had finished before and were not run again, although files have changed since: my.py has changed. "
        f"Fix: crashhunt rerun {tmp_path} --all runs all hunts with today's files"
    )
    assert len(compared) == 2  # one for each snapshot


def test_settings_on_disk_are_what_a_request_keeps(hunt):
    write_settings(hunt / layout.HUNT, settings(), ["crashhunt"])
    assert _hunt_reruns._request_of(read_settings(hunt / layout.HUNT)).agents == {"ego": "keep-lane"}
