"""Traffic events in words, as part of the story of a crash."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crashhunt.recording import Recording
    from crashhunt.world import Event

__all__ = ["about_events"]

_LAST = 5  # a jam has many


def about_events(recording: Recording, first_step: int, *, besides: Event | None) -> list[str]:
    """Return what else happened in the traffic in the last steps, a sentence each.

    Args:
        recording: of the episode.
        first_step: from which on.
        besides: what ended it, which has been told.
    """
    end = recording.steps * recording.prologue.step_length_s
    told = [
        (step.step, event)
        for step in recording.all_steps[first_step:]
        if step.scene is not None
        for event in step.scene.events
        if event != besides
    ]
    return [
        f"{end - step * recording.prologue.step_length_s:.1f} s before, at step {step}: {event.what}."
        for step, event in told[-_LAST:]
    ]
