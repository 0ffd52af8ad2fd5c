"""The oracles that come with crashhunt: of crashes, of near misses, and of traffic events."""

from __future__ import annotations

import math
from math import cos, sin, sqrt
from typing import TYPE_CHECKING, Annotated

import numpy as np

from crashhunt.base.errors import ArgumentError
from crashhunt.oracles._protocol import Finding
from crashhunt.trial import Argument, Collision, Outcome
from crashhunt.world import (
    MAX_CONTACT_GAP_M,
    Event,
    contact_at,
    first_contact,
    lane_jump,
    on_one_level,
    outlines,
    outlines_overlap,
    reachable_m,
    rectangle_gap,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.trial import Category
    from crashhunt.world import Actor, Contact, Rectangle, Scene, Touch


MAX_BRAKING_MPS2 = 10.0
"""Upper bound of braking, in m/s²: it bounds the speed of an actor in the previous scene."""


class ReportedCollision:
    """Detects the collisions of controlled vehicles that the simulator reports.

    Collider, speeds and time are determined from the paths of both actors. After a long step or a lane change, the
    simulator may report the two vehicles in the wrong order, and a lane that is not the agent's lane.
    """

    name = "reported"

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return a finding for each collision of an agent that the simulator reports."""
        findings = []
        for contact in scene.contacts:
            for agent in agents:
                if agent in (contact.collider, contact.victim):
                    findings.append(Finding(Outcome.COLLISION, self._collision(scene, agent, contact)))
                    break
        return findings

    def _collision(self, scene: Scene, agent: str, contact: Contact) -> Collision:
        index = scene.roster.index
        other = contact.victim if agent == contact.collider else contact.collider
        if scene.swept and agent in index and other in index:
            touch = contact_at(scene.previous, scene, index[agent], index[other])
            if touch.gap_m < MAX_CONTACT_GAP_M:
                lane = _lane_at(scene, agent, touch) or contact.lane
                return _touching(self.name, agent, other, touch, contact.kind, lane)
        x, y, lane = _place_of(scene, agent)
        return Collision(
            agent=agent,
            role="alone" if not contact.victim else "collider" if agent == contact.collider else "victim",
            collider=contact.collider,
            victim=contact.victim,
            seen_by=(self.name,),
            kind=contact.kind,
            x=x,
            y=y,
            lane=lane or contact.lane,
            collider_speed=contact.collider_speed,
            victim_speed=contact.victim_speed,
            time_s=scene.time_s,
        )


class Overlap:
    """Detects a collision if the outlines of an agent and another actor overlap, or overlapped during the step.

    Simulators miss some of these collisions, because SUMO compares only vehicles of the same lane. The collider is the
    vehicle that moves into the other's lane, or that has the other vehicle in front of it at the first touch. A
    standing vehicle is never the collider. A parked vehicle takes no part.
    """

    name = "overlap"

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return a finding for each agent whose outline overlaps the outline of another actor."""
        findings = []
        previous = scene.previous if scene.swept else None
        for agent in agents:
            actors, row = scene.roster.actors, scene.roster.index.get(agent)
            if row is None or actors[row].parked:
                continue
            for other in _within_reach(scene, previous, row):
                if actors[other].parked:
                    continue
                # Between a parking space and a lane, SUMO moves a vehicle at once and drives no path.
                jumped = previous is not None and (
                    _was_parked(previous, actors[row]) or _was_parked(previous, actors[other])
                )
                touch = first_contact(None if jumped else previous, scene, row, other)
                if touch is not None:
                    name = actors[other].id
                    lane = _lane_at(scene, agent, touch)
                    collision = _touching(self.name, agent, name, touch, "overlap", lane)
                    findings.append(Finding(Outcome.COLLISION, collision))
        return findings


class OffRoad:
    """Detects controlled vehicles that left the road, according to the simulator."""

    name = "off_road"

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return a finding for each agent that left the road."""
        findings = []
        for agent in scene.off_road:
            if agent in agents:
                x, y, lane = _place_of(scene, agent)
                row = scene.roster.index.get(agent)
                speed = scene.speeds[row] if row is not None else float("nan")
                collision = Collision(
                    agent=agent,
                    role="alone",
                    collider=agent,
                    victim="",
                    seen_by=(self.name,),
                    kind="off_road",
                    x=x,
                    y=y,
                    lane=lane,
                    collider_speed=speed,
                    time_s=scene.time_s,
                )
                findings.append(Finding(Outcome.OFF_ROAD, collision))
        return findings


def _was_parked(previous: Scene, actor: Actor) -> bool:
    row = previous.roster.index.get(actor.id)
    return row is not None and previous.roster.actors[row].parked


def _within_reach(scene: Scene, previous: Scene | None, row: int) -> list[int]:
    """Return the rows of actors that may have touched an actor since the previous scene, nearest first; often none.

    An actor that is further away than both actors could have moved relative to each other cannot have touched the
    agent. This function examines every near vehicle in every step, so it avoids all unnecessary work.
    """
    roster, further = scene.roster, 0.0
    if previous is not None:
        step_s = scene.time_s - previous.time_s
        bends = scene.spines or previous.spines
        if not bends and scene.core is not None and scene.columns is not None and previous.columns is not None:
            before = None
            if previous.roster is not roster:
                index = previous.roster.index
                before = [index.get(actor.id, -1) for actor in roster.actors]
            rows = scene.core.within_reach(scene.columns, previous.columns, row, step_s, MAX_BRAKING_MPS2, before)
            if rows is not None:
                return rows
        further = 2 * reachable_m(max(scene.speeds) + MAX_BRAKING_MPS2 * step_s, step_s)
    limit = (roster.touch_distance + further) ** 2
    moved, found = None, []
    reaches = roster.reaches
    for squared, other in scene.neighbors(row):
        if squared >= limit:
            break
        reach = reaches[row] + reaches[other]
        margin = 0.0
        if squared >= (reach + further) * (reach + further):
            continue
        if previous is not None:
            if moved is None:
                moved = _displacement(previous, scene, row)
            theirs = _displacement(previous, scene, other)
            rx, ry = moved[0] - theirs[0], moved[1] - theirs[1]
            margin = sqrt(rx * rx + ry * ry) + moved[2] + theirs[2]
        if squared < (reach + margin) * (reach + margin) and _may_touch(scene, previous, row, other, margin):
            found.append(other)
    return found


def _may_touch(scene: Scene, previous: Scene | None, row: int, other: int, margin: float) -> bool:
    """Return whether two outlines overlap, or may have overlapped between the two scenes.

    The two actors have moved ``margin`` m relative to each other.
    """
    if scene.spines or (previous is not None and previous.spines):
        return True
    one, two = _rectangle(scene, row), _rectangle(scene, other)
    if previous is None:
        return outlines_overlap(one, two)
    if not outlines_overlap(one, two, margin=margin):
        return False
    return outlines_overlap(one, two, margin=margin / 2) or _were_near(previous, scene, row, other, margin / 2)


def _were_near(previous: Scene, scene: Scene, row: int, other: int, margin: float) -> bool:
    if previous.roster is not scene.roster:
        actors, index = scene.roster.actors, previous.roster.index
        was, other_was = index.get(actors[row].id), index.get(actors[other].id)
        if was is None or other_was is None:
            return True
        row, other = was, other_was
    return outlines_overlap(_rectangle(previous, row), _rectangle(previous, other), margin=margin)


def _displacement(previous: Scene, scene: Scene, row: int) -> tuple[float, float, float]:
    """Return the displacement of an actor (x, y), and how much further one of its corners may have moved meanwhile."""
    was = row
    if previous.roster is not scene.roster:
        found = previous.roster.index.get(scene.roster.actors[row].id)
        if found is None:
            return 0.0, 0.0, 0.0
        was = found
    x, y = scene.points[row]
    old_x, old_y = previous.points[was]
    heading = previous.headings[was]
    dx, dy = x - old_x, y - old_y
    aside = 2 * abs(dy * cos(heading) - dx * sin(heading))
    turn = scene.headings[row] - heading
    if turn:
        aside += abs(math.remainder(turn, math.tau)) * (scene.roster.reaches[row] + abs(dx) + abs(dy))
    if scene.spines or previous.spines:  # the back of a train does not move as its front does
        aside += 2 * (abs(dx) + abs(dy))
    return dx, dy, aside


def _rectangle(scene: Scene, row: int) -> Rectangle:
    actor = scene.roster.actors[row]
    x, y = scene.points[row]
    return x, y, scene.headings[row], actor.length, actor.width


def _touching(name: str, agent: str, other: str, touch: Touch, kind: str, lane: str) -> Collision:
    collider, victim = (agent, other) if touch.drives_into else (other, agent)
    speeds = (touch.speed, touch.other_speed) if touch.drives_into else (touch.other_speed, touch.speed)
    role = "collider" if touch.drives_into else "victim"
    return Collision(agent, role, collider, victim, (name,), kind, touch.x, touch.y, lane, *speeds, touch.time_s)


def _lane_at(scene: Scene, agent: str, touch: Touch) -> str:
    """Return the lane of an agent at a contact; empty if it is unknown."""
    previous = scene.previous
    if touch.share < 1.0 and previous is not None and lane_jump(previous, scene, agent):
        return previous.agent_lanes.get(agent, "")  # it changed lanes after the contact
    return _place_of(scene, agent)[2]


def _place_of(scene: Scene, agent: str) -> tuple[float, float, str]:
    row = scene.roster.index.get(agent)
    if row is None:
        return float("nan"), float("nan"), ""
    x, y = scene.points[row]
    return x, y, scene.lanes[row] if scene.lanes else scene.agent_lanes.get(agent, "")


class TooClose:
    """Detects a near miss: a moving agent comes closer to another actor than a given gap, without touching it.

    Args:
        gap_m: gap between the outlines, in m.
        speed: minimum speed of the agent relative to the other actor, in m/s; 0 includes an agent that creeps forward
            in a queue.
    """

    name = "too-close"
    outcomes: Mapping[str, Category] = {"too_close": "traffic event"}

    def __init__(
        self,
        gap_m: Annotated[float, Argument("gap_m", unit="m", help="between the outlines")] = 0.5,
        speed: Annotated[float, Argument("speed", unit="m/s", help="relative to the other, at least")] = 1.0,
    ) -> None:
        for name, value in (("gap_m", gap_m), ("speed", speed)):
            if not 0 <= value < float("inf"):
                raise ArgumentError(f"{name} is {value:g}", fix="give 0 or more", where="--oracle too-close")
        self._gap_m, self._speed = gap_m, speed

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the nearest near miss of each agent in this scene, if there is any."""
        findings = []
        for agent in agents:
            row = scene.roster.index.get(agent)
            near = [] if row is None else [found for other in self._others(scene, row) if (found := self._gap(*other))]
            if row is not None and near:
                gap_m, other = min(near)
                (x, y), speed, lane = scene.points[row], scene.speeds[row], scene.agent_lanes.get(agent, "")
                name = scene.roster.actors[other].id
                what = f"{agent} came within {gap_m:.2f} m of {name}"
                event = Event("too_close", agent, what, others=(name,), lane=lane, x=x, y=y, speed=speed)
                findings.append(Finding(Outcome("too_close"), event=event))
        return findings

    def _others(self, scene: Scene, row: int) -> list[tuple[Scene, int, int]]:
        """Yield the actors that may be near enough; circles around the outlines give a lower bound of the gap."""
        found = []
        reaches = scene.roster.reaches
        for squared, other in scene.neighbors(row):
            if squared > (scene.roster.touch_distance + self._gap_m) ** 2:  # all further ones as well
                break
            if scene.roster.actors[other].parked:
                continue
            if squared <= (reaches[row] + reaches[other] + self._gap_m) ** 2 and on_one_level(scene, row, other):
                found.append((scene, row, other))
        return found

    def _gap(self, scene: Scene, row: int, other: int) -> tuple[float, int] | None:
        """Return the gap to another actor, in m, and the actor's row; None if it does not count as a near miss."""
        vx, vy = (
            scene.speeds[row] * turn(scene.headings[row]) - scene.speeds[other] * turn(scene.headings[other])
            for turn in (math.cos, math.sin)
        )
        if scene.speeds[row] <= 0 or math.hypot(vx, vy) < self._speed:
            return None
        pairs = [(one, two) for one in outlines(scene, row) for two in outlines(scene, other)]
        places, turns = [], []
        for (x, y, heading, length, _), (other_x, other_y, other_heading, other_length, _) in pairs:
            dx = other_x - math.cos(other_heading) * other_length / 2 - x + math.cos(heading) * length / 2
            dy = other_y - math.sin(other_heading) * other_length / 2 - y + math.sin(heading) * length / 2
            c, s = math.cos(heading), math.sin(heading)
            places.append((dx * c + dy * s, dy * c - dx * s))
            turns.append(other_heading - heading)
        halves = [
            np.array([(length / 2, width / 2) for *_, length, width in side]) for side in zip(*pairs, strict=True)
        ]
        gap_m = float(rectangle_gap(np.array(places), np.array(turns), *halves).min())
        return (gap_m, other) if 0.0 < gap_m < self._gap_m else None  # who touches has not missed


# Oracles of traffic events, which use only the reports of the simulator.


class TrafficEvents:
    """Reports the simulator's own traffic events, such as red lights, standstills and teleports.

    An episode uses this oracle as the last one, so that a collision in the same step takes precedence. The oracle is
    used only if ``--crash-on`` names a traffic event.
    """

    name = "traffic-events"

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the events in which the agents take part."""
        return [Finding(Outcome(event.kind), event=event) for event in scene.events if event.agent in agents]


class _ReportedEvent:
    """Makes one type of event a crash: ``--oracle red-light`` is short for adding the type to ``--crash-on``."""

    name: str
    outcomes: Mapping[str, Category]

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the events of this type in which the agents take part."""
        events = [event for event in scene.events if event.kind in self.outcomes and event.agent in agents]
        return [Finding(Outcome(event.kind), event=event) for event in events]


class RedLight(_ReportedEvent):
    """Detects that an agent runs a red light, if the simulator reports this."""

    name = "red-light"
    outcomes: Mapping[str, Category] = {"red_light": "traffic event"}


class WrongWay(_ReportedEvent):
    """Detects that an agent drives in the wrong direction, if the simulator reports this."""

    name = "wrong-way"
    outcomes: Mapping[str, Category] = {"wrong_way": "traffic event"}


class OffRoute(_ReportedEvent):
    """Detects that an agent misses its route, if the simulator reports this."""

    name = "off-route"
    outcomes: Mapping[str, Category] = {"off_route": "traffic event"}


class Teleport(_ReportedEvent):
    """Detects that the simulator teleports an agent that was stuck, if the simulator reports this."""

    name = "teleport"
    outcomes: Mapping[str, Category] = {"teleport": "traffic event"}
