"""A result in one sentence, "ego drove into main.31 at step 47": what commands, screen and page say of a trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.trial._outcome import Outcome

if TYPE_CHECKING:
    from crashhunt.trial._result import TrialResult

__all__ = ["summarize"]


def summarize(result: TrialResult) -> str:
    """Return the outcome of a trial in one line, for people."""
    if result.collision is not None:
        hit = result.collision
        if hit.role == "alone":
            what = "left the road" if result.outcome is Outcome.OFF_ROAD else f"crashed ({hit.kind})"
            return f"{hit.agent} {what} at step {result.steps}"
        verb = "drove into" if hit.role == "collider" else "was hit by"
        return f"{hit.agent} {verb} {hit.other} at step {result.steps}"
    if result.event is not None:
        return f"{result.event.what}, at step {result.steps}"
    if result.failure is not None:
        failure = result.failure
        if failure.traceback and failure.exit_code is None and failure.kind != "timeout":
            whose = f"{failure.agent}: " if failure.agent else ""
            return f"{whose}{failure.kind}: {failure.message}"
        return failure.message
    return f"{result.outcome} after {result.steps} steps"
