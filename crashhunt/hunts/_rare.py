"""Rare mode of a hunt: its trials are roots, their copies have forced first onsets, and the rate is estimated of both.

The forcing of a root depends on its number and on the results of earlier blocks alone. So the roots are the same with
any number of workers, and after the hunt was killed and resumed.

``--until-error`` ends the hunt at the first full block at which the interval is narrow enough. Roots above that block
may have ended by then. They do not count, because that they have ended depends on the number of workers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from crashhunt.base import layout
from crashhunt.disturbances import first_forcing
from crashhunt.hunts._verification import Found
from crashhunt.plans import share_of
from crashhunt.rates import BLOCK, learn_forcing, rare_estimate, root_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Bundle
    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.hunts._verification import VerificationRuns
    from crashhunt.ledger import Ledger
    from crashhunt.plans import HuntSettings
    from crashhunt.rates import RareEstimate, Root
    from crashhunt.trial import Forced, ForcedCopy, Forcing, TrialResult

__all__ = ["Forcings", "PrecisionRule", "RareReport", "verify_rare"]

_WEIGHTIEST: Final = 5  # roots; a crash of a copy is a crash only where it comes again from the start


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
                if any(copy.crash for copy in result.forced.copies if result.forced):  # type: ignore[union-attr]
                    self.results.append(result)
            if self._until and self._next % BLOCK == 0:
                self.is_met = self.estimate().relative_error <= self._until

    def estimate(self) -> RareEstimate:
        """Return the estimate of the roots that were read."""
        return rare_estimate(self.roots, excluded=self.excluded)


@dataclass(frozen=True, slots=True)
class RareReport:
    """What came of a hunt in rare mode.

    Args:
        estimate: of the crash probability per trial.
        verified: how many of the weightiest crashes of copies were run from the start.
        not_finished: how many of these could not be run to their end.
        crashes: those of them that crashed in the same way at the same step, and once more bit-identically.
    """

    estimate: RareEstimate
    verified: int
    not_finished: int
    crashes: tuple[Bundle, ...]

    @property
    def is_verified(self) -> bool:
        """Whether every crash that was run to its end from the start came again."""
        return len(self.crashes) == self.verified - self.not_finished

    def to_json(self) -> JsonObject:
        """Return the shape that ``run --json`` prints."""
        return {
            **self.estimate.to_json(),
            "run_again": self.verified,
            "not_finished": self.not_finished,
            "confirmed": len(self.crashes),
            "crashes": [bundle.summary() for bundle in self.crashes],
        }

    @property
    def lines(self) -> list[str]:
        """The answer, its evidence and what is missing, for the user."""
        found = self.estimate
        if found.estimate is None:
            return [f"rare: no estimate: {found.why_not or 'no root has ended'}"]
        answer = f"rare: {found.estimate:.2g} per trial"
        if found.estimated is not None:
            one = found.estimated
            answer += (
                f" ({one.low:.2g} to {one.high:.2g}, estimated from {found.roots} roots; "
                f"effective sample size {one.effective:.0f})"
            )
        lines = [answer]
        if found.estimated is None:
            more = f"; about {found.more_roots} more roots are needed" if found.more_roots is not None else ""
            lines.append(f"  no interval from {found.roots} roots: {found.why_not}{more}")
        shares = [
            f"{cell} {part:.2g} ({part / found.disturbed:.0%})" for cell, part in found.parts.items() if found.disturbed
        ]
        lines.append("  " + "; ".join([f"undisturbed {found.undisturbed_crashes} of {found.roots}", *shares[:5]]))
        if found.plain_equivalent_steps is not None:
            lines.append(
                f"  {found.steps} steps; plain trials need about {found.plain_equivalent_steps:.2g} for the same error"
            )
        if self.verified:
            lines.append(f"  of the {self.verified} weightiest crashes, {len(self.crashes)} came again from the start")
        lines.append("  an estimate says nothing about failures that no copy has met")
        return lines


def verify_rare(copies: VerificationRuns, *, differences: int = 0) -> RareReport | None:
    """Estimate the rate, and run the weightiest crashes of copies from the start, in fresh processes.

    Args:
        copies: runs them.
        differences: how many trials of the audit were not the same again.

    Returns:
        None where the hunt is not in rare mode.
    """
    again = copies.again
    if not again.settings.rare or copies.disturber is None:
        return None
    rule = PrecisionRule(again.settings, again.ledger, copies.disturber)
    rule.read()
    found = [
        _found(result, max(_crashed(result), key=lambda copy: copy.weight))
        for result in sorted(rule.results, key=_greatest_weight, reverse=True)[:_WEIGHTIEST]
    ]
    crashes, not_finished = copies.crashes(found, layout.BRANCHES)
    verified = 0 if copies.is_stopped else len(found)
    estimate = rule.estimate()
    why = f"{differences} trials of the audit were not the same again" if differences else ""
    if len(crashes) < verified - not_finished:
        why = f"{verified - not_finished - len(crashes)} of {verified} crashes did not come again from the start"
    if why:
        estimate = replace(
            estimate, estimate=None, estimated=None, estimated_disturbed=None, why_not=why, why_not_disturbed=why,
            more_roots=None,
        )  # fmt: skip
    return RareReport(estimate, verified, not_finished, crashes)


def _crashed(result: TrialResult) -> Iterator[ForcedCopy]:
    return (copy for copy in result.forced.copies if copy.crash) if result.forced is not None else iter(())


def _greatest_weight(result: TrialResult) -> float:
    return max(copy.weight for copy in _crashed(result))


def _found(result: TrialResult, copy: ForcedCopy) -> Found:
    spec = replace(result.spec, disturbances=copy.disturbances, forcing=None, origin="rare")
    return Found(spec, copy.crash, copy.step)
