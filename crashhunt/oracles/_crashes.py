"""The oracles that come with crashhunt."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

from crashhunt.oracles._geometry import outlines_overlap
from crashhunt.oracles._protocol import Finding
from crashhunt.trial import Collision, Outcome

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.scene import Scene

__all__ = ["OffRoad", "Overlap", "ReportedCollision"]


class ReportedCollision:
    """Believes the simulator's own list of collisions, where a controlled vehicle takes part."""

    name = "reported"

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the reported collisions of the agents."""
        findings = []
        for contact in scene.contacts:
            for agent in agents:
                if agent in (contact.collider, contact.victim):
                    x, y, lane = _where(scene, agent)
                    collision = Collision(
                        agent,
                        "alone" if not contact.victim else "collider" if agent == contact.collider else "victim",
                        contact.collider,
                        contact.victim,
                        (self.name,),
                        contact.kind,
                        x,
                        y,
                        contact.lane or lane,
                        contact.collider_speed,
                        contact.victim_speed,
                    )
                    findings.append(Finding(Outcome.COLLISION, collision))
                    break
        return findings


class Overlap:
    """Sees a collision where the outlines of a controlled vehicle and another actor overlap.

    Simulators miss some: SUMO compares vehicles of one lane only. Whoever has the other in front of it is the
    collider.
    """

    name = "overlap"

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the overlaps of the agents."""
        findings = []
        for agent in agents:
            row = scene.roster.index.get(agent)
            if row is None:
                continue
            roster = scene.roster
            limit = roster.touch_distance_squared
            for squared, other in scene.neighbors(row):
                if squared >= limit:
                    break
                if squared < (roster.reaches[row] + roster.reaches[other]) ** 2 and outlines_overlap(
                    _rectangle(scene, row), _rectangle(scene, other)
                ):
                    findings.append(self._finding(scene, row, other))
        return findings

    def _finding(self, scene: Scene, row: int, other: int) -> Finding:
        agent, them = scene.roster.actors[row].id, scene.roster.actors[other].id
        heading = scene.headings[row]
        offset = (scene.centers[other] - scene.centers[row]).tolist()
        ahead = offset[0] * cos(heading) + offset[1] * sin(heading) > 0
        own_speed, other_speed = scene.speeds[row], scene.speeds[other]
        x, y, lane = _where(scene, agent)
        collision = Collision(
            agent,
            "collider" if ahead else "victim",
            agent if ahead else them,
            them if ahead else agent,
            (self.name,),
            "overlap",
            x,
            y,
            lane,
            own_speed if ahead else other_speed,
            other_speed if ahead else own_speed,
        )
        return Finding(Outcome.COLLISION, collision)


class OffRoad:
    """Believes the simulator when it says that a controlled vehicle left the road."""

    name = "off_road"

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the agents that left the road."""
        findings = []
        for agent in scene.off_road:
            if agent in agents:
                x, y, lane = _where(scene, agent)
                row = scene.roster.index.get(agent)
                speed = scene.speeds[row] if row is not None else float("nan")
                collision = Collision(agent, "alone", agent, "", (self.name,), "off_road", x, y, lane, speed)
                findings.append(Finding(Outcome.OFF_ROAD, collision))
        return findings


def _rectangle(scene: Scene, row: int) -> tuple[float, float, float, float, float]:
    actor = scene.roster.actors[row]
    x, y = scene.points[row]
    return x, y, scene.headings[row], actor.length, actor.width


def _where(scene: Scene, agent: str) -> tuple[float, float, str]:
    row = scene.roster.index.get(agent)
    if row is None:
        return float("nan"), float("nan"), ""
    x, y = scene.points[row]
    return x, y, scene.lanes[row] if scene.lanes else scene.agent_lanes.get(agent, "")
