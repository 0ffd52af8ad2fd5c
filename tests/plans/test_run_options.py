"""The list of hunt options, and what is made of it: an option is added in one place, and everybody has it."""

from __future__ import annotations

import inspect
import json
from dataclasses import replace

import numpy as np
import pytest

import crashhunt
from crashhunt.base.errors import CallError, UsageError
from crashhunt.plans import (
    Request,
    RunSettings,
    hunt_options,
    plan,
    read_settings,
    write_settings,
)
from crashhunt.replays import ReplayOptions
from crashhunt.snapshots import SnapshotOptions
from crashhunt.suites import RunRequest, Suite, SuiteEntry


def test_python_has_the_options_of_the_list():
    names = [option.name for option in hunt_options()]
    given = inspect.signature(crashhunt.prepare).parameters
    assert list(given)[:4] == ["directory", "parallel", "trials", "max_steps"]
    assert set(given) - {*list(given)[:4]} == {*names, "snapshot", "overwrite", "command"}
    assert {*inspect.signature(crashhunt.run).parameters} == {*given, "watch"}
    for option in hunt_options():
        assert given[option.name].kind is inspect.Parameter.KEYWORD_ONLY
        assert given[option.name].default == option.default
        assert f"    {option.name}: {option.about.meaning}" in crashhunt.prepare.__doc__
    assert crashhunt.prepare.__name__ == "prepare"


WHOLE = """\
# crashhunt run
scenario = "loop"
scenario_digest = "DIGEST"
trials = 3
max_steps = 10
seed = 7
sampler = "grid"
points = 4
crash_on = [
    "collision",
    "not_moving",
]
oracles = [
    "reported-collision",
    "overlap",
    "off-road",
]
schema = 1

[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"
action = "continuous"

[agents.ego.arguments.speed]
spec = "3.0:5.0"
kind = "float"

[scenario_arguments.vehicles]
spec = "25"
kind = "int"

[scenario_arguments.trucks_per_100_cars]
spec = "15"
kind = "int"

[scenario_arguments.imperfection]
spec = "0.5"
kind = "float"

[scenario_arguments.speed_spread]
spec = "0.1"
kind = "float"

[events]
not_moving = 12.5

[run]
parallel = 3
keep_going = true
deterministic = true
keep_trials = true
timeout_s = 5.0
audit = 0.25
accelerate = false
"""


def test_hunt_toml_is_what_it_was_to_the_byte(tmp_path):
    asked = Request(
        parallel=3, keep_going=True, deterministic=True, keep_trials=True, timeout_s=5.0, audit=0.25,
        accelerate=False, trials=3, max_steps=10, seed=7, action="continuous", sampler="grid", points=4,
        crash_on=["collision", "not_moving:12.5"], arguments={"speed": "3:5"},
    )  # fmt: skip
    _, settings = plan(asked)
    write_settings(tmp_path / "hunt.toml", settings, ["crashhunt", "run"])
    written = (tmp_path / "hunt.toml").read_text()
    assert written == WHOLE.replace("DIGEST", settings.scenario_digest)
    assert read_settings(tmp_path / "hunt.toml") == settings


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"points": "a"}, "--points is 'a'; give a whole number"),
        ({"points": True}, "--points is True; give a whole number"),
        ({"points": 0}, "--points is 0; give at least 1"),
        ({"seed": -1}, "--seed is -1; give at least 0"),
        ({"seed": 2**63}, f"--seed is {2**63}; give at most {2**63 - 1}"),
        ({"near_misses": 2**63}, f"--near-misses is {2**63}; give at most {2**63 - 1}"),
        ({"timeout_s": float("inf")}, "--timeout is inf; give seconds above 0"),
        ({"timeout_s": float("nan")}, "--timeout is nan; give seconds above 0"),
        ({"timeout_s": "long"}, "--timeout is 'long'; give a number"),
        ({"audit": 1.5}, "--audit is 1.5; give a share of the trials, from 0 to 1"),
        ({"audit": float("nan")}, "--audit is nan; give a share of the trials, from 0 to 1"),
        ({"duration": "30x"}, "--for is 30x; give a time above 0, such as 90s, 30m, 2h or 1h30m"),
        ({"probe": "often"}, "--probe is often; give a time above 0, such as 4s, or omit the option"),
        ({"keep_going": "no"}, "--keep-going is 'no'; give True or False"),
        ({"crash_on": "collision"}, "--crash-on is 'collision'; give a list"),
        ({"snapshot_limit_mb": 0}, "--snapshot-limit is 0; give MB above 0, or --no-snapshot"),
        ({"sampler": 3}, "--sampler is 3; give a text"),
        ({"arguments": "speed"}, "--arg is 'speed'; give a dictionary"),
        ({"scenario_arguments": 3}, "--set is 3; give a dictionary"),
        ({"agents": "a:B"}, "--agent is 'a:B'; give a dictionary"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_the_fix(given, message):
    with pytest.raises(UsageError) as refused:
        crashhunt.prepare("nowhere", 1, 1, 1, **given)
    assert str(refused.value) == message


def test_numbers_of_numpy_are_numbers(tmp_path):
    hunt = crashhunt.prepare(tmp_path / "h", 1, 1, 1, seed=np.int64(3), points=np.int32(4), timeout_s=np.float32(2))
    assert (hunt.settings.seed, hunt.settings.points, hunt.settings.run.timeout_s) == (3, 4, 2.0)
    write_settings(tmp_path / "hunt.toml", hunt.settings, ["x"])
    assert read_settings(tmp_path / "hunt.toml") == hunt.settings


def test_a_suite_has_every_option(tmp_path):
    assert {option.name for option in hunt_options(SuiteEntry)} | {"agent", "agents"} == {
        option.name for option in hunt_options()
    }
    lacked = "accelerate = false\ntimeout_s = 7.0\nsnapshot_limit_mb = 3\nsnapshot_code = false\n"
    (tmp_path / "s.toml").write_text(f'[defaults]\n{lacked}[[hunts]]\nid = "a"\nscenario = "toy"\n')
    (folder,) = Suite.read(tmp_path / "s.toml").plan(tmp_path / "s")
    planned = json.loads((folder / "request.json").read_text())
    assert planned["request"]["run"]["accelerate"] is False
    assert planned["request"]["run"]["timeout_s"] == 7.0
    assert (planned["snapshot_limit_mb"], planned["snapshot_code"], planned["snapshot_roots"]) == (3.0, False, [])
    assert Suite.read(tmp_path / "s.toml").entries[0] == SuiteEntry(
        id="a", scenario="toy", accelerate=False, timeout_s=7.0, snapshot_limit_mb=3.0, snapshot_code=False
    )
    (tmp_path / "s.toml").write_text('[[hunts]]\nid = "a"\ntimeut_s = 3\n')
    with pytest.raises(UsageError, match="unknown key 'timeut_s'; did you mean 'timeout_s'"):
        Suite.read(tmp_path / "s.toml")


def test_a_request_of_an_older_version_is_read(tmp_path):
    older = {
        "request": {
            "trials": 3, "max_steps": 9, "scenario": "toy", "ego": "", "action": "", "agents": {},
            "arguments": {"speed": "4"}, "scenario_arguments": {}, "sampler": "random", "points": 10, "seed": 5,
            "crash_on": ["collision"], "run": {"parallel": 1, "keep_going": True, "timeout_s": 3.0},
        },
        "folder": "/somewhere",
        "snapshot_roots": ["/a/file"],
    }  # fmt: skip
    (tmp_path / "request.json").write_text(json.dumps(older))
    found = RunRequest.read(tmp_path / "request.json")
    assert found.request == Request(
        trials=3, max_steps=9, scenario="toy", arguments={"speed": "4"}, seed=5, crash_on=["collision"],
        keep_going=True, timeout_s=3.0, snapshot_roots=["/a/file"],
    )  # fmt: skip
    assert json.loads(json.dumps(found.to_json()))["snapshot_roots"] == ["/a/file"]


def test_what_has_no_such_option_states_what_it_has():
    for make, name in ((SuiteEntry, "SuiteEntry"), (RunSettings, "RunSettings"), (Request, "Request")):
        with pytest.raises(CallError, match=rf"{name}\(\) has no argument 'keep_gong'"):
            make(keep_gong=True)
    for make in (SnapshotOptions, ReplayOptions, Suite):
        with pytest.raises(CallError, match=rf"{make.__name__}\(\) has no argument 'tims'; "):
            make(tims=3)
    with pytest.raises(CallError, match=r"Request\(\): missing a required.* call Request\(trials, max_steps"):
        Request()
    with pytest.raises(CallError, match=r"prepare\(\) has no argument 'timeout'; did you mean 'timeout_s'"):
        crashhunt.prepare("h", 1, 1, 1, timeout=3)


def test_options_of_python_become_a_request():
    request = Request(
        agent="a:B", agents=None, arguments={"x": True, "y": 2}, scenario_arguments=None, trials=1, max_steps=2,
        parallel=3,
    )  # fmt: skip
    assert request.agents == request.locators == {"": "a:B"}
    assert replace(request, trials=4).agents == {"": "a:B"}  # the form of the command line is not changed again
    assert request.arguments == {"x": "true", "y": "2"}
    assert request.run.parallel == 3
