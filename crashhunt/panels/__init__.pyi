from ._painting import FAINT as FAINT, INK as INK, as_array as as_array, font as font
from ._panels import (
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
    labelled as labelled,
    scope as scope,
)
