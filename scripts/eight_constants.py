"""A version of ``guided`` with eight constants (version I of the study): ``scripts/search --samplers eight-constants``.

Each trial belongs either to a model or to the even search. A trial that is more critical than a share of 1 - q of the
unguided trials has payoff -log q. For trials that know nothing, payoffs are exponentially distributed with mean 1. The
mean payoff of the model's trials therefore has an inverse gamma posterior. Before each proposal, a mean is drawn from
it (Thompson 1933), and the model proposes if the mean is high enough.

Rising criticality does not imply a crash. The share of the model therefore falls exponentially with the number of its
trials since the last progress towards a crash. The number of trials that a misleading criticality costs then grows only
with the logarithm of the length of the hunt, as in the best strategies for bandits (Lai and Robbins 1985).

The model is that of ``guided`` without its constants: the fit begins at values that follow from the unit cube, and a
third of the candidates each is anywhere, around all parents, and near one parent.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.samplers import GuidedSampler
from crashhunt.samplers._guided import nearest_better
from crashhunt.samplers._model import Process
from crashhunt.samplers._space_filling import HaltonSampler
from crashhunt.samplers._strategy import CRASHED, Draft, Elites, reflected

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from crashhunt.samplers._protocol import HuntFacts, Space
    from crashhunt.samplers._space_filling import Cube
    from crashhunt.samplers._strategy import ScoredTrial, Strategy

    Floats = NDArray[np.float64]
    Seeds = NDArray[np.int64]
    Excluded = Callable[[Floats, Seeds], NDArray[np.bool_]]

__all__ = ["EightConstants"]

_TRIALS = 96  # trials in the process, and candidates for a proposal: a solution takes about 0.2 ms
_PARENTS = 12  # most critical trials whose neighbours are candidates: more are less critical, fewer are one peak
_FINEST = 0.5 / _TRIALS  # half the distance of that many values of an argument, in widths: least step, and least share
_WIDEST = 1.0 / math.sqrt(12.0)  # standard deviation of a uniform draw, in widths: greatest step


class _Parameters(NamedTuple):
    """What is fitted, each in steps from where the fit begins.

    Args:
        lengths: doublings of the length scales; they begin at the root-mean-square distance of two uniform points.
        noise: logarithm of the odds of the share of noise.
        seeded: the same of the share that counts only with the same seed.
    """

    lengths: Floats
    noise: float = -2.0
    seeded: float = -2.0

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
        """Return neighbouring parameters: in turns, one length, the noise, all lengths, and the seed's share."""
        turn, which = divmod(turn, 4)
        if which == 0:
            return self._replace(lengths=self.lengths + by * (np.arange(len(self.lengths)) == turn % len(self.lengths)))
        if which == 1:
            return self._replace(noise=self.noise + 2.0 * by)
        if which == 2:
            return self._replace(lengths=self.lengths + by)
        return self._replace(seeded=self.seeded + 2.0 * by)


class _Model:
    """Proposes the candidate with the greatest chance to exceed the best score.

    Args:
        cube: cube of the arguments.
    """

    def __init__(self, cube: Cube) -> None:
        self._cube = cube
        self._units = np.where(cube.categorical, math.sqrt(2.0), 1.0)  # two values of a choice have the distance 1
        self._told = self._turn = 0
        self.parameters = _Parameters(np.zeros(cube.dimensions))
        self.trials: Sequence[ScoredTrial] = ()
        self._process: Process | None = None

    def learn(self, trials: Sequence[ScoredTrial]) -> None:
        """Replace the trials, and at growing intervals fit one of the parameters again."""
        self.remember(trials)
        self._told += 1
        if self._is_ready and self._told % (1 + self._told // _TRIALS) == 0:
            self._fit()

    def remember(self, trials: Sequence[ScoredTrial]) -> None:
        """Replace the trials without fitting."""
        self.trials = trials
        self._process = None
        if trials:
            self._points = np.array([trial.point for trial in trials])
            self._values = self._cube.values(self._points)
            self._seeds = np.array([trial.seed for trial in trials])
            self._scores = np.array([trial.score for trial in trials])

    def propose(self, rng: np.random.Generator, excluded: Excluded | None = None) -> Draft | None:
        """Return the best candidate that is not excluded; None if there is none, or while there are too few trials."""
        if not self._is_ready:
            return None
        if self._process is None:
            self._process = self._with(self.parameters)
        best = np.argsort(-self._scores, kind="stable")[:_PARENTS]
        points, places, kept = self._candidates(self._points[best], rng)
        parents = best[places]
        seeds = np.where(kept, self._seeds[parents], -1)
        worth = self._process.worth(self._cube.values(points), seeds, float(rng.random()))
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
            self._values,
            self._seeds,
            self._scores,
            categorical=self._cube.categorical,
            scales=2.0**-parameters.lengths / math.sqrt(self._cube.dimensions / 6.0) * self._units,
            noise=noise,
            seeded=seeded,
        )

    def _fit(self) -> None:
        """Compare one parameter with its two neighbours, and keep the value with the greatest likelihood."""
        tried = [self.parameters, *(self.parameters.stepped(self._turn, by) for by in (-1, 1))]
        self.parameters = max(tried, key=lambda one: self._with(one).likelihood + one.log_prior)
        self._turn += 1

    def _candidates(
        self, known: Floats, rng: np.random.Generator
    ) -> tuple[Floats, NDArray[np.intp], NDArray[np.bool_]]:
        """Return candidate points, the index of the parent of each, and whether each keeps its parent's seed.

        A third each is anywhere, around all parents, and near one parent, which is drawn by its rank (Zipf 1949).
        """
        shape, categorical = (_TRIALS, self._cube.dimensions), self._cube.categorical
        energy = np.cumsum(1.0 / (1.0 + np.arange(len(known))))
        places = np.searchsorted(energy / energy[-1], rng.random(_TRIALS))
        places = np.minimum(places, len(known) - 1)
        centers, drawn = known[places], rng.random(shape)
        scale = _WIDEST * (_FINEST / _WIDEST) ** rng.random((_TRIALS, 1))
        points = np.where(categorical, drawn, reflected(centers + scale * rng.standard_normal(shape)))
        touched = rng.random(shape) < 2.0 ** -rng.integers(0, max(1, shape[1].bit_length()), (_TRIALS, 1))
        touched[np.arange(_TRIALS), rng.integers(shape[1], size=_TRIALS)] = True
        points = np.where(touched, points, centers)
        around = centers.mean(axis=0) + np.maximum(centers.std(axis=0), _FINEST) * rng.standard_normal(shape)
        others = centers[rng.integers(_TRIALS, size=shape), np.arange(shape[1])]
        around = np.where(categorical, others, reflected(around))
        how = rng.integers(6, size=(_TRIALS, 1))
        points = np.where(how == 0, drawn, np.where(how < 3, around, points))
        return points, places, (rng.random(_TRIALS) < 0.5) & (how[:, 0] > 0)


# Known crashes: search for other crashes, not for these again.
#
# Criticality leads to a known crash from all of its basin, so its neighbourhood alone is not enough: just outside of it
# are the most critical trials of all. A trial belongs to the basin of the nearest more critical one, unless that is far
# away (nearest-better clustering; Preuss 2010). A crash belongs to the basin of the nearest earlier one in this way.

_FAR = 2.0  # times the mean distance to the nearest more critical trial: beyond that, a trial is in a basin of its own
_REPEATS = 3  # consecutive crashes of known types in a basin: the next is new in at most one of five cases


class _KnownCrashes:
    """The places in the space of arguments that are not worth another trial.

    A basin is excluded when its last crashes are of known types. The same arguments may lead to other types, so one
    crash is not enough. A crash whose result has no type excludes its basin at once.

    The same traffic leads to the same crash even with other arguments, so the seed of a crash is excluded, too.
    """

    def __init__(self) -> None:
        self._crashes: deque[tuple[ScoredTrial, bool]] = deque(maxlen=_TRIALS)  # each with whether it was new
        self._types: set[str] = set()
        self._seeds = np.empty(0, dtype=np.int64)
        self._ground = np.empty((0, 0))  # points of crashes and trials
        self._is_excluded = np.empty(0, dtype=bool)  # of these, which are in an excluded basin

    def __bool__(self) -> bool:
        return bool(self._crashes)

    def cover(self, points: NDArray[np.float64], seeds: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which points are in an excluded basin or have the seed of a crash."""
        covered = np.isin(seeds, self._seeds)
        if self._is_excluded.any():
            away = (self._ground**2).sum(axis=1) - 2.0 * points @ self._ground.T
            covered |= self._is_excluded[np.argmin(away, axis=1)]
        return covered

    def covers(self, trial: ScoredTrial) -> bool:
        """Return whether a trial is in an excluded basin or has the seed of a crash."""
        return bool(self.cover(trial.point[None], np.array([trial.seed]))[0])

    def outside(self, trials: Sequence[ScoredTrial]) -> list[ScoredTrial]:
        """Return the trials that are not covered."""
        if not self._crashes or not trials:
            return [*trials]
        covered = self.cover(np.array([one.point for one in trials]), np.array([one.seed for one in trials])).tolist()
        return [trial for trial, is_covered in zip(trials, covered, strict=True) if not is_covered]

    def is_new(self, crash: ScoredTrial) -> bool:
        """Return whether the type of a crash is unknown; for a crash without a type, whether it is not covered."""
        return crash.kind not in self._types if crash.kind else not self.covers(crash)

    def add(self, crash: ScoredTrial, trials: Sequence[ScoredTrial]) -> None:
        """Add a crash, and compute the basins among trials without a crash."""
        self._crashes.append((crash, self.is_new(crash)))
        self._types.add(crash.kind)
        self._seeds = np.array([one.seed for one, _ in self._crashes])
        self._compute(trials)

    def update(self, trials: Sequence[ScoredTrial]) -> None:
        """Compute the basins among trials without a crash again, if one is excluded."""
        if self._is_excluded.any():
            self._compute(trials)

    def _compute(self, trials: Sequence[ScoredTrial]) -> None:
        many = len(self._crashes)
        points = np.array([one.point for one in (*(crash for crash, _ in self._crashes), *trials)])
        scores = np.append(CRASHED + np.arange(many, 0, -1), [trial.score for trial in trials])
        away, better = nearest_better(points, scores)
        reached = np.isfinite(away)
        far = _FAR * float(away[reached].mean()) if reached.any() else 0.0
        basins = np.arange(len(points))  # by the index of the most critical trial
        for place in np.argsort(-scores, kind="stable"):
            if away[place] <= far:
                basins[place] = basins[better[place]]
        repeats: dict[int, int] = {}
        for basin, (crash, is_new) in zip(basins[:many].tolist(), self._crashes, strict=True):
            known = _REPEATS if not crash.kind else 0 if is_new else repeats.get(basin, 0) + 1
            repeats[basin] = known
        self._ground = points
        self._is_excluded = np.isin(basins, [basin for basin, known in repeats.items() if known >= _REPEATS])


_EVEN, _MODEL = "halton", "model"
_WORTHWHILE = 1.5  # mean payoff: below that, the even search proposes, because criticality cannot mislead it
_PRIOR = 2.0  # payoff of one imagined trial of the model, so that it is tried
_NEARER = 0.85  # progress: the distance of the greatest score from 1 shrinks to this share or less
_PATIENCE = 14  # trials of the model without progress, for each argument, in which its share falls to 1 / e


class _Portfolio:
    """A model of criticality, in addition to Halton's sequence.

    Args:
        cube: cube of the arguments.
        space: the space of the arguments, as distributions.
        hunt: facts about the hunt, whose seed scrambles the sequence.
    """

    def __init__(self, cube: Cube, space: Space, hunt: HuntFacts) -> None:
        self._even = HaltonSampler(space, hunt=hunt)
        self._model = _Model(cube)
        self._patience = _PATIENCE * cube.dimensions
        self._unguided: list[float] = []  # scores, in order
        self._best = Elites(_TRIALS)  # most critical trials without a crash
        self._last: deque[ScoredTrial] = deque(maxlen=_TRIALS)  # latest trials without a crash
        self._known = _KnownCrashes()
        self._found = {True: (0.5, 1.0), False: (0.5, 1.0)}  # new types, as Jeffreys (1946), and trials: guided, not
        self._record, self._without_record = -1.0, 0  # greatest score, and trials of the model since then
        self._believe_again()

    def _believe_again(self) -> None:
        """Forget the payoffs of the model: believe in it as after one trial."""
        self._earned, self._counted = _PRIOR, 1.0

    def tell(self, trial: ScoredTrial) -> None:
        """Update payoffs and the model with a trial."""
        is_guided = trial.origin == _MODEL
        if is_guided:
            self._earned += 1.0 if self._is_inherited(trial) else self._payoff(trial.score)
            self._counted += 1.0
        else:
            insort(self._unguided, trial.score)
        types, trials = self._found[is_guided]
        self._found[is_guided] = (types + (trial.crashed and self._known.is_new(trial)), trials + 1.0)
        if trial.crashed:
            self._known.add(trial, self._remembered())
            self._model.remember(self._worth_learning())
            self._record = max((one.score for one in self._model.trials), default=-1.0)
            self._without_record = 0
            return
        self._best.add(trial)
        self._last.append(trial)
        self._known.update(self._remembered())
        self._model.learn(self._worth_learning())
        if not self._known.covers(trial):
            self._measure(trial)

    def propose(self, place: int, rng: np.random.Generator) -> Draft:
        """Return a proposal of the model, or the next point of the even search."""
        draft = self._model.propose(rng, self._known.cover if self._known else None) if self._is_guided(rng) else None
        return replace(draft, origin=_MODEL) if draft else Draft(self._even.point(place), origin=_EVEN)

    def _is_guided(self, rng: np.random.Generator) -> bool:
        """Draw whether the model proposes next."""
        if self._known:
            guided, unguided = (rng.standard_gamma(types) / trials for types, trials in self._found.values())
            if guided < unguided:
                return False
        if self._earned / rng.standard_gamma(self._counted) <= _WORTHWHILE:
            return False
        return bool(rng.random() < math.exp(-self._without_record / self._patience))

    def _measure(self, trial: ScoredTrial) -> None:
        """Update the greatest score and the progress of the model.

        If an unguided trial makes progress, the model knows more than in the trials that were counted. Where
        criticality is 0 almost everywhere, the model is otherwise hardly tried after the first trial that has any.
        """
        if 1.0 - trial.score < _NEARER * (1.0 - self._record):
            self._record, self._without_record = trial.score, 0
            if trial.origin != _MODEL:
                self._believe_again()
        elif trial.origin == _MODEL:
            self._without_record += 1

    def _remembered(self) -> list[ScoredTrial]:
        """Return the most critical and the latest trials without a crash, in order."""
        return _in_order([*self._last, *self._best])

    def _worth_learning(self) -> list[ScoredTrial]:
        """Return the trials from which the model learns: the most critical and the latest that are not covered."""
        half = _TRIALS // 2
        best, last = self._known.outside([*self._best]), self._known.outside([*self._last])
        return _in_order([*last[-half:], *best[:half]])

    def _is_inherited(self, trial: ScoredTrial) -> bool:
        """Return whether a trial has its parent's seed and is no more critical: the traffic alone may explain that."""
        parent = next((one for one in self._best if one.number == trial.parent), None)
        return parent is not None and parent.seed == trial.seed and trial.score <= parent.score

    def _payoff(self, score: float) -> float:
        below, at_most = bisect_left(self._unguided, score), bisect_right(self._unguided, score)
        above = len(self._unguided) - at_most + 0.5 * (at_most - below)
        return math.log((len(self._unguided) + 1.0) / (above + 0.5))


def _in_order(trials: Sequence[ScoredTrial]) -> list[ScoredTrial]:
    """Return trials by their number, each once."""
    known = {trial.number: trial for trial in trials}
    return [known[number] for number in sorted(known)]


class EightConstants(GuidedSampler):
    """The sampler of this version."""

    def _make(self, space: Space) -> Strategy:
        return _Portfolio(self._cube, space, self._hunt)
