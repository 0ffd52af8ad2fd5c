"""A Gaussian process over arguments and seeds (Rasmussen and Williams 2006, algorithm 2.1)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

__all__ = ["Process"]

_OTHER = 0.5  # the square of how far two values of a choice are apart
_WIDER = 1.5  # with the seed kept, it is worth looking so many times as far
_JITTER = 1e-6


class Process:
    """The process, given trials and its parameters.

    Args:
        points: trials x arguments, of a choice the place of its value.
        seeds: of the trials.
        scores: likewise; only their order matters.
        categorical: which arguments are choices.
        scales: by which each argument is multiplied.
        noise: the share of what scores vary by that nothing explains, above 0 and below 1.
        seeded: the share of the rest that arguments explain only as long as the seed is the same.
    """

    def __init__(
        self, points: Floats, seeds: NDArray[np.int64], scores: Floats, *, categorical: NDArray[np.bool_],
        scales: Floats, noise: float, seeded: float,
    ) -> None:  # fmt: skip
        self._points, self._seeds = points, seeds
        self._categorical, self._scales = categorical, scales
        self._noise, self._seeded = noise / (1.0 - noise) + _JITTER, seeded
        worths = _worths(scores)
        self._target = (worths - worths.mean()) / (float(worths.std()) or 1.0)
        kernel = self._kernel(points, seeds)
        kernel[np.diag_indices(len(kernel))] += self._noise
        self._lower = np.linalg.cholesky(kernel)
        self._half = np.linalg.solve(self._lower, self._target)
        self._amplitude = max(float(self._half @ self._half) / len(points), 1e-9)
        self.likelihood = -0.5 * len(points) * math.log(self._amplitude) - float(np.log(np.diag(self._lower)).sum())
        """Of the scores, as a logarithm, but for a constant."""

    def worth(self, points: Floats, seeds: NDArray[np.int64], ambition: float) -> Floats:
        """Return by how many standard deviations the score expected at each point is above what is wanted.

        Args:
            points: as those of the trials.
            seeds: likewise; below 0 for one that no trial has.
            ambition: by how much the greatest score is to be exceeded, in standard deviations of all scores.
        """
        half = np.linalg.solve(self._lower, self._kernel(points, seeds).T)
        spread = self._amplitude * np.maximum(1.0 + self._noise - (half**2).sum(axis=0), _JITTER)
        worth: Floats = (half.T @ self._half - float(self._target.max()) - ambition) / np.sqrt(spread)
        return worth

    def _kernel(self, points: Floats, seeds: NDArray[np.int64]) -> Floats:
        numbers = ~self._categorical
        one, other = (of[:, numbers] * self._scales[numbers] for of in (points, self._points))
        squared = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2.0 * one @ other.T
        squared = np.maximum(squared, 0.0)
        for place in np.flatnonzero(self._categorical):
            differ = points[:, place, None] != self._points[:, place]
            squared += _OTHER * self._scales[place] ** 2 * differ
        kernel: Floats = (1.0 - self._seeded) * np.exp(-0.5 * squared)
        if self._seeded:
            same = seeds[:, None] == self._seeds
            kernel += self._seeded * same * np.exp(-0.5 / _WIDER**2 * squared)
        return kernel


def _worths(scores: Floats) -> Floats:
    """Return numbers that follow from the order of scores alone, and are further apart among the greatest."""
    order, count = np.sort(scores), len(scores)
    below = np.searchsorted(order, scores, "left")
    above = count - np.searchsorted(order, scores, "right")
    worths: Floats = -np.log((above + 0.5 * (count - above - below)) / count)
    return worths
