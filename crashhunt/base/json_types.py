"""The types of JSON data of unknown structure: everything that a JSON file may contain.

Data of a known structure are converted from a dataclass (`crashhunt.base.codec`), or have a `TypedDict` in the module
that writes them. In both cases, the type checker finds misspelt keys. A `TypedDict` is for data that are never objects,
such as messages: at run time it is a dict, and nothing is converted or checked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NotRequired, TypeAlias, TypedDict, final

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
"""What `json.loads` returns."""

Plain: TypeAlias = Mapping[str, object]
"""An object that is only looked through or written: any `TypedDict` is one."""


class ErrorWords(TypedDict):
    """The texts of an error; the traceback is present only for failures of crashhunt itself."""

    message: str
    fix: str
    where: str
    traceback: NotRequired[str]


@final
class ErrorData(TypedDict):
    """The form in which every command prints an error with ``--json``."""

    error: ErrorWords


def finite(value: float) -> float | None:
    """Return a number for JSON: null replaces infinity and NaN, which JSON lacks."""
    return value if math.isfinite(value) else None
