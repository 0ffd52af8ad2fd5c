"""Observations and actions of any Gymnasium space, of a user's own too, are recorded and read back as they are."""

from __future__ import annotations

import enum
import subprocess
import sys
import threading
from collections import OrderedDict
from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest
from conftest import examples
from episodes import record_run
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings, strategies as st

from crashhunt.base.foreign_code import ForeignError
from crashhunt.errors import ActionError
from crashhunt.gym import GymSimulator
from crashhunt.gym._descriptor import CrashRule, GymSetup
from crashhunt.recording import (
    decode_value,
    describe_value,
    encode_value,
    first_divergence,
    read_log,
    write_log,
)
from crashhunt.recording._values import OpaqueValue
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators import action_form, native
from crashhunt.simulators._any_space import FlatAction, ObservationForm
from crashhunt.testing import SimulatorContract
from crashhunt.trial import TrialSpec


@dataclass
class Note:
    """A value of a class that no recording knows."""

    text: str
    pages: list[int]


class Notes(gymnasium.Space):
    """A space of a user's own, of the least that Gymnasium demands; it says of nothing whether it can be flattened."""

    def __init__(self, pages: int = 3) -> None:
        super().__init__(None, None)
        self.pages = pages

    def sample(self, mask=None, probability=None):
        return Note("read", self.np_random.integers(9, size=self.pages).tolist())

    def contains(self, x):
        return isinstance(x, Note) and len(x.pages) == self.pages

    @property
    def is_np_flattenable(self):
        raise NotImplementedError


FLOATS = (np.float16, np.float32, np.float64)
INTEGERS = (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64)


@st.composite
def boxes(draw):
    shape = tuple(draw(st.lists(st.integers(0, 3), max_size=2)))
    dtype = draw(st.sampled_from((*FLOATS, *INTEGERS)))
    if dtype in FLOATS:
        low, high = draw(st.sampled_from(((-1.0, 1.0), (-np.inf, np.inf), (0.0, np.inf))))
    else:
        low, high = draw(st.sampled_from(((0, 5), (np.iinfo(dtype).min, np.iinfo(dtype).max))))
    return spaces.Box(low, high, shape, dtype)


LEAVES = st.one_of(
    boxes(),
    st.builds(spaces.Discrete, st.integers(1, 5), start=st.integers(-3, 3)),
    st.builds(spaces.MultiDiscrete, st.lists(st.integers(1, 4), min_size=1, max_size=3)),
    st.builds(spaces.MultiBinary, st.integers(1, 4)),
    st.builds(spaces.Text, st.integers(1, 9), min_length=st.just(0), charset=st.sampled_from(("ab", 'Aä\n"{ 本'))),
    st.builds(spaces.Graph, boxes(), st.sampled_from((None, spaces.Discrete(3), spaces.Box(-1, 1, (2,))))),
    st.builds(Notes, st.integers(0, 3)),
)
NESTED = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.builds(spaces.Dict, st.dictionaries(st.text("abc", min_size=1, max_size=3), inner, max_size=3)),
        st.builds(lambda parts: spaces.Tuple(tuple(parts)), st.lists(inner, max_size=3)),
        st.builds(spaces.Sequence, inner),
        st.builds(lambda parts: spaces.OneOf(tuple(parts)), st.lists(inner, min_size=1, max_size=3)),
    ),
    max_leaves=6,
)
FEW = settings(max_examples=examples(150), deadline=None, suppress_health_check=[HealthCheck.too_slow])


def same(one, other):
    """Whether two values are equal to the bit; of arrays and structures of arrays too."""
    if isinstance(one, np.ndarray | np.generic):
        one, other = np.asarray(one), np.asarray(other)
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


def agree(shown, observation):
    """Whether an agent receives what the environment returned; flattening changes the class of a number only."""
    if isinstance(observation, np.generic) and isinstance(shown, np.ndarray):
        return shown.shape == () and shown.item() == observation.item()
    if isinstance(observation, dict):
        return shown.keys() == observation.keys() and all(agree(shown[key], observation[key]) for key in observation)
    if isinstance(observation, tuple) and not hasattr(observation, "_fields"):
        return len(shown) == len(observation) and all(map(agree, shown, observation))
    return same(shown, observation) or (np.isscalar(shown) and shown == observation)


@FEW
@given(NESTED, st.integers(0, 2**31))
def test_action_of_any_space_reaches_the_environment_as_it_is(space, seed):
    space.seed(seed)
    form = action_form(space)
    action = space.sample()
    encoded = form.encode(action)
    assert agree(native(form, encoded), action)
    again = form.encode(encoded)
    assert (again.dtype, again.tobytes()) == (encoded.dtype, encoded.tobytes())
    assert agree(native(form, again), action)


@FEW
@given(NESTED, st.integers(0, 2**31))
def test_text_of_a_value_is_read_back_equal(space, seed):
    space.seed(seed)
    value = space.sample()
    array = encode_value(value)
    read, is_whole = decode_value(array)
    assert same(encode_value(read), array)
    assert is_whole == (b'{"opaque":' not in array.tobytes())
    assert same(read, value) or not is_whole
    assert "\n" not in describe_value(array)
    assert len(describe_value(array, 30)) <= 30


class Odd(enum.IntEnum):
    ONE = 1


class Silent:
    def __reduce_ex__(self, protocol):
        raise RuntimeError("no words")


PLAIN = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.binary(),
        st.complex_numbers(allow_nan=False), st.text("ab").map(np.str_), st.floats(width=32).map(np.float32),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.lists(inner, max_size=4).map(tuple), st.dictionaries(st.text(), inner),
        st.lists(inner, max_size=3).map(lambda items: np.array([*items, None], object)),
    ),
    max_leaves=4,
)  # fmt: skip
SETS = st.frozensets(st.text(), max_size=4) | st.sets(st.integers(), max_size=4)


@FEW
@given(PLAIN | SETS)
def test_plain_values_are_read_back_equal(value):
    read, is_whole = decode_value(encode_value(value))
    assert is_whole
    assert read == value if isinstance(value, set | frozenset) else repr(read) == repr(value)  # NaN differs from NaN
    assert type(read) is type(value)


@given(st.binary() | st.text().map(str.encode))
def test_what_is_no_recorded_value_is_a_value_error(data):
    array = np.frombuffer(data, np.uint8)
    try:
        read, _ = decode_value(array)
    except ValueError:
        assert describe_value(array) == "(damaged)"
    else:
        assert same(encode_value(read), array) or isinstance(read, int | float | str | None)


@pytest.mark.parametrize(
    "value",
    [Note("a", [1]), OrderedDict(a=Note("b", [])), Odd.ONE, np.ma.masked_array([1, 2], [True, False]), range(3), Note],
)
def test_value_of_another_class_is_known_by_class_and_digest(value):
    array = encode_value(value)
    read, is_whole = decode_value(array)
    assert not is_whole
    assert isinstance(read, OpaqueValue)
    kind = value if isinstance(value, type) else type(value)
    assert read.kind == f"{kind.__module__}.{kind.__qualname__}"
    assert bool(read.digest) != isinstance(value, type)
    assert read == decode_value(encode_value(value))[0]
    assert kind.__name__ in describe_value(array)


def test_digest_shows_what_differs_inside_an_object():
    texts = {encode_value(Note("a", pages)).tobytes() for pages in ([1], [2], [1, 2], [])}
    assert len(texts) == 4


def test_value_without_readable_content_is_known_by_its_class():
    for value in (threading.Lock(), Silent(), [].__iter__):
        read, _ = decode_value(encode_value(value))
        assert read.digest == "" or isinstance(value, type([].__iter__))
    loop = []
    loop.append(loop)
    assert decode_value(encode_value(loop))[0][0].kind == "builtins.list"
    deep = ()
    for _ in range(5000):
        deep = (deep,)
    assert not decode_value(encode_value(deep))[1]


WRITES = """
from dataclasses import dataclass
from crashhunt.recording import encode_value

@dataclass
class Note:
    text: str
    names: set

print(encode_value({"n": Note("a", {"x", "y", "z"}), "s": {"x", "y", "z"}}).tobytes())
"""


def test_same_value_has_the_same_text_in_another_process():
    found = {
        subprocess.run(
            [sys.executable, "-c", WRITES], env={"PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert len(found) == 1


# A whole episode.


class Post(gymnasium.Env):
    """Letters of any kind; a crash where a letter is torn."""

    observation_space = spaces.Dict(
        {"address": spaces.Text(9), "note": Notes(2), "weights": spaces.Sequence(spaces.Box(0, 9, (2,), np.float32))}
    )
    action_space = spaces.OneOf((spaces.Text(3), spaces.Discrete(4), Notes(1)))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.got = 0, []
        return self._look(), {}

    def step(self, action):
        self.steps += 1
        self.got.append(action)
        return self._look(), 1.0, False, False, {"torn": self.steps == 7}

    def _look(self):
        weights = tuple(self.np_random.random((self.steps % 3, 2), dtype=np.float32))
        return {"address": f"no{self.steps}", "note": Note("x", [self.steps, 1]), "weights": weights}


gymnasium.register("Post-v0", entry_point=Post)


class Carrier:
    def __init__(self):
        self.seen = []

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.seen.append(observation)
        self.step += 1
        return ((0, "abc"), (np.int64(1), np.int64(2)), (2, Note("y", [5])))[self.step % 3]


def post(tmp_path):
    tables = {"gym": GymSetup(id="Post-v0", crash=CrashRule(info="torn"))}
    return GymSimulator(Scenario(simulator="gym", tables=tables, agents={"me": AgentSetup()}), tmp_path)


class TestPost(SimulatorContract):
    @pytest.fixture
    def make(self, tmp_path):
        return lambda: post(tmp_path)


def drive(tmp_path, name, carrier):
    simulator = post(tmp_path)
    return *record_run(tmp_path / name, TrialSpec(0, 1, {}, {}, 10), simulator, carrier, oracles=()), simulator


def test_episode_of_any_spaces_is_recorded_shown_and_compared(tmp_path):
    carrier = Carrier()
    result, recording, simulator = drive(tmp_path, "one", carrier)
    assert result.failure is None
    assert result.steps == 7
    assert [seen["address"] for seen in carrier.seen] == [f"no{n}" for n in range(7)]
    assert carrier.seen[3]["note"] == Note("x", [3, 1])
    assert [len(seen["weights"]) for seen in carrier.seen] == [0, 1, 2, 0, 1, 2, 0]
    assert simulator._env.unwrapped.got[0] == (1, 2)
    assert simulator._env.unwrapped.got[1] == (2, Note("y", [5]))

    write_log(tmp_path / "log.mcap", recording)
    again = read_log(tmp_path / "log.mcap")
    assert again.digest == result.digest
    shown = [decode_value(array)[0] for array in again.observations("me")]
    assert [one["address"] for one in shown] == [f"no{n}" for n in range(7)]
    assert decode_value(again.actions("me")[2])[0] == (0, "abc")
    assert first_divergence(recording, again) is None

    class Other(Carrier):
        def act(self, observation):
            return (0, "ab") if self.step == 2 and not self.seen.append(observation) else super().act(observation)

    _, other, _ = drive(tmp_path, "two", Other())
    difference = first_divergence(recording, other)
    assert (difference.step, difference.agent, difference.field) == (3, "me", "action")
    assert (difference.recorded, difference.replayed) == ("(0, 'abc')", "(0, 'ab')")


@pytest.mark.parametrize("action", [(0, "abcd"), (1, 9), "abc", None, (2, Note("y", [])), (2, Silent())])
def test_action_outside_such_a_space_is_the_agents_fault_in_one_line(action):
    with pytest.raises(ActionError, match=r"the action .* is not in OneOf\(") as caught:
        action_form(Post.action_space).encode(action)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("side", [2, -1, "left"])
def test_observation_that_its_space_cannot_hold_is_not_recorded_as_another(side):
    space = spaces.Dict({"side": spaces.Discrete(2), "x": spaces.Box(-1, 1, (1,))})
    form = ObservationForm(space)
    assert form.encode({"side": 1, "x": np.array([7.0])}).tolist() == [0.0, 1.0, 7.0]  # outside, but recorded as it is
    with pytest.raises(ForeignError) as caught:
        form.encode({"side": side, "x": np.zeros(1)})
    assert str(caught.value.error).startswith("observation['side'] does not have the form of Discrete(2): it is ")


@pytest.mark.parametrize(
    ("part", "place", "what"),
    [
        ({"image": np.zeros((1, 3), np.uint8)}, "['image']", "array([[0, 0, 0]], dtype=uint8), of shape (1, 3)"),
        ({}, "['image']", "absent"),
        (None, "", "None"),
    ],
)
def test_wrong_part_of_an_observation_is_named(part, place, what):
    """Gymnasium's error named the shape of another part."""
    space = spaces.Box(0, 255, (2, 2), np.uint8)
    image = spaces.Dict({"image": space})
    form = ObservationForm(spaces.Dict({"a": spaces.Tuple((spaces.Discrete(2), image)), "b": spaces.Discrete(2)}))
    with pytest.raises(ForeignError) as caught:
        form.encode({"a": (1, part), "b": 1})
    form_of = space if place else image
    assert str(caught.value.error) == f"observation['a'][1]{place} does not have the form of {form_of}: it is {what}"
    assert form.misfit({"a": (1, {"image": np.full((2, 2), 7, np.uint8)}), "b": 2}) == "['b']"


def test_axes_of_an_observation_are_not_exchanged():
    """An image of height, width and channels was shown as one of channels, height and width."""
    form = ObservationForm(spaces.Box(-9, 9, (3, 4, 5)))
    assert np.array_equal(form.encode(np.arange(60.0)).ravel(), np.arange(60))
    for shape, other in (((3,), (1, 3)), ((1,), ()), ((2, 3), (6,))):
        assert ObservationForm(spaces.Box(-1, 1, shape)).encode(np.zeros(other)).shape == shape
    for shape in ((4, 5, 3), (12, 5), (59,)):
        with pytest.raises(ForeignError) as caught:
            form.encode(np.zeros(shape))
        assert str(caught.value.error) == f"the observation has the shape {shape}, and its space (3, 4, 5)"


@pytest.mark.parametrize(("value", "fits"), [([0.5], False), ([300], False), ([7.0], True), (np.array([7]), True)])
def test_observation_that_another_type_would_change_lies_outside_the_space(value, fits):
    form = ObservationForm(spaces.Box(0, 255, (1,), np.uint8))
    array = form.encode(np.array(value))
    assert form.contains(np.array(value), array) is fits
    plain = ObservationForm(spaces.Box(0, 1, (1,), np.float32))
    assert plain.contains(np.array([0.1]), plain.encode(np.array([0.1])))  # only rounded


@pytest.mark.parametrize(("high", "is_flat"), [(2**24, True), (2**62, False)])
def test_integers_that_flattening_would_round_are_recorded_as_values(high, is_flat):
    space = spaces.Dict({"n": spaces.Box(0, high, (1,), np.int32 if is_flat else np.int64), "x": spaces.Box(-1, 1, ())})
    form = ObservationForm(space)
    observation = {"n": np.array([high - 1], space["n"].dtype), "x": np.array(0.5, np.float32)}
    assert form.restore(form.encode(observation))["n"].item() == high - 1
    assert form.flattened == is_flat
    assert isinstance(action_form(space), FlatAction) == is_flat
