"""Observations that consist of parts which follow from scenes, for simulators without readers of their own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import cos, sin
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.simulators._bicycle_model import WHEELBASE_SHARE
from crashhunt.simulators._kinematics_observation import kind_number
from crashhunt.simulators._line_of_sight import RayCaster, occluded
from crashhunt.simulators._observation_layout import History, RequestedPart, layouts_of
from crashhunt.simulators._observation_parts import REACH_M, SCENE_PARTS
from crashhunt.simulators._scene_parts import (
    ActorNumbers,
    NearActor,
    center_of,
    covariances_of,
    nearest_actors,
    predictions_of,
    with_range_noise,
    with_reference_point,
    wrapped,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from numpy.typing import NDArray

    from crashhunt.scenario import AgentSetup
    from crashhunt.world import Scene

_MAX_BEND = 2.0  # of the wheelbase times the curvature, with the front wheels across


@dataclass(frozen=True, slots=True, kw_only=True)
class LanePlace:
    """The place of an actor on the lanes."""

    same_lane: bool = True  # whether the actor is on the lane of the agent's vehicle, or on a lane before or after it
    # distance of the front bumper's centre from the centre line of the lane, in m, positive to the left
    offset: float = 0.0
    index: int = 0  # index of the lane on its road, from 0 for the outer lane


class SceneObserver:
    """Builds the observations of all agents that observe parts."""

    def __init__(self, setups: Mapping[str, AgentSetup], others: Iterable[str] = ()) -> None:
        self.layouts = layouts_of(setups, (*SCENE_PARTS, *others))  # the layout of each such agent's observation
        # pairs of identifiers: an agent, and an actor that this agent does not see
        self.hidden: set[tuple[str, str]] = set()
        self._step_length_s = self._start_s = 0.0
        self._seed = 0
        self._histories: dict[str, History] = {}
        self._casters: dict[tuple[int, float], RayCaster] = {}
        self._numbers: dict[str, ActorNumbers] = {}
        self._before: dict[str, dict[str, tuple[float, float]]] = {}

    def begin(self, time_s: float, step_length_s: float, seed: int) -> None:
        """Begin an episode of a seed at a simulation time, with a step length, both in s."""
        self._start_s, self._step_length_s, self._seed = time_s, step_length_s, seed
        self._histories = {agent: History(layout) for agent, layout in self.layouts.items()}
        self._before, self._numbers = {}, {}
        self.hidden.clear()

    def blank(self, agent: str) -> NDArray[np.generic]:
        """Return the recorded array of an agent that has left the simulation."""
        return self.layouts[agent].blank()

    def observe(
        self,
        agent: str,
        scene: Scene,
        *,
        distance: float,
        place: Callable[[int], LanePlace],
        steering: float | None = None,
        other: Callable[[RequestedPart], NDArray[np.float64]] | None = None,
    ) -> NDArray[np.generic]:
        """Return the recorded array of an agent's observation; crashhunt calls this method once per step.

        Args:
            agent: The agent.
            scene: The scene after the last step, which contains the agent's vehicle.
            distance: The distance that the vehicle has driven, in m.
            place: Function that returns the place on the lanes of the actor in a row of the scene.
            steering: The steering angle, in rad, positive to the left; None to compute it from the yaw rate.
            other: Function that returns a part that the simulator reads itself.
        """
        layout, row = self.layouts[agent], scene.roster.index[agent]
        motion = _Motion(scene, self._before.get(agent, {}), self._step_length_s)
        self._before[agent] = motion.now
        hidden = frozenset(other for who, other in self.hidden if who == agent)
        if layout.occlusion_rays:
            hidden |= occluded(scene, row, self._caster(layout.occlusion_rays, REACH_M))
        arrays: dict[str, NDArray[Any]] = {}
        for name, one in layout.parts.items():
            if name == "ego":
                arrays[name] = self._ego(scene, row, motion, place(row), distance=distance, steering=steering)
                continue
            if other is not None and name not in SCENE_PARTS:
                arrays[name] = other(one)
                continue
            reach = one.settings["range"] + max(scene.roster.lengths) if name == "lidar2d" else one.settings["radius"]
            limit = None if name == "lidar2d" else int(one.settings["rows"])
            near = nearest_actors(scene, row, hidden=hidden, radius=reach, limit=limit)
            if name == "lidar2d":
                caster = self._caster(int(one.settings["rays"]), one.settings["range"])
                ranges = caster.cast(scene, row, [found.row for found in near])
                step = round((scene.time_s - self._start_s) / self._step_length_s)
                arrays[name] = with_range_noise(ranges, one.settings, seed=self._seed, agent=agent, step=step)
            elif name == "predictions":
                arrays[name] = predictions_of(
                    scene, near, shape=one.shape, interval=one.settings["interval"],
                    reference_share=layout.reference_share,
                )  # fmt: skip
            elif name == "prediction_covariance":
                arrays[name] = covariances_of(scene, near, one.settings, shape=one.shape)
            elif name == "actor_ids":
                numbers = self._numbers.setdefault(agent, ActorNumbers())
                arrays[name] = numbers.of(scene, near, int(one.settings["rows"]))
            else:
                arrays[name] = _actors(scene, row, near, motion, place, one.shape)
        if layout.reference_share:
            with_reference_point(arrays, layout.columns, layout.reference_share)
        return layout.flat(self._histories[agent].add(arrays))

    def _ego(
        self, scene: Scene, row: int, motion: _Motion, place: LanePlace, *, distance: float, steering: float | None
    ) -> NDArray[np.float64]:
        actor, heading, speed = scene.roster.actors[row], scene.headings[row], scene.speeds[row]
        acceleration, yaw_rate = motion.of(row)
        if steering is None:
            steering = bicycle_steering(yaw_rate, speed, actor.length)
        x, y = center_of(scene, row)
        return np.array(
            (
                x, y, wrapped(heading), speed, acceleration, yaw_rate, steering, actor.length, actor.width,
                place.index, place.offset, distance, scene.time_s - self._start_s,
            )
        )  # fmt: skip

    def _caster(self, rays: int, reach_m: float) -> RayCaster:
        found = self._casters.get((rays, reach_m))
        if found is None:
            found = self._casters[rays, reach_m] = RayCaster(rays, reach_m)
        return found


class _Motion:
    """The changes of speed and heading of actors since the last step."""

    def __init__(self, scene: Scene, before: Mapping[str, tuple[float, float]], step_length_s: float) -> None:
        self.now = {
            actor.id: (heading, speed)
            for actor, heading, speed in zip(scene.roster.actors, scene.headings, scene.speeds, strict=True)
        }
        self._actors, self._before, self._step_length_s = scene.roster.actors, before, step_length_s

    def of(self, row: int) -> tuple[float, float]:
        """Return the acceleration and the yaw rate of an actor; 0 if it was not there one step before."""
        name = self._actors[row].id
        heading, speed = self.now[name]
        was_heading, was_speed = self._before.get(name, (heading, speed))
        return (speed - was_speed) / self._step_length_s, wrapped(heading - was_heading) / self._step_length_s


def bicycle_steering(yaw_rate: float, speed: float, length: float) -> float:
    """Return the steering angle with which a kinematic bicycle model turns as a vehicle does, in rad.

    The model is that of `BicycleModel`. Let δ be the steering angle, t = tan(δ), and L the wheelbase. Then the yaw rate
    is the speed times t / √(1 + t² / 4) / L. The result is 0 at a standstill.
    """
    bend = yaw_rate * WHEELBASE_SHARE * length / speed if speed > 0.0 else 0.0
    if abs(bend) >= _MAX_BEND:
        return math.copysign(math.pi / 2, bend)
    return math.atan(bend / math.sqrt(1.0 - bend * bend / 4.0))


def _actors(
    scene: Scene,
    row: int,
    near: Iterable[NearActor],
    motion: _Motion,
    place: Callable[[int], LanePlace],
    shape: tuple[int, ...],
) -> NDArray[np.float64]:
    own_x, own_y = center_of(scene, row)
    own_cos, own_sin = cos(scene.headings[row]), sin(scene.headings[row])
    rows = np.zeros(shape)
    for number, one in enumerate(near):
        actor, heading, speed = scene.roster.actors[one.row], scene.headings[one.row], scene.speeds[one.row]
        on_lane, ahead = place(one.row), (one.x - own_x) * own_cos + (one.y - own_y) * own_sin
        rows[number] = (
            1.0, one.x, one.y, wrapped(heading), speed * cos(heading), speed * sin(heading), motion.of(one.row)[0],
            actor.length, actor.width, kind_number(actor.kind), on_lane.same_lane, ahead, on_lane.offset, 0.0, 0.0,
        )  # fmt: skip
    return rows
