"""Numbers and truth values of a user's code."""

from __future__ import annotations

import enum
import math
from decimal import Decimal
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.base.foreign_code import number_of, truth_of
from crashhunt.errors import UnusableValueError


class Status(enum.IntEnum):
    DRIVES = 0
    CRASHED = 2


class Level(int):
    """A user's own number."""


def tensor_of(value, shape):
    """What torch and jax have in common with NumPy."""
    return SimpleNamespace(shape=shape, item=lambda: value)


@pytest.mark.parametrize(
    ("value", "number"),
    [
        (Status.CRASHED, 2.0), (Level(3), 3.0), (Decimal("0.5"), 0.5), (Fraction(1, 4), 0.25), (np.float16(0.5), 0.5),
        (np.uint8(7), 7.0), (np.array([[4]], object), 4.0), (np.array([np.array([5])], object), 5.0),
        (np.ma.array([6.0], mask=[False]), 6.0), (tensor_of(value=True, shape=(1, 1)), 1.0), (math.inf, math.inf),
    ],
)  # fmt: skip
def test_numbers_of_any_library_are_numbers(value, number):
    assert number_of(value, "x", "") == number
    assert truth_of(value, "x", "") is True
    assert math.isnan(number_of(np.array([np.nan]), "x", ""))


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (enum.Enum("Light", ["RED"]).RED, "x is of type Light: <Light.RED: 1> (allowed: a bool, a number, an array"),
        (np.zeros((2, 3)), "x is of type ndarray with 6 elements: array("),
        (tensor_of(1.0, (2,)), "x is of type SimpleNamespace with 2 elements: "),
        (tensor_of(None, ()), "x is of type SimpleNamespace: "),
        (np.ma.masked, "x is of type MaskedConstant: masked"),
        (np.timedelta64(1, "s"), "x is of type timedelta64: "),
        (np.float64, "x is of type type: <class 'numpy.float64'>"),
        (10**400, "x is of type int: 1000"),
        (Decimal("sNaN"), "x is of type Decimal: "),
        ("1" * 500, f"x is of type str: '{'1' * 198}… (allowed"),
    ],
)
def test_anything_else_is_refused_with_its_type(value, says):
    for function in (number_of, truth_of):
        with pytest.raises(UnusableValueError) as caught:
            function(value, "x", "return a bool")
        assert caught.value.message.startswith(says)
        assert caught.value.fix == "return a bool"
        assert caught.value.exit_code == 2
