"""What a vehicle can see: rays to actors and obstacles, and the actors that others hide.

Sine and cosine come from the C library, because NumPy's results differ between processors in the last bit.
"""

from __future__ import annotations

import math
from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.simulators._scene_parts import center_of, in_frame, nearest_actors
from crashhunt.world import outlines

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from crashhunt.world import Scene

    Mask = NDArray[np.bool_]
    Line = NDArray[np.float64]


_HALF_TURN_RAD = 3.1  # a little less, between the ends of an edge as seen from a point at it


def occluded(scene: Scene, row: int, caster: RayCaster) -> frozenset[str]:
    """Return the identifiers of the actors that other actors and obstacles hide from a vehicle."""
    reach = caster.reach_m + max(scene.roster.lengths)
    near = [one.row for one in nearest_actors(scene, row, hidden=frozenset(), radius=reach)]
    seen = caster.seen(scene, row, near)
    return frozenset(scene.roster.actors[other].id for other in near if other not in seen)


class ObstacleOutlines:
    """The edges of outlines of obstacles that do not move and are no actors, prepared once per episode.

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

        The square reaches ``reach_m`` to each side.

        Returns:
            x and y of the start and of the end of each edge, counter-clockwise around each outline, shape (n, 4).
        """
        place = np.array((x, y))
        is_near = np.all((self._low <= place + reach_m) & (self._high >= place - reach_m), axis=1)
        edges: NDArray[np.float64] = self._edges[is_near[self._owners]]
        return edges


class RayCaster:
    """Casts rays from the centre of a vehicle to the outlines of actors and obstacles.

    Args:
        rays: Number of rays, evenly distributed over the full circle; the first one points along the heading.
        reach_m: Largest distance, in m.
        obstacles: The obstacles; None if there are none.

    Attributes:
        reach_m: Largest distance, in m.
    """

    def __init__(self, rays: int, reach_m: float, obstacles: ObstacleOutlines | None = None) -> None:
        self._rays, self.reach_m, self._obstacles = rays, reach_m, obstacles
        angles = [math.tau * number / rays for number in range(rays)]
        self._cos, self._sin = np.array([*map(cos, angles)]), np.array([*map(sin, angles)])

    def cast(self, scene: Scene, row: int, others: Sequence[int]) -> NDArray[np.float64]:
        """Return the distance along each ray to the nearest outline, in m; the largest distance if there is none."""
        found = self._clear(scene, row)
        _, ray, enters = self._hits(scene, row, others)
        np.minimum.at(found, ray, enters)
        return found

    def seen(self, scene: Scene, row: int, others: Sequence[int]) -> frozenset[int]:
        """Return the rows of the actors that a ray hits first, of the given rows."""
        nearest = self._clear(scene, row)
        owner, ray, enters = self._hits(scene, row, others)
        np.minimum.at(nearest, ray, enters)
        return frozenset(np.asarray(others)[owner[enters == nearest[ray]]].tolist() if len(owner) else ())

    def _clear(self, scene: Scene, row: int) -> NDArray[np.float64]:
        """Return the distance along each ray to the nearest obstacle, in m; the largest distance if there is none."""
        found = np.full(self._rays, self.reach_m)
        if self._obstacles is None:
            return found
        edges = self._obstacles.edges_near(*center_of(scene, row), self.reach_m)
        starts, ends = in_frame(scene, row, edges[:, :2]), in_frame(scene, row, edges[:, 2:])
        (ax, ay), (bx, by) = starts.T, ends.T
        angle, turn = np.arctan2(ay, ax), np.arctan2(ax * by - bx * ay, ax * bx + ay * by)
        # Rounding decides on which side an edge is that the centre of the vehicle is on.
        is_at_edge = np.abs(turn) > _HALF_TURN_RAD
        which, ray = self._rays_between(
            np.where(is_at_edge, -math.pi, angle + np.minimum(turn, 0.0)),
            np.where(is_at_edge, math.pi, angle + np.maximum(turn, 0.0)),
            np.ones(len(edges), bool),
        )
        ray_cos, ray_sin = self._cos[ray], self._sin[ray]
        # Edges that meet have the same numbers at the corner, so no ray passes between them.
        (first_along, first_left), (last_along, last_left) = (
            (ray_cos * x[which] + ray_sin * y[which], ray_cos * y[which] - ray_sin * x[which])
            for x, y in ((ax, ay), (bx, by))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            # A ray along an edge gives 0 / 0; it hits the edges before and after it.
            away = first_along + (last_along - first_along) * (first_left / (first_left - last_left))
        is_hit = (np.minimum(first_left, last_left) <= 0.0) & (np.maximum(first_left, last_left) >= 0.0)
        is_hit &= (away >= 0.0) & (away <= self.reach_m)
        np.minimum.at(found, ray[is_hit], away[is_hit])
        return found

    def _hits(
        self, scene: Scene, row: int, others: Sequence[int]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
        """Return the hits of rays: the index of the actor, the ray, and the distance in m."""
        rectangles, owners = [], []
        for index, other in enumerate(others):
            outline = outlines(scene, other)
            rectangles += outline
            owners += [index] * len(outline)
        if not rectangles:
            return np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0)
        (own_x, own_y), heading = center_of(scene, row), scene.headings[row]
        own_cos, own_sin = cos(heading), sin(heading)
        facts = []
        for x, y, turn, length, width in rectangles:
            c, s = cos(turn), sin(turn)
            # The centre of the vehicle in the frame of the rectangle, and the direction of its first ray there.
            dx, dy = own_x - (x - length / 2 * c), own_y - (y - length / 2 * s)
            facts.append(
                (
                    dx * c + dy * s, dy * c - dx * s, own_cos * c + own_sin * s, own_sin * c - own_cos * s,
                    length / 2, width / 2,
                )
            )  # fmt: skip
        table = np.array(facts)
        which, ray = self._candidates(table)
        along, across, first_cos, first_sin, half_length, half_width = table[which].T
        ray_cos, ray_sin = self._cos[ray], self._sin[ray]
        towards = first_cos * ray_cos - first_sin * ray_sin, first_sin * ray_cos + first_cos * ray_sin
        enters, leaves = np.zeros(len(ray)), np.full(len(ray), self.reach_m)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for offset, step, half in ((along, towards[0], half_length), (across, towards[1], half_width)):
                one, two = (-half - offset) / step, (half - offset) / step
                # A ray along an edge gives 0 / 0, which is within the rectangle for every distance.
                enters = np.fmax(enters, np.minimum(one, two))
                leaves = np.fmin(leaves, np.maximum(one, two))
        hit = enters <= leaves
        return np.array(owners)[which[hit]], ray[hit], enters[hit]

    def _candidates(self, table: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return pairs of a rectangle and a ray: at least all pairs in which the ray hits the rectangle."""
        along, across, first_cos, first_sin, half_length, half_width = table.T
        distance, radius = np.hypot(along, across), np.hypot(half_length, half_width)
        # The direction to the rectangle's centre, and half the angle of the circle around the rectangle.
        direction = np.arctan2(-across, -along) - np.arctan2(first_sin, first_cos)
        inside = distance <= radius
        half = np.where(inside, math.pi, np.arcsin(np.minimum(1.0, radius / np.where(inside, 1.0, distance))))
        is_near = distance - radius <= self.reach_m
        return self._rays_between(direction - half, direction + half, is_near)

    def _rays_between(
        self, begin: NDArray[np.float64], end: NDArray[np.float64], is_near: Mask
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return pairs of an index and a ray: the rays between two angles to the heading, and one more on each side.

        The angles are in rad. Only the indices in ``is_near`` have pairs.
        """
        step = math.tau / self._rays
        first, last = np.floor(begin / step).astype(np.intp), np.ceil(end / step).astype(np.intp)
        counts = np.where(is_near, np.minimum(last - first + 1, self._rays), 0)
        which = np.repeat(np.arange(len(first)), counts)
        offset = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        return which, (first[which] + offset) % self._rays
