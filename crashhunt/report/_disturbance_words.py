"""Disturbances in words: those before a crash, the likeliest crash, and the results of probes and branches."""

from __future__ import annotations

import math
import statistics
from typing import TYPE_CHECKING

from crashhunt.base.text import command_line, count_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.crashes import Bundle
    from crashhunt.hunts import HuntReport
    from crashhunt.recording import Recording
    from crashhunt.trial import Disturbance, TrialResult


def about_disturbances(recording: Recording, result: TrialResult, first_step: int) -> list[str]:
    """Return the disturbances in a trial's last steps, one sentence each, and the number of earlier disturbances."""
    step_length_s = recording.prologue.step_length_s
    recent = [one for one in result.disturbances if one.step + one.how_long / step_length_s >= first_step]
    earlier = len(result.disturbances) - len(recent)
    sentences = [
        f"{recording.ago(min(one.step - 1, recording.steps))}, from step {one.step} on: {one.words}{_place_words(one)}."
        for one in recent
    ]
    if earlier:
        sentences.insert(0, f"{earlier} {'disturbance was' if earlier == 1 else 'disturbances were'} over earlier.")
    return sentences


def list_disturbances(result: TrialResult) -> list[str]:
    """Return one line for each disturbance of a trial, and one line with the log-likelihood of all disturbances."""
    if not may_be_disturbed(result):
        return []
    lines = [f"disturbed from step {one.step} on: {one.words}{_place_words(one)}" for one in result.disturbances]
    lines = lines or ["in undisturbed traffic: no planned disturbance had begun"]
    if result.log_likelihood is not None:
        lines.append(f"log-likelihood of exactly these disturbances: {result.log_likelihood:.2f}")
    return lines


def describe_disturbances(report: HuntReport) -> list[str]:
    """Return as text the number of a hunt's crashes with disturbances, and the likeliest of these crashes."""
    found = report.tally
    if not (report.settings.disturb and found.found):
        return []
    undisturbed = found.found - found.disturbed
    lines = [f"Crashes: {undisturbed} in undisturbed traffic, {found.disturbed} with disturbances."]
    if found.likeliest:
        lines.append(
            f"Likeliest crash with disturbances: {found.likeliest} (log-likelihood {found.log_likelihood:.2f})"
        )
    return lines


def traffic_of(bundle: Bundle, likeliest: str) -> str:
    """Return a text on whether the traffic of a crash was disturbed; empty if its hunt has no disturbances.

    ``likeliest`` is the id of the likeliest of the hunt's disturbed crashes.
    """
    if not may_be_disturbed(bundle.result):
        return ""
    if not bundle.result.disturbed:
        return "in undisturbed traffic"
    likely = f", log-likelihood {_likelihood_words(bundle):.1f}" * math.isfinite(_likelihood_words(bundle))
    return f"with disturbances{likely}{': the likeliest' * (bundle.id == likeliest)}"


def by_likelihood(crashes: Sequence[Bundle]) -> list[Bundle]:
    """Return the undisturbed crashes in the given order, then the disturbed crashes, the most likely first."""
    return sorted(crashes, key=lambda bundle: (1, -_likelihood_words(bundle)) if bundle.result.disturbed else (0, 0.0))


def may_be_disturbed(result: TrialResult) -> bool:
    """Return whether the hunt of a crash has disturbances, even if none occurred in the crash's trial."""
    return result.log_likelihood is not None or bool(result.spec.disturbances)


def _likelihood_words(bundle: Bundle) -> float:
    found = bundle.result.log_likelihood
    return -math.inf if found is None else found


def _place_words(one: Disturbance) -> str:
    return f" ({one.place})" if one.vehicle != one.agent else ""


def describe_probes(report: HuntReport) -> list[str]:
    """Return as text the robustness margins of trials, and the crashes of forks that reproduce from the start."""
    found = report.probes
    if found is None or not (found.margins or found.sums["not_fully_asked"]):
        return []
    steps = f"{found.sums['steps']} steps, in addition to {report.trial_steps} steps of trials"
    enough = _skipped(found.sums["left_out"])
    lines = ["Robustness margin: no trial was fully probed."]
    if found.margins:
        safe = sum(margin == 1.0 for margin in found.margins)
        least, median = min(found.margins), statistics.median(found.margins)
        said = f"{safe} of them crashed under no plausible disturbance"
        many = count_of(len(found.margins), "trial")
        lines = [f"Robustness margin of {many}: least {least:.2f}, median {median:.2f}; {said}."]
    lines += _not_fully_asked(found.sums["not_fully_asked"], found.why_unasked)
    lines.append(f"  {count_of(found.sums['probes'], 'probe')} took {steps}{enough}")
    if found.run_again:
        lines.append(
            f"  crashes by the mildest disturbance that reproduce from the start: {len(found.crashes)} of "
            f"{found.run_again}{_not_finished(found.not_finished)}:"
        )
    for bundle, by in zip(found.crashes, found.by, strict=True):
        lines.append(f"  {command_line(bundle.path)}: {bundle.result.summary}, {by.words}")
    return lines


def describe_branches(report: HuntReport) -> list[str]:
    """Return as text the results of branches, and which of their crashes reproduce from the start."""
    found = report.branches
    if found is None or not found.sums["trials"]:
        return []
    sums = found.sums
    enough = _skipped(sums["left_out"])
    moments = f"{count_of(sums['moments'], 'moment')} of {count_of(sums['trials'], 'trial')}"
    crashed = f"{sums['crashed']} crashed, of {count_of(sums['crashed_trials'], 'trial')}"
    lines = [
        f"Branches: {sums['branches']} forks with other disturbances, from {moments}; {crashed}.",
        f"  they took {sums['steps']} steps, in addition to {report.trial_steps} steps of trials{enough}",
        *_not_fully_asked(sums["not_fully_asked"], found.why_unanswered),
    ]
    if found.run_again:
        unfinished = _not_finished(found.not_finished)
        lines.append(
            f"  likeliest crashes that reproduce from the start: {len(found.crashes)} of {found.run_again}{unfinished}:"
        )
    for bundle in found.crashes:
        likely = bundle.result.log_likelihood
        said = f", log-likelihood {likely:.2f}" if likely is not None else ""
        lines.append(f"  {command_line(bundle.path)}: {bundle.result.summary}{said}")
    return lines


def _skipped(count: int) -> str:
    return f"; {count} more were skipped, because the step budget of their trials was used up" if count else ""


def _not_fully_asked(count: int, why: str) -> list[str]:
    """Return a line on the trials in which a fork has no result; an empty list if ``count`` is 0."""
    if not count:
        return []
    return [f"  {count_of(count, 'trial')} {'was' if count == 1 else 'were'} not fully probed: {why}"]


def _not_finished(count: int) -> str:
    return f", and {count} did not finish" if count else ""
