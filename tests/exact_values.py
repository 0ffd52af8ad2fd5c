"""What tests compare where every bit has to be the same."""

from __future__ import annotations

from typing import Any

import numpy as np

_FLOATS, _ROWS, _PLAIN = (float, np.floating), (list, tuple), (int, str, np.generic)


def exact(value: Any) -> Any:
    """Return the types, shapes and bits of a value: NumPy's floats are not Python's to what multiplies them by float32.

    Of an object that is no data, it returns the type.
    """
    if isinstance(value, _FLOATS):
        number = float(value)
        # Other equal floats have equal bits; to write them down takes ten times as long.
        return type(value), number if number and number == number else repr(number)
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: exact(inner) for key, inner in value.items()}
    if isinstance(value, _ROWS):
        return type(value), [exact(inner) for inner in value]
    return type(value), repr(value) if value is None or isinstance(value, _PLAIN) else ""
