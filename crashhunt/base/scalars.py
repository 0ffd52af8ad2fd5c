"""Values of a user's code that crashhunt compares or uses as truth values: only bools and numbers are accepted.

Python gives every object a truth value: that of ``(False, False)`` and ``"False"`` is true. Therefore, no value of a
user's code is passed to `bool` or `float` unchecked.
"""

from __future__ import annotations

import math
import sys
from decimal import Decimal
from numbers import Real
from typing import Any, Final, Protocol

from crashhunt.base.capabilities import supports
from crashhunt.base.errors import UnusableValueError

_ALLOWED: Final = "a bool, a number, an array with one element"
_MAX_CHARACTERS: Final = 200  # of a value in an error message
_MAX_NESTING: Final = 4  # an array with one element may contain another such array


class _Array(Protocol):
    """What the arrays of NumPy, torch, jax and pandas have in common."""

    shape: tuple[int, ...]

    def item(self) -> Any:
        """Return the only element."""


def number_of(value: object, what: str, fix: str) -> float:
    """Return a number of a user's code: a bool, a number, or the only element of an array; NaN is returned as it is.

    Args:
        value: The value.
        what: The name of the value for the message.
        fix: The fix for the message.

    Raises:
        UnusableValueError: The value is anything else.
    """
    try:
        return float(value if type(value) in (float, bool, int) else _only_element(value))  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        shape = _shape_of(value)
        size = f" with {math.prod(shape)} elements" if shape is not None and math.prod(shape) != 1 else ""
        kind: str = type.__dict__["__name__"].__get__(type(value))  # a metaclass may define its own ``__name__``
        message = f"{what} is of type {kind}{size}: {describe_value(value)} (allowed: {_ALLOWED})"
        raise UnusableValueError(message, fix=fix) from None


def truth_of(value: object, what: str, fix: str) -> bool:
    """Return whether a bool or number of a user's code is true.

    Args:
        value: The value.
        what: The name of the value for the message.
        fix: The fix for the message.

    Raises:
        UnusableValueError: The value is neither a bool nor a number, as for `number_of`, or it is NaN.
    """
    number = number_of(value, what, fix)
    if math.isnan(number):
        raise UnusableValueError(f"{what} is NaN (allowed: {_ALLOWED})", fix=fix)
    return number != 0


def _only_element(value: Any) -> Any:
    """Return the number that a value contains.

    Raises:
        TypeError: The value is no number, and no array with a number as its only element.
    """
    for _ in range(_MAX_NESTING):
        if isinstance(value, Real | Decimal):
            return value
        shape = _shape_of(value)
        if shape is None or math.prod(shape) != 1 or is_masked(value):
            break
        value = value.item()  # of NumPy, torch, jax and pandas
    raise TypeError


def _shape_of(value: object) -> tuple[int, ...] | None:
    """Return the shape of an array of any library; None if the value is no array."""
    if isinstance(value, type) or not supports(value, _Array):
        return None
    return value.shape if isinstance(value.shape, tuple) else None


def is_masked(value: object) -> bool:
    """Return whether the value is an array with a masked element."""
    ma = sys.modules.get("numpy.ma")  # NumPy imports this module on first use, so without it no masked array exists
    return ma is not None and isinstance(value, ma.MaskedArray) and bool(ma.is_masked(value))


def describe_value(value: object) -> str:
    """Return the text of a value for an error message: one line of at most 200 characters."""
    try:
        text = " ".join(repr(value).split())
    except Exception as error:
        text = f"of class {type(value).__name__}, whose repr raises {type(error).__name__},"
    return text if len(text) <= _MAX_CHARACTERS else f"{text[: _MAX_CHARACTERS - 1]}…"
