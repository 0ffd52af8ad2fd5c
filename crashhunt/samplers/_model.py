"""A model of criticality over arguments and seeds, which selects the most promising of many candidates.

Computes a Gaussian process (Rasmussen and Williams 2006) over the most critical and the latest trials. The kernel of
this process has two parts. The first depends only on the arguments. The second counts only between trials with the same
seed, because the seed determines the traffic. The rest is noise. Length scales and shares are fitted while results
arrive. Of many candidates, most of them near critical trials, the model proposes the candidate that most likely exceeds
the best score so far (Kushner 1964).

Why not a library: proposals must follow from the reported results bit by bit, and take milliseconds.

Invariant: only the order of scores matters, so any monotonic measure of criticality gives the same proposals.

Cost: at most 96 trials are in the process, so one solution takes 96³ / 3 operations, whatever the hunt's length.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.samplers._learning import Draft, ScoredTrial, reflected
from crashhunt.samplers._signal_shapes import SignalShapes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from crashhunt.samplers._space_filling import Cube

    Floats = NDArray[np.float64]
    Excluded = Callable[[Floats, NDArray[np.int64]], NDArray[np.bool_]]


# A Gaussian process over arguments and seeds (Rasmussen and Williams 2006, algorithm 2.1).


class KnownTrials:
    """What a process of some trials computes only once, and not for each of the parameters that are tried.

    Args:
        points: trials x arguments; a choice is the index of its value.
        seeds: seeds of the trials.
        scores: scores of the trials; only their order matters.
        categorical: which arguments are choices; two values of a choice have the distance 1.
    """

    def __init__(
        self, points: Floats, seeds: NDArray[np.int64], scores: Floats, *, categorical: NDArray[np.bool_]
    ) -> None:
        self.points, self.seeds = points, seeds
        ranks = _ranks(scores)
        self.target: Floats = (ranks - ranks.mean()) / (float(ranks.std()) or 1.0)
        self.target_and_one = np.column_stack([self.target, np.ones(len(points))])
        self.numbers, self.choices = np.flatnonzero(~categorical), np.flatnonzero(categorical)
        self.plain = points[:, self.numbers]
        self.diagonal = np.diag_indices(len(points))
        self.have_same_seed = seeds[:, None] == seeds


class Process:
    """The Gaussian process of the scores of given trials, with given parameters.

    Args:
        known: the trials.
        scales: factors of the arguments, the reciprocals of length scales.
        noise: the share of the variance of scores that is noise, above 0 and below 1.
        seeded: the share of the remaining variance that is explained only by an equal seed.
    """

    def __init__(self, known: KnownTrials, *, scales: Floats, noise: float, seeded: float) -> None:
        self._known, self._target = known, known.target
        self._scales, self._scaled = scales, known.plain * scales[known.numbers]
        self._squares = (self._scaled**2).sum(axis=1)
        self._noise, self._seeded = noise / (1.0 - noise), seeded
        points = known.points
        kernel = self._kernel(points, self._scaled, self._squares, known.have_same_seed)
        kernel[known.diagonal] += self._noise
        self._lower = np.linalg.cholesky(kernel)
        # The mean is estimated by generalized least squares (section 2.7). The average would be too high, because most
        # trials are near a peak: the model would then expect high scores far from all trials.
        target, one = self._solved(known.target_and_one).T
        self._mean = float(one @ target) / float(one @ one)
        self._half = target - self._mean * one
        self._amplitude = max(float(self._half @ self._half) / len(points), 1e-9)
        self.likelihood = -0.5 * len(points) * math.log(self._amplitude) - float(np.log(np.diag(self._lower)).sum())
        """The logarithm of the likelihood of the scores, up to a constant."""

    def worth(
        self, points: Floats, seeds: NDArray[np.int64], ambition: float, among: NDArray[np.bool_] | None = None
    ) -> Floats:
        """Return by how many standard deviations the expected score at each point exceeds the target.

        A seed below 0 is one that no trial has. The target exceeds the best score, of the trials ``among`` or of all,
        by ``ambition`` standard deviations of all scores.
        """
        best = float((self._target if among is None else self._target[among]).max())
        half = self._solved(self._to(points, seeds).T)
        spread = self._amplitude * np.maximum(1.0 + self._noise - (half**2).sum(axis=0), self._noise)
        worth: Floats = (self._mean + half.T @ self._half - best - ambition) / np.sqrt(spread)
        return worth

    def _solved(self, right: Floats) -> Floats:
        from scipy.linalg.lapack import dtrtrs  # takes a fifth of a second to import

        # As `scipy.linalg.solve_triangular` does it, the checks of which take longer than the solution.
        solved: Floats = dtrtrs(self._lower.T, right, lower=0, trans=1)[0]
        return solved

    def _to(self, points: Floats, seeds: NDArray[np.int64]) -> Floats:
        """Return the kernel between points and the known trials."""
        scaled = points[:, self._known.numbers] * self._scales[self._known.numbers]
        return self._kernel(points, scaled, (scaled**2).sum(axis=1), seeds[:, None] == self._known.seeds)

    def _kernel(self, points: Floats, scaled: Floats, squares: Floats, have_same_seed: NDArray[np.bool_]) -> Floats:
        squared = squares[:, None] + self._squares - 2.0 * scaled @ self._scaled.T
        squared = np.maximum(squared, 0.0)
        for place in self._known.choices:
            differ = points[:, place, None] != self._known.points[:, place]
            squared += self._scales[place] ** 2 * differ
        far = np.sqrt(5.0 * squared)  # Matérn's kernel with 5/2 (equation 4.17): criticality has edges
        kernel: Floats = (1.0 + far + far**2 / 3.0) * np.exp(-far)
        if self._seeded:
            kernel *= 1.0 - self._seeded + self._seeded * have_same_seed
        return kernel


def _ranks(scores: Floats) -> Floats:
    """Return the share of scores below each score; of equal scores, half count as below."""
    order = np.sort(scores)
    ranks: Floats = (np.searchsorted(order, scores, "left") + np.searchsorted(order, scores, "right")) / 2 / len(scores)
    return ranks


TRIALS = 96
"""Trials in the process, and trials in each memory: a solution takes about 0.2 ms."""
_CANDIDATES = 384  # points from which a proposal is chosen: their worths take about half a millisecond

# As in `_signal_shapes`, chosen on the problems of the page falsification-evaluation.
_SHAPED = 0.8  # share of candidates that change the signals of a parent, if the space has signals

# The following numbers are part of the method. None was changed when a version was chosen.

_ANYWHERE, _AROUND, _NEAR = 1, 2, 3  # odds of candidates: anywhere, around all parents, near one parent
_KEEP_SEED = 0.5  # probability that a candidate keeps the seed of its parent: a fair coin
_KEEP_OTHERS = 0.5  # probability that such a candidate keeps the other arguments of its parent
_AMBITION = 1.0  # greatest ambition, in standard deviations of scores; it is drawn from 0 on
_FIRST_ODDS = -2.0  # logarithm of the odds of each share where the fit begins: a share of 0.12
_STARTS = 5  # length scales at which the fit begins again, each half of the one before
_ODDS_STEP = 2.0  # step of that logarithm in the fit
_FINEST = 0.5 / TRIALS  # half the distance of that many values of an argument, in widths: least step, and least share
_WIDEST = 1.0 / math.sqrt(12.0)  # standard deviation of a uniform draw, in widths: greatest step


class _Parameters(NamedTuple):
    """What is fitted, each in steps from where the fit begins."""

    lengths: Floats  # doublings of the length scales; they begin at the root-mean-square distance of two uniform points
    noise: float  # logarithm of the odds of the share of noise
    seeded: float  # the same of the share that counts only with the same seed

    @property
    def shares(self) -> tuple[float, float]:
        """The shares of noise and of what counts only with the same seed."""
        noise, seeded = (
            min(max(1.0 / (1.0 + math.exp(-odds)), _FINEST), 1.0 - _FINEST) for odds in (self.noise, self.seeded)
        )
        return noise, seeded

    @property
    def log_prior(self) -> float:
        """A standard normal distribution of each length, and the prior of Jeffreys (1946) of each share."""
        shares = sum(0.5 * math.log(share * (1.0 - share)) for share in self.shares)
        logarithms = math.log(2.0) * self.lengths
        return shares - 0.5 * float(logarithms @ logarithms)

    def stepped(self, turn: int, by: int) -> _Parameters:
        """Return other parameters, in turns by another length, noise, all lengths, a new start, and the seed's share.

        The likelihood may have several maxima: long lengths with much noise, and short lengths with little noise. Steps
        do not lead from the first to the second. A start has little noise, and one length for all arguments.
        """
        turn, which = divmod(turn, 5)
        if which == 0:
            return self._replace(lengths=self.lengths + by * (np.arange(len(self.lengths)) == turn % len(self.lengths)))
        if which == 1:
            return self._replace(noise=self.noise + _ODDS_STEP * by)
        if which == 2:
            return self._replace(lengths=self.lengths + by)
        if which == 3:
            lengths = np.full(len(self.lengths), -float(turn % _STARTS))
            return _Parameters(lengths, _FIRST_ODDS + _ODDS_STEP * min(by, 0), _FIRST_ODDS)
        return self._replace(seeded=self.seeded + _ODDS_STEP * by)


class Model:
    """Proposes the candidate with the greatest chance to exceed the best score."""

    def __init__(self, cube: Cube) -> None:
        self._cube = cube
        self._shapes = SignalShapes(cube.signals) if cube.signals else None
        self._told = self._turn = 0
        self.parameters = _Parameters(np.zeros(cube.dimensions), _FIRST_ODDS, _FIRST_ODDS)
        self.trials: Sequence[ScoredTrial] = ()
        self._process: Process | None = None

    def learn(self, trials: Sequence[ScoredTrial]) -> None:
        """Replace the trials, and fit some of the parameters again: the more, the fewer results there are."""
        self.remember(trials)
        self._told += 1
        if self._is_ready and self._told % (1 + self._told // TRIALS) == 0:
            for _ in range(max(1, TRIALS // self._told)):
                self._fit()

    def remember(self, trials: Sequence[ScoredTrial]) -> None:
        """Replace the trials without fitting."""
        self.trials = trials
        self._process = None
        if trials:
            self._points = np.array([trial.point for trial in trials])
            self._seeds = np.array([trial.seed for trial in trials])
            self._scores = np.array([trial.score for trial in trials])
            values = self._cube.values(self._points)
            self._known = KnownTrials(values, self._seeds, self._scores, categorical=self._cube.categorical)

    def propose(
        self, rng: np.random.Generator, excluded: Excluded | None = None, among: NDArray[np.bool_] | None = None
    ) -> Draft | None:
        """Return the best candidate; None if there is none, or while there are too few trials.

        ``excluded`` returns which points and seeds are not proposed. The trials of ``among`` are parents, and have the
        score to exceed; None for all.
        """
        order = np.argsort(-self._scores, kind="stable") if self._is_ready else np.empty(0, dtype=np.intp)
        ranked = order if among is None else order[among[order]]
        if not len(ranked):
            return None
        points, places, kept = self._candidates(self._points[ranked], rng)
        parents = ranked[places]
        seeds = np.where(kept, self._seeds[parents], -1)
        worth = self._fitted().worth(self._cube.values(points), seeds, _AMBITION * float(rng.random()), among)
        if excluded is not None:
            worth[excluded(points, seeds)] = -np.inf
        chosen = int(np.argmax(worth))
        if math.isinf(worth[chosen]):
            return None
        point, parent = points[chosen], self.trials[parents[chosen]]
        seed = parent.seed if kept[chosen] else None
        if seed is not None and self._cube.arguments(point) == self._cube.arguments(parent.point):
            seed = None  # the same point and seed would repeat the trial
        return Draft(point, seed=seed, parent=parent.number)

    @property
    def _is_ready(self) -> bool:
        return len(self.trials) > self._cube.dimensions  # fewer trials do not even determine a plane

    def _with(self, parameters: _Parameters) -> Process:
        noise, seeded = parameters.shares
        return Process(
            self._known,
            scales=2.0**-parameters.lengths / math.sqrt(self._cube.dimensions / 6.0),
            noise=noise,
            seeded=seeded,
        )

    def _fitted(self) -> Process:
        """Return the process with the present parameters."""
        if self._process is None:
            self._process = self._with(self.parameters)
        return self._process

    def _fit(self) -> None:
        """Compare one parameter with its two neighbours, and keep the value with the greatest likelihood."""
        greatest = self._fitted().likelihood + self.parameters.log_prior
        for tried in [self.parameters.stepped(self._turn, by) for by in (-1, 1)]:
            process = self._with(tried)
            if (likelihood := process.likelihood + tried.log_prior) > greatest:
                self.parameters, self._process, greatest = tried, process, likelihood
        self._turn += 1

    def _candidates(
        self, known: Floats, rng: np.random.Generator
    ) -> tuple[Floats, NDArray[np.intp], NDArray[np.bool_]]:
        """Return candidate points, the index of the parent of each, and whether each keeps its parent's seed.

        A sixth is anywhere, a third around all parents, and half near one parent, which is drawn by its rank (Zipf
        1949). The trials are known from the most to the least critical one.
        """
        shape, categorical = (_CANDIDATES, self._cube.dimensions), self._cube.categorical
        energy = np.cumsum(1.0 / (1.0 + np.arange(len(known))))
        places = np.searchsorted(energy / energy[-1], rng.random(_CANDIDATES))
        places = np.minimum(places, len(known) - 1)
        centers, drawn = known[places], rng.random(shape)
        scale = _WIDEST * (_FINEST / _WIDEST) ** rng.random((_CANDIDATES, 1))
        points = np.where(categorical, drawn, reflected(centers + scale * rng.standard_normal(shape)))
        touched = rng.random(shape) < 2.0 ** -rng.integers(0, max(1, shape[1].bit_length()), (_CANDIDATES, 1))
        touched[np.arange(_CANDIDATES), rng.integers(shape[1], size=_CANDIDATES)] = True
        points = np.where(touched, points, centers)
        around = centers.mean(axis=0) + np.maximum(centers.std(axis=0), _FINEST) * rng.standard_normal(shape)
        others = centers[rng.integers(_CANDIDATES, size=shape), np.arange(shape[1])]
        around = np.where(categorical, others, reflected(around))
        how = rng.integers(_ANYWHERE + _AROUND + _NEAR, size=(_CANDIDATES, 1))
        points = np.where(how < _ANYWHERE, drawn, np.where(how < _ANYWHERE + _AROUND, around, points))
        if self._shapes is not None:
            shaped = round(_SHAPED * _CANDIDATES)
            # Other arguments are those of the parent, or as drawn above.
            others = self._shapes.with_signals_of(points[:shaped], centers[:shaped])
            bases = np.where(rng.random((shaped, 1)) < _KEEP_OTHERS, centers[:shaped], others)
            points[:shaped] = self._shapes.changed(bases, rng)
        return points, places, (rng.random(_CANDIDATES) < _KEEP_SEED) & (how[:, 0] >= _ANYWHERE)
