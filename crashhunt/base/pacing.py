"""Values that are expensive to compute: they are computed again for new data, and only in a small share of the time."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

_MAX_SHARE_OF_TIME = 0.05  # that the computations of a value may take


class Paced(Generic[T]):
    """Caches a value with the version of the data from which it was computed.

    ``longest_pause_s`` is the longest time for which an outdated value is returned because the computation is slow.
    """

    def __init__(self, longest_pause_s: float = math.inf) -> None:
        self._made: tuple[object, T] | None = None
        self._due = 0.0
        self._longest_pause_s = longest_pause_s

    def __call__(self, version: object, make: Callable[[], T], *, now: bool = False) -> T:
        """Return the value, which may be out of date unless ``now``; compute it if necessary."""
        began = time.monotonic()
        if self._made is not None and (self._made[0] == version or (began < self._due and not now)):
            return self._made[1]
        self._made = version, make()
        ended = time.monotonic()
        self._due = ended + min((ended - began) / _MAX_SHARE_OF_TIME, self._longest_pause_s)
        return self._made[1]
