"""Parts of the simulator for Gymnasium environments: spaces, configurations, crash rules, notices and learners."""

from __future__ import annotations

import math
import signal
import time
from contextlib import suppress
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from crashhunt.base.errors import ActionError, InvalidEpisodeError, UnusableValueError
from crashhunt.base.foreign_code import ForeignError, number_of
from crashhunt.gym import GymSimulator, _simulator as gym
from crashhunt.gym._descriptor import CrashRule, GymSetup
from crashhunt.gym._simulator import crash_cell
from crashhunt.recording import encode_value
from crashhunt.scenario import AgentSetup, ArgumentSetup, Scenario
from crashhunt.simulators import _any_space as _gymnasium
from crashhunt.simulators._any_space import FlatAction, ObservationForm, OpaqueAction, OpaqueSpace


@pytest.mark.parametrize(
    ("dtype", "recorded"),
    [("f4", True), ("f8", True), ("f2", False), ("g", False), ("i1", True), ("i8", True), ("?", True), ("u1", True),
     ("u2", True), ("u4", True), ("u8", False), ("c8", False), ("O", False), ("U2", False)],
)  # fmt: skip
def test_arrays_are_recorded_where_a_log_holds_every_bit(dtype, recorded):
    assert _gymnasium._can_be_recorded(np.dtype(dtype)) is recorded


BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)


@pytest.mark.parametrize(
    ("space", "array", "flat"),
    [
        (BOX, True, False),
        (spaces.Discrete(3), True, False),
        (spaces.MultiBinary(2), True, False),
        (spaces.Dict(a=BOX), False, True),
        (spaces.Tuple([BOX, spaces.Discrete(3)]), False, True),
        (spaces.Dict(), False, False),
        (spaces.Dict(a=BOX, b=spaces.Tuple([])), False, False),
        (spaces.Dict(a=BOX, b=spaces.Text(3)), False, False),
        (spaces.Text(3), False, False),
        (spaces.Box(0, 1, (2,), np.float16), False, False),
        (spaces.Dict(a=spaces.Box(0, 255, (2,), np.uint8), b=BOX), False, True),
        (spaces.Dict(a=spaces.Box(0, 2**25, (2,), np.int32), b=BOX), False, True),
        (spaces.Dict(a=spaces.Box(0, 2**54, (2,), np.int64), b=BOX), False, False),
        (spaces.Dict(a=spaces.Box(-(2**53), 2**53, (2,), np.int64), b=spaces.Box(0, 1, (1,), np.float64)), False, True),
        (
            spaces.Dict(a=spaces.Box(-(2**53) - 2, 0, (2,), np.int64), b=spaces.Box(0, 1, (1,), np.float64)),
            False,
            False,
        ),
        (spaces.Dict(a=spaces.Box(0, 2**53 + 2, (2,), np.int64), b=spaces.Box(0, 1, (1,), np.float64)), False, False),
    ],
)
def test_spaces_are_recorded_as_arrays_flat_or_as_values(space, array, flat):
    form = ObservationForm(space)
    assert (not form.structured, form.flattened) == (array, flat)
    assert isinstance(form.space, OpaqueSpace) == (not array and not flat)
    kind = type(_gymnasium.action_form(space)).__name__
    assert kind == ("SpaceAction" if array else "FlatAction" if flat else "OpaqueAction")


def test_observation_of_another_form_is_an_error_of_the_environment():
    form = ObservationForm(spaces.Dict(a=spaces.Discrete(3), b=BOX))
    fine = {"a": 1, "b": np.array([0.5, -0.5], np.float32)}
    assert form.encode(fine).tolist() == [0.0, 1.0, 0.0, 0.5, -0.5]
    restored = form.restore(form.encode(fine))
    assert (restored["a"], restored["b"].tolist()) == (1, [0.5, -0.5])
    outside = {"a": 1, "b": np.array([0.5, 7.0], np.float32)}
    assert form.encode(outside)[-1] == 7.0  # a number that the array can hold
    assert form.contains(fine, None)
    assert not form.contains(outside, None)
    with pytest.raises(ForeignError) as caught:
        form.encode({"a": -1, "b": fine["b"]})
    assert "observation['a'] does not have the form of Discrete(3): it is -1" in str(caught.value.error)
    plain = ObservationForm(BOX)
    given = np.zeros(2, np.float32)
    assert plain.encode(given) is not given
    assert plain.encode([1, 2]).dtype == np.float32
    assert plain.restore(given) is given
    assert plain.contains(given, given)
    assert not plain.contains(None, given + 2)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ({"a": 1}, {"a": 1, "b": 2}, True), ({"a": 1, "b": 2}, {"a": 1}, False), ({"a": 1}, 1, False),
        ((1, 2), (1, 2), True), ((1, 2), (1,), False), ((1, 2), (1, 3), False), (np.array([1]), [1.0], True),
        (np.array([np.nan]), np.array([np.nan]), True), ({"a": (1, {"b": 2})}, {"a": (1, {"b": 3})}, False),
    ],
)  # fmt: skip
def test_structures_are_equal_where_their_numbers_are(one, other, same):
    assert bool(_gymnasium._equal(one, other)) is same


def test_flat_action_is_inside_its_space_and_the_same_on_its_way_back():
    form = FlatAction(spaces.Dict(gear=spaces.Discrete(2), more=spaces.Box(0.0, 1.0, (1,), np.float64)))
    flat = np.array([0.0, 1.0, 0.5])
    for action in ({"gear": 1, "more": np.array([0.5])}, flat, flat.astype(np.float16)):
        assert (form.encode(action).dtype, form.encode(action).tolist()) == (np.float64, [0.0, 1.0, 0.5])
    for action in (flat.astype(complex), np.array([1.0, 1.0, 0.5]), np.array([0.0, 1.0, 1.5]), np.array([0.0, 1.0]),
                   {"gear": 2}, {"gear": 1, "more": np.ma.array([0.5], mask=[True])}, None):  # fmt: skip
        with pytest.raises(ActionError, match="is not in Dict"):
            form.encode(action)
    assert _gymnasium.native(form, np.array([0.0, 1.0, 0.5]))["gear"] == 1
    number = _gymnasium.native(_gymnasium.action_form(spaces.Discrete(3)), np.array(2))
    assert (number, type(number)) == (2, int)
    given = np.zeros(2, np.float32)
    found = _gymnasium.native(_gymnasium.action_form(BOX), given)
    assert found is not given
    assert found.tolist() == [0.0, 0.0]


def test_action_without_a_fixed_size_is_a_value_or_its_text():
    form = OpaqueAction(spaces.Text(3, charset="ab"))
    text = form.encode("ab")
    assert form.restore(text) == "ab"
    assert form.encode(text).tolist() == text.tolist()
    assert _gymnasium.native(form, text) == "ab"
    for wrong in ("abab", 7, encode_value("abab"), np.zeros(3, np.uint8)):
        with pytest.raises(ActionError, match="is not in Text"):
            form.encode(wrong)
    space = OpaqueSpace(spaces.Text(3))
    assert (space.is_np_flattenable, space.contains(text), space.contains(text[None])) == (False, True, False)
    assert not space.contains(text.astype(np.int64))
    assert not space.contains("ab")
    assert space.contains(space.sample())
    assert repr(space) == f"OpaqueSpace({space.original!r})"


def test_objects_that_cannot_be_restored_are_kept_while_there_are_few():
    values, kept = _gymnasium._Values(), [SimpleNamespace(number=number, more=lambda: None) for number in range(257)]
    arrays = [values.encode(one) for one in kept[:256]]
    assert values.restore(arrays[0]) is kept[0]
    values.encode(kept[0])  # used again, so that it is not the oldest
    values.encode(kept[256])
    assert values.restore(arrays[0]) is kept[0]
    assert len(values._originals) == 256
    assert arrays[1].tobytes() not in values._originals
    assert values.restore(values.encode({"a": [1, 2]})) == {"a": [1, 2]}
    assert len(values._originals) == 256  # plain values need no object


def test_arguments_are_nested_tables_by_their_dots():
    scenario = SimpleNamespace(
        arguments={"rows": ArgumentSetup(default=1, option="a.b.c"), "x": ArgumentSetup(default=1)}
    )
    assert _gymnasium.as_tables(scenario, {"rows": 3, "x": 4, "other.y": 5}) == [
        {"a": {"b": {"c": 3}}}, {"x": 4}, {"other": {"y": 5}}
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("table", "found"),
    [
        ({"a": {"x": 9}}, {"a": {"type": "one", "x": 9, "y": 2}, "b": 1}),
        ({"a": {"type": "one", "x": 9}}, {"a": {"type": "one", "x": 9, "y": 2}, "b": 1}),
        ({"a": {"type": "two"}}, {"a": {"type": "two"}, "b": 1}),
        ({"a": 3}, {"a": 3, "b": 1}),
        ({"b": {"z": 1}, "c": 2}, {"a": {"type": "one", "x": 1, "y": 2}, "b": {"z": 1}, "c": 2}),
    ],
)
def test_tables_of_the_same_type_are_merged(table, found):
    config = {"a": {"type": "one", "x": 1, "y": 2}, "b": 1}
    _gymnasium.merge(config, table)
    assert config == found


@pytest.mark.parametrize("make", [np.random.default_rng, np.random.RandomState])
def test_generator_is_reseeded_for_all_that_share_it(make):
    generator = make(1)
    _gymnasium.reseed_in_place(generator, 5)
    assert generator.random() == make(5).random()


@pytest.mark.parametrize(
    ("info", "cell"),
    [
        ({}, ""),
        ({"b": True, "a": np.True_, "c": False, "n": 3}, "a b"),
        ({"t": "wet", "e": "", "l": "x" * 21}, "t=wet"),
        ({"t": "x" * 20}, "t=" + "x" * 20),
        ({f"k{n}": True for n in range(9, -1, -1)}, "k0 k1 k2 k3 k4 k5 k6 k7"),
    ],
)
def test_crash_cell_has_true_flags_and_short_texts(info, cell):
    assert crash_cell(info) == cell


# Crash rules.


@pytest.mark.parametrize(
    ("rule", "step", "found"),
    [
        ({"info": "crash"}, (0.0, False, {"crash": True}), "crash"),
        ({"info": "crash"}, (0.0, False, {"crash": 0}), ""),
        ({"reward_below": -1.0}, (-1.0, False, {}), ""),
        ({"reward_below": -1.0}, (-1.5, False, {}), "reward -1.5"),
        ({"termination": True}, (0.0, True, {}), "terminated"),
        ({"termination": True}, (0.0, False, {}), ""),
        ({}, (0.0, True, {}), ""),
        ({"info": "crash", "termination": True}, (0.0, True, {"crash": False}), "terminated"),
        ({"info": "crash"}, (0.0, False, {"crash": True, "crash_kind": " rear \n end"}), "rear end"),
        ({"info": "crash"}, (0.0, False, {"crash": True, "crash_kind": "x" * 90}), "x" * 80),
        ({"info": "crash"}, (0.0, False, {"crash": True, "crash_kind": 7}), "crash"),
        ({"info": "crash"}, (0.0, False, {"crash_kind": "x"}), ""),
    ],
)
def test_crash_rule_names_the_crash(rule, step, found):
    reward, terminated, info = step
    made = gym._Rule(CrashRule(**rule), number_of)
    assert made("seen", reward, terminated, False, info) == found
    assert made.has_named == (found not in ("", "crash", "terminated") and not found.startswith("reward"))


def test_functions_of_a_rule_get_the_step_and_name_it(monkeypatch):
    asked, answers = [], {"f": "hit", "k": "rear end"}
    monkeypatch.setattr(gym, "load_object", lambda name: lambda *given: asked.append((name, given)) or answers[name])
    made = gym._Rule(CrashRule(function="f", kind="k"), number_of)
    step = ("seen", 1.0, True, False, {"crash_kind": "other"})
    assert made(*step) == "rear end"
    assert asked == [("f", step), ("k", step)]
    answers["k"] = None
    assert (made(*step), made.has_named) == ("hit", False)
    answers["f"] = True
    assert made(*step) == "f"
    answers["f"] = False
    assert made(*step) == ""


class Environment(gymnasium.Env):
    """An environment whose steps a test gives."""

    observation_space, action_space = BOX, spaces.Discrete(2)
    made: list = []  # noqa: RUF012

    def __init__(self, **given):
        self.given, self.steps, self.closed = given, [], 0
        Environment.made.append(self)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps.append(("reset", seed))
        self.options = options
        if options:
            options["low"] = "changed"  # as environments do that fill in defaults
        return np.zeros(2, np.float32), {"begin": True}

    def step(self, action):
        self.steps.append(action)
        return Environment.result

    def close(self):
        self.closed += 1


@pytest.fixture
def make(monkeypatch):
    monkeypatch.setattr(Environment, "made", [])
    monkeypatch.setattr(Environment, "result", (np.zeros(2, np.float32), 0.5, False, False, {}), raising=False)
    monkeypatch.setattr(gym, "load_object", lambda name: Environment)

    def make(danger="", arguments=None, reset_options=None, **crash):
        setup = GymSetup(id="m:Environment", kwargs={"a": {"x": 1}}, crash=CrashRule(**crash), danger=danger,
                         reset_options=reset_options)  # fmt: skip
        return GymSimulator(Scenario(simulator="gym", step_length_s=0.5, agents={"ego": AgentSetup()},
                                     tables={"gym": setup}, arguments=arguments or {}), None)  # fmt: skip

    return make


def step(simulator, *result):
    Environment.result = result
    found = simulator.step({"ego": simulator.actions["ego"].encode(1)})
    return [part["ego"] for part in found]


SEEN = np.array([0.5, 0.5], np.float32)


def test_each_episode_has_an_environment_of_its_own_with_its_arguments(make):
    made = make(arguments={"y": ArgumentSetup(default=2, option="a.y")})
    assert [one.given for one in Environment.made] == [{"a": {"x": 1, "y": 2}}]
    observations, infos = made.reset(seed=7, options={"arguments": {"y": 3}})
    assert (observations["ego"].tolist(), infos) == ([0.0, 0.0], {"ego": {"begin": True}})
    assert [one.given for one in Environment.made][1:] == [{"a": {"x": 1, "y": 3}}]
    assert [one.closed for one in Environment.made] == [1, 0]
    assert Environment.made[1].steps == [("reset", 7)]
    made.close()
    assert Environment.made[1].closed == 1
    before = Environment.made[1].np_random.bit_generator.state
    made.reseed(4)
    assert Environment.made[1].np_random.bit_generator.state != before


def test_reset_gets_the_options_of_the_scenario_with_the_values_of_its_arguments(make):
    given = {"low": -0.1, "at": {"x": 1}}
    arguments = {"y": ArgumentSetup(default=2, option="reset_options.at.y"), "z": ArgumentSetup(default=5)}
    made = make(arguments=arguments, reset_options=given)
    for y in (3, 4):
        made.reset(seed=7, options={"arguments": {"y": y, "z": 6}})
        last = Environment.made[-1]
        assert last.given == {"a": {"x": 1}, "z": 6}
        assert last.options == {"low": "changed", "at": {"x": 1, "y": y}}
    assert given == {"low": -0.1, "at": {"x": 1}}  # an environment cannot change what later trials get
    made = make(reset_options={})
    made.reset(seed=7)
    assert Environment.made[-1].options == {}


def test_reset_without_options_may_lack_the_parameter_and_keywords_may_have_its_name(make, monkeypatch):
    monkeypatch.setattr(Environment, "reset", lambda self, seed: (np.zeros(2, np.float32), {}))
    made = make(arguments={"y": ArgumentSetup(default=2, option="reset_options.y")})
    made.reset(seed=7)
    assert Environment.made[0].given == {"a": {"x": 1}, "reset_options": {"y": 2}}
    with pytest.raises(InvalidEpisodeError, match="unexpected keyword argument 'options'"):
        make(reset_options={"y": 2}).reset(seed=7)


def test_step_ends_an_episode_that_is_over_or_has_crashed(make):
    made = make(info="hit")
    made.reset(seed=1)
    observation, reward, over, truncated, info = step(made, SEEN, np.float32(0.5), np.False_, 0, {"n": 1})
    assert (observation.tolist(), reward, type(reward), over, truncated, info) == (
        [0.5, 0.5], 0.5, float, False, False, {"n": 1}
    )  # fmt: skip
    assert (made.agents, made.scene().time_s, made.scene().contacts) == (["ego"], 0.5, ())
    for ended, cut in ((True, False), (False, True)):
        made.reset(seed=1)
        assert step(made, SEEN, 0.5, ended, cut, {})[2:4] == [True, False]
        assert (made.agents, made.scene().contacts) == ([], ())
    made.reset(seed=1)
    assert step(made, SEEN, 0.5, False, False, {"hit": True, "wet": True})[2] is True
    (contact,) = made.scene().contacts
    assert (contact.collider, contact.victim, contact.kind, contact.lane) == ("ego", "", "hit", "")
    assert math.isnan(contact.collider_speed)
    assert made.crash_cell == "hit wet"
    step(made, SEEN, 0.5, False, False, {"hit": True, "dry": True})
    assert (made.scene().contacts, made.crash_cell, made.scene().time_s) == ((), "hit wet", 1.0)
    made.reset(seed=1)
    assert (made.crash_cell, made.agents, made.scene().time_s) == ("", ["ego"], 0.0)
    step(made, SEEN, 0.5, False, False, {"hit": True, "crash_kind": "named"})
    assert (made.crash_cell, made.scene().contacts[0].kind) == ("", "named")


@pytest.mark.parametrize(
    ("danger", "values", "found"),
    [
        ("info.d", [0.25, 0.75, 0.5], 0.75),
        ("info.d", [-1.0], 0.0),
        ("info.d", [7.0], 1.0),
        ("info.d", [np.nan], None),
        ("-info.d", [3.0, 1.0, 4.0], 0.5),
        ("-info.d", [-2.0], 1.0),
        ("info.d", [None], None),
        ("", [0.5], None),
    ],
)
def test_named_danger_is_the_largest_of_an_episode(make, danger, values, found):
    made = make(danger)
    for _ in range(2):
        made.reset(seed=1)
        assert made.named_danger is None
        for value in values:
            step(made, SEEN, 0.5, False, False, {} if value is None else {"d": value})
        assert made.named_danger == found
    if danger:
        with pytest.raises(ForeignError) as caught:
            step(made, SEEN, 0.5, False, False, {"d": "much"})
        assert isinstance(caught.value.error, UnusableValueError)


def test_odd_observations_and_failing_ends_are_noticed_once(make, caplog, monkeypatch):
    made = make()
    made.reset(seed=1)
    for values in ([np.nan, 0.0], [7.0, 0.0], [8.0, 0.0], [0.0, 0.0]):
        step(made, np.array(values, np.float32), 0.5, False, False, {})
    monkeypatch.setattr(Environment, "close", lambda self: 1 / 0)
    made.close(), made.close()
    notices = list(made.notices)
    assert len(notices) == 3
    assert notices[0].endswith("shows its agent an observation that contains NaN")
    assert notices[1].endswith("outside its own observation space")
    assert "cannot be closed: " in notices[2]
    assert [record.getMessage().rpartition(" ")[2] for record in caplog.records] == ["1", "2", "4"]


WRONG = [(False, False), [True], {"a": True}, "False", "", b"1", None, 1j, np.array([True, False]), np.array([]),
         np.array(["1"]), np.array([None]), np.ma.array([1.0], mask=[True]), object()]  # fmt: skip


@pytest.mark.parametrize("value", WRONG, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize(
    ("place", "what", "fix"),
    [
        ("info", "info['hit']", "gym.crash.function"),
        ("function", "the result of m:f", "gym.crash.function"),
        ("danger", "gym.danger = 'info.d'", "gym.danger"),
        ("reward", "the reward", "gym.id"),
        ("terminated", "terminated", "gym.id"),
        ("truncated", "truncated", "gym.id"),
    ],
)
def test_value_that_is_no_number_is_no_truth_value(make, monkeypatch, place, what, fix, value):
    if place == "function" and (value is None or isinstance(value, str)):
        return  # a function that returns nothing has found nothing, and a text describes the crash
    made = make(danger="info.d", info="hit", reward_below=-5.0)
    monkeypatch.setattr(made._rule, "_function", lambda *_: value if place == "function" else None)
    monkeypatch.setattr(made._rule, "_rule", CrashRule(info="hit", reward_below=-5.0, function="m:f"))
    made.reset(seed=1)
    given = {"reward": 0.5, "terminated": False, "truncated": False, place: value}
    info = {key: value for key, name in (("hit", "info"), ("d", "danger")) if place == name}
    with pytest.raises(ForeignError) as caught:
        step(made, SEEN, given["reward"], given["terminated"], given["truncated"], info)
    error = caught.value.error
    assert isinstance(error, UnusableValueError)
    assert (caught.value.party, made.scene().contacts) == ("environment", ())
    assert error.message.startswith(f"{what} is of type {type(value).__name__}")
    assert fix in error.fix


def test_nan_is_reported_once_for_each_value_and_is_no_crash(make, monkeypatch):
    made = make(danger="info.d", info="hit", reward_below=-5.0)
    monkeypatch.setattr(made._rule, "_function", lambda *_: math.nan)
    made.reset(seed=1)
    for _ in range(3):
        result = step(
            made, np.full(2, np.nan, np.float32), np.float32("nan"), False, False, {"hit": math.nan, "d": math.nan}
        )
        assert (result[2], made.scene().contacts, made.named_danger) == (False, (), None)
    names = [notice.partition(" is NaN in the environment 'm:Environment'")[0] for notice in made.notices]
    assert names[:4] == ["the reward", "info['hit']", "the result of ", "gym.danger = 'info.d'"]
    assert names[4].endswith("an observation that contains NaN")
    assert len([name for name in names if "names something that occurred" not in name]) == 5


def test_nan_as_the_end_of_an_episode_is_refused(make):
    made = make()
    made.reset(seed=1)
    with pytest.raises(ForeignError) as caught:
        step(made, SEEN, 0.5, math.nan, False, {})
    assert str(caught.value.error).startswith("terminated is NaN (allowed: ")


@pytest.mark.parametrize(
    ("observation", "nan"),
    [(math.nan, True), (np.float16("nan"), True), ({"a": [1, (np.array([1, np.nan]),)]}, True), ([], False),
     ({"a": "nan", "b": np.array(["nan"]), "c": np.array([1]), "d": None}, False), (np.array([np.inf]), False)],
)  # fmt: skip
def test_nan_is_found_in_observations_of_any_space(observation, nan):
    assert _gymnasium.has_nan(observation) is nan


def test_close_that_does_not_return_is_stopped_and_named(make, monkeypatch):
    monkeypatch.setattr(gym, "_MAX_CLOSE_S", 0.05)

    def hang(self):
        while True:
            with suppress(Exception):
                time.sleep(60)

    monkeypatch.setattr(Environment, "close", hang)
    handler = signal.getsignal(signal.SIGALRM)
    made = make()
    assert list(made.notices) == [
        "the environment 'm:Environment' cannot be closed: its close() was stopped after 0.05 s"
    ]
    assert signal.getsignal(signal.SIGALRM) is handler


def test_environment_whose_spaces_are_read_is_closed_before_the_first_episode(make):
    made = make()
    assert [one.closed for one in Environment.made] == [1]
    made.reset(seed=1)
    made.close(), made.close()
    assert [one.closed for one in Environment.made] == [1, 1]
