"""Actions at the limits of what their data type can hold, and their texts in messages."""

from __future__ import annotations

import numpy as np
import pytest

from crashhunt.base.foreign_code import describe_value
from crashhunt.errors import ActionError
from crashhunt.simulators import MetaAction
from crashhunt.simulators._actions import cast


@pytest.mark.parametrize(
    ("action", "dtype", "found"),
    [
        (3, "i1", 3),
        (127, "i1", 127),
        (128, "i1", None),
        (-129, "i1", None),
        (True, "i8", 1),
        (2, "?", None),
        (0.5, "i8", None),
        (1.0, "i8", None),
        (0.1, "f4", np.float32(0.1)),
        (1e39, "f4", None),
        (-1e39, "f4", None),
        (np.inf, "f4", np.inf),
        (np.nan, "f4", np.nan),
        (3.4e38, "f4", np.float32(3.4e38)),
        (1j, "f8", None),
        ("1", "f8", None),
        (2**63, "i8", None),
    ],
)
def test_number_is_cast_where_its_type_can_hold_it(action, dtype, found):
    if found is None:
        with pytest.raises((ValueError, TypeError)):
            cast(action, np.dtype(dtype))
        return
    array = cast(action, np.dtype(dtype))
    assert array.dtype == np.dtype(dtype)
    assert np.array_equal(array, np.array(found, dtype), equal_nan=np.dtype(dtype).kind == "f")


@pytest.mark.parametrize(("length", "cut"), [(198, False), (199, True), (300, True)])
def test_text_of_an_action_is_one_line_of_200_characters(length, cut):
    text = describe_value("x" * length)
    assert text == (f"'{'x' * 198}…" if cut else f"'{'x' * length}'")
    assert len(text) <= 200
    lines = type("Lines", (), {"__repr__": lambda self: " a \n\t b "})
    assert describe_value(lines()) == "a b"


@pytest.mark.parametrize("action", [0, 4, np.int64(4), np.array([3]), np.array([[2]]), np.int8(1), True])
def test_meta_action_is_a_number_below_the_count(action):
    found = MetaAction().encode(action)
    assert (found.dtype, found.shape, found[0]) == (np.int64, (1,), int(np.asarray(action).item()))


@pytest.mark.parametrize("action", [-1, 5, np.int64(5), np.array([1, 2]), 1.0, "1", None])
def test_number_without_a_meta_action_is_refused(action):
    with pytest.raises(ActionError, match="return an action in this space"):
        MetaAction().encode(action)
    assert MetaAction(("SLOWER", "IDLE")).space.meanings == ("SLOWER", "IDLE")
    with pytest.raises(ActionError):
        MetaAction(("SLOWER", "IDLE")).encode(2)
