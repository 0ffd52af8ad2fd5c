"""Whose fault a failure is: a table of places and parties, in which every cell is provoked for real."""

from __future__ import annotations

import importlib
import os
import re
import sys

import numpy as np
import pytest

from crashhunt.base import layout
from crashhunt.base.foreign_code import ForeignError
from crashhunt.episode import Episode, Nearness, Parts, Recorder, WorkerSettings, _failures, run_episode
from crashhunt.episode._blame import guarded_check, guarded_step
from crashhunt.episode._fast_path import FastPath
from crashhunt.errors import InternalError, RecorderError, ScenarioError, UnusableValueError
from crashhunt.gym import GymSimulator
from crashhunt.oracles import ReportedCollision
from crashhunt.recording import BlackBox
from crashhunt.scenario import AgentSetup, Scenario, argument_values, load_scenario, scenario_from_dict
from crashhunt.simulators.toy import ToySimulator
from crashhunt.sumo import SumoSimulator
from crashhunt.trial import CRASHES, UNUSABLE_VALUE, TrialSpec

# Modules of a user's: an environment, an agent, an oracle, a simulator. `fails` says where each of them goes wrong.

ENVIRONMENT = """
import gymnasium
import numpy as np
from gymnasium import spaces

fails = ""
listeners = []


def fail(place):
    if fails == place:
        raise KeyError("of the environment")


class Refusing(dict):
    def refuse(self, *_):
        fail("info")
        return 0

    get = __getitem__ = __contains__ = items = refuse


class Word(gymnasium.Space):
    def __init__(self):
        super().__init__(None, None)

    def sample(self, mask=None, probability=None):
        return "go"

    def contains(self, x):
        fail(f"contains {x}")
        return isinstance(x, str)

    @property
    def is_np_flattenable(self):
        raise NotImplementedError


class Env(gymnasium.Env):
    action_space = spaces.Dict({"word": Word(), "turn": spaces.Box(-1, 1, (), np.float32)})

    def __init__(self):
        fail("constructor")
        self.observation_space = spaces.Dict({"x": spaces.Box(-1, 1, (2,), np.float32), "side": spaces.Discrete(2)})
        if fails.startswith("contains"):
            self.observation_space = spaces.Dict({"x": spaces.Box(-1, 1, (2,), np.float32), "word": Word()})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        fail("reset")
        return self.look(), {}

    def look(self):
        if fails == "shape" or (fails == "later shape" and self.steps == 2):
            return {"x": np.zeros(3, np.float32), "side": 0}
        if "word" in self.observation_space.spaces:
            return {"x": np.zeros(2, np.float32), "word": "see"}
        return {"x": np.zeros(2, np.float32), "side": 2 if fails == "side" else 0}

    def step(self, action):
        assert isinstance(action["word"], str)
        self.steps += 1
        for tell in listeners:
            tell()
        if self.steps == 2:
            fail("step")
            if fails == "exit":
                raise SystemExit(3)
            if fails == "four":
                return self.look(), 0.0, False, {}
        reward = "much" if fails == "reward" else 0.0
        info = {"no info": None, "info": Refusing(bad=0)}.get(fails, {"bad": 0})
        return self.look(), reward, False, False, info

    def close(self):
        fail("close")


def rule(observation, reward, terminated, truncated, info):
    fail("rule")
"""
AGENT = """
import numpy as np
import place_environment

fails = ""


def fail(place):
    if fails == place:
        raise ValueError("of the agent")


class Thing:
    def __array__(self, *_, **__):
        fail("array")
        raise SystemExit(4)

    def __repr__(self):
        fail("repr")
        return "thing"

    def __reduce_ex__(self, protocol):
        fail("reduce")
        raise SystemExit(5)


class Agent:
    def __init__(self):
        fail("constructor")

    def reset(self, seed):
        fail("reset")

    def act(self, observation):
        assert observation["x"].shape == (2,)
        fail("act")
        if fails == "listener":
            place_environment.listeners.append(lambda: fail("listener"))
        if fails in ("array", "array exits"):
            return {"word": "go", "turn": Thing()}
        if fails in ("repr", "reduce", "reduce exits"):
            return Thing()
        if fails == "outside":
            return {"word": "go", "turn": np.float32(7)}
        if fails == "look":  # a function of crashhunt's is replaced by one of the agent's
            from crashhunt.gym import GymSimulator
            GymSimulator._look = lambda *_: fail("look")
        return {"word": "go", "turn": np.array(0.5, np.float32)}

    def close(self):
        fail("close")


class Driver:
    def __init__(self, **_):
        pass

    def reset(self, seed):
        pass

    def act(self, observation):
        return 5.0, 0
"""
OTHERS = """
from crashhunt.simulators.toy import ToySimulator

fails = ""


def fail(place):
    if fails == place:
        raise LookupError("of another")


class Oracle:
    name = "mine"

    def __init__(self):
        pass

    def check(self, scene, agents):
        if scene.time_s > 0.15:
            fail("check")
            return {"garbage": ["nothing"], "number": 5}.get(fails, [])
        return []

    def see_map(self, lanes):
        fail("see_map")

    def close(self):
        fail("close")


class Form:
    def __init__(self, form):
        self.form, self.space, self.names, self.calls = form, form.space, form.names, 0

    def encode(self, action):
        self.calls += 1
        fail("encode" if self.calls > 3 else "first encode")
        return self.form.encode(action)


class Simulator(ToySimulator):
    def reset(self, **options):
        fail("reset")
        found = super().reset(**options)
        self.actions = {name: Form(form) for name, form in self.actions.items()}
        return ("nothing", {}) if fails == "reset garbage" else found

    def step(self, actions):
        fail("step")
        found = super().step(actions)
        shown, rewards, *rest = found
        wrong = {"garbage": None, "list": ({"ego": [1.0]}, rewards, *rest), "reward": (shown, {"ego": "x"}, *rest)}
        return wrong.get(fails, found)

    def close(self):
        super().close()
        fail("close")

    def scene(self):
        fail("scene")
        if self._step > 1:
            fail("later scene")
        return "a picture" if fails == "no scene" else super().scene()
"""
FOREIGN = {"environment": "place_environment", "agent": "place_agent", "other": "place_others"}


@pytest.fixture
def modules(tmp_path, monkeypatch):
    """The modules of the user's, by party."""
    folder = tmp_path / "users"
    folder.mkdir()
    for name, text in zip(FOREIGN.values(), (ENVIRONMENT, AGENT, OTHERS), strict=True):
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(_failures, "_originals", [])
    yield {party: importlib.import_module(name) for party, name in FOREIGN.items()}
    for name in FOREIGN.values():
        sys.modules.pop(name, None)


def gym(tmp_path):
    table = {
        "simulator": "gym",
        "gym": {"id": "place_environment:Env", "crash": {"function": "place_environment:rule"}, "danger": "info.bad"},
        "agents": {"ego": {"agent": "place_agent:Agent"}},
    }
    return GymSimulator(scenario_from_dict(table, where="here", folder=tmp_path), tmp_path)


def toy(tmp_path, kind=ToySimulator):
    agents = {"ego": AgentSetup(agent="place_agent:Driver")}
    return kind(Scenario(simulator="toy", agents=agents), tmp_path)


def run(tmp_path, simulator, oracles=None, observers=(), values=None):
    agents = {"ego": AgentSetup(agent=f"place_agent:{'Agent' if isinstance(simulator, GymSimulator) else 'Driver'}")}
    scenario = Scenario(simulator="toy", agents=agents)
    settings = WorkerSettings(scenario=scenario, scratch=tmp_path, oracles=(), crash_on=CRASHES)
    oracles = [ReportedCollision()] if oracles is None else oracles
    box = BlackBox(tmp_path / "box")
    box.begin(pid=0, trial=0, started=0.0)
    spec = TrialSpec(0, 1, {}, values or {}, 5)
    make_agent = Parts(settings).agent
    return run_episode(spec, simulator=simulator, make_agent=make_agent, box=box, oracles=oracles, observers=observers)


def label(result):
    failure = result.failure
    if failure is None:
        return str(result.outcome), "", "", ""
    return str(result.outcome), failure.party, failure.place, failure.agent


A, E, S, O = "agent", "environment", "simulator", "oracle"  # noqa: E741
TABLE = [
    # party, place in the user's code, label: outcome, party, what was called, agent
    (A, "constructor", ("invalid", A, "constructor", "ego")),
    (A, "reset", ("invalid", A, "reset", "ego")),
    (A, "act", ("agent_error", A, "act", "ego")),
    (A, "array", ("agent_error", A, "action conversion", "ego")),
    (A, "array exits", ("agent_error", A, "action conversion", "ego")),
    (A, "repr", ("agent_error", A, "action conversion", "ego")),
    (A, "reduce", ("agent_error", A, "action conversion", "ego")),
    (A, "reduce exits", ("agent_error", A, "action conversion", "ego")),
    (A, "outside", ("agent_error", A, "action conversion", "ego")),
    (A, "listener", ("agent_error", A, "", "ego")),  # called by the environment, in its step
    (A, "close", ("survived", "", "", "")),
    (A, "look", ("agent_error", A, "", "ego")),  # in place of a function of crashhunt's
    (E, "reset", ("invalid", E, "reset", "")),
    (E, "shape", ("invalid", E, "space conversion", "")),
    (E, "later shape", ("simulator_error", E, "space conversion", "")),
    (E, "side", ("invalid", E, "space conversion", "")),
    (E, "contains {'x': array([0., 0.], dtype=float32), 'word': 'see'}", ("survived", "", "", "")),
    (E, "contains see", ("invalid", E, "space conversion", "")),
    (E, "contains go", ("simulator_error", E, "action conversion", "")),
    (E, "step", ("simulator_error", E, "step", "")),
    (E, "exit", ("simulator_error", E, "step", "")),
    (E, "four", ("simulator_error", E, "step", "")),
    (E, "reward", ("simulator_error", E, "reward", "")),
    (E, "no info", ("simulator_error", E, "step", "")),
    (E, "info", ("simulator_error", E, "info", "")),
    (E, "rule", ("simulator_error", E, "info", "")),
    (E, "close", ("survived", "", "", "")),
]


@pytest.mark.parametrize(("party", "fails", "expected"), TABLE, ids=lambda value: str(value)[:20])
def test_failure_of_an_agent_or_an_environment_is_labelled_by_the_call(
    modules, tmp_path, monkeypatch, party, fails, expected
):
    monkeypatch.setattr(GymSimulator, "_look", GymSimulator._look)
    if fails == "close":  # the environment whose spaces are read is closed at once
        modules[party].fails = fails
    simulator = gym(tmp_path)
    modules[party].fails = fails
    result = run(tmp_path, simulator)
    assert label(result) == expected
    if expected[1]:
        assert "of the" in result.failure.message or "Thing" not in result.failure.traceback
        assert result.failure.traceback or result.failure.kind in ("invalid", UNUSABLE_VALUE)
    if fails == "close" and party == E:
        assert [notice for notice in simulator.notices if notice.endswith(": KeyError: 'of the environment'")]


def test_guide_has_a_tested_row_for_each_party_and_place():
    """The table of the guide and those of these tests must have the same cells, except for `close`."""
    of_users = [(fails, expected) for _, fails, expected in TABLE]
    tested = {(party, place, outcome) for _, (outcome, party, place, _) in of_users + OF_ORACLES + OF_SIMULATORS}
    page = (layout.PACKAGE / "guide" / "reference" / "outcomes.md").read_text(encoding="utf-8")
    told, party = set(), ""
    for row in page.partition("| party | place | outcome |")[2].partition("\n\n")[0].splitlines()[2:]:
        cells = [re.findall(r"`([a-z_ ]+)`", cell) for cell in row.split("|")[1:-1]]
        party = cells[0][0] if cells[0] else party
        told |= {(party, place, outcome) for place in cells[1] for outcome in cells[2]}
    assert {cell for cell in tested if cell[1]} == told


def test_environment_that_cannot_be_made_is_a_mistake_in_the_scenario_or_an_invalid_trial(modules, tmp_path):
    simulator = gym(tmp_path)
    modules["environment"].fails = "constructor"
    assert label(run(tmp_path, simulator)) == ("invalid", E, "reset", "")
    says = r"its constructor fails at .*place_environment.py, line \d+: KeyError: 'of the environment'"
    with pytest.raises(ScenarioError, match=says):
        gym(tmp_path)


OF_ORACLES = [
    ("check", ("simulator_error", O, "check", "")),
    ("garbage", ("simulator_error", O, "check", "")),
    ("number", ("simulator_error", O, "check", "")),
    ("see_map", ("simulator_error", O, "see_map", "")),
    ("close", ("survived", "", "", "")),  # an oracle has no such method, so an episode does not call it
]


@pytest.mark.parametrize(("fails", "expected"), OF_ORACLES)
def test_failure_of_a_users_oracle_is_the_oracles(modules, tmp_path, fails, expected):
    modules["other"].fails = fails
    oracle = modules["other"].Oracle()
    assert label(run(tmp_path, toy(tmp_path), [oracle])) == expected


OF_SIMULATORS = [
    ("reset", ("invalid", S, "reset", "")),
    ("reset garbage", ("invalid", S, "reset", "")),
    ("step", ("simulator_error", S, "step", "")),
    ("garbage", ("simulator_error", S, "step", "")),
    ("list", ("simulator_error", S, "step", "")),
    ("reward", ("simulator_error", S, "step", "")),
    ("scene", ("invalid", S, "scene", "")),
    ("no scene", ("invalid", S, "scene", "")),
    ("later scene", ("simulator_error", S, "scene", "")),
    ("encode", ("simulator_error", S, "action conversion", "")),
    ("first encode", ("invalid", S, "reset", "")),
    ("close", ("survived", "", "", "")),  # the trial has ended before
]


@pytest.mark.parametrize(("fails", "expected"), OF_SIMULATORS)
def test_failure_of_a_users_simulator_is_the_simulators(modules, tmp_path, fails, expected):
    simulator = toy(tmp_path, modules["other"].Simulator)
    modules["other"].fails = fails
    assert label(run(tmp_path, simulator)) == expected


# Faults of crashhunt itself: a function that fails, in a file of crashhunt's.

BROKEN = """
def broken(*_, **__):
    raise KeyError("ours")
"""


def broken_function():
    names = {"__name__": "crashhunt.broken"}
    exec(compile(BROKEN, str(layout.PACKAGE / "broken.py"), "exec"), names)
    return names["broken"]


OURS = {
    "reset": (GymSimulator, "_look"),
    "space conversion": ("crashhunt.simulators._any_space.ObservationForm", "encode"),
    "observe": ("crashhunt.simulators._any_space.ObservationForm", "restore"),
    "action conversion": ("crashhunt.simulators._any_space._Values", "encode"),
    "native action": ("crashhunt.gym._simulator", "native"),
    "agent's arguments": (Parts, "_factory"),
    "step": (GymSimulator, "_notice"),
    "info": (GymSimulator, "_record_danger"),
    "scene": ("crashhunt.world.Scene", "follow"),
    "oracle": (ReportedCollision, "check"),
    "observer": (Nearness, "end"),
    "recorder": (Recorder, "scene"),
    "episode": (Episode, "_judge"),
}


@pytest.mark.parametrize("place", OURS)
def test_failure_of_crashhunt_itself_is_no_trials_outcome(modules, tmp_path, monkeypatch, place):
    simulator = gym(tmp_path)
    owner, name = OURS[place]
    if isinstance(owner, str):
        module, _, attribute = owner.rpartition(".")
        owner = (
            importlib.import_module(owner)
            if place == "native action"
            else getattr(importlib.import_module(module), attribute)
        )
    monkeypatch.setattr(owner, name, broken_function())
    if place == "step":  # is called for an observation outside the space only
        monkeypatch.setattr("crashhunt.simulators._any_space.ObservationForm.contains", lambda *_: False)
    with pytest.raises(InternalError) as caught:
        run(tmp_path, simulator)
    fault = caught.value
    assert fault.message.startswith("crashhunt itself failed")
    assert ("in trial 0 " in fault.message) == (place != "agent's arguments")
    assert fault.message.endswith("KeyError: 'ours'")
    assert "KeyError: 'ours'" in fault.traceback
    assert "https://github.com/crashhunt/crashhunt/issues" in fault.fix
    assert "\n" not in str(fault)


@pytest.mark.parametrize("name", ["_resume", "_record_roster"])
def test_failure_of_crashhunt_itself_in_compiled_steps_is_no_trials_outcome(modules, tmp_path, monkeypatch, name):
    scenario = load_scenario("loop")
    simulator = SumoSimulator(scenario, tmp_path)
    try:
        values = argument_values(scenario)
        result = run(tmp_path, simulator, values=values)
        assert label(result) == ("survived", "", "", ""), result.failure
        monkeypatch.setattr(FastPath, name, broken_function())
        with pytest.raises(InternalError, match=r"crashhunt itself failed in trial 0 .*: KeyError: 'ours'"):
            run(tmp_path, simulator, values=values)
    finally:
        monkeypatch.undo()
        simulator.close()


@pytest.mark.parametrize("party", ["agent", "environment"])
def test_exception_of_crashhunts_own_classes_forges_no_label(modules, tmp_path, monkeypatch, party):
    """Whoever raises what crashhunt raises is named all the same."""
    from crashhunt.base.foreign_code import ForeignError, Party

    simulator = gym(tmp_path)
    forgeries = (
        InternalError("crashhunt itself failed"), RecorderError("full"), KeyError("x"),
        ForeignError(Party.SIMULATOR, "step", KeyError("x")), ForeignError(Party.AGENT, "act", KeyError("x")),
    )  # fmt: skip
    for error in forgeries:

        def forge(*_, error=error):
            raise error

        where = modules["agent"].Agent if party == "agent" else modules["environment"].Env
        with monkeypatch.context() as patched:
            patched.setattr(where, "act" if party == "agent" else "step", forge)
            result = run(tmp_path, simulator)
        expected = ("agent_error", A, "act", "ego") if party == "agent" else ("simulator_error", E, "step", "")
        assert label(result) == expected
        assert result.failure.kind == type(error).__name__


def test_agent_that_closes_our_files_is_the_agents_fault_and_a_full_disk_nobodys(modules, tmp_path, monkeypatch):
    boxes = []
    real = BlackBox.__init__
    monkeypatch.setattr(
        BlackBox, "__init__", lambda box, *words, **more: (boxes.append(box), real(box, *words, **more))[1]
    )

    class Closing(modules["agent"].Agent):
        def act(self, observation):
            os.close(boxes[-1]._file)
            boxes[-1]._reserved = 0  # the recording has to grow
            return super().act(observation)

    monkeypatch.setattr(modules["agent"], "Agent", Closing)
    assert label(run(tmp_path, gym(tmp_path)))[0] == "agent_error"


# Hunts.

SCENARIO = """
schema = 1
simulator = "gym"
[gym]
id = "place_environment:Env"
[agents.ego]
agent = "place_agent:Agent"
"""


def prepare(shell, environment="", agent=""):
    """Write environment and agent, which go wrong where they are told."""
    (shell.folder / "place_environment.py").write_text(ENVIRONMENT.replace('fails = ""', f"fails = {environment!r}"))
    (shell.folder / "place_agent.py").write_text(AGENT.replace('fails = ""', f"fails = {agent!r}"))
    (shell.folder / "s.toml").write_text(SCENARIO)


FAULT = f"""
import crashhunt.gym._simulator as broken_module
names = {{"__name__": "crashhunt.broken"}}
exec(compile({BROKEN!r}, broken_module.__file__.replace("_simulator.py", "broken.py"), "exec"), names)
broken_module.native = names["broken"]
"""  # before crashhunt notes what its functions are, so that it is as if crashhunt came like this


def test_fault_of_crashhunt_ends_the_hunt_with_a_line_to_report_it(shell):
    prepare(shell)
    with (shell.folder / "place_environment.py").open("a") as file:
        file.write(FAULT)
    done = shell.crashhunt("run", "h", "1", "3", "4", "--scenario", "s.toml", "--seed", "1", "--json", expect=2)
    assert "crashhunt itself failed in trial 0 after 0 steps: KeyError: 'ours'" in done.err
    assert "report it with the output of the same command with CRASHHUNT_TRACEBACK=1" in done.err
    assert "Traceback" not in done.err
    assert done.json["error"]["message"].startswith("crashhunt itself failed")
    shell.environment |= {"CRASHHUNT_TRACEBACK": "1"}
    again = shell.begin("run", "h", "1", "3", "4", "--scenario", "s.toml", "--seed", "1")
    _, err = again.communicate(timeout=100)
    assert again.returncode == 2
    assert "broken.py" in err
    assert "Traceback" in err


def test_values_of_a_foreign_simulator_are_numbers_or_refused():
    def stepped(reward, ended, cut):
        return guarded_step(lambda _: ({}, {"ego": reward}, {"ego": ended}, {"ego": cut}, {}))({})

    assert stepped(np.array([2]), np.array([True]), 0) == ({}, {"ego": 2.0}, {"ego": True}, {"ego": False}, {})
    for values, says in (
        (("2", False, False), "rewards['ego'] is of type str: '2'"),
        ((2, (False,), False), "terminations['ego'] is of type tuple: (False,)"),
        ((2, False, {"over": False}), "truncations['ego'] is of type dict: "),
    ):
        with pytest.raises(ForeignError) as caught:
            stepped(*values)
        assert isinstance(caught.value.error, UnusableValueError)
        assert str(caught.value.error).startswith(says)


@pytest.mark.parametrize("found", [True, 3, np.float64(1.0)])
def test_oracle_that_returns_a_truth_value_gets_an_error_that_names_the_right_type(found):
    with pytest.raises(ForeignError) as caught:
        guarded_check(lambda scene, agents: found)(None, ())
    assert str(caught.value.error) == f"check() returned {found!r}; it must return a list of Finding"
    assert guarded_check(lambda scene, agents: None)(None, ()) == []
    assert guarded_check(lambda scene, agents: False)(None, ()) == []
