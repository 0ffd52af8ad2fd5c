"""Outlines of obstacles that do not move and are no actors, such as buildings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray


class ObstacleOutlines:
    """The edges of outlines, prepared once per episode.

    Args:
        outlines: The corners of each outline as x and y, in m. The first corner may be repeated at the end.
    """

    def __init__(self, outlines: Iterable[Sequence[tuple[float, float]]]) -> None:
        known = [outline for outline in outlines if outline]
        corners = np.array([corner for outline in known for corner in outline], float).reshape(-1, 2)
        counts = np.array([len(outline) for outline in known], int)
        starts = np.cumsum(counts) - counts
        self._owners = np.repeat(np.arange(len(known)), counts)
        following = np.arange(len(corners)) + 1
        following[starts + counts - 1] = starts
        (ax, ay), (bx, by) = ((ends - corners[starts][self._owners]).T for ends in (corners, corners[following]))
        is_clockwise = (np.add.reduceat(ax * by - bx * ay, starts) < 0.0)[self._owners]
        self._edges = np.where(
            is_clockwise[:, None], np.hstack((corners[following], corners)), np.hstack((corners, corners[following]))
        )
        # A town has thousands of obstacles, so the edges of those far away are excluded by their bounding box.
        self._low, self._high = np.minimum.reduceat(corners, starts), np.maximum.reduceat(corners, starts)

    def edges_near(self, x: float, y: float, reach_m: float) -> NDArray[np.float64]:
        """Return all edges of the obstacles whose bounding box touches a square around a point.

        Args:
            x: x of the point, in m.
            y: y of the point, in m.
            reach_m: Half the edge length of the square, in m.

        Returns:
            x and y of the start and of the end of each edge, counter-clockwise around each outline, shape (n, 4).
        """
        place = np.array((x, y))
        is_near = np.all((self._low <= place + reach_m) & (self._high >= place - reach_m), axis=1)
        edges: NDArray[np.float64] = self._edges[is_near[self._owners]]
        return edges
