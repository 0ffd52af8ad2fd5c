"""Environments of Gymnasium as simulators: one of its own, one registered here, one made by a factory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from conftest import mostly_nightly
from gymnasium import spaces

from crashhunt.base.foreign_code import ForeignError
from crashhunt.base.text import ABSENT_WORDS, NOTICE_TOPIC, PRESENT_WORDS
from crashhunt.errors import CrashhuntError, InvalidEpisodeError, ScenarioError
from crashhunt.gym import GymSimulator
from crashhunt.gym._descriptor import BACKEND, CrashRule, GymSetup
from crashhunt.plans import Request, plan
from crashhunt.scenario import AgentSetup, ArgumentSetup, Scenario
from crashhunt.testing import SimulatorContract


class Tray(gymnasium.Env):
    """A ball on a tray: structured observations and actions, and a crash in the info."""

    observation_space = spaces.Dict(
        {
            "ball": spaces.Box(-10, 10, (2,), np.float64),
            "side": spaces.Discrete(2),
            "step": spaces.Box(0, 255, (1,), np.uint8),
        }
    )
    action_space = spaces.Dict({"tilt": spaces.Box(-1, 1, (2,), np.float32), "kick": spaces.Discrete(2)})

    def __init__(self, *, size=2.0, fails_at=0):
        self.size, self.fails_at = size, fails_at

    def _look(self):
        return {"ball": self.ball, "side": int(self.ball[0] > 0), "step": np.array([self.steps], np.uint8)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.size < 0:
            raise ValueError("a tray has a size")
        self.ball, self.steps = self.np_random.normal(size=2) * 0.1, 0
        return self._look(), {}

    def step(self, action):
        assert isinstance(action, dict)
        self.steps += 1
        self.ball += 0.2 * action["tilt"] + 0.1 * action["kick"]  # the same array as before, as careless ones do
        return (
            self._look(),
            float(-abs(self.ball).max()),
            self.steps >= 40,
            False,
            {"fell": abs(self.ball).max() > self.size},
        )


# The checker would warn, because the ball is the same array in each observation.
gymnasium.register("Tray-v0", entry_point=Tray, disable_env_checker=True)
gymnasium.register("Short-v0", entry_point=Tray, disable_env_checker=True, max_episode_steps=10)


def scenario_of(name, *, crash=None, arguments=None, **kwargs):
    setup = GymSetup(id=name, kwargs=kwargs, crash=CrashRule(**(crash or {})))
    return Scenario(simulator="gym", tables={"gym": setup}, agents={"ball": AgentSetup()}, arguments=arguments or {})


def simulator_of(tmp_path, *words, **options):
    return GymSimulator(scenario_of(*words, **options), tmp_path)


BY_DAY = ("CartPole-v1", "FrozenLake-v1", "Tray-v0")  # arrays, numbers and tables
NAMES = (*BY_DAY, "MountainCarContinuous-v0", "Blackjack-v1", "tests_tray:make_tray")


@pytest.mark.parametrize("name", mostly_nightly(NAMES, BY_DAY))
class TestGym(SimulatorContract):
    @pytest.fixture
    def make(self, tmp_path, name, monkeypatch):
        (tmp_path / "tests_tray.py").write_text(
            "import gymnasium\ndef make_tray():\n    return gymnasium.make('Tray-v0', disable_env_checker=True)\n"
        )
        monkeypatch.syspath_prepend(tmp_path)
        return lambda: GymSimulator(scenario_of(name), tmp_path)

    def test_an_episode_depends_on_its_seed_alone(self, simulator, name):
        if name == "FrozenLake-v1":  # it always begins in the same place, and the lake is slippery by chance
            self.steps = 3
        super().test_an_episode_depends_on_its_seed_alone(simulator)


FALL = {"tilt": np.array([1.0, 0.0], np.float32), "kick": 0}


def fall(simulator, steps=100):
    simulator.reset(seed=1, options={"arguments": {}})
    for step in range(1, steps + 1):
        _, _, terminations, _, _ = simulator.step({"ball": simulator.actions["ball"].encode(FALL)})
        if terminations["ball"]:
            return step
    return None


def was_cut(observation, reward, terminated, truncated, info):
    return truncated and "cut"


OWN_LIMIT = "the environment 'Short-v0' ends an episode after {} steps, which is its own time limit; set "


@pytest.mark.parametrize(
    ("limit", "kwargs", "ends", "told"),
    [
        ("registered", {}, 10, OWN_LIMIT.format(10)),
        ("registered", {"max_episode_steps": 7}, 7, OWN_LIMIT.format(7).removesuffix("; set ")),
        ("registered", {"max_episode_steps": -1}, 40, ""),
        ("registered", {"max_episode_steps": 60}, 40, ""),
        ("none", {}, 40, ""),
        ("none", {"max_episode_steps": 7}, 7, OWN_LIMIT.format(7).removesuffix("; set ")),
    ],
)
def test_registered_time_limit_ends_an_episode_unless_the_scenario_lifts_it(tmp_path, limit, kwargs, ends, told):
    scenario = scenario_of("Short-v0", crash={"function": f"{__name__}:was_cut"}, **kwargs)
    simulator = GymSimulator(scenario.with_table(replace(scenario.table(GymSetup), time_limit=limit)), tmp_path)
    for _ in range(2):
        assert fall(simulator) == ends
    assert [contact.kind for contact in simulator.scene().contacts] == (["cut"] if ends < 40 else [])
    assert [notice.partition("gym.time_limit")[0] for notice in simulator.notices] == ([told] if told else [])


class CutEarly(gymnasium.Wrapper):
    def step(self, action):
        *rest, _, info = self.env.step(action)
        return *rest, self.env.steps >= 7, info


def make_cut():
    return CutEarly(Tray())


def test_truncation_by_a_wrapper_is_reported_and_is_no_termination(tmp_path):
    cut, whole = simulator_of(tmp_path, f"{__name__}:make_cut"), simulator_of(tmp_path, "Tray-v0")
    assert (fall(cut), cut.was_truncated) == (7, True)
    what = "truncates an episode itself or by a wrapper, so the trial ends as finished before MAX_STEPS"
    assert cut.notices == [f"the environment '{__name__}:make_cut' {what}"]
    cut.reset(seed=1)
    assert not cut.was_truncated
    assert (fall(whole), whole.was_truncated) == (40, False)


class Unchecked(Tray):
    """Its observation has a part that its space lacks, which only Gymnasium's checker refuses."""

    def _look(self):
        return {**super()._look(), "more": 1} if self.steps >= self.fails_at else super()._look()


gymnasium.register("Unchecked-v0", entry_point=Unchecked)


def make_unchecked(fails_at=0):
    return gymnasium.make("Unchecked-v0", fails_at=fails_at)


@pytest.mark.parametrize("fails_at", [0, 1])
@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("Unchecked-v0", "set kwargs.disable_env_checker = true in the table [gym]"),
        (f"{__name__}:make_unchecked", "give gymnasium.make disable_env_checker=True"),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_refusal_by_the_checker_of_gymnasium_names_the_option_that_disables_it(tmp_path, name, fix, fails_at):
    simulator = simulator_of(tmp_path, name, fails_at=fails_at)
    with pytest.raises((ForeignError, InvalidEpisodeError)) as caught:
        fall(simulator, steps=2)
    error = getattr(caught.value, "error", caught.value)
    assert "keys is not same as the observation space keys" in str(error)
    assert f"correct the environment, or {fix}" in (getattr(error, "fix", "") or str(error))


def test_limit_of_an_id_is_reported_where_its_class_is_named_and_runs_longer(tmp_path):
    simulator = simulator_of(tmp_path, f"{__name__}:Tray")
    fall(simulator, steps=6)
    assert list(simulator.notices) == []
    assert fall(simulator) == 40
    told = "is registered as 'Doubled-v0' with a time limit of 9 steps, which only that id has"
    assert list(simulator.notices) == [f"the environment '{__name__}:Tray' {told}"]


def test_id_without_a_version_may_have_the_form_of_an_attribute(tmp_path):
    gymnasium.register("TrayWithoutVersion", entry_point=Tray, disable_env_checker=True, max_episode_steps=6)
    assert fall(simulator_of(tmp_path, f"{__name__}:TrayWithoutVersion")) == 6
    del gymnasium.registry["TrayWithoutVersion"]
    with pytest.raises(CrashhuntError, match="has no attribute 'TrayWithoutVersion'"):
        simulator_of(tmp_path, f"{__name__}:TrayWithoutVersion")


def test_scenario_that_lifts_the_time_limit_has_a_note():
    for kwargs, limit, count in (({}, "registered", 0), ({}, "none", 1), ({"max_episode_steps": -1}, "registered", 1)):
        scenario = scenario_of("Short-v0", crash={"info": "fell"}, **kwargs)
        notes = list(BACKEND.notes(scenario.with_table(replace(scenario.table(GymSetup), time_limit=limit))))
        assert len(notes) == count
        assert all("'Short-v0' is registered is lifted" in note for note in notes)


class Doubled(gymnasium.RewardWrapper, gymnasium.utils.RecordConstructorArgs):
    def __init__(self, env):
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)

    def reward(self, reward):
        return 2 * float(reward)


gymnasium.register(
    "Doubled-v0",
    entry_point=Tray,
    disable_env_checker=True,
    additional_wrappers=(Doubled.wrapper_spec(),),
    max_episode_steps=9,
)


def test_environment_has_the_wrappers_with_which_it_is_registered(tmp_path):
    plain, doubled = simulator_of(tmp_path, "Tray-v0"), simulator_of(tmp_path, "Doubled-v0")
    rewards = []
    for simulator in (plain, doubled):
        simulator.reset(seed=1)
        rewards.append(simulator.step({"ball": simulator.actions["ball"].encode(FALL)})[1]["ball"])
    assert rewards[1] == 2 * rewards[0]
    assert fall(doubled) == 9


def test_scenario_without_a_crash_rule_has_a_note():
    for crash, count in (({}, 1), ({"kind": f"{__name__}:was_cut"}, 1), ({"info": "fell"}, 0)):
        found = list(BACKEND.notes(scenario_of("Tray-v0", crash=crash)))
        assert (
            found == ["gym.crash has no rule, so only failures of the agent and of the environment are crashes"] * count
        )


def test_a_hunt_for_a_requirement_has_no_note_on_a_missing_crash_rule(tmp_path):
    (tmp_path / "scenario.toml").write_text(
        'schema = 1\nsimulator = "gym"\ngym.id = "CartPole-v1"\nagents.cart.agent = "random"\n'
    )
    request = Request(scenario=tmp_path, trials=1, max_steps=9)
    assert [note for note in plan(request)[0].notes if "gym.crash" in note]
    calm = replace(request, requirements=("always (observation[0] < 1)",))
    assert not [note for note in plan(calm)[0].notes if "gym.crash" in note]


def test_keys_that_the_scenario_names_are_reported_as_present_or_absent(tmp_path):
    scenario = scenario_of("Tray-v0", crash={"info": "felt"})
    scenario = scenario.with_table(replace(scenario.table(GymSetup), danger="-info.fell"))
    simulator = GymSimulator(scenario, tmp_path)
    assert simulator.notices == []
    fall(simulator, steps=2)
    absent, present = simulator.notices
    assert present == f"gym.danger = '-info.fell'{PRESENT_WORDS}"
    topic, _, text = absent.partition(NOTICE_TOPIC)
    assert text == f"{topic}. Fix: did you mean 'fell'? Keep it if info has this key only in the step of a crash"
    assert topic == f"gym.crash.info = 'felt'{ABSENT_WORDS}info had only the keys fell"


def test_scenario_argument_that_is_a_signal_is_a_function_of_the_time(tmp_path):
    arguments = {"wide": ArgumentSetup(default=3.0, option="size")}
    simulator = simulator_of(tmp_path, f"{__name__}:Wide", arguments=arguments)
    signal = {"wide": "signal:linear:2:10.0", "wide[0]": 1.0, "wide[1]": 3.0}
    simulator.reset(seed=1, options={"arguments": signal})
    assert [simulator._env.unwrapped.wide(time_s) for time_s in (0.0, 2.5, 99.0)] == [1.0, 1.5, 3.0]


class Wide(Tray):
    def __init__(self, size=1.0):
        super().__init__(size=1.0)
        self.wide = size


def make_nested(config=None, **kwargs):
    """One that takes a table, and refuses what is in it."""
    if config["friction"]["of"] < 0:
        raise ValueError("friction is\nnegative")
    made = Tray(**kwargs)
    made.config = config
    return made


def make_nothing():
    return "a tray"


class OldTray(Tray):
    """Has the interface of the gym before Gymnasium."""

    returned = (np.zeros(2), 0.0, False, {})

    def reset(self, *, seed=None, options=None):
        given = super().reset(seed=seed)
        return given if self.size > 1 else np.zeros(2)

    def step(self, action):
        return self.returned if self.size > 2 else (np.zeros(2), 0.0, False, False, None)


@pytest.mark.parametrize(
    ("size", "says"),
    [
        (3.0, "step() returned 4 values, but step() of Gymnasium returns observation, reward, terminated, truncated"),
        (2.0, "step() returned info = None, which is not a dictionary"),
        (1.0, "reset() returned one ndarray, but reset() of Gymnasium returns observation, info"),
    ],
)
def test_error_of_an_old_gym_environment_states_what_gymnasium_returns(tmp_path, size, says):
    simulator = simulator_of(tmp_path, f"{__name__}:OldTray", size=size)
    with pytest.raises((ForeignError, InvalidEpisodeError)) as caught:
        fall(simulator, steps=1)
    assert says in str(getattr(caught.value, "error", caught.value))


gymnasium.register("OldTray-v0", entry_point=OldTray, max_episode_steps=5, disable_env_checker=True)


def test_error_of_an_old_gym_environment_is_the_same_inside_a_wrapper(tmp_path):
    simulator = simulator_of(tmp_path, "OldTray-v0", size=2.5)
    simulator.reset(seed=1)
    with pytest.raises(ForeignError) as caught:
        simulator.step({"ball": simulator.actions["ball"].encode(FALL)})
    assert str(caught.value.error) == (
        "step() of Gymnasium returns observation, reward, terminated, truncated, info, but step() of the environment: "
        "not enough values to unpack (expected 5, got 4)"
    )


class Spaceless(Tray):
    observation_space = None


gymnasium.register("Spaceless-v0", entry_point=Spaceless, disable_env_checker=True)


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("Carpole-v1", {}, "Carpole"),
        ("Tray-v0", {"colour": "red"}, "colour"),
        ("Tray-v0", {"reset_options": {"low": 1}}, "; add reset_options = {} to the table [gym]"),
        (f"{__name__}:Tray", {"max_episode_steps": 5}, "; remove max_episode_steps, or name the id with which the env"),
        ("Short-v0", {"max_episode_steps": 0}, "; give 1 or more steps, or set gym.time_limit = "),
        ("Short-v0", {"max_episode_steps": "9"}, "; give 1 or more steps, or set gym.time_limit = "),
        ("Spaceless-v0", {}, "the environment's observation_space is None, not a gymnasium.Space; set it"),
        ("no_such_module:make", {}, "no_such_module"),
        (f"{__name__}:make_nested", {"config": {"friction": {"of": -1}}}, "friction is negative"),
        (f"{__name__}:make_nothing", {}, "this factory returned a str"),
        ("CartPole-v1", {"crash": {"function": "math:cosine"}}, "cosine"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, name, options, says):
    with pytest.raises((ScenarioError, CrashhuntError)) as caught:
        simulator_of(tmp_path, name, **options)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


class Straying(gymnasium.Env):
    """Shows what it does not promise: no number at step 2, too much at step 3."""

    observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        shown = {2: np.nan, 3: 7.0}.get(self.steps, 0.5)
        return np.array([shown, 0.0], np.float32), 0.0, False, False, {}


def make_straying():
    return Straying()


SCENARIO = """
schema = 1
title = "Strays"
simulator = "gym"
[gym]
id = "straying:make_straying"
[agents.me]
agent = "random"
"""


def test_a_hunt_reports_it_in_its_summary(shell):
    source = Path(__file__).read_text(encoding="utf-8")
    body = source.partition("class Straying")[2].partition("\n\n\ndef test_")[0]
    (shell.folder / "straying.py").write_text(
        f"import gymnasium\nimport numpy as np\nfrom gymnasium import spaces\n\n\nclass Straying{body}\n"
    )
    (shell.folder / "strays.toml").write_text(SCENARIO)
    done = shell.crashhunt("run", "h", "1", "2", "4", "--scenario", "strays.toml", "--seed", "1", "--json")
    assert done.json["outcomes"] == {"survived": 2}
    assert sum("contains NaN" in note for note in done.json["notes"]) == 1
    assert "Note: the environment 'straying:make_straying' shows its agent an observation outside" in done.err


def test_danger_that_names_nothing_is_one_line():
    scenario = scenario_of("Tray-v0")
    for danger in ("distance", "info.", "-reward"):
        with pytest.raises(ScenarioError, match=f"gym.danger = '{danger}' is not of the form"):
            BACKEND.check(scenario.with_table(replace(scenario.table(GymSetup), danger=danger)), "scenario.toml")


TWO_KINDS = """
import gymnasium
import numpy as np

class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-9, 9, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.side = int(self.np_random.integers(2))
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), -7.5 - self.side, True, False, {"crash_kind": ("ice", "wall 3")[self.side]}
"""


def test_hunt_groups_crashes_by_the_kind_that_the_environment_names(shell):
    (shell.folder / "two.py").write_text(TWO_KINDS)
    crash = "crash = { termination = true }"
    scenario = SCENARIO.replace("straying:make_straying", "two:Env").replace("[agents", f"{crash}\n[agents")
    (shell.folder / "two.toml").write_text(scenario)
    done = shell.crashhunt(
        "run", "h", "1", "3", "4", "--scenario", "two.toml", "--seed", "1", "--keep-going", "--keep", "1", "--json"
    )
    assert sorted(kind["words"] for kind in done.json["kinds"]) == ["ice", "wall #"]
    assert sum(kind["count"] for kind in done.json["kinds"]) == 3
