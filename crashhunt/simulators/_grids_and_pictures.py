"""Grids and pictures of the surroundings of a vehicle, computed from outlines and centre lines.

Sine and cosine come from the C library, because NumPy's results differ between processors in the last bit.
"""

from __future__ import annotations

import math
from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.simulators._scene_parts import center_of, in_frame
from crashhunt.world import outlines

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.simulators._line_of_sight import ObstacleOutlines
    from crashhunt.world import Scene

    Mask = NDArray[np.bool_]
    Line = NDArray[np.float64]


_BACKGROUND, _ROAD, _OBSTACLE = (246, 247, 249), (228, 232, 237), (196, 186, 176)
_ACTOR, _OWN = (125, 139, 156), (224, 138, 0)
"""Colours of pictures (red, green, blue), as in films."""


class Raster:
    """Cells around a vehicle: the vehicle is in the middle, and its heading points to smaller row numbers."""

    def __init__(self, rows: int, columns: int, resolution_m: float) -> None:
        self._shape, self._resolution_m = (rows, columns), resolution_m
        self.reach_m = math.hypot(rows, columns) / 2 * resolution_m

    def occupied(self, scene: Scene, row: int, others: Sequence[int]) -> Mask:
        """Return whether the centre of each cell is inside the outline of an actor."""
        found = np.zeros(self._shape, bool)
        for other in others:
            for x, y, heading, length, width in outlines(scene, other):
                half = length / 2
                middle = np.array([[x - half * cos(heading), y - half * sin(heading)]])
                ahead, left = in_frame(scene, row, middle)[0].tolist()
                turn = heading - scene.headings[row]
                c, s = cos(turn), sin(turn)
                part = self._window(ahead, left, math.hypot(half, width / 2))
                cell_ahead, cell_left = self._centers(part)
                along = (cell_ahead - ahead) * c + (cell_left - left) * s
                across = (cell_left - left) * c - (cell_ahead - ahead) * s
                found[part] |= (np.abs(along) <= half) & (np.abs(across) <= width / 2)
        return found

    def obstructed(self, scene: Scene, row: int, obstacles: ObstacleOutlines) -> Mask:
        """Return whether the centre of each cell is inside the outline of an obstacle."""
        edges = obstacles.edges_near(*center_of(scene, row), self.reach_m)
        # As numbers of rows and columns, which are whole at the centre of a cell.
        (first_row, first_column), (last_row, last_column) = (
            (np.array(self._shape) / 2 - 0.5 - in_frame(scene, row, ends) / self._resolution_m).T
            for ends in (edges[:, :2], edges[:, 2:])
        )
        # All outlines have the same orientation. So a cell is outside if as many edges cross its row upwards as
        # downwards on its left, also where outlines overlap.
        begin = np.clip(np.floor(np.minimum(first_row, last_row)), -1, self._shape[0] - 1).astype(int) + 1
        end = np.clip(np.floor(np.maximum(first_row, last_row)), -1, self._shape[0] - 1).astype(int) + 1
        counts = end - begin
        which = np.repeat(np.arange(len(edges)), counts)
        cell_row = begin[which] + np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        slope = (last_column - first_column)[which] / (last_row - first_row)[which]
        crossing = first_column[which] + (cell_row - first_row[which]) * slope
        cell_column = np.clip(np.floor(crossing), -1, self._shape[1] - 1).astype(int) + 1
        turns = np.zeros((self._shape[0], self._shape[1] + 1), int)
        np.add.at(turns, (cell_row, cell_column), np.where(last_row > first_row, 1, -1)[which])
        inside: Mask = turns.cumsum(axis=1)[:, :-1] != 0
        return inside

    def on_lanes(self, scene: Scene, row: int, lanes: Sequence[tuple[Line, float]]) -> Mask:
        """Return whether the centre of each cell is on a lane: at most half its width from its centre line.

        Each lane has the points of its centre line, shape (n, 2), and its width, in m.
        """
        found = np.zeros(self._shape, bool)
        lines = [(in_frame(scene, row, line), width) for line, width in lanes]
        starts = np.concatenate([line[:-1] for line, _ in lines] or [np.zeros((0, 2))])
        steps = np.concatenate([np.diff(line, axis=0) for line, _ in lines] or [np.zeros((0, 2))])
        halves = np.repeat([width / 2 for _, width in lines], [len(line) - 1 for line, _ in lines])
        middles, lengths = starts + steps / 2, np.hypot(steps[:, 0], steps[:, 1])
        reaches = lengths / 2 + halves
        limit = np.array(self._shape) / 2 * self._resolution_m
        seen = (np.abs(middles) <= limit + reaches[:, None]).all(axis=1)
        starts, steps, halves, middles, reaches = (a[seen] for a in (starts, steps, halves, middles, reaches))
        if not len(starts):
            return found
        # The cells in a square around the middle of each piece of a line.
        side = math.ceil(float(reaches.max()) / self._resolution_m) + 1
        offsets = np.arange(-side, side + 1)
        first = np.floor(np.array(self._shape) / 2 - middles / self._resolution_m).astype(int)
        cell_rows = first[:, :1, None] + offsets[:, None]
        cell_columns = first[:, 1:, None] + offsets
        ahead = (self._shape[0] / 2 - cell_rows - 0.5) * self._resolution_m - starts[:, :1, None]
        left = (self._shape[1] / 2 - cell_columns - 0.5) * self._resolution_m - starts[:, 1:, None]
        step_ahead, step_left = steps[:, :1, None], steps[:, 1:, None]
        squared = np.maximum(step_ahead * step_ahead + step_left * step_left, 1e-12)
        share = np.clip((ahead * step_ahead + left * step_left) / squared, 0.0, 1.0)
        away_ahead, away_left = ahead - share * step_ahead, left - share * step_left
        inside = away_ahead * away_ahead + away_left * away_left <= (halves * halves)[:, None, None]
        inside &= (cell_rows >= 0) & (cell_rows < self._shape[0])
        inside &= (cell_columns >= 0) & (cell_columns < self._shape[1])
        piece, at_row, at_column = np.nonzero(inside)
        found[cell_rows[piece, at_row, 0], cell_columns[piece, 0, at_column]] = True
        return found

    def _window(self, ahead: float, left: float, reach_m: float) -> tuple[slice, slice]:
        """Return the cells in a square around a point, as rows and columns."""
        found = []
        for place, count in zip((ahead, left), self._shape, strict=True):
            first = math.floor(count / 2 - (place + reach_m) / self._resolution_m)
            last = math.ceil(count / 2 - (place - reach_m) / self._resolution_m)
            found.append(slice(min(max(first, 0), count), min(max(last, 0), count)))
        return found[0], found[1]

    def _centers(self, part: tuple[slice, slice]) -> tuple[Line, Line]:
        """Return how far the centres of cells are ahead, as a column, and to the left, as a row."""
        rows, columns = (np.arange(one.start, one.stop) for one in part)
        ahead = (self._shape[0] / 2 - rows - 0.5) * self._resolution_m
        left = (self._shape[1] / 2 - columns - 0.5) * self._resolution_m
        return ahead[:, None], left[None, :]


def picture(road: Mask, obstacles: Mask, actors: Mask, own: Mask) -> NDArray[np.uint8]:
    """Return a picture of cells, shape (rows, columns, 3): red, green and blue."""
    found = np.full((*road.shape, 3), _BACKGROUND, np.uint8)
    for mask, color in ((road, _ROAD), (obstacles, _OBSTACLE), (actors, _ACTOR), (own, _OWN)):
        found[mask] = color
    return found
