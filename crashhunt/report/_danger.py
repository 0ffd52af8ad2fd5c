"""The danger of a crash or near miss in words and figures: the agent's own, and that by those behind it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from crashhunt.report._positions import about_gap, about_place

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle, DangerCourse, Encounter
    from crashhunt.recording import Recording
    from crashhunt.world import DangerousMoment

__all__ = ["COLUMNS", "about_danger", "about_nearest", "danger_cells", "danger_to_json", "nearest_to_json", "window_of"]

COLUMNS = ("danger", "from behind")
"""The headings of the two numbers of a step."""


def window_of(recording: Recording, last_s: float, nearest: DangerousMoment | None) -> tuple[int, int]:
    """Return the first and the last step to be told: the last seconds of a crash, or those around a near miss."""
    dt, end = recording.prologue.step_length_s, recording.steps
    if nearest is None:
        return end - round(last_s / dt), end
    half = round(last_s / 2 / dt)
    return max(0, nearest.step - half), min(end, nearest.step + half)


def about_nearest(encounter: Encounter, nearest: DangerousMoment) -> list[str]:
    """Return when a trial without a crash was nearest to one, to whom, and how they stood to each other."""
    moment = next((one for one in encounter.moments if one.step == nearest.step), None)
    if moment is None:
        return []
    when = f"at {moment.time_s:.1f} s, after step {nearest.step}"
    return [
        f"It was nearest to a crash {when}: a danger of {nearest.danger:.2f}, to {nearest.other}.",
        f"At that time {about_gap(encounter, moment)}; {about_place(encounter, moment)}.",
    ]


def about_danger(course: DangerCourse) -> str:
    """Return the greatest danger of both kinds, and what they add up to over the trial."""
    parts = []
    for whose, moment, total, who, nobody in (
        (f"{course.agent}'s own", course.greatest, course.own_total, "towards", "nobody was seen near"),
        (
            "that by those behind it",
            course.greatest_behind,
            course.behind_total,
            "by",
            "nobody was seen to close in from behind",
        ),
    ):
        if moment.danger <= 0:
            parts.append(nobody)
            continue
        most = f"at most {moment.danger:.2f}, after step {moment.step}, {who} {moment.other}"
        parts.append(f"{whose} was {most} ({total:.2f} over the trial)")
    return f"Danger: {parts[0]}; {parts[1]}."


def danger_cells(course: DangerCourse, step: int) -> list[str]:
    """Return the two numbers of a step, for a table."""
    found = course.of_step(step)
    return ["-"] * len(COLUMNS) if found is None else [f"{one:.2f}" if math.isfinite(one) else "-" for one in found]


def danger_to_json(course: DangerCourse | None, bundle: Bundle, first: int, last: int) -> dict[str, object] | None:
    """Return the shape under ``danger`` of ``show --json``; None where nobody knows.

    Args:
        course: of the recording.
        bundle: of the trial.
        first: step of those that are told one by one.
        last: likewise.
    """
    if course is None:
        return None
    return {
        "ranked_by": bundle.result.danger,
        "own": _summary(course.greatest, course.own_total),
        "from_behind": _summary(course.greatest_behind, course.behind_total),
        "steps": [
            {"step": step, "own": _or_none(own), "from_behind": _or_none(behind)}
            for step, own, behind in zip(course.steps, course.own, course.behind, strict=True)
            if first <= step <= last
        ],
    }


def nearest_to_json(nearest: DangerousMoment | None) -> dict[str, object] | None:
    """Return the shape under ``nearest`` of ``show --json``; None of a crash."""
    if nearest is None:
        return None
    return {"step": nearest.step, "danger": nearest.danger, "agent": nearest.agent, "other": nearest.other}


def _or_none(danger: float) -> float | None:
    return float(danger) if math.isfinite(danger) else None


def _summary(moment: DangerousMoment, total: float) -> dict[str, object]:
    known = moment.danger > 0
    return {
        "over_the_trial": total,
        "greatest": moment.danger,
        "step": moment.step if known else None,
        "other": moment.other if known else None,
    }
