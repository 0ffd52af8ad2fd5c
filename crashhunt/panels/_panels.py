"""Panels: views of an agent's internal state next to the scene. Panels are plain data, and are drawn when requested.

An agent creates panels in every step, even if they are not drawn. Pillow is therefore imported only by the first
drawing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache, singledispatch
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.text import format_number

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from PIL import Image, ImageFont


# Names of panels: nested scopes, and the places in a nest.

_scopes: ContextVar[tuple[str, ...]] = ContextVar("crashhunt_render_scopes", default=())


@contextmanager
def scope(name: str) -> Iterator[None]:
    """Prefix the names of the panels that are created in a ``with`` block; blocks can be nested.

    Args:
        name: prefix of the names of the scopes and panels in the block.
    """
    token = _scopes.set((*_scopes.get(), name))
    try:
        yield
    finally:
        _scopes.reset(token)


def current_scope() -> tuple[str, ...]:
    """Return the names of the current scopes, the outermost first."""
    return _scopes.get()


def labelled(nest: object) -> list[tuple[str, Panel]]:
    """Return every panel in nested mappings and sequences, with its label; other objects are ignored.

    A label consists of the scopes in which the panel was created, its keys in the nested objects, and its title. If two
    panels have the same label, the second gets a number.
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
    """A picture of a part of an agent's internal state."""

    title: str = ""  # title above the panel; in the label, scopes and keys precede the title
    # names of the scopes in which the panel was created
    scopes: tuple[str, ...] = field(default_factory=current_scope, init=False, repr=False)

    def draw(self, width: int = 240, height: int = 160, label: str = "") -> NDArray[np.uint8]:
        """Return the panel as a picture, uint8, shape (height, width, 3).

        Args:
            width: width of the picture, in pixels.
            height: height of the picture, in pixels.
            label: text above the panel; by default its title.

        Raises:
            TypeError: the panel has a class of the user without a method `draw`.
            ValueError: the content of the panel has the wrong shape.
        """
        return painted(self, width, height, label or self.title)


@dataclass
class Heatmap(Panel):
    """A matrix shown as colours, with the first row at the top and a colour bar.

    Args:
        values: values of the matrix, shape (rows, columns).
        low: value with the darkest colour; by default the least value.
        high: value with the brightest colour; by default the greatest value.
        annotate: whether to write the values into the cells.
    """

    values: ArrayLike
    low: float | None = None
    high: float | None = None
    annotate: bool = False


@dataclass
class Contour(Panel):
    """A matrix shown as a landscape with contour lines.

    Args:
        values: values of the matrix, shape (rows, columns).
        low: value of the lowest contour line; by default the least value.
        high: value of the highest contour line; by default the greatest value.
        levels: number of levels.
    """

    values: ArrayLike
    low: float | None = None
    high: float | None = None
    levels: int = 8


@dataclass
class Curve(Panel):
    """One or several curves.

    Args:
        series: values of each curve by name, or the values of a single curve.
        x: x of all values; by default the index of each value.
        low: lower end of the vertical axis; by default the least value.
        high: upper end of the vertical axis; by default the greatest value.
        cursor: position of a vertical line on the x axis.
        colors: red, green and blue (0 to 255) of some curves, by name.
    """

    series: Mapping[str, ArrayLike] | ArrayLike
    x: ArrayLike | None = None
    low: float | None = None
    high: float | None = None
    cursor: float | None = None
    colors: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)


@dataclass
class Curve3D(Panel):
    """A path in space, seen from above at an angle; its colour changes from dark to bright.

    Args:
        points: points of the path, shape (n, 3).
        azimuth: direction from which the scene is seen, in degrees.
    """

    points: ArrayLike
    azimuth: float = 35.0


@dataclass
class Bar(Panel):
    """Bars with their values.

    Args:
        values: value of each bar by name, or values without names.
        low: lower end of the axis; by default 0 or the least value.
        high: upper end of the axis; by default the greatest value.
    """

    values: Mapping[str, float] | ArrayLike
    low: float | None = None
    high: float | None = None


@dataclass
class Text(Panel):
    """Some lines of text.

    Args:
        text: the lines of text.
    """

    text: str


@dataclass
class Action(Panel):
    """An action, shown as bars within their bounds, or as an integer.

    Args:
        value: value from a Box space, or the integer of a discrete action.
        low: lower bound of each component; needed for bars.
        high: upper bound of each component.
        names: names of the components.
    """

    value: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    names: Sequence[str] = ()


@dataclass
class ActionDistribution(Panel):
    """The probability of each action of an agent.

    Args:
        probabilities: probability of each discrete action.
        mean: mean of each component of a continuous action; given together with ``std``.
        std: standard deviation of each component of a continuous action.
        names: names of the actions or components.
    """

    probabilities: ArrayLike | None = None
    mean: ArrayLike | None = None
    std: ArrayLike | None = None
    names: Sequence[str] = ()


@dataclass
class Picture(Panel):
    """An image, drawn as large as possible.

    Args:
        image: pixels of the image, shape (height, width, 3) or (height, width); uint8, or floats from 0 to 1.
    """

    image: ArrayLike


# What all pictures share: fonts, colours, axes.

PAPER, INK, FAINT, GRID = (255, 255, 255), (27, 36, 48), (93, 107, 125), (217, 223, 231)
# Okabe and Ito's palette, which the colour-blind can tell apart.
COLORS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (90, 90, 90))
_MAX_NAME_CHARACTERS = 80  # characters of a name
_MIN_DISTANCE = 1e-100  # what is closer is one place
# Nine points of viridis (S. van der Walt, N. Smith), between which is interpolated.
_VIRIDIS = (
    (68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141), (39, 173, 129), (92, 200, 99),
    (170, 220, 50), (253, 231, 37),
)  # fmt: skip


@lru_cache(maxsize=16)
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return a font that comes with Pillow."""
    from PIL import ImageFont

    return ImageFont.load_default(size)


@lru_cache(maxsize=1)
def color_map() -> NDArray[np.uint8]:
    """Return 256 colours from the lowest to the highest value, shape (256, 3)."""
    places = np.linspace(0, 255, len(_VIRIDIS))
    columns = [np.interp(np.arange(256), places, [color[part] for color in _VIRIDIS]) for part in range(3)]
    return np.stack(columns, axis=1).round().astype(np.uint8)


def map_colors(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.uint8]:
    """Return the colours of values, shape (*values.shape, 3); values that are not finite are grey."""
    finite = np.isfinite(values)
    share = (np.where(finite, values, low) - low) / span_of(low, high)
    colors = color_map()[np.clip(share * 255, 0, 255).astype(np.uint8)]
    colors[~finite] = 200
    return colors


def span_of(low: float, high: float) -> float:
    """Return the difference of two limits; 1 if they are equal."""
    return high - low if high - low > _MIN_DISTANCE else 1.0


def number(value: float) -> str:
    """Return a number as text for a label."""
    return format_number(value) if math.isfinite(value) else "-"


@lru_cache(maxsize=256)
def ticks(low: float, high: float, most: int = 4) -> tuple[float, ...]:
    """Return round numbers between two limits, for the labels of an axis."""
    if not high - low > max(_MIN_DISTANCE, abs(low) * 1e-12, abs(high) * 1e-12):  # as far as floats can tell
        return (low,)
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return tuple(place * step for place in range(first, math.floor(high / step + 1e-9) + 1))


@lru_cache(maxsize=512)
def _background(width: int, height: int, title: str) -> Image.Image:
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, width - 1, height - 1), outline=GRID)
    draw.text((width // 2, 3), title, INK, font(12), anchor="ma")
    return image


class Canvas:
    """An empty panel with its title, to draw on.

    Args:
        width: width of the panel, in pixels.
        height: height of the panel, in pixels.
        title: title above the panel.
    """

    def __init__(self, width: int, height: int, title: str) -> None:
        from PIL import ImageDraw

        self.width, self.height = width, height
        self.image = _background(width, height, _one_line(title)).copy()  # image on which the panel is drawn
        self.draw = ImageDraw.Draw(self.image)  # Pillow's object that draws on the image

    def text(
        self, at: tuple[float, float], text: str, color: tuple[int, int, int], size: int, anchor: str = "la"
    ) -> None:
        """Write one line of text onto the panel."""
        self.draw.text(at, _one_line(text), color, font(size), anchor=anchor)

    def pixels(self) -> NDArray[np.uint8]:
        """Return the panel as uint8, shape (height, width, 3)."""
        return as_array(self.image)


def as_array(image: Image.Image) -> NDArray[np.uint8]:
    """Return an image as uint8, shape (height, width, 3)."""
    return np.asarray(image.convert("RGB") if image.mode != "RGB" else image)


def _one_line(text: object) -> str:
    """Return a name as one line of limited length."""
    return " ".join(str(text)[:_MAX_NAME_CHARACTERS].split())


_TOP, _LEFT, _BOTTOM, _RIGHT = 20, 38, 18, 10  # room for title and labels, in pixels
_LEGEND_FONT_PIXELS, _LEGEND_ROW_PIXELS, _LEGEND_GAP_PIXELS, _MAX_LEGEND_ROWS = 11, 13, 10, 3
_NAME_ROW_PIXELS = 11  # height of a row of names below bars
_LARGE_NAME_CHARACTERS = 12  # characters of a name that are written large
_MAX_DRAWN_VALUE = 1e100  # beyond it, the difference of two numbers may overflow; drawn as missing


def painted(panel: Panel, width: int, height: int, label: str) -> NDArray[np.uint8]:
    """Return a panel as a picture, uint8, shape (height, width, 3).

    Raises:
        TypeError: the panel has no known type.
        ValueError: the content of the panel has the wrong shape.
    """
    canvas = Canvas(width, height, label)
    with np.errstate(all="ignore"):  # agents show what they have
        _paint(panel, canvas)
    return canvas.pixels()


@singledispatch
def _paint(panel: Panel, _canvas: Canvas) -> None:
    raise TypeError(f"{type(panel).__name__} has no method that draws the panel")


@_paint.register(Heatmap)
def _paint_heatmap(panel: Heatmap, canvas: Canvas) -> None:
    values = _matrix_of(panel.values)
    low, high = _limits(values, panel.low, panel.high)
    colors = map_colors(values, low, high)
    box = _paste_map(canvas, colors, smooth=False)
    if panel.annotate:
        cell = ((box[2] - box[0]) / values.shape[1], (box[3] - box[1]) / values.shape[0])
        for row in range(values.shape[0]):
            for column in range(values.shape[1]):
                at = (box[0] + (column + 0.5) * cell[0], box[1] + (row + 0.5) * cell[1])
                ink = (0, 0, 0) if colors[row, column].mean() > 120 else (255, 255, 255)
                canvas.text(at, number(values[row, column]), ink, 10, anchor="mm")
    _color_bar(canvas, low, high)


@_paint.register(Contour)
def _paint_contour(panel: Contour, canvas: Canvas) -> None:
    values, levels = _matrix_of(panel.values), max(1, panel.levels)
    low, high = _limits(values, panel.low, panel.high)
    fine = _bilinear(values, 120, 180)
    there = np.isfinite(fine)
    share = (np.where(there, fine, low) - low) / span_of(low, high)
    level = np.clip((share * levels).astype(int), 0, levels - 1)
    colors = map_colors(np.where(there, (level + 0.5) / levels, np.nan), 0.0, 1.0)
    edge = np.zeros(level.shape, bool)
    edge[:, 1:] |= level[:, 1:] != level[:, :-1]
    edge[1:] |= level[1:] != level[:-1]
    colors[edge & there] //= 2
    _paste_map(canvas, colors, smooth=True)
    _color_bar(canvas, low, high)


@_paint.register(Curve)
def _paint_curve(panel: Curve, canvas: Canvas) -> None:
    named = panel.series if isinstance(panel.series, Mapping) else {"": panel.series}
    series = {str(name): _numbers(values).ravel() for name, values in named.items()}
    longest = max((len(values) for values in series.values()), default=0)
    x = np.arange(longest) if panel.x is None else _numbers(panel.x).ravel()
    everything = np.concatenate(list(series.values())) if series else np.zeros(0)
    low, high = _limits(everything, panel.low, panel.high)
    colors = {name: panel.colors.get(name, COLORS[place % len(COLORS)]) for place, name in enumerate(series)}
    top = _draw_legend(canvas, list(colors.items()))
    frame = _Axes(canvas, *_limits(x, None, None), low, high, top)
    for name, values in series.items():
        count = min(len(x), len(values))
        for part in _finite_runs(x[:count], values[:count]):
            frame.line(part, colors[name])
    if panel.cursor is not None:
        at = frame.x(panel.cursor)
        canvas.draw.line((at, top, at, canvas.height - _BOTTOM), FAINT)


@_paint.register(Curve3D)
def _paint_curve_3d(panel: Curve3D, canvas: Canvas) -> None:
    points = _numbers(panel.points).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    turn = math.radians(panel.azimuth)
    size = 0.55 * min(canvas.width, canvas.height - _TOP)

    def place(where: NDArray[np.float64]) -> NDArray[np.float64]:
        unit = (where - low) / span - 0.5
        across = unit[:, 0] * math.cos(turn) - unit[:, 1] * math.sin(turn)
        away = unit[:, 0] * math.sin(turn) + unit[:, 1] * math.cos(turn)
        return np.stack(
            (canvas.width / 2 + across * size, (canvas.height + _TOP) / 2 - (0.4 * away + 0.75 * unit[:, 2]) * size), 1
        )

    corner = place(np.array([low, [high[0], low[1], low[2]], [low[0], high[1], low[2]], [low[0], low[1], high[2]]]))
    for name, end in zip("xyz", corner[1:], strict=True):
        canvas.draw.line((*corner[0], *end), FAINT)
        canvas.text(tuple(end), name, FAINT, 10)
    path = place(points)
    shades = color_map()[np.linspace(0, 255, max(1, len(path) - 1)).astype(int)]
    for begin, end, shade in zip(path, path[1:], shades, strict=False):
        canvas.draw.line((*begin, *end), tuple(map(int, shade)), 2)


@_paint.register(Bar)
def _paint_bar(panel: Bar, canvas: Canvas) -> None:
    named = panel.values
    if not isinstance(named, Mapping):
        named = {str(place): float(value) for place, value in enumerate(_numbers(named).ravel())}
    values = _numbers([*named.values(), 0.0])  # bars stand on zero
    _bars(canvas, list(named), values[:-1], *_limits(values, panel.low, panel.high))


@_paint.register(Text)
def _paint_text(panel: Text, canvas: Canvas) -> None:
    canvas.draw.multiline_text((8, _TOP + 2), str(panel.text), INK, font(12), spacing=3)


@_paint.register(Action)
def _paint_action(panel: Action, canvas: Canvas) -> None:
    values = np.asarray(panel.value)
    if values.ndim == 0 and np.issubdtype(values.dtype, np.integer):
        name = panel.names[int(values)] if 0 <= int(values) < len(panel.names) else ""
        middle, size = (canvas.width / 2, canvas.height / 2), 26 if len(name) <= _LARGE_NAME_CHARACTERS else 14
        canvas.text(middle, name or str(int(values)), COLORS[0], size if name else 36, anchor="mm")
        if name:
            canvas.text((middle[0], middle[1] + 32), f"action {int(values)}", INK, 12, anchor="mm")
        return
    parts = _numbers(values).ravel()
    low = np.broadcast_to(_numbers(-1.0 if panel.low is None else panel.low), parts.shape)
    high = np.broadcast_to(_numbers(1.0 if panel.high is None else panel.high), parts.shape)
    row = min(34.0, (canvas.height - _TOP - 6) / max(1, len(parts)))
    left, right = 8.0, canvas.width - 9.0
    for place, value in enumerate(parts):
        top = _TOP + 2 + place * row
        canvas.text((left, top), f"{_name(panel.names, place)} {number(value)}", INK, 11)
        at = top + row - 10
        canvas.draw.rectangle((left, at, right, at + 6), outline=FAINT)
        if math.isfinite(value):
            shares = (np.array([0.0, value]) - low[place]) / span_of(low[place], high[place])
            begin, end = sorted((left + (right - left) * np.clip(shares, 0.0, 1.0)).tolist())
            canvas.draw.rectangle((begin, at, max(end, begin + 1), at + 6), COLORS[0])


@_paint.register(ActionDistribution)
def _paint_distribution(panel: ActionDistribution, canvas: Canvas) -> None:
    if panel.probabilities is not None:
        values = _numbers(panel.probabilities).ravel()
        _bars(canvas, [_name(panel.names, place) for place in range(len(values))], values, 0.0, 1.0)
        return
    if panel.mean is None or panel.std is None:
        raise ValueError("the panel has no values: give probabilities, or mean and std")
    mean, std = _numbers(panel.mean).ravel(), np.maximum(_numbers(panel.std).ravel(), 1e-9)
    if len(mean) != len(std):
        raise ValueError(f"mean has {len(mean)} values, but std has {len(std)}")
    there = np.isfinite(mean) & np.isfinite(std)
    if not there.any():
        return
    low, high = float((mean - 3 * std)[there].min()), float((mean + 3 * std)[there].max())
    x = np.linspace(low, high, 120)
    density = np.exp(-(((x[None] - mean[:, None]) / std[:, None]) ** 2) / 2) / (std[:, None] * math.sqrt(math.tau))
    colors = [(_name(panel.names, place), COLORS[place % len(COLORS)]) for place in range(len(density))]
    frame = _Axes(canvas, low, high, 0.0, float(density[there].max()), _draw_legend(canvas, colors))
    for place, curve in enumerate(density):
        if there[place]:
            frame.line(np.stack((x, curve), 1), colors[place][1])


@_paint.register(Picture)
def _paint_picture(panel: Picture, canvas: Canvas) -> None:
    pixels = np.asarray(panel.image)
    if pixels.dtype != np.uint8:
        pixels = (np.clip(np.nan_to_num(_numbers(pixels)), 0, 1) * 255).astype(np.uint8)
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.ndim != 3 or 0 in pixels.shape:
        raise ValueError(f"give an image of shape (height, width) or (height, width, channels), not {pixels.shape}")
    if pixels.shape[2] < 3:
        pixels = np.repeat(pixels[:, :, :1], 3, axis=2)
    scale = min((canvas.width - 12) / pixels.shape[1], (canvas.height - _TOP - 6) / pixels.shape[0])
    size = max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale))
    from PIL import Image

    drawn = Image.fromarray(np.ascontiguousarray(pixels[:, :, :3])).resize(size)
    canvas.image.paste(drawn, ((canvas.width - size[0]) // 2, _TOP + (canvas.height - _TOP - 6 - size[1]) // 2))


_CUT_PIXELS, _CUT_DOT_PIXELS = 1.0, 3.0  # beyond an axis, a value is cut: a dotted line at the axis


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int, bool]]:
    """Return the begin, the end and the value of each run of equal flags."""
    ends = [*(np.flatnonzero(flags[1:] != flags[:-1]) + 1).tolist(), len(flags)]
    return [(begin, end, bool(flags[begin])) for begin, end in zip([0, *ends], ends, strict=False)]


class _Axes:
    """Axes with labels, and the conversion of values to pixel positions."""

    def __init__(self, canvas: Canvas, left: float, right: float, low: float, high: float, top: int) -> None:
        self._draw, self._bottom = canvas.draw, canvas.height - _BOTTOM
        self._top = top = min(top, self._bottom - 1)  # the legend of a small panel is as high as the panel
        self._left, self._low = left, low
        self._scale_x = (canvas.width - _LEFT - _RIGHT) / span_of(left, right)
        self._scale_y = (self._bottom - top) / span_of(low, high)
        for tick in ticks(low, high):
            at = self._bottom - (tick - low) * self._scale_y
            canvas.draw.line((_LEFT, at, canvas.width - _RIGHT, at), GRID)
            canvas.text((_LEFT - 4, at), number(tick), FAINT, 10, anchor="rm")
        for tick in ticks(left, right):
            canvas.text((self.x(tick), canvas.height - _BOTTOM + 3), number(tick), FAINT, 10, anchor="mt")
        canvas.draw.rectangle((_LEFT, top, canvas.width - _RIGHT, self._bottom), outline=FAINT)

    def x(self, value: float) -> float:
        return _LEFT + (value - self._left) * self._scale_x

    def line(self, points: NDArray[np.float64], color: tuple[int, int, int]) -> None:
        placed = np.empty_like(points)
        placed[:, 0] = _LEFT + (points[:, 0] - self._left) * self._scale_x
        heights = self._bottom - (points[:, 1] - self._low) * self._scale_y
        placed[:, 1] = np.clip(heights, self._top, self._bottom)
        if len(placed) == 1:
            placed, heights = np.repeat(placed, 2, axis=0), np.repeat(heights, 2)
        is_cut = np.abs(heights - placed[:, 1]) > _CUT_PIXELS
        is_cut = is_cut[1:] & is_cut[:-1]
        for begin, end, cut in _runs(is_cut):
            if not cut:
                self._draw.line(placed[begin : end + 1].ravel().tolist(), color, 2)
                continue
            level = placed[begin, 1]
            for left in np.arange(placed[begin, 0], placed[end, 0], 2 * _CUT_DOT_PIXELS):
                right = min(left + _CUT_DOT_PIXELS, placed[end, 0])
                self._draw.line((left, level, right, level), color, 2)


def _bars(canvas: Canvas, names: Sequence[str], values: NDArray[np.float64], low: float, high: float) -> None:
    if not len(values):
        return
    room, top, bottom = (canvas.width - 16) / len(values), _TOP + 12, canvas.height - _BOTTOM
    names = [_one_line(name) for name in names]
    rows = 1 if all(font(10).getlength(name) <= room - 4 for name in names) else 2  # rows of names
    bottom -= _NAME_ROW_PIXELS * (rows - 1)
    scale = (bottom - top) / span_of(low, high)
    zero = bottom - (min(max(0.0, low), high) - low) * scale
    for place, (name, value) in enumerate(zip(names, values.tolist(), strict=True)):
        left = 8 + place * room
        middle = left + room / 2
        if math.isfinite(value):
            end = bottom - (min(max(value, low), high) - low) * scale
            canvas.draw.rectangle((left + room * 0.15, min(end, zero), left + room * 0.85, max(end, zero)), COLORS[0])
            canvas.text((middle, min(end, zero) - 2), number(value), INK, 10, anchor="mb")
        limit = min(rows * room - 4, 2 * (middle - 3), 2 * (canvas.width - 3 - middle))
        at = middle, bottom + 2 + _NAME_ROW_PIXELS * (place % rows)
        canvas.text(at, _shortened(name, limit), FAINT, 10, anchor="ma")  # one line, whatever letters a name has
    canvas.draw.line((8, zero, canvas.width - 8, zero), FAINT)


@lru_cache(maxsize=256)
def _shortened(name: str, width: float) -> str:
    """Return a name that is at most so many pixels wide; the middle is cut, as names often differ in their ends."""
    if font(10).getlength(name) <= width:
        return name
    for kept in range(len(name) - 1, 1, -1):
        text = f"{name[: kept // 2]}…{name[kept // 2 - kept :]}"
        if font(10).getlength(text) <= width:
            return text
    return name[:1]


def _matrix_of(values: ArrayLike) -> NDArray[np.float64]:
    matrix = np.atleast_2d(_numbers(values))
    if matrix.ndim != 2 or 0 in matrix.shape:
        raise ValueError(f"give a matrix with two dimensions that are not empty, not shape {matrix.shape}")
    return matrix


def _limits(values: NDArray[np.generic], low: float | None, high: float | None) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    least, most = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    lower, upper = _numbers([least if low is None else low, most if high is None else high]).tolist()
    lower = lower if math.isfinite(lower) else least
    return lower, max(lower, upper if math.isfinite(upper) else most)


def _numbers(values: ArrayLike) -> NDArray[np.float64]:
    """Return values as floats; values that are too large to draw become NaN."""
    found = np.array(values, float)
    found[~(np.abs(found) < _MAX_DRAWN_VALUE)] = np.nan
    return found


def _finite_runs(x: NDArray[np.generic], y: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the parts of a curve without missing values."""
    there = np.isfinite(y) & np.isfinite(x)
    if there.all():
        return [np.stack((x, y), 1).astype(float)] if len(y) else []
    edges = np.flatnonzero(np.diff(np.concatenate(([0], there.astype(np.int8), [0]))))
    return [np.stack((x[a:b], y[a:b]), 1).astype(float) for a, b in zip(edges[0::2], edges[1::2], strict=True)]


def _bilinear(values: NDArray[np.float64], rows: int, columns: int) -> NDArray[np.float64]:
    row, column = np.linspace(0, values.shape[0] - 1, rows), np.linspace(0, values.shape[1] - 1, columns)
    top, left = np.floor(row).astype(int), np.floor(column).astype(int)
    below, right = np.minimum(top + 1, values.shape[0] - 1), np.minimum(left + 1, values.shape[1] - 1)
    down, along = (row - top)[:, None], (column - left)[None]
    upper = values[np.ix_(top, left)] * (1 - along) + values[np.ix_(top, right)] * along
    lower = values[np.ix_(below, left)] * (1 - along) + values[np.ix_(below, right)] * along
    fine: NDArray[np.float64] = upper * (1 - down) + lower * down
    return fine


def _paste_map(canvas: Canvas, colors: NDArray[np.uint8], *, smooth: bool) -> tuple[int, int, int, int]:
    from PIL import Image

    resample = Image.Resampling.BILINEAR if smooth else Image.Resampling.NEAREST
    """Stretch a picture over the room for it, and say where that is."""
    box = (_RIGHT, _TOP, canvas.width - 52, canvas.height - 8)
    canvas.image.paste(Image.fromarray(colors).resize((box[2] - box[0], box[3] - box[1]), resample), box[:2])
    return box


def _color_bar(canvas: Canvas, low: float, high: float) -> None:
    from PIL import Image

    bar = Image.fromarray(color_map()[::-1][:, None, :]).resize((8, canvas.height - _TOP - 8))
    canvas.image.paste(bar, (canvas.width - 48, _TOP))
    canvas.text((canvas.width - 37, _TOP), number(high), FAINT, 10, anchor="lt")
    canvas.text((canvas.width - 37, canvas.height - 8), number(low), FAINT, 10, anchor="ls")


def _draw_legend(canvas: Canvas, names: Sequence[tuple[str, tuple[int, int, int]]]) -> int:
    """Write the names of curves in rows between title and axes, never over a curve; return the top of the axes."""
    left, row = float(_LEFT), 0
    for name, color in names:
        if not name:
            continue
        width = font(_LEGEND_FONT_PIXELS).getlength(_one_line(name)) + _LEGEND_GAP_PIXELS
        if left > _LEFT and left + width > canvas.width - _RIGHT:
            left, row = float(_LEFT), row + 1
        if row == _MAX_LEGEND_ROWS:
            break
        canvas.text((left, _TOP - 1 + _LEGEND_ROW_PIXELS * row), name, color, _LEGEND_FONT_PIXELS)
        left += width
    return _TOP + (_LEGEND_ROW_PIXELS * min(row + 1, _MAX_LEGEND_ROWS) if left > _LEFT or row else 0)


def _name(names: Sequence[str], place: int) -> str:
    return names[place] if place < len(names) else str(place)
