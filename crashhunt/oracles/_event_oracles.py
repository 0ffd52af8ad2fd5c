"""The oracle for near misses, and the oracles for traffic events."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import numpy as np

from crashhunt.base.errors import ArgumentError
from crashhunt.oracles._protocol import Finding
from crashhunt.trial import Argument, Outcome
from crashhunt.world import Event, on_one_level, outlines, rectangle_gap

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.trial import Category
    from crashhunt.world import Scene


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
