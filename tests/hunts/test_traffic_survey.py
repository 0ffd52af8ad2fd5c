"""The plain traffic is simulated before ``--ego any`` hunts, in a process of its own."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import time
import tomllib

import pytest
from conftest import mostly_nightly, wait_for

from crashhunt.base.processes import children_of
from crashhunt.base.reaper import Kept
from crashhunt.hunts import TrafficSurveyor, _preflight
from crashhunt.plans import Request, plan, write_settings
from crashhunt.scenario import as_plain_data, shipped_folder
from crashhunt.snapshots import SnapshotOptions, take_snapshot
from crashhunt.suites._processes import _planned

WAY = '<route id="way" edges="south east north west"/>'
# It stands where `blocked` departs, and for longer than trials wait.
BLOCKED = (
    f'{WAY}<vehicle id="plug" route="way" depart="0" departPos="7" departLane="0">'
    '<stop lane="south_0" endPos="8" duration="9999"/></vehicle>'
    '<flow id="blocked" route="way" begin="1" period="1" number="30" departPos="7" departLane="0"/>'
    '<flow id="free" route="way" begin="2" period="3" number="9" departPos="30" departLane="1"/>'
)
WORDS = ("--scenario", "town.sumocfg", "--arg", "speed=5:9", "--keep-going", "--no-snapshot", "--json")


def write(folder, demand, options=""):
    shutil.copy(shipped_folder() / "loop" / "loop.net.xml", folder / "net.net.xml")
    (folder / "r.rou.xml").write_text(f"<routes>{demand}</routes>")
    (folder / "town.sumocfg").write_text(
        f'<configuration><n v="net.net.xml"/><r v="r.rou.xml"/><step-length v="0.5"/>{options}</configuration>'
    )


@pytest.fixture
def town(shell):
    write(shell.folder, BLOCKED)
    return shell


def hunted(folder, hunt="h"):
    return tomllib.loads((folder / hunt / "hunt.toml").read_text())


def surveyed(folder, *, hunt="h", survey=True, **options):
    request = Request(scenario=str(folder / "town.sumocfg"), trials=2, max_steps=9, **options)
    surveyor = TrafficSurveyor(folder / hunt, overwrite=False)
    return plan(request, survey=surveyor if survey else None)


def test_trials_replace_vehicles_that_enter_only(town):
    done = town.crashhunt("run", "h", "1", "2", "20", *WORDS)
    assert "invalid" not in done.json["outcomes"]
    assert "no --ego given: each trial replaces one random vehicle (" in done.err
    spec = hunted(town.folder)["scenario_arguments"]["vehicle"]["spec"]
    assert spec
    assert all(name.startswith("free.") for name in spec.split("|"))
    # The files alone promise others, and would do so again: the hunt that is there keeps what it has drawn from.
    before = hunted(town.folder)
    _, settings = surveyed(town.folder, survey=False)
    assert "blocked." in settings.scenario_arguments["vehicle"].spec
    more = town.crashhunt("run", "h", "1", "3", "20", *WORDS)
    assert more.json["trials_run"] == 3
    assert {**hunted(town.folder), "trials": 2} == before


@pytest.mark.nightly
def test_a_hunt_of_before_continues_with_the_vehicles_that_its_files_promised(town):
    _, before = surveyed(town.folder, survey=False)
    promised = before.scenario_arguments["vehicle"].spec
    town.crashhunt("run", "h", "1", "1", "5", *WORDS, "--ego", "any", "--set", f"vehicle={promised}", expect=None)
    found = hunted(town.folder)
    assert found["scenario_arguments"]["vehicle"]["spec"] == promised
    assert found["scenario_digest"] == before.scenario_digest  # that of a hunt without a survey
    done = town.crashhunt("run", "h", "1", "2", "5", *WORDS, expect=None)
    assert done.json["trials_planned"] == 2
    assert hunted(town.folder)["scenario_arguments"] == found["scenario_arguments"]


def test_no_survey_where_the_user_names_the_vehicle(town, monkeypatch):
    monkeypatch.setattr(_preflight, "_survey", lambda *_: pytest.fail("simulated"))
    for options in ({"ego": "free.1"}, {"ego": "route=way"}, {"scenario_arguments": {"vehicle": "blocked.1"}},
                    {"scenario_arguments": {"scenario.vehicle": "blocked.1"}}):  # fmt: skip
        surveyed(town.folder, **options)
    request = Request(scenario="loop", trials=1, max_steps=1)
    plan(request, survey=TrafficSurveyor(town.folder, overwrite=False))


def test_the_demand_is_simulated_at_both_ends_of_its_range(town, monkeypatch):
    asked = []

    def survey(_scenario, runs):
        asked.extend(runs)
        return [{"begin_s": 0.0, "end_s": 9.0, "steps": 9, "entries": [("free.0", 2.0, "passenger", False)],
                 "gridlock": None, "cut_short": False}]  # fmt: skip

    monkeypatch.setattr(_preflight, "_survey", survey)
    _, settings = surveyed(town.folder, scenario_arguments={"scale": "0.5:2"})
    assert [run["values"] for run in asked] == [{"scale": 0.5}, {"scale": 2.0}]
    assert len({run["seed"] for run in asked}) == 2
    assert settings.scenario_arguments["vehicle"].spec == "free.0"


def test_where_no_trial_can_be_valid_one_line_states_so_before_the_first(shell):
    write(shell.folder, '<flow id="f" begin="10" end="20" probability="0.00001" from="south" to="east"/>')
    done = shell.crashhunt("run", "h", "1", "4", "20", *WORDS, expect=3)
    assert "no vehicle enters in 25 s of simulation (50 steps from 0 s)" in done.json["error"]["message"]
    assert done.json["error"]["fix"]
    (line,) = [line for line in done.err.splitlines() if not line.startswith("simulating the plain traffic")]
    assert line.startswith("crashhunt: ")
    assert not (shell.folder / "h").exists()


def test_vehicles_that_stand_for_ever_are_a_gridlock(shell):
    slow = '<vType id="slow" maxSpeed="0.01"/>'
    flow = '<flow id="f" type="slow" route="way" begin="0" period="1" number="9" departPos="random_free"/>'
    write(shell.folder, f"{slow}{WAY}{flow}")
    scenario, _ = surveyed(shell.folder)
    (note,) = [note for note in scenario.notes if note.startswith("warning")]
    assert "gridlocked from" in note
    assert "9 of 9 vehicles stand still" in note
    assert "in 2 of 2 runs" in note


def test_a_survey_that_takes_too_long_is_given_up(town, monkeypatch):
    monkeypatch.setattr(_preflight, "MAX_WALL_TIME_S", 0.0)
    scenario, settings = surveyed(town.folder)
    assert "took more than 0 s of wall time" in scenario.notes[1]
    assert settings == surveyed(town.folder, survey=False, seed=settings.seed)[1]


@pytest.mark.nightly
def test_survey_without_processor_time_warns_that_candidates_depend_on_the_machine(town, monkeypatch):
    assert not [note for note in surveyed(town.folder)[0].notes if "processor time" in note]
    monkeypatch.setattr(_preflight, "MAX_PROCESSOR_TIME_S", 0.0)
    (note,) = [note for note in surveyed(town.folder)[0].notes if "processor time" in note]
    assert note.startswith("warning: the look ahead ended at 5 s")


@pytest.mark.nightly
def test_busy_machine_finds_the_same_candidates(town, monkeypatch):
    before, _ = surveyed(town.folder)
    monkeypatch.setattr(_preflight, "MAX_PROCESSOR_TIME_S", 20.0)
    # As if other processes took the processor: wall time passes a thousand times as fast.
    fast = "import time\nreal = time.monotonic\ntime.monotonic = lambda: 1000 * real()\n"
    (town.folder / "sitecustomize.py").write_text(fast)
    monkeypatch.setenv("PYTHONPATH", str(town.folder), prepend=os.pathsep)
    assert surveyed(town.folder)[0].arguments == before.arguments


def test_without_room_for_the_survey_the_hunt_continues(town, monkeypatch):
    monkeypatch.setattr(_preflight, "Kept", lambda *_, **__: raise_full())
    scenario, settings = surveyed(town.folder)
    assert "the survey cannot run: [Errno 28]" in scenario.notes[1]
    assert settings == surveyed(town.folder, survey=False, seed=settings.seed)[1]


def raise_full():
    raise OSError(errno.ENOSPC, "No space left on device")


def kill_surveys(monkeypatch, number, *, first, child=False):
    """Send a signal to the processes of the first surveys, or to their reapers; return a list of all that begin."""
    begun = []

    def begin(*words, **options):
        kept = Kept(*words, **options)
        begun.append(kept)
        if len(begun) <= first:
            while child and not children_of(kept.process.pid):
                time.sleep(0.001)
            os.kill(children_of(kept.process.pid)[0] if child else kept.process.pid, number)
        return kept

    monkeypatch.setattr(_preflight, "Kept", begin)
    return begun


@pytest.mark.parametrize(
    ("number", "child"),
    mostly_nightly([(signal.SIGKILL, False), (signal.SIGKILL, True), (signal.SIGTERM, True)], [(signal.SIGKILL, True)]),
)
def test_survey_that_is_killed_from_outside_is_run_again(town, monkeypatch, number, child):
    undisturbed = surveyed(town.folder, seed=1)
    begun = kill_surveys(monkeypatch, number, first=2, child=child)
    assert surveyed(town.folder, seed=1) == undisturbed
    assert [kept.process.returncode for kept in begun] == [-number, -number, 0]


def test_survey_that_is_killed_each_time_is_abandoned(town, monkeypatch):
    begun = kill_surveys(monkeypatch, signal.SIGKILL, first=9)
    scenario, settings = surveyed(town.folder)
    assert len(begun) == _preflight.MAX_ATTEMPTS
    assert scenario.notes[1].endswith("the simulation of the traffic without agents failed: signal 9")
    assert settings == surveyed(town.folder, survey=False, seed=settings.seed)[1]


def test_survey_that_fails_by_itself_is_run_once(town, monkeypatch):
    (town.folder / "r.rou.xml").write_text(f'<routes>{WAY}<vehicle id="a" route="gone" depart="1"/></routes>')
    begun = kill_surveys(monkeypatch, signal.SIGKILL, first=0)
    scenario, _ = surveyed(town.folder)
    assert "the simulation of the traffic without agents failed" in scenario.notes[1]
    assert len(begun) == 1


@pytest.mark.parametrize("has_snapshot", [pytest.param(True, marks=pytest.mark.nightly), False])
def test_resumed_hunt_keeps_the_candidates_with_which_it_began_although_its_survey_was_killed(
    town, monkeypatch, has_snapshot
):
    with monkeypatch.context() as killing:
        kill_surveys(killing, signal.SIGKILL, first=9)
        begun, settings = surveyed(town.folder, seed=1)
    assert "blocked." in settings.scenario_arguments["vehicle"].spec
    # As a hunt that is killed right after it has written hunt.toml, or after it has taken its snapshot.
    (town.folder / "h").mkdir()
    write_settings(town.folder / "h" / "hunt.toml", settings, ["crashhunt", "run", "h"])
    if has_snapshot:
        take_snapshot(town.folder / "h" / "snapshots", begun, settings, SnapshotOptions(code=False))
    resumed, again = surveyed(town.folder, seed=1)
    assert again == settings
    assert as_plain_data(resumed) == as_plain_data(begun)
    other, _ = surveyed(town.folder, hunt="other", seed=1)  # the scenario of which a survey excludes the blocked ones
    assert as_plain_data(other) != as_plain_data(begun)


@pytest.mark.nightly
def test_hunt_of_a_suite_that_was_killed_before_its_snapshot_keeps_its_candidates(town):
    request = Request(scenario=str(town.folder / "town.sumocfg"), seed=1, trials=2, max_steps=9)
    begun, settings = surveyed(town.folder, seed=1)
    (town.folder / "h").mkdir()
    write_settings(town.folder / "h" / "hunt.toml", settings, ["crashhunt", "suite", "run"])
    resumed, again, _ = _planned(town.folder / "h", request, {})
    assert again == settings
    assert as_plain_data(resumed) == as_plain_data(begun)


def test_ctrl_c_ends_the_survey_and_leaves_nothing_behind(shell):
    far = '<trip id="a" depart="99999999" from="south" to="east"/>'
    write(shell.folder, far)
    temporary = shell.folder / "tmp"
    temporary.mkdir()
    shell.environment["TMPDIR"] = str(temporary)
    process = shell.start("run", "h", "1", "4", "20", *WORDS)
    wait_for(lambda: list(temporary.glob("crashhunt-temporary-*/*/survey-*/stage")), process=process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    assert json.loads(out)["error"]["message"] == "interrupted before the hunt began"
    assert not list(temporary.iterdir())
    assert not (shell.folder / "h").exists()
