"""What is told of the probes and branches of a hunt."""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crashhunt.hunts import HuntReport

__all__ = ["describe_branches", "describe_probes"]


def describe_probes(report: HuntReport) -> list[str]:
    """Return how little it would have taken for trials to crash, and what has been run from the start of it."""
    found = report.probes
    if found is None or not (found.margins or found.not_fully_asked):
        return []
    steps = f"{found.steps} steps beside {report.trial_steps} of trials"
    enough = f"; {found.left_out} questions were left out, as that was enough" if found.left_out else ""
    lines = ["Stress margin: no trial was fully asked."]
    if found.margins:
        safe = sum(margin == 1.0 for margin in found.margins)
        least, median = min(found.margins), statistics.median(found.margins)
        said = f"nothing plausible made {safe} of them crash"
        many = _many(len(found.margins), "trial")
        lines = [f"Stress margin of {many}: least {least:.2f}, median {median:.2f}; {said}."]
    lines += _not_fully_asked(found.not_fully_asked, found.why_unasked)
    lines.append(f"  copies were asked {_many(found.probes, 'time')}, with {steps}{enough}")
    if found.run_again:
        lines.append(
            f"  of the {found.run_again} mildest disturbances with which a trial crashed, {len(found.crashes)} made it "
            f"crash from the start as well{_not_finished(found.not_finished)}:"
        )
    for bundle, by in zip(found.crashes, found.by, strict=True):
        lines.append(f"  {bundle.path}: {bundle.result.summary}, {by.words}")
    return lines


def describe_branches(report: HuntReport) -> list[str]:
    """Return what came of branches, and which of those that crashed have done so from the start as well."""
    found = report.branches
    if found is None or not found.trials:
        return []
    enough = f"; {found.left_out} were left out, as that was enough" if found.left_out else ""
    moments = f"{_many(found.moments, 'moment')} of {_many(found.trials, 'trial')}"
    crashed = f"{found.crashed} crashed, of {_many(found.crashed_trials, 'trial')}"
    lines = [
        f"Branches: copies went on with other disturbances {_many(found.branches, 'time')}, from {moments}; {crashed}.",
        f"  they took {found.steps} steps beside {report.trial_steps} of trials{enough}",
        *_not_fully_asked(found.not_fully_asked, found.why_unanswered),
    ]
    if found.run_again:
        unfinished = _not_finished(found.not_finished)
        lines.append(
            f"  of the {found.run_again} likeliest, {len(found.crashes)} crashed from the start as well{unfinished}:"
        )
    for bundle in found.crashes:
        likely = bundle.result.log_likelihood
        said = f", log-likelihood {likely:.2f}" if likely is not None else ""
        lines.append(f"  {bundle.path}: {bundle.result.summary}{said}")
    return lines


def _not_fully_asked(count: int, why: str) -> list[str]:
    """Return the line on trials of which a question has no answer; none where there are none."""
    if not count:
        return []
    return [f"  {_many(count, 'trial')} {'was' if count == 1 else 'were'} not fully asked: {why}"]


def _not_finished(count: int) -> str:
    return f", and {count} could not be run to the end" if count else ""


def _many(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
