"""Pictures: panels that an agent may show of itself, the scene from above, and films of both.

Needs Pillow, and for MP4 PyAV: ``pip install 'crashhunt[video]'``. Panels themselves need neither: an agent can make
them where nobody draws them.
"""

from crashhunt.render._files import explanation, load_meanings, load_panels, save_meanings, save_panels
from crashhunt.render._nest import labelled, scope
from crashhunt.render._panels import (
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
    "explanation",
    "labelled",
    "load_meanings",
    "load_panels",
    "save_meanings",
    "save_panels",
    "scope",
]
