"""What the rules about fault look at: the last seconds of two actors, their lanes, and what happened in the traffic."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from crashhunt.world import Event, RightOfWay, Scene


__all__ = ["SAME_WAY", "Case", "LaneMap", "Way"]


_WINDOW_S = 4.0  # what was longer ago has not led to it
SAME_WAY = math.radians(45)
_LATELY_S = 1.5
_BEFORE_S = 1.0  # as long as the first half of a lane change takes
_SIDEWAYS_M = 0.3  # less is drifting
_STRAIGHT = math.radians(10)
_DRIFTS_M = 0.1
_ACROSS_M = 50.0  # from the line of a junction to where it ends; there are larger ones
_BESIDE_M = 1.2  # of the path that another one drives; less is in its way


@dataclass(frozen=True, slots=True)
class Way:
    """How an actor moved: before the crash, a row a scene.

    Args:
        id: of the actor.
        points: x and y of its front bumper, shape (n, 2), in m.
        headings: shape (n,), in rad.
        speeds: shape (n,), in m/s.
        length: in m.
        width: in m.
    """

    id: str
    points: NDArray[np.float64]
    headings: NDArray[np.float64]
    speeds: NDArray[np.float64]
    length: float
    width: float

    @property
    def centers(self) -> NDArray[np.float64]:
        """The centre of its outline, shape (n, 2), in m."""
        return self.points - self.length / 2 * np.stack((np.cos(self.headings), np.sin(self.headings)), axis=1)


@dataclass(frozen=True)
class Case:
    """A collision of two.

    Args:
        agent: the controlled vehicle.
        other: The collision partner.
        scenes: to the end of the step in which they touched.
        time_s: of the first contact.
        began_s: when the episode began.
        lanes: around the place.
        events: of the last seconds, each with its simulation time.
        right_of_way: of the map, where it says.
        lane: The lane of the agent at the end; empty if it is unknown.
    """

    agent: str
    other: str
    scenes: Sequence[Scene]
    time_s: float
    began_s: float
    lanes: LaneMap
    events: tuple[tuple[float, Event], ...] = ()
    right_of_way: RightOfWay | None = None
    lane: str = ""

    @cached_property
    def before(self) -> list[Scene]:
        """The last scenes before the contact in which both were there."""
        found = [
            scene
            for scene in self.scenes
            if self.time_s - _WINDOW_S - 1e-6 <= scene.time_s < self.time_s - 1e-6
            and self.agent in scene.roster.index
            and self.other in scene.roster.index
        ]
        return found or list(self.scenes[-1:])

    @cached_property
    def through(self) -> list[Scene]:
        """The same and the scene after the contact."""
        last = self.scenes[-1]
        there = self.agent in last.roster.index and self.other in last.roster.index
        return [*self.before, last] if there and last is not self.before[-1] else self.before

    @cached_property
    def times(self) -> NDArray[np.float64]:
        """Of the scenes before, in s before the contact; the first one is the longest ago."""
        return np.array([self.time_s - scene.time_s for scene in self.before])

    def way(self, actor: str) -> Way:
        """Return how one of them moved before the contact."""
        return self._ways[actor]

    @cached_property
    def _ways(self) -> dict[str, Way]:
        return {actor: self._way(actor) for actor in (self.agent, self.other)}

    def _way(self, actor: str) -> Way:
        rows = [(scene, scene.roster.index[actor]) for scene in self.before]
        scene, row = rows[-1]
        known = scene.roster.actors[row]
        return Way(
            id=actor,
            points=np.array([scene.points[row] for scene, row in rows]),
            headings=np.unwrap(np.array([scene.headings[row] for scene, row in rows])),
            speeds=np.array([scene.speeds[row] for scene, row in rows]),
            length=known.length,
            width=known.width,
        )

    def partner(self, actor: str) -> str:
        """Return the other one of the two."""
        return self.other if actor == self.agent else self.agent

    @cached_property
    def turn(self) -> float:
        """The angle between their headings just before, in rad, within 0 and pi."""
        own, other = self.way(self.agent), self.way(self.other)
        return abs(math.remainder(own.headings[-1] - other.headings[-1], math.tau))

    @property
    def same_way(self) -> bool:
        """Whether they drove the same way just before."""
        return self.turn < SAME_WAY

    def turned(self, since_s: float) -> float:
        """The greatest angle between their headings from so many s before the contact on, in rad."""
        own, other = self.way(self.agent), self.way(self.other)
        turns = np.abs((own.headings - other.headings + math.pi) % math.tau - math.pi)
        return float(turns[self.times <= since_s + 1e-6].max(initial=self.turn))

    def ahead_m(self, actor: str, back: int = -1) -> float:
        """How far an actor's centre is ahead of the other's, along the other's heading, in m."""
        own, other = self.way(actor), self.way(self.partner(actor))
        dx, dy = own.centers[back] - other.centers[back]
        return float(dx * math.cos(other.headings[back]) + dy * math.sin(other.headings[back]))

    def gap_m(self, actor: str, back: int = -1) -> float:
        """How far an actor's rear is ahead of the other's front, along the other's heading, in m; at that scene."""
        own, other = self.way(actor), self.way(self.partner(actor))
        return self.ahead_m(actor, back) - (own.length + other.length) / 2

    def aside_m(self, actor: str, back: int = -1) -> float:
        """How far an actor's centre is to the left of the other's, across the other's heading, in m."""
        own, other = self.way(actor), self.way(self.partner(actor))
        dx, dy = own.centers[back] - other.centers[back]
        return float(dy * math.cos(other.headings[back]) - dx * math.sin(other.headings[back]))

    @cached_property
    def follower(self) -> str:
        """The actor that was behind when they touched, on the same path; empty if there was none or side by side."""
        for leader in (self.agent, self.other):
            follower = self.partner(leader)
            own, its = self.way(leader), self.way(follower)
            touch = self.ahead_m(leader) > 0.6 * (own.length + its.length) / 2
            if self.same_way and touch and abs(self.aside_m(leader)) < 0.5 * (own.width + its.width) + 0.3:
                return follower
        return ""

    def in_its_way_s(self, leader: str) -> float:
        """For how long a leader had been in the follower's way, in s: the follower drove over where it had been."""
        lead, follow = self.way(leader), self.way(self.partner(leader))
        straight = np.array([math.cos(follow.headings[-1]), math.sin(follow.headings[-1])])
        path = np.vstack((follow.centers, follow.centers[-1] + straight * np.array([[5.0], [60.0]])))
        found = 0.0
        for back in range(len(self.before) - 1, -1, -1):
            if _distance(path[back:], lead.centers[back]) > _BESIDE_M:
                break
            found = float(self.times[back])
        return found

    def turns_off_s(self, leader: str) -> float | None:
        """How long before the contact a leader left the way of a follower that drove straight on; None if it did not.

        It had been in its way before, as long as is known.
        """
        lead, follow = self.way(leader), self.way(self.partner(leader))
        straight = bool(np.ptp(follow.headings) < _STRAIGHT) and self.ahead_m(leader) > 0
        before = abs(math.remainder(lead.headings[0] - follow.headings[0], math.tau))
        if not straight or before >= _STRAIGHT or self.turn < _STRAIGHT:
            return None
        asides = [abs(self.aside_m(leader, back)) for back in range(len(self.before))]
        left = next((back for back, aside in enumerate(asides) if aside > _BESIDE_M), len(asides))
        parting = all(after > before - _DRIFTS_M for before, after in pairwise(asides[max(0, left - 1) :]))
        return float(self.times[left - 1]) if left > 0 and parting else None

    def changed_s(self, actor: str) -> float | None:
        """How long before the contact an actor last came from one lane into the next, or was about to; None if not."""
        return self._changes[actor]

    @cached_property
    def _changes(self) -> dict[str, float | None]:
        return {actor: self._changed_s(actor) for actor in (self.agent, self.other)}

    def _changed_s(self, actor: str) -> float | None:
        left = self.lanes.left_sideways(self.before, actor)
        since = left or 0
        if self.lanes.left_sideways(self.through[since:], actor) or any(
            self.lanes.reaches_over(scenes[since:], actor) for scenes in (self.through, self.before)
        ):
            return float(self.times[-1])
        return None if left is None else float(self.times[left])

    def drifted(self, actor: str) -> bool:
        """Whether an actor was moving over the side of its lane when they touched, or had done so before."""
        return self.changed_s(actor) is not None

    def meets_sideways(self, actor: str) -> bool:
        """Whether an actor moved towards the other's side."""
        last = self.through[-1]
        own, its = (last.centers[last.roster.index[name]] for name in (actor, self.partner(actor)))
        heading = last.headings[last.roster.index[self.partner(actor)]]
        aside = (own[1] - its[1]) * math.cos(heading) - (own[0] - its[0]) * math.sin(heading)
        lately = [abs(self.aside_m(actor, back)) for back, time_s in enumerate(self.times) if time_s <= _LATELY_S]
        return max(lately, default=0.0) - abs(float(aside)) > _SIDEWAYS_M

    def was_off_path(self, actor: str, back: int) -> bool:
        """Whether an actor was off the path of the other actor just before a scene."""
        return any(
            abs(self.aside_m(actor, place)) > _BESIDE_M
            for place in range(back + 1)
            if self.times[place] - self.times[back] <= _BEFORE_S
        )

    def is_between_junctions(self, *actors: str) -> bool:
        """Whether all of them were on roads of SUMO's, in none of its junctions, in the last seconds."""
        lanes = {
            actor: [
                scene.lanes[scene.roster.index[actor]]
                for scene in self.scenes
                if scene.lanes and actor in scene.roster.index and scene.time_s >= self.time_s - _WINDOW_S
            ]
            for actor in actors
        }
        return all(
            bool(found) and not any(lane.startswith(":") or not lane for lane in found) for found in lanes.values()
        )

    def was_in_junction(self, actor: str, before_s: float) -> bool:
        """Whether an actor was in a junction of SUMO's so many s before the contact."""
        lanes = [
            scene.lanes[scene.roster.index[actor]]
            for scene in self.scenes
            if scene.lanes and actor in scene.roster.index and scene.time_s <= self.time_s - before_s
        ]
        return bool(lanes) and lanes[-1].startswith(":")

    def is_past(self, event: Event, time_s: float) -> bool:
        """Whether the actor of an event at a junction had already left the junction.

        Args:
            event: on the first of the junction's lanes.
            time_s: when.
        """
        after = [scene for scene in self.scenes if scene.time_s >= time_s and event.agent in scene.roster.index]
        points = [scene.points[scene.roster.index[event.agent]] for scene in after]
        if sum(math.dist(a, b) for a, b in pairwise(points)) > _ACROSS_M:
            return True
        lanes = [event.lane, *(scene.lanes[scene.roster.index[event.agent]] for scene in after if scene.lanes)]
        if event.agent == self.agent:
            lanes.append(self.lane)
        junctions = {lane.rsplit("_", 2)[0] for lane in lanes if lane.startswith(":")}
        return len(junctions) > 1

    def speed_mps(self, actor: str, before_s: float) -> float:
        """How fast an actor was so many s before the contact, or as long before as is known."""
        return float(self.way(actor).speeds[int(np.argmin(np.abs(self.times - before_s)))])

    def slowed(self, actor: str, since_s: float) -> float:
        """How hard an actor braked on average, from so many s before the contact on, in m/s²."""
        way = self.way(actor)
        back = int(np.argmin(np.abs(self.times - since_s)))
        took = float(self.times[back] - self.times[-1])
        return float(way.speeds[back] - way.speeds[-1]) / took if took > 0 else 0.0

    def hardest_braking(self, actor: str) -> float:
        """The greatest deceleration of an actor between two scenes, in m/s²."""
        way = self.way(actor)
        steps = -np.diff(self.times)
        return float((-np.diff(way.speeds) / np.maximum(steps, 1e-9)).max(initial=0.0))

    def links(self, actor: str) -> tuple[int, ...]:
        """The places of the ways across a junction that an actor may have been on."""
        assert self.right_of_way is not None
        lanes = [
            scene.lanes[scene.roster.index[actor]]
            for scene in self.scenes
            if scene.lanes and actor in scene.roster.index and scene.time_s >= self.time_s - 3 * _WINDOW_S
        ]
        if actor == self.agent and self.lane:
            lanes.append(self.lane)
        x, y = self.way(actor).points[-1].tolist()
        return self.right_of_way.places(tuple(lane for lane in lanes if lane), x, y)


def _distance(path: NDArray[np.float64], point: NDArray[np.float64]) -> float:
    start, leg = path[:-1], np.diff(path, axis=0)
    along = np.clip(np.einsum("ij,ij->i", point - start, leg) / np.maximum((leg**2).sum(axis=1), 1e-12), 0.0, 1.0)
    return float(np.hypot(*(point - start - along[:, None] * leg).T).min())


# Who changes lanes before a crash, and whether it is where lanes cross, as the map and the recording show it.

_NEAR_M = 60.0  # around where it happens; a town has thousands of lanes further away
_ALONG = math.radians(30)  # a vehicle within so much of a lane's direction drives along it
_CROSSES = math.radians(30)  # lanes that differ by more cross each other, where they lie over each other
_MOVED_M = 0.4  # sideways; less is drifting within a lane
_OVER_M = 0.1
_MOVES_M = 0.01  # sideways in a step; who moves less does not change lanes yet
_END_M = 0.5  # who is nearer to the end of a lane leaves it ahead, not sideways


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a point is, as seen from a lane."""

    aside_m: float  # to the left of the centre line
    along_m: float  # from the beginning
    heading: float  # of the lane there
    inside: bool  # between its beginning and its end


class _Lane:
    """The centre line of a lane."""

    def __init__(self, right: NDArray[np.float64], left: NDArray[np.float64]) -> None:
        self.points = (right + left) / 2
        self.half_width = float(np.hypot(*(left - right).T).mean()) / 2
        steps = np.diff(self.points, axis=0)
        self._lengths = np.maximum(np.hypot(*steps.T), 1e-9)
        self._directions = steps / self._lengths[:, None]
        self._starts = np.concatenate(([0.0], np.cumsum(self._lengths)))

    def place(self, point: NDArray[np.float64]) -> _Place:
        offset = point - self.points[:-1]
        along = np.clip(np.einsum("ij,ij->i", offset, self._directions), 0.0, self._lengths)
        away = np.hypot(*(offset - along[:, None] * self._directions).T)
        nearest = int(np.argmin(away))
        dx, dy = self._directions[nearest]
        aside = float(dx * offset[nearest, 1] - dy * offset[nearest, 0])
        driven = float(self._starts[nearest] + along[nearest])
        inside = _END_M < driven < self._starts[-1] - _END_M
        return _Place(
            aside_m=math.copysign(float(away[nearest]), aside),
            along_m=driven,
            heading=math.atan2(dy, dx),
            inside=inside,
        )


class LaneMap:
    """The lanes around a place.

    Args:
        borders: of each lane of the map, right and left, shape (n, 2) each, in m; as `crashhunt.recording.read_lanes`
            returns them.
        around: x and y of the place, in m.
    """

    def __init__(
        self, borders: Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]], around: tuple[float, float]
    ) -> None:
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
        """Whether lanes of different directions lie over each other there, in m."""
        spot = np.array(point)
        headings = [
            place.heading
            for lane in self._lanes
            if abs((place := lane.place(spot)).aside_m) < lane.half_width and place.inside
        ]
        return any(
            abs(math.remainder(one - two, math.tau)) > _CROSSES
            for number, one in enumerate(headings)
            for two in headings[:number]
        )

    def leaves_sideways(self, scenes: Sequence[Scene], actor: str) -> bool:
        """Whether an actor leaves a lane over its side, and continues next to it.

        An actor that drives over the end of its lane, or turns off, does not count.
        """
        return self.left_sideways(scenes, actor) is not None

    def left_sideways(self, scenes: Sequence[Scene], actor: str) -> int | None:
        """Return the place of the last scene before which an actor left a lane over its side; None if it did not."""
        poses = _poses(scenes, actor)
        return next(
            (
                place
                for (_, before), (place, after) in reversed(list(pairwise(poses)))
                if (lane := self._driven(before)) is not None and self._has_left(lane, after)
            ),
            None,
        )

    def change_began(self, scenes: Sequence[Scene], actor: str) -> int | None:
        """Return the place of the scene after which an actor began its last lane change; None where it made none.

        One that is not complete in the end counts as well.
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
        """Whether an actor at the end reaches into a neighbouring lane after moving towards it."""
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
            if not end.inside or abs(math.remainder(end.heading - heading, math.tau)) >= _ALONG:
                continue  # that lane has ended by now, or it turned off
            moved = (end.aside_m - lane.place(before[0]).aside_m) * (1 if end.aside_m > 0 else -1)
            if moved < _MOVED_M or abs(end.aside_m) + half_width - lane.half_width < _OVER_M:
                return False
            edge = point + math.copysign(half_width, end.aside_m) * np.array(
                [-math.sin(end.heading), math.cos(end.heading)]
            )
            return self._is_in_parallel_lane(lane, edge, end.heading)
        return False

    def _driven(self, pose: tuple[NDArray[np.float64], float]) -> _Lane | None:
        """The lane along which it drives: of several that lie over each other, the one whose middle is nearest."""
        point, heading = pose
        found = [
            (abs(place.aside_m), number, lane)
            for number, lane in enumerate(self._lanes)
            if abs((place := lane.place(point)).aside_m) <= lane.half_width
            and place.inside
            and abs(math.remainder(place.heading - heading, math.tau)) < _ALONG
        ]
        return min(found)[2] if found else None

    def _has_left(self, lane: _Lane, pose: tuple[NDArray[np.float64], float]) -> bool:
        point, heading = pose
        place = lane.place(point)
        if not place.inside or abs(place.aside_m) <= lane.half_width:
            return False
        if abs(math.remainder(place.heading - heading, math.tau)) >= _ALONG:
            return False  # it turns off
        return self._is_in_parallel_lane(lane, point, place.heading)

    def _is_in_parallel_lane(self, lane: _Lane, point: NDArray[np.float64], heading: float) -> bool:
        """Whether a point lies in another lane that leads the same way."""
        return any(
            abs(other.aside_m) <= near.half_width and abs(math.remainder(other.heading - heading, math.tau)) < _ALONG
            for near in self._lanes
            if near is not lane
            for other in (near.place(point),)
        )


def _poses(scenes: Sequence[Scene], actor: str) -> list[tuple[int, tuple[NDArray[np.float64], float]]]:
    """Where an actor was and how it was turned, each with the place of its scene."""
    return [
        (place, (np.array(scene.points[row]), scene.headings[row]))
        for place, scene in enumerate(scenes)
        if (row := scene.roster.index.get(actor)) is not None
    ]
