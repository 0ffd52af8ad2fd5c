"""The descriptors of the simulators that come with crashhunt, and what is made of one that is broken."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from crashhunt.errors import PluginError, ScenarioError
from crashhunt.gym._descriptor import GymSetup
from crashhunt.highway._descriptor import HighwaySetup
from crashhunt.scenario import (
    AgentSetup,
    Backend,
    Scenario,
    _load,
    backend_of,
    load_scenario,
    scenario_from_dict,
    shipped_folder,
)
from crashhunt.scenario._scenario import backend_names
from crashhunt.sumo import SumoSetup
from crashhunt.testing import BackendContract


class TestSumo(BackendContract):
    @pytest.fixture
    def name(self):
        return "sumo"

    @pytest.fixture
    def scenario(self):
        return shipped_folder() / "merge"


class TestHighway(BackendContract):
    @pytest.fixture
    def name(self):
        return "highway"

    @pytest.fixture
    def scenario(self):
        return shipped_folder() / "merge-highway-env"


class _Written(BackendContract):
    said = ""

    @pytest.fixture
    def scenario(self, tmp_path, name):
        folder = tmp_path / "written"
        folder.mkdir()
        (folder / "scenario.toml").write_text(f'schema = 1\nsimulator = "{name}"\n[agents.ego]\n{self.said}')
        return folder


class TestGym(_Written):
    said = '[gym]\nid = "CartPole-v1"\n[gym.kwargs]\nsutton_barto_reward = true\n[gym.crash]\ntermination = true\n'

    @pytest.fixture
    def name(self):
        return "gym"


class TestToy(_Written):
    @pytest.fixture
    def name(self):
        return "toy"


def test_what_comes_with_crashhunt_is_found_without_entry_points(monkeypatch):
    monkeypatch.setattr("crashhunt.scenario._scenario._plugin_backends", dict)
    assert {"gym", "highway", "sumo", "toy"} <= set(backend_names())
    assert backend_of("a.module:Simulator") is None


class Point:
    def __init__(self, value):
        self.value = value


@pytest.mark.parametrize(
    ("target", "says"),
    [
        (
            "crashhunt.base.layout:SCENARIO",
            "the backend 'other' is a str, not a Backend; make it a crashhunt.scenario.Backend",
        ),
        ("crashhunt.base.layout:SCENARIOS", "has no attribute 'SCENARIOS'; did you mean 'SCENARIO'?"),
        ("no_such_module:BACKEND", "'other' cannot be imported: No module named 'no_such_module'"),
    ],
)
def test_a_broken_backend_is_an_error_where_it_is_asked_for_and_nowhere_else(monkeypatch, target, says):
    from crashhunt.scenario import installed_backends

    monkeypatch.setattr("crashhunt.scenario._scenario._plugin_backends", lambda: {"other": Point(target)})
    with pytest.raises(PluginError) as caught:
        backend_of("other")
    assert says in str(caught.value)
    with pytest.raises(PluginError):
        scenario_from_dict({"other": {}}, where="here", folder=Path())
    assert "other" not in dict(installed_backends())
    assert load_scenario("loop").backend.title == "SUMO"


def test_a_table_that_is_no_dataclass_is_refused():
    with pytest.raises(TypeError, match="must be a dataclass, but <class 'dict'> is not"):
        Backend(table=dict)


def test_a_simulator_of_your_own_may_have_the_tables_of_those_that_are_known():
    scenario = scenario_from_dict(
        {"simulator": "mine:Simulator", "sumo": {"net": "n.net.xml"}, "highway": {"id": "merge-v0"}},
        where="here", folder=Path("/there"),
    )  # fmt: skip
    assert list(scenario.backends) == ["sumo", "highway"]
    assert scenario.table(SumoSetup).net == "n.net.xml"
    assert scenario.table(HighwaySetup).id == "merge-v0"
    assert list(scenario.files()) == ["n.net.xml"]
    assert list(scenario.modules()) == ["mine"]
    with pytest.raises(ScenarioError, match=r"the scenario has no \[GymSetup\] table"):
        scenario.table(GymSetup)


@dataclass(frozen=True, kw_only=True)
class RoadSetup:
    friction: float = 1.0


@pytest.mark.parametrize(("given", "friction"), [({}, 1.0), ({"mine": {"friction": 0.5}}, 0.5)])
def test_table_without_required_keys_may_be_missing(monkeypatch, given, friction):
    monkeypatch.setattr(_load, "backend_of", {"mine": Backend(table=RoadSetup)}.get)
    scenario = scenario_from_dict({"simulator": "mine", **given}, where="here", folder=Path())
    assert scenario.table(RoadSetup).friction == friction


def test_a_table_that_is_missing_is_called_as_it_is_in_the_file():
    with pytest.raises(ScenarioError, match=r"the scenario has no \[gym\] table; add it"):
        Scenario(simulator="gym", agents={"ego": AgentSetup()}).table(GymSetup)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ('simulator = "toy"\n[sumo]\nnet = "x"\n', "'toy' has no use for the table [sumo]; remove it"),
        ('simulator = "toy"\n[toy]\n', "unknown key 'toy'"),
        ("[tables]\n", "unknown key 'tables'; the keys here are title, simulator, "),
        ('simulator = "mysim"\n[mysim]\na = 1\n', "simulator = 'mysim' is not registered; give one of gym, "),
        ("[sumoo]\n", "unknown key 'sumoo'; did you mean 'sumo'?"),
        ("simulator = []\n", "simulator = []: "),
        ("sumo = 3\n", "sumo = 3: "),
        ("[sumo]\nnet = 3\n", "sumo.net = 3: "),
    ],
)
def test_a_table_of_no_one_is_refused(tmp_path, changes, says):
    (tmp_path / "scenario.toml").write_text(f"schema = 1\n{changes}")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(tmp_path)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "notes" not in str(caught.value)  # nor what is no key of a file


def test_what_ran_before_with_a_table_that_no_one_used_still_runs(tmp_path):
    shutil.copytree(shipped_folder() / "highway", tmp_path / "s")
    file = tmp_path / "s" / "scenario.toml"
    file.write_text('schema = 1\nsimulator = "toy"\n[agents.ego]\n[sumo]\nnet = "gone.net.xml"\n')
    assert list(load_scenario(file, kept=True).files()) == []
