"""What all pictures share: fonts, colours, axes."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFont

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "COLORS",
    "FAINT",
    "GRID",
    "INK",
    "PAPER",
    "Canvas",
    "as_array",
    "color_map",
    "font",
    "map_colors",
    "number",
    "span_of",
    "ticks",
]

PAPER, INK, FAINT, GRID = (255, 255, 255), (27, 36, 48), (93, 107, 125), (217, 223, 231)
# Okabe and Ito's palette, which the colour-blind can tell apart.
COLORS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (90, 90, 90))
_LONGEST = 80  # characters of a name
_NEAREST = 1e-100  # what is closer is one place
# Nine points of viridis (S. van der Walt, N. Smith), between which is interpolated.
_VIRIDIS = (
    (68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141), (39, 173, 129), (92, 200, 99),
    (170, 220, 50), (253, 231, 37),
)  # fmt: skip


@lru_cache(maxsize=16)
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return a font; Pillow brings it along."""
    return ImageFont.load_default(size)


@lru_cache(maxsize=1)
def color_map() -> NDArray[np.uint8]:
    """Return 256 colours from low to high, shape (256, 3)."""
    places = np.linspace(0, 255, len(_VIRIDIS))
    columns = [np.interp(np.arange(256), places, [color[part] for color in _VIRIDIS]) for part in range(3)]
    return np.stack(columns, axis=1).round().astype(np.uint8)


def map_colors(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.uint8]:
    """Return the colours of values, shape (*values.shape, 3); grey where a value is not finite."""
    finite = np.isfinite(values)
    share = (np.where(finite, values, low) - low) / span_of(low, high)
    colors = color_map()[np.clip(share * 255, 0, 255).astype(np.uint8)]
    colors[~finite] = 200
    return colors


def span_of(low: float, high: float) -> float:
    """Return how far apart two limits are; 1 where they are not."""
    return high - low if high - low > _NEAREST else 1.0


def number(value: float) -> str:
    """Return a number for a label."""
    return f"{value:.3g}" if math.isfinite(value) else "-"


@lru_cache(maxsize=256)
def ticks(low: float, high: float, most: int = 4) -> tuple[float, ...]:
    """Return round numbers between two limits."""
    if not high - low > max(_NEAREST, abs(low) * 1e-12, abs(high) * 1e-12):  # as far as floats can tell
        return (low,)
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return tuple(place * step for place in range(first, math.floor(high / step + 1e-9) + 1))


@lru_cache(maxsize=512)
def _background(width: int, height: int, title: str) -> Image.Image:
    image = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, width - 1, height - 1), outline=GRID)
    draw.text((width // 2, 3), title, INK, font(12), anchor="ma")
    return image


class Canvas:
    """An empty panel with its title, to draw on.

    Args:
        width: in pixels.
        height: in pixels.
        title: above it.

    Attributes:
        image: what is drawn.
        draw: what draws.
    """

    def __init__(self, width: int, height: int, title: str) -> None:
        self.width, self.height = width, height
        self.image = _background(width, height, _line(title)).copy()
        self.draw = ImageDraw.Draw(self.image)

    def text(
        self, at: tuple[float, float], text: str, color: tuple[int, int, int], size: int, anchor: str = "la"
    ) -> None:
        """Write one line."""
        self.draw.text(at, _line(text), color, font(size), anchor=anchor)

    def pixels(self) -> NDArray[np.uint8]:
        """Return it as uint8, shape (height, width, 3)."""
        return as_array(self.image)


def as_array(image: Image.Image) -> NDArray[np.uint8]:
    """Return an image as uint8, shape (height, width, 3)."""
    return np.asarray(image.convert("RGB") if image.mode != "RGB" else image)


def _line(text: object) -> str:
    """A name on one line, and no longer than anybody could read."""
    return " ".join(str(text)[:_LONGEST].split())
