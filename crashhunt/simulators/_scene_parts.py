"""Parts of observations that follow from a scene alone: nearest actors, predictions and their noise.

Sine and cosine come from the C library, because NumPy's results differ between processors in the last bit.
"""

from __future__ import annotations

import math
from math import cos, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.world import on_one_level

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.world import Scene

    Mask = NDArray[np.bool_]
    Line = NDArray[np.float64]


_NOISE_STREAM = 0x6C696461  # apart from what else is drawn of a trial's seed


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


def in_frame(scene: Scene, row: int, points: Line) -> Line:
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
