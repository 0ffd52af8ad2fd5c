"""What tests compare where every bit has to be the same."""

from __future__ import annotations

from typing import Any

import numpy as np


def exact(value: Any) -> Any:
    """Return the types, shapes and bits of a value: NumPy's floats are not Python's to what multiplies them by float32.

    Of an object that is no data, it returns the type.
    """
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: exact(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return type(value), [exact(inner) for inner in value]
    if isinstance(value, float | np.floating):
        return type(value), float(value).hex()
    return type(value), repr(value) if value is None or isinstance(value, int | str | np.generic) else ""
