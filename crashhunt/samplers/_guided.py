"""The portfolio behind the sampler `guided`: distributes trials between a model and an even search.

Computes the share of the model by payoff. A trial that is more critical than a share of 1 - q of the unguided trials
has payoff -log q. The mean payoff is 1 where the model learns nothing, so only ranks matter for payoffs. Two thresholds
read the scale of criticality, namely the progress of the model, and the criticality of 0.5 that caps its share.

Invariant: the model keeps at least 2 % of the trials (probes), and the even search gets everything that the model does
not earn. A hunt with a misleading criticality is therefore never much worse than an even search.

Reason against using only the model: rising criticality does not imply a crash, and before the first crash this is
unknown. Two signs show that criticality misleads. Either the model is far ahead of the unguided trials and makes no
progress, or it never exceeds a criticality of 0.5. In both cases its share is capped, and a part of it explores other
peaks (`Niches`).

After the first crash, new crash types count. Before each proposal, the rate of new types that the model finds is drawn
from its posterior, and so is that of unguided trials (Thompson 1933). The model does not search in basins of crashes
that yield known types only.

Sources: nearest-better distance (Preuss 2010), Thompson sampling (1933), Halton's sequence (1960); payoffs and shares
are our own, measured with `scripts/search`. Cost: below a millisecond per trial in addition to the model.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.samplers._model import Model
from crashhunt.samplers._space_filling import HaltonSampler
from crashhunt.samplers._strategy import CRASHED, PLAIN_EVERY, Draft, Elites, reflected

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.samplers._protocol import HuntFacts, Space
    from crashhunt.samplers._space_filling import Cube
    from crashhunt.samplers._strategy import ScoredTrial


__all__ = ["KnownCrashes", "Niches", "Portfolio"]


_MEMORY = 256  # latest trials, and most critical ones, in memory: distances between all take some milliseconds


# Niches: other peaks of criticality, explored when trials around the most critical one make no more progress.
#
# Criticality has several peaks, and the highest may not contain a crash. A trial that is far from every more critical
# one is at the foot of another peak (nearest-better distance; Preuss 2010). A separate model searches the ball around
# the foot whose radius is that distance.

_LEAST = 12  # trials before the search for feet
_RETRY_AFTER = 32  # trials between two searches without success
_FAR_FOOT = 2.0  # times the mean distance to the next more critical trial: beyond that it is the foot of another peak
_TRIED = 16  # last feet, which are not visited again
_NICHE_PATIENCE, _NICHE_PATIENCE_PER_ARGUMENT = 5, 1  # trials without progress before a peak is abandoned
_NEARER = 0.85  # progress: the distance of the score from 1 shrinks to this share or less
_TRIES = 4  # proposals of the model, of which the first inside the ball is used


class Niches:
    """Searches near the peaks of criticality, one peak after the other.

    Args:
        cube: the unit cube whose dimensions are the arguments that vary.
        like: a model whose fitted parameters are the initial parameters of the model of each peak.
    """

    def __init__(self, cube: Cube, like: Model) -> None:
        self._cube, self._like = cube, like
        self._patience = _NICHE_PATIENCE + _NICHE_PATIENCE_PER_ARGUMENT * cube.dimensions
        self._last: deque[ScoredTrial] = deque(maxlen=_MEMORY)
        self._best = Elites(_MEMORY)
        self._tried: deque[ScoredTrial] = deque(maxlen=_TRIED)
        self._foot: ScoredTrial | None = None
        self._model = like
        self._reach = self._record = 0.0
        self._without_record = self._told = self._not_before = 0

    def tell(self, trial: ScoredTrial) -> None:
        """Add a trial; abandon the peak where no more progress is made."""
        self._best.add(trial)
        self._last.append(trial)
        self._told += 1
        if self._foot is None:
            return
        within = float(np.linalg.norm(trial.point - self._foot.point)) < self._reach
        if within:
            self._model.tell(trial)
        if within and 1.0 - trial.score < _NEARER * (1.0 - self._record):
            self._record, self._without_record = trial.score, 0
        elif trial.origin == "niche":
            self._without_record += 1
        if self._without_record >= self._patience:
            self._foot = None

    def begin(self) -> None:
        """Select a trial at which the search of another peak begins, unless a peak is already being searched."""
        if self._foot is not None or self._told < max(self._not_before, _LEAST):
            return
        self._not_before = self._told + _RETRY_AFTER
        trial = {one.number: one for one in self._last} | {one.number: one for one in self._best}
        trials = [trial[number] for number in sorted(trial)]
        points, scores = np.array([trial.point for trial in trials]), np.array([trial.score for trial in trials])
        reach, _ = nearest_better(points, scores)
        rank = np.searchsorted(np.sort(scores), scores)
        known = np.isfinite(reach)  # all but the most critical one
        least = _FAR_FOOT * float(reach[known].mean()) if known.any() else 0.0
        worth = np.where(known & (reach > least), reach, 0.0) * rank
        for place in np.argsort(-worth, kind="stable"):
            tried = (float(np.linalg.norm(points[place] - foot.point)) for foot in self._tried)
            if worth[place] > 0.0 and all(one > 0.5 * reach[place] for one in tried):
                self._go(trials[place], float(reach[place]), trials)
                return

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a proposal of the model of the current peak; None if no peak is selected."""
        if self._foot is None:
            return None
        for _ in range(_TRIES):
            draft = self._model.propose(place, rng)
            if draft is not None and float(np.linalg.norm(draft.point - self._foot.point)) < self._reach:
                return draft
        size = len(self._foot.point)
        step = self._reach / math.sqrt(size) * rng.standard_normal(size)
        return Draft(reflected(self._foot.point + step), parent=self._foot.number)

    def _go(self, foot: ScoredTrial, reach: float, trials: list[ScoredTrial]) -> None:
        self._tried.append(foot)
        self._foot, self._reach, self._record, self._without_record = foot, reach, foot.score, 0
        self._model = Model(self._cube, like=self._like)
        self._model.remember(trial for trial in trials if float(np.linalg.norm(trial.point - foot.point)) < reach)


# Known crashes: search for other crashes, not for these again.
#
# Criticality leads to a known crash from all of its basin, so its neighbourhood alone is not enough: just outside of it
# are the most critical trials of all. A trial belongs to the basin of the nearest more critical one, unless that is far
# away (nearest-better clustering; Preuss 2010). A basin is excluded if its crash yields known types only.

_MOST = 32  # crashes whose neighbourhood is excluded
_SEEDS = 1024  # seeds of crashes in memory
_AROUND = 0.1  # radius of an excluded neighbourhood, times the square root of the dimensions
_JUST_THERE = 0.02  # the same, while the next crash there may be of another type
_REPEATS = 3  # consecutive crashes of known types in a neighbourhood: the next is new in at most one of five cases
_BASINS_EVERY = 16  # trials without a crash, after which basins are made again


class KnownCrashes:
    """The places in the space of arguments that are not worth another trial.

    A crash excludes a neighbourhood that depends on its type. If the result has no type, a wide neighbourhood and the
    basin of the crash are excluded at once. If the result has a type, almost nothing is excluded at first, because the
    same arguments may lead to other types. After three consecutive crashes of known types, the wide neighbourhood and
    the basin are excluded.

    The same traffic leads to the same crash even with other arguments, so no proposal reuses the seed of a crash.

    Args:
        dimensions: number of arguments that vary.
    """

    def __init__(self, dimensions: int) -> None:
        self._unit = math.sqrt(dimensions)
        self._points = np.empty((0, dimensions))
        self._radii = np.empty(0)
        self._kinds: dict[str, None] = {}
        self._seeds: dict[int, None] = {}
        self._again: list[NDArray[np.float64]] = []  # last crashes of known types that no new type has followed nearby
        self._seen: deque[ScoredTrial] = deque(maxlen=_MEMORY)
        self._covered_trials: deque[ScoredTrial] = deque(maxlen=_MEMORY)
        self._since_basins = 0
        self._ground = np.empty((0, dimensions))  # points of trials, and of excluded crashes
        self._in_basin = np.empty(0, dtype=bool)  # of these, which are in an excluded basin

    def __bool__(self) -> bool:
        return bool(len(self._radii))

    def cover(self, point: NDArray[np.float64], seed: int | None = None) -> bool:
        """Return whether a trial would likely repeat a known crash, because of its point or its seed.

        Args:
            point: arguments of the trial as a point in the unit cube. The point is covered if it is near a known crash,
                or if criticality rises from it towards a known crash.
            seed: seed of the trial, which is covered if a known crash has the same seed; None to ignore seeds.
        """
        return seed in self._seeds or bool(self._covered(point[None])[0])

    def is_new(self, trial: ScoredTrial) -> bool:
        """Return whether the type of a crash is unknown; for a crash without a type, whether no known crash is near."""
        return trial.kind not in self._kinds if trial.kind else not self.cover(trial.point)

    def outside(self, trials: Sequence[ScoredTrial]) -> list[ScoredTrial]:
        """Return the trials that `cover` does not cover."""
        if not trials:
            return []
        covered = self._covered(np.array([trial.point for trial in trials])).tolist()
        return [
            trial for trial, near in zip(trials, covered, strict=True) if not near and trial.seed not in self._seeds
        ]

    def see(self, trial: ScoredTrial) -> list[ScoredTrial]:
        """Add a trial without a crash; return all trials that are worth learning from since it is known.

        Usually, the result is the trial itself, or empty if the trial is covered. Earlier covered trials are added to a
        later result if they turn out to be at another peak than the known crashes.
        """
        self._seen.append(trial)
        self._since_basins += 1
        if self._since_basins < _BASINS_EVERY or not self._in_basin.any():
            return self.sift([trial])
        self._make_basins()
        again = [*self._covered_trials, trial]
        self._covered_trials.clear()
        return self.sift(again)

    def sift(self, trials: Sequence[ScoredTrial]) -> list[ScoredTrial]:
        """Return the trials that `cover` does not cover; remember the others, which may become uncovered later."""
        kept = self.outside(trials)
        numbers = {trial.number for trial in kept}
        self._covered_trials.extend(trial for trial in trials if trial.number not in numbers)
        return kept

    def add(self, trial: ScoredTrial) -> bool:
        """Add a crash; return whether the excluded region has changed."""
        new = bool(trial.kind) and trial.kind not in self._kinds
        self._kinds[trial.kind] = None
        if len(self._kinds) > _MEMORY:
            del self._kinds[next(iter(self._kinds))]
        self._seeds[trial.seed] = None
        if len(self._seeds) > _SEEDS:
            del self._seeds[next(iter(self._seeds))]
        away = self._away(trial.point[None])[0]
        around = away < self._radii
        if new:  # the region contains more types than assumed, so it is open again
            self._radii = np.where(around, np.minimum(_JUST_THERE * self._unit, away), self._radii)
        elif around.any():
            return False
        kept = self._radii > 0.0  # a radius of 0 is the very same point, as with choices and whole numbers
        worked_out = not trial.kind or self._is_worked_out(trial.point, new)
        radius = (_AROUND if worked_out else _JUST_THERE) * self._unit
        self._points = np.vstack((self._points[kept], trial.point))[-_MOST:]
        self._radii = np.append(self._radii[kept], radius)[-_MOST:]
        self._make_basins()
        return True

    def _make_basins(self) -> None:
        """Compute which trials are in the basin of a crash whose wide neighbourhood is excluded."""
        self._since_basins = 0
        worked_out = self._points[self._radii > _JUST_THERE * self._unit]
        if not len(worked_out) or not self._seen:
            self._in_basin = np.zeros(len(self._ground), dtype=bool)
            return
        points = np.vstack((worked_out, [trial.point for trial in self._seen]))
        scores = np.append(np.full(len(worked_out), CRASHED), [trial.score for trial in self._seen])
        away, better = nearest_better(points, scores)
        reached = np.isfinite(away)
        far = _FAR_FOOT * float(away[reached].mean()) if reached.any() else 0.0
        self._ground, self._in_basin = points, np.arange(len(points)) < len(worked_out)
        for place in np.argsort(-scores, kind="stable")[len(worked_out) :]:
            self._in_basin[place] = away[place] <= far and self._in_basin[better[place]]

    def _covered(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        covered: NDArray[np.bool_] = np.any(self._away(points) < self._radii, axis=1)
        if self._in_basin.any():
            nearest = np.argmin(((points[:, None] - self._ground) ** 2).sum(axis=2), axis=1)
            covered |= self._in_basin[nearest]
        return covered

    def _is_worked_out(self, point: NDArray[np.float64], new: bool) -> bool:
        """Count a crash, and return whether its neighbourhood yields known types only."""
        near = [float(np.linalg.norm(other - point)) < _AROUND * self._unit for other in self._again]
        if new:
            self._again = [other for other, is_near in zip(self._again, near, strict=True) if not is_near]
            return False
        self._again = [*self._again, point][-_MOST:]
        return sum(near) + 1 >= _REPEATS

    def _away(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        away: NDArray[np.float64] = np.sqrt(((points[:, None] - self._points) ** 2).sum(axis=2))
        return away


def nearest_better(
    points: NDArray[np.float64], scores: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return the distance from each point to the nearest point with a greater score (or infinity), and its index."""
    away = (points**2).sum(axis=1)[:, None] + (points**2).sum(axis=1) - 2.0 * points @ points.T
    away = np.sqrt(np.maximum(away, 0.0))
    away[scores <= scores[:, None]] = np.inf
    return away.min(axis=1), away.argmin(axis=1)


_EVEN, _MODEL, _NICHE = "halton", "model", "niche"
_OF_OURS = 1.0 - 1.0 / PLAIN_EVERY  # share of a hunt's trials that the portfolio proposes; shares are of all trials
_CLIMBING, _STUCK = 0.7, 0.05  # maximum share of the model, with and without progress
_FAR, _NEAR = 0.35, 0.5  # maximum share while no criticality has exceeded the second number
_PROBING = 0.02  # minimum share of the model: its payoff may have changed
_OTHER_PEAKS = 0.08  # share of niches where the model is stuck
_PATIENCE, _PATIENCE_PER_ARGUMENT = 8, 3  # trials of the model without progress before it may be stuck
_AHEAD = 0.4  # recent share of the model's trials above all unguided ones, beyond which it is stuck
_FAR_AHEAD = 2.5  # mean payoff of the model, beyond which it is stuck
_LATELY = 0.1  # weight of the last trial in that recent share
_CREDIT = 3.0  # initial trials of the model, with a payoff of 2, so that it is tried
_FORGET = 0.96  # decay of the model's payoff per trial
_INHERITED = 0.3  # weight of a trial whose criticality may come from the seed of its parent
_KINDS = 0.5  # Jeffreys' prior of the number of new crash types


class Portfolio:
    """Divides the trials between a model of criticality and Halton's sequence.

    Args:
        cube: the unit cube whose dimensions are the arguments that vary.
        space: the space of the arguments, as distributions.
        hunt: facts about the hunt, whose seed scrambles the sequence.
    """

    def __init__(self, cube: Cube, space: Space, hunt: HuntFacts) -> None:
        self._cube = cube
        self._even = HaltonSampler(space, hunt=hunt)
        self._patience = _PATIENCE + _PATIENCE_PER_ARGUMENT * cube.dimensions
        self._unguided: list[float] = []  # scores, in order
        self._best = Elites(_MEMORY)
        self._known = KnownCrashes(cube.dimensions)
        self._earned, self._counted = 2.0 * _CREDIT, _CREDIT  # decaying sum and count of payoffs
        self._kinds = {True: (_KINDS, 1.0), False: (_KINDS, 1.0)}  # new types and trials: guided, unguided
        self._model = Model(cube)
        self._begin()

    def _begin(self) -> None:
        """Restart the model from the trials that are not near a known crash."""
        best, self._best = sorted(self._best, key=lambda trial: trial.number), Elites(_MEMORY)
        kept = self._known.sift(best)
        self._model = Model(self._cube, like=self._model)
        self._model.remember(kept)
        self._niches = Niches(self._cube, self._model)
        self._record, self._without_record = -1.0, 0  # greatest criticality, and trials since then
        self._rival = 0.0  # greatest criticality of an unguided trial
        self._ahead = 0.0  # recent share of the model's trials above all unguided ones
        for trial in kept:
            self._best.add(trial)
            self._measure(trial)

    def tell(self, trial: ScoredTrial) -> None:
        """Update payoffs and the model with a trial."""
        is_guided = trial.origin in (_MODEL, _NICHE)
        if trial.origin == _MODEL:
            payoff, weight = (1.0, _INHERITED) if self._is_inherited(trial) else (self._payoff(trial.score), 1.0)
            self._earned = self._earned * _FORGET + payoff * weight
            self._counted = self._counted * _FORGET + weight
        elif not is_guided:
            insort(self._unguided, trial.score)
        kinds, trials = self._kinds[is_guided]
        self._kinds[is_guided] = (kinds + (trial.crashed and self._known.is_new(trial)), trials + 1.0)
        if trial.crashed:
            if self._known.add(trial):
                self._begin()
            return
        for known in self._known.see(trial):
            self._best.add(known)
            self._model.tell(known)
            self._measure(known)
            self._niches.tell(known)
        if self._is_stuck:
            self._niches.begin()

    def propose(self, place: int, rng: np.random.Generator) -> Draft:
        """Return a proposal of the model of the highest or of another peak, or the next point of the even search."""
        for name in self._drawn(rng):
            strategy = self._niches if name == _NICHE else self._model
            for _ in range(_TRIES):
                draft = strategy.propose(place, rng)
                if draft is not None and not self._known.cover(draft.point, draft.seed):
                    return Draft(draft.point, draft.seed, draft.parent, origin=name)
        return Draft(self._even.point(place), origin=_EVEN)

    def _drawn(self, rng: np.random.Generator) -> list[str]:
        """Return the origins to try in their order; empty if it is the even search's turn."""
        names = []
        if self._is_stuck and rng.random() < _OTHER_PEAKS / _OF_OURS:
            names.append(_NICHE)
        share = _PROBING if self._known and not self._finds_more(rng) else self._share()
        if rng.random() < share / _OF_OURS:
            names.append(_MODEL)
        return names

    def _finds_more(self, rng: np.random.Generator) -> bool:
        """Draw whether guided trials find more new types per trial than unguided trials (Thompson 1933)."""
        guided, unguided = (rng.standard_gamma(kinds) / trials for kinds, trials in self._kinds.values())
        return bool(guided >= unguided)

    def _measure(self, trial: ScoredTrial) -> None:
        """Update the greatest criticality and the progress of the model."""
        if 1.0 - trial.score < _NEARER * (1.0 - self._record):
            self._record, self._without_record = trial.score, 0
        elif trial.origin == _MODEL:
            self._without_record += 1
        if trial.origin == _MODEL:
            self._ahead += _LATELY * ((trial.score > self._rival) - self._ahead)
        elif trial.origin != _NICHE:
            self._rival = max(self._rival, trial.score)

    def _is_inherited(self, trial: ScoredTrial) -> bool:
        """Return whether a trial has its parent's seed and is no more critical: the traffic alone may explain that."""
        parent = next((one for one in self._best if one.number == trial.parent), None)
        return parent is not None and parent.seed == trial.seed and trial.score <= parent.score

    def _payoff(self, score: float) -> float:
        below, at_most = bisect_left(self._unguided, score), bisect_right(self._unguided, score)
        above = len(self._unguided) - at_most + 0.5 * (at_most - below)
        return math.log((len(self._unguided) + 1.0) / (above + 0.5))

    def _share(self) -> float:
        """Return the share of the model in all trials of the hunt."""
        gain = max(self._earned / self._counted - 1.0, 0.0) ** 2
        most = _STUCK if self._is_stuck else _CLIMBING if self._record > _NEAR else _FAR
        return max(most * min(1.0, gain), _PROBING)

    @property
    def _is_stuck(self) -> bool:
        if self._without_record < self._patience:
            return False
        return self._ahead > _AHEAD or self._earned / self._counted > _FAR_AHEAD
