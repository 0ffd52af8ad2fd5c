"""A simulator of somebody else's, in a distribution of its own: its table, files and versions count as ours do."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

BACKEND = '''
"""Nothing here imports the simulator."""

from dataclasses import dataclass
from pathlib import Path

from crashhunt.errors import ScenarioError
from crashhunt.scenario import AgentSetup, Backend, Configuration, ObservationSetup, Scenario


@dataclass(frozen=True, kw_only=True)
class RoadSetup:
    road: str
    friction: float = 1.0


def check(scenario, where):
    friction = scenario.table(RoadSetup).friction
    if not 0 < friction <= 1:
        raise ScenarioError(f"mysim.friction = {friction!r} is none", fix="give 0 to 1", where=where)


def load(path, ego):
    return Scenario(
        simulator="mysim", name=path.stem, folder=path.resolve().parent, file=path.name,
        observation=ObservationSetup(), agents={ego or "ego": AgentSetup()},
        tables={"mysim": RoadSetup(road=path.name)}, notes=(f"{path.name}, as it is",),
    )


BACKEND = Backend(
    title="My simulator",
    table=RoadSetup,
    example="a road",
    keys=frozenset(),
    check=check,
    files=lambda scenario: [scenario.table(RoadSetup).road],
    notes=lambda scenario: [f"the road is {scenario.table(RoadSetup).road}"],
    versions=("mysim-engine",),
    variables=("MYSIM_HOME",),
    reported_events=(),
    configurations=(Configuration(endings=(".road",), load=load),),
)
'''

SIMULATOR = '''
"""The toy on a road of its own, which says how far it is to the leader."""

from crashhunt.simulators.toy import ToySimulator

from mysim.backend import RoadSetup


class MySimulator(ToySimulator):
    def __init__(self, scenario, stage):
        super().__init__(scenario, stage)
        self._gap = float((scenario.folder / scenario.table(RoadSetup).road).read_text())

    def reset(self, *, seed, options=None):
        arguments = {"gap_m": self._gap, **(options or {}).get("arguments", {})}
        return super().reset(seed=seed, options={"arguments": arguments})
'''

SCENARIO = """
schema = 1
simulator = "mysim"
[agents.ego]
agent = "keep-lane"
[agents.ego.arguments.speed]
default = 20.0
[mysim]
road = "roads/short.road"
"""


@pytest.fixture
def mysim(shell):
    """A folder of installed distributions, a simulator among them, and a scenario for it."""
    installed = shell.folder / "installed" / "site-packages"
    package, about = installed / "mysim", installed / "mysim_engine-2.5.dist-info"
    package.mkdir(parents=True)
    about.mkdir()
    (package / "__init__.py").write_text("")
    (package / "backend.py").write_text(BACKEND)
    (package / "simulator.py").write_text(SIMULATOR)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mysim-engine\nVersion: 2.5\n\n")
    (about / "RECORD").write_text("mysim/__init__.py,,\nmysim/backend.py,,\nmysim/simulator.py,,\n")
    (about / "entry_points.txt").write_text(
        "[crashhunt.simulators]\nmysim = mysim.simulator:MySimulator\n"
        "[crashhunt.backends]\nmysim = mysim.backend:BACKEND\n"
    )
    (shell.folder / "town" / "roads").mkdir(parents=True)
    (shell.folder / "town" / "scenario.toml").write_text(SCENARIO)
    (shell.folder / "town" / "roads" / "short.road").write_text("25")
    (shell.folder / "town" / "bystander.txt").write_text("nobody reads it")
    shell.environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(installed), os.environ.get("PYTHONPATH"))))
    shell.environment["XDG_STATE_HOME"] = str(shell.folder / "state")
    shell.environment["MYSIM_HOME"] = "/opt/mysim"
    return shell


def installed(shell) -> Path:
    return shell.folder / "installed" / "site-packages"


@pytest.mark.nightly
def test_its_table_files_and_versions_are_those_of_the_hunt_and_its_crash_is_replayed(mysim):
    hunt = mysim.crashhunt("run", "h", "1", "3", "200", "--scenario", "town", "--seed", "1", "--json")
    assert "the road is roads/short.road" in hunt.err
    (crash,) = hunt.json["crashes"]
    assert crash["outcome"] == "collision"
    assert crash["confirmed"]
    (snapshot,) = (mysim.folder / "h" / "snapshots").iterdir()
    kept = {str(file.relative_to(snapshot / "scenario")) for file in (snapshot / "scenario").rglob("*.*")}
    assert kept == {"scenario.toml", "roads/short.road"}
    environment = json.loads((snapshot / "environment.json").read_text())
    assert environment["versions"]["mysim-engine"] == "2.5"
    assert "mysim-engine" in environment["loaded"]
    assert environment["variables"]["MYSIM_HOME"] == "/opt/mysim"

    (mysim.folder / "town" / "roads" / "short.road").write_text("900")  # which is not the road that was hunted on
    assert mysim.crashhunt("replay", "h", "--json").json["verdict"] == "reproduced"

    about = installed(mysim) / "mysim_engine-2.5.dist-info"
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mysim-engine\nVersion: 3.0\n\n")
    simulator = installed(mysim) / "mysim" / "simulator.py"
    simulator.write_text(simulator.read_text().replace("self._gap =", "self._gap = 3 +"))
    other = mysim.crashhunt("replay", "h", "--json", expect=1).json
    assert other["verdict"] == "not_comparable"
    assert other["reason"] == "the simulator differs: mysim-engine was 2.5 and is 3.0"

    exported = str(mysim.folder / "crash.zip")
    mysim.crashhunt("export", "h", exported)
    mysim.environment["XDG_STATE_HOME"] = str(mysim.folder / "of somebody else")  # whom this user does not know
    refused = mysim.crashhunt("replay", exported, "--from-log", expect=2)
    assert "the side effects of the simulator 'mysim' are unknown; give --trust" in refused.err


def test_mistakes_are_reported_in_one_line(mysim):
    file = mysim.folder / "town" / "scenario.toml"
    for said, instead, says in (
        ("road =", "rod =", "unknown key 'mysim.rod'; did you mean 'road'?"),
        ('road = "roads/short.road"', "", "the key 'mysim.road' is missing; add it"),
        ("[mysim]", "[mysin]", "unknown key 'mysin'; did you mean 'mysim'?"),
        ("short.road", "long.road", "mysim = 'roads/long.road' does not exist"),
        ("roads/short.road", "../faulty.py", "mysim = '../faulty.py' lies outside the scenario's folder"),
        ("[mysim]", "[mysim]\nfriction = 3.0", "mysim.friction = 3.0 is none; give 0 to 1"),
        ('agent = "keep-lane"', 'route = "x"', "agents.ego.route = 'x' is for SUMO; remove it"),
    ):
        file.write_text(SCENARIO.replace(said, instead))
        done = mysim.crashhunt("run", "h", "1", "1", "9", "--scenario", "town", expect=2)
        assert says in done.err
        assert len(done.err.splitlines()) == 1
        assert not (mysim.folder / "h").exists()


def test_a_configuration_of_its_own_is_run_as_it_is(mysim):
    words = ("1", "1", "200", "--scenario", "town/roads/short.road", "--ego", "me", "--arg", "speed=20")
    hunt = mysim.crashhunt("run", "h", *words, "--seed", "1", "--json")
    assert "short.road, as it is" in hunt.err
    (crash,) = hunt.json["crashes"]
    assert list(crash["arguments"]) == ["me"]
    assert crash["confirmed"]
    near = mysim.crashhunt("run", "g", "1", "1", "9", "--scenario", "town/roads/shor.road", expect=2)
    assert "did you mean 'town/roads/short.road'?" in near.err
    assert "scenario.toml, *.sumocfg, *.osm, *.xodr or *.road" in near.err


def test_without_it_what_is_missing_is_the_simulator(mysim):
    del mysim.environment["PYTHONPATH"]
    done = mysim.crashhunt("run", "h", "1", "1", "9", "--scenario", "town", expect=2)
    assert "simulator = 'mysim' is not registered" in done.err
