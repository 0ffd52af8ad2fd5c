"""Panels: views of an agent's internal state, shown next to the scene. They are plain data, drawn on request."""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import ArrayLike, NDArray


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
    "current_scope",
    "labelled",
    "scope",
]


# Names of panels: nested scopes, and the places in a nest.

_scopes: ContextVar[tuple[str, ...]] = ContextVar("crashhunt_render_scopes", default=())


@contextmanager
def scope(name: str) -> Iterator[None]:
    """Name the panels that are made inside; scopes nest.

    Args:
        name: comes before the names of scopes and panels inside.
    """
    token = _scopes.set((*_scopes.get(), name))
    try:
        yield
    finally:
        _scopes.reset(token)


def current_scope() -> tuple[str, ...]:
    """Return the names of the scopes around, outermost first."""
    return _scopes.get()


def labelled(nest: object) -> list[tuple[str, Panel]]:
    """Return every panel in a nest of mappings and sequences, with its label; whatever is no panel is passed over.

    A label is made of the scopes in which the panel was made, its keys in the nest, and its title. Of two panels with
    the same label, the second gets a number.
    """
    found: list[tuple[str, Panel]] = []
    labels: dict[str, int] = {}

    def visit(value: object, path: tuple[str, ...]) -> None:
        if isinstance(value, Panel):
            label = "/".join(filter(None, (*value.scopes, *path, value.title)))
            labels[label] = labels.get(label, 0) + 1
            found.append((label if labels[label] == 1 else f"{label} {labels[label]}".strip(), value))
        elif isinstance(value, dict):
            for key, item in value.items():
                visit(item, (*path, str(key)))
        elif isinstance(value, list | tuple):
            for item in value:
                visit(item, path)

    visit(nest, ())
    return found


@dataclass(kw_only=True)
class Panel:
    """A picture of something inside an agent.

    Args:
        title: above it; scopes and keys come before it in the label.

    Attributes:
        scopes: in which it was made.
    """

    title: str = ""
    scopes: tuple[str, ...] = field(default_factory=current_scope, init=False, repr=False)

    def draw(self, width: int = 240, height: int = 160, label: str = "") -> NDArray[np.uint8]:
        """Return it as uint8, shape (height, width, 3).

        Args:
            width: in pixels.
            height: in pixels.
            label: above it; its title by default.

        Raises:
            TypeError: it is of a class of your own, which then has to have this method.
            ValueError: what it shows has the wrong shape.
        """
        from crashhunt.panels._painting import painted

        return painted(self, width, height, label or self.title)


@dataclass
class Heatmap(Panel):
    """A matrix as colours, the first row on top, with a colour bar.

    Args:
        values: shape (rows, columns).
        low: the value of the darkest colour; the least value by default.
        high: the value of the brightest; the greatest by default.
        annotate: whether to write the values into the cells.
    """

    values: ArrayLike
    low: float | None = None
    high: float | None = None
    annotate: bool = False


@dataclass
class Contour(Panel):
    """A matrix as a landscape with contour lines.

    Args:
        values: shape (rows, columns).
        low: of the lowest level; the least value by default.
        high: of the highest level; the greatest by default.
        levels: how many.
    """

    values: ArrayLike
    low: float | None = None
    high: float | None = None
    levels: int = 8


@dataclass
class Curve(Panel):
    """One or several curves.

    Args:
        series: name to values; or the values of the only one.
        x: of all values; their number by default.
        low: of the vertical axis; the least value by default.
        high: likewise.
        cursor: where to draw a vertical line.
    """

    series: Mapping[str, ArrayLike] | ArrayLike
    x: ArrayLike | None = None
    low: float | None = None
    high: float | None = None
    cursor: float | None = None


@dataclass
class Curve3D(Panel):
    """A path in space, seen from above at an angle; it begins dark and ends bright.

    Args:
        points: shape (n, 3).
        azimuth: from where it is seen, in degrees.
    """

    points: ArrayLike
    azimuth: float = 35.0


@dataclass
class Bar(Panel):
    """Bars with their values.

    Args:
        values: name to value, or values.
        low: of the axis; 0 or the least value by default.
        high: likewise.
    """

    values: Mapping[str, float] | ArrayLike
    low: float | None = None
    high: float | None = None


@dataclass
class Text(Panel):
    """Some lines of text.

    Args:
        text: what to write.
    """

    text: str


@dataclass
class Action(Panel):
    """An action: bars within their bounds, or an integer.

    Args:
        value: of a Box space, or the integer of a discrete one.
        low: the bounds of each part; needed for bars.
        high: likewise.
        names: of the parts.
    """

    value: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    names: Sequence[str] = ()


@dataclass
class ActionDistribution(Panel):
    """How likely an agent is to act in which way.

    Args:
        probabilities: of each discrete action.
        mean: of each part of a continuous action, with ``std``.
        std: its standard deviation.
        names: of the actions or parts.
    """

    probabilities: ArrayLike | None = None
    mean: ArrayLike | None = None
    std: ArrayLike | None = None
    names: Sequence[str] = ()


@dataclass
class Picture(Panel):
    """An image, as large as fits.

    Args:
        image: shape (height, width, 3) or (height, width); uint8, or floats from 0 to 1.
    """

    image: ArrayLike
