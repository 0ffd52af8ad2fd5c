"""What probes have found in a hunt, and the mildest of it run from the start: only that is a crash."""

from __future__ import annotations

import statistics
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base import layout
from crashhunt.hunts._from_the_start import Found
from crashhunt.trial import TrialResult, in_turn

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle, CrashSummary
    from crashhunt.hunts._from_the_start import FromTheStart
    from crashhunt.hunts._ledger import Ledger
    from crashhunt.plans import HuntSettings
    from crashhunt.trial import Stress, TrialSpec

__all__ = ["ProbeData", "ProbeReport", "look_at_probes"]

_MILDEST = 3  # trials; each takes two processes of its own


class ProbeData(TypedDict):
    """What ``run --json`` prints of them."""

    trials: int
    least: float | None
    median: float | None
    probes: int
    steps: int
    left_out: int
    run_again: int
    confirmed: int
    crashes: list[CrashSummary]


@dataclass(frozen=True, slots=True)
class ProbeReport:
    """What came of the probes of a hunt.

    Args:
        margins: the stress margin of each trial that was asked.
        probes: how many copies were asked.
        steps: how many steps they took.
        left_out: how many questions were left out, because copies had taken enough steps.
        run_again: how many of the mildest were run from the start.
        crashes: those of them that crashed in the same way at the same step, and once more to the bit.
    """

    margins: tuple[float, ...]
    probes: int
    steps: int
    left_out: int
    run_again: int
    crashes: tuple[Bundle, ...]

    def to_json(self) -> ProbeData:
        """Return the shape that ``run --json`` prints."""
        return {
            "trials": len(self.margins),
            "least": min(self.margins, default=None),
            "median": statistics.median(self.margins) if self.margins else None,
            "probes": self.probes,
            "steps": self.steps,
            "left_out": self.left_out,
            "run_again": self.run_again,
            "confirmed": len(self.crashes),
            "crashes": [bundle.summary() for bundle in self.crashes],
        }


def look_at_probes(ledger: Ledger, settings: HuntSettings, again: FromTheStart) -> ProbeReport | None:
    """Sum up what copies were asked, and run the mildest that made a trial crash from the start, in fresh processes.

    Args:
        ledger: of the hunt.
        settings: of the hunt.
        again: runs trials from the start.

    Returns:
        None where nobody has asked.
    """
    if not settings.probe:
        return None
    asked = [(result, result.stress) for result in map(TrialResult.from_json, ledger.plain_results()) if result.stress]
    found = sorted((pair for pair in asked if pair[1].disturbance is not None), key=lambda pair: pair[1].margin)
    mildest = [
        Found(_specification(result, stress), stress.outcome, stress.step) for result, stress in found[:_MILDEST]
    ]
    return ProbeReport(
        tuple(stress.margin for _, stress in asked),
        sum(stress.probes for _, stress in asked),
        sum(stress.steps for _, stress in asked),
        sum(stress.left_out for _, stress in asked),
        len(mildest),
        again.crashes(mildest, layout.PROBES),
    )


def _specification(result: TrialResult, stress: Stress) -> TrialSpec:
    """The trial from the start, with what made its copy crash."""
    assert stress.disturbance is not None
    return replace(result.spec, disturbances=in_turn([*result.spec.disturbances, stress.disturbance]), origin="probe")
