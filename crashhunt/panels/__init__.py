"""Panels: plain data that show an agent's internal state; Pillow is imported when a panel is drawn."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._panels import (
        FAINT as FAINT,
        INK as INK,
        Action as Action,
        ActionDistribution as ActionDistribution,
        Bar as Bar,
        Contour as Contour,
        Curve as Curve,
        Curve3D as Curve3D,
        Heatmap as Heatmap,
        Panel as Panel,
        Picture as Picture,
        Text as Text,
        as_array as as_array,
        font as font,
        labelled as labelled,
        scope as scope,
    )

offer_lazily(__name__)
