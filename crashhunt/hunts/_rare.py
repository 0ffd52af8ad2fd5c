"""Rare mode of a hunt: every fifth trial is a root, whose copies have forced first onsets; the others are plain trials.

The forcing of a root depends on its number and on the results of earlier blocks alone. So the roots are the same with
any number of workers, and after the hunt was killed and resumed.

``--until-error`` ends the hunt at the first full block at which the interval is narrow enough. Roots above that block
may have ended by then. They do not count, because that they have ended depends on the number of workers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from crashhunt.disturbances import first_forcing
from crashhunt.plans import share_of
from crashhunt.rates import BLOCK, TRIALS_PER_ROOT, Paced, RareCounter, is_root, learn_forcing, root_of, with_plain
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.ledger import Ledger, RunningRate
    from crashhunt.plans import HuntSettings
    from crashhunt.rates import RareEstimate
    from crashhunt.trial import Forced, ForcedCopy, Forcing, TrialResult

__all__ = ["Forcings", "RareWatch", "crashed_copies", "greatest_weight"]

_WEIGHTIEST = 5  # roots; a crash of a copy is a crash only where it comes again from the start


class Forcings:
    """The forcing of each root, learned from the blocks before the previous one.

    Args:
        settings: of the hunt.
        ledger: of the hunt.
        sampler: of its disturbances.
    """

    def __init__(self, settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler) -> None:
        self._ledger = ledger
        self._start = first_forcing(sampler, settings.max_steps)
        self._earlier: list[Forced] = []
        self._known = 0  # trials that the earlier results are of
        self._current = self._start

    @staticmethod
    def needed(number: int) -> int:
        """Return how many trials, from number 0 on, have to have ended before a trial begins."""
        if not is_root(number):
            return 0
        return max(0, number // TRIALS_PER_ROOT // BLOCK - 1) * BLOCK * TRIALS_PER_ROOT

    def of(self, number: int) -> Forcing | None:
        """Return the forcing of a root, None of a plain trial; numbers have to be asked in order."""
        if not is_root(number):
            return None
        needed = self.needed(number)
        if self._known < needed:
            for earlier in range(self._known, needed, TRIALS_PER_ROOT):
                result = self._ledger.result(earlier)
                if result is not None and result.forced is not None and not result.forced.unanswered:
                    self._earlier.append(result.forced)
            self._known = needed
            self._current = learn_forcing(self._earlier, self._start)
        return self._current


class RareWatch:
    """Reads trials in order of their numbers, and finds the block at which the hunt may end.

    A root counts once its plain trials have ended as well.

    Args:
        settings: of the hunt.
        ledger: of the hunt.
        sampler: of its disturbances.

    Attributes:
        weightiest: of the roots with a crash of a copy, those with the greatest weights, the greatest first.
        is_met: whether the interval is narrow enough; no trial is read after that.
    """

    def __init__(self, settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler) -> None:
        self.weightiest: list[TrialResult] = []
        self.is_met = False
        self._settings, self._ledger = settings, ledger
        self._hazard = len(sampler.agents) * math.fsum(sampler.chance(name) for name in sampler.models)
        self._counter = RareCounter(min(1.0, self._hazard * settings.max_steps))
        self._until = share_of(settings.run.until_error) if settings.run.until_error else 0.0
        self._read = 0  # trials
        self._group: list[TrialResult] = []  # the last root that was read, and its plain trials
        self._paced: Paced[RunningRate] = Paced(lambda: self.estimate().running())

    @property
    def roots(self) -> int:
        """How many roots were read with their plain trials."""
        return self._counter.roots + self._counter.excluded

    def read(self, finished: int | None = None) -> None:
        """Read the trials that have ended, up to the first one that has not.

        Args:
            finished: how many trials, from number 0 on, have ended; None to look.
        """
        while not self.is_met and (finished is None or self._read < finished):
            result = self._ledger.result(self._read)
            if result is None:
                return
            self._read += 1
            self._group.append(result)
            if self._read % TRIALS_PER_ROOT == 0:
                self._count(*self._group)
                self._group.clear()

    def _count(self, first: TrialResult, *plain: TrialResult) -> None:
        crash_on = self._settings.crash_on
        root = root_of(first, crash_on, self._hazard)
        if root is None:
            self._counter.add(None, (one.outcome in crash_on for one in plain if one.outcome is not Outcome.INVALID))
        else:
            self._counter.add(with_plain(root, plain, crash_on))
            if any(crashed_copies(first)):
                self.weightiest.append(first)
                self.weightiest.sort(key=greatest_weight, reverse=True)
                del self.weightiest[_WEIGHTIEST:]
        if self._until and self.roots % BLOCK == 0:
            self.is_met = self.estimate().relative_error <= self._until

    def estimate(self) -> RareEstimate:
        """Return the estimate of the trials that were read."""
        return self._counter.estimate()

    def running(self, *, now: bool = False) -> RunningRate:
        """Return the rate so far.

        Args:
            now: whether that of some moments ago will not do, where a new one takes too much of the time.
        """
        return self._paced(self.roots, now=now)


def crashed_copies(result: TrialResult) -> Iterator[ForcedCopy]:
    """Return the copies of a root that crashed."""
    return (copy for copy in result.forced.copies if copy.crash) if result.forced is not None else iter(())


def greatest_weight(result: TrialResult) -> float:
    """Return the greatest weight among the crashed copies of a root that has some."""
    return max(copy.weight for copy in crashed_copies(result))
