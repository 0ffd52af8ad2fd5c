"""The criticality of a crash or near miss as text and numbers: the agent's own and the rear criticality."""

from __future__ import annotations

import math
import statistics
from typing import TYPE_CHECKING, Any

from crashhunt.base.text import command_line, count_of, format_number, format_percent, one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from crashhunt.crashes import (
        Attempt,
        Bundle,
        DangerCourse,
        DriverRun,
        Encounter,
        Factor,
        Judgement,
        Moment,
        Note,
        Omission,
        Preventability,
        Reference,
        Why,
    )
    from crashhunt.hunts import HuntReport
    from crashhunt.recording import Recording
    from crashhunt.trial import Disturbance, TrialResult, Value
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


NOT_DECIDED = "not decided"
"""How texts name the verdict on the vehicle at fault if rules contradict each other, or if no rule applies."""


def fault_words(fault: str) -> str:
    """Return a verdict on the vehicle at fault as text."""
    return {"nobody can tell": NOT_DECIDED, "ego": "the agent"}.get(fault, fault)  # an agent may have another name


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
            if partner and moment is course.greatest and moment.other != partner:
                heading += " before the contact"
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


# Disturbances in words: what happened before a crash, and which crash would be the likeliest.


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


# Whether a collision could have been avoided, in words. Every sentence reports runs, not calculations.

_ESCAPE_WORDS = {
    "brake": "by braking",
    "left": "by changing to the lane on the left and braking",
    "right": "by changing to the lane on the right and braking",
}


def about_judgement(judgement: Judgement, ago: Callable[[int], str], agent: str, other: str) -> list[str]:
    """Return the results of the counterfactual analysis, one sentence each.

    ``ago`` returns the time of a step as text, such as ``0.4 s before, after step 68``.
    """
    best, runs = judgement.best, count_of(judgement.runs, "run")
    sentences = []
    if best is not None:
        sentences = [_until(best, ago)]
        rest = (attempt for attempt in judgement.attempts if attempt is not best and attempt.last_step is not None)
        sentences += [_until(attempt, ago) for attempt in rest]
    elif judgement.avoidable is False:
        tried = " nor ".join(_ESCAPE_WORDS.get(attempt.manoeuvre, attempt.manoeuvre) for attempt in judgement.attempts)
        sentences = [f"None of {runs} avoided it, from the first step on: neither {tried}."]
        if len(judgement.attempts) == 1:
            sentences = [f"None of {runs} avoided it {tried}, from the first step on."]
        if others := sum(end == "other" for attempt in judgement.attempts for end in attempt.endings.values()):
            sentences.append(f"In {others} of them, another crash happened instead.")
    elif judgement.runs:
        sentences = [f"None of {runs} avoided it, but they do not prove that it was unavoidable."]
    visible = judgement.visible_step
    if judgement.verdict == "invalid":
        sentences.append(f"{agent} started in an unavoidable situation: the trial is invalid.")
    elif visible is not None and judgement.verdict == "too late when visible":
        sentences.append(
            f"When {agent} first observed {other}, {ago(visible)}, the crash was already unavoidable: runs from every "
            "later step crashed."
        )
    elif visible is not None and judgement.runs:
        when = "at the start" if visible == 0 else ago(visible)  # other actors may hide it later
        sentences.append(f"{agent} first observed {other} {when}.")
    if judgement.why_not:
        sentences.append(f"Whether it could have been avoided is not fully known: {judgement.why_not}.")
    return sentences


DRIVER_NAMES = {"cc_human": "careful human", "fsm": "FSM", "rss": "RSS", "reg157": "R157 5.2.5.2"}
_ANSWER_WORDS = {True: "yes", False: "no", None: "no answer"}


def about_drivers(drivers: Preventability, ago: Callable[[int], str], agent: str, other: str) -> list[str]:
    """Return whether models of a competent driver would have prevented the crash, and when the risk was perceived."""
    if not drivers.runs:
        return [f"Whether a competent driver would have prevented it is not known: {drivers.why_not}."]
    answers = "; ".join(_driver_answer(run) for run in drivers.runs)
    if drivers.by_any is None:
        sentences = [f"Whether a competent driver would have prevented it is not known ({answers})."]
    else:
        sentences = [f"Preventable by a competent driver ({answers})."]
    perceived = drivers.perceived
    if perceived is not None and perceived.perceived_step is not None:
        sentences.append(
            f"The model {DRIVER_NAMES[perceived.model]} perceives the risk first, {ago(perceived.perceived_step)}: "
            f"{other} is {perceived.gap_m or 0.0:.1f} m ahead and drives {perceived.other_speed_mps or 0.0:.1f} m/s, "
            f"and {agent} drives {perceived.speed_mps or 0.0:.1f} m/s."
        )
    if drivers.why_not:
        sentences.append(f"Not all models were asked: {drivers.why_not}.")
    return sentences


def list_preventing(answers: Mapping[str, bool | None] | None) -> str:
    """Return the answers of the models that have one, as text; empty if there are none."""
    known = ((name, answer) for name, answer in (answers or {}).items() if answer is not None)
    return ", ".join(f"{DRIVER_NAMES[name]}: {_ANSWER_WORDS[answer]}" for name, answer in known)


def _driver_answer(run: DriverRun) -> str:
    answer = f"{DRIVER_NAMES.get(run.model, run.model)}: {_ANSWER_WORDS[run.prevented]}"
    if run.prevented and run.margin_m is not None:
        return f"{answer}, by {run.margin_m:.1f} m"
    return f"{answer} because {run.why_not}" if run.why_not else answer


_FACULTY_WORDS = {
    "longitudinal": "controls its speed",
    "lateral": "decides about its lane changes",
    "both": "controls its speed and decides about its lane changes",
}


_MIN_KEPT_S = 1.0  # over a shorter time, every driver keeps its speed


def about_reference(
    reference: Reference, ago: Callable[[int], str], agent: str, *, had_to_yield: bool = True
) -> list[str]:
    """Return sentences on what the agent failed to do; empty if no run with a reference driver shows an omission.

    Unless a rule blames the agent (``had_to_yield``), no sentence says that it did not yield.
    """
    if reference.omission is None:
        return []
    omission, runs = reference.omission, [run for run in reference.deciding if run.ending != "unclear"]
    sentences = [f"Cause: {_omitted(omission, agent, ago, had_to_yield=had_to_yield)}."]
    count = "the run ends" if len(runs) == 1 else f"all {len(runs)} runs end"
    changed = sorted({each for run in runs for each in run.changed} if omission.faculty == "longitudinal" else ())
    more = f" In addition, {' and '.join(changed)} in these runs." if changed else ""
    sentences.append(
        f"With a reference driver that {_FACULTY_WORDS[omission.faculty]} from {ago(omission.step)}, on, {count} "
        f"without a crash.{more}"
    )
    return sentences


def _omitted(omission: Omission, agent: str, ago: Callable[[int], str], *, had_to_yield: bool) -> str:
    """Return what an agent failed to do, as a sentence without its period."""
    actor, kind = omission.actor, omission.kind
    seen = ""
    if omission.visible_step is not None and omission.visible_step <= omission.step:
        seen = ", which it first observed at the start" if omission.visible_step == 0 else ""
        seen = seen or f", which it first observed {ago(omission.visible_step)}"
    elif actor and omission.visible_step is not None:
        seen = ", which it did not observe yet"
    if omission.instead == "changed lanes":
        relation, _, side = kind.rpartition(" ")
        if relation == "no lane":
            return f"{agent} changed to the {side}, where it has no lane"
        away = "" if omission.gap_m is None or relation == "alongside" else f"{omission.gap_m:.1f} m "
        speeds = f"{omission.actor_speed_mps or 0:.1f} m/s against {omission.speed_mps:.1f} m/s of {agent}"
        needs, where = "", "alongside it"
        if relation != "alongside":
            where = f"{away}{relation}{' it' if relation == 'behind' else ''}"
            needs = f"; the safe gap is {omission.safe or 0:.1f} m"
        return f"{agent} changed to the {side} lane although {actor} was {where} ({speeds}{needs}){seen}"
    what = "stop for a red light" if kind == "red light" else f"brake for {actor}"
    what = f"yield to {actor}" if kind == "crossing" and had_to_yield else what
    gap = f"{omission.gap_m:.1f} m ahead, " if omission.gap_m is not None else ""
    safe = f"{omission.speed_mps:.1f} m/s where {omission.safe or 0:.1f} m/s are safe"
    if omission.speed_mps <= (omission.safe or 0.0):  # not too fast yet, but its action would make it so
        safe = f"{omission.safe:.1f} m/s are safe, and it was about to drive faster"
    if omission.instead == "braked too little":
        how = what.removeprefix("brake ") if what.startswith("brake ") else f"to {what}"
        return f"{agent} braked too little {how} ({gap}{safe}){seen}"
    instead = describe_instead(omission)
    return f"{agent} did not {what} ({gap}{safe}){seen}{f', and {instead}' if instead else ''}"


def describe_instead(omission: Omission) -> str:
    """Return what an agent did with its speed in place of braking; empty if it is unknown or ambiguous.

    An agent may have sped up before it kept its speed, so the text contains the time over which it kept its speed.
    """
    last = omission.last_speed_mps
    if omission.instead == "sped up" and last is None:  # an earlier version judged the crash
        return "sped up"
    if omission.instead == "sped up" and last is not None and last > omission.speed_mps:
        return f"sped up to {last:.1f} m/s"
    if omission.instead == "kept its speed" and omission.kept_s is not None and omission.kept_s >= _MIN_KEPT_S:
        return f"kept its speed for the last {omission.kept_s:.1f} s"
    return ""


def about_changes(changed: Sequence[str]) -> str:
    """Return further differences of the agent in a run, as a sentence with a leading space; empty if there are none."""
    return f" In addition, {' and '.join(changed)} in that run." if changed else ""


def _until(attempt: Attempt, ago: Callable[[int], str]) -> str:
    assert attempt.last_step is not None
    braking = f" (at up to {attempt.deceleration:.1f} m/s²)" if attempt.deceleration is not None else ""
    escape = _ESCAPE_WORDS.get(attempt.manoeuvre, attempt.manoeuvre)
    words = f"It could be avoided until {ago(attempt.last_step)}, {escape}{braking}"
    more = about_changes(attempt.changed)
    if attempt.all_later_run and attempt.last_step < attempt.end - 1:
        return f"{words}: a run from this step avoids it, and runs from all later steps crash.{more}"
    if attempt.too_late_step is not None:
        return f"{words}: a run from this step avoids it, and a run from one step later crashes.{more}"
    return f"{words}: a run from this step avoids it.{more}"


# The causes of a crash, in words. Every sentence reports runs, not calculations.

_OMISSION_WORDS = {
    "braked": "it keeps its speed",
    "sped up": "it keeps its speed",
    "changed lanes": "it stays in its lane",
}
_MANOEUVRE_NOUNS = {"braked": "braking", "sped up": "speeding up", "changed lanes": "change of lanes"}


def about_why(why: Why, when: Callable[[int], str]) -> list[str]:
    """Return the causes of a crash, one sentence each, the strongest first, then the factors without influence.

    A cause is the stronger, the fewer of the runs without it end in the same crash. ``when`` returns the time of a step
    as text, such as ``61.3 s``.
    """
    defaults = {factor.name: factor for factor in why.factors if (factor.kind, factor.what) == ("argument", "default")}
    drawn = {
        factor.name for factor in why.factors if (factor.kind, factor.what) == ("argument", "drawn") and factor.clear
    }
    causes: list[tuple[float, str]] = []
    alike = []
    for factor in why.factors:
        default = defaults.get(factor.name) if factor.kind == "argument" else None
        if not factor.clear or (factor is default and factor.name in drawn):
            continue
        each = [factor, *([default] if default is not None and default is not factor else [])]
        if all(one.same == one.clear for one in each):
            alike.append(_short(factor, sum(one.clear for one in each), when))
        else:
            words = f"- {'; '.join(_sentence(one, when) for one in each if one.clear)}."
            causes.append((sum(one.same for one in each) / sum(one.clear for one in each), words))
    sentences = [words for _, words in sorted(causes, key=lambda cause: cause[0])]
    if sentences:
        sentences = [f"Causes, from {why.runs} runs that each remove or change one element:", *sentences]
    if alike:
        sentences.append(f"No difference in any run: {'; '.join(alike)}.")
    if why.why_not:
        sentences.append(f"The causes are not fully known: {why.why_not}.")
    return sentences


def _sentence(factor: Factor, when: Callable[[int], str]) -> str:
    return f"{_condition_words(factor, when)}: {_outcome(factor)}"


def _condition_words(factor: Factor, when: Callable[[int], str]) -> str:
    who, what = factor.name, factor.what
    if factor.kind == "argument" and what == "default":
        return f"{who} at its default {_number(factor.runs[0].given)}"
    if factor.kind == "argument":
        return f"other values of {who} (it was {_number(factor.was)})"
    if factor.kind == "seed":
        return "other seeds, and so other traffic"
    if what == "there":
        return f"without {who} (taken off the road {_steps(factor)})"
    assert factor.step is not None
    if factor.kind == "disturbance":
        return f"without the disturbance {what} of {who} at {when(factor.step)}"
    return f"{who} {what} at {when(factor.step)}; without that ({_OMISSION_WORDS[what]})"


def _steps(factor: Factor) -> str:
    steps = sorted(int(run.given) for run in factor.runs)
    earlier = ", ".join(map(str, steps[:-1]))
    return f"after step {earlier} or {steps[-1]}" if earlier else f"after step {steps[-1]}"


def _outcome(factor: Factor) -> str:
    of = factor.clear
    if factor.kind in ("argument", "seed") and of > 1:
        low, high = factor.interval or (0.0, 1.0)
        words = f"{factor.crashed} of {of} runs crash ({format_percent(low)} to {format_percent(high)})"
        if factor.crashed == factor.same:
            return words
        return f"{words}, {factor.same or 'none'} of them the same crash"
    counts = (("no crash", of - factor.crashed), ("another crash", factor.crashed - factor.same))
    several = [*counts, ("the same crash", factor.same)]
    parts = [f"{words} in {number} of {of} runs" if of > 1 else words for words, number in several if number]
    into = sorted({run.into for run in factor.runs if run.into})
    more = f", though {factor.name} then drives into {' or '.join(into)} itself" if into else ""
    changed = sorted({each for run in factor.runs for each in run.changed})
    of_changed = sum(bool(run.changed) for run in factor.runs)
    if changed:
        more += f" (in {of_changed} of {of} runs in addition {' or '.join(changed)})"
    return f"{' and '.join(parts)}{more}"


def _short(factor: Factor, runs: int, when: Callable[[int], str]) -> str:
    who, what = factor.name, factor.what
    if factor.kind == "argument":
        return f"the value of {who}, {_number(factor.was)} ({runs} {'other' if runs == 1 else 'others'})"
    if factor.kind == "seed":
        return f"the seed ({runs} others)"
    if what == "there":
        return who
    assert factor.step is not None
    return f"the {_MANOEUVRE_NOUNS.get(what, what)} of {who} at {when(factor.step)}"


def _number(value: Value | None) -> str:
    return format_number(value) if isinstance(value, float) else str(value)


# The results of the robustness probes and branches of a hunt.


def describe_versions(versions: Iterable[Mapping[str, Any]]) -> str:
    """Return the trials of each version of the code as text, the newest version first.

    Each version has the fields of `VersionCounts`.
    """
    ordered = sorted(versions, key=lambda one: not one["is_newest"])
    newest = ordered[0]
    each = "; ".join(
        f"{'newest ' if one['is_newest'] else ''}version {one['version']}: {one['crashes']} of "
        f"{count_of(one['trials'], 'trial')} crashed"
        for one in ordered
    )
    return (
        f"the code has changed: {each}; crash types are of version {newest['version']}, and its rate is of the trials "
        f"from {newest['first']} on"
    )


_MAX_NOTE_CHARACTERS = 200  # of a note in one line


def describe_note(note: Note, *, whole: bool = True) -> str:
    """Return a note as one line; unless the whole note is wanted, the middle of a long text is omitted."""
    about = f" on {note.crash}" if note.crash else ""
    tags = "".join(f" #{tag}" for tag in note.tags)
    text = one_line(note.text)
    if not whole and len(text) > _MAX_NOTE_CHARACTERS:
        half = _MAX_NOTE_CHARACTERS // 2
        text = f"{text[:half]} … {text[-half:]}"
    return one_line(f"note {note.number}{about} ({note.by}, {note.at}):{' ' if text else ''}{text}{tags}")


def describe_types_by_version(versions: Mapping[str, Mapping[str, Mapping[int, int]]]) -> list[str]:
    """Return for each hunt and crash type how often it occurred with each version of the code, one line each."""
    lines = []
    for hunt, types in versions.items():
        for words, counts in types.items():
            each = ", ".join(f"{count} with version {version}" for version, count in counts.items())
            lines.append(f"{hunt}: {words}: {each} of the code")
    return lines


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
