"""What a hunt's sampler has tried in this run, strategy by strategy, and what came of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crashhunt.trial import TrialResult

__all__ = ["SearchStatus", "Searching", "StrategyStatus"]


@dataclass(frozen=True, slots=True)
class StrategyStatus:
    """One of the origins of trials.

    Args:
        name: of the strategy.
        trials: that it proposed and that have ended.
        share: of all that have ended, 0 to 1.
        danger: mean of its trials, 0 to 1, a crash counting as 1; None where none of them has one.
        crashes: among its trials.
    """

    name: str
    trials: int
    share: float
    danger: float | None
    crashes: int


@dataclass(frozen=True, slots=True)
class SearchStatus:
    """How a search is going, for people who watch.

    Args:
        strategies: those that have had trials, the most frequent first; empty where a sampler names none.
        grown_trials: how many trials have ended since the greatest danger grew; None where it has not in this run.
        grown_s: how long ago that was, in s of wall time; None likewise.
    """

    strategies: tuple[StrategyStatus, ...] = ()
    grown_trials: int | None = None
    grown_s: float | None = None


@dataclass(slots=True)
class _Tally:
    trials: int = 0
    measured: int = 0
    danger: float = 0.0
    crashes: int = 0


@dataclass(slots=True)
class Searching:
    """Keeps account of the trials of this run."""

    ended: int = 0
    _tallies: dict[str, _Tally] = field(default_factory=dict)
    _grown: tuple[int, float] | None = None  # after how many trials, and when

    def take(self, result: TrialResult, *, crashed: bool) -> None:
        """Count a trial that has ended."""
        self.ended += 1
        if not result.spec.origin:
            return
        tally = self._tallies.setdefault(result.spec.origin, _Tally())
        tally.trials += 1
        tally.crashes += crashed
        danger = 1.0 if crashed else result.danger
        if danger is not None:
            tally.measured += 1
            tally.danger += danger

    def grow(self) -> None:
        """Take note that the trial which was counted last is the most dangerous one without a crash."""
        self._grown = self.ended, time.monotonic()

    def status(self) -> SearchStatus:
        """Return how it is going."""
        strategies = [
            StrategyStatus(
                name,
                tally.trials,
                tally.trials / self.ended,
                tally.danger / tally.measured if tally.measured else None,
                tally.crashes,
            )
            for name, tally in sorted(self._tallies.items(), key=lambda entry: (-entry[1].trials, entry[0]))
        ]
        if self._grown is None:
            return SearchStatus(tuple(strategies))
        trials, moment = self._grown
        return SearchStatus(tuple(strategies), self.ended - trials, time.monotonic() - moment)
