"""Steps on SUMO in which nothing happens, which the compiled core takes by itself, each in one call."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple, ParamSpec, Protocol, TypeVar

import numpy as np
from libsumo import _libsumo as sumo

from crashhunt.world import Scene

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from crashhunt.native import Core, Vehicles
    from crashhunt.simulators._kinematics import Kinematics
    from crashhunt.simulators._protocol import Observations, Simulator, StepResult
    from crashhunt.simulators.sumo._scene_reader import Sight
    from crashhunt.simulators.sumo._traffic_events import SumoEvents
    from crashhunt.world import Roster


__all__ = ["Present", "UsualSteps"]


_ROSTERS = 3  # of the last scene and the one before; that of the next may not come to be
_OBSERVED = np.dtype("<f4")


P = ParamSpec("P")
T = TypeVar("T")


class MakesPart(Protocol):
    """Makes of what does a part of a step one that raises what a step does."""

    def __call__(self, do: Callable[P, T], /) -> Callable[P, T]:
        """Return it."""


class Present(NamedTuple):
    """Where a simulator is.

    Args:
        scene: after the last step.
        observations: what the agents are shown next.
        steps: how many are complete.
    """

    scene: Scene
    observations: Observations
    steps: int


class UsualSteps:
    """Takes the steps of one episode in which nothing happens; as `AtOnce` says.

    While the core goes ahead, everybody else stays where they were: the simulator, its sight and its events. `catch_up`
    brings them to where the core is, `resume` brings the core to where they are.

    Args:
        core: the compiled part.
        agent: the only one of the episode.
        sight: what scenes are read by.
        events: what looks for events.
        kinematics: what observations are made by.
        simulate: simulates a step.
        part: makes of what does a part of a step one that raises what a step does.
        present: returns where the simulator is.
        arrive: called with where the core has come to.
        apply: applies an action; returns whether there is nothing about it to look into.
        finish: does what is left of a step that has been simulated.
        from_left: returns how far right of the middle of an edge's leftmost lane that of another one is, in m.
        start_m: how far the agent had driven at the start, in m.
        step_length_s: in s.
        lateral: whether vehicles may be elsewhere than in the middle of a lane.
        takes_speed: whether actions are a speed and a change of lane.
        instead_of: what it does without calling it, as a simulator has it.
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
        part: MakesPart,
        present: Callable[[], Present],
        arrive: Callable[[Present], None],
        apply: Callable[[str, NDArray[np.generic]], bool],
        finish: Callable[[Mapping[str, NDArray[np.generic]]], StepResult],
        from_left: Callable[[str, int], float],
        start_m: float,
        step_length_s: float,
        lateral: bool,
        takes_speed: bool,
        instead_of: Mapping[str, object],
    ) -> None:
        self._core, self._agent = core, agent
        self._sight, self._events, self._kinematics = sight, events, kinematics
        self._present, self._arrive = present, arrive
        self.apply, self.finish, self.enter = part(apply), part(finish), part(self._enter)
        shape = kinematics.shape
        self.core = core.UsualSteps(
            agent, SimpleNamespace(simulationStep=simulate), (np.ndarray, shape, _OBSERVED), shape[0] - 1,
            step_length_s, lateral, takes_speed, sight.around, start_m,
        )  # fmt: skip
        self._from_left, self._instead_of = from_left, instead_of
        self._last: StepResult = ({}, {}, {}, {}, {})
        self._rosters: dict[Vehicles, Roster] = {}  # of the scenes that may be asked for

    def is_unpatched(self, simulator: Simulator) -> bool:
        """Whether nothing that it does is somebody else's in a simulator, such as in a wrapper around this one."""
        return all(getattr(simulator, name) == own for name, own in self._instead_of.items())

    def begin(self) -> None:
        """Take what is counted in this episode, which is about to begin."""
        self.core.heed(*self._events.counted)
        self._controlled = self._events.controlled

    @property
    def roster(self) -> Roster:
        """Who is in sight, or will be after the step that the core takes."""
        return self._sight.roster

    def _enter(self, ids: tuple[str, ...]) -> tuple[Vehicles, tuple[str, ...], int, dict[str, object]] | None:
        """Take note of who is in sight; None where there is more about them than the core knows."""
        self._sight.see(ids)
        seen, row = self._sight.plain, self.roster.index.get(self._agent)
        if seen is None or row is None:
            return None
        while len(self._rosters) > _ROSTERS:
            del self._rosters[next(iter(self._rosters))]
        self._rosters[seen[0]] = self.roster
        return *seen, row, self._controlled

    def resume(self) -> Scene | None:
        """Have the core go on from here; return the scene, None where that has to wait."""
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
            (vehicles, ids, row, self._controlled), observations[agent], columns, scene.time_s,
            "\n".join(scene.lanes), where, self._events.followers[agent], steps,
        )  # fmt: skip
        return scene

    def catch_up(self) -> StepResult:
        """Bring everybody else to where the core is; return what the last step would have returned."""
        told = self.core.told()
        before, agent = self._present(), self._agent
        if told is None or told[0] <= before.steps:
            return self._last
        step, observation, reward, follower, now, last = told
        previous = before.scene if step == before.steps + 1 else self._scene(before.scene, True, *last)
        scene = self._scene(before.scene, False, *now)
        scene.follow(previous)
        observations: Observations = {agent: observation}  # type: ignore[dict-item]
        self._events.go_on(scene, step, {agent: follower})
        self._arrive(Present(scene, observations, step))
        self._last = observations, {agent: reward}, {agent: False}, {agent: False}, {agent: {}}
        return self._last

    def reads_right(self) -> bool:
        """Whether the core reads what libsumo's getters return, to the bit."""
        if self._sight.plain is None:
            return True
        vehicles, ids = self._sight.plain
        agent, lane = self._agent, sumo.vehicle_getLaneID(self._agent)
        along = sumo.vehicle_getLanePosition(agent)
        read = (
            sumo.vehicle_getRoadID(agent),
            sumo.vehicle_getLaneIndex(agent),
            sumo.vehicle_getDistance(agent),
            sumo.vehicle_getLateralLanePosition(agent),
            sumo.vehicle_getLateralSpeed(agent),
            along,
            sumo.lane_getAngle(lane, along),
            sumo.vehicle_getDecel(agent),
            "".join(f"{sumo.vehicle_getLaneID(one)}\n" for one in ids),
            sumo.vehicle_getFollower(agent)[0],
            sumo.vehicle_getStopState(agent),
            sumo.simulation_getTime(),
            sumo.simulation_getEmergencyStoppingVehiclesNumber(),
        )
        return repr(self.core.reads(vehicles)) == repr(read)

    def _scene(self, like: Scene, back: bool, vehicles: Vehicles, time_s: float, lanes: str) -> Scene:
        scene = Scene(
            time_s, self._rosters[vehicles], lanes=tuple(lanes.split("\n")) if lanes else (), swept=True,
            core=self._core, columns=self.core.columns(back),
        )  # fmt: skip
        scene.agent_lanes = dict(like.agent_lanes)
        return scene
