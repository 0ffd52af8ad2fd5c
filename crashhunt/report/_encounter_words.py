"""How two actors met, in words and numbers: gap, place, criticality and the traffic events before a crash."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle, DangerCourse, Encounter, Moment
    from crashhunt.recording import Recording
    from crashhunt.world import DangerousMoment, Event


# The positions of two actors relative to each other, in words.

MAX_STANDING_SPEED_MPS = 0.05  # m/s; a lower speed is shown as 0
_PLACE_WORDS = {
    "ahead": "ahead of {agent}",
    "behind": "behind {agent}",
    "left": "to the left of {agent}",
    "right": "to the right of {agent}",
}
_DIRECTION_WORDS = {
    "same": "going the same way",
    "other": "going the other way",
    "left": "crossing from right to left",
    "right": "crossing from left to right",
}


def about_gap(encounter: Encounter, moment: Moment) -> str:
    """Return the distance between two actors and their speeds as text."""
    return (
        f"they were {moment.gap_m:.1f} m apart, {_closing(moment.closing_speed)}; {encounter.agent} at "
        f"{moment.speed:.1f} m/s, {encounter.other} at {moment.other_speed:.1f} m/s"
    )


def about_place(encounter: Encounter, moment: Moment) -> str:
    """Return as text the position of the other actor relative to the agent, and its direction."""
    position = encounter.position(moment.step)
    assert position is not None
    going = _DIRECTION_WORDS[position.faces] if abs(moment.other_speed) >= MAX_STANDING_SPEED_MPS else "standing"
    return f"{encounter.other} was {_PLACE_WORDS[position.place].format(agent=encounter.agent)}, {going}"


def _closing(speed: float) -> str:
    if abs(speed) < MAX_STANDING_SPEED_MPS:
        return "keeping their distance"
    return f"{'closing' if speed > 0 else 'parting'} at {abs(speed):.1f} m/s"


COLUMNS = ("criticality", "rear")
"""The headings of the two numbers of a step."""


def window_of(recording: Recording, last_s: float, nearest: DangerousMoment | None) -> tuple[int, int]:
    """Return the first and the last step to describe: the last seconds of a crash, or the steps around a near miss."""
    dt, end = recording.prologue.step_length_s, recording.steps
    if nearest is None:
        return end - round(last_s / dt), end
    half = round(last_s / 2 / dt)
    return max(0, nearest.step - half), min(end, nearest.step + half)


def about_nearest(encounter: Encounter, nearest: DangerousMoment) -> list[str]:
    """Return sentences on the most critical moment of a trial without a crash: its time, and the other actor."""
    moment = next((one for one in encounter.moments if one.step == nearest.step), None)
    if moment is None:
        return []
    when = f"at {moment.time_s:.1f} s, after step {nearest.step}"
    return [
        f"It was nearest to a crash {when}: a criticality of {nearest.danger:.2f}, to {nearest.other}.",
        f"At that time {about_gap(encounter, moment)}; {about_place(encounter, moment)}.",
    ]


def about_danger(course: DangerCourse, *, partner: str = "") -> str:
    """Return as text the greatest criticality of the agent and of vehicles behind it, and the sums over the trial.

    Args:
        course: criticality of the trial over time.
        partner: the actor that the agent touched; empty if there is none. For a touch, "no actor was near" is never
            reported, because an actor that jumps into another lane has no path to the contact. Nor has an actor that
            comes onto the agent's way at the contact: then the criticality towards others is that before the contact.

    Returns:
        A sentence; empty if there is nothing to report.
    """
    parts = []
    for heading, moment, total, relation, absent in (
        (f"Criticality of {course.agent}", course.greatest, course.own_total, "towards", _no_danger(course)),
        ("Rear criticality", course.greatest_behind, course.behind_total, "by", "no vehicle closed in"),
    ):
        if moment.danger > 0:
            if partner and moment is course.greatest and moment.other != partner and moment.step < course.steps[-1]:
                heading += " before the contact"  # highway-env also shows other vehicles in the step of the contact
            most = f"at most {moment.danger:.2f}, after step {moment.step}, {relation} {moment.other}"
            parts.append(f"{heading}: {most} ({total:.2f} over the trial).")
        elif not partner:
            parts.append(f"{heading}: {absent}.")
    return " ".join(parts)


def _no_danger(course: DangerCourse) -> str:
    if course.nearest is None:
        return "no actor came within 50 m"
    actor, gap_m, step = course.nearest
    return f"no actor was on its way; {actor} came nearest, {gap_m:.1f} m away after step {step}"


def danger_cells(course: DangerCourse, step: int) -> list[str]:
    """Return the two numbers (own and rear criticality) of a step for a table."""
    found = course.of_step(step)
    return ["-"] * len(COLUMNS) if found is None else [f"{one:.2f}" if math.isfinite(one) else "-" for one in found]


def danger_to_json(course: DangerCourse | None, bundle: Bundle, first: int, last: int) -> dict[str, object] | None:
    """Return the object under ``danger`` of ``show --json``; None if the recording has no criticality."""
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
    """Return the object under ``nearest`` of ``show --json``; None for a crash."""
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


# Traffic events in words, as part of the story of a crash.

_MAX_LISTED_EVENTS = 5  # a jam has many


def about_events(recording: Recording, first_step: int, *, besides: Event | None) -> list[str]:
    """Return a sentence for each traffic event of the last steps, except for the event that ended the trial.

    Another text describes this event.
    """
    found = [
        (step.step, event)
        for step in recording.all_steps[first_step:]
        if step.scene is not None
        for event in step.scene.events
        if event != besides
    ]
    return [f"{recording.ago(step)}, at step {step}: {event.what}." for step, event in found[-_MAX_LISTED_EVENTS:]]
