from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from crashhunt.scenario import copy_shipped_scenario, load_scenario, shipped_folder, shipped_scenarios

ROOT = Path(__file__).parents[2]


def test_agents_are_listed_with_arguments_ranges_and_units(shell):
    agents = {entry["name"]: entry for entry in shell.crashhunt("list", "agents", "--json").json["agents"]}
    assert {"car-following", "keep-lane", "lane-changer", "random", "recorded"} <= set(agents)
    (speed,) = agents["keep-lane"]["arguments"]
    assert speed == {
        "name": "speed",
        "kind": "float",
        "default": 15.0,
        "range": "5.0:30.0",
        "unit": "m/s",
        "help": "held for ever",
    }
    text = shell.crashhunt("list", "agents").out
    assert all(entry["locator"] in text and entry["title"] in text for entry in agents.values())


def test_every_listed_scenario_states_what_it_is(shell):
    scenarios = shell.crashhunt("list", "scenarios", "--json").json["scenarios"]
    assert {entry["name"] for entry in scenarios} == set(shipped_scenarios())  # each of which test_scenarios hunts
    for entry in scenarios:
        assert entry["title"]
        assert entry["arguments"]


@pytest.mark.parametrize("name", shipped_scenarios())
def test_copied_scenario_needs_no_file_of_the_package(name, tmp_path):
    copy_shipped_scenario(name, tmp_path / "mine")
    mine = load_scenario(str(tmp_path / "mine"))
    assert mine.title == load_scenario(name).title
    named = [value for setup in mine.agents.values() for value in setup.arguments.values()]
    assert str(shipped_folder()) not in str([mine, named])


def test_copy_of_a_scenario_is_refused_with_the_fix(shell):
    assert "mine has the files of loop" in shell.crashhunt("list", "scenarios", "--copy", "loop", "mine").out
    assert (
        shell.crashhunt("list", "scenarios", "--copy", "loop", "more", "--json").json["scenarios"][0]["name"] == "loop"
    )
    assert (
        "not empty; give a new folder" in shell.crashhunt("list", "scenarios", "--copy", "loop", "mine", expect=2).err
    )
    assert "did you mean 'loop'?" in shell.crashhunt("list", "scenarios", "--copy", "lop", "new", expect=2).err
    assert not (shell.folder / "new").exists()


def test_list_without_a_kind_names_the_entries_of_every_kind(shell):
    found = shell.crashhunt("list", "--json").json
    assert [*found] == ["actions", "agents", "disturbances", "observations", "oracles", "requirements", "scenarios"]
    *lines, more = shell.crashhunt("list").out.splitlines()
    assert lines == [f"{kind}: {', '.join(entry['name'] for entry in entries)}" for kind, entries in found.items()]
    assert "crashhunt list agents" in more


@pytest.mark.parametrize("kind", ["agents", "disturbances"])
def test_commands_of_earlier_versions_are_aliases_of_list(shell, kind):
    assert shell.crashhunt(kind, "--json").json == shell.crashhunt("list", kind, "--json").json
    lines = shell.crashhunt("--help").out.splitlines()
    indented = next(line for line in lines if line.split()[:1] == ["list"]).partition("list")[0]
    assert not any(line.startswith(f"{indented}{kind} ") for line in lines)


def test_list_refuses_an_unknown_kind_and_the_copy_of_anything_but_a_scenario(shell):
    unknown = shell.crashhunt("list", "agent", expect=2).err
    assert "WHAT 'agent' is none of its choices; did you mean 'agents'?" in unknown
    assert "run crashhunt list scenarios --copy loop x" in shell.crashhunt("list", "--copy", "loop", "x", expect=2).err


def test_networks_are_what_their_sources_say():
    done = subprocess.run(
        [ROOT / "scripts" / "tools" / "networks", "--check"], capture_output=True, text=True, check=False
    )
    if "netconvert is missing" in done.stderr:
        pytest.skip("netconvert is not installed")
    assert (done.returncode, done.stderr) == (0, "")
