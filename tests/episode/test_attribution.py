"""Which agent an exception comes from that another part of an episode has met."""

from __future__ import annotations

import builtins
import importlib
import resource
import sys
from pathlib import Path

import numpy as np
import pytest

from crashhunt.episode import Episode, _failures, run_episode
from crashhunt.episode._failures import Attribution, attribute_error, record_originals
from crashhunt.errors import RecorderError
from crashhunt.gym import GymSimulator
from crashhunt.recording import BlackBox
from crashhunt.scenario import AgentSetup, Scenario, scenario_from_dict
from crashhunt.simulators.toy import ToySimulator
from crashhunt.trial import TrialSpec

DRIVES = """
import {imports}

class {name}:
    def __init__(self, *ignored, **more): ...

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step == 3:
            self.harm()
        return {action}

    def harm(self):
        {harm}
"""
ENVIRONMENT = """
import gymnasium
import numpy as np
import shared

class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1e6, 1e6, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    listeners = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.steps == 4:
            self.fail()
        for tell in self.listeners:
            tell()
        return np.ones(1, np.float32), 0.0, False, False, {}

    def fail(self):
        FAIL
"""


@pytest.fixture(autouse=True)
def nothing_recorded(monkeypatch):
    monkeypatch.setattr(_failures, "_originals", [])


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Writes modules of a user's, and imports them."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    written = []

    def write_module(name, text):
        Path(tmp_path, f"{name}.py").write_text(text)
        importlib.invalidate_caches()
        written.append(name)
        return importlib.import_module(name)

    yield write_module
    for name in written:
        sys.modules.pop(name, None)


def agent_module(harm, imports="numpy", name="Agent", action="5.0, 0"):
    return DRIVES.format(harm=harm, imports=imports, name=name, action=action)


def run(tmp_path, simulator, *agents, **more):
    box = BlackBox(tmp_path / "box")
    box.begin(pid=0, trial=0, started=0.0)
    made = dict(zip(simulator.actions, agents, strict=True))
    try:
        return run_episode(
            TrialSpec(0, 1, {}, {}, 10), simulator=simulator, make_agent=lambda name, *_: made[name](), box=box,
            **{"oracles": (), **more},
        )  # fmt: skip
    finally:
        box.close()


def toy(tmp_path, *agents):
    return ToySimulator(Scenario(simulator="toy", agents=dict.fromkeys(agents or ["ego"], AgentSetup())), tmp_path)


def told(result):
    failure = result.failure
    return str(result.outcome), result.steps, failure.agent if failure else None


RAISES_IN_SIMULATOR = "from crashhunt.simulators.toy import ToySimulator as T; T._look = lambda *_: 1 / 0"


@pytest.fixture
def toy_mended(monkeypatch):
    """Undoes what an agent does to the toy."""
    monkeypatch.setattr(ToySimulator, "_look", ToySimulator._look)


@pytest.mark.usefixtures("toy_mended")
def test_agent_in_a_module_of_its_own_is_reported_from_another_agent(write, tmp_path):
    second = write("second", agent_module("pass", name="Calm")).Calm
    first = write("mine", agent_module(RAISES_IN_SIMULATOR)).Agent
    assert told(run(tmp_path, toy(tmp_path, "a", "b"), second, first)) == ("agent_error", 2, "b")


@pytest.mark.usefixtures("toy_mended")
def test_of_agents_of_one_module_none_is_named(write, tmp_path):
    module = write("mine", agent_module(RAISES_IN_SIMULATOR))
    assert told(run(tmp_path, toy(tmp_path, "a", "b"), module.Agent, module.Agent)) == ("agent_error", 2, "")


@pytest.mark.usefixtures("toy_mended")
def test_of_agents_of_one_class_the_one_whose_method_runs_is_named(write, tmp_path):
    harm = "from crashhunt.simulators.toy import ToySimulator as T; T._look = self.look"
    text = agent_module(harm) + "\n    def look(self, *_):\n        1 / 0\n"
    module = write("mine", text)

    class Calm(module.Agent):
        def harm(self): ...

    assert told(run(tmp_path, toy(tmp_path, "a", "b"), Calm, module.Agent)) == ("agent_error", 2, "b")


@pytest.mark.usefixtures("toy_mended")
def test_helper_that_only_the_agent_imports_is_the_agents(write, tmp_path):
    write("shared", "def look(*_):\n    1 / 0\n")
    harm = "from crashhunt.simulators.toy import ToySimulator as T; T._look = shared.look"
    result = run(tmp_path, toy(tmp_path), write("mine", agent_module(harm, "shared")).Agent)
    assert told(result) == ("agent_error", 2, "ego")


def gym(tmp_path):
    table = {"simulator": "gym", "gym": {"id": "environment:Env"}, "agents": {"ego": {}}}
    return GymSimulator(scenario_from_dict(table, where="here", folder=tmp_path), tmp_path)


@pytest.mark.parametrize(
    ("fail", "helper", "harm", "expected"),
    [
        # The environment's own mistake, directly, and in a module that the agent imports as well.
        ("1 / 0", "", "pass", ("simulator_error", 3, "")),
        ("shared.help()", "def help():\n    1 / 0\n", "pass", ("simulator_error", 3, "")),
        # What the agent has put into it.
        ("pass", "", "environment.Env.fail = lambda *_: 1 / 0", ("agent_error", 3, "ego")),
        ("pass", "", "environment.Env.listeners.append(lambda: [][1])", ("agent_error", 2, "ego")),
        ("pass", "", "environment.Env.listeners.append(lambda: exit(3))", ("agent_error", 2, "ego")),
        ("shared.help()", "def help(): ...\n", "shared.help = lambda: 1 / 0", ("agent_error", 3, "ego")),
    ],
)
def test_environment_of_a_users_is_reported_from_the_agent(write, tmp_path, fail, helper, harm, expected):
    write("shared", helper)
    write("environment", ENVIRONMENT.replace("FAIL", fail))
    agent = write("mine", agent_module(harm, "environment, shared", action="0")).Agent
    assert told(run(tmp_path, gym(tmp_path), agent)) == expected


def test_agent_in_the_module_of_the_environment_is_known_by_its_class(write, tmp_path):
    write("shared", "")
    harm = "Env.listeners.append(lambda: [][1])"
    both = ENVIRONMENT.replace("FAIL", "1 / 0") + agent_module(harm, "shared", action="0")
    module = write("environment", both)
    assert told(run(tmp_path, gym(tmp_path), module.Agent)) == ("agent_error", 2, "ego")
    module.Env.listeners.clear()

    class Calm(module.Agent):
        def harm(self): ...

    assert told(run(tmp_path, gym(tmp_path), Calm)) == ("simulator_error", 3, "")


@pytest.mark.parametrize(
    ("harm", "cause"),
    [
        ("numpy.clip = None", "numpy.clip has been replaced"),
        ("numpy.clip = lambda *_: 'no array'", "numpy.clip has been replaced"),
        ("del numpy.clip", "numpy.clip has been replaced"),
        ("environment.Env.steps = property()", ""),  # which is no function of a library
    ],
)
def test_replaced_function_of_a_library_is_named(write, tmp_path, monkeypatch, harm, cause):
    monkeypatch.setattr(np, "clip", np.clip)
    record_originals()
    write("shared", "")
    write("environment", ENVIRONMENT.replace("FAIL", "np.clip(1, 0, 1) + 1"))
    agent = write("mine", agent_module(harm, "numpy, environment", action="0")).Agent
    result = run(tmp_path, gym(tmp_path), agent)
    assert str(result.outcome) == ("agent_error" if cause else "simulator_error")
    assert result.failure.agent == ("ego" if cause else "")
    assert result.failure.message.startswith(f"{cause}, upon which this fails: " if cause else "property")


def test_function_that_the_failing_code_does_not_use_is_not_blamed(write, tmp_path, monkeypatch):
    monkeypatch.setattr(np, "clip", np.clip)
    monkeypatch.setattr(np, "hypot", np.hypot)
    record_originals()
    write("shared", "")
    write("environment", ENVIRONMENT.replace("FAIL", "1 / 0"))
    agent = write("mine", agent_module("numpy.hypot = None", action="0")).Agent
    assert told(run(tmp_path, gym(tmp_path), agent)) == ("simulator_error", 3, "")


def test_function_that_the_environment_replaces_is_its_own_business(write, tmp_path, monkeypatch):
    monkeypatch.setattr(np, "clip", np.clip)
    record_originals()
    write("shared", "")
    write("environment", ENVIRONMENT.replace("FAIL", "np.clip = lambda *_: None; np.clip(1) + 1"))
    agent = write("mine", agent_module("pass", action="0")).Agent
    assert told(run(tmp_path, gym(tmp_path), agent)) == ("simulator_error", 3, "")


@pytest.mark.parametrize(
    ("error", "lower", "cause"),
    [
        (RecursionError, "recursion", "the recursion limit has been lowered to"),
        (MemoryError, "RLIMIT_AS", "RLIMIT_AS has been lowered to"),
        (OSError, "RLIMIT_NOFILE", "RLIMIT_NOFILE has been lowered to"),
        (ValueError, "RLIMIT_NOFILE", ""),
        (OSError, "", ""),
    ],
)
def test_limit_that_an_agent_has_lowered_is_named(write, tmp_path, monkeypatch, error, lower, cause):
    record_originals()
    agent = write("mine", agent_module("pass")).Agent()
    lowered = resource.RLIM_INFINITY - 1, resource.RLIM_INFINITY
    limits = {getattr(resource, lower): lowered} if lower.startswith("RLIMIT") else {}
    real = resource.getrlimit
    monkeypatch.setattr(resource, "getrlimit", lambda number: limits.get(number) or real(number))
    if lower == "RLIMIT_AS" and real(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY:
        limits[resource.RLIMIT_AS] = 1 << 30, -1
    if lower == "RLIMIT_NOFILE":
        limits[resource.RLIMIT_NOFILE] = 3, 3
    if lower == "recursion":
        monkeypatch.setattr(sys, "getrecursionlimit", lambda: 60)
    found = attribute_error(error(), {"ego": agent}, toy(tmp_path))
    assert (found is not None and found.cause.startswith(cause)) == bool(cause)
    assert found is None or found.agent == "ego"


def test_raising_recorder_error_does_not_make_it_a_full_disk(write, tmp_path, monkeypatch):
    monkeypatch.setattr(ToySimulator, "_look", ToySimulator._look)
    harm = (
        "from crashhunt.errors import RecorderError; from crashhunt.simulators.toy import ToySimulator as T; "
        "T._look = lambda *_: (_ for _ in ()).throw(RecorderError('full'))"
    )
    result = run(tmp_path, toy(tmp_path), write("mine", agent_module(harm)).Agent)
    assert told(result) == ("agent_error", 2, "ego")

    calm = write("calm", agent_module("pass")).Agent

    class Full(ToySimulator):
        def step(self, actions):
            raise RecorderError("full")

    with pytest.raises(RecorderError):
        run(tmp_path, Full(Scenario(simulator="toy", agents={"ego": AgentSetup()}), tmp_path), calm)


def test_signal_handler_that_raises_between_two_steps_is_the_agents(write, tmp_path, monkeypatch):
    module = write("mine", agent_module("pass") + "\ndef on_signal():\n    raise ValueError('late')\n")
    step = Episode.step

    def interrupted(episode, *given):
        if episode.steps == 4:
            module.on_signal()
        return step(episode, *given)

    monkeypatch.setattr(Episode, "step", interrupted)
    assert told(run(tmp_path, toy(tmp_path), module.Agent)) == ("agent_error", 4, "ego")

    def fails(episode, *given):
        raise KeyError("ours")

    monkeypatch.setattr(Episode, "step", fails)
    with pytest.raises(KeyError):
        run(tmp_path, toy(tmp_path), module.Agent)


def test_exception_before_the_agents_are_made_is_found_by_the_scenario(write, tmp_path):
    write("shared", "")
    write("environment", ENVIRONMENT.replace("FAIL", "pass"))
    write("mine", agent_module("pass", action="0") + "\ndef on_signal():\n    raise ValueError('early')\n")
    table = {"simulator": "gym", "gym": {"id": "environment:Env"}, "agents": {"ego": {"agent": "mine:Agent"}}}
    simulator = GymSimulator(scenario_from_dict(table, where="here", folder=tmp_path), tmp_path)

    def reset(**_):
        sys.modules["mine"].on_signal()

    result = run(tmp_path, simulator, sys.modules["mine"].Agent, reset=reset)
    assert told(result) == ("invalid", 0, "ego")


def test_damaged_interpreter_is_no_obstacle(write, tmp_path, monkeypatch):
    agent = write("mine", agent_module("pass")).Agent()
    monkeypatch.setattr(builtins, "any", None)
    assert attribute_error(ValueError(), {"ego": agent}, toy(tmp_path)) is None
    monkeypatch.undo()
    assert attribute_error(ValueError(), {}, toy(tmp_path)) is None


def test_chain_of_causes_leads_to_the_agent(write, tmp_path):
    module = write("mine", agent_module("raise ValueError"))
    try:
        try:
            module.Agent().harm()
        except ValueError as cause:
            raise RuntimeError("SUMO gave up") from cause
    except RuntimeError as error:
        assert attribute_error(error, {"ego": module.Agent()}, toy(tmp_path)) == Attribution("ego")
        error.__cause__ = error  # a circle
        assert attribute_error(error, {"ego": module.Agent()}, toy(tmp_path)) is None
