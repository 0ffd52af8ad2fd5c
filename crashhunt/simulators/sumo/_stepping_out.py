"""A person of SUMO's who steps out onto the road and back, as nobody does there of their own accord."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.world import PERSON

if TYPE_CHECKING:
    from crashhunt.world import Scene

__all__ = ["SteppingOut", "roadside"]

_AHEAD_M, _ASIDE_M = 60.0, 15.0  # who is further away than that is not meant
_INNER_M = 1.6  # half a lane: who is less to the side is in the way already
_WALKS = 2  # SUMO's type of a stage


def roadside(scene: Scene, agent: str, who: str) -> str:
    """Return the nearest person who walks on one side of the road ahead of an agent; empty where nobody does.

    Args:
        scene: as it is now.
        agent: a controlled vehicle.
        who: ``left ahead`` or ``right ahead``; nobody is anywhere else.
    """
    here = scene.roster.index.get(agent)
    if here is None:
        return ""
    (x, y), heading = scene.points[here], scene.headings[here]
    found = []
    for row, actor in enumerate(scene.roster.actors):
        if not actor.id.startswith(PERSON):
            continue
        dx, dy = scene.points[row][0] - x, scene.points[row][1] - y
        ahead, left = dx * math.cos(heading) + dy * math.sin(heading), dy * math.cos(heading) - dx * math.sin(heading)
        place = f"{'left' if left > 0 else 'right'} ahead"
        if place == who and 0 < ahead <= _AHEAD_M and _INNER_M < abs(left) <= _ASIDE_M and _walks(actor.id):
            found.append((ahead, actor.id))
    return min(found)[1] if found else ""


def _walks(actor: str) -> bool:
    stage = libsumo.person.getStage(actor.removeprefix(PERSON))
    return bool(stage.type == _WALKS)


class SteppingOut:
    """Walks straight to the middle of the agent's way, stands there, and is back where it began when the time is over.

    SUMO's persons walk on their sidewalks only: this one is moved, never further in a step than a person walks in it.
    SUMO has forgotten afterwards where it was going, and is told again.

    Args:
        actor: a person who walks.
        agent: whose way it is.
        speed: in m/s; no more than what the person can do.
        steps: in how many it goes out and comes back.
        step_length_s: of the simulation.
        speeds: of persons of whom SUMO does not know how fast they are, by their ids there; ours is added.
    """

    def __init__(
        self, actor: str, agent: str, speed: float, steps: int, step_length_s: float, speeds: dict[str, float]
    ) -> None:
        person = actor.removeprefix(PERSON)
        self.how_strong = min(speed, float(sumo.person_getMaxSpeed(person)))
        self._person = person
        self._dt = step_length_s
        self._speeds = speeds
        self._left = steps
        self._walk = libsumo.person.getStage(person)
        self._edge = str(sumo.person_getRoadID(person))
        self._start: tuple[float, float] = sumo.person_getPosition(person)
        heading = math.radians(90.0 - sumo.vehicle_getAngle(agent))
        own_x, own_y = sumo.vehicle_getPosition(agent)
        dx, dy = self._start[0] - own_x, self._start[1] - own_y
        left = dy * math.cos(heading) - dx * math.sin(heading)
        side = -1.0 if left > 0 else 1.0
        self._way = -side * math.sin(heading), side * math.cos(heading)
        self._far = abs(left)  # to the middle of the agent's way
        self._out = 0.0
        self._command()

    def keep(self) -> None:
        """Go on, where it has not left."""
        try:
            self._command()
        except libsumo.TraCIException:
            self._speeds.pop(self._person, None)

    def end(self) -> None:
        """Have it go on where it was going."""
        self._speeds.pop(self._person, None)
        edges = tuple(self._walk.edges)
        try:
            rest = edges[edges.index(self._edge) :] if self._edge in edges else edges
            libsumo.person.appendWalkingStage(self._person, rest, self._walk.arrivalPos)
            if libsumo.person.getRemainingStages(self._person) > 1:
                libsumo.person.removeStage(self._person, 0)
        except libsumo.TraCIException:
            pass  # it has left

    def _command(self) -> None:
        self._left -= 1  # steps after this one
        reach = self.how_strong * self._dt
        before = self._out
        # As far as it comes, and no further than from where it is back in time.
        self._out = min(self._far, before + reach, self._left * reach)
        away = self._out - before
        towards = self._way if away >= 0 else (-self._way[0], -self._way[1])
        (x, y), (way_x, way_y) = self._start, self._way
        angle = 90.0 - math.degrees(math.atan2(towards[1], towards[0]))
        sumo.person_moveToXY(self._person, "", x + self._out * way_x, y + self._out * way_y, angle, 2, 100.0)
        self._speeds[self._person] = abs(away) / self._dt
