"""How the hunts of a suite share the machine, and what becomes of those that cannot run; the processes are made up."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.ledger import Ledger
from crashhunt.plans import Request, plan
from crashhunt.results import hunt_state
from crashhunt.suites import RunRequest, _hunt_reruns, _processes, rerun
from crashhunt.suites._processes import check_machine, run_all, set_aside
from crashhunt.suites._request_file import REQUEST, write_request

ASKED = RunRequest(
    Request(
        scenario="loop",
        trials=7,
        max_steps=9,
        seed=3,
        arguments={"speed": "4"},
        keep_going=True,
        snapshot_limit_mb=7.0,
    ),
    "/somewhere",
)


@pytest.fixture
def folders(tmp_path):
    found = [tmp_path / name for name in "abc"]
    for folder in found:
        folder.mkdir()
        write_request(folder, ASKED)
    return found


@pytest.fixture
def started(monkeypatch):
    """Which hunts were started with which options.

    Each takes as long as `sleeps` has for its name: so many seconds, until another one starts, or an instant.
    """
    calls, sleeps = [], {}

    def start(folder, run, environment):
        if isinstance(error := sleeps.get(folder.name, 0), Exception):
            raise error
        if isinstance(error, str):
            process = subprocess.Popen(["cat"], stdin=subprocess.PIPE)
        else:
            process = subprocess.Popen(["sleep", str(error)])
        for name, *_, other in calls:
            if sleeps.get(name) == folder.name:
                other.stdin.close()
        calls.append((folder.name, run, environment, process))
        return process

    monkeypatch.setattr(_processes, "_start", start)
    monkeypatch.setattr(_processes, "_LOOK_EVERY_S", 0.01)
    monkeypatch.setattr(_processes, "_WATCH_EVERY_S", 0.01)
    return calls, sleeps


def test_a_request_is_read_as_it_was_written(tmp_path):
    write_request(tmp_path, ASKED)
    assert RunRequest.read(tmp_path / REQUEST) == ASKED
    (tmp_path / REQUEST).write_text(json.dumps({"request": {}}))
    with pytest.raises(HuntDirectoryError, match=r"no request\.json"):
        RunRequest.read(tmp_path / REQUEST)


def test_the_last_hunts_share_the_slots_and_have_the_options_of_the_machine(folders, started):
    calls, sleeps = started
    sleeps.update(a="c")
    run_all(folders, 2, machine={"executor": "fresh"}, environments={folders[1]: {"WHO": "b"}})
    assert [(name, run["parallel"]) for name, run, *_ in calls] == [("a", 1), ("b", 1), ("c", 1)]
    assert all(run["executor"] == "fresh" for _, run, *_ in calls)
    assert [environment for *_, environment, _ in calls] == [None, {"WHO": "b"}, None]
    assert [run.get("partner") for _, run, *_ in calls] == [None] * 3
    calls.clear()
    sleeps.clear()
    run_all(folders[:2], 2, partners={folders[0]: folders[1]})
    assert [run.get("partner") for _, run, *_ in calls] == [str(folders[1]), None]
    calls.clear()
    run_all(folders, 8)
    assert [(name, run["parallel"]) for name, run, *_ in calls] == [("a", 2), ("b", 3), ("c", 3)]


def test_a_hunt_that_cannot_be_started_is_an_error_and_the_others_run(folders, started):
    calls, sleeps = started
    sleeps.update(a=HuntDirectoryError("no request.json", fix="plan it again"))
    looks = []
    run_all(folders, 1, watch=lambda: looks.append(hunt_state(folders[0]).state))
    assert [name for name, *_ in calls] == ["b", "c"]
    state = hunt_state(folders[0])
    assert (state.state, state.detail) == ("error", "no request.json; plan it again")
    assert looks[-1] == "error"


def test_where_it_is_enough_running_hunts_are_stopped_and_no_more_are_started(folders, started):
    calls, sleeps = started
    sleeps.update(a=60, b=60)
    run_all(folders, 2, watch=lambda: None, is_enough=lambda: True)
    assert [(name, process.returncode) for name, *_, process in calls] == [("a", -signal.SIGINT), ("b", -signal.SIGINT)]


@pytest.mark.parametrize(
    ("error", "detail", "trace"),
    [
        (KeyError("gone"), "KeyError: 'gone'", True),
        (UsageError("no such agent", fix="name it"), "no such agent; name it", False),
    ],
)
def test_the_process_of_a_hunt_records_why_it_could_not_run(folders, monkeypatch, error, detail, trace):
    def fail(*_):
        raise error

    monkeypatch.setattr(_processes, "_planned", fail)
    monkeypatch.setattr(_processes, "die_with", lambda *_: None)  # this process must not end with its parent
    _processes._main(folders[0], {}, os.getppid())
    state = hunt_state(folders[0])
    assert (state.state, state.detail) == ("error", detail)
    log = (folders[0] / layout.ERROR_LOG).read_text()
    assert log.startswith(detail)
    assert ("Traceback" in log) == trace


@pytest.mark.parametrize(
    ("before", "state", "fact"),
    [
        ("interrupted", "interrupted", "interrupted"), ("running", "killed", "running"),
        ("all_trials", "interrupted", "interrupted"), ("no_valid_trial", "error", "error"),
        ("queued", "error", "error"),
    ],
)  # fmt: skip
def test_hunt_that_cannot_resume_keeps_its_trials_when_it_runs_again(folders, started, before, state, fact):
    calls, sleeps = started
    with closing(Ledger(folders[0] / layout.LEDGER, writable=True)) as ledger:
        ledger.enter(before)
    sleeps.update(a=HuntDirectoryError("another version of the sampler"))
    run_all(folders[:1], 1)
    found = hunt_state(folders[0])
    assert (found.state, found.detail, found.failed) == (state, "another version of the sampler", True)
    with closing(Ledger(folders[0] / layout.LEDGER)) as ledger:
        assert ledger.facts()["state"] == fact
        assert ledger.events()[-1][1:] == ("error", "another version of the sampler")
    sleeps.clear()
    _, replaced = rerun(folders[:1], trusted=True)
    assert [name for name, *_ in calls] == ["a"]
    assert bool(replaced) == (state == "error")


def test_a_process_of_its_own_begins_with_the_folder_the_options_and_its_parent(folders):
    """Other tests fork it, which leaves out how Python starts."""
    (folders[0] / REQUEST).write_text("{}")
    command = [sys.executable, "-P", "-m", "crashhunt.suites._processes", str(folders[0]), "{}", str(os.getpid())]
    subprocess.run(command, check=True, timeout=60)
    assert hunt_state(folders[0]).state == "error"
    assert REQUEST in hunt_state(folders[0]).detail


def test_results_that_are_replaced_are_moved_next_to_the_hunt_each_time(folders):
    folder, asked = folders[0], []
    for number in range(2):
        (folder / "result").write_text(f"{number}")

        def planned(aside):
            asked.append(aside)
            return ASKED

        aside = set_aside(folder, planned)
        assert aside.parent == folder.parent
        assert (aside / "result").read_text() == f"{number}"
        assert asked[-1] == aside
        assert [path.name for path in folder.iterdir()] == [REQUEST]
    assert len({*asked}) == 2


def test_a_changed_copy_runs_elsewhere_and_the_hunt_stays(folders, started, tmp_path):
    calls, _ = started
    before = (folders[0] / REQUEST).read_bytes()
    changes = {"trials": "11", "seed": "5", "speed": "6"}
    states, replaced = rerun([folders[0]], changes=changes, to=tmp_path / "copy", trusted=True, parallel=1)
    assert ([state.dir for state in states], replaced) == ([str(tmp_path / "copy")], [])
    assert [(name, run) for name, run, *_ in calls] == [("copy", {"parallel": 1})]
    assert (folders[0] / REQUEST).read_bytes() == before
    asked = RunRequest.read(tmp_path / "copy" / REQUEST).request
    assert (asked.trials, asked.seed, asked.max_steps) == (11, 5, 9)
    assert [*asked.arguments.values()] == ["6"]
    rerun([folders[0]], changes=changes, to=tmp_path / "copy", trusted=True)  # the same command resumes
    with pytest.raises(HuntDirectoryError, match="exists already"):
        rerun([folders[0]], changes={"seed": "6"}, to=tmp_path / "copy", trusted=True)
    with pytest.raises(HuntDirectoryError, match="cannot be created"):
        rerun([folders[0]], changes=changes, to=tmp_path / "no" / "where", trusted=True)
    with pytest.raises(UsageError, match="takes one hunt, but there are 2"):
        rerun(folders[:2], changes=changes, to=tmp_path / "other", trusted=True)


def test_only_hunts_that_need_it_run_again_unless_all_are_asked_for(folders, started):
    calls, sleeps = started
    sleeps.update(a=HuntDirectoryError("damaged", fix="plan it again"))
    run_all(folders[:1], 1)
    sleeps.clear()
    states, replaced = rerun(folders[:2], trusted=True, parallel=1)
    assert [name for name, *_ in calls] == ["a", "b"]  # one failed, the other never ran
    assert [path.name for path in replaced] == [f"a{layout.REPLACED}0"]
    assert [state.state for state in states] == ["queued", "queued"]  # the made-up processes do nothing
    with pytest.raises(UsageError, match="--set seed: a hunt cannot change its settings"):
        rerun(folders[:1], changes={"seed": "4"}, trusted=True)
    _, replaced = rerun(folders[:1], everything=True, changes={"seed": "4"}, trusted=True)
    assert [path.name for path in replaced] == [f"a{layout.REPLACED}1"]
    assert RunRequest.read(folders[0] / REQUEST).request.seed == 4
    assert RunRequest.read(replaced[0] / REQUEST) == ASKED


@pytest.mark.parametrize(("parallel", "machine"), [(-1, None), (1, {"executor": "gone"}), (1, {"audit": -1})])
def test_options_of_the_machine_are_checked_before_any_hunt_runs(parallel, machine):
    check_machine(1, {"executor": "fresh", "continue_with_new_code": True})
    with pytest.raises(Exception, match=r".+") as caught:
        check_machine(parallel, machine)
    assert "\n" not in str(caught.value)


def test_results_are_moved_aside_also_where_names_cannot_be_exchanged(folders, monkeypatch):
    monkeypatch.setattr(_processes, "exchange", lambda one, other: False)
    (folders[0] / "result").write_text("old")
    aside = set_aside(folders[0], lambda aside: ASKED)
    assert (aside / "result").read_text() == "old"
    assert [path.name for path in folders[0].iterdir()] == [REQUEST]
    assert {path.name for path in folders[0].parent.iterdir() if not path.name.startswith(".")} == {
        "a", "b", "c", aside.name,
    }  # fmt: skip


def test_the_request_of_settings_results_in_the_same_settings():
    chosen = {"arguments": {"speed": "4:8"}, "scenario_arguments": {"vehicles": "12"}, "disturb": ("brake=0.1",)}
    given = Request(scenario="loop", trials=7, max_steps=9, seed=3, sampler="sobol", **chosen,
                    keep_going=True)  # fmt: skip
    scenario, settings = plan(given)
    assert [*scenario.agents] == ["ego"]
    again = _hunt_reruns._request_of(settings)
    assert (again.trials, again.max_steps, again.seed, again.sampler, again.disturb) == (
        7,
        9,
        3,
        "sobol",
        ("brake=0.1",),
    )
    assert plan(again)[1] == settings
    for actions, asked in (
        (("trajectory", "trajectory"), "trajectory:visible=front"), (("meta", None), ""),
        (("meta", "trajectory:visible=whole"), ""),
    ):  # fmt: skip
        agents = {name: replace(settings.agents["ego"], action=one) for name, one in zip("ab", actions, strict=True)}
        assert _hunt_reruns._request_of(replace(settings, agents=agents)).action == asked
