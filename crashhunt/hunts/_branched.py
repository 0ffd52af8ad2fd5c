"""What the branches of trials have found in a hunt, and the likeliest of it run from the start."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base import layout
from crashhunt.hunts._from_the_start import Found
from crashhunt.trial import Branches

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle, CrashSummary
    from crashhunt.hunts._from_the_start import FromTheStart
    from crashhunt.trial import Branch, TrialResult

__all__ = ["BranchReport", "BranchReportData", "likeliest", "look_at_branches"]

_LIKELIEST = 10  # trials; each takes two processes of its own


class BranchReportData(TypedDict):
    """What ``run --json`` prints of them."""

    trials: int
    moments: int
    branches: int
    steps: int
    left_out: int
    crashed: int
    crashed_trials: int
    not_fully_asked: int
    run_again: int
    not_finished: int
    confirmed: int
    crashes: list[CrashSummary]


@dataclass(frozen=True, slots=True)
class BranchReport:
    """What came of the branches of a hunt.

    Args:
        trials: of how many trials there might have been some.
        moments: from how many copies went on.
        branches: how many there were.
        steps: how many steps they took.
        left_out: how many were left out, because branches had taken enough steps.
        crashed: how many crashed.
        crashed_trials: in how many trials.
        not_fully_asked: of how many of the trials a branch has no answer.
        why_unanswered: the reason for the first of them; empty where there is none.
        run_again: how many of these were run from the start: of each trial the likeliest.
        not_finished: how many of these could not be run to their end, as when they are killed from outside.
        crashes: those of them that crashed in the same way at the same step, and once more to the bit.
    """

    trials: int
    moments: int
    branches: int
    steps: int
    left_out: int
    crashed: int
    crashed_trials: int
    not_fully_asked: int
    why_unanswered: str
    run_again: int
    not_finished: int
    crashes: tuple[Bundle, ...]

    def to_json(self) -> BranchReportData:
        """Return the shape that ``run --json`` prints."""
        return {
            "trials": self.trials,
            "moments": self.moments,
            "branches": self.branches,
            "steps": self.steps,
            "left_out": self.left_out,
            "crashed": self.crashed,
            "crashed_trials": self.crashed_trials,
            "not_fully_asked": self.not_fully_asked,
            "run_again": self.run_again,
            "not_finished": self.not_finished,
            "confirmed": len(self.crashes),
            "crashes": [bundle.summary() for bundle in self.crashes],
        }


def look_at_branches(copies: FromTheStart) -> BranchReport | None:
    """Sum up what branches came to, and run the likeliest that crashed from the start, in fresh processes.

    Args:
        copies: runs from the start what they have found.

    Returns:
        None where there were to be none.
    """
    ledger = copies.again.ledger
    if not copies.again.settings.branch:
        return None
    sums, why_unanswered = [0] * 7, ""
    found: list[tuple[int, Branch]] = []  # of each trial the likeliest; there may be a million trials
    for plain in ledger.plain_results():
        if not (data := plain.get("branches")):
            continue
        one = Branches.from_json(data)
        counts = (1, one.moments, one.asked, one.steps, one.left_out, len(one.crashes), one.unanswered > 0)
        why_unanswered = why_unanswered or one.why_unanswered
        sums = [sum(pair) for pair in zip(sums, counts, strict=True)]
        if one.crashes:
            found.append((plain["spec"]["number"], max(one.crashes, key=_likely)))
    kept = copies.kept.get(layout.BRANCHES, {})
    specs = [
        _specification(result, branch)
        for number, branch in sorted(found, key=lambda pair: (pair[0] not in kept, -_likely(pair[1])))[:_LIKELIEST]
        if (result := ledger.result(number)) is not None
    ]
    crashes, not_finished = copies.crashes(specs, layout.BRANCHES)
    trials, moments, branches, steps, left_out, crashed, not_fully_asked = sums
    return BranchReport(
        trials,
        moments,
        branches,
        steps,
        left_out,
        crashed,
        len(found),
        not_fully_asked,
        why_unanswered,
        0 if copies.is_stopped else len(specs),
        not_finished,
        crashes,
    )


def likeliest(result: TrialResult) -> Found | None:
    """Return the likeliest branch of a trial that crashed, as it is from the start; None where none did."""
    if result.branches is None or not result.branches.crashes:
        return None
    return _specification(result, max(result.branches.crashes, key=_likely))


def _specification(result: TrialResult, branch: Branch) -> Found:
    spec = replace(result.spec, disturbances=branch.disturbances, origin="branch")
    return Found(spec, branch.outcome, branch.step)


def _likely(branch: Branch) -> float:
    return -math.inf if branch.log_likelihood is None else branch.log_likelihood
