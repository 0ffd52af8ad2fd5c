"""Panels of agents that are programs: the value of each panel in an answer determines how it is shown."""

from __future__ import annotations

from numbers import Real

import numpy as np

from crashhunt.panels import Bar, Curve, Heatmap, Panel, Text


def panels_in(value: object) -> dict[str, Panel]:
    """Return the panels in an answer of a program, by their labels.

    A text or a number is shown as text, a list of numbers as a curve, and a list of equally long lists as a heatmap. An
    object of numbers is shown as bars, and an object of lists as curves.

    Raises:
        ValueError: the value is not an object, or the value of a panel has another form.
    """
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise ValueError("panels is not an object with a value for each label")
    return {str(label): _panel(str(label), shown) for label, shown in value.items()}


def _panel(label: str, value: object) -> Panel:
    if isinstance(value, str | Real):
        return Text(text=str(value))
    if isinstance(value, dict) and value:
        if all(isinstance(one, Real) for one in value.values()):
            return Bar(values={str(name): float(one) for name, one in value.items()})
        if all(_dimensions(one) == 1 for one in value.values()):
            return Curve(series={str(name): np.asarray(one, np.float64) for name, one in value.items()})
    if _dimensions(value) == 1:
        return Curve(series=np.asarray(value, np.float64))
    if _dimensions(value) == 2:
        return Heatmap(values=np.asarray(value, np.float64))
    raise ValueError(f"the panel {label!r} is neither text nor numbers in a list, a table or an object")


def _dimensions(value: object) -> int:
    """Return the number of dimensions of nested lists of numbers; 0 for all other values and for empty lists."""
    if not isinstance(value, list):
        return 0
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return 0
    return array.ndim if array.size else 0
