"""Mutation: the fuzzer. A corpus of dangerous trials, each of which is changed a little, or a lot.

The schedule of energy is in the manner of AFL: what is dangerous is changed often, what has been changed often without
having come nearer to a crash ever less.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.samplers._elites import Elites
from crashhunt.samplers._strategy import Draft, reflected

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.samplers._cube import Cube
    from crashhunt.samplers._told import Told

__all__ = ["Mutation"]

_LEAST, _MOST = 4, 64  # trials in the corpus
_KEEP_SEED = 0.5
_SPLICE, _BOUND, _HAVOC = 0.15, 0.05, 0.1  # how often; else there are small steps
_LARGEST, _SMALLEST = 0.3, 0.003  # standard deviation of a step, drawn evenly in the logarithm between them
_OTHER = 0.3  # how often a categorical argument that is to be changed is


class Mutation:
    """Changes what is in the corpus.

    Args:
        cube: of the arguments.
    """

    def __init__(self, cube: Cube) -> None:
        self._cube = cube
        self._categorical = cube.categorical
        self._corpus = Elites(_MOST)
        self._children: dict[int, int] = {}  # number of a trial to how many there have been of it without gain
        self._scores: dict[int, float] = {}
        self._energy: NDArray[np.float64] | None = None

    def tell(self, told: Told) -> None:
        """Take it into the corpus, if it is dangerous enough."""
        gone = self._corpus.add(told)
        parent = told.parent
        if parent is not None and parent in self._children:
            gained = told.score > self._scores[parent]
            self._children[parent] = 0 if gained else self._children[parent] + 1
            self._energy = None
        if gone is told:
            return
        self._children[told.number], self._scores[told.number] = 0, told.score
        if gone is not None:
            del self._children[gone.number], self._scores[gone.number]
        self._energy = None

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a mutant."""
        if len(self._corpus) < _LEAST:
            return None
        if self._energy is None:
            # By rank, as dangers may all be nearly the same; a parent without luck has ever less.
            tired = np.array([self._children[one.number] for one in self._corpus])
            energy = 1.0 / (4.0 + np.arange(len(tired))) / (1.0 + tired / 8.0)
            self._energy = np.cumsum(energy / energy.sum())
        place = min(int(np.searchsorted(self._energy, rng.random())), len(self._corpus) - 1)
        parent = self._corpus[place]
        seed = parent.seed if rng.random() < _KEEP_SEED else None
        point = self._changed(parent.point, rng)
        if seed is not None and self._cube.arguments(point) == self._cube.arguments(parent.point):
            seed = None  # it would be the same trial again
        return Draft(point, seed=seed, parent=parent.number)

    def _changed(self, point: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        size = len(point)
        how = rng.random()
        if how < _SPLICE:
            other = self._corpus[int(rng.integers(len(self._corpus)))].point
            point = np.where(rng.random(size) < 0.5, other, point)
            how = 1.0
        touched = rng.random(size) < 2.0 ** -rng.integers(0, max(1, int(size).bit_length()))  # from all to one or so
        if not touched.any():
            touched[rng.integers(size)] = True
        if how < _SPLICE + _BOUND:
            changed = np.where(rng.random(size) < 0.5, 0.0, 1.0)
        elif how < _SPLICE + _BOUND + _HAVOC:
            changed = rng.random(size)
        else:
            scale = _LARGEST * (_SMALLEST / _LARGEST) ** rng.random()
            changed = reflected(point + scale * rng.standard_normal(size))
            renewed = np.where(rng.random(size) < _OTHER, rng.random(size), point)
            changed = np.where(self._categorical, renewed, changed)
        return np.where(touched, changed, point)
