"""Cross-entropy: draw from a distribution that is fitted to the most dangerous trials, again and again.

Rubinstein (1999), with an adaptive quantile of danger instead of a fixed level, and a mixture of one normal
distribution around all of them and one around each, so that several dangerous regions are not taken for one in between.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.samplers._elites import Elites
from crashhunt.samplers._strategy import Draft, reflected

if TYPE_CHECKING:
    from crashhunt.samplers._cube import Cube
    from crashhunt.samplers._told import Told

__all__ = ["CrossEntropy"]

_LEAST, _MOST = 8, 40  # elites
_QUANTILE = 0.1  # of all trials are elites, within those bounds
_FLOOR = 0.01  # of the standard deviation of a dimension: it is never narrower
_OTHER = 0.1  # how often a categorical argument is drawn anew
_TOGETHER = 0.5  # the share of the distribution around all elites


class CrossEntropy:
    """A mixture of normal distributions around the elites.

    Args:
        cube: of the arguments.
    """

    def __init__(self, cube: Cube) -> None:
        self._categorical = cube.categorical
        self._elites = Elites(_MOST)
        self._count = 0
        self._points: np.ndarray[tuple[int, int], np.dtype[np.float64]] | None = None

    def tell(self, told: Told) -> None:
        """Take it among the elites, if it is one."""
        self._count += 1
        self._elites.add(told)
        self._points = None

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a draw from the mixture."""
        if len(self._elites) < _LEAST:
            return None
        many = min(max(_LEAST, math.ceil(_QUANTILE * self._count)), _MOST)
        if self._points is None:
            self._points = np.array([elite.point for elite in self._elites.best(many)])
        points = self._points
        mean, spread = points.mean(axis=0), np.maximum(points.std(axis=0), _FLOOR)
        place = int(rng.integers(len(points)))
        chosen = self._elites[place]
        if rng.random() < _TOGETHER:
            center = mean
        else:
            center = chosen.point
            spread = np.maximum(spread * len(points) ** (-1.0 / (len(mean) + 4)), _FLOOR)  # Scott (1992)
        point = reflected(center + spread * rng.standard_normal(len(mean)))
        if self._categorical.any():
            renewed = np.where(rng.random(len(mean)) < _OTHER, rng.random(len(mean)), chosen.point)
            point = np.where(self._categorical, renewed, point)
        return Draft(point, parent=chosen.number)
