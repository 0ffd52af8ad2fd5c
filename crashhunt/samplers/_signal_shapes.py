"""Shapes of input signals: corners, random shapes, and changes of parts of a signal.

The points of a signal are arguments, but not independent ones: violations of requirements usually need an extreme value
for a long time, or a change at the right time. Uniform draws of each point contain neither. Therefore, a guided hunt
first tries the corners, in which every signal is constant at one end of its range. This is usual in falsification
(Breach: Donzé, CAV 2010). Random shapes have few pieces of different lengths, many of them at an end of the range. The
model's candidates change a piece of a signal, or move a signal in time.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

# The following numbers are part of the method. They were chosen on the problems of the page falsification-evaluation.

_MOST_CORNERS = 8  # corners of more signals than three would take too many trials
_ALL_PIECES = 0.5  # probability that each point of a shape is a piece of its own
_AGAIN = 0.4  # probability that a changed signal is changed once more
_EXTREME = 0.5  # probability of an end of the range, for the new value of a piece
_REPLACE, _SHIFT = 0.45, 0.2  # probability of a new value, and of a move in time; otherwise, values change a little
_LARGEST, _SMALLEST = 0.3, 0.003  # standard deviation of a small change, drawn log-uniformly between these


class SignalShapes:
    """Proposes the coordinates of signals in the unit cube.

    Args:
        signals: for each signal, the dimensions of its points, in the order of time.
    """

    def __init__(self, signals: Sequence[Sequence[int]]) -> None:
        self._signals = [np.array(places, dtype=np.intp) for places in signals]
        self._counts = np.array([len(places) for places in signals])
        self._longest = int(self._counts.max())
        self._places = np.array([np.resize(places, self._longest) for places in signals], dtype=np.intp)
        corners = itertools.product((0.0, 1.0), repeat=len(signals)) if 2 ** len(signals) <= _MOST_CORNERS else ()
        self.corners = tuple(corners)
        """For each corner, the value of each signal."""

    def with_corner(self, point: Floats, corner: int) -> Floats:
        """Return a point whose signals are constant, as the given corner says."""
        found = point.copy()
        for places, value in zip(self._signals, self.corners[corner], strict=True):
            found[places] = value
        return found

    def with_shapes(self, point: Floats, rng: np.random.Generator) -> Floats:
        """Return a point whose signals have random shapes."""
        found = point.copy()
        for places in self._signals:
            count = len(places)
            pieces = count if rng.random() < _ALL_PIECES else round(math.exp(rng.random() * math.log(count)))
            starts = np.sort(rng.permutation(count - 1)[: pieces - 1] + 1)
            levels = np.where(rng.random(pieces) < rng.random(), rng.integers(2, size=pieces), rng.random(pieces))
            found[places] = levels[np.searchsorted(starts, np.arange(count), side="right")]
        return found

    def with_signals_of(self, points: Floats, others: Floats) -> Floats:
        """Return points with the signals of other points."""
        found, places = points.copy(), np.concatenate(self._signals)
        found[:, places] = others[:, places]
        return found

    def changed(self, points: Floats, rng: np.random.Generator) -> Floats:
        """Return points, each with changes of one signal or of several."""
        found, active = points.copy(), np.arange(len(points))
        while len(active):
            found[active] = self._changed_once(found[active], rng)
            active = active[rng.random(len(active)) < _AGAIN]
        return found

    def _changed_once(self, points: Floats, rng: np.random.Generator) -> Floats:
        many = len(points)
        rows, one = np.arange(many)[:, None], rng.random((many, 1))
        which = rng.integers(len(self._signals), size=many)
        counts, places = self._counts[which, None], self._places[which]
        lengths = np.round(np.exp(rng.random((many, 1)) * np.log(counts)))
        starts = np.floor(rng.random((many, 1)) * (counts - lengths + 1))
        at = np.arange(self._longest)
        piece = (at >= starts) & (at < starts + lengths)
        old = points[rows, places]
        ends = rng.integers(2, size=(many, 1))
        new = np.where(rng.random((many, 1)) < _EXTREME, ends, rng.random((many, 1)))
        scale = _LARGEST * (_SMALLEST / _LARGEST) ** rng.random((many, 1))
        noise = np.where(rng.random((many, 1)) < 0.5, rng.standard_normal((many, 1)), rng.standard_normal(old.shape))
        by = rng.integers(1, np.maximum(2, counts // 4) + 1) * np.where(rng.random((many, 1)) < 0.5, 1, -1)
        moved = points[rows, places[rows, np.clip(at - by, 0, counts - 1)]]
        values = np.where(piece, np.where(one < _REPLACE, new, np.clip(old + scale * noise, 0.0, 1.0)), old)
        values = np.where(one >= 1.0 - _SHIFT, moved, values)
        found, inside = points.copy(), at < counts
        found[np.broadcast_to(rows, inside.shape)[inside], places[inside]] = values[inside]
        return found
