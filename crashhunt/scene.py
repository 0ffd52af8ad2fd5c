"""The state of the actors at one step, and what touched."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["Actor", "Contact", "Frame", "Lane", "Roster", "Scene", "corners"]


@dataclass(frozen=True, slots=True)
class Actor:
    """What does not change about an actor.

    Args:
        id: unique within the episode.
        kind: the simulator's word for it, such as SUMO's vehicle class (``passenger``, ``truck``).
        length: in m.
        width: in m.
    """

    id: str
    kind: str
    length: float
    width: float


@dataclass(frozen=True, slots=True)
class Contact:
    """A collision that the simulator itself reports.

    Args:
        collider: the actor that drove into the other.
        victim: the actor that was hit.
        kind: the simulator's word for it.
        lane: where.
        collider_speed: in m/s.
        victim_speed: in m/s.
    """

    collider: str
    victim: str
    kind: str
    lane: str
    collider_speed: float
    victim_speed: float


@dataclass(frozen=True, slots=True)
class Lane:
    """A lane of the map.

    Args:
        id: the simulator's name of it.
        width: in m.
        shape: its centre line, as (x, y) pairs in m.
    """

    id: str
    width: float
    shape: tuple[tuple[float, float], ...]


class Roster:
    """The actors of a scene, in the order of its rows. One roster serves every step until somebody enters or leaves.

    Args:
        actors: all actors.
    """

    def __init__(self, actors: tuple[Actor, ...]) -> None:
        self.actors = actors

    @cached_property
    def index(self) -> dict[str, int]:
        """Actor id to row."""
        return {actor.id: row for row, actor in enumerate(self.actors)}

    @cached_property
    def half_sizes(self) -> NDArray[np.float64]:
        """Half the length and half the width of each actor, shape (n, 2), in m."""
        return np.array([(actor.length / 2, actor.width / 2) for actor in self.actors]).reshape(-1, 2)

    @cached_property
    def reaches(self) -> list[float]:
        """How far the far corner of each outline is from the centre of its front bumper, in m."""
        return [math.hypot(actor.length, actor.width / 2) for actor in self.actors]

    @cached_property
    def touch_distance_squared(self) -> float:
        """No two outlines touch whose front bumpers are further apart than the root of this, in m²."""
        return (2 * max(self.reaches, default=0.0)) ** 2

    def __len__(self) -> int:
        return len(self.actors)


Frame = tuple[Roster, "NDArray[np.float64]"]
"""Successive scenes of the same actors, as bare columns: float64, shape (scenes, 4 n): x and y alternating, then all
headings, then all speeds."""


class Scene:
    """The actors at one instant.

    Args:
        time_s: simulation time, in s.
        roster: who the rows are.
        points: x and y of the centre of each front bumper, in m.
        headings: in rad, counter-clockwise from the x axis.
        speeds: in m/s.
        contacts: the collisions that the simulator reports for this step.
        off_road: the controlled vehicles that left the road in this step.
        lanes: the lane of each actor, or empty where this step did not look.

    Attributes:
        agent_lanes: the lane of each controlled vehicle, where the simulator says; not recorded.
        previous: the scene one step before; None at the start. It has no previous one itself, so that nothing piles up.
    """

    __slots__ = (
        "_neighbors",
        "agent_lanes",
        "contacts",
        "headings",
        "lanes",
        "off_road",
        "points",
        "previous",
        "roster",
        "speeds",
        "time_s",
    )

    def __init__(
        self,
        time_s: float,
        roster: Roster,
        points: Sequence[tuple[float, float]],
        headings: Sequence[float],
        speeds: Sequence[float],
        contacts: tuple[Contact, ...] = (),
        off_road: tuple[str, ...] = (),
        lanes: tuple[str, ...] = (),
    ) -> None:
        self.time_s = time_s
        self.roster = roster
        self.points = points
        self.headings = headings
        self.speeds = speeds
        self.contacts = contacts
        self.off_road = off_road
        self.lanes = lanes
        self.agent_lanes: dict[str, str] = {}
        self.previous: Scene | None = None
        self._neighbors: dict[int, list[tuple[float, int]]] = {}

    def follow(self, previous: Scene | None) -> None:
        """Say which scene was one step before."""
        if previous is self:
            return  # a simulator that hands out the same object again
        if previous is not None:
            previous.previous = None
        self.previous = previous

    @property
    def frame(self) -> Frame:
        """The scene as bare columns."""
        flat = [value for point in self.points for value in point]
        return self.roster, np.array([[*flat, *self.headings, *self.speeds]])

    @property
    def data(self) -> NDArray[np.float64]:
        """Shape (n, 4): x, y, heading, speed of every actor."""
        columns = np.empty((len(self.points), 4))
        columns[:, :2] = np.reshape(self.points, (-1, 2))
        columns[:, 2] = self.headings
        columns[:, 3] = self.speeds
        return columns

    @property
    def centers(self) -> NDArray[np.float64]:
        """The centre of each outline, shape (n, 2), in m."""
        columns = self.data
        forward = np.stack((np.cos(columns[:, 2]), np.sin(columns[:, 2])), axis=1)
        centers: NDArray[np.float64] = columns[:, :2] - self.roster.half_sizes[:, :1] * forward
        return centers

    def neighbors(self, row: int) -> list[tuple[float, int]]:
        """Return (squared distance of front bumpers in m², row) of all other actors, nearest first."""
        found = self._neighbors.get(row)
        if found is None:
            x, y = self.points[row]
            found = [((px - x) * (px - x) + (py - y) * (py - y), other) for other, (px, py) in enumerate(self.points)]
            del found[row]
            found.sort()
            self._neighbors[row] = found
        return found


def corners(scene: Scene, row: int) -> NDArray[np.float64]:
    """Return the outline of an actor: shape (4, 2), counter-clockwise from the front left, in m."""
    actor = scene.roster.actors[row]
    heading = scene.headings[row]
    forward = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-forward[1], forward[0]]) * (actor.width / 2)
    front = np.array(scene.points[row])
    back = front - actor.length * forward
    return np.array([front + left, back + left, back - left, front - left])
