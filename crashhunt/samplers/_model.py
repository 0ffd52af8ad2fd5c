"""A model of criticality over arguments and seeds, which selects the most promising of many candidates.

Computes a Gaussian process (Rasmussen and Williams 2006) over the most critical and the latest trials. The kernel of
this process has two parts. The first depends only on the arguments. The second counts only between trials with the same
seed, because the seed determines the traffic. The rest is noise. Length scales and shares are fitted while results
arrive. Of 64 candidates, most of them neighbours of critical trials, the model proposes the candidate that most likely
exceeds the best score so far (Kushner 1964).

Why not a library: proposals must follow from the reported results bit by bit, and take milliseconds.

Invariant: only the order of scores matters, so any monotonic measure of criticality gives the same proposals.

Cost: at most 96 trials are in the process, so one solution takes 96³ / 3 operations, whatever the hunt's length.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.samplers._strategy import Draft, Elites, reflected

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from crashhunt.samplers._space_filling import Cube
    from crashhunt.samplers._strategy import ScoredTrial

    Floats = NDArray[np.float64]


__all__ = ["Model", "Process"]


# A Gaussian process over arguments and seeds (Rasmussen and Williams 2006, algorithm 2.1).

_CATEGORY_DISTANCE_SQUARED = 0.5  # squared distance between two different values of a choice


class Process:
    """The Gaussian process of the scores of given trials, with given parameters.

    Args:
        points: trials x arguments; a choice is the index of its value.
        seeds: seeds of the trials.
        scores: scores of the trials; only their order matters.
        categorical: which arguments are choices.
        scales: factors of the arguments, the reciprocals of length scales.
        noise: the share of the variance of scores that is noise, above 0 and below 1.
        seeded: the share of the remaining variance that is explained only by an equal seed.
    """

    def __init__(
        self, points: Floats, seeds: NDArray[np.int64], scores: Floats, *, categorical: NDArray[np.bool_],
        scales: Floats, noise: float, seeded: float,
    ) -> None:  # fmt: skip
        self._points, self._seeds = points, seeds
        self._categorical, self._scales = categorical, scales
        self._noise, self._seeded = noise / (1.0 - noise), seeded
        worths = _worths(scores)
        self._target = (worths - worths.mean()) / (float(worths.std()) or 1.0)
        kernel = self._kernel(points, seeds)
        kernel[np.diag_indices(len(kernel))] += self._noise
        self._lower = np.linalg.cholesky(kernel)
        self._half = np.linalg.solve(self._lower, self._target)
        self._amplitude = max(float(self._half @ self._half) / len(points), 1e-9)
        self.likelihood = -0.5 * len(points) * math.log(self._amplitude) - float(np.log(np.diag(self._lower)).sum())
        """The logarithm of the likelihood of the scores, up to a constant."""

    def worth(self, points: Floats, seeds: NDArray[np.int64], ambition: float) -> Floats:
        """Return by how many standard deviations the expected score at each point exceeds the target.

        Args:
            points: points in the same form as those of the trials.
            seeds: seeds of the points; below 0 for a seed that no trial has.
            ambition: by how much the target exceeds the best score, in standard deviations of all scores.
        """
        half = np.linalg.solve(self._lower, self._kernel(points, seeds).T)
        spread = self._amplitude * np.maximum(1.0 + self._noise - (half**2).sum(axis=0), self._noise)
        worth: Floats = (half.T @ self._half - float(self._target.max()) - ambition) / np.sqrt(spread)
        return worth

    def _kernel(self, points: Floats, seeds: NDArray[np.int64]) -> Floats:
        numbers = ~self._categorical
        one, other = (of[:, numbers] * self._scales[numbers] for of in (points, self._points))
        squared = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2.0 * one @ other.T
        squared = np.maximum(squared, 0.0)
        for place in np.flatnonzero(self._categorical):
            differ = points[:, place, None] != self._points[:, place]
            squared += _CATEGORY_DISTANCE_SQUARED * self._scales[place] ** 2 * differ
        kernel: Floats = np.exp(-0.5 * squared)
        if self._seeded:
            kernel *= 1.0 - self._seeded + self._seeded * (seeds[:, None] == self._seeds)
        return kernel


def _worths(scores: Floats) -> Floats:
    """Return values that depend only on the order of scores, with greater differences for greater scores."""
    order, count = np.sort(scores), len(scores)
    below = np.searchsorted(order, scores, "left")
    above = count - np.searchsorted(order, scores, "right")
    worths: Floats = -np.log((above + 0.5 * (count - above - below)) / count)
    return worths


_BEST, _LAST = 48, 48  # trials in the process: a solution of 96 takes about a millisecond
_CANDIDATES = 64  # per proposal
_ANYWHERE, _FITTED = 0.15, 0.25  # shares of candidates; the others are neighbours of one trial
_PARENTS = 12  # best trials whose neighbours are candidates
_KEEP_SEED = 0.5  # probability that a neighbour keeps the seed of its parent
_FINEST = 0.005  # least standard deviation of a step, and of draws around all parents, in widths of an argument
_WIDEST = 1.0 / math.sqrt(12.0)  # greatest one: that of a uniform draw; steps are log-uniform between both
_OTHER = 0.3  # probability that a selected categorical argument changes
_NOISE = (0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9)  # candidates for the noise share
_SEEDED = (0.0, 0.2, 0.5, 0.8, 0.95)  # candidates for the share that counts only with the same seed
_AMBITION = 0.5  # mean of the drawn ambition, in standard deviations


class _Parameters(NamedTuple):
    lengths: NDArray[np.float64]  # logarithms to base 2 of factors of the initial length scales
    noise: int
    seeded: int


class Model:
    """Proposes the candidate with the greatest chance to exceed the best score.

    Args:
        cube: the unit cube whose dimensions are the arguments that vary.
        like: a model whose fitted parameters are the initial parameters of this model.
    """

    def __init__(self, cube: Cube, like: Model | None = None) -> None:
        self._cube = cube
        self._best = Elites(_BEST)
        self._last: deque[ScoredTrial] = deque(maxlen=_LAST)
        self._count = self._turn = 0
        unknown = _Parameters(np.zeros(cube.dimensions), 3, 1)
        self._parameters: _Parameters = unknown if like is None else like._parameters
        self._process: Process | None = None

    def remember(self, trials: Iterable[ScoredTrial]) -> None:
        """Add earlier trials without fitting."""
        for trial in trials:
            self._best.add(trial)
            self._last.append(trial)
            self._count += 1
        self._process = None

    def tell(self, trial: ScoredTrial) -> None:
        """Add a trial; at growing intervals, fit one of the parameters again."""
        self.remember((trial,))
        if self._is_ready and self._count % (1 + self._count // (_BEST + _LAST)) == 0:
            self._tune()

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return the best of many candidates; None while there are too few trials."""
        if not self._is_ready:
            return None
        if self._process is None:
            self._process = self._with(self._parameters)
        best = self._best.best(_PARENTS)
        points, places, kept = self._candidates(best, rng)
        seeds = np.where(kept, np.array([trial.seed for trial in best])[places], -1)
        worth = self._process.worth(self._cube.values(points), seeds, float(rng.exponential(_AMBITION)))
        chosen = int(np.argmax(worth))
        point, parent = points[chosen], best[places[chosen]]
        seed = parent.seed if kept[chosen] else None
        if seed is not None and self._cube.arguments(point) == self._cube.arguments(parent.point):
            seed = None  # the same point and seed would repeat the trial
        return Draft(point, seed=seed, parent=parent.number)

    @property
    def _is_ready(self) -> bool:
        return self._count > self._cube.dimensions  # fewer trials do not even determine a plane

    def _with(self, parameters: _Parameters) -> Process:
        known = {trial.number: trial for trial in self._last} | {trial.number: trial for trial in self._best}
        trials = [known[number] for number in sorted(known)]
        return Process(
            self._cube.values(np.array([trial.point for trial in trials])),
            np.array([trial.seed for trial in trials]),
            np.array([trial.score for trial in trials]),
            categorical=self._cube.categorical,
            scales=2.0**-parameters.lengths / math.sqrt(self._cube.dimensions / 6.0),  # a mean distance of two draws
            noise=_NOISE[parameters.noise],
            seeded=_SEEDED[parameters.seeded],
        )

    def _tune(self) -> None:
        """Compare one parameter with its two neighbours, and keep the value with the greatest likelihood.

        The natural logarithm of each length scale has a standard normal prior.
        """
        tried = [self._parameters, *(self._stepped(by) for by in (-1, 1))]
        weight = 0.5 * math.log(2.0) ** 2
        likely = [self._with(one).likelihood - weight * float(one.lengths @ one.lengths) for one in tried]
        self._parameters = tried[int(np.argmax(likely))]
        self._turn += 1

    def _stepped(self, by: int) -> _Parameters:
        """Return neighbouring parameters: in turns, one length, and one of all lengths, noise and seed share."""
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
        self, best: list[ScoredTrial], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.bool_]]:
        """Return candidate points, the index of the parent of each, and whether each keeps its parent's seed."""
        shape = (_CANDIDATES, self._cube.dimensions)
        known = np.array([trial.point for trial in best])
        energy = np.cumsum(1.0 / (2.0 + np.arange(len(best))))
        places = np.searchsorted(energy / energy[-1], rng.random(_CANDIDATES))
        places = np.minimum(places, len(best) - 1)
        centers, drawn = known[places], rng.random(shape)
        scale = _WIDEST * (_FINEST / _WIDEST) ** rng.random((_CANDIDATES, 1))
        points = reflected(centers + scale * rng.standard_normal(shape))
        points = np.where(self._cube.categorical & (rng.random(shape) >= _OTHER), centers, points)
        points = np.where(self._cube.categorical & (points != centers), drawn, points)
        touched = rng.random(shape) < 2.0 ** -rng.integers(0, max(1, shape[1].bit_length()), (_CANDIDATES, 1))
        touched[np.arange(_CANDIDATES), rng.integers(shape[1], size=_CANDIDATES)] = True
        points = np.where(touched, points, centers)
        around = known.mean(axis=0) + np.maximum(known.std(axis=0), _FINEST) * rng.standard_normal(shape)
        others = known[rng.integers(len(known), size=shape), np.arange(shape[1])]
        around = np.where(self._cube.categorical, others, reflected(around))
        how = rng.random(_CANDIDATES)
        points = np.where((how < _ANYWHERE + _FITTED)[:, None], around, points)
        points = np.where((how < _ANYWHERE)[:, None], drawn, points)
        return points, places, (rng.random(_CANDIDATES) < _KEEP_SEED) & (how >= _ANYWHERE)
