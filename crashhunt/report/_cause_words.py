"""The causes of a crash, in words. Every sentence reports runs, not calculations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.text import format_number, format_percent

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.crashes import Factor, Why
    from crashhunt.trial import Value


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
        crash = "crashes" if factor.crashed == 1 else "crash"
        words = f"{factor.crashed} of {of} runs {crash} ({format_percent(low)} to {format_percent(high)})"
        if factor.crashed == factor.same:
            return words
        same = f"{factor.same or 'none'} of them the same crash" if factor.crashed > 1 else "another crash"
        return f"{words}, {same}"
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
