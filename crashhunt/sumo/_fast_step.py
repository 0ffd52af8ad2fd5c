"""The fast path on SUMO: the compiled core runs uneventful steps by itself, each in one call."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple, ParamSpec, Protocol, TypeVar

import numpy as np
from libsumo import _libsumo as sumo

from crashhunt.sumo._scene_reader import reach_of
from crashhunt.world import Scene

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from crashhunt.native import Columns, Core, Draft, Vehicles
    from crashhunt.simulators import Kinematics, Observations, Simulator, StepResult
    from crashhunt.sumo._scene_reader import Sight
    from crashhunt.sumo._traffic_events import SumoEvents
    from crashhunt.world import Actor, Roster


_MAX_ROSTERS = 3  # rosters to keep: of the last scene, the scene before it, and the next scene, which may not be needed
_FLOAT32, _FLOAT64 = np.dtype("<f4"), np.dtype("<f8")


P = ParamSpec("P")
T = TypeVar("T")


class WrapsPartOfStep(Protocol):
    """Wraps a function that does a part of a step, so that it raises the same errors as a whole step."""

    def __call__(self, do: Callable[P, T], /) -> Callable[P, T]:
        """Return the wrapped function."""


class PresentVehicles(NamedTuple):
    """The state of a simulator between two steps."""

    scene: Scene
    observations: Observations
    steps: int


class UsualSteps:
    """Implements `FastStepper`: runs uneventful steps of an episode in the compiled core.

    While the core runs steps, the simulator, its sight and its events keep an older state. The method `catch_up` brings
    them to the state of the core. The method `resume` brings the core to the state of these objects.

    Args:
        core: The compiled core.
        agent: The only agent of the episode.
        sight: Object that reads scenes from SUMO.
        events: Object that detects traffic events.
        kinematics: Object that makes observations.
        simulate: Function that simulates a step.
        part: Function that wraps another function, which does a part of a step, so that it raises the same errors as a
            whole step.
        present: Function that returns the state of the simulator.
        arrive: Function called with the new state of the simulator.
        apply: Function that applies an action and returns whether the step can stay uneventful.
        finish: Function that completes an eventful step, which SUMO has already simulated.
        from_left: Function that returns the distance in m from the centre line of an edge's leftmost lane to the centre
            line of another lane.
        start_m: The distance that the agent had driven at the start, in m.
        step_length_s: Step length, in s.
        lateral: Whether vehicles may leave the centre line of a lane.
        takes: The kind of actions: 1 for `SpeedAndLaneChange`, 2 for `AccelerationAndLaneChange`, 0 for others.
        perceive: Function that makes an observation that consists of parts; None for the default observation.
        draft: What the core writes observations that consist of parts into; None if it does not write them.
        enter_parts: Function called with the vehicles in sight, the row of the agent and the roster; None without a
            draft.
        shape: Shape of the observation's array.
        restore: Function that returns what the agent receives, from such an observation.
        record: Type of such an observation as one value, whose fields the agent receives; None if it receives others.
        instead_of: Attributes of the simulator that the core bypasses, by name.
    """

    def __init__(
        self,
        core: Core,
        agent: str,
        sight: Sight,
        events: SumoEvents,
        kinematics: Kinematics,
        *,
        simulate: Callable[[], None],
        part: WrapsPartOfStep,
        present: Callable[[], PresentVehicles],
        arrive: Callable[[PresentVehicles], None],
        apply: Callable[[str, NDArray[np.generic]], bool],
        finish: Callable[[Mapping[str, NDArray[np.generic]]], StepResult],
        from_left: Callable[[str, int], float],
        start_m: float,
        step_length_s: float,
        lateral: bool,
        takes: int,
        perceive: Callable[[Scene, int, str], NDArray[np.generic]] | None,
        draft: Draft | None,
        enter_parts: Callable[[Vehicles, int, Roster], None] | None,
        shape: tuple[int, ...],
        restore: Callable[[NDArray[np.generic]], object],
        record: np.dtype[np.void] | None,
        instead_of: Mapping[str, object],
    ) -> None:
        self._core, self._agent = core, agent
        self._sight, self._events, self._kinematics = sight, events, kinematics
        self._present, self._arrive = present, arrive
        self.apply, self.finish = part(apply), part(finish)
        array = np.ndarray, shape, _FLOAT32 if draft is None else _FLOAT64
        self.core = core.UsualSteps(
            agent, SimpleNamespace(simulationStep=simulate), array, kinematics.shape[0] - 1,
            step_length_s, lateral, takes, sight.around, start_m,
        )  # fmt: skip
        self.core.meet(sight.known, sight.know, reach_of, part(self._adopt))
        self._perceive, self._enter_parts = perceive, enter_parts
        if perceive is not None:
            names = () if record is None else record.names or ()
            self.core.perceive(self._make_observation, restore, draft, record, names)
        self._from_left, self._instead_of = from_left, instead_of
        self._last: StepResult = ({}, {}, {}, {}, {})
        self._rosters: dict[Vehicles, Roster] = {}  # of the scenes that `catch_up` may need

    def is_unpatched(self, simulator: Simulator) -> bool:
        """Return whether the simulator still has the attributes that the core bypasses; false for a wrapper."""
        return all(getattr(simulator, name) == own for name, own in self._instead_of.items())

    def begin(self) -> None:
        """Pass the event counters of the new episode to the core."""
        self.core.heed(*self._events.counted)
        self._controlled = self._events.controlled

    @property
    def roster(self) -> Roster:
        """The actors in sight; while the core runs a step, they may already be the actors after this step."""
        return self._sight.roster

    def _adopt(self, vehicles: Vehicles, ids: tuple[str, ...], actors: tuple[Actor, ...], row: int) -> Roster:
        """Set the vehicles in sight, and return their roster."""
        roster = self._sight.adopt(vehicles, ids, actors)
        while len(self._rosters) > _MAX_ROSTERS:
            del self._rosters[next(iter(self._rosters))]
        self._rosters[vehicles] = roster
        if self._enter_parts is not None:
            self._enter_parts(vehicles, row, roster)
        return roster

    def _make_observation(self, columns: Columns, time_s: float, row: int, lane: str) -> NDArray[np.generic]:
        assert self._perceive is not None
        scene = Scene(time_s, self.roster, swept=True, core=self._core, columns=columns)
        return self._perceive(scene, row, lane)

    def resume(self) -> Scene | None:
        """Bring the core to the state of the simulator; return the scene, or None if that is not possible yet."""
        self.catch_up()
        (scene, observations, steps), seen = self._present(), self._sight.plain
        lane, columns, agent = scene.agent_lanes.get(self._agent, ""), scene.columns, self._agent
        if seen is None or columns is None or not lane or not self._events.is_quiet(agent) or self._kinematics.hidden:
            return None
        vehicles, ids = seen
        edge, _, number = lane.rpartition("_")
        where = edge, int(number), lane, self._from_left(edge, int(number))
        row = scene.roster.index[agent]
        self._rosters = {vehicles: scene.roster}
        self.core.resume(
            (vehicles, ids, row, self._controlled, scene.roster.actors), observations[agent], columns, scene.time_s,
            "\n".join(scene.lanes), where, self._events.followers[agent], steps,
        )  # fmt: skip
        return scene

    def catch_up(self) -> StepResult:
        """Bring the simulator to the state of the core; return the result that its last step would have returned."""
        state = self.core.told()
        before, agent = self._present(), self._agent
        if state is None or state[0] <= before.steps:
            return self._last
        step, observation, reward, follower, now, last = state
        previous = before.scene if step == before.steps + 1 else self._scene(before.scene, True, *last)
        scene = self._scene(before.scene, False, *now)
        scene.follow(previous)
        observations: Observations = {agent: observation}  # type: ignore[dict-item]
        self._events.resume(scene, step, {agent: follower})
        self._arrive(PresentVehicles(scene, observations, step))
        self._last = observations, {agent: reward}, {agent: False}, {agent: False}, {agent: {}}
        return self._last

    def reads_right(self) -> bool:
        """Return whether the core's values are bit-identical to the values of libsumo's getters."""
        agent, lane = self._agent, sumo.vehicle_getLaneID(self._agent)
        if self._sight.plain is None or not lane:
            return True
        vehicles, ids = self._sight.plain
        along = sumo.vehicle_getLanePosition(agent)
        read = (
            sumo.vehicle_getRoadID(agent),
            sumo.vehicle_getLaneIndex(agent),
            sumo.vehicle_getDistance(agent),
            sumo.vehicle_getLateralLanePosition(agent),
            sumo.vehicle_getLateralSpeed(agent),
            along,
            sumo.lane_getAngle(lane, along),
            sumo.lane_getMaxSpeed(lane),
            sumo.vehicle_getDecel(agent),
            "".join(f"{sumo.vehicle_getLaneID(vehicle)}\n" for vehicle in ids),
            sumo.vehicle_getFollower(agent)[0],
            sumo.vehicle_getStopState(agent),
            sumo.simulation_getTime(),
            sumo.simulation_getEmergencyStoppingVehiclesNumber(),
            sumo.vehicle_getVehicleClass(agent),
            sumo.vehicle_getLength(agent),
            sumo.vehicle_getWidth(agent),
        )
        lights = sumo.trafficlight_getIDList()[:1]
        states = [sumo.trafficlight_getRedYellowGreenState(light) for light in lights]
        right = repr(self.core.reads(vehicles)) == repr(read)
        return right and [self._core.light_state(light) for light in lights] == states

    def _scene(self, like: Scene, back: bool, vehicles: Vehicles, time_s: float, lanes: str) -> Scene:
        scene = Scene(
            time_s, self._rosters[vehicles], lanes=tuple(lanes.split("\n")) if lanes else (), swept=True,
            core=self._core, columns=self.core.columns(back),
        )  # fmt: skip
        scene.agent_lanes = dict(like.agent_lanes)
        return scene
