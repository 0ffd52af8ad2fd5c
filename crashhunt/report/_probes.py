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
    if found is None or not found.margins:
        return []
    steps = f"{found.steps} steps beside {report.trial_steps} of trials"
    safe = sum(margin == 1.0 for margin in found.margins)
    least, median = min(found.margins), statistics.median(found.margins)
    said = f"nothing plausible made {safe} of them crash"
    enough = f"; {found.left_out} questions were left out, as that was enough" if found.left_out else ""
    lines = [
        f"Stress margin of {_many(len(found.margins), 'trial')}: least {least:.2f}, median {median:.2f}; {said}.",
        f"  copies were asked {_many(found.probes, 'time')}, with {steps}{enough}",
    ]
    if found.run_again:
        lines.append(
            f"  of the {found.run_again} mildest disturbances with which a trial crashed, {len(found.crashes)} made it "
            "crash from the start as well:"
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
    ]
    if found.run_again:
        lines.append(f"  of the {found.run_again} likeliest, {len(found.crashes)} crashed from the start as well:")
    for bundle in found.crashes:
        likely = bundle.result.log_likelihood
        said = f", log-likelihood {likely:.2f}" if likely is not None else ""
        lines.append(f"  {bundle.path}: {bundle.result.summary}{said}")
    return lines


def _many(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
