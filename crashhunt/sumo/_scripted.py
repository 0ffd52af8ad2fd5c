"""Playback of paths on SUMO, recorded or of a manoeuvre: SUMO simulates the controlled vehicles, scenes add the others.

When SUMO moves a vehicle to a position, it maps the vehicle to a lane nearby and derives the speed from the distance.
SUMO would thus change the states of the paths, so the other actors are not in SUMO. Instead, this module copies their
states into the scenes, bit-identical. Observations and contacts are computed from scenes. SUMO's own safe-speed checks
do not see the other actors.
"""

from __future__ import annotations

import math
from itertools import chain, pairwise
from typing import TYPE_CHECKING, cast

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.sumo._options import arguments_of
from crashhunt.trial import InputSignal, fold_signals
from crashhunt.world import (
    START_M,
    Actor,
    ActorState,
    Path,
    Paths,
    Roster,
    Scene,
    actor_of_manoeuvre,
    manoeuvre_motions,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from crashhunt.sumo._scene_reader import Sight
    from crashhunt.trial import Value
    from crashhunt.world import Spine

    Row = tuple[Actor, ActorState, str, Spine | None]


class ScriptedSight:
    """Reads the controlled vehicles from SUMO, and adds the actors of the paths.

    Args:
        sight: Object that reads scenes from SUMO.
        script: The paths by step of the episode. Actors in sight at the end of the recording drive straight
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


# The paths of other vehicles in the manoeuvres of UN R157, computed from the arguments of a scenario.
#
# All vehicles drive along the x axis, on two lanes of one edge.

_STEPS = 600  # after these steps, the other vehicles drive straight on
_KMH = 3.6
_SIGNED = {"side": 1.0, "from_side": 1.0, "offset_m": 10.0, "impact_m": 10.0, "beside_m": 100.0}
_ABOVE_ZERO = {"period_s": 0.1}


def manoeuvre_paths(manoeuvre: str, agent: str, arguments: Mapping[str, Value], step_s: float) -> Paths:
    """Return the paths of all vehicles of a manoeuvre, with the controlled vehicle at its start.

    The arguments are those of `arguments_of`.

    Raises:
        InvalidEpisodeError: an argument is out of its range.
    """
    names = arguments_of(manoeuvre, arguments)
    folded = fold_signals(arguments)
    values = {name: _checked(name, folded[name]) for name in names}
    ego_kmh = cast("float", values["ego_kmh"])
    slower_kmh = values.get("slower_kmh", 0.0)
    if manoeuvre == "cut_in" and not callable(slower_kmh) and slower_kmh > ego_kmh:
        raise InvalidEpisodeError(
            f"slower_kmh is {slower_kmh:g} (allowed: 0 to ego_kmh, {ego_kmh:g})",
            fix="give a smaller value",
        )
    lanes = sorted(str(lane) for lane in sumo.lane_getIDList() if not str(lane).startswith(":"))
    if len(lanes) != 2:
        raise InvalidEpisodeError(f"the network has {len(lanes)} lanes, and a manoeuvre needs 2")
    right_to_left = cast("float", values.get("side", -1.0)) < 0
    own, next_lane = (lanes[1], lanes[0]) if right_to_left else (lanes[0], lanes[1])
    own_y, next_y = (float(sumo.lane_getShape(lane)[0][1]) for lane in (own, next_lane))
    speed = ego_kmh / _KMH
    states = manoeuvre_motions(manoeuvre, values, own_y, next_y, step_s)
    rows = [next(states) for _ in range(_STEPS + 1)]
    others = tuple(_path(name, rows, {own: own_y, next_lane: next_y}) for name in dict.fromkeys(chain(*rows)))
    start = Path(
        actor=actor_of_manoeuvre(agent), first=0, states=(ActorState(START_M, own_y, 0.0, speed),), lanes=((0, own),)
    )
    return Paths(time_s=0.0, steps=_STEPS, agents=(start,), others=others)


def _checked(name: str, value: object) -> float | InputSignal:
    if not isinstance(value, InputSignal):
        return _number(name, value)
    for point in value.points:
        _number(name, point)
    return value


def _number(name: str, value: object) -> float:
    number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    low, high = (-_SIGNED[name], _SIGNED[name]) if name in _SIGNED else (_ABOVE_ZERO.get(name, 0.0), 1000.0)
    if not low <= number <= high:
        raise InvalidEpisodeError(
            f"the argument {name} is {value!r} (allowed: {low:g} to {high:g})", fix="give a value in this range"
        )
    return number


def _path(name: str, rows: list[dict[str, ActorState]], lanes: Mapping[str, float]) -> Path:
    first = next(step for step, row in enumerate(rows) if name in row)
    states = tuple(row[name] for row in rows[first:])
    return Path(actor=actor_of_manoeuvre(name), first=first, states=states, lanes=tuple(_lanes(first, states, lanes)))


def _lanes(first: int, states: tuple[ActorState, ...], lanes: Mapping[str, float]) -> Iterator[tuple[int, str]]:
    last = ""
    for step, state in enumerate(states, first):
        lane = min(lanes, key=lambda one: abs(lanes[one] - state.y))
        if lane != last:
            yield step, lane
        last = lane
