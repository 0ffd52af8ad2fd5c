"""Whatever an agent returns is an action or its own error, on SUMO, highway-env and Gymnasium alike."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import examples
from gymnasium import spaces
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as arrays

from crashhunt.errors import ActionError
from crashhunt.simulators import MetaAction, SpeedAndLaneChange, action_form, native

STRUCTURE = spaces.Dict(
    steering=spaces.Box(-1.0, 1.0, (1,), np.float32),
    gear=spaces.Discrete(3),
    more=spaces.Tuple([spaces.MultiBinary(2)]),
)
FORMS = {
    "sumo": SpeedAndLaneChange(),
    "meta": MetaAction(),
    "steering": action_form(spaces.Box(-1.0, 1.0, (2,), np.float32)),
    "unbounded": action_form(spaces.Box(-np.inf, np.inf, (2,), np.float32)),
    "bytes": action_form(spaces.Box(0, 255, (2,), np.uint8)),
    "signed": action_form(spaces.Box(-100, 100, (2, 1), np.int8)),
    "shifted": action_form(spaces.Discrete(3, start=-1)),
    "several": action_form(spaces.MultiDiscrete([3, 2])),
    "switches": action_form(spaces.MultiBinary(2)),
    "structure": action_form(STRUCTURE),
}

numbers = st.one_of(
    st.booleans(), st.integers(-3, 6), st.integers(-(2**70), 2**70), st.sampled_from([2**64 - 1, 2**32, 256, 10**400]),
    st.floats(), st.sampled_from([1e300, -0.0, 1.0, 2.0, 0.5]), st.complex_numbers(), st.none(), st.text(max_size=2),
)  # fmt: skip
kinds = st.sampled_from([np.float16, np.float32, np.float64, np.int8, np.uint8, np.int64, np.uint64, bool, complex,
                         object, "U2", "M8[s]", "m8[s]"])  # fmt: skip
shapes = st.sampled_from([(), (1,), (2,), (2, 1), (1, 2), (1, 1), (0,), (5,), (6,)])


@st.composite
def shaped(draw):
    kind, shape = draw(kinds), draw(shapes)
    array = draw(arrays.arrays(kind, shape, elements=numbers if kind is object else None))
    how = draw(st.sampled_from(["plain", "masked", "list", "read only"]))
    if how == "masked":
        return np.ma.array(array, mask=draw(arrays.arrays(bool, shape)))
    if how == "read only":
        array.flags.writeable = False
    return array.tolist() if how == "list" else array


parts = numbers | shaped()
anything = st.one_of(
    parts, st.lists(parts, max_size=3), st.tuples(parts, parts), st.dictionaries(st.sampled_from("ab"), parts),
    st.frozensets(st.integers(-1, 1)), st.tuples(st.floats(0, 100), st.integers(-1, 1)),
    st.fixed_dictionaries({"steering": parts, "gear": parts, "more": st.tuples(parts)}),
)  # fmt: skip


@pytest.mark.parametrize("name", FORMS)
@settings(max_examples=examples(60))
@given(action=anything)
def test_an_action_is_taken_as_it_is_or_refused(name, action):
    form = FORMS[name]
    usual = form.encode(form.space.sample())
    try:
        encoded = form.encode(action)
    except ActionError as error:
        assert "\n" not in str(error)
        assert len(str(error)) < 500
        return
    assert (encoded.dtype, encoded.shape) == (usual.dtype, usual.shape)
    assert np.array_equal(form.encode(encoded), encoded)
    if name == "sumo":
        assert 0 <= encoded[0] <= 100
        assert encoded[1] in (-1, 0, 1)
    else:
        assert form.space.contains(native(form, encoded))
    if not isinstance(action, dict):
        assert not np.ma.is_masked(action)
        given_values = np.asarray(action, object).ravel().tolist()
        assert all(not isinstance(value, complex | np.complexfloating | str) for value in given_values)
        whole = encoded.dtype.kind in "biu"
        for one, two in zip(given_values, encoded.ravel().tolist(), strict=True):
            assert one == two if whole else (one == two or abs(one - two) <= 1e-3 * abs(one) + 1e-40)


@pytest.mark.parametrize(
    ("name", "action"),
    [
        ("sumo", np.array([[15.0], [1.0]])),
        ("sumo", np.array([15.0 + 2j, 1.0])),
        ("sumo", (np.complex64(3), 0)),
        ("sumo", {15.0: "fast", 0: "straight"}),
        ("sumo", np.ma.array([15.0, 1.0], mask=[True, False])),
        ("steering", np.ma.array([0.5, 0.5], mask=[True, False], dtype=np.float32)),
        ("unbounded", np.array([1e300, 0.0])),
        ("bytes", np.array([-1, 300])),
        ("shifted", 2**64 - 1),
        ("structure", np.array([0.5, 1.0, 1.0, 0.0, 1.0, 1.0])),  # two gears at once
    ],
)
def test_what_was_once_taken_for_another_action_is_refused(name, action):
    with pytest.raises(ActionError):
        FORMS[name].encode(action)


def test_an_action_is_its_own_whatever_the_agent_does_with_its_array():
    array = np.array([0.5, 0.5], np.float32)
    encoded = FORMS["steering"].encode(array)
    array[:] = 1.0
    assert encoded.tolist() == [0.5, 0.5]


class Silent:
    def __repr__(self):
        raise RuntimeError("no")

    def __array__(self, dtype=None, copy=None):
        raise KeyError("no")

    def __iter__(self):
        raise MemoryError


class Interrupted:
    """An action during whose first conversion a signal handler of the agent raises an error."""

    def __init__(self):
        self.conversions = 0

    def __array__(self, dtype=None, copy=None):
        return np.array([*self])

    def __iter__(self):
        self.conversions += 1
        if self.conversions == 1:
            raise ZeroDivisionError("of a signal handler")
        return iter((0.5, 0.0))


@pytest.mark.parametrize("form", [FORMS["steering"], SpeedAndLaneChange()], ids=["steering", "speed_and_lane"])
def test_an_exception_that_does_not_come_again_is_not_that_of_the_action(form):
    with pytest.raises(ZeroDivisionError, match="of a signal handler"):
        form.encode(Interrupted())


@pytest.mark.parametrize("name", FORMS)
def test_an_object_that_fails_when_it_is_looked_at_is_refused(name):
    with pytest.raises(ActionError, match=r"of class Silent, whose repr raises RuntimeError, is not"):
        FORMS[name].encode(Silent())


def test_a_lane_change_is_whole():
    form = SpeedAndLaneChange()
    for change in (-1, 0, 1, -1.0, 1.0, np.int8(-1), True):
        assert form.encode((10.0, change)).tolist() == [10.0, float(change)]
    for change in (0.5, -0.5, 0.999, 2, -2, float("nan"), None, "1"):
        with pytest.raises(ActionError, match="not \\(target_speed, lane_change\\)"):
            form.encode((10.0, change))
    for speed in (0.0, 100.0):
        assert form.encode((speed, 0)).tolist() == [speed, 0.0]
    for speed in (-1e-9, 100.1, float("nan"), float("inf")):
        with pytest.raises(ActionError, match="within 0 and 100 m/s"):
            form.encode((speed, 0))
