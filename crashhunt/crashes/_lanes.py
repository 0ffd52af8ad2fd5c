"""The lanes around the place of a crash: finds lane changes of the actors, and places where lanes cross."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from crashhunt.world import Scene


Borders: TypeAlias = "tuple[NDArray[np.float64], NDArray[np.float64]]"
"""The right and the left border of a lane, shape (n, 2) each, in m."""


_NEAR_M = 60.0  # around where it happens; a town has thousands of lanes further away
_MAX_DRIVING_ANGLE_RAD = math.radians(30)  # a vehicle within so much of a lane's direction drives along it
_OPPOSITE_RAD = math.radians(150)  # a vehicle at a larger angle to a lane drives against the lane's direction
_MIN_CROSSING_ANGLE_RAD = math.radians(
    30
)  # lines that differ by more cross each other, where lanes lie over each other
_MOVED_M = 0.4  # sideways; less is drifting within a lane
_MAX_JUMP_TURN_RAD = math.radians(10)  # within a step that is no turn
_OVER_M = 0.1
_MOVES_M = 0.01  # sideways in a step; who moves less does not change lanes yet
_ROUNDING_M = 1e-6  # far more than the error of a distance
_END_M = 0.5  # who is nearer to the end of a lane leaves it ahead, not sideways


@dataclass(frozen=True, slots=True)
class _Place:
    """The position of a point relative to a lane."""

    aside_m: float  # to the left of the centre line
    heading: float  # of the lane there
    inside: bool  # between its beginning and its end


class _Lane:
    """The centre line and the borders of a lane."""

    def __init__(self, right: NDArray[np.float64], left: NDArray[np.float64]) -> None:
        self.points = (right + left) / 2
        self.half_width = float(np.hypot(*(left - right).T).mean()) / 2
        steps = np.diff(self.points, axis=0)
        self._begins = self.points[:-1]
        self._lengths = np.maximum(np.hypot(*steps.T), 1e-9)
        self._directions = steps / self._lengths[:, None]
        self._starts = np.concatenate(([0.0], np.cumsum(self._lengths)))
        margin = self.half_width + _ROUNDING_M
        self._low_x, self._low_y = map(float, self.points.min(axis=0) - margin)
        self._high_x, self._high_y = map(float, self.points.max(axis=0) + margin)

    def may_hold(self, point: NDArray[np.float64]) -> bool:
        """Return whether a point is in the bounding box of the lane; a point outside of it is never in the lane."""
        x, y = map(float, point)
        return self._low_x <= x <= self._high_x and self._low_y <= y <= self._high_y

    def place(self, point: NDArray[np.float64]) -> _Place:
        offset = point - self._begins
        # `np.clip` and `np.argmin` take several times as long on the few legs of a lane.
        along = np.minimum(np.maximum(np.einsum("ij,ij->i", offset, self._directions), 0.0), self._lengths)
        away = np.hypot(*(offset - along[:, None] * self._directions).T)
        nearest = int(away.argmin())
        dx, dy = self._directions[nearest]
        aside = float(dx * offset[nearest, 1] - dy * offset[nearest, 0])
        driven = float(self._starts[nearest] + along[nearest])
        inside = _END_M < driven < self._starts[-1] - _END_M
        return _Place(
            aside_m=math.copysign(float(away[nearest]), aside),
            heading=math.atan2(dy, dx),
            inside=inside,
        )


class LaneMap:
    """The lanes around a place of the map.

    Args:
        borders: borders of each lane of the map, right and left, shape (n, 2) each, in m; as
            `crashhunt.recording.read_lanes` returns them.
        around: x and y of the place, in m.
    """

    def __init__(self, borders: Iterable[Borders], around: tuple[float, float]) -> None:
        center = np.array(around)
        self._lanes = []
        for right, left in borders:
            if len(right) < 2 or len(right) != len(left):
                continue
            low = np.minimum(right.min(axis=0), left.min(axis=0)) - _NEAR_M
            high = np.maximum(right.max(axis=0), left.max(axis=0)) + _NEAR_M
            if bool(np.all((low < center) & (center < high))):
                self._lanes.append(_Lane(right, left))

    def __bool__(self) -> bool:
        return bool(self._lanes)

    def cross(self, point: tuple[float, float]) -> bool:
        """Return whether lanes cross at a point; coordinates are in m. A lane that is used both ways does not cross."""
        spot = np.array(point)
        headings = [
            place.heading
            for lane in self._lanes
            if lane.may_hold(spot) and abs((place := lane.place(spot)).aside_m) < lane.half_width and place.inside
        ]
        return any(
            abs(math.remainder(one - two, math.pi)) > _MIN_CROSSING_ANGLE_RAD
            for number, one in enumerate(headings)
            for two in headings[:number]
        )

    def is_against(self, point: tuple[float, float], course: float) -> bool | None:
        """Return whether a point lies only in lanes of the opposite direction; None if other lanes lead elsewhere.

        The point is in m, and the course in rad.
        """
        spot = np.array(point)
        angles = [
            abs(math.remainder(place.heading - course, math.tau))
            for lane in self._lanes
            if lane.may_hold(spot) and abs((place := lane.place(spot)).aside_m) <= lane.half_width
        ]
        if any(angle < _MAX_DRIVING_ANGLE_RAD for angle in angles):
            return False
        return True if angles and min(angles) > _OPPOSITE_RAD else None

    def joins(self, point: NDArray[np.float64], course: float, other: NDArray[np.float64], other_course: float) -> bool:
        """Return whether a lane holds two points and leads in the given directions there; angles are in rad."""
        return any(
            abs(place.aside_m) <= lane.half_width and _is_along(place, course)
            for lane in self._lanes
            if lane.may_hold(point) and lane.may_hold(other)
            if abs((there := lane.place(other)).aside_m) <= lane.half_width and _is_along(there, other_course)
            for place in (lane.place(point),)
        )

    def leaves_sideways(self, scenes: Sequence[Scene], actor: str) -> bool:
        """Return whether an actor leaves a lane over its side border, and then drives next to the lane.

        An actor that drives over the end of its lane, or turns off, does not count.
        """
        return self.left_sideways(scenes, actor) is not None

    def left_sideways(self, scenes: Sequence[Scene], actor: str) -> int | None:
        """Return the index of the last scene before an actor left a lane over its side; None if it did not."""
        poses = _poses(scenes, actor)
        return next(
            (
                place
                for (_, before), (place, after) in reversed(list(pairwise(poses)))
                if (lane := self._driven(before)) is not None and self._has_left(lane, before, after)
            ),
            None,
        )

    def change_began(self, scenes: Sequence[Scene], actor: str) -> int | None:
        """Return the index of the scene after which an actor began its last lane change; None if it made none.

        A lane change that is incomplete in the last scene counts as well.
        """
        poses = _poses(scenes, actor)
        left = self.left_sideways(scenes, actor)
        if left is None and not self.reaches_over(scenes, actor):
            return None
        places = [place for place, _ in poses]
        end = places.index(left) if left is not None else len(places) - 1
        lane = next((found for _, pose in reversed(poses[:end]) if (found := self._driven(pose)) is not None), None)
        if lane is None:
            return None
        asides = [lane.place(point).aside_m for _, (point, _) in poses[: end + 1]]
        way = math.copysign(1.0, asides[end])
        begin = end
        while begin > 0 and (asides[begin] - asides[begin - 1]) * way > _MOVES_M:
            begin -= 1
        return places[begin]

    def reaches_over(self, scenes: Sequence[Scene], actor: str) -> bool:
        """Return whether, in the last scene, an actor reaches into a neighbouring lane after moving towards it."""
        poses = _poses(scenes, actor)
        if not poses:
            return False
        last_place, (point, heading) = poses[-1]
        row = scenes[last_place].roster.index[actor]
        half_width = scenes[last_place].roster.actors[row].width / 2
        for _, before in poses:
            lane = self._driven(before)
            if lane is None:
                continue
            end = lane.place(point)
            if not end.inside or abs(math.remainder(end.heading - heading, math.tau)) >= _MAX_DRIVING_ANGLE_RAD:
                continue  # that lane has ended by now, or it turned off
            moved = (end.aside_m - lane.place(before[0]).aside_m) * (1 if end.aside_m > 0 else -1)
            if moved < _MOVED_M or abs(end.aside_m) + half_width - lane.half_width < _OVER_M:
                return False
            edge = point + math.copysign(half_width, end.aside_m) * np.array(
                [-math.sin(end.heading), math.cos(end.heading)]
            )
            return self._is_in_parallel_lane(lane, edge, end.heading)
        return False

    def is_over_side(self, pose: tuple[NDArray[np.float64], float], half_width: float) -> bool:
        """Return whether an actor reaches over the side of the lane on which it drives, or into which it reaches.

        The pose is the centre, in m, and the heading, in rad. The half width is in m.
        """
        point, heading = pose
        lane = self._driven(pose)
        if lane is None:  # its centre is next to its lane
            places = ((near.place(point), near.half_width) for near in self._lanes)
            over = (abs(place.aside_m) - own for place, own in places if place.inside and _is_along(place, heading))
            return min(over, default=half_width) < half_width
        return abs(lane.place(point).aside_m) + half_width - lane.half_width >= _OVER_M

    def reached_since(self, scenes: Sequence[Scene], actor: str, pose: tuple[NDArray[np.float64], float]) -> int | None:
        """Return the index of the scene since which the outline of an actor has always reached into a lane.

        Args:
            scenes: scenes up to the present.
            actor: identifier of the actor.
            pose: a point, in m, and a heading, in rad, on this lane.
        """
        lane, found = self._driven(pose), None
        for index in range(len(scenes) - 1, -1, -1):
            row = scenes[index].roster.index.get(actor)
            if lane is None or row is None:
                break
            known, place = scenes[index].roster.actors[row], lane.place(scenes[index].centers[row])
            angle = scenes[index].headings[row] - place.heading
            reach = (known.length * abs(math.sin(angle)) + known.width * abs(math.cos(angle))) / 2
            if not place.inside or abs(place.aside_m) - reach > lane.half_width - _OVER_M:
                break
            found = index
        return found

    def _driven(self, pose: tuple[NDArray[np.float64], float]) -> _Lane | None:
        """Return the lane on which an actor drives; of overlapping lanes, the lane with the nearest centre line.

        An actor that overtakes on the opposite lane drives on this lane, if no lane there leads in its direction.
        """
        point, heading = pose
        found = [
            (not _is_along(place, heading), abs(place.aside_m), number, lane)
            for number, lane in enumerate(self._lanes)
            if lane.may_hold(point)  # a box is compared in a fiftieth of the time, and most lanes are elsewhere
            and abs((place := lane.place(point)).aside_m) <= lane.half_width
            and place.inside
            and (_is_along(place, heading) or _is_along(place, heading + math.pi))
        ]
        return min(found)[3] if found else None

    def _has_left(
        self, lane: _Lane, before: tuple[NDArray[np.float64], float], after: tuple[NDArray[np.float64], float]
    ) -> bool:
        point, heading = after
        place = lane.place(point)
        if not place.inside:
            return self._has_jumped(lane, before, after)
        if abs(place.aside_m) <= lane.half_width:
            return False
        if _is_along(place, heading) and self._is_in_parallel_lane(lane, point, heading):
            return True
        dx, dy = point - before[0]
        if dx * math.cos(heading) + dy * math.sin(heading) <= 0:
            return False  # it reverses, which leads over the middle of the road, too
        if _is_along(place, heading):
            return self.is_against((float(point[0]), float(point[1])), heading) is True
        # It has overtaken on the opposite lane and returns; otherwise, it turns off.
        return _is_along(place, heading + math.pi) and self._is_in_parallel_lane(lane, point, heading)

    def _has_jumped(
        self, lane: _Lane, before: tuple[NDArray[np.float64], float], after: tuple[NDArray[np.float64], float]
    ) -> bool:
        """Return whether an actor changed lanes in the step in which it drove over the end of its lane.

        Straight ahead, another lane leads on; otherwise the road shifts there.
        """
        turn = math.remainder(after[1] - before[1], math.tau)
        heading = before[1] + turn / 2  # a chord of an arc has no sideways part
        way = np.array([math.cos(heading), math.sin(heading)])
        move = after[0] - before[0]
        across = abs(float(move[1] * way[0] - move[0] * way[1]))
        if abs(turn) >= _MAX_JUMP_TURN_RAD or across <= lane.half_width:
            return False
        return self._is_in_parallel_lane(lane, before[0] + float(move @ way) * way, heading)

    def _is_in_parallel_lane(self, lane: _Lane, point: NDArray[np.float64], heading: float) -> bool:
        """Return whether a point lies in another lane that leads in the same direction."""
        return any(
            abs(place.aside_m) <= near.half_width and _is_along(place, heading)
            for near in self._lanes
            if near is not lane and near.may_hold(point)
            for place in (near.place(point),)
        )


def _is_along(place: _Place, heading: float) -> bool:
    return abs(math.remainder(place.heading - heading, math.tau)) < _MAX_DRIVING_ANGLE_RAD


def _poses(scenes: Sequence[Scene], actor: str) -> list[tuple[int, tuple[NDArray[np.float64], float]]]:
    """Return the poses (position and heading) of an actor, each with the index of its scene."""
    return [
        (place, (np.array(scene.points[row]), scene.headings[row]))
        for place, scene in enumerate(scenes)
        if (row := scene.roster.index.get(actor)) is not None
    ]
