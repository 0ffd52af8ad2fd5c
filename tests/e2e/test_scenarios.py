"""Every shipped scenario has a crash, which is replayed and filmed; on some, all else is done with it too.

By day it is one of highway-env's, by night all are. With one of SUMO's, loop, the README's commands do
the same by day; by night, pages of the guide hunt in merge, highway-policy and motorway. The contracts drive in
loop-two-agents, intersection and all of highway-env's.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from conftest import mostly_nightly

from crashhunt.crashes import list_bundles, names_of_actions
from crashhunt.report import player_data
from crashhunt.scenario import shipped_scenarios

SEEDS = {  # with which a crash comes soon
    "highway": 3,
    "highway-policy": 5,
    "intersection": 4,
    "intersection-highway-env": 4,
    "intersection-two-agents": 4,
    "loop": 1,
    "merge": 7,
    "motorway": 6,
    "roundabout": 2,
}


ALWAYS = ("highway",)


@pytest.mark.long
@pytest.mark.parametrize("scenario", mostly_nightly(sorted(shipped_scenarios()), ALWAYS))
def test_a_crash_of_it_is_found_replayed_and_filmed(shell, scenario):
    seed = str(SEEDS.get(scenario, 1))
    words = ("--scenario", scenario, "--seed", seed, "--deterministic")
    found = shell.crashhunt("run", "h", "2", "400", "500", *words, "--json").json
    (crash,) = found["crashes"]
    assert crash["confirmed"]
    frames = ("--frames", "f", "--last-seconds", "1", "--size", "160x120", "--json")
    replayed = shell.crashhunt("replay", "h", *frames).json
    assert replayed["verdict"] == "reproduced"
    assert replayed["written"]["f"] in (21, 16, 12)  # steps of 0.1, 0.2 and 1 s, and the last one again
    for who in {"loop": (("--code", "current"), ("--from-log",)), "intersection-two-agents": (("--from-log",),)}.get(
        scenario, ()
    ):
        assert shell.crashhunt("replay", "h", *who, "--json").json["verdict"] == "reproduced"
    if scenario not in ("loop", "highway"):
        return
    if scenario == "loop":  # by day, tests/e2e/test_export.py
        shell.crashhunt("export", "h", "crash.zip")
        assert shell.crashhunt("replay", "crash.zip", "--json").json["digest_replayed"] == crash["digest"]
    shown = shell.crashhunt("show", "h").out
    assert f"step {crash['step']}" in shown
    if scenario == "highway":  # the log has the number of an action, and people read its name
        (bundle,) = list_bundles(shell.folder / "h")
        words = names_of_actions(bundle, "ego")
        assert words == ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
        last = int(bundle.recording().all_steps[-1].actions["ego"].item())
        assert shown[shown.rindex(f"\n{crash['step']:4} ") :].split()[3] == words[last]
        assert player_data(bundle)["actionWords"] == words
    shell.crashhunt("report", "h")
    assert crash["id"] in (shell.folder / "h/report.html").read_text(encoding="utf-8")


def test_a_mistake_in_a_highway_scenario_is_one_line(shell):
    for table, says in (
        ('step_length_s = 0.5\n[highway]\nid = "highway-v0"', "policy_frequency"),
        ('[sumo]\nnet = "x.net.xml"', "add a table [highway]"),
    ):
        (shell.folder / "scenario.toml").write_text(f'schema = 1\nsimulator = "highway"\n{table}\n')
        done = shell.crashhunt("run", "h", "1", "1", "5", "--scenario", ".", expect=2)
        assert says in done.err
        assert len(done.err.strip().splitlines()) == 1
        assert "snapshots" not in done.err  # the file to mend is the one that was given


STRANGE = [
    ('simulator = "gym"\n[gym]\nid = "evil:make"', "evil"),
    (
        'simulator = "highway"\n[highway]\nid = "highway-fast-v0"\nconfig = { other_vehicles_type = "evil.Car" }',
        "evil.Car",
    ),
]


@pytest.mark.parametrize(("table", "says"), STRANGE)
def test_what_a_stranger_made_imports_nothing_even_from_its_log(table, says):
    from crashhunt.crashes import refuse_side_effects
    from crashhunt.errors import UsageError
    from crashhunt.plans import Request, plan
    from crashhunt.scenario import Scenario, scenario_from_dict

    _, settings = plan(Request(trials=1, max_steps=1, scenario="highway", seed=1))
    scenario = scenario_from_dict(tomllib.loads(table), where="x", folder=Path())
    assert isinstance(scenario, Scenario)
    with pytest.raises(UsageError, match=says):
        refuse_side_effects(scenario, settings, {})
