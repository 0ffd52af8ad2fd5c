"""What probes have found in a hunt, and the mildest of it run from the start: only that is a crash."""

from __future__ import annotations

import statistics
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base import layout
from crashhunt.hunts._from_the_start import Found
from crashhunt.trial import Stress, in_turn

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle, CrashSummary
    from crashhunt.hunts._from_the_start import FromTheStart
    from crashhunt.trial import Disturbance, TrialResult

__all__ = ["ProbeData", "ProbeReport", "look_at_probes", "mildest"]

_MILDEST = 3  # trials; each takes two processes of its own


class ProbeData(TypedDict):
    """What ``run --json`` prints of them."""

    trials: int
    not_fully_asked: int
    least: float | None
    median: float | None
    probes: int
    steps: int
    left_out: int
    run_again: int
    not_finished: int
    confirmed: int
    crashes: list[CrashSummary]


@dataclass(frozen=True, slots=True)
class ProbeReport:
    """What came of the probes of a hunt.

    Args:
        margins: the stress margin of each trial of which all was asked that was to be asked.
        not_fully_asked: of how many further trials a question has no answer.
        why_unasked: the reason for the first of them; empty where there is none.
        probes: how many copies were asked.
        steps: how many steps they took.
        left_out: how many questions were left out, because copies had taken enough steps.
        run_again: how many of the mildest were run from the start.
        not_finished: how many of these could not be run to their end, as when they are killed from outside.
        crashes: those of them that crashed in the same way at the same step, and once more to the bit.
        by: what each of these was probed with, as it took place; others may have been drawn besides.
    """

    margins: tuple[float, ...]
    not_fully_asked: int
    why_unasked: str
    probes: int
    steps: int
    left_out: int
    run_again: int
    not_finished: int
    crashes: tuple[Bundle, ...]
    by: tuple[Disturbance, ...]

    def to_json(self) -> ProbeData:
        """Return the shape that ``run --json`` prints."""
        return {
            "trials": len(self.margins),
            "not_fully_asked": self.not_fully_asked,
            "least": min(self.margins, default=None),
            "median": statistics.median(self.margins) if self.margins else None,
            "probes": self.probes,
            "steps": self.steps,
            "left_out": self.left_out,
            "run_again": self.run_again,
            "not_finished": self.not_finished,
            "confirmed": len(self.crashes),
            "crashes": [bundle.summary() for bundle in self.crashes],
        }


def look_at_probes(copies: FromTheStart) -> ProbeReport | None:
    """Sum up what copies were asked, and run the mildest that made a trial crash from the start, in fresh processes.

    Args:
        copies: runs from the start what they have found.

    Returns:
        None where nobody has asked.
    """
    ledger = copies.again.ledger
    if not copies.again.settings.probe:
        return None
    margins: list[float] = []
    not_fully_asked, why_unasked = 0, ""
    sums = [0] * 3
    found: list[tuple[float, int]] = []
    for plain in ledger.plain_results():
        if not (data := plain.get("stress")):
            continue
        stress = Stress.from_json(data)
        if stress.margin is not None:
            margins.append(stress.margin)
        else:
            not_fully_asked, why_unasked = not_fully_asked + 1, why_unasked or stress.why_unasked
        sums = [sum(pair) for pair in zip(sums, (stress.probes, stress.steps, stress.left_out), strict=True)]
        if stress.disturbance is not None:
            found.append((stress.least, plain["spec"]["number"]))
    kept = copies.kept.get(layout.PROBES, {})
    results = [
        result
        for _, number in sorted(found, key=lambda pair: (pair[1] not in kept, pair[0]))[:_MILDEST]
        if (result := ledger.result(number)) is not None
    ]
    specs = [one for result in results if (one := mildest(result)) is not None]
    crashes, not_finished = copies.crashes(specs, layout.PROBES)
    asked = {result.spec.number: result.stress for result in results}
    by = tuple(_as_it_took_place(asked[bundle.result.spec.number], bundle.result) for bundle in crashes)
    probes, steps, left_out = sums
    return ProbeReport(
        tuple(margins),
        not_fully_asked,
        why_unasked,
        probes,
        steps,
        left_out,
        0 if copies.is_stopped else len(specs),
        not_finished,
        crashes,
        by,
    )


def _as_it_took_place(stress: Stress | None, result: TrialResult) -> Disturbance:
    """What a trial was probed with, as it took place when it was run from the start."""
    assert stress is not None
    planned = stress.disturbance
    assert planned is not None
    key = planned.step, planned.agent, planned.what
    return next((one for one in result.disturbances if (one.step, one.agent, one.what) == key), planned)


def mildest(result: TrialResult) -> Found | None:
    """Return a trial from the start, with the mildest that made a copy of it crash; None where nothing did."""
    stress = result.stress
    if stress is None or stress.disturbance is None:
        return None
    planned = in_turn([*result.spec.disturbances, stress.disturbance])
    return Found(replace(result.spec, disturbances=planned, origin="probe"), stress.outcome, stress.step)
