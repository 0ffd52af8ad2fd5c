"""Parts of observations that follow from a scene alone: nearest actors, predictions, ranges, grids and pictures.

Sine and cosine come from the C library, because NumPy's results differ between processors in the last bit.
"""

from __future__ import annotations

import math
from math import cos, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.world import on_one_level, outlines

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.world import Scene

    Mask = NDArray[np.bool_]
    Line = NDArray[np.float64]


_NOISE_STREAM = 0x6C696461  # apart from what else is drawn of a trial's seed
_HALF_TURN_RAD = 3.1  # a little less, between the ends of an edge as seen from a point at it


class NearActor(NamedTuple):
    """An actor near the controlled vehicle."""

    squared: float  # squared distance of the centres, in m²
    row: int  # row of the actor in the scene
    x: float  # x of the centre of the rectangle, in m
    y: float  # y of the centre of the rectangle, in m


def wrapped(angle: float) -> float:
    """Return an angle in rad within -π and π."""
    return math.remainder(angle, math.tau)


def center_of(scene: Scene, row: int) -> tuple[float, float]:
    """Return the centre of an actor's rectangle."""
    x, y = scene.points[row]
    heading, half = scene.headings[row], scene.roster.actors[row].length / 2
    return x - half * cos(heading), y - half * sin(heading)


def _in_frame(scene: Scene, row: int, points: Line) -> Line:
    """Return points in the frame of a vehicle: the distance ahead and to the left of its centre."""
    own_x, own_y = center_of(scene, row)
    c, s = cos(scene.headings[row]), sin(scene.headings[row])
    dx, dy = points[:, 0] - own_x, points[:, 1] - own_y
    return np.stack((dx * c + dy * s, dy * c - dx * s), axis=1)


def nearest_actors(
    scene: Scene, row: int, *, hidden: frozenset[str], radius: float, limit: int | None = None
) -> list[NearActor]:
    """Return the actors that an agent sees, the nearest first.

    Actors on another level, such as a bridge above, are excluded, because they would look like obstacles. The actors in
    ``hidden`` are not seen by the agent. The radius is the largest distance of the centres, in m.
    """
    own_x, own_y = center_of(scene, row)
    actors = scene.roster.actors
    found = []
    for other, ((x, y), heading) in enumerate(zip(scene.points, scene.headings, strict=True)):
        half = actors[other].length / 2
        x, y = x - half * cos(heading), y - half * sin(heading)
        squared = (x - own_x) * (x - own_x) + (y - own_y) * (y - own_y)
        if squared <= radius * radius and other != row:
            found.append(NearActor(squared, other, x, y))
    if scene.heights:
        found = [one for one in found if on_one_level(scene, row, one.row)]
    if hidden:
        found = [one for one in found if actors[one.row].id not in hidden]
    found.sort()
    return found[:limit]


def predictions_of(
    scene: Scene, near: Sequence[NearActor], *, shape: tuple[int, ...], interval: float, reference_share: float = 0.0
) -> NDArray[np.float64]:
    """Return the positions of actors at constant velocity: the columns of the part ``predictions``.

    The times are ``interval`` s apart, and the first is one interval from now. The reference point is ahead of the
    centre by a share of the length.
    """
    found = np.zeros(shape)
    times = interval * np.arange(1, shape[1] + 1)
    for place, one in enumerate(near):
        heading, speed = scene.headings[one.row], scene.speeds[one.row]
        ahead = reference_share * scene.roster.actors[one.row].length
        found[place, :, 0] = one.x + ahead * cos(heading) + speed * cos(heading) * times
        found[place, :, 1] = one.y + ahead * sin(heading) + speed * sin(heading) * times
        found[place, :, 2:] = wrapped(heading), speed
    return found


def covariances_of(
    scene: Scene, near: Sequence[NearActor], settings: Mapping[str, float], *, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Return the covariances of the positions in `predictions_of`: the columns of ``prediction_covariance``.

    Let d be the standard deviation of an acceleration that is unknown, but constant. After the time t, the standard
    deviation of the position is d t² / 2, along and across the heading. The settings are ``interval``, ``along`` and
    ``across``.
    """
    found = np.zeros(shape)
    times = settings["interval"] * np.arange(1, shape[1] + 1)
    spread = times * times / 2.0
    along, across = ((settings[name] * spread) ** 2 for name in ("along", "across"))
    for place, one in enumerate(near):
        c, s = cos(scene.headings[one.row]), sin(scene.headings[one.row])
        found[place, :, 0] = c * c * along + s * s * across
        found[place, :, 1] = s * s * along + c * c * across
        found[place, :, 2] = c * s * (along - across)
    return found


def with_range_noise(
    ranges: NDArray[np.float64], settings: Mapping[str, float], *, seed: int, agent: str, step: int
) -> NDArray[np.float64]:
    """Return the values of ``lidar2d`` with their errors: the same ones for the same seed, agent and step."""
    if not settings["noise"]:
        return ranges
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_NOISE_STREAM, step, *agent.encode())))
    noisy = np.clip(ranges + rng.normal(0.0, settings["noise"], len(ranges)), 0.0, settings["range"])
    return np.where(ranges < settings["range"], noisy, ranges)


class ActorNumbers:
    """The numbers of the actors that an agent has seen in an episode, from 1 in the order in which it saw them."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    def of(self, scene: Scene, near: Sequence[NearActor], limit: int) -> NDArray[np.int64]:
        """Return the number of each actor in its row, shape (limit,): the part ``actor_ids``."""
        found = np.zeros(limit, np.int64)
        for row, one in enumerate(near):
            name = scene.roster.actors[one.row].id
            found[row] = self._numbers.setdefault(name, len(self._numbers) + 1)
        return found


def with_reference_point(
    arrays: Mapping[str, NDArray[np.generic]], columns: Mapping[str, Mapping[str, int]], share: float
) -> None:
    """Move ``x`` and ``y`` of the parts ``ego`` and ``actors`` from the centre to another point.

    The point is ahead of the centre by a share of the length.
    """
    for name in ("ego", "actors"):
        if name in arrays:
            index, rows = columns[name], arrays[name].reshape(-1, len(columns[name]))
            for row in rows:
                heading, ahead = float(row[index["heading"]]), share * float(row[index["length"]])
                row[index["x"]] += ahead * cos(heading)
                row[index["y"]] += ahead * sin(heading)


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
        starts, ends = _in_frame(scene, row, edges[:, :2]), _in_frame(scene, row, edges[:, 2:])
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


# Grids and pictures of the surroundings of a vehicle, computed from outlines and centre lines.

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
                ahead, left = _in_frame(scene, row, middle)[0].tolist()
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
            (np.array(self._shape) / 2 - 0.5 - _in_frame(scene, row, ends) / self._resolution_m).T
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
        lines = [(_in_frame(scene, row, line), width) for line, width in lanes]
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
