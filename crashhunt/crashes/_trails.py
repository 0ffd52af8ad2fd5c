"""The paths of two actors before their contact, and the part that one drove behind the other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.crashes._lanes import LaneMap


BESIDE_M = 1.2  # of the path that another one drives; less is in its way
TRAIL_STEP_M = 0.25  # between two poses of a trail
_SHARED_M = 4.0  # of its path, a vehicle drives along the path of another one to count as on the same way
_SHARED_ASIDE_M = 5.0  # a vehicle on a neighbouring lane drives the same way
_MAX_SHARED_TURN_RAD = math.radians(35)  # between two paths at the same place
_REAR_M = 1.5  # from the rear of a vehicle, along its path: further ahead, its side is touched


@dataclass(frozen=True)
class Trail:
    """The path of an actor's front up to the contact, the earliest pose first."""

    points: NDArray[np.float64]  # x and y of the front bumper, shape (n, 2), in m
    headings: NDArray[np.float64]  # headings of the actor, shape (n,), in rad
    length: float  # length of the actor, in m

    @cached_property
    def to_go(self) -> NDArray[np.float64]:
        """How far the actor drove from each point to the last one, shape (n,), in m."""
        legs = np.hypot(*np.diff(self.points, axis=0).T)
        return np.append(np.cumsum(legs[::-1])[::-1], 0.0)

    @cached_property
    def courses(self) -> NDArray[np.float64]:
        """The direction of motion at each point, shape (n,), in rad; an instantaneous lane change does not count."""
        legs = np.diff(self.points, axis=0)
        along: NDArray[np.float64] = np.arctan2(legs[:, 1], legs[:, 0])
        jumps = np.hypot(*legs.T) > 2 * TRAIL_STEP_M
        along[jumps] = self.headings[1:][jumps]
        return np.append(along, along[-1:])

    @property
    def with_rear(self) -> Trail:
        """The path with the place of the actor's rear at its beginning."""
        rear = self.points[0] - self.length * np.array([math.cos(self.headings[0]), math.sin(self.headings[0])])
        parts = np.linspace(0.0, 1.0, math.ceil(self.length / TRAIL_STEP_M), endpoint=False)[:, None]
        points = np.vstack((rear + parts * (self.points[0] - rear), self.points))
        return Trail(points, np.append(np.full(len(parts), self.headings[0]), self.headings), self.length)

    def index(self, to_go_m: float) -> int | None:
        """Return the index of the last point from which the actor drove at least so far; None if it did not."""
        found = np.flatnonzero(self.to_go >= to_go_m)
        return int(found[-1]) if len(found) else None

    def centers(self, driven_m: float) -> NDArray[np.float64]:
        """Return the centres of the actor on its last metres, shape (n, 2)."""
        directions = np.stack((np.cos(self.headings), np.sin(self.headings)), axis=1)
        return (self.points - self.length / 2 * directions)[self.to_go <= driven_m]

    def shared_with(self, its: Trail, lanes: LaneMap) -> SharedPath | None:
        """Return how the end of this path leads along the path that another actor had driven before, or None.

        Paths that cross, merge or part within the last metres do not count, nor do those of distant vehicles.
        """
        first = self.index(_SHARED_M)
        if first is None:
            return None
        path = its.with_rear
        reach_m = its.length * math.pi / 2 + _REAR_M  # in a bend, the front has driven further than the body is long
        aside = behind = 0.0
        for place in range(first, len(self.points)):
            start = int(np.argmax(path.to_go <= reach_m + self.to_go[place]))  # on a ring, it came past here before
            away = np.hypot(*(path.points[start:] - self.points[place]).T)
            nearest = start + int(np.argmin(away))
            aside, behind = float(away[nearest - start]), float(path.to_go[nearest])
            if nearest < len(path.points) - len(its.points):
                # The recording begins when the other actor was here, or it has always stood: the lane must decide.
                ends = self.points[place], float(self.courses[place]), its.centers(0.0)[-1], float(its.headings[-1])
                if not lanes.joins(*ends):
                    return None
                continue
            turn = math.remainder(float(self.courses[place] - path.courses[nearest]), math.tau)
            if aside > _SHARED_ASIDE_M or abs(turn) > _MAX_SHARED_TURN_RAD:
                return None
        return SharedPath(aside, behind, its.length) if 0 < behind < reach_m else None


@dataclass(frozen=True, slots=True)
class SharedPath:
    """The end of an actor's path, which leads along the path that another actor had driven before."""

    aside_m: float  # distance of the actor's front from the path of the other actor at the contact, in m
    behind_m: float  # how far the front of the actor is behind the front of the other one, along the path, in m
    length: float  # length of the other actor, in m

    @property
    def meets_rear(self) -> bool:
        """Whether the actor was on the other's path and reached its rear."""
        return self.aside_m <= BESIDE_M and self.behind_m >= self.length - _REAR_M
