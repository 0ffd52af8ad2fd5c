"""Fault, and whether a collision could have been avoided, in words. Every sentence reports runs, not calculations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.text import count_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.crashes import Attempt, DriverRun, Judgement, Omission, Preventability, Reference


NOT_DECIDED = "not decided"
"""How texts name the verdict on the vehicle at fault if rules contradict each other, or if no rule applies."""


def fault_words(fault: str) -> str:
    """Return a verdict on the vehicle at fault as text."""
    return {"nobody can tell": NOT_DECIDED, "ego": "the agent"}.get(fault, fault)  # an agent may have another name


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
    elif judgement.runs:
        others = judgement.others_from(0)
        none = f"None of {runs} {'ended without a crash' if others else 'avoided it'}"
        tried = " nor ".join(_ESCAPE_WORDS.get(attempt.manoeuvre, attempt.manoeuvre) for attempt in judgement.attempts)
        if judgement.avoidable is not False:
            sentences = [f"{none}, but they do not prove that it was unavoidable."]
        elif len(judgement.attempts) == 1:
            sentences = [f"{none} {tried}, from the first step on."]
        else:
            sentences = [f"{none}, from the first step on: neither {tried}."]
        sentences += [f"In {others} of them, another crash happened instead."] * bool(others)
    visible = judgement.visible_step
    if judgement.verdict == "invalid":
        sentences.append(f"{agent} started in an unavoidable situation: the trial is invalid.")
    elif visible is not None and judgement.verdict == "too late when visible":
        seen = f"When {agent} first observed {other}, {ago(visible)},"
        if others := judgement.others_from(visible):
            late = f"no later run ended without a crash; in {others} of them, another crash happened instead"
        else:
            late = "the crash was already unavoidable: runs from every later step crashed"
        sentences.append(f"{seen} {late}.")
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
