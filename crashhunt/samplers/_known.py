"""Crashes that are known: a hunt that goes on is after other ones, and not after these again and again."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.samplers._told import Told

__all__ = ["KnownCrashes"]

_MOST = 32  # crashes around which nothing more is looked for
_KINDS = 256  # that are remembered
_AROUND = 0.1  # of a crash, times the square root of the dimensions: there, nothing more is looked for
_JUST_THERE = 0.02  # likewise, of a kind that is new: the next crash there may be another
_WIDER, _WIDEST = 1.5, 0.45  # so many times that, where all that is found is just outside; up to so much


@dataclass(slots=True, eq=False)
class _Crash:
    point: NDArray[np.float64]
    kind: str
    radius: float

    def away(self, point: NDArray[np.float64]) -> float:
        return float(np.linalg.norm(self.point - point))


class KnownCrashes:
    """The places in the space of arguments that are not worth another trial.

    What a crash keeps others from depends on its kind. Where the result does not tell manner and place, arguments are
    all there is, and nothing more is looked for around it. Where it does, the first crash of a kind keeps
    next to nothing away, as the same arguments may lead to others; the next one of that kind does.

    Args:
        dimensions: of the space.
    """

    def __init__(self, dimensions: int) -> None:
        self._unit = math.sqrt(dimensions)
        self._crashes: deque[_Crash] = deque(maxlen=_MOST)
        self._kinds: dict[str, None] = {}

    def __bool__(self) -> bool:
        return bool(self._crashes)

    def cover(self, point: NDArray[np.float64]) -> bool:
        """Whether a crash is known near to it."""
        return any(crash.away(point) < crash.radius for crash in self._crashes)

    def add(self, told: Told) -> bool:
        """Take in a crash; return whether more or less is known by it than before."""
        new = bool(told.kind) and told.kind not in self._kinds
        self._kinds[told.kind] = None
        if len(self._kinds) > _KINDS:
            del self._kinds[next(iter(self._kinds))]
        around = [crash for crash in self._crashes if crash.away(told.point) < crash.radius]
        if new:  # so there is more to find here than was thought
            for crash in around:
                crash.radius = min(crash.radius / _WIDER, crash.away(told.point))
        elif around:
            return False
        self._crashes.append(_Crash(told.point, told.kind, (_JUST_THERE if new else _AROUND) * self._unit))
        return True

    def widen(self, top: NDArray[np.float64]) -> bool:
        """Keep further away from the nearest crash, if what is most dangerous is just beside it; return whether so."""
        nearest = min(self._crashes, key=lambda crash: crash.away(top) / crash.radius)
        if nearest.away(top) >= _WIDER * nearest.radius:
            return False
        wider = max(nearest.radius * _WIDER, _AROUND * self._unit)
        nearest.radius = wider if wider < _WIDEST * self._unit else _AROUND * self._unit
        return True
