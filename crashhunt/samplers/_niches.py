"""Where else to look once nothing nearer to a crash is found around the most dangerous trial.

Danger has several peaks, and the highest need not be one at which anything crashes. A trial that is far from every more
dangerous one is at the foot of another peak (nearest-better distance; Preuss 2010). Around it, up to there, a model of
its own looks for more.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.samplers._elites import Elites
from crashhunt.samplers._model import Model
from crashhunt.samplers._strategy import Draft, reflected

if TYPE_CHECKING:
    from crashhunt.samplers._cube import Cube
    from crashhunt.samplers._told import Told

__all__ = ["Niches"]

_LAST, _BEST = 256, 64  # trials among which feet of peaks are looked for
_LEAST = 12  # of them
_AGAIN = 32  # trials after which feet are looked for again where there was none
_FAR = 2.0  # times the mean distance to a more dangerous one: so far away, it is the foot of another peak
_TRIED = 16  # feet to which nobody goes back
_PATIENCE, _PATIENCE_PER_ARGUMENT = 5, 1  # trials without a greater danger until it is left
_NEARER = 0.85  # of what was missing to a crash is missing now, or less: else it is no greater danger
_TRIES = 4


class Niches:
    """Climbs one peak after the other.

    Args:
        cube: of the arguments.
        like: whose fitted parameters its models begin with.
    """

    def __init__(self, cube: Cube, like: Model) -> None:
        self._cube, self._like = cube, like
        self._patience = _PATIENCE + _PATIENCE_PER_ARGUMENT * cube.dimensions
        self._last: deque[Told] = deque(maxlen=_LAST)
        self._best = Elites(_BEST)
        self._tried: deque[Told] = deque(maxlen=_TRIED)
        self._foot: Told | None = None
        self._model = like
        self._reach = self._record = 0.0
        self._without_record = self._told = self._not_before = 0

    @property
    def climbs(self) -> bool:
        """Whether it has come nearer to a crash than the foot is."""
        return self._foot is not None and self._record > self._foot.score

    def tell(self, told: Told) -> None:
        """Take it in; leave the peak where nothing comes nearer any more."""
        self._best.add(told)
        self._last.append(told)
        self._told += 1
        if self._foot is None:
            return
        within = float(np.linalg.norm(told.point - self._foot.point)) < self._reach
        if within:
            self._model.tell(told)
        if within and 1.0 - told.score < _NEARER * (1.0 - self._record):
            self._record, self._without_record = told.score, 0
        elif told.origin == "niche":
            self._without_record += 1
        if self._without_record >= self._patience:
            self._foot = None

    def begin(self) -> None:
        """Go to the foot of another peak, unless it is at one."""
        if self._foot is not None or self._told < max(self._not_before, _LEAST):
            return
        self._not_before = self._told + _AGAIN
        told = {one.number: one for one in self._last} | {one.number: one for one in self._best}
        trials = [told[number] for number in sorted(told)]
        points, scores = np.array([told.point for told in trials]), np.array([told.score for told in trials])
        away = (points**2).sum(axis=1)[:, None] + (points**2).sum(axis=1) - 2.0 * points @ points.T
        away = np.sqrt(np.maximum(away, 0.0))
        away[scores <= scores[:, None]] = np.inf
        reach = away.min(axis=1)
        rank = np.searchsorted(np.sort(scores), scores) / len(scores)
        known = np.isfinite(reach)  # but for the most dangerous one
        least = _FAR * float(reach[known].mean()) if known.any() else 0.0
        worth = np.where(known & (reach > least), np.where(known, reach, 0.0) * rank, 0.0)
        for place in np.argsort(-worth, kind="stable"):
            tried = (float(np.linalg.norm(points[place] - foot.point)) for foot in self._tried)
            if worth[place] > 0.0 and all(one > 0.5 * reach[place] for one in tried):
                self._go(trials[place], float(reach[place]), trials)
                return

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return what the model of this peak proposes; None where there is no other peak."""
        if self._foot is None:
            return None
        for _ in range(_TRIES):
            draft = self._model.propose(place, rng)
            if draft is not None and float(np.linalg.norm(draft.point - self._foot.point)) < self._reach:
                return draft
        size = len(self._foot.point)
        step = self._reach / math.sqrt(size) * rng.standard_normal(size)
        return Draft(reflected(self._foot.point + step), parent=self._foot.number)

    def _go(self, foot: Told, reach: float, trials: list[Told]) -> None:
        self._tried.append(foot)
        self._foot, self._reach, self._record, self._without_record = foot, reach, foot.score, 0
        self._model = Model(self._cube, like=self._like)
        self._model.remember(told for told in trials if float(np.linalg.norm(told.point - foot.point)) < reach)
