"""``brake@124=ahead:4:2``: a disturbance that every trial has, in a step that somebody has chosen."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.base.names import one_of
from crashhunt.trial import CELLS, Disturbance, why_not

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

__all__ = ["FORM", "is_fixed", "parse_fixed", "word_of"]

FORM = "KIND@STEP=WHO:HOW_STRONG:HOW_LONG"
_FIX = f"write {FORM}, such as brake@124=ahead:4:2 for 4 m/s² and 2 s from step 124 on"


def is_fixed(word: str) -> bool:
    """Whether a word is about a disturbance in a step of its own, and says no rate."""
    return "@" in word


def parse_fixed(words: Iterable[str], agents: Sequence[str], *, shown: str = "--disturb") -> tuple[Disturbance, ...]:
    """Return the disturbances that words fix, ``[AGENT.]KIND@STEP=WHO:HOW_STRONG:HOW_LONG``, in the order of steps.

    Args:
        words: as they are given; those that say a rate are left aside.
        agents: the controlled vehicles, around which they are.
        shown: where somebody has written them, for the error.

    Raises:
        UsageError: it cannot be meant, or a kind comes twice in one step around one agent.
    """
    found: dict[tuple[int, str, str], Disturbance] = {}
    for word in filter(is_fixed, words):
        one = _parsed(word, agents, shown)
        key = one.step, one.agent, one.what
        if key in found:
            raise UsageError(f"{shown} {word}: {one.what} begins twice at step {one.step}", fix="give it once")
        found[key] = one
    return tuple(one for _, one in sorted(found.items()))


def word_of(one: Disturbance, agents: Sequence[str]) -> str:
    """Return the word that fixes a disturbance; whose it is only where there are several agents."""
    whose = f"{one.agent}." if len(agents) > 1 else ""
    place = one.who.replace(" ", "_")  # so that no shell needs quotes
    return f"{whose}{one.what}@{one.step}={place}:{one.how_strong!r}:{one.how_long!r}"


def _parsed(word: str, agents: Sequence[str], shown: str) -> Disturbance:
    name, equals, text = word.partition("=")
    kind, _, step = name.partition("@")
    parts = [part.strip() for part in text.split(":")]
    agent, what = _whose(kind, agents, f"{shown} {word}")
    if not (equals and what and len(parts) == 3 and step.isascii() and step.isdecimal() and int(step) > 0):
        raise UsageError(f"{shown} {word!r} is no disturbance", fix=_FIX)
    who = parts[0].replace("_", " ")
    if who not in CELLS:
        raise UsageError(f"{shown} {word}: {parts[0]!r} is no place around an agent", fix=one_of(who, CELLS))
    one = Disturbance(int(step), who, what, _number(parts[1]), _number(parts[2]), agent)
    if reason := why_not(one):
        raise UsageError(f"{shown} {word}: {reason[0]}", fix=reason[1])
    return one


def _whose(name: str, agents: Sequence[str], shown: str) -> tuple[str, str]:
    """The agent around which it is, and the kind."""
    agent, dot, what = name.rpartition(".")
    if dot and agent not in agents:
        raise UsageError(f"{shown}: there is no controlled vehicle {agent!r}", fix=one_of(agent, agents))
    if not dot and len(agents) > 1:
        fix = f"write {agents[0]}.{name}@…"
        raise UsageError(f"{shown} does not say around whom, and there are {', '.join(agents)}", fix=fix)
    return agent or agents[0], what


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
