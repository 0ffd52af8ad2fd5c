"""Rare mode of a hunt: its trials are roots, their copies have forced first onsets, and the rate is estimated of both.

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
from crashhunt.rates import BLOCK, learn_forcing, rare_estimate, root_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.ledger import Ledger
    from crashhunt.plans import HuntSettings
    from crashhunt.rates import RareEstimate, Root
    from crashhunt.trial import Forced, ForcedCopy, Forcing, TrialResult

__all__ = ["Forcings", "PrecisionRule", "crashed_copies", "greatest_weight"]


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
        self._known = 0  # roots of which the earlier results are
        self._current = self._start

    @staticmethod
    def needed(number: int) -> int:
        """Return how many roots, from number 0 on, have to have ended before a root begins."""
        return max(0, number // BLOCK - 1) * BLOCK

    def of(self, number: int) -> Forcing:
        """Return the forcing of a root; numbers have to be asked in order."""
        needed = self.needed(number)
        if self._known < needed:
            for earlier in range(self._known, needed):
                result = self._ledger.result(earlier)
                if result is not None and result.forced is not None and not result.forced.unanswered:
                    self._earlier.append(result.forced)
            self._known = needed
            self._current = learn_forcing(self._earlier, self._start)
        return self._current


class PrecisionRule:
    """Reads roots in order of their numbers, and finds the block at which the hunt may end.

    Args:
        settings: of the hunt.
        ledger: of the hunt.
        sampler: of its disturbances.

    Attributes:
        roots: those with a complete result.
        excluded: how many have none.
        is_met: whether the interval is narrow enough; no root is read after that.
    """

    def __init__(self, settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler) -> None:
        self.roots: list[Root] = []
        self.results: list[TrialResult] = []  # with a crash of a copy
        self.excluded = 0
        self.is_met = False
        self._settings, self._ledger = settings, ledger
        self._hazard = len(sampler.agents) * math.fsum(sampler.chance(name) for name in sampler.models)
        self._until = share_of(settings.run.until_error) if settings.run.until_error else 0.0
        self._next = 0

    def read(self, finished: int | None = None) -> None:
        """Read the roots that have ended, up to the first one that has not.

        Args:
            finished: how many roots, from number 0 on, have ended; None to look.
        """
        while not self.is_met and (finished is None or self._next < finished):
            result = self._ledger.result(self._next)
            if result is None:
                return
            self._next += 1
            root = root_of(result, self._settings.crash_on, self._hazard)
            if root is None:
                self.excluded += 1
            else:
                self.roots.append(root)
                if any(crashed_copies(result)):
                    self.results.append(result)
            if self._until and self._next % BLOCK == 0:
                self.is_met = self.estimate().relative_error <= self._until

    def estimate(self) -> RareEstimate:
        """Return the estimate of the roots that were read."""
        least_bound = min(1.0, self._hazard * self._settings.max_steps)
        return rare_estimate(self.roots, least_bound=least_bound, excluded=self.excluded)


def crashed_copies(result: TrialResult) -> Iterator[ForcedCopy]:
    """Return the copies of a root that crashed."""
    return (copy for copy in result.forced.copies if copy.crash) if result.forced is not None else iter(())


def greatest_weight(result: TrialResult) -> float:
    """Return the greatest weight among the crashed copies of a root that has some."""
    return max(copy.weight for copy in crashed_copies(result))
