"""A model of danger: what is near in arguments, and has the same traffic perhaps, is about as dangerous.

A Gaussian process (Rasmussen and Williams 2006) over the most dangerous trials and the last ones. It has two parts:
what arguments explain, and what they explain only as long as the seed is kept; what neither does is noise. How far it
is worth looking along each argument, and how much each part counts, is fitted while trials are told. Of many
candidates, most of them neighbours of dangerous trials, that one is proposed which most likely is more dangerous than
all so far (Kushner 1964).
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.samplers._elites import Elites
from crashhunt.samplers._process import Process
from crashhunt.samplers._strategy import Draft, reflected

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from crashhunt.samplers._cube import Cube
    from crashhunt.samplers._told import Told

__all__ = ["Model"]

_LEAST = 6  # trials before there is a model
_BEST, _LAST = 48, 48  # trials that it is of: so many are quick to solve for
_OFTEN = 64  # trials, after each of which a parameter is fitted; later, as many times for every doubling and a half
_CANDIDATES = 64
_ANYWHERE, _FITTED = 0.15, 0.25  # of them; the others are neighbours of one trial
_PARENTS = 12
_KEEP_SEED = 0.5
_LARGEST, _SMALLEST = 0.3, 0.005  # standard deviation of a step, drawn evenly in the logarithm between them
_NARROWEST = 0.02  # standard deviation of what is drawn around all parents, at least
_OTHER = 0.3  # how often a categorical argument that is to be changed is
_LENGTH = 0.4  # times the square root of the dimensions: how far it is worth looking, to begin with
_UNLIKELY = 0.25  # how little it is believed that a length is many times that
_NOISE = (0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9)  # shares of what danger varies by
_SEEDED = (0.0, 0.2, 0.5, 0.8, 0.95)  # of the rest, what is explained only as long as the seed is kept
_AMBITION = 0.5  # standard deviations by which a crash is above the most dangerous trial, on the average of draws


class _Parameters(NamedTuple):
    lengths: NDArray[np.float64]  # logarithms to base 2 of what the first ones are multiplied by
    noise: int
    seeded: int


class Model:
    """A Gaussian process that is asked which candidate is worth a trial.

    Args:
        cube: of the arguments.
        like: one whose fitted parameters it begins with.
    """

    def __init__(self, cube: Cube, like: Model | None = None) -> None:
        self._cube = cube
        self._best = Elites(_BEST)
        self._last: deque[Told] = deque(maxlen=_LAST)
        self._count = self._turn = 0
        unknown = _Parameters(np.zeros(cube.dimensions), 3, 1)
        self._parameters: _Parameters = unknown if like is None else like._parameters
        self._process: Process | None = None

    def remember(self, trials: Iterable[Told]) -> None:
        """Take in trials that were told before, and fit nothing."""
        for told in trials:
            self._best.add(told)
            self._last.append(told)
            self._count += 1
        self._process = None

    def tell(self, told: Told) -> None:
        """Take it in; every so often, one of the parameters is fitted anew."""
        self.remember((told,))
        if self._count >= _LEAST and self._count % max(1, self._count // _OFTEN) == 0:
            self._tune()

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return the best of many candidates."""
        if self._count < _LEAST:
            return None
        if self._process is None:
            self._process = self._with(self._parameters)
        best = self._best.best(_PARENTS)
        points, places, kept = self._candidates(best, rng)
        seeds = np.where(kept, np.array([told.seed for told in best])[places], -1)
        worth = self._process.worth(self._cube.values(points), seeds, float(rng.exponential(_AMBITION)))
        chosen = int(np.argmax(worth))
        point, parent = points[chosen], best[places[chosen]]
        seed = parent.seed if kept[chosen] else None
        if seed is not None and self._cube.arguments(point) == self._cube.arguments(parent.point):
            seed = None  # it would be the same trial again
        return Draft(point, seed=seed, parent=parent.number)

    def _with(self, parameters: _Parameters) -> Process:
        known = {told.number: told for told in self._last} | {told.number: told for told in self._best}
        trials = [known[number] for number in sorted(known)]
        return Process(
            self._cube.values(np.array([told.point for told in trials])),
            np.array([told.seed for told in trials]),
            np.array([told.score for told in trials]),
            categorical=self._cube.categorical,
            scales=2.0**-parameters.lengths / (_LENGTH * math.sqrt(self._cube.dimensions)),
            noise=_NOISE[parameters.noise],
            seeded=_SEEDED[parameters.seeded],
        )

    def _tune(self) -> None:
        """Try one parameter a little smaller and a little larger, and keep what explains the trials best."""
        tried = [self._parameters, *(self._stepped(by) for by in (-1, 1))]
        likely = [self._with(one).likelihood - _UNLIKELY * float(one.lengths @ one.lengths) for one in tried]
        self._parameters = tried[int(np.argmax(likely))]
        self._turn += 1

    def _stepped(self, by: int) -> _Parameters:
        """Return other parameters: in turns, one length, and one of all lengths, the noise and the seed's part."""
        lengths, noise, seeded = self._parameters
        turn, whole = divmod(self._turn, 2)
        if not whole:
            lengths = lengths.copy()
            lengths[turn % len(lengths)] += by
        elif turn % 3 == 0:
            lengths = lengths + by
        elif turn % 3 == 1:
            noise = min(max(noise + by, 0), len(_NOISE) - 1)
        else:
            seeded = min(max(seeded + by, 0), len(_SEEDED) - 1)
        return _Parameters(lengths, noise, seeded)

    def _candidates(
        self, best: list[Told], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.bool_]]:
        """Return points, of each the place of its parent, and whether it keeps that one's seed."""
        shape = (_CANDIDATES, self._cube.dimensions)
        known = np.array([told.point for told in best])
        energy = np.cumsum(1.0 / (2.0 + np.arange(len(best))))
        places = np.searchsorted(energy / energy[-1], rng.random(_CANDIDATES))
        places = np.minimum(places, len(best) - 1)
        centers, drawn = known[places], rng.random(shape)
        scale = _LARGEST * (_SMALLEST / _LARGEST) ** rng.random((_CANDIDATES, 1))
        points = reflected(centers + scale * rng.standard_normal(shape))
        points = np.where(self._cube.categorical & (rng.random(shape) >= _OTHER), centers, points)
        points = np.where(self._cube.categorical & (points != centers), drawn, points)
        touched = rng.random(shape) < 2.0 ** -rng.integers(0, max(1, shape[1].bit_length()), (_CANDIDATES, 1))
        touched[np.arange(_CANDIDATES), rng.integers(shape[1], size=_CANDIDATES)] = True
        points = np.where(touched, points, centers)
        around = known.mean(axis=0) + np.maximum(known.std(axis=0), _NARROWEST) * rng.standard_normal(shape)
        others = known[rng.integers(len(known), size=shape), np.arange(shape[1])]
        around = np.where(self._cube.categorical, others, reflected(around))
        how = rng.random(_CANDIDATES)
        points = np.where((how < _ANYWHERE + _FITTED)[:, None], around, points)
        points = np.where((how < _ANYWHERE)[:, None], drawn, points)
        return points, places, (rng.random(_CANDIDATES) < _KEEP_SEED) & (how >= _ANYWHERE)
