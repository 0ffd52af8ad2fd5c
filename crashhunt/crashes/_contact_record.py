"""The record of a contact: the sides that touched, its manner, and the lane changes that led to it.

Everything that describes a collision reads this record: its type, the fault, the lane, the speeds and the text. The
contact is computed by `crashhunt.world.contact_at`, from which the oracles also determine the role of the agent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base import layout
from crashhunt.crashes._before_contact import Approach, scenes_since
from crashhunt.crashes._lanes import LaneMap
from crashhunt.crashes._trails import BESIDE_M, TRAIL_STEP_M, SharedPath, Trail
from crashhunt.world import (
    MAX_CONTACT_GAP_M,
    OBSTACLE_KINDS,
    STANDS_MPS,
    contact_at,
    is_person,
    lane_jump,
    poses_between,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.crashes import Bundle
    from crashhunt.recording import Recording
    from crashhunt.trial import Collision
    from crashhunt.world import Scene, Touch


_EVENTS_S = 10.0  # before the contact
SAME_WAY = math.radians(45)
_MIN_BEND_TURN_RAD = math.radians(20)  # between two vehicles that touch in one lane: less is no tight bend
_OPPOSITE_RAD = math.radians(135)
_UNSWEPT_CONTACT = "crashed"  # highway-env's collisions: its vehicles drive through several collision checks in a step
_LATELY_S = 1.5
_STOOD_S = 1.0  # an actor that stood for less time may only have paused
_SIDEWAYS_M = 0.3  # less is drifting
_MAX_STRAIGHT_TURN_RAD = math.radians(10)
_DRIFTS_M = 0.1
_OVER_M = 0.1  # less is a rounding error of the map
_BEND_M = 0.4  # with it, an actor on the neighbouring lane is still not in the way: its centre is more than 2 m away
_MAX_ASIDE_M, _MIN_OVERLAP_M = 1.5, 0.3  # across the lane, of a follower that does not drive in its middle
_TRAIL_M = 40.0  # of the path before the contact; longer than any vehicle and the part that a follower must share
_MIN_LEG_M = 0.01  # a shorter leg of a trail has no direction
_FRONTS_M = 2.0  # between two fronts that met, each with the middle or with a corner
_MIN_COURSE_M = 0.5  # driven, to know in which direction the front of a vehicle moves


@dataclass(frozen=True)
class ContactRecord(Approach):
    """The contact of an agent with another actor."""

    reported: Collision | None = None  # the collision that the result of the trial contains; None if it is unknown

    def _at_contact(self, actor: str) -> tuple[NDArray[np.float64], float]:
        """Return the centre of an actor at the contact, in m, and its heading, in rad."""
        known = self.way(actor)
        scenes = self.through[-2:]
        rows = [scene.roster.index[actor] for scene in scenes]
        start, end = (
            (*scenes[place].points[rows[place]], scenes[place].headings[rows[place]], known.length, known.width)
            for place in (0, -1)
        )
        bends = self.swept and not is_person(actor)
        ((x, y, heading, length, _),) = poses_between(start, end, (self.touch.share,), bends=bends)
        return np.array([x - length / 2 * math.cos(heading), y - length / 2 * math.sin(heading)]), heading

    @cached_property
    def _bend_m(self) -> float:
        """The greatest distance between a bend and its chord from one scene to the next, in m.

        Between two scenes, the path in a bend is an estimate. The error of the estimate is a fraction of this distance.
        """
        found = 0.0
        for before, after in pairwise(self.through):
            for actor in (self.agent, self.other):
                was, row = before.roster.index[actor], after.roster.index[actor]
                turn = abs(math.remainder(after.headings[row] - before.headings[was], math.tau))
                found = max(found, math.dist(before.points[was], after.points[row]) * turn / 8)
        return found

    @cached_property
    def touch(self) -> Touch:
        """The contact of the two outlines, with the agent as the first actor."""
        last = self.scenes[-1]
        previous = self.scenes[-2] if len(self.scenes) > 1 else None
        index = last.roster.index
        pair = index[self.agent], index[self.other]
        return contact_at(previous, last, *pair, swept=self.swept, grazing=self.reported is not None)

    @property
    def collider(self) -> str:
        """The identifier of the actor that drove into the other actor."""
        return self.agent if self.touch.drives_into else self.other

    @cached_property
    def is_disputed(self) -> bool:
        """Whether the scenes contradict the collision that the simulator reported.

        In that case no fault rule can decide.

        The contradiction occurs in two cases. In the first, the outlines did not touch, and their positions make the
        other actor the collider. In the second, the simulator detected a collision within a step, and the next scene
        already shows the consequences. Examples of consequences are another collider, or a slower vehicle that drives
        into the back of a faster vehicle.
        """
        hit = self.reported
        if hit is None:
            return False
        if hit.collider != self.collider and (not self.swept or self.touch.gap_m >= MAX_CONTACT_GAP_M):
            return True
        follower = "" if self.swept else self._follower
        return bool(follower) and self.speed_at_contact(follower) < self.speed_at_contact(self.partner(follower))

    @property
    def jumpers(self) -> tuple[str, ...]:
        """The actors whose instantaneous lane change caused the contact."""
        jumps = ((self.agent, self.touch.jumps), (self.other, self.touch.other_jumps))
        return tuple(actor for actor, jumped in jumps if jumped)

    def speed_at_contact(self, actor: str) -> float:
        """Return the speed of an actor at the contact, in m/s.

        highway-env slows crashed vehicles down within the step of the crash, so the next scene has lower speeds.
        """
        hit = self.reported
        if not self.swept and hit is not None:
            reported = hit.collider_speed if actor == hit.collider else hit.victim_speed
            if math.isfinite(reported):
                return reported
        return self.touch.speed if actor == self.agent else self.touch.other_speed

    @property
    def manner(self) -> str:
        """The manner of the collision, as in `Signature`."""
        if is_person(self.agent) or is_person(self.other):
            return "pedestrian"
        if self.is_disputed:
            return ""
        if self.has_obstacle:
            return "obstacle"
        if self.same_way:
            return "rear end" if self.follower else "side swipe"
        if self.is_oncoming:
            return "standing vehicle" if self.standing else "head-on"
        return "crossing from the right" if self.touch.turn > 0 else "crossing from the left"

    @property
    def has_obstacle(self) -> bool:
        """Whether one of the actors is an obstacle, which has neither a front nor a direction."""
        roster = self.before[-1].roster
        return any(roster.actors[roster.index[one]].kind in OBSTACLE_KINDS for one in (self.agent, self.other))

    @cached_property
    def standing(self) -> str:
        """The actor that had stood still for at least 1 s before the contact; empty if both or none had.

        A vehicle that stands is not an oncoming vehicle: German accident statistics count the two apart.
        """
        stood = [one for one in (self.agent, self.other) if self.stood_s(one) >= _STOOD_S]
        return stood[0] if len(stood) == 1 else ""

    @property
    def turn(self) -> float:
        """The angle between the headings of both actors at the contact, in rad, from 0 to pi."""
        return abs(self.touch.turn)

    @cached_property
    def same_way(self) -> bool:
        """Whether both actors drove in the same direction: by their headings, or one along the path of the other.

        In a tight bend, the headings of two vehicles of the same lane may differ by any angle.
        """
        return self.turn < SAME_WAY or any(self._shared_paths.values())

    @cached_property
    def is_oncoming(self) -> bool:
        """Whether both actors drove towards each other at the contact, along a bend or a straight road."""
        if self.same_way:
            return False
        if self.turn > _OPPOSITE_RAD:
            return True
        own, its = (self._course(actor) for actor in (self.agent, self.other))
        if abs(math.remainder(own - its, math.tau)) <= _OPPOSITE_RAD:
            return False
        if (self.touch.face, self.touch.other_face) == ("front", "front"):
            return True
        # A corner of the front counts as a side in a bend. A vehicle that turns left comes from another lane.
        front, its_front = (self._trail(actor).points[-1] for actor in (self.agent, self.other))
        return math.dist(front, its_front) <= _FRONTS_M and self.lanes.joins(front, own, its_front, its + math.pi)

    def _course(self, actor: str) -> float:
        """Return the direction in which the front of an actor last moved; if it had not moved, its heading, in rad."""
        trail = self._trail(actor)
        back = trail.index(_MIN_COURSE_M)
        if back is None:
            return float(trail.headings[-1])
        dx, dy = trail.points[-1] - trail.points[back]
        return math.atan2(dy, dx)

    @cached_property
    def _shared_paths(self) -> dict[str, SharedPath | None]:
        """The part of each actor's path that leads along the path that the other actor had driven before."""
        pair = (self.agent, self.other)
        if any(is_person(actor) or self.reverses(actor) for actor in pair):
            return dict.fromkeys(pair)
        return {actor: self._trail(actor).shared_with(self._trail(self.partner(actor)), self.lanes) for actor in pair}

    def _trail(self, actor: str) -> Trail:
        """Return the path of an actor's front up to the contact, for at most 40 m."""
        return self._trails[actor]

    @cached_property
    def _trails(self) -> dict[str, Trail]:
        return {actor: self._trail_of(actor) for actor in (self.agent, self.other)}

    def _trail_of(self, actor: str) -> Trail:
        known = self.way(actor)
        size = known.length, known.width
        center, heading = self._at_contact(actor)
        front = center + known.length / 2 * np.array([math.cos(heading), math.sin(heading)])
        poses = [(float(front[0]), float(front[1]), heading)]
        after = (*poses[0], *size)
        left = _TRAIL_M
        for scene in reversed(self.scenes):
            if scene.time_s >= self.time_s - 1e-6:
                continue
            row = scene.roster.index.get(actor)
            if row is None or left <= 0:
                break
            before = (*scene.points[row], scene.headings[row], *size)
            driven = math.dist(before[:2], after[:2])
            if driven < _MIN_LEG_M:
                continue  # it stands: the direction of so short a leg is a rounding error
            parts = max(1, math.ceil(driven / TRAIL_STEP_M))
            shares = [part / parts for part in range(parts)]
            poses.extend(pose[:3] for pose in reversed(poses_between(before, after, shares, bends=self.swept)))
            left -= driven
            after = before
        points = np.array(poses[::-1])
        return Trail(points[:, :2], points[:, 2], known.length)

    def turned(self, since_s: float) -> float:
        """Return the greatest angle between the headings of both actors in the seconds before the contact, in rad."""
        own, other = self.way(self.agent), self.way(self.other)
        turns = np.abs((own.headings - other.headings + math.pi) % math.tau - math.pi)
        return float(turns[self.times <= since_s + 1e-6].max(initial=self.turn))

    @cached_property
    def follower(self) -> str:
        """The actor whose front touched the other actor's rear, in the same direction; empty for other contacts."""
        return "" if self.is_disputed else self._follower

    @cached_property
    def _follower(self) -> str:
        if self.touch.is_sideways:
            return ""
        faces = self.touch.face, self.touch.other_face
        if self.turn < SAME_WAY and faces in (("front", "rear"), ("rear", "front")):
            return self.agent if faces[0] == "front" else self.other
        if self.turn < _MIN_BEND_TURN_RAD:
            return ""
        # In a bend, a follower touches a corner of the vehicle ahead, which may count as its side.
        behind = [actor for actor, path in self._shared_paths.items() if path is not None and path.meets_rear]
        return behind[0] if len(behind) == 1 else ""

    def in_its_way_s(self, leader: str) -> float:
        """Return for how long before the contact the leader had been in the path of the follower, in s."""
        lead, follow = self.way(leader), self.way(self.partner(leader))
        # The leader is the last point: where the road bends, the follower would not have gone straight on.
        ends = [self._at_contact(actor)[0] for actor in (follow.id, leader)]
        shared = None if self._drove_straight(follow.id) else self._shared_paths[follow.id]
        if shared is not None and shared.meets_rear:  # where the road bends tightly, the leader shows the way
            ends.insert(1, self._trail(leader).centers(lead.length))
        path, places = np.vstack((follow.centers, *ends)), lead.centers
        legs = np.diff(path, axis=0)
        squares = np.maximum((legs**2).sum(axis=1), 1e-12)
        behind_m = min(_MAX_ASIDE_M, (lead.width + follow.width) / 2 - _MIN_OVERLAP_M)
        limit_m = max(BESIDE_M, behind_m) + min(_BEND_M, self._bend_m / 2)
        found = 0.0
        for back in range(len(self.times) - 1, -1, -1):
            if _distance(path[back:-1], legs[back:], squares[back:], places[back]) > limit_m:
                break
            found = float(self.times[back])
        return found

    def _drove_straight(self, actor: str) -> bool:
        headings = np.unwrap(np.append(self.way(actor).headings, self._at_contact(actor)[1]))
        return bool(np.ptp(headings) < _MAX_STRAIGHT_TURN_RAD)

    def turns_off_s(self, leader: str) -> float | None:
        """Return when a leader left the path of a follower that drove straight on, in s before the contact, or None.

        Before that, the leader was in the follower's path in every recorded step.
        """
        lead, follow = self.way(leader), self.way(self.partner(leader))
        straight = self._drove_straight(follow.id) and self.ahead_m(leader) > 0
        before = abs(math.remainder(lead.headings[0] - follow.headings[0], math.tau))
        if not straight or before >= _MAX_STRAIGHT_TURN_RAD or self.turn < _MAX_STRAIGHT_TURN_RAD:
            return None
        asides = [abs(self.aside_m(leader, back)) for back in range(len(self.times))]
        left = next((back for back, aside in enumerate(asides) if aside > BESIDE_M), len(asides))
        parting = all(after > before - _DRIFTS_M for before, after in pairwise(asides[max(0, left - 1) :]))
        return float(self.times[left - 1]) if left > 0 and parting else None

    def changed_s(self, actor: str) -> float | None:
        """Return how long before the contact an actor last changed lanes, or began to, in s; None if it never did."""
        return self._changes[actor]

    @cached_property
    def _changes(self) -> dict[str, float | None]:
        return {actor: self._changed_s(actor) for actor in (self.agent, self.other)}

    def _changed_s(self, actor: str) -> float | None:
        if actor in self.jumpers:
            return 0.0
        if self._leaves_last(actor) or self.is_changing(actor):
            return float(self.times[-1])
        left = self._left[actor]
        return None if left is None else self.time_s - self.before[left].time_s

    @cached_property
    def _left(self) -> dict[str, int | None]:
        """The index of the last scene before the contact at which each actor left a lane over its side."""
        return {actor: self.lanes.left_sideways(self.before, actor) for actor in (self.agent, self.other)}

    def _leaves_last(self, actor: str) -> bool:
        """Return whether an actor left a lane over its side between the last scene before the contact and the next."""
        scenes = self.until_contact(actor)
        return len(scenes) > len(self.before) and self.lanes.leaves_sideways(scenes[-2:], actor)

    def _has_left_since(self, actor: str, time_s: float) -> bool:
        """Return whether an actor left a lane over its side between two scenes from a time on."""
        left = self._left[actor]
        begin = len(self.before) if self._leaves_last(actor) else left
        return begin is not None and self.before[begin - 1].time_s >= time_s

    def is_changing(self, actor: str) -> bool:
        """Return whether an actor reached into the next lane at the contact, with its centre still in its own lane."""
        since = self._left[actor] or 0
        through = self.until_contact(actor)[since:]
        return not self._leaves_last(actor) and any(
            self.lanes.reaches_over(scenes, actor) for scenes in (through, self.before[since:])
        )

    def reached_in_s(self, jumper: str) -> float:
        """Return for how long before the contact the other actor had reached into the lane that an actor jumped to."""
        since = self.lanes.reached_since(self.before, self.partner(jumper), self._at_contact(jumper))
        return 0.0 if since is None else self.time_s - self.before[since].time_s

    def is_against_its_lane(self, actor: str, back: int | None = None) -> bool | None:
        """Return whether an actor moved against the direction of all lanes at its centre; None if that is not known.

        ``back`` is the index of a time before the contact; None for the time of the contact.
        """
        center, heading = self._pose(actor, back)
        return self._is_against(actor, center, heading)

    def reaches_oncoming_lane(self, actor: str, back: int | None = None) -> bool:
        """Return whether an actor reached more than 0.1 m into lanes that only lead in the opposite direction."""
        _, heading = self._pose(actor, back)
        return any(self._is_against(actor, point, heading) for point in self._outline(actor, back, _OVER_M))

    def is_inside_its_lanes(self, actor: str) -> bool:
        """Return whether the outline of an actor was wholly in lanes of its direction at the contact.

        Places where lanes cross do not count.
        """
        _, heading = self._pose(actor, None)
        return all(
            self._is_against(actor, point, heading) is False
            and not self.lanes.cross((float(point[0]), float(point[1])))
            for point in self._outline(actor, None)
        )

    def _pose(self, actor: str, back: int | None) -> tuple[NDArray[np.float64], float]:
        """Return the centre of an actor, in m, and its heading, in rad."""
        way = self.way(actor)
        return self._at_contact(actor) if back is None else (way.centers[back], float(way.headings[back]))

    def _outline(self, actor: str, back: int | None, inset_m: float = 0.0) -> NDArray[np.float64]:
        """Return the corners of an actor and the middles of its sides, each nearer to its axis by a distance."""
        center, heading = self._pose(actor, back)
        way = self.way(actor)
        ahead, left = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
        return np.array([
            center + along * way.length * ahead + side * (way.width / 2 - inset_m) * left
            for along in (-0.5, 0.0, 0.5) for side in (-1, 1)
        ])  # fmt: skip

    def _is_against(self, actor: str, point: NDArray[np.float64], heading: float) -> bool | None:
        course = heading + math.pi if self.reverses(actor) else heading
        return self.lanes.is_against((float(point[0]), float(point[1])), float(course))

    def reverses(self, actor: str) -> bool:
        """Return whether an actor last moved backwards."""
        trail = self._trail(actor)
        return math.cos(self._course(actor) - float(trail.headings[-1])) < 0 and trail.index(_MIN_COURSE_M) is not None

    def until_contact(self, actor: str) -> list[Scene]:
        """Return the scenes before the contact and the first scene after it, without lane changes after the contact."""
        jumped = self.swept and len(self.through) > 1 and lane_jump(self.through[-2], self.through[-1], actor)
        return self.before if jumped and actor not in self.jumpers else self.through

    def lane_changers(self, within_s: float) -> tuple[str, ...]:
        """Return the actors that changed lanes at the contact, or at most the given time before it."""
        found = [
            actor
            for actor in (self.agent, self.other)
            if actor in self.jumpers or self._has_left_since(actor, self.time_s - within_s)
        ]
        if found or self.manner not in ("side swipe", "rear end"):
            return tuple(found)
        for actor in (self.agent, self.other):  # they touched before half a lane had been crossed
            scenes = [scene for scene in self.until_contact(actor) if scene.time_s >= self.time_s - within_s]
            late = [scene for scene in scenes if scene.time_s >= self.time_s - within_s / 2]
            if self.lanes.reaches_over(scenes, actor) or self.lanes.reaches_over(late, actor):
                found.append(actor)
        return tuple(found)

    def drifted(self, actor: str) -> bool:
        """Return whether an actor was crossing the side of its lane at the contact, or had crossed it before."""
        return self.changed_s(actor) is not None

    def is_over_side(self, actor: str) -> bool:
        """Return whether an actor that drove straight on reached over the side of its lane at the contact."""
        half_width = self.way(actor).width / 2
        return self._drove_straight(actor) and self.lanes.is_over_side(self._at_contact(actor), half_width)

    def meets_sideways(self, actor: str) -> bool:
        """Return whether an actor moved towards the side of the other actor."""
        if self.touch.is_sideways:
            return actor in self.jumpers
        last = self.through[-1]
        own, its = (last.centers[last.roster.index[name]] for name in (actor, self.partner(actor)))
        heading = last.headings[last.roster.index[self.partner(actor)]]
        aside = (own[1] - its[1]) * math.cos(heading) - (own[0] - its[0]) * math.sin(heading)
        lately = [abs(self.aside_m(actor, back)) for back, time_s in enumerate(self.times) if time_s <= _LATELY_S]
        return max(lately, default=0.0) - abs(float(aside)) > _SIDEWAYS_M

    def stood_s(self, actor: str) -> float:
        """Return how long an actor had stood still until the contact, in s; 0 if it moved when the actors touched."""
        if abs(self.speed_at_contact(actor)) >= STANDS_MPS:
            return 0.0
        found, place = 0.0, None
        for scene in reversed(self.scenes):
            row = scene.roster.index.get(actor)
            if scene.time_s >= self.time_s - 1e-6:
                continue
            if row is None:
                break
            ago = self.time_s - scene.time_s
            if (speed := abs(scene.speeds[row])) >= STANDS_MPS:
                if place is None:
                    break
                # It stopped between two scenes. With a constant deceleration, the distance says when.
                moved_s = 2 * math.dist(scene.points[row], place) / speed
                return max(found, ago - moved_s)
            found, place = ago, scene.points[row]
        return found


def record_in(scenes: Sequence[Scene], hit: Collision) -> ContactRecord | None:
    """Return the record of a contact at the end of the given scenes, without a map; None if an actor is missing."""
    agent, other = hit.agent, hit.other
    if not scenes or not all(name in scenes[-1].roster.index for name in (agent, other)):
        return None
    return ContactRecord(
        agent=agent,
        other=other,
        scenes=scenes,
        time_s=scenes[-1].time_s,
        began_s=scenes[0].time_s,
        lanes=LaneMap((), (0.0, 0.0)),
        swept=hit.kind != _UNSWEPT_CONTACT,
        reported=hit,
    )


def contact_record(bundle: Bundle, recording: Recording | None = None) -> ContactRecord | None:
    """Return the record of a collision of two actors; no code of the bundle runs.

    Returns:
        None if there was no contact, or if one of the two actors is missing in the last scene.

    Raises:
        BundleError: the log of the crash is missing or damaged.
    """
    hit = bundle.result.collision
    if hit is None or not hit.other:
        return None
    from crashhunt.recording import read_lanes  # MCAP takes longer than a list of software faults

    found = recording or bundle.recording()
    record = record_in(found.scenes(), hit)
    if record is None:
        return None
    last = record.scenes[-1]
    since_s = last.time_s - _EVENTS_S
    return replace(
        record,
        time_s=hit.time_s if last.time_s - found.prologue.step_length_s <= hit.time_s <= last.time_s else last.time_s,
        lanes=LaneMap(read_lanes(bundle.path / layout.LOG), (hit.x, hit.y)),
        events=tuple((scene.time_s, event) for scene in scenes_since(record.scenes, since_s) for event in scene.events),
        # Earlier versions wrote the lane of SUMO's report, which may be the other actor's.
        lane=(last.lanes[last.roster.index[hit.agent]] if last.lanes else "") or hit.lane,
    )


def _distance(
    starts: NDArray[np.float64], legs: NDArray[np.float64], squares: NDArray[np.float64], point: NDArray[np.float64]
) -> float:
    """Return the distance of a point from legs, of which the starts, the vectors and the squared lengths are given."""
    offsets = point - starts
    along = np.minimum(np.maximum(np.einsum("ij,ij->i", offsets, legs) / squares, 0.0), 1.0)
    return float(np.hypot(*(offsets - along[:, None] * legs).T).min())
