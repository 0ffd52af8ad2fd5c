"""The scene from above, centred on one vehicle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw

from crashhunt.base.text import format_time
from crashhunt.panels import FAINT, INK, as_array, font
from crashhunt.world import corners, is_person

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray
    from PIL import ImageFont

    from crashhunt.recording import Recording
    from crashhunt.trial import Disturbance
    from crashhunt.world import Scene

_SKY, _ROAD, _MARK, _OBSTACLE = (246, 247, 249), (228, 232, 237), (170, 180, 192), (196, 186, 176)
# The contrast of the agent and its collision partner is that of the report.
_EGO, _PARTNER, _AGENT, _OTHER = (255, 179, 26), (143, 15, 63), (46, 158, 91), (154, 165, 179)
_CRASH = (198, 40, 40)
_DISTURBANCE_COLOR = (128, 62, 158)
_POINTS_PER_EDGE = 40  # of the outline of an actor
_CLOSEST_M = 0.1  # pairs of these points that are as much farther apart belong to one contact, too
_TRAIL_S = 4.0  # of where the agent has been
_PERSON_PIXELS = 4  # radius at least; a person is 20 cm long
_OVERSAMPLING = 2  # drawn so many times larger, for smooth edges
_LEGEND_STEP_PIXELS = 22  # pixels
_FULL_SIZE_PIXELS = 640, 360  # of a picture whose labels have their full size; those of a smaller one are smaller
_MIN_FONT_PIXELS = 10  # what is smaller cannot be read
_MIN_SHRINK = 0.3  # of the distances between labels
_EDGE_PIXELS = 1  # of the letters in a small picture
_MIN_LEGEND_PIXELS = 200, 120  # a picture that is smaller has room for one line of text


class SceneView:
    """Draws the scenes of a recording.

    Args:
        recording: recording of the episode.
        lanes: right and left border of each lane, shape (n, 2), in m.
        agent: identifier of the vehicle in the centre of the picture.
        other: identifier of the collision partner; empty if there is none.
        width: width of the picture, in pixels.
        height: height of the picture, in pixels.
        scale: scale of the picture, in pixels per metre.
        crash_step: step at which to mark the crash; -1 for none.
        nearest_step: step at which to mark the nearest moment of a near miss, for a second; -1 for none.
        crash_words: text above the marked crash.
        obstacles: outlines of obstacles, shape (n, 2), in m.
    """

    def __init__(
        self,
        recording: Recording,
        lanes: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
        *,
        agent: str,
        other: str = "",
        width: int = 960,
        height: int = 540,
        scale: float = 8.0,
        crash_step: int = -1,
        nearest_step: int = -1,
        crash_words: str = "CRASH",
        obstacles: Sequence[NDArray[np.float64]] = (),
    ) -> None:
        self.width, self.height = width, height
        self._recording = recording
        self._lanes = [(right, left, _box(right, left)) for right, left in lanes if len(right) > 1]
        self._obstacles = [outline for outline in obstacles if len(outline) > 2]
        self._agent, self._other = agent, other
        self._agents = set(recording.agents)
        self._scale = scale
        shrink = min(1.0, width / _FULL_SIZE_PIXELS[0], height / _FULL_SIZE_PIXELS[1])
        self._shrink = max(_MIN_SHRINK, shrink)
        self._has_legend = width >= _MIN_LEGEND_PIXELS[0] and height >= _MIN_LEGEND_PIXELS[1]
        self._crash_step, self._crash_words, self._nearest_step = crash_step, crash_words, nearest_step
        self._second = round(1.0 / recording.prologue.step_length_s)
        self._center = np.zeros(2)
        self._trail = round(_TRAIL_S / recording.prologue.step_length_s)

    def draw(self, step: int) -> NDArray[np.uint8]:
        """Return a picture of a scene, uint8, shape (height, width, 3).

        Raises:
            IndexError: the recording has no such step.
        """
        scene = self._recording.scene(step)
        row = scene.roster.index.get(self._agent)
        if row is not None:
            self._center = scene.centers[row]
        size = self.width * _OVERSAMPLING, self.height * _OVERSAMPLING
        image = Image.new("RGB", size, _SKY)
        draw = ImageDraw.Draw(image)
        self._draw_road(draw)
        for name, color in ((self._other, _PARTNER), (self._agent, _EGO)):
            self._draw_trail(draw, name, color, step)
        order = range(len(scene.roster))
        for other in sorted(order, key=scene.heights.__getitem__) if scene.heights else order:
            self._draw_actor(draw, scene, other, self._color(scene.roster.actors[other].id))
        for one in self._active_disturbances(step):
            self._ring(draw, scene, one.vehicle)
        if self._marked(step) and row is not None:
            x, y = self._to_pixels(self._contact(scene, row, step)[np.newaxis])[0]
            for radius in (34, 38):
                draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=_CRASH, width=3)
        smooth = image.reduce(_OVERSAMPLING)
        self._label(ImageDraw.Draw(smooth), scene, step, row)
        return as_array(smooth)

    def _contact(self, scene: Scene, row: int, step: int) -> NDArray[np.float64]:
        """Return the position to mark: the middle of where the outlines are closest, or the front of the agent."""
        other = scene.roster.index.get(self._other)
        if step != self._crash_step or other is None:
            return np.array(scene.points[row])
        first, second = (_along(corners(scene, one)) for one in (row, other))
        apart = np.linalg.norm(first[:, np.newaxis] - second[np.newaxis], axis=2)
        # Along a whole edge, such as at a rear end, all pairs are as close: the first of them would be a corner.
        one, two = np.nonzero(apart <= apart.min() + _CLOSEST_M)
        middle: NDArray[np.float64] = (first[one] + second[two]).mean(axis=0) / 2
        return middle

    def _marked(self, step: int) -> str:
        """Return the text above a marked step; empty if the step is not marked."""
        if step == self._crash_step:
            return self._crash_words
        # One picture alone would be gone before anybody has seen it.
        since = step - self._nearest_step
        return "NEAREST" if self._nearest_step >= 0 and 0 <= since <= self._second else ""

    def _to_pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert positions in metres to pixels of the high-resolution image."""
        offset = (points - self._center) * (self._scale * _OVERSAMPLING)
        offset[:, 1] *= -1
        placed: NDArray[np.float64] = offset + np.array([self.width, self.height]) * (_OVERSAMPLING / 2)
        return placed

    def _draw_road(self, draw: ImageDraw.ImageDraw) -> None:
        reach = np.array([self.width, self.height]) / (2 * self._scale)
        low, high = self._center - reach, self._center + reach
        seen = [lane for lane in self._lanes if (lane[2][0] <= high).all() and (lane[2][1] >= low).all()]
        for right, left, _ in seen:
            draw.polygon(self._to_pixels(np.concatenate((right, left[::-1]))).ravel().tolist(), fill=_ROAD)
        for right, left, _ in seen:
            for border in (right, left):
                draw.line(self._to_pixels(border.copy()).ravel().tolist(), fill=_MARK, width=_OVERSAMPLING)
        for outline in self._obstacles:
            if (outline.min(axis=0) <= high).all() and (outline.max(axis=0) >= low).all():
                draw.polygon(self._to_pixels(outline.copy()).ravel().tolist(), fill=_OBSTACLE)

    def _draw_trail(self, draw: ImageDraw.ImageDraw, name: str, color: tuple[int, int, int], step: int) -> None:
        points = []
        for number in range(max(0, step - self._trail), step + 1):
            scene = self._recording.scene(number)
            row = scene.roster.index.get(name)
            if row is not None:
                points.append(scene.points[row])
        if len(points) > 1:
            pale = tuple((part + 255) // 2 for part in color)
            draw.line(self._to_pixels(np.array(points)).ravel().tolist(), fill=pale, width=2 * _OVERSAMPLING)

    def _draw_actor(self, draw: ImageDraw.ImageDraw, scene: Scene, row: int, color: tuple[int, int, int]) -> None:
        outline = self._to_pixels(corners(scene, row))
        dark = tuple(part // 2 for part in color)
        if (
            not ((outline > -50) & (outline < np.array([self.width, self.height]) * _OVERSAMPLING + 50))
            .all(axis=1)
            .any()
        ):
            return
        if is_person(scene.roster.actors[row].id):
            x, y = outline.mean(axis=0)
            radius = max(_PERSON_PIXELS * _OVERSAMPLING, float(np.ptp(outline, axis=0).max()) / 2)
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color, outline=dark)
            return
        draw.polygon(outline.ravel().tolist(), fill=color, outline=dark)
        front_left, back_left, back_right, front_right = outline[[0, 1, -2, -1]]
        front, back = (front_left + front_right) / 2, (back_left + back_right) / 2
        glass = [front + (back - front) * share + (front_left - front_right) * side
                 for share, side in ((0.22, 0.38), (0.34, 0.42), (0.34, -0.42), (0.22, -0.38))]  # fmt: skip
        draw.polygon(np.array(glass).ravel().tolist(), fill=dark)

    def _active_disturbances(self, step: int) -> list[Disturbance]:
        """Return the active disturbances that affect an actor."""
        step_length_s = self._recording.prologue.step_length_s
        return [one for one in self._recording.disturbances if one.vehicle and one.is_active(step, step_length_s)]

    def _ring(self, draw: ImageDraw.ImageDraw, scene: Scene, name: str) -> None:
        """Draw a ring around an actor that is disturbed, or that the agent does not observe."""
        row = scene.roster.index.get(name)
        if row is None:
            return
        outline = self._to_pixels(corners(scene, row))
        x, y = (outline.min(axis=0) + outline.max(axis=0)) / 2
        radius = max(_PERSON_PIXELS * _OVERSAMPLING, float(np.ptp(outline, axis=0).max()) / 2) + 5 * _OVERSAMPLING
        draw.ellipse(
            (x - radius, y - radius, x + radius, y + radius), outline=_DISTURBANCE_COLOR, width=2 * _OVERSAMPLING
        )

    def _color(self, name: str) -> tuple[int, int, int]:
        if name == self._agent:
            return _EGO
        if name == self._other:
            return _PARTNER
        return _AGENT if name in self._agents else _OTHER

    def _label(self, draw: ImageDraw.ImageDraw, scene: Scene, step: int, row: int | None) -> None:
        margin = self._pixels(12)
        self._headline(draw, scene, step, row)
        if self._has_legend:
            self._legend(draw, step)
        if not self._recording.actors:
            middle = self.width / 2, self.height / 2
            self._write(draw, middle, "this simulator shows no scene", FAINT, 15, anchor="mm")
            return
        wanted = 60 * self._shrink
        meters = next((length for length in (5, 10, 20, 50, 100) if length * self._scale > wanted), 200)
        left, bottom = margin + self._pixels(2), self.height - margin
        draw.line((left, bottom, left + meters * self._scale, bottom), FAINT, 2)
        self._write(draw, (left, bottom - self._pixels(6)), f"{meters} m", FAINT, 12, anchor="ls")

    def _headline(self, draw: ImageDraw.ImageDraw, scene: Scene, step: int, row: int | None) -> None:
        """Write time, step and speed, and the text of a marked step: as much of the former as there is room for."""
        margin, top = self._pixels(12), self._pixels(10)
        speed = f"{scene.speeds[row]:.1f} m/s" if row is not None else "gone" if self._recording.actors else ""
        parts = [
            format_time(scene.time_s, self._recording.prologue.step_length_s),
            f"step {step}",
            f"{self._agent} {speed}",
        ]
        mark, large, plain = self._marked(step), self._font(26), self._font(15)
        room = float(self.width - 2 * margin)
        if mark:
            room -= large.getlength(mark) + margin
        while parts and plain.getlength("   ".join(parts)) > room:
            parts.pop()
        words = "   ".join(parts)
        self._write(draw, (margin, top), words, INK, 15)
        if mark:
            half = large.getlength(mark) / 2
            overlaps = bool(words) and margin + plain.getlength(words) + margin > self.width / 2 - half
            middle = self.width - margin - half if overlaps else self.width / 2
            self._write(draw, (middle, self._pixels(14)), mark, _CRASH, 26, anchor="ma")

    def _legend(self, draw: ImageDraw.ImageDraw, step: int) -> None:
        """Write the names of vehicles with their colours, and active disturbances, down to the scale of the picture."""
        names = [(self._agent, _EGO), (self._other, _PARTNER)]
        names += [(name, _AGENT) for name in sorted(self._agents - {self._agent, self._other})]
        names = [(name, color) for name, color in names if name]
        margin = self._pixels(12)
        row = max(_MIN_FONT_PIXELS + 3, self._pixels(_LEGEND_STEP_PIXELS))
        first = max(self._pixels(36), self._pixels(10) + _MIN_FONT_PIXELS + 5)
        side, lowest = max(7, self._pixels(12)), self.height - max(30, self._pixels(56))
        for place, (name, color) in enumerate(names):
            top = first + row * place
            if top > lowest:
                return
            square = margin + 1, top + self._pixels(3)
            draw.rectangle((*square, square[0] + side, square[1] + side), fill=color)
            self._write(draw, (margin + side + max(4, self._pixels(8)), top), name, INK, 13)
        for place, one in enumerate(self._active_disturbances(step)):
            top = first + self._pixels(4) + row * (len(names) + place)
            if top > lowest:
                return
            words = one.words.replace("²", "^2")  # the font has no ²
            self._write(draw, (margin, top), words, _DISTURBANCE_COLOR, 13)

    def _write(
        self,
        draw: ImageDraw.ImageDraw,
        at: tuple[float, float],
        text: str,
        color: tuple[int, int, int],
        size: int,
        anchor: str = "la",
    ) -> None:
        """Write one line; in a small picture, it has an edge, since it may lie on vehicles."""
        edge = _EDGE_PIXELS if self._shrink < 1.0 else 0
        draw.text(at, text, color, self._font(size), anchor=anchor, stroke_width=edge, stroke_fill=_SKY)

    def _pixels(self, full: float) -> int:
        """Return a distance in pixels from that in a picture of full size."""
        return round(full * self._shrink)

    def _font(self, full: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
        return font(max(_MIN_FONT_PIXELS, round(full * self._shrink)))


def _along(outline: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points along the edges of an outline, about 10 cm apart on a car."""
    shares = np.linspace(0.0, 1.0, _POINTS_PER_EDGE, endpoint=False)[:, np.newaxis]
    edges = zip(outline, np.roll(outline, -1, axis=0), strict=True)
    return np.concatenate([start + shares * (end - start) for start, end in edges])


def _box(right: NDArray[np.float64], left: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    both = np.concatenate((right, left))
    return both.min(axis=0), both.max(axis=0)
