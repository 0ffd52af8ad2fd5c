"""Simpler versions of ``guided``, to be measured beside it: ``scripts/search --samplers guided,simpler``.

All are the model of criticality and the even search, with neither mutation nor niches. The payoff of a trial that is
more critical than a share of 1 - q of the unguided trials is -log q, which is exponentially distributed with mean 1 for
trials that know nothing. The mean payoff of the model therefore has an inverse gamma posterior. Before each proposal, a
mean is drawn from it (Thompson 1933), and the model proposes if the mean is high enough.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.samplers import GuidedSampler
from crashhunt.samplers._guided import KnownCrashes
from crashhunt.samplers._model import Model
from crashhunt.samplers._space_filling import HaltonSampler
from crashhunt.samplers._strategy import CRASHED, Draft, Elites

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from crashhunt.samplers._protocol import HuntFacts, Space
    from crashhunt.samplers._space_filling import Cube
    from crashhunt.samplers._strategy import ScoredTrial, Strategy

__all__ = ["Simpler", "SimplerAgain", "SimplerPeaks"]

_EVEN, _MODEL, _PEAK = "halton", "model", "peak"
_MEMORY = 256  # trials from which the model restarts after a crash
_WORTHWHILE = 1.5  # mean payoff: below that, the even search proposes, because it cannot be misled
_PRIOR_TRIALS, _PRIOR_PAYOFF = 3.0, 2.0  # belief in the model before its first trial, so that it is tried
_NEARER = 0.85  # progress: the distance of the score from 1 shrinks to this share or less
_PATIENCE = 7  # trials of a model without progress for each argument before it may be stuck
_AHEAD = 2.5  # mean payoff beyond which a model without progress is stuck
_STUCK = 0.1  # share of its proposals while it is stuck
_JEFFREYS = 0.5  # prior of the number of new crash types (Jeffreys 1946)
_TRIES = 4  # proposals of a model, of which the first outside known crashes is used


class _Portfolio:
    """A model of criticality, in addition to Halton's sequence (version D of the study).

    Args:
        cube: cube of the arguments.
        space: the same as distributions.
        hunt: its seed scrambles the sequence.
    """

    def __init__(self, cube: Cube, space: Space, hunt: HuntFacts) -> None:
        self._cube = cube
        self._even = HaltonSampler(space, hunt=hunt)
        self._patience = _PATIENCE * cube.dimensions
        self._unguided: list[float] = []  # scores, in order
        self._best = Elites(_MEMORY)
        self._known = KnownCrashes(cube.dimensions)
        self._earned, self._counted = _PRIOR_TRIALS * _PRIOR_PAYOFF, _PRIOR_TRIALS  # payoffs of the model, and trials
        self._ranks, self._proposed = 0.0, 0  # the same without a prior, with inherited criticality
        self._kinds = {True: (_JEFFREYS, 1.0), False: (_JEFFREYS, 1.0)}  # new types and trials: guided, unguided
        self._model = Model(cube)
        self._begin()

    def _begin(self) -> None:
        """Restart the model from the trials that are not near a known crash."""
        best, self._best = _in_order(self._best), Elites(_MEMORY)
        kept = self._known.sift(best)
        self._model = Model(self._cube, like=self._model)
        self._model.remember(kept)
        self._record, self._without_record = -1.0, 0  # greatest criticality, and trials of the model since then
        for trial in kept:
            self._best.add(trial)
            self._measure(trial)

    def tell(self, trial: ScoredTrial) -> None:
        """Update payoffs and the model with a trial."""
        if trial.origin == _MODEL:
            payoff = self._payoff(trial.score)
            self._ranks, self._proposed = self._ranks + payoff, self._proposed + 1
            self._earned += 1.0 if self._is_inherited(trial) else payoff
            self._counted += 1.0
        elif trial.origin != _PEAK:
            insort(self._unguided, trial.score)
        is_guided = trial.origin in (_MODEL, _PEAK)
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

    def propose(self, place: int, rng: np.random.Generator) -> Draft:
        """Return a proposal of the model, or the next point of the even search."""
        draft = self._guided(place, rng) if self._is_guided(rng) else None
        return draft or Draft(self._even.point(place), origin=_EVEN)

    def _guided(self, place: int, rng: np.random.Generator) -> Draft | None:
        return self._outside(self._model, place, rng, _MODEL, (self._known,))

    def _outside(
        self, model: Model, place: int, rng: np.random.Generator, origin: str, excluded: Sequence[KnownCrashes]
    ) -> Draft | None:
        """Return the first proposal of a model that is not excluded; None if there is none."""
        for _ in range(_TRIES):
            draft = model.propose(place, rng)
            if draft is not None and not any(known.cover(draft.point, draft.seed) for known in excluded):
                return replace(draft, origin=origin)
        return None

    def _is_guided(self, rng: np.random.Generator) -> bool:
        """Draw whether the model proposes next."""
        if self._known and not self._finds_more(rng):
            return False
        if self._is_stuck:
            return bool(rng.random() < _STUCK)
        return bool(self._earned / rng.standard_gamma(self._counted) > _WORTHWHILE)

    def _finds_more(self, rng: np.random.Generator) -> bool:
        """Draw whether the model finds more new types per trial than unguided trials (Thompson 1933)."""
        guided, unguided = (rng.standard_gamma(kinds) / trials for kinds, trials in self._kinds.values())
        return bool(guided >= unguided)

    def _measure(self, trial: ScoredTrial) -> bool:
        """Update the greatest criticality and the progress of the model; return whether there is progress."""
        if 1.0 - trial.score < _NEARER * (1.0 - self._record):
            self._record, self._without_record = trial.score, 0
            return True
        self._without_record += trial.origin == _MODEL
        return False

    def _is_inherited(self, trial: ScoredTrial) -> bool:
        """Return whether a trial has its parent's seed and is no more critical: the traffic alone may explain that."""
        parent = next((one for one in self._best if one.number == trial.parent), None)
        return parent is not None and parent.seed == trial.seed and trial.score <= parent.score

    def _payoff(self, score: float) -> float:
        below, at_most = bisect_left(self._unguided, score), bisect_right(self._unguided, score)
        above = len(self._unguided) - at_most + 0.5 * (at_most - below)
        return math.log((len(self._unguided) + 1.0) / (above + 0.5))

    @property
    def _is_stuck(self) -> bool:
        return self._without_record >= self._patience and self._ranks > _AHEAD * self._proposed


class _Again(_Portfolio):
    """The belief in the model begins again when an unguided trial makes progress (version E).

    The model then knows more than in the trials that were counted. Where criticality is 0 almost everywhere, the model
    is otherwise hardly tried after the first trial that has any.
    """

    def _measure(self, trial: ScoredTrial) -> bool:
        progress = super()._measure(trial)
        if progress and trial.origin != _MODEL:
            mean = max(self._earned / self._counted, _PRIOR_PAYOFF)
            self._earned, self._counted = mean * _PRIOR_TRIALS, _PRIOR_TRIALS
            self._ranks, self._proposed = 0.0, 0
        return progress


class _Peaks(_Again):
    """While the model is stuck, a second one searches outside the basins of the peaks without progress (version G).

    The second model has as many proposals as the first one keeps. Instead of those of the first, they cost several
    thousand trials where the crash is at the peak without progress (version F).
    """

    def _begin(self) -> None:
        self._peaks: KnownCrashes | None = None
        super()._begin()

    def _measure(self, trial: ScoredTrial) -> bool:
        progress = super()._measure(trial)
        if progress:
            self._peaks = None
        elif self._is_stuck and self._peaks is None:
            self._peaks = KnownCrashes(self._cube.dimensions)
            for one in _in_order(self._best):
                self._peaks.see(one)
            self._leave(self._best[0])
        return progress

    def _leave(self, top: ScoredTrial) -> None:
        """Exclude the basin of a trial, and restart the second model from all others."""
        assert self._peaks is not None
        self._peaks.add(replace(top, score=CRASHED, kind=""))
        self._other = Model(self._cube, like=self._model)
        others = self._peaks.outside(_in_order(self._best))
        self._other.remember(others)
        self._other_record, self._without_other = max((one.score for one in others), default=-1.0), 0

    def tell(self, trial: ScoredTrial) -> None:
        """Update the second model, too."""
        peaks = self._peaks
        super().tell(trial)
        if peaks is None or peaks is not self._peaks or trial.crashed:
            return
        for known in peaks.see(trial):
            self._other.tell(known)
        if 1.0 - trial.score < _NEARER * (1.0 - self._other_record) and not peaks.cover(trial.point):
            self._other_record, self._without_other = trial.score, 0
        elif trial.origin == _PEAK:
            self._without_other += 1
        others = peaks.outside(list(self._best)) if self._without_other >= self._patience else []
        if others:
            self._leave(others[0])

    def _is_guided(self, rng: np.random.Generator) -> bool:
        return super()._is_guided(rng) or (self._has_second and bool(rng.random() < _STUCK / (1.0 - _STUCK)))

    @property
    def _has_second(self) -> bool:
        return self._is_stuck and self._peaks is not None and not self._known

    def _guided(self, place: int, rng: np.random.Generator) -> Draft | None:
        peaks = self._peaks
        if peaks is not None and self._has_second and rng.random() < 0.5:
            return self._outside(self._other, place, rng, _PEAK, (self._known, peaks))
        return super()._guided(place, rng)


def _in_order(trials: Elites) -> list[ScoredTrial]:
    return sorted(trials, key=lambda trial: trial.number)


class Simpler(GuidedSampler):
    """Version D of the study."""

    def _make(self, space: Space) -> Strategy:
        return _Portfolio(self._cube, space, self._hunt)


class SimplerAgain(GuidedSampler):
    """Version E."""

    def _make(self, space: Space) -> Strategy:
        return _Again(self._cube, space, self._hunt)


class SimplerPeaks(GuidedSampler):
    """Version G."""

    def _make(self, space: Space) -> Strategy:
        return _Peaks(self._cube, space, self._hunt)
