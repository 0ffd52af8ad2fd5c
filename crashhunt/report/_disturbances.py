"""Disturbances in words: what happened before a crash, and which crash would be the likeliest."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.crashes import Bundle
    from crashhunt.recording import Recording
    from crashhunt.trial import Disturbance, TrialResult

__all__ = [
    "about_disturbances",
    "by_likelihood",
    "describe_disturbances",
    "likeliest",
    "may_be_disturbed",
    "told_disturbances",
    "traffic_of",
]


def about_disturbances(recording: Recording, result: TrialResult, first_step: int) -> list[str]:
    """Return what disturbed a trial in its last steps, a sentence each, and how often anything did before.

    Args:
        recording: of the episode.
        result: of it.
        first_step: from which on.
    """
    step_length_s = recording.prologue.step_length_s
    recent = [one for one in result.disturbances if one.step + one.how_long / step_length_s >= first_step]
    earlier = len(result.disturbances) - len(recent)
    told = [
        f"{max(0, recording.steps - one.step + 1) * step_length_s:.1f} s before, from step {one.step} on: {one.words}"
        f"{_where(one)}."
        for one in recent
    ]
    if earlier:
        told.insert(0, f"{earlier} {'disturbance was' if earlier == 1 else 'disturbances were'} over before that.")
    return told


def told_disturbances(result: TrialResult) -> list[str]:
    """Return a line for each disturbance of a trial, and one for how likely all of it was."""
    if not may_be_disturbed(result):
        return []
    lines = [f"disturbed from step {one.step} on: {one.words}{_where(one)}" for one in result.disturbances]
    lines = lines or ["in undisturbed traffic: nothing that was planned had begun"]
    if result.log_likelihood is not None:
        lines.append(f"log-likelihood of those that were drawn, and no others: {result.log_likelihood:.2f}")
    return lines


def describe_disturbances(crashes: Sequence[Bundle]) -> list[str]:
    """Return how many crashes of a hunt with disturbances had any, and which of those is the likeliest."""
    if not any(may_be_disturbed(bundle.result) for bundle in crashes):
        return []
    disturbed = [bundle for bundle in crashes if bundle.result.disturbed]
    lines = [f"Crashes: {len(crashes) - len(disturbed)} in undisturbed traffic, {len(disturbed)} with disturbances."]
    first = likeliest(crashes)
    if first is not None:
        lines.append(f"The likeliest of those with disturbances: {first.id} (log-likelihood {_likely(first):.2f})")
    return lines


def likeliest(crashes: Sequence[Bundle]) -> Bundle | None:
    """Return the likeliest of the crashes with disturbances; None where none of them was drawn."""
    drawn = [bundle for bundle in crashes if bundle.result.disturbed and math.isfinite(_likely(bundle))]
    return by_likelihood(drawn)[0] if drawn else None


def traffic_of(bundle: Bundle, crashes: Sequence[Bundle]) -> str:
    """Return which traffic a crash took place in, in words; empty where its hunt has no disturbances.

    Args:
        bundle: the crash.
        crashes: all of the hunt.
    """
    if not may_be_disturbed(bundle.result):
        return ""
    if not bundle.result.disturbed:
        return "in undisturbed traffic"
    likely = f", log-likelihood {_likely(bundle):.1f}" * math.isfinite(_likely(bundle))
    return f"with disturbances{likely}{': the likeliest' * (bundle is likeliest(crashes))}"


def by_likelihood(crashes: Sequence[Bundle]) -> list[Bundle]:
    """Return crashes in order: those in undisturbed traffic as they are, then the others, the likeliest first."""
    return sorted(crashes, key=lambda bundle: (1, -_likely(bundle)) if bundle.result.disturbed else (0, 0.0))


def may_be_disturbed(result: TrialResult) -> bool:
    """Whether its hunt has disturbances, whatever of them took place."""
    return result.log_likelihood is not None or bool(result.spec.disturbances)


def _likely(bundle: Bundle) -> float:
    found = bundle.result.log_likelihood
    return -math.inf if found is None else found


def _where(one: Disturbance) -> str:
    return f" ({one.place})" if one.vehicle != one.agent else ""
