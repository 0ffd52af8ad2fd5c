"""The sentence about a result that all reports use, such as "ego drove into main.31 at step 47"."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.text import count_of
from crashhunt.trial._outcome import Outcome

if TYPE_CHECKING:
    from crashhunt.trial._evidence import Collision, Failure
    from crashhunt.world import Event


def summarize(
    outcome: Outcome, steps: int, *, collision: Collision | None, event: Event | None, failure: Failure | None
) -> str:
    """Return a sentence about the outcome of a trial, in one line."""
    if collision is not None:
        if collision.role == "alone":
            what = "left the road" if outcome is Outcome.OFF_ROAD else f"crashed ({collision.kind})"
            return f"{collision.agent} {what} at step {steps}"
        verb = "drove into" if collision.role == "collider" else "was hit by"
        return f"{collision.agent} {verb} {collision.other} at step {steps}"
    if event is not None:
        return f"{event.what}, at step {steps}"
    if failure is not None:
        if failure.traceback and failure.exit_code is None and failure.kind != "timeout":
            whose = f"{failure.agent}: " if failure.agent else ""
            if failure.party not in ("", "agent", "simulator"):
                whose = f"{failure.party} ({failure.place}): "
            return f"{whose}{failure.kind}: {failure.message}"
        return failure.message
    return f"{outcome} after {count_of(steps, 'step')}"
