"""Panels under the name from which agents import them: ``from crashhunt.render import Bar``."""

from crashhunt.panels import (
    Action,
    ActionDistribution,
    Bar,
    Contour,
    Curve,
    Curve3D,
    Heatmap,
    Panel,
    Picture,
    Text,
    labelled,
    scope,
)

__all__ = [
    "Action",
    "ActionDistribution",
    "Bar",
    "Contour",
    "Curve",
    "Curve3D",
    "Heatmap",
    "Panel",
    "Picture",
    "Text",
    "labelled",
    "scope",
]
