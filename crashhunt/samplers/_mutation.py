"""The sampler `mutation`: a fuzzer with a corpus of critical trials, which are changed by small or large steps.

The power schedule follows AFL: critical trials are mutated often, and parents with many mutants without progress ever
less often.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.samplers._learning import Draft, Elites, Learning, ScoredTrial, Strategy, reflected

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.samplers._protocol import Space
    from crashhunt.samplers._space_filling import Cube

_MIN_CORPUS, _MAX_CORPUS = 4, 64  # trials in the corpus
_KEEP_SEED = 0.5  # probability that a mutant has the traffic of its parent
_SPLICE, _BOUND, _HAVOC = 0.15, 0.05, 0.1  # probability of each operator; otherwise small steps
_LARGEST, _SMALLEST = 0.3, 0.003  # standard deviation of a step, drawn log-uniformly between these
_OTHER_CATEGORY = 0.3  # probability that a selected categorical argument changes


class Mutation:
    """Proposes mutants of the trials in the corpus."""

    def __init__(self, cube: Cube) -> None:
        self._cube = cube
        self._categorical = cube.categorical
        self._corpus = Elites(_MAX_CORPUS)
        self._children: dict[int, int] = {}  # trial number to its number of mutants without progress
        self._scores: dict[int, float] = {}
        self._energy: NDArray[np.float64] | None = None

    def tell(self, trial: ScoredTrial) -> None:
        """Add a trial to the corpus, if it is critical enough."""
        gone = self._corpus.add(trial)
        parent = trial.parent
        if parent is not None and parent in self._children:
            gained = trial.score > self._scores[parent]
            self._children[parent] = 0 if gained else self._children[parent] + 1
            self._energy = None
        if gone is trial:
            return
        self._children[trial.number], self._scores[trial.number] = 0, trial.score
        if gone is not None:
            del self._children[gone.number], self._scores[gone.number]
        self._energy = None

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a mutant of a trial in the corpus."""
        if len(self._corpus) < _MIN_CORPUS:
            return None
        if self._energy is None:
            # By rank, because criticality may be nearly equal; parents without progress are selected ever less often.
            tired = np.array([self._children[one.number] for one in self._corpus])
            energy = 1.0 / (4.0 + np.arange(len(tired))) / (1.0 + tired / 8.0)
            self._energy = np.cumsum(energy / energy.sum())
        place = min(int(np.searchsorted(self._energy, rng.random())), len(self._corpus) - 1)
        parent = self._corpus[place]
        seed = parent.seed if rng.random() < _KEEP_SEED else None
        point = self._changed(parent.point, rng)
        if seed is not None and self._cube.arguments(point) == self._cube.arguments(parent.point):
            seed = None  # the same arguments and seed would repeat the trial
        return Draft(point, seed=seed, parent=parent.number)

    def _changed(self, point: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        size = len(point)
        how = rng.random()
        if how < _SPLICE:
            other = self._corpus[int(rng.integers(len(self._corpus)))].point
            point = np.where(rng.random(size) < 0.5, other, point)
            how = 1.0
        touched = rng.random(size) < 2.0 ** -rng.integers(0, max(1, int(size).bit_length()))  # from all to about one
        if not touched.any():
            touched[rng.integers(size)] = True
        if how < _SPLICE + _BOUND:
            changed = np.where(rng.random(size) < 0.5, 0.0, 1.0)
        elif how < _SPLICE + _BOUND + _HAVOC:
            changed = rng.random(size)
        else:
            scale = _LARGEST * (_SMALLEST / _LARGEST) ** rng.random()
            changed = reflected(point + scale * rng.standard_normal(size))
            renewed = np.where(rng.random(size) < _OTHER_CATEGORY, rng.random(size), point)
            changed = np.where(self._categorical, renewed, changed)
        return np.where(touched, changed, point)


class MutationSampler(Learning):
    """Changes the most critical trials, with the same or other traffic (`Mutation`)."""

    origin = "mutation"

    def _make(self, space: Space) -> Strategy:
        return Mutation(self._cube)
