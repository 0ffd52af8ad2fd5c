"""The types of plain data whose shape nobody knows before it is looked at: what a JSON file may hold.

Where the shape is known, it is a `TypedDict` beside what writes it, and the type checker finds a key that is misspelt.
All of them are for the checker: at run time they are dicts, and nothing is converted or checked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeAlias, TypedDict, final

__all__ = ["ErrorData", "ErrorWords", "Json", "Plain", "finite", "finite_values"]

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
"""What `json.loads` returns."""

Plain: TypeAlias = Mapping[str, object]
"""An object that is only looked through or written: any `TypedDict` is one."""


class ErrorWords(TypedDict):
    """What an error says."""

    message: str
    fix: str
    where: str


@final
class ErrorData(TypedDict):
    """The shape that every command prints under ``--json``."""

    error: ErrorWords


def finite(value: float) -> float | None:
    """Return a number for JSON, which has no infinity and no NaN: null instead."""
    return value if math.isfinite(value) else None


def finite_values(data: Plain) -> dict[str, object]:
    """Return plain data with null instead of what is not a finite number."""
    return {name: finite(value) if isinstance(value, float) else value for name, value in data.items()}
