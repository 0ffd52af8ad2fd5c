"""The seconds before a contact: the motion of the two actors, their distance, their lanes and junctions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, takewhile
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.text import format_time
from crashhunt.crashes._trails import BESIDE_M
from crashhunt.world import is_person, poses_between

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.crashes._lanes import LaneMap
    from crashhunt.world import Event, RightOfWay, Scene

_WINDOW_S = 4.0  # earlier movements have not led to the contact
_SAMPLE_S = 0.1  # as short as the usual steps of simulators
_BEFORE_S = 1.0  # as long as the first half of a lane change takes
_ACROSS_M = 50.0  # from the line of a junction to where it ends; there are larger ones


@dataclass(frozen=True)
class ApproachPath:
    """The motion of an actor before the contact, with one row for each of the times of an `Approach`."""

    id: str  # identifier of the actor
    points: NDArray[np.float64]  # x and y of its front bumper, shape (n, 2), in m
    headings: NDArray[np.float64]  # headings of the actor, shape (n,), in rad
    speeds: NDArray[np.float64]  # speeds of the actor, shape (n,), in m/s
    length: float  # length of the actor, in m
    width: float  # width of the actor, in m

    @cached_property
    def centers(self) -> NDArray[np.float64]:
        """The centre of the actor's outline, shape (n, 2), in m."""
        return self.points - self.length / 2 * np.stack((np.cos(self.headings), np.sin(self.headings)), axis=1)


@dataclass(frozen=True)
class Approach:
    """The seconds before the contact of an agent with another actor."""

    agent: str  # identifier of the controlled vehicle
    other: str  # identifier of the collision partner
    scenes: Sequence[Scene]  # scenes up to the end of the step in which the actors touched
    time_s: float  # simulation time of the first contact
    began_s: float  # simulation time at which the episode began
    lanes: LaneMap  # lanes around the place of the contact
    events: tuple[tuple[float, Event], ...] = ()  # events of the last seconds, each with its simulation time
    right_of_way: RightOfWay | None = None  # right of way of the map; None if the map has none
    lane: str = ""  # the lane of the agent at the contact; empty if it is unknown
    swept: bool = True  # whether actors move continuously between scenes and change lanes instantly, as in `Scene`

    @cached_property
    def before(self) -> list[Scene]:
        """The last scenes before the contact with both actors; they cover at least 4 s if the recording is that long.

        The result begins with the latest scene that is at least 4 s before the contact. Otherwise, the time of the
        contact within a long step would decide how much time the fault rules examine.
        """
        found: list[Scene] = []
        for scene in reversed(self.scenes):
            if scene.time_s >= self.time_s - 1e-6:
                continue
            index = scene.roster.index
            if self.agent not in index or self.other not in index:
                if found:
                    break
                continue
            found.append(scene)
            if scene.time_s <= self.time_s - _WINDOW_S + 1e-6:
                break
        return found[::-1] or list(self.scenes[-1:])

    @cached_property
    def through(self) -> list[Scene]:
        """The scenes before the contact and the first scene after it."""
        last = self.scenes[-1]
        there = self.agent in last.roster.index and self.other in last.roster.index
        return [*self.before, last] if there and last.time_s != self.before[-1].time_s else self.before

    @cached_property
    def times(self) -> NDArray[np.float64]:
        """The times at which the movement before the contact is sampled, in s before the contact, the earliest first.

        The times are relative to the contact, not to the scenes. Otherwise the results of the rules would depend on the
        time of the contact within a long step.
        """
        first, last = (self.time_s - self.before[place].time_s for place in (0, -1))
        first = min(first, max(_WINDOW_S, last))
        samples = first - _SAMPLE_S * np.arange(math.ceil((first - last) / _SAMPLE_S - 1e-6))
        return np.append(samples, last)

    def ago(self, before_s: float) -> str:
        """Return a time in s before the contact as text, relative to the end of the step, as all texts on a crash."""
        last_s = self.scenes[-1].time_s
        step_s = last_s - self.scenes[-2].time_s if len(self.scenes) > 1 else 0.1
        return f"{format_time(before_s + last_s - self.time_s, step_s)} before"

    def way(self, actor: str) -> ApproachPath:
        """Return how an actor moved before the contact."""
        return self._ways[actor]

    @cached_property
    def _ways(self) -> dict[str, ApproachPath]:
        return {actor: self._way(actor) for actor in (self.agent, self.other)}

    def _way(self, actor: str) -> ApproachPath:
        rows = [(scene, scene.roster.index[actor]) for scene in self.before]
        scene, row = rows[-1]
        known = scene.roster.actors[row]
        poses = [(*scene.points[row], scene.headings[row], known.length, known.width) for scene, row in rows]
        at = np.array([self.time_s - scene.time_s for scene, _ in rows])
        bends = self.swept and not is_person(actor)
        found = []
        for time_s in self.times:
            place = max(0, min(len(rows) - 2, int(np.searchsorted(-at, -time_s, side="right")) - 1))
            after = min(place + 1, len(rows) - 1)
            share = (at[place] - time_s) / (at[place] - at[after]) if after > place else 1.0
            (pose,) = poses_between(poses[place], poses[after], (share,), bends=bends)
            found.append(pose)
        return ApproachPath(
            id=actor,
            points=np.array([pose[:2] for pose in found]),
            headings=np.unwrap(np.array([pose[2] for pose in found])),
            speeds=np.interp(-self.times, -at, [scene.speeds[row] for scene, row in rows]),
            length=known.length,
            width=known.width,
        )

    def partner(self, actor: str) -> str:
        """Return the identifier of the other actor in the contact."""
        return self.other if actor == self.agent else self.agent

    def ahead_m(self, actor: str, back: int = -1) -> float:
        """Return how far an actor's centre is ahead of the other's centre, along the other's heading, in m."""
        own, other = self.way(actor), self.way(self.partner(actor))
        dx, dy = own.centers[back] - other.centers[back]
        return float(dx * math.cos(other.headings[back]) + dy * math.sin(other.headings[back]))

    def gap_m(self, actor: str, back: int) -> float:
        """Return the distance from the other actor's front to an actor's rear, along the other's heading, in m."""
        own, other = self.way(actor), self.way(self.partner(actor))
        return self.ahead_m(actor, back) - (own.length + other.length) / 2

    def aside_m(self, actor: str, back: int = -1) -> float:
        """Return how far an actor's centre is to the left of the other's centre, across the other's heading, in m."""
        own, other = self.way(actor), self.way(self.partner(actor))
        dx, dy = own.centers[back] - other.centers[back]
        return float(dy * math.cos(other.headings[back]) - dx * math.sin(other.headings[back]))

    def was_off_path(self, actor: str, back: int) -> bool:
        """Return whether an actor was off the path of the other actor just before the time with the index ``back``."""
        return any(
            abs(self.aside_m(actor, place)) > BESIDE_M
            for place in range(back + 1)
            if self.times[place] - self.times[back] <= _BEFORE_S
        )

    def is_between_junctions(self, *actors: str) -> bool:
        """Return whether all given actors were on SUMO roads, outside junctions, in the seconds before the contact."""
        lanes = [self._lanes_since(actor, self.time_s - _WINDOW_S) for actor in actors]
        return all(bool(found) and not any(lane.startswith(":") or not lane for lane in found) for found in lanes)

    def _lanes_since(self, actor: str, time_s: float) -> list[str]:
        """Return the lanes of an actor in SUMO, in the scenes since a time that contain it."""
        return [
            scene.lanes[scene.roster.index[actor]]
            for scene in scenes_since(self.scenes, time_s)
            if scene.lanes and actor in scene.roster.index
        ]

    def was_in_junction(self, actor: str, before_s: float) -> bool:
        """Return whether an actor was inside a junction of SUMO at the given time before the contact."""
        lanes = (
            scene.lanes[scene.roster.index[actor]]
            for scene in reversed(self.scenes)
            if scene.lanes and actor in scene.roster.index and scene.time_s <= self.time_s - before_s
        )
        return next(lanes, "").startswith(":")

    def is_past(self, event: Event, time_s: float) -> bool:
        """Return whether the actor of an event at a junction had already left the junction.

        Args:
            event: the event, recorded on the first lane of the junction.
            time_s: simulation time for which the answer holds.
        """
        after = [scene for scene in scenes_since(self.scenes, time_s) if event.agent in scene.roster.index]
        points = [scene.points[scene.roster.index[event.agent]] for scene in after]
        driven = sum(math.dist(a, b) for a, b in pairwise(points))
        # In a long step, its front may have passed the junction when the event was found, but not its back.
        is_behind = bool(event.lane) and not event.lane.startswith(":")
        if driven > (self.way(event.agent).length if is_behind else _ACROSS_M):
            return True
        lanes = [event.lane, *(scene.lanes[scene.roster.index[event.agent]] for scene in after if scene.lanes)]
        if event.agent == self.agent:
            lanes.append(self.lane)
        junctions = {lane.rsplit("_", 2)[0] for lane in lanes if lane.startswith(":")}
        return len(junctions) > 1

    def speed_mps(self, actor: str, before_s: float) -> float:
        """Return an actor's speed the given time before the contact, or at its first recorded step if that is later."""
        return float(self.way(actor).speeds[int(np.argmin(np.abs(self.times - before_s)))])

    def slowed(self, actor: str, since_s: float) -> float:
        """Return the average deceleration of an actor in the last seconds before the contact, in m/s²."""
        way = self.way(actor)
        back = int(np.argmin(np.abs(self.times - since_s)))
        took = float(self.times[back] - self.times[-1])
        return float(way.speeds[back] - way.speeds[-1]) / took if took > 0 else 0.0

    def hardest_braking(self, actor: str) -> float:
        """Return the greatest deceleration of an actor between two scenes, in m/s²."""
        way = self.way(actor)
        steps = -np.diff(self.times)
        return float((-np.diff(way.speeds) / np.maximum(steps, 1e-9)).max(initial=0.0))

    def links(self, actor: str) -> tuple[int, ...]:
        """Return the indices of the connections across a junction that an actor may have used."""
        assert self.right_of_way is not None
        lanes = self._lanes_since(actor, self.time_s - 3 * _WINDOW_S)
        if actor == self.agent and self.lane:
            lanes.append(self.lane)
        x, y = self.way(actor).points[-1].tolist()
        return self.right_of_way.places(tuple(lane for lane in lanes if lane), x, y)


def scenes_since(scenes: Sequence[Scene], time_s: float) -> list[Scene]:
    """Return the last of the given scenes, without the scenes before a time."""
    return [*takewhile(lambda scene: scene.time_s >= time_s, reversed(scenes))][::-1]
