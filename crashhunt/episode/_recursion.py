"""A bound on how deep Python may recurse in a process that runs agents."""

from __future__ import annotations

import sys
from typing import Final

__all__ = ["MAX_RECURSION_LIMIT", "bound_recursion"]

MAX_RECURSION_LIMIT: Final = 200_000
"""As deep as this, calls of Python functions take 50 MB and 0.3 s."""

_set_limit = sys.setrecursionlimit


def bound_recursion() -> None:
    """Have `sys.setrecursionlimit` set `MAX_RECURSION_LIMIT` where it is asked for more.

    Python allocates the frames of Python functions on the heap, so endless recursion without a limit fills the memory
    of the machine in minutes. With the bound it ends in a `RecursionError`.
    """
    sys.setrecursionlimit = setrecursionlimit


def setrecursionlimit(limit: int, /) -> None:
    """Set how deep Python may recurse, at most `MAX_RECURSION_LIMIT`."""
    _set_limit(min(limit, MAX_RECURSION_LIMIT))
