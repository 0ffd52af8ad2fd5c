"""The state of a hunt from the facts in its ledger, at a fixed time."""

from __future__ import annotations

import os
import shutil
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.process_owners import this_process
from crashhunt.errors import HuntDirectoryError
from crashhunt.ledger import Ledger
from crashhunt.plans import HuntSettings
from crashhunt.results import _hunt_state, find_hunts, hunt_state, is_hunt
from crashhunt.results._hunt_directory import HuntDirectory
from crashhunt.results._hunt_state import copies_to_come, ledger_owner, state_of_facts, sums_of_branches
from crashhunt.trial import Branch, Branches, Outcome, TrialResult, TrialSpec

NOW = 1000.0


@pytest.fixture(autouse=True)
def _clock(monkeypatch):
    monkeypatch.setattr(_hunt_state, "time", SimpleNamespace(time=lambda: NOW, strftime=time.strftime))


def running(**facts):
    return {"state": "running", "owner": ledger_owner(), "began": 900.0, "done_before": 2, "planned": 20} | facts


OUTCOMES = {"survived": 4, "collision": 1, "invalid": 2, "agent_error": 1, "hang": 1}


def state(facts, outcomes=OUTCOMES, last=950.0):
    return state_of_facts(Path("h"), facts, outcomes, last)


def test_running_hunt_has_its_rate_and_the_time_to_its_last_trial():
    found = state(running())
    assert (found.dir, found.state, found.owner_alive, found.detail) == ("h", "running", True, "")
    assert (found.trials_planned, found.trials_run, found.outcomes, found.errors) == (20, 9, OUTCOMES, 4)
    assert found.rate_per_s == pytest.approx(7 / 100)
    assert found.seconds_left == pytest.approx(11 / 0.07)
    assert (found.phase, found.newest_kind_s, found.rate, found.nodes, found.kinds, found.core) == (None,) * 6
    more = state(
        running(core="used", nodes=["n"], kinds=["k"], types_by_cause=2, running_rate={"x": 1}, newest_kind=970)
    )
    assert (more.core, more.nodes, more.kinds, more.types_by_cause) == ("used", ["n"], ["k"], 2)
    assert (more.rate, more.newest_kind_s) == ({"x": 1}, 30.0)
    assert state(running(newest_kind=NOW + 5)).newest_kind_s == 0.0


@pytest.mark.parametrize("said", ["crash", "all_trials", "interrupted"])
def test_clocks_stand_still_after_the_last_trial(said, monkeypatch):
    ended = running(state=said, newest_kind=930.0)
    found = state(ended)
    assert found.newest_kind_s == 20.0
    confirming = running(newest_kind=930.0, phase={"name": "confirming", "done": 0, "total": 1, "seconds_left": None})
    assert state(confirming).newest_kind_s == 20.0
    monkeypatch.setattr(_hunt_state.time, "time", lambda: NOW + 3600)
    later = state(ended)
    assert (later.newest_kind_s, later.rate_per_s) == (found.newest_kind_s, found.rate_per_s)
    assert state(ended, last=None).newest_kind_s is None


@pytest.mark.parametrize(
    ("facts", "left"),
    [
        ({"until": 1010.0}, 10.0),
        ({"until": 2000.0}, 11 / 0.07),
        ({"until": 990.0}, 0.0),
        ({"until": 1010.0, "planned": 0}, 10.0),
        ({"planned": 0}, None),
        ({"planned": 5}, 0.0),
        ({"ends_at": 1042.0, "until": 1010.0}, 42.0),
        ({"ends_at": 990.0}, 0.0),
        ({"done_before": 9}, None),
        ({"done_before": 12, "until": 1500.0}, 500.0),
        ({"began": NOW}, None),
    ],
)
def test_time_left_is_that_of_the_trials_of_the_clock_or_expected(facts, left):
    found = state(running(**facts))
    assert found.seconds_left == (left if left is None else pytest.approx(left))
    assert (found.rate_per_s == 0.0) == (facts.get("done_before", 0) >= 9 or "began" in facts)


@pytest.mark.parametrize(
    ("seconds", "heartbeat", "left"), [(40.0, 990.0, 30.0), (5.0, 990.0, 0.0), (None, 990.0, None), (40.0, None, 40.0)]
)
def test_phase_has_the_time_left_since_its_heartbeat(seconds, heartbeat, left):
    phase = {"name": "confirming", "done": 3, "total": 9, "seconds_left": seconds}
    facts = running(phase=phase, ends_at=2000.0) | ({} if heartbeat is None else {"heartbeat": heartbeat})
    found = state(facts)
    assert found.phase == {"name": "confirming", "done": 3, "total": 9}
    assert list(found.phase) == ["name", "done", "total"]
    assert found.seconds_left == left
    assert found.rate_per_s == pytest.approx(7 / 50)  # up to the last trial
    ended = state(facts | {"state": "all_trials"})
    assert (ended.phase, ended.seconds_left) == (None, None)


def test_rate_of_a_hunt_that_has_ended_is_up_to_its_last_trial():
    ended = running(state="all_trials", owner=None, detail="done")
    assert state(ended).rate_per_s == pytest.approx(7 / 50)
    found = state(ended, last=None)
    assert (found.state, found.detail, found.owner_alive) == ("finished", "done", False)
    assert (found.rate_per_s, found.seconds_left) == (0.0, None)
    queued = state({}, {}, None)
    assert (queued.state, queued.trials_planned, queued.trials_run, queued.rate_per_s) == ("queued", 0, 0, 0.0)
    assert state({"began": 0.0, "state": "time"}, {"survived": 3}, 6.0).rate_per_s == 0.5
    assert state({"done_before": 0, "state": "interrupted"}, {"survived": 3}, 6.0).rate_per_s == 0.0  # a salvaged copy
    killed = state(running(owner=None))
    assert (killed.state, killed.detail, killed.owner_alive, killed.seconds_left) == (
        "killed", "its process is gone", False, None,
    )  # fmt: skip


def test_owner_on_another_machine_is_alive_for_a_minute_after_its_heartbeat():
    owner = {"host": "elsewhere", "pid": os.getpid(), "started": ledger_owner()["started"]}
    assert _hunt_state._is_alive(owner, NOW - 59.0)
    assert not _hunt_state._is_alive(owner, NOW - 60.0)
    assert not state(running(owner=owner)).owner_alive  # without any heartbeat


def test_owner_in_another_container_of_the_same_host_name_is_judged_by_its_heartbeat():
    here = ledger_owner()
    assert _hunt_state._is_alive(here, 0.0)
    pid, started, boot, namespace = here["token"].split("-")
    other = {**here, "token": f"{pid}-{started}-{boot}-{int(namespace, 16) ^ 1:08x}"}
    assert (_hunt_state._is_alive(other, NOW - 59.0), _hunt_state._is_alive(other, NOW - 60.0)) == (True, False)
    for gone in ({**here, "pid": 2**22 + 5}, {**here, "started": here["started"] + 1}):
        assert not _hunt_state._is_alive(gone, NOW)


def test_copies_of_a_hunt_are_those_of_its_settings():
    def of(**wanted):
        return copies_to_come(SimpleNamespace(**{"probe": "", "branch": False, "rare": False} | wanted))

    assert of() is None
    assert of(probe="4s") == ["probes"]
    assert of(branch=True) == ["branches"]
    assert of(rare=True) == ["rare"]
    assert of(probe="4s", branch=True) == ["probes", "branches"]


def result(number, outcome=Outcome.SURVIVED, **more):
    return TrialResult(TrialSpec(number, 1, {}, {}, 9), outcome, steps=9, **more)


def test_branches_of_a_hunt_are_summed(tmp_path):
    crash = Branch((), 1, "collision", 5, -2.0)
    with closing(Ledger(tmp_path / "l.sqlite", writable=True)) as ledger:
        for number, branches in enumerate([
            Branches(moments=1, asked=2, steps=3, left_out=4),
            Branches(moments=10, asked=20, steps=30, left_out=40, crashes=(crash, crash), unanswered=2),
            Branches(moments=100, asked=200, steps=300, left_out=400, crashes=(crash,)),
            None,
        ]):  # fmt: skip
            ledger.record(result(number, branches=branches), snapshot="")
        facts = {"copies": ["branches"], "confirmed": {"branches": (2, 1), "probes": (7, 7)}}
        assert sums_of_branches(ledger, facts) == {
            "trials": 3, "moments": 111, "branches": 222, "steps": 333, "left_out": 444, "crashed": 3,
            "crashed_trials": 2, "not_fully_asked": 1, "run_again": 2, "confirmed": 1,
        }  # fmt: skip
        found = sums_of_branches(
            ledger, {"copies": ["branches"], "state": "running", "confirmed": {"branches": (2, 1)}}
        )
        assert (found["run_again"], found["confirmed"]) == (None, None)
        assert sums_of_branches(ledger, {"copies": ["probes"]}) is sums_of_branches(ledger, {}) is None


@pytest.fixture
def hunt(tmp_path):
    """A hunt of six trials, of which three crashed, with a bundle of one."""
    path = tmp_path / "h"
    (path / layout.CRASHES / "000001-collision").mkdir(parents=True)
    with closing(Ledger(path / layout.LEDGER, writable=True)) as ledger:
        for number in range(6):
            ledger.record(result(number, Outcome.COLLISION if number % 2 else Outcome.SURVIVED), snapshot="")
        ledger.enter("all_trials", planned=6, crash_on=["collision"])
    return path


def note(hunt, **facts):
    with closing(Ledger(hunt / layout.LEDGER, writable=True)) as ledger:
        ledger.note(**facts)


def test_crashes_are_those_of_the_ledger_or_those_that_were_saved(hunt):
    found = hunt_state(hunt)
    assert (found.state, found.crashes, found.crashes_saved, found.disturbed) == ("crashed", 3, 1, None)
    note(hunt, dropped={"a": [3, 5, 7], "b": [9]}, disturb=["brake=0.1"])
    found = hunt_state(hunt)
    assert (found.crashes, found.crashes_saved, found.disturbed) == (5, 1, 0)
    note(hunt, dropped=None, crash_on=["off_road"])
    found = hunt_state(hunt)
    assert (found.crashes, found.crashes_saved, found.disturbed) == (1, None, 0)
    note(hunt, crash_on=None)  # neither ledger nor settings know what counts
    found = hunt_state(hunt)
    assert (found.state, found.crashes, found.disturbed) == ("crashed", 1, None)
    note(hunt, state="interrupted")
    assert hunt_state(hunt).state == "interrupted"


def test_facts_of_another_kind_are_damage(hunt):
    note(hunt, planned="many")
    found = hunt_state(hunt)
    assert (found.dir, found.state, found.damaged) == (str(hunt), "error", True)
    assert "a fact cannot be read: ValueError" in found.detail
    assert found.trials_run == 0


def test_folder_without_a_hunt_is_refused_with_what_it_is(hunt, tmp_path):
    assert find_hunts(hunt) == [hunt]
    (tmp_path / "file").touch()
    for function, what in ((find_hunts, "a hunt or a suite"), (hunt_state, "a hunt")):
        with pytest.raises(HuntDirectoryError, match=f"file' is a file; give the directory of {what}$"):
            function(tmp_path / "file")
    (tmp_path / "nightly").mkdir()
    (tmp_path / "nightly" / "run").mkdir()
    (tmp_path / "nightly" / "run" / "hunt.toml").touch()
    (tmp_path / "nightlie").mkdir()  # has no hunt
    for function in (find_hunts, hunt_state):
        with pytest.raises(HuntDirectoryError, match=r"nightli' does not exist; did you mean '.*nightly'\? give the"):
            function(tmp_path / "nightli")
    shutil.rmtree(tmp_path / "nightly" / "run")
    with pytest.raises(HuntDirectoryError, match="is not the directory of a hunt"):
        hunt_state(tmp_path / "nightly")
    for name in (layout.LEDGER, layout.REQUEST, layout.HUNT):
        (tmp_path / "nightly" / name).touch()
        assert is_hunt(tmp_path / "nightly")
        (tmp_path / "nightly" / name).unlink()


def test_settings_are_removed_last_so_that_a_folder_stays_that_of_a_hunt(tmp_path, monkeypatch):
    place, removed = HuntDirectory(tmp_path), []
    assert place.has_begun is False
    unlink = Path.unlink

    def listen(path, **options):
        removed.append(path.name)
        unlink(path, **options)

    for name in (layout.HUNT, layout.LEDGER, "mine"):
        (tmp_path / name).touch()
    (tmp_path / "snapshots" / "a").mkdir(parents=True)
    monkeypatch.setattr(Path, "unlink", listen)
    place._remove_own()
    assert removed[-1] == layout.HUNT
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_claim_removes_what_ended_processes_have_left(tmp_path):
    here, place = this_process(), HuntDirectory(tmp_path)
    dead = replace(here, pid=2**22 + 5, started=1)
    folders = [tmp_path, *(tmp_path / name for name in (layout.CRASHES, *layout.BESIDE))]
    for folder in folders:
        for owner in (here, dead):
            (folder / f".000001-collision.{owner.token}").mkdir(parents=True)
    (tmp_path / f".scratch-{dead.token}" / "trial").mkdir(parents=True)
    settings = HuntSettings(scenario="loop", scenario_digest="x", trials=1, max_steps=1, seed=1)
    place.claim(settings, ["crashhunt"], overwrite=False, seed_given=True)
    for folder in folders:
        assert [path.name for path in folder.glob(".000001*")] == [f".000001-collision.{here.token}"]
    assert [path.name for path in tmp_path.glob(".scratch*")] == [place.scratch.name]


@pytest.mark.parametrize(
    ("began", "elapsed_s", "rate"),
    [
        (900.0, 50.0, 7 / 50),  # up to the last trial
        (900.0, 45.0, 7 / 50),  # the last trial ended after the last heartbeat
        (900.0, 70.0, 7 / 50),  # the hunt ended after its last trial
        (-6300.0, 50.0, 7 / 50),  # the clock was put forward by 2 h, or the machine was suspended
        (8100.0, 50.0, 7 / 50),  # put back
        (8100.0, 0.0, 0.0),
    ],
)
def test_rate_does_not_depend_on_the_setting_of_the_clock(began, elapsed_s, rate):
    for changed in ({}, {"state": "all_trials", "owner": None}):
        phase = {"name": "confirming", "done": 0, "total": 1, "seconds_left": None}
        facts = running(began=began, elapsed_s=elapsed_s, phase=phase) | changed
        assert state(facts).rate_per_s == pytest.approx(rate)


def test_rate_of_a_running_hunt_is_up_to_now_unless_the_clock_was_set():
    assert state(running(elapsed_s=99.0)).rate_per_s == pytest.approx(7 / 100)
    assert state(running(elapsed_s=40.0)).rate_per_s == pytest.approx(7 / 40)
