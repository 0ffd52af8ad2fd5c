"""The sampler `cross-entropy`: repeatedly fits a distribution to the most critical trials, and draws from it.

Source: Rubinstein (1999), with an adaptive quantile of criticality instead of a fixed level. The distribution is a
mixture of one normal distribution around all elites and one around each of them. A single normal distribution would
search between several critical regions, where nothing is critical.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.samplers._learning import Draft, Elites, Learning, ScoredTrial, Strategy, reflected

if TYPE_CHECKING:
    from crashhunt.samplers._protocol import Space
    from crashhunt.samplers._space_filling import Cube

_MIN_ELITES, _MAX_ELITES = 8, 40  # fewer give no spread; more react too slowly
_QUANTILE = 0.1  # share of all trials that are elites, within these bounds
_FLOOR = 0.01  # lower bound of the standard deviation per dimension, so the search never stops
_REDRAWN = 0.1  # probability that a categorical argument is drawn again
_TOGETHER = 0.5  # probability of the distribution around all elites


class CrossEntropy:
    """A mixture of normal distributions around the elites."""

    def __init__(self, cube: Cube) -> None:
        self._categorical = cube.categorical
        self._elites = Elites(_MAX_ELITES)
        self._count = 0
        self._points: np.ndarray[tuple[int, int], np.dtype[np.float64]] | None = None

    def tell(self, trial: ScoredTrial) -> None:
        """Count a trial, and add it to the elites if its score is high enough."""
        self._count += 1
        self._elites.add(trial)
        self._points = None

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a draw from the mixture."""
        if len(self._elites) < _MIN_ELITES:
            return None
        many = min(max(_MIN_ELITES, math.ceil(_QUANTILE * self._count)), _MAX_ELITES)
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
            renewed = np.where(rng.random(len(mean)) < _REDRAWN, rng.random(len(mean)), chosen.point)
            point = np.where(self._categorical, renewed, point)
        return Draft(point, parent=chosen.number)


class CrossEntropySampler(Learning):
    """Draws from a distribution that is fitted to the most critical trials (`CrossEntropy`)."""

    origin = "cross-entropy"

    def _make(self, space: Space) -> Strategy:
        return CrossEntropy(self._cube)
