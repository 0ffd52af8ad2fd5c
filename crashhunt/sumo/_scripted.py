"""Playback of recorded paths on SUMO: SUMO simulates the controlled vehicles, and scenes add the recorded actors.

When SUMO moves a vehicle to a position, it maps the vehicle to a lane nearby and derives the speed from the distance.
SUMO would thus change the recorded states, so the recorded actors are not in SUMO. Instead, this module copies the
recorded states into the scenes, bit-identical. Observations and contacts are computed from scenes. SUMO's own
safe-speed checks do not see the recorded actors.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.world import Actor, ActorState, Path, Roster, Scene

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.sumo._range_of_sight import Sight
    from crashhunt.world import Paths, Spine

    Row = tuple[Actor, ActorState, str, Spine | None]


class ScriptedSight:
    """Reads the controlled vehicles from SUMO, and adds the recorded actors.

    Args:
        sight: Object that reads scenes from SUMO.
        script: The recorded paths by step of the episode. Actors in sight at the end of the recording drive straight
            on afterwards.
    """

    def __init__(self, sight: Sight, script: Paths) -> None:
        self._sight, self._script = sight, script
        self._agents = {path.actor.id: path for path in script.agents}
        self._roster = Roster(())

    def look(self, steps: int, off_road: Sequence[str]) -> Scene:
        """Return the scene after this number of steps."""
        scene = self._sight.look(steps, off_road)
        rows = [
            self._agent(scene, row, steps) for row, actor in enumerate(scene.roster.actors) if actor.id in self._agents
        ]
        rows += [self._row(path, steps) for path in self._script.others if self._is_present(path, steps)]
        actors = tuple(actor for actor, *_ in rows)
        if actors != self._roster.actors:
            self._roster = Roster(actors)
        states = [state for _, state, *_ in rows]
        return Scene(
            scene.time_s,
            self._roster,
            [(state.x, state.y) for state in states],
            [state.heading for state in states],
            [state.speed for state in states],
            tuple(hit for hit in scene.contacts if {hit.collider, hit.victim} <= self._agents.keys()),
            tuple(off_road),
            tuple(lane for _, _, lane, _ in rows) if scene.lanes else (),
            [state.z for state in states] if scene.heights else (),
            [state.grade for state in states] if scene.heights else (),
            {row: spine for row, (*_, spine) in enumerate(rows) if spine is not None},
            swept=scene.swept,
            core=scene.core,
        )

    def _agent(self, scene: Scene, row: int, steps: int) -> Row:
        actor = scene.roster.actors[row]
        lane = scene.lanes[row] if scene.lanes else ""
        if steps == 0:  # SUMO reports the new position of a moved vehicle only after the next step
            return actor, self._agents[actor.id].states[0], lane, None
        high = (scene.heights[row], scene.grades[row]) if scene.heights else ()
        state = ActorState(*scene.points[row], scene.headings[row], scene.speeds[row], *high)
        return actor, state, lane, scene.spines.get(row)

    def _is_present(self, path: Path, steps: int) -> bool:
        return path.first <= steps and (steps <= path.last or path.last >= self._script.steps)

    def _row(self, path: Path, steps: int) -> Row:
        state = path.at(steps, sumo.simulation_getDeltaT())
        lane = next((lane for step, lane in reversed(path.lanes) if step <= steps), "")
        spine = next((spine for step, spine in path.spines if step == steps), None)
        return path.actor, state, lane, spine


def place_agents(script: Paths) -> None:
    """Simulate until the recording begins, and move the controlled vehicles to their recorded start.

    Raises:
        InvalidEpisodeError: The recording has no start of a controlled vehicle.
    """
    step_s = sumo.simulation_getDeltaT()
    while sumo.simulation_getTime() < script.time_s - step_s / 2:
        for path in script.agents:
            sumo.vehicle_setSpeed(path.actor.id, 0.0)  # stops early vehicles from driving away
        libsumo.simulationStep()
    for path in script.agents:
        agent, state = path.actor.id, path.states[0]
        first, lane = path.lanes[0] if path.lanes else (0, "")
        if path.first > 0 or first > 0 or not lane or agent not in sumo.vehicle_getIDList():
            raise InvalidEpisodeError(f"the start position of {agent!r} is unknown, or off every lane")
        libsumo.vehicle.moveTo(agent, lane, _along(lane, (state.x, state.y)))
        libsumo.vehicle.setPreviousSpeed(agent, state.speed)
        sumo.vehicle_setSpeed(agent, -1.0)


def _along(lane: str, point: tuple[float, float]) -> float:
    """Return the position along a lane, in m, of the lane's point that is nearest to a point."""
    shape = [(x, y) for x, y, *_ in sumo.lane_getShape(lane)]
    best = done = 0.0
    least = math.inf
    for (x0, y0), (x1, y1) in pairwise(shape):
        dx, dy = x1 - x0, y1 - y0
        length = math.hypot(dx, dy)
        if length == 0.0:
            continue
        along = min(length, max(0.0, ((point[0] - x0) * dx + (point[1] - y0) * dy) / length))
        away = math.hypot(point[0] - x0 - along * dx / length, point[1] - y0 - along * dy / length)
        if away < least:
            least, best = away, done + along
        done += length
    length = float(sumo.lane_getLength(lane))
    return min(length, best * length / done) if done else 0.0
