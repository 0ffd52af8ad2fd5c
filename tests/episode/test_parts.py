"""What a trial is put together from, and where it may come from."""

from __future__ import annotations

import importlib.util
import os
import random
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.plugins import CurrentFolder, locate
from crashhunt.episode import Parts, WorkerSettings, _parts, require_origin, seal
from crashhunt.scenario import load_scenario
from crashhunt.simulators import ObservationLayout, parse_parts
from crashhunt.trial import CallSignature

AGENT = """
import random
drawn = random.random()
class Driver:
    libraries = ("no_such_library", "colorsys")
    def __init__(self, observation_space, action_space, step_length_s, weights="", speed=1.0):
        self.given = observation_space, action_space, step_length_s, weights, speed
    def reset(self, seed): pass
    def act(self, observation): return self.given[-1], 0
class Plain:
    def __init__(self, speed=1.0):
        self.speed = speed
"""
TOY = """
title = "A toy"
schema = 1
simulator = "toy"
step_length_s = 0.25
[agents.ego]
agent = "{module}:Driver"
[agents.second]
agent = "{module}:Plain"
"""


@pytest.fixture
def made(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "meta_path", [one for one in sys.meta_path if not isinstance(one, CurrentFolder)])
    # Later tests in this process replace functions of crashhunt, which is then taken for an agent's doing.
    monkeypatch.setattr(_parts, "record_originals", lambda: None)
    before = set(sys.modules)

    def make(module="snapshot_agent", **more):
        code = tmp_path / "code"
        for folder in (code, tmp_path / "scratch", tmp_path / "scenario"):
            folder.mkdir(exist_ok=True)
        (code / f"{module}.py").write_text(AGENT)
        (tmp_path / "scenario" / "scenario.toml").write_text(TOY.format(module=module))
        scenario = load_scenario(tmp_path / "scenario" / "scenario.toml")
        settings = {"oracles": ("overlap",), "crash_on": (), "scratch": tmp_path / "scratch", "code": (str(code),)}
        return Parts(WorkerSettings(scenario=scenario, **{**settings, **more}))

    yield make
    for name in set(sys.modules) - before:
        if name in ("snapshot_agent", "elsewhere_agent"):
            del sys.modules[name]


def test_agents_are_given_what_they_ask_for(made):
    parts = made(argument_files={"w.npz": "/snapshot/files/w.npz"})
    simulator = parts.simulator()
    driver = parts.agent("ego", simulator, {"weights": "w.npz", "speed": 2.5})
    space, action, step_s, weights, speed = driver.given
    assert space == simulator.observation_spaces["ego"]
    assert action == simulator.actions["ego"].space
    assert (step_s, weights, speed) == (0.25, "/snapshot/files/w.npz", 2.5)
    assert parts.agent("ego", simulator, {"weights": "other"}).given[3:] == ("other", 1.0)
    assert parts.agent("second", simulator, {"speed": 3}).speed == 3
    simulator.shown_spaces = {"ego": "as it is meant"}
    assert parts.agent("ego", simulator, {}).given[0] == "as it is meant"
    assert type(parts.agent("ego", simulator, {})) is type(driver)


def test_agent_that_changes_its_columns_changes_only_its_own(made):
    parts = made()
    parts._factories["ego"] = dict, CallSignature({}, open=True, given=("columns",))
    simulator = parts.simulator()
    simulator.observation_layouts = {"ego": ObservationLayout(parse_parts(("ego",), where=""))}
    parts.agent("ego", simulator, {})["columns"]["ego"].clear()
    assert parts.agent("ego", simulator, {})["columns"]["ego"]["heading"] == 2


def test_agent_is_given_the_masks_of_its_simulator(made):
    parts = made()
    parts._factories["ego"] = dict, CallSignature({}, open=True, given=("action_masks",))
    simulator = parts.simulator()
    assert parts.agent("ego", simulator, {}) == {"action_masks": None}
    simulator.action_mask = lambda agent: f"mask of {agent}"
    assert parts.agent("ego", simulator, {})["action_masks"]() == "mask of ego"


def test_notices_are_read_from_agents_of_crashhunt_only(made):
    parts = made()
    for module in ("crashhunt.agents.some", "mine"):
        parts._factories["ego"] = (
            type("Policy", (), {"__module__": module, "notices": [module]}),
            CallSignature({}, open=False, given=()),
        )
        parts.agent("ego", parts.simulator(), {})
    assert [agent.notices for agent in parts.reporting_agents] == [["crashhunt.agents.some"]]


def test_the_snapshot_comes_before_where_the_hunt_was_started(made, tmp_path):
    parts = made()
    assert sys.path[0] == str(tmp_path / "code")
    for name in ("only_here", "snapshot_agent", "torch"):
        (tmp_path / f"{name}.py").write_text("")
    assert importlib.util.find_spec("only_here").origin == str(tmp_path / "only_here.py")
    assert importlib.util.find_spec("torch") is None or "site-packages" in importlib.util.find_spec("torch").origin
    assert locate("agents", "snapshot_agent:Driver").__module__ == "snapshot_agent"
    assert sys.modules["snapshot_agent"].__file__ == str(tmp_path / "code" / "snapshot_agent.py")
    (oracle,), (another,) = parts.oracles(), parts.oracles()
    assert oracle.name == "overlap"
    assert oracle is not another  # what one remembers of a trial is nobody's business in the next
    assert [path.name for path in (tmp_path / "scratch").iterdir()] == []
    parts.simulator()
    (stage,) = (tmp_path / "scratch").iterdir()
    assert stage.name.startswith("stage-")
    parts.simulator()  # the folder is used again


def test_what_modules_draw_when_they_are_imported_is_always_the_same(made):
    parts = made()
    random.seed(99)
    parts.load()
    assert "colorsys" in sys.modules
    drawn = sys.modules["snapshot_agent"].drawn
    random.seed(0)
    assert drawn == random.random()


def test_a_module_of_the_snapshot_may_come_from_nowhere_else(made, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "elsewhere_agent.py").write_text(AGENT)
    sys.path.insert(0, str(elsewhere))
    __import__("elsewhere_agent")
    parts = made("elsewhere_agent")
    with pytest.raises(CrashhuntError, match=r"imported from .*elsewhere_agent.py, not from the snapshot") as caught:
        parts.load()
    assert caught.value.where == str(tmp_path / "code")
    require_origin("elsewhere_agent", ())
    require_origin("elsewhere_agent", (str(elsewhere),))
    require_origin("elsewhere_agent", (str(tmp_path),))  # which does not have it
    with pytest.raises(CrashhuntError, match="not from the snapshot"):
        require_origin("elsewhere_agent", (str(tmp_path / "other"), str(tmp_path / "code")))
    require_origin("elsewhere_agent", (str(tmp_path), str(tmp_path / "code")))  # a submodule has a copy in each project
    package = tmp_path / "packages" / "elsewhere_agent"
    package.mkdir(parents=True)
    with pytest.raises(CrashhuntError, match="not from the snapshot"):
        require_origin("elsewhere_agent", (str(package.parent),))
    sys.modules["elsewhere_agent"].__file__ = None  # as a namespace has none
    require_origin("elsewhere_agent", (str(package.parent),))


def test_a_strangers_code_is_confined_to_its_scratch_folder(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(_parts, "confine", lambda folder, readable: asked.append((folder, list(readable))))
    monkeypatch.setattr(os, "environ", dict(os.environ))
    monkeypatch.chdir(tmp_path)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    scenario = replace(load_scenario("loop"), folder=tmp_path / "scenario")
    settings = WorkerSettings(scenario=scenario, oracles=(), crash_on=(), scratch=scratch)
    before = dict(os.environ)
    seal(settings)  # our own code works where it was started, with what it was given
    assert (Path.cwd(), os.environ, asked) == (tmp_path, before, [])
    for _ in range(2):  # the next worker finds the folder
        seal(replace(settings, sealed=("/code", "/files")))
    home = scratch / "home"
    assert Path.cwd() == home
    assert os.environ == {**before, "HOME": str(home), "TMPDIR": str(home)}
    assert asked == [(scratch, [tmp_path / "scenario", "/code", "/files"])] * 2
