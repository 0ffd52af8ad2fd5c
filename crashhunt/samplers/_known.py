"""Crashes that are known: a hunt that goes on is after other ones, and not after these again and again."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.samplers._told import Told

__all__ = ["KnownCrashes"]

_MOST = 32  # crashes around which nothing more is looked for
_KINDS = 256  # that are remembered
_SEEDS = 1024  # likewise
_AROUND = 0.1  # of a crash, times the square root of the dimensions: there, nothing more is looked for
_JUST_THERE = 0.02  # likewise, for as long as the next crash there may be of another kind
_AGAIN = 3  # crashes in a row there that are of known kinds: then the next one is new in one of five, at most
_WIDER, _WIDEST = 1.5, 0.45  # so many times that, where all that is found is just outside; up to so much


class KnownCrashes:
    """The places in the space of arguments that are not worth another trial.

    What a crash keeps others from depends on its kind. Where the result does not tell manner and place, arguments are
    all there is, and nothing more is looked for around it. Where it does, a crash keeps next to nothing away, as the
    same arguments may lead to others, until several in a row there were of known kinds.

    The same traffic leads to the same crash again even where arguments are others, so nothing keeps the seed of one.

    Args:
        dimensions: of the space.
    """

    def __init__(self, dimensions: int) -> None:
        self._unit = math.sqrt(dimensions)
        self._points = np.empty((0, dimensions))
        self._radii = np.empty(0)
        self._kinds: dict[str, None] = {}
        self._seeds: dict[int, None] = {}
        self._again: list[NDArray[np.float64]] = []  # the latest crashes of known kinds, but where a new one followed

    def __bool__(self) -> bool:
        return bool(len(self._radii))

    def cover(self, point: NDArray[np.float64], seed: int | None = None) -> bool:
        """Whether a crash is known near to it, or with that seed."""
        return seed in self._seeds or bool((self._away(point) < self._radii).any())

    def is_new(self, told: Told) -> bool:
        """Whether its kind is not known; where nobody knows its kind, whether no crash is known near to it."""
        return told.kind not in self._kinds if told.kind else not self.cover(told.point)

    def outside(self, trials: Sequence[Told]) -> list[Told]:
        """Return the trials that no crash is known near to, nor with the same seed."""
        if not trials:
            return []
        points = np.array([told.point for told in trials])
        covered = np.any(self._away(points[:, None]) < self._radii, axis=1).tolist()
        return [told for told, near in zip(trials, covered, strict=True) if not near and told.seed not in self._seeds]

    def add(self, told: Told) -> bool:
        """Take in a crash; return whether more or less is known by it than before."""
        new = bool(told.kind) and told.kind not in self._kinds
        self._kinds[told.kind] = None
        if len(self._kinds) > _KINDS:
            del self._kinds[next(iter(self._kinds))]
        self._seeds[told.seed] = None
        if len(self._seeds) > _SEEDS:
            del self._seeds[next(iter(self._seeds))]
        away = self._away(told.point)
        around = away < self._radii
        if new:  # so there is more to find here than was thought
            self._radii = np.where(around, np.minimum(self._radii / _WIDER, away), self._radii)
        elif around.any():
            return False
        kept = self._radii > 0.0  # else it was at the very same point, as it is with choices and whole numbers
        radius = (_JUST_THERE if told.kind and not self._is_worked_out(told.point, new) else _AROUND) * self._unit
        self._points = np.vstack((self._points[kept], told.point))[-_MOST:]
        self._radii = np.append(self._radii[kept], radius)[-_MOST:]
        return True

    def _is_worked_out(self, point: NDArray[np.float64], new: bool) -> bool:
        """Account for a crash, and say whether all that comes around it has been known for long."""
        near = [float(np.linalg.norm(other - point)) < _AROUND * self._unit for other in self._again]
        if new:
            self._again = [other for other, is_near in zip(self._again, near, strict=True) if not is_near]
            return False
        self._again = [*self._again, point][-_MOST:]
        return sum(near) + 1 >= _AGAIN

    def widen(self, top: NDArray[np.float64]) -> bool:
        """Keep further away from the nearest crash, if what is most dangerous is just beside it; return whether so."""
        away = self._away(top)
        nearest = int(np.argmin(away / self._radii))
        if away[nearest] >= _WIDER * self._radii[nearest]:
            return False
        wider = max(self._radii[nearest] * _WIDER, _AROUND * self._unit)
        self._radii[nearest] = wider if wider < _WIDEST * self._unit else _AROUND * self._unit
        return True

    def _away(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        away: NDArray[np.float64] = np.sqrt(((self._points - point) ** 2).sum(axis=-1))
        return away
