"""Drawing of the map of a place with its busiest roads."""

from __future__ import annotations

import unicodedata
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from PIL import ImageDraw

    from crashhunt.sumo.maps._road_network import Edge, RoadNetwork

_SIZE, _MARGIN, _HEAD = 1200, 40, 70  # pixels
_OVERSAMPLING = 2  # drawn so many times larger, for smooth edges
_GROUND, _ROAD, _WAY = (246, 247, 249), (200, 206, 214), (222, 226, 232)
_COLOR_RAMP = ((146, 180, 214), (224, 138, 0), (198, 40, 40))
"""From little traffic to the most."""
_MAX_LABELS = 5
_LETTERS = str.maketrans({"ß": "ss", "Ł": "L", "ł": "l", "Ø": "O", "ø": "o", "Đ": "D", "đ": "d", "Æ": "Ae", "æ": "ae"})
_BAR_PIXELS = 220
_LANE_M = 3.2


def draw_map(
    network: RoadNetwork,
    vehicles: Mapping[str, float],
    path: Path,
    *,
    title: str,
    hours: float,
    busiest: list[tuple[str, float]],
) -> None:
    """Write a PNG with roads in the colour of their traffic, the names of the busiest roads, and a scale.

    ``busiest`` has the roads whose names are drawn, with their vehicles per hour; the busiest road is first.
    """
    from PIL import Image, ImageDraw

    from crashhunt.panels import FAINT, INK, font

    points = [point for edge in network.edges.values() for lane in edge.lanes for point in lane.shape]
    low = min(x for x, _ in points), min(y for _, y in points)
    high = max(x for x, _ in points), max(y for _, y in points)
    span = max(high[0] - low[0], high[1] - low[1], 1.0)
    scale = (_SIZE - 2 * _MARGIN) / span
    width = max(round((high[0] - low[0]) * scale), 700) + 2 * _MARGIN
    height = max(round((high[1] - low[1]) * scale), 160) + 2 * _MARGIN + _HEAD + 30
    left = (width - (high[0] - low[0]) * scale) / 2
    top = _HEAD + (height - _HEAD - 30 - (high[1] - low[1]) * scale) / 2

    def place(point: tuple[float, float]) -> tuple[float, float]:
        return left + (point[0] - low[0]) * scale, top + (high[1] - point[1]) * scale

    image = Image.new("RGB", (width * _OVERSAMPLING, height * _OVERSAMPLING), _GROUND)
    draw = ImageDraw.Draw(image)
    most = max(vehicles.values(), default=0.0)
    lane_px = max(1.2, _LANE_M * scale * 0.85)
    for area in network.areas:
        draw.polygon([tuple(number * _OVERSAMPLING for number in place(point)) for point in area], fill=_ROAD)
    for edge in sorted(network.edges.values(), key=lambda edge: vehicles.get(edge.id, 0.0)):
        count = vehicles.get(edge.id, 0.0)
        for lane in edge.lanes:
            is_road = lane.admits("passenger")
            color = _color(count / most) if count and is_road else (_ROAD if is_road else _WAY)
            pixels = lane_px * (1.0 + (count / most if most and is_road else 0.0))
            line = [tuple(number * _OVERSAMPLING for number in place(point)) for point in lane.shape]
            draw.line(line, fill=color, width=max(1, round(pixels * _OVERSAMPLING)), joint="curve")
    smooth = image.reduce(_OVERSAMPLING)
    draw = ImageDraw.Draw(smooth)
    draw.text((_MARGIN, 18), drawable(title), fill=INK, font=font(22))
    _draw_ramp(draw, width, most / hours, font(14), INK)
    _draw_labels(draw, network, busiest, place, (width, height))
    _draw_scale(draw, scale, (width, height), FAINT, font(14))
    smooth.save(path, optimize=True)


def _color(share: float) -> tuple[int, int, int]:
    share = min(max(share, 0.0), 1.0) * (len(_COLOR_RAMP) - 1)
    index = min(int(share), len(_COLOR_RAMP) - 2)
    part = share - index
    first, second = _COLOR_RAMP[index], _COLOR_RAMP[index + 1]
    red, green, blue = (round(a + (b - a) * part) for a, b in zip(first, second, strict=True))
    return red, green, blue


def _draw_ramp(draw: ImageDraw.ImageDraw, width: int, most: float, letters: object, ink: tuple[int, int, int]) -> None:
    right, top = width - _MARGIN - 20, 46
    for x in range(_BAR_PIXELS):
        color = _color(x / _BAR_PIXELS)
        draw.line([(right - _BAR_PIXELS + x, top), (right - _BAR_PIXELS + x, top + 10)], fill=color)
    text = f"{most:,.0f} vehicles/h"
    draw.text((right - _BAR_PIXELS - 16, top - 4), "0", fill=ink, font=letters)  # type: ignore[arg-type]
    draw.text((right - draw.textlength(text, font=letters), top - 22), text, fill=ink, font=letters)  # type: ignore[arg-type]


def _draw_labels(
    draw: ImageDraw.ImageDraw,
    network: RoadNetwork,
    busiest: list[tuple[str, float]],
    place: object,
    size: tuple[int, int],
) -> None:
    from crashhunt.panels import INK, font

    taken: list[tuple[float, float, float, float]] = []
    for name, rate in busiest[:_MAX_LABELS]:
        edge = network.edges[name]
        x, y = place(_midpoint(edge))  # type: ignore[operator]
        text = f"{drawable(edge.name) or edge.id}: {rate:,.0f}/h"
        long = draw.textlength(text, font=font(14))
        x = min(max(x + 8, 4), size[0] - long - 8)
        y -= 9
        box = (x - 3, y - 2, x + long + 3, y + 18)
        if any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken):
            continue
        taken.append(box)
        draw.rounded_rectangle(box, radius=4, fill=(255, 255, 255), outline=(200, 206, 214))
        draw.text((x, y), text, fill=INK, font=font(14))


def drawable(text: str) -> str:
    """Return a text that contains only letters of the font; empty if too few letters remain.

    Pillow's own font has Latin letters, and draws boxes for all other letters, such as the sharp s of German.
    """
    from crashhunt.panels import font

    letters = font(14)
    missing = bytes(letters.getmask("\uffff"))
    found = ""
    for character in text.translate(_LETTERS):
        known = [
            one for one in unicodedata.normalize("NFKD", character)
            if not unicodedata.combining(one) and bytes(letters.getmask(one)) != missing
        ]  # fmt: skip
        is_known = bytes(letters.getmask(character)) != missing
        found += character if is_known else "".join(known)
    return found if len(found) >= len(text) / 2 else ""


def _midpoint(edge: Edge) -> tuple[float, float]:
    shape = edge.lanes[0].shape
    if len(shape) == 2:
        (x, y), (u, v) = shape
        return (x + u) / 2, (y + v) / 2
    return shape[len(shape) // 2]


def _draw_scale(
    draw: ImageDraw.ImageDraw, scale: float, size: tuple[int, int], ink: tuple[int, int, int], letters: object
) -> None:
    """Draw a scale: a line whose length is a round number."""
    length = next((m for m in (5000, 2000, 1000, 500, 200, 100, 50, 20, 10) if m * scale <= _BAR_PIXELS), 10)
    x, y = _MARGIN, size[1] - 24
    draw.line([(x, y), (x + length * scale, y)], fill=ink, width=3)
    text = f"{length} m" if length < 1000 else f"{length / 1000:g} km"
    draw.text((x + length * scale + 8, y - 9), text, fill=ink, font=letters)  # type: ignore[arg-type]
