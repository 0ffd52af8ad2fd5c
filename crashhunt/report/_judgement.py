"""Whether a collision could have been avoided, in words: only what was run is said."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.crashes import Attempt, Judgement

__all__ = ["about_judgement"]

_BY = {
    "brake": "by braking",
    "left": "by changing to the lane on the left and braking",
    "right": "by changing to the lane on the right and braking",
}


def about_judgement(judgement: Judgement, ago: Callable[[int], str], agent: str, other: str) -> list[str]:
    """Return what was found out, a sentence each.

    Args:
        judgement: of the crash.
        ago: says when a step was, such as ``0.4 s before, after step 68``.
        agent: the controlled vehicle.
        other: whom it collided with.
    """
    best, runs = judgement.best, f"{judgement.runs} {'run' if judgement.runs == 1 else 'runs'}"
    sentences = []
    if best is not None:
        sentences = [_until(best, ago)]
        rest = (attempt for attempt in judgement.attempts if attempt is not best and attempt.last_step is not None)
        sentences += [_until(attempt, ago) for attempt in rest]
    elif judgement.avoidable is False:
        tried = " nor ".join(_BY.get(attempt.manoeuvre, attempt.manoeuvre) for attempt in judgement.attempts)
        sentences = [f"None of {runs} avoided it, from the first step on: neither {tried}."]
        if len(judgement.attempts) == 1:
            sentences = [f"None of {runs} avoided it {tried}, from the first step on."]
    elif judgement.runs:
        sentences = [f"None of {runs} avoided it, and they do not say that nothing could have."]
    visible = judgement.visible_step
    if judgement.verdict == "invalid":
        sentences.append(f"{agent} was put into it: that is an invalid trial, and says nothing about it.")
    elif visible is not None and judgement.verdict == "too late when visible":
        sentences.append(
            f"When {agent} was first shown {other}, {ago(visible)}, it could not be avoided any more: it was run from "
            "each step from then on."
        )
    elif visible is not None and judgement.runs:
        sentences.append(f"{agent} was shown {other} {'all the time' if visible == 0 else f'from {ago(visible)}, on'}.")
    if judgement.why_not:
        sentences.append(f"Whether it could have been avoided is not fully known: {judgement.why_not}.")
    return sentences


def _until(attempt: Attempt, ago: Callable[[int], str]) -> str:
    assert attempt.last_step is not None
    braking = f" (at up to {attempt.deceleration:.1f} m/s²)" if attempt.deceleration is not None else ""
    words = (
        f"It could be avoided until {ago(attempt.last_step)}, {_BY.get(attempt.manoeuvre, attempt.manoeuvre)}{braking}"
    )
    if attempt.all_later_run and attempt.last_step < attempt.end - 1:
        return f"{words}; that was run, and after each later step it was too late."
    if attempt.too_late_step is not None:
        return f"{words}; that was run, and one step later it was too late."
    return f"{words}; that was run."
