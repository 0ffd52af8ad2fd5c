"""Playback of recorded paths on highway-env: vehicles that follow their recorded paths and react to nothing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.world import ActorState

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from highway_env.road.road import Road
    from highway_env.vehicle.objects import RoadObject
    from numpy.typing import NDArray

    from crashhunt.world import Actor, Path, Paths


class Puppet(Vehicle):  # type: ignore[misc]
    """A vehicle that follows a recorded path.

    After each step the state is bit-identical to the recorded state. Between two steps it is interpolated linearly.
    """

    impact: NDArray[np.float64] | None

    def __init__(self, road: Road, path: Path, sub_steps: int, step_length_s: float) -> None:
        self.LENGTH, self.WIDTH = path.actor.length, path.actor.width
        self.path = path
        self.shown = path.states[0]
        self._sub_steps, self._step_length_s = sub_steps, step_length_s
        self._done = path.first * sub_steps
        self.route = None  # environments read this attribute
        super().__init__(road, *place_of(path.states[0], path.actor.length))

    def begin(self, steps: int) -> None:
        """Move to the recorded state after this number of steps."""
        self._done = steps * self._sub_steps
        self._move()

    def act(self, action: dict[str, float] | str | None = None) -> None:
        """Do nothing, because the path is fixed."""

    def step(self, dt: float) -> None:
        """Move by a sub-step along the path, regardless of obstacles."""
        self._done += 1
        self._move()

    def predict_trajectory_constant_speed(
        self, times: NDArray[np.float64]
    ) -> tuple[list[NDArray[np.float64]], list[float]]:
        """Return the positions and headings at constant velocity; highway-env's right-of-way rules read them."""
        return [self.position + time * self.velocity for time in times], [self.heading] * len(times)

    def _move(self) -> None:
        steps, rest = divmod(self._done, self._sub_steps)
        self.shown = self.path.at(steps, self._step_length_s)
        if rest:
            self.shown = _between(self.shown, self.path.at(steps + 1, self._step_length_s), rest / self._sub_steps)
        self.position, self.heading, self.speed = place_of(self.shown, self.path.actor.length)
        if self.impact is not None:  # the collision does not push this vehicle, but `contact_of` reads `crashed`
            self.crashed, self.impact = True, None
        self.on_state_update()


class Puppets:
    """Moves the other actors of an episode along recorded paths.

    Args:
        road: The road of the environment. All other vehicles on it are removed.
        script: The recorded paths.
        agents: The controlled vehicles by identifier. These vehicles are placed at their recorded start.
        sub_steps: Number of sub-steps in each step.
        step_length_s: Step length, in s.

    Raises:
        InvalidEpisodeError: The recording has no start of an agent.
    """

    def __init__(
        self, road: Road, script: Paths, agents: Mapping[str, Vehicle], sub_steps: int, step_length_s: float
    ) -> None:
        self._road, self._agents = road, list(agents.values())
        self._end = script.steps
        begins = {path.actor.id: path.states[0] for path in script.agents if path.first == 0}
        for agent, vehicle in agents.items():
            if agent not in begins:
                raise InvalidEpisodeError(f"the start position of {agent!r} is unknown")
            _set_pose(vehicle, begins[agent], late=script.time_s > 0)
        self.things: list[tuple[Path, RoadObject]] = [
            (path, _make_puppet(road, path, sub_steps, step_length_s)) for path in script.others
        ]
        self.enter(0)

    @property
    def actors(self) -> list[tuple[RoadObject, Actor]]:
        """The moved objects, each with its recorded actor."""
        return [(thing, path.actor) for path, thing in self.things]

    def enter(self, steps: int) -> None:
        """Put only the actors on the road that were recorded after a step; keep objects that cannot be hit."""
        road = self._road
        there = [thing for path, thing in self.things if self._is_present(path, steps)]
        known = {id(thing) for thing in road.vehicles}
        for thing in there:
            if isinstance(thing, Puppet) and id(thing) not in known:
                thing.begin(steps)
        road.vehicles = [*self._agents, *(thing for thing in there if isinstance(thing, Vehicle))]
        marks = [thing for thing in road.objects if not (thing.solid and thing.collidable)]
        road.objects = [*marks, *(thing for thing in there if not isinstance(thing, Vehicle))]

    def _is_present(self, path: Path, steps: int) -> bool:
        return path.first <= steps and (steps <= path.last or path.last >= self._end)


def place_of(state: ActorState, length: float) -> tuple[NDArray[np.float64], float, float]:
    """Convert a state in scene coordinates to the centre, heading and speed in highway-env's coordinates."""
    x = state.x - length / 2 * math.cos(state.heading)
    y = state.y - length / 2 * math.sin(state.heading)
    return np.array([x, -y]), -state.heading, state.speed


def _make_puppet(road: Road, path: Path, sub_steps: int, step_length_s: float) -> RoadObject:
    if not path.actor.id.startswith("obstacle."):
        return Puppet(road, path, sub_steps, step_length_s)
    thing = Obstacle(road, *place_of(path.states[0], path.actor.length))
    thing.LENGTH, thing.WIDTH = path.actor.length, path.actor.width
    thing.diagonal = math.hypot(thing.LENGTH, thing.WIDTH)
    return thing


def _set_pose(vehicle: Any, state: ActorState, *, late: bool) -> None:
    """Put a controlled vehicle at its recorded state.

    The recording does not hold the vehicle's intention. If the episode begins late, the vehicle keeps lane and speed.
    """
    vehicle.position, vehicle.heading, vehicle.speed = place_of(state, vehicle.LENGTH)
    vehicle.on_state_update()
    if not late or not isinstance(vehicle, ControlledVehicle):
        return
    vehicle.target_lane_index, vehicle.target_speed = vehicle.lane_index, vehicle.speed
    if isinstance(vehicle, MDPVehicle):
        vehicle.speed_index = vehicle.speed_to_index(vehicle.target_speed)
        vehicle.target_speed = vehicle.index_to_speed(vehicle.speed_index)
    vehicle.route = _remaining_route(vehicle.route, vehicle.lane_index)


def _remaining_route(route: Sequence[Any] | None, lane: Sequence[Any]) -> list[Any] | None:
    """Return the rest of a route from a lane on."""
    if not route:
        return None
    here = [number for number, part in enumerate(route) if tuple(part[:2]) == tuple(lane[:2])]
    return list(route[here[0] :]) if here else list(route)


def _between(state: ActorState, after: ActorState, share: float) -> ActorState:
    turn = math.remainder(after.heading - state.heading, math.tau)
    return ActorState(
        x=state.x + share * (after.x - state.x),
        y=state.y + share * (after.y - state.y),
        heading=state.heading + share * turn,
        speed=state.speed + share * (after.speed - state.speed),
    )
