"""``--set disturbances=none`` and ``--set disturbances.STEP.how_strong=2``: a crash with other disturbances."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import ArgumentError
from crashhunt.base.names import one_of
from crashhunt.trial import CELLS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.trial import Disturbance

__all__ = ["NAME", "edited_disturbances", "is_about_disturbances"]

NAME = "disturbances"
_FIELDS = ("who", "how_strong", "how_long")


def is_about_disturbances(name: str) -> bool:
    """Whether ``--set NAME=…`` is about the disturbances of the trial."""
    return name == NAME or name.startswith(f"{NAME}.")


def edited_disturbances(
    planned: Sequence[Disturbance], name: str, text: str
) -> tuple[tuple[Disturbance, ...], list[str]]:
    """Return the disturbances with one change, and what is not as it was, in words.

    Args:
        planned: of the trial.
        name: ``disturbances`` or ``disturbances.STEP.FIELD``.
        text: ``none``, or the value of the field.

    Raises:
        ArgumentError: it cannot be meant.
    """
    where = f"--set {name}"
    if name == NAME:
        if text != "none":
            fix = f"write {NAME}=none, or {NAME}.STEP.how_strong=2"
            raise ArgumentError(f"{where}: {text!r} is not none", fix=fix)
        return (), [f"{NAME} were {len(planned)} and are none"] if planned else []
    step, _, field = name.removeprefix(f"{NAME}.").partition(".")
    steps = list(dict.fromkeys(str(one.step) for one in planned))
    if step not in steps:
        raise ArgumentError(f"{where}: none begins at step {step!r}", fix=one_of(step, steps, give="they begin at"))
    if field not in _FIELDS:
        fix = one_of(field, _FIELDS, give="write one of")
        raise ArgumentError(f"{where}: {field!r} is nothing to change", fix=fix)
    value = _value(where, field, text)
    found = tuple(replace(one, **{field: value}) if str(one.step) == step else one for one in planned)
    words = [
        f"{NAME}.{step}.{field} was {getattr(was, field)} and is {value}"
        for was, now in zip(planned, found, strict=True)
        if was != now
    ]
    return found, words


def _value(where: str, field: str, text: str) -> Any:
    if field == "who":
        if text not in CELLS:
            raise ArgumentError(f"{where}: {text!r} is no place", fix=one_of(text, CELLS))
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (0 <= value < math.inf) or (field == "how_long" and value == 0):
        raise ArgumentError(f"{where}: {text!r} is none", fix="give a number above 0")
    return value
