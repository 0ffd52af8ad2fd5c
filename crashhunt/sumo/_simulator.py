"""SUMO as a simulator, through libsumo. Import this module only in worker processes: libsumo has one instance."""

from __future__ import annotations

import weakref
from functools import partial
from types import MethodType
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import libsumo

# The package's own functions each wrap one of these in a Python call, which doubles the cost of a getter; a step reads
# some two hundred values.
from libsumo import _libsumo as sumo

from crashhunt.base.errors import EpisodeError, InvalidEpisodeError, SimulatorError
from crashhunt.base.foreign_code import Party
from crashhunt.native import core_for, reseed_generators, why_no_reseeding
from crashhunt.scenario import ObservationSetup
from crashhunt.simulators import (
    MAX_ACCELERATION,
    META_ACTIONS,
    AccelerationAndLaneChange,
    FullBraking,
    Kinematics,
    MetaAction,
    NumbersAction,
    SimulatorDrives,
    SpeedAndLaneChange,
    TrajectoryAction,
    Unseen,
)
from crashhunt.sumo._agent_calls import forget_calls, guard_against_agents, refused_calls
from crashhunt.sumo._descriptor import BACKEND
from crashhunt.sumo._disturbances import SumoDisturbances
from crashhunt.sumo._drivable_area import obstacle_outlines
from crashhunt.sumo._driving import FREE_FORMS, Driving, VehicleCommand, hold_vehicle
from crashhunt.sumo._ego_and_actors import vehicle_data_of
from crashhunt.sumo._fast_step import PresentVehicles, UsualSteps
from crashhunt.sumo._files import StagedFiles
from crashhunt.sumo._followers import Followers
from crashhunt.sumo._insertion import VehicleFilter, enter, replaced_by, steps_counted
from crashhunt.sumo._lane_graph import USUAL_CLASS
from crashhunt.sumo._lights_for_pictures import LightReader
from crashhunt.sumo._loading import VERSION, Loading, keep_xml_ready
from crashhunt.sumo._observing import ObservedParts
from crashhunt.sumo._omitted_demand import OmittedDemand
from crashhunt.sumo._options import SumoSetup
from crashhunt.sumo._reader_protocol import AgentMoment
from crashhunt.sumo._scene_reader import Sight
from crashhunt.sumo._scripted import ScriptedSight, manoeuvre_paths, place_agents
from crashhunt.sumo._surroundings import nearest_ahead_of, surroundings_of, unregulated_junctions
from crashhunt.sumo._traffic_events import SumoEvents
from crashhunt.world import PERSON, Lane, first_contact, is_person

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.scenario import Scenario
    from crashhunt.simulators import ActionForm, ActiveDisturbance, Info, Lights, Observations, Options, StepResult
    from crashhunt.trial import Disturbance, Value
    from crashhunt.world import Contact, Motion, Neighbor, Paths, RoadMap, Scene, Surroundings, VehicleData

guard_against_agents()
_simulation_step = libsumo.simulationStep
_FOLLOWED, _MARKED = (224, 138, 0, 255), (198, 40, 40, 255)
_WINDOW_WIDTH_M = 150.0  # width of the visible part of the network when the window follows a vehicle
_FORMS: dict[str, Callable[[], ActionForm]] = {
    "speed_and_lane": SpeedAndLaneChange,
    "speed_and_lateral": partial(NumbersAction, "speed_and_lateral"),
    "meta": MetaAction,
    "acceleration": AccelerationAndLaneChange,
    "acceleration_steering": partial(NumbersAction, "acceleration_steering"),
    "throttle_brake_steering": partial(NumbersAction, "throttle_brake_steering"),
    "trajectory": TrajectoryAction,
    "target_pose": partial(NumbersAction, "target_pose"),
    "sumo": SimulatorDrives,
}
_APPLIED_IN_CORE: Mapping[type, int] = {SpeedAndLaneChange: 1, AccelerationAndLaneChange: 2}
_DECELERATION_LIMIT_BIT = 4  # bit of SUMO's speed mode: no braking harder than the decel of the type
_CORE_DISABLED_NOTICE = "the compiled core is disabled: its values differ from those of libsumo's getters"
P = ParamSpec("P")
T = TypeVar("T")
_TRACI_ERRORS = (libsumo.TraCIException, libsumo.FatalTraCIError)
_current: weakref.ref[SumoSimulator] | None = None  # the simulator that owns the process's libsumo


class SumoSimulator:
    """Runs the episodes of a scenario on SUMO, one after another in one process."""

    def __init__(self, scenario: Scenario, stage: Path) -> None:
        self.step_length_s = scenario.step_length_s
        self._scenario = scenario
        self._files = StagedFiles(scenario, stage)
        self._kinematics = Kinematics(scenario.observation or ObservationSetup())
        self.observation_names = self._kinematics.features
        self.observation_spaces = dict.fromkeys(scenario.agents, self._kinematics.space)
        native = scenario.table(SumoSetup).native is not False
        core = core_for(VERSION, sumo.__file__) if native else None
        self._parts = ObservedParts(scenario, core)
        self._parts.prepare()
        self.observation_layouts = self._parts.layouts
        self.observation_spaces |= {agent: layout.flat_space for agent, layout in self.observation_layouts.items()}
        if self.observation_layouts:
            self.shown_spaces = {agent: layout.space for agent, layout in self.observation_layouts.items()}
        self._forms = {agent: setup.action_form for agent, setup in scenario.agents.items()}
        self.actions: dict[str, ActionForm] = {agent: _FORMS[form]() for agent, form in self._forms.items()}
        self.agents: list[str] = []
        self._unregulated: frozenset[str] | None = None
        # Only with these options of SUMO, or by such an action, can a vehicle leave the centre line of its lane.
        options = scenario.table(SumoSetup).options
        durations = (one.action_settings.get("lane_change_duration_s") for one in scenario.agents.values())
        self._drifts = "speed_and_lateral" in self._forms.values() or any(durations)
        moves = not set(FREE_FORMS).isdisjoint(self._forms.values())
        self._lateral = self._drifts or moves or "lateral-resolution" in options or "lanechange.duration" in options
        net = scenario.folder / scenario.table(SumoSetup).net
        self._driving = Driving(scenario.agents, scenario.step_length_s, net)
        visible = {agent: one.action_settings.get("visible", "front") for agent, one in scenario.agents.items()}
        self._followers = Followers(
            [agent for agent, part in visible.items() if part != "front"],
            scenario.agents,
            lambda: self._parts.graph,
            scenario.step_length_s,
            ignored_ahead=[agent for agent, part in visible.items() if part == "outline"],
        )
        self._followers.prepare()
        self._disturbances = SumoDisturbances(scenario.agents.keys(), scenario.step_length_s, self._driving)
        self._loading = Loading(fix_link_order=scenario.table(SumoSetup).fix_link_order is not False)
        self._sight = Sight(
            tuple(scenario.agents),
            scenario.step_length_s,
            lateral=self._lateral,
            speeds=self._disturbances.speeds,
            core=core,
            reach_m=self._parts.reach_m,
        )
        self._notices: list[str] = []
        self._demand = OmittedDemand(scenario)
        self._lanes: list[Lane] | None = None
        self._program = ["sumo"]
        self._events = SumoEvents(scenario.step_length_s, scenario.events)
        self._taking_part: VehicleFilter | None = None
        self.setup_steps = 0
        self.scripted = False
        self._setups = scenario.agents
        self._look_with: Sight | ScriptedSight = self._sight
        self._lights: LightReader | None = None
        self._scene: Scene
        self.at_once: UsualSteps | None = None

    reported_events = BACKEND.reported_events
    disturbing_kinds = BACKEND.disturbances or ()

    def ready_process(self) -> None:
        """Initialize SUMO's XML library."""
        keep_xml_ready()

    @property
    def notices(self) -> list[str]:
        """Notices on how the last episode was simulated, and on demand that SUMO has omitted."""
        return [*self._notices, *self._demand.notices()]

    def open_window(self) -> None:
        """Show the episodes in sumo-gui, which libsumo contains."""
        self._program = ["sumo-gui", "--start", "--delay", "0", "--window-size", "1200,800"]

    @property
    def window_open(self) -> bool:
        """Whether the window is still open."""
        return bool(libsumo.isLoaded())

    def follow(self, agent: str, other: str) -> None:
        """Colour two actors in the window, and keep the first in view."""
        present = sumo.vehicle_getIDList()
        for name, color in ((agent, _FOLLOWED), (other, _MARKED)):
            if name in present:
                libsumo.vehicle.setColor(name, color)
            elif is_person(name) and name.removeprefix(PERSON) in sumo.person_getIDList():
                libsumo.person.setColor(name.removeprefix(PERSON), color)
        if agent in present:
            (view, *_) = libsumo.gui.getIDList()
            if libsumo.gui.getTrackedVehicle(view) != agent:
                libsumo.gui.trackVehicle(view, agent)
                libsumo.gui.setZoom(view, libsumo.gui.getZoom(view) * max(1.0, self._span_m() / _WINDOW_WIDTH_M))

    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Observations, Info]:
        """Load the scenario, warm up the traffic, and put the controlled vehicles on the road."""
        self._stop_fast_path()
        forget_calls()
        VehicleCommand.forget_all()
        script = self._set_up_traffic(seed, options or {})
        self.agents = list(self._setups)
        self._driving.begin(self.agents)
        for path in script.agents if script is not None else ():
            if path.actor.id in self._driving.moving:  # SUMO reports the new position only after the next step
                self._driving.moving[path.actor.id].place(*path.states[0][:4])
        self._followers.begin()
        for agent, motion in self._driving.moving.items():
            form = self.actions[agent]
            if motion.is_planned and isinstance(form, NumbersAction | TrajectoryAction):
                form.check = motion.check
        self._start = {agent: sumo.vehicle_getDistance(agent) for agent in self.agents}
        self._last_lanes: dict[str, tuple[str, int]] = {}
        self._steps = 0
        self._kinematics.hidden.clear()
        self._off_road: list[str] = []
        self._lights = None
        observations = self._observe_start(seed)
        usual = self._usual_steps()
        if self._sight.core is not None and self._is_core_wrong(observations, usual):
            self._sight.distrust()
            self._parts.core = usual = None
            self._notices.append(_CORE_DISABLED_NOTICE)
            observations = self._observe_start(seed)
        routes = {agent: motion.edges for agent, motion in self._driving.moving.items()}
        self._events.begin(self._scene, self.agents, self._moved, routes)
        self._shown, self.at_once = observations, usual
        if usual is not None:
            usual.begin()
        return observations, {}

    def _set_up_traffic(self, seed: int, options: Options) -> Paths | None:
        """Load the scenario, warm up, and insert the controlled vehicles; return the paths of the scripted actors.

        Raises:
            InvalidEpisodeError: a controlled vehicle cannot be inserted, or SUMO reports an error.
        """
        global _current
        arguments, only, script = options.get("arguments", {}), options.get("only"), options.get("script")
        self.setup_steps = 0
        self._begin(only, script, arguments)
        command = self._files.arguments(seed, arguments)
        try:
            self._demand.begin()
            notice = self._loading.load(self._program, command)
            _current = weakref.ref(self)
            if notice and notice not in self._notices:
                self._notices.append(notice)
            if script is None and (manoeuvre := self._scenario.table(SumoSetup).manoeuvre):
                script = self._planned_paths(manoeuvre, arguments)
                self._begin(only, script, arguments)
            with steps_counted(self, self.step_length_s):
                enter(self._scenario, self._setups, self._replaced, self._taking_part)
            self._demand.read()
            if script is not None:
                place_agents(script)
        except InvalidEpisodeError as error:
            raise self._demand.explained(error, [*self._setups, *self._replaced]) from None
        except _TRACI_ERRORS as error:
            raise InvalidEpisodeError(f"SUMO could not set up the episode: {_one_line(error)}") from error
        return script

    def _observe_start(self, seed: int) -> Observations:
        """Read the scene before the first step, and return what the agents observe in it."""
        steering = {agent: motion.steering for agent, motion in self._driving.moving.items()}
        self._parts.begin(self._start, sumo.simulation_getTime(), steering, seed=seed)
        self._read_scene()
        return self._observe_all()

    party = Party.SIMULATOR
    foreign_packages = ("libsumo", "sumolib", "traci")

    @property
    def why_no_reseeding(self) -> str:
        """Why SUMO's random generators cannot be re-seeded; empty if they can."""
        return why_no_reseeding(VERSION, sumo.__file__)

    def reseed(self, seed: int) -> None:
        """Re-seed the generators of drivers, types and devices; departure times stay as planned."""
        reseed_generators(sumo.__file__, seed)

    def step(self, actions: Mapping[str, NDArray[np.generic]]) -> StepResult:
        """Apply the actions and simulate one step; the reward is the distance driven in the step, in m."""
        if self.at_once is not None and self.at_once.core.step > self._steps:
            self.at_once.catch_up()
        self._off_road = []
        if _current is None or _current() is not self:
            raise SimulatorError(
                "another simulator in this process has been reset after this simulator",
                fix="run one simulation at a time, or each simulation in its own process",
            )
        is_simulating = False
        try:
            if self._followers.agents:
                self._followers.react(actions, self._driving.is_inside_lane)
            for agent, action in actions.items():
                if not self._driving.apply(agent, action):
                    self._off_road.append(agent)
            is_simulating = True
            libsumo.simulationStep()
            is_simulating = False
            self._driving.settle()
            return self._finish(actions)
        except _TRACI_ERRORS as error:
            raise _failure_of(error, is_simulating=is_simulating) from error

    def _finish(self, actions: Mapping[str, NDArray[np.generic]]) -> StepResult:
        """Return the result of a step that SUMO has simulated."""
        if self.at_once is not None:
            self.at_once.core.pause()
        if self._taking_part is not None:
            self._taking_part.remove()
        self._steps += 1
        self._read_scene()
        scene, present = self._scene, self._scene.roster.index
        observations: Observations = {}
        rewards: dict[str, float] = {}
        terminations: dict[str, bool] = {}
        for agent in actions:
            row = present.get(agent)
            observations[agent] = self._blank(agent) if row is None else self._observe(agent, row)
            rewards[agent] = 0.0 if row is None else scene.speed(row) * self.step_length_s
            terminations[agent] = row is None
        scene.events = self._events.look(scene, tuple(actions))
        for agent, motion in self._driving.moving.items() if self._driving.moving else ():
            scene.events += tuple(
                self._events.of_agent(scene, agent, *one) for one in motion.events if agent in actions
            )
        self._shown = observations
        if scene.contacts or self._off_road:
            hit = {name for contact in scene.contacts for name in (contact.collider, contact.victim)}
            terminations |= dict.fromkeys(hit.union(self._off_road).intersection(actions), True)
        if True in terminations.values():
            self.agents = [agent for agent in self.agents if not terminations.get(agent, False)]
        return observations, rewards, terminations, dict.fromkeys(actions, False), self._infos(actions)

    def scene(self) -> Scene:
        """Return the state of the vehicles in sight."""
        if self.at_once is not None and self.at_once.core.step > self._steps:
            self.at_once.catch_up()
        return self._scene

    def lanes(self) -> list[Lane]:
        """Return all lanes of the network, including those inside junctions."""
        if self._lanes is None:
            self._lanes = [
                Lane(lane, sumo.lane_getWidth(lane), tuple(tuple(point) for point in sumo.lane_getShape(lane)))
                for lane in sumo.lane_getIDList()
            ]
        return self._lanes

    def obstacles(self) -> list[Lane]:
        """Return the outlines of the obstacles in additional files."""
        return [Lane(name, 0.0, (*shape, shape[0])) for name, shape in obstacle_outlines().items()]

    def lights(self) -> Lights:
        """Return traffic lights, the lights of vehicles, and what is ahead of the agents on their routes."""
        if self._lights is None:
            self._lights = LightReader(self._scenario, self._start)
        lanes = {}
        for agent in self.agents:
            edge, lane = sumo.vehicle_getRoadID(agent), sumo.vehicle_getLaneIndex(agent)
            edge, lane = (edge, lane) if lane >= 0 else self._last_lanes.get(agent) or (edge, 0)
            lanes[agent] = f"{edge}_{lane}"
        return self._lights.read(self._scene, lanes)

    def prepare_road_maps(self) -> None:
        """Read the network."""
        self._parts.graph.lanes_for(USUAL_CLASS)

    def road_map(self, agent: str) -> RoadMap:
        """Return the map of the roads, with the route of a vehicle that has entered."""
        return self._parts.places(agent).road_map()

    def vehicle_data(self, agent: str) -> VehicleData:
        """Return the size and the limits of a vehicle that has entered."""
        return vehicle_data_of(agent)

    def full_braking(self, agent: str) -> FullBraking:
        """Return the action for the hardest braking that the speed mode of the vehicle allows."""
        setup, form = self._scenario.agents[agent], self._forms[agent]
        if motion := self._driving.moving.get(agent):
            most = motion.model.max_deceleration
            how = "the maximum of its vehicle type, and steering to the middle of its lane"
            return FullBraking(motion.brake(), how, deceleration=most, choose=motion.brake)
        if form == "meta":
            return FullBraking(META_ACTIONS.index("SLOWER"), "by answering SLOWER in every step")
        action = (-MAX_ACCELERATION if form == "acceleration" else 0.0, 0)
        if setup.speed_mode & _DECELERATION_LIMIT_BIT:
            return FullBraking(action, "the maximum of its vehicle type", float(libsumo.vehicle.getDecel(agent)))
        return FullBraking(action, f"as hard as its speed mode {setup.speed_mode} allows")

    def is_steered(self, agent: str) -> bool:
        """Whether a vehicle moves freely, so that its actions have no lanes."""
        return self._forms[agent] in FREE_FORMS

    def motion_of(self, agent: str, action: NDArray[np.generic]) -> Motion:
        """Return what an encoded action of a vehicle that moves freely does within the next step."""
        self.scene()  # brings SUMO to the current step
        return self._driving.moving[agent].motion_of(action)

    def action_with(
        self, agent: str, action: NDArray[np.generic] | None, *, speed_mps: float | None, keeps_lane: bool
    ) -> NDArray[np.generic]:
        """Return an action with another speed, or with the steering that keeps the lane."""
        moving = self._driving.moving[agent]
        return self.actions[agent].encode(moving.action_with(action, speed_mps=speed_mps, keeps_lane=keeps_lane))

    def surroundings(self, agent: str) -> Surroundings:
        """Return what a careful driver of the vehicle would consider after the last step."""
        self.scene()  # brings SUMO to the current step
        if self._unregulated is None:  # the network is read at the first use; libsumo has no getter
            self._unregulated = unregulated_junctions(self._scenario.folder / self._scenario.table(SumoSetup).net)
        return surroundings_of(agent, self._driving.neighboring_lane, self._unregulated)

    def nearest_ahead(self, agent: str, kind: str) -> Neighbor | None:
        """Return the vehicle ahead, or the next red light; None without one."""
        return nearest_ahead_of(agent, kind)

    def speed_limit(self, agent: str) -> float:
        """Return the speed limit of the vehicle's lane, which can differ from that of the network file."""
        return float(libsumo.lane.getMaxSpeed(libsumo.vehicle.getLaneID(agent)))

    def resolve_target(self, disturbance: Disturbance) -> str:
        """Return the actor that a disturbance names by a place, such as ``ahead``; empty if there is none."""
        return self._disturbances.resolve_target(disturbance, self.scene())

    def disturb(self, vehicle: str, disturbance: Disturbance) -> ActiveDisturbance | None:
        """Disturb a vehicle until the disturbance ends."""
        if disturbance.what == "unseen":
            return Unseen(self._kinematics, disturbance.agent, vehicle)
        return self._disturbances.disturb(vehicle, disturbance)

    def hold(self, vehicle: str, what: str) -> ActiveDisturbance | None:
        """Apply a hold to a vehicle until the hold ends; return None for a person."""
        found = hold_vehicle(vehicle, what)
        if what == "gone":
            self._sight.lose(vehicle)
        return found

    @property
    def entered(self) -> list[str]:
        """Identifiers of all actors that have entered; empty if no actor is excluded."""
        return [] if self._taking_part is None else self._taking_part.entered

    def close(self) -> None:
        """End the simulation, unless another simulator of this process has since begun a simulation."""
        if _current is not None and _current() is self and libsumo.isLoaded():
            libsumo.close()

    def _span_m(self) -> float:
        """Return the width of the network in m, which is the initial view of the window."""
        (left, _), (right, _) = libsumo.simulation.getNetBoundary()
        return float(right - left)

    def _begin(self, only: Sequence[str] | None, script: Paths | None, arguments: Mapping[str, Value]) -> None:
        """Reset the state of the last episode, and set the actors that take part in the next episode."""
        self._sight.reset()
        self._sight.leaving.clear()
        self._look_with, setups = self._sight, self._scenario.agents
        self.scripted = script is not None
        if script is not None:
            self._look_with = ScriptedSight(self._sight, script)
            driven = {path.actor.id for path in script.agents}
            setups, only = {agent: setup for agent, setup in setups.items() if agent in driven}, ()
        self._setups, self._replaced = setups, replaced_by(setups, arguments)
        self._moved = {**self._scenario.agents, **dict.fromkeys(script.names if script is not None else ())}
        stay = (*(only or ()), *setups, *self._replaced)
        self._taking_part = None if only is None else VehicleFilter(stay, self._sight.leaving)

    def _planned_paths(self, manoeuvre: str, arguments: Mapping[str, Value]) -> Paths:
        """Return the paths of the other vehicles in a manoeuvre with some arguments."""
        defaults = {name: setup.default for name, setup in self._scenario.arguments.items()}
        values = {name: value for name, value in {**defaults, **arguments}.items() if value is not None}
        return manoeuvre_paths(manoeuvre, next(iter(self._scenario.agents)), values, self.step_length_s)

    def _stop_fast_path(self) -> None:
        """Stop the fast path of the last episode in this process, because another episode begins."""
        last = _current() if _current is not None else None
        if last is not None and last.at_once is not None:
            last.at_once.core.stop()
        self.at_once = None

    def _usual_steps(self) -> UsualSteps | None:
        """Return the fast path of this episode; None if the core cannot run whole steps of it."""
        core, plain = self._sight.core, type(self) is SumoSimulator and not self.scripted and self._taking_part is None
        if core is None or not plain or len(self.agents) != 1 or self._drifts:
            return None
        has_parts, draft = self.agents[0] in self.observation_layouts, self._parts.draft(self.agents[0])
        if not (has_parts or self._kinematics.usual):
            return None
        if self._lateral and self._driving.left_hand:
            return None  # the core computes lateral offsets for right-hand traffic only
        (agent,) = self.agents
        # Take the methods of the class, because a caller may have replaced attributes of this object.
        own = {
            method.__name__: MethodType(method, self)
            for method in (
                SumoSimulator.reset,
                SumoSimulator.step,
                SumoSimulator.scene,
                SumoSimulator.restore_observation,
            )
        }
        return UsualSteps(
            core,
            agent,
            self._sight,
            self._events,
            self._kinematics,
            simulate=_simulating(self._driving),
            part=_part,
            present=lambda: PresentVehicles(self._scene, self._shown, self._steps),
            arrive=self._arrive,
            apply=self._apply_alone,
            finish=self._finish,
            from_left=self._driving.from_left,
            start_m=self._start[agent],
            step_length_s=self.step_length_s,
            lateral=self._lateral,
            takes=_APPLIED_IN_CORE.get(type(self.actions[agent]), 0),
            perceive=self._perceive if has_parts else None,
            draft=draft,
            enter_parts=None if draft is None else partial(self._parts.enter, agent),
            shape=self._parts.layouts[agent].flat_space.shape if has_parts else self._kinematics.shape,
            restore=partial(self.restore_observation, agent),
            record=self.observation_layouts[agent].record if has_parts else None,
            instead_of={"actions": self.actions, **own},
        )

    def _perceive(self, scene: Scene, row: int, lane: str) -> NDArray[np.generic]:
        """Return the parts that the only agent observes after a step, which the core may yet leave to this object."""
        moment = AgentMoment(scene=scene, row=row, lane=lane, hidden=frozenset())
        return self._parts.observe(self.agents[0], moment)

    def _infos(self, agents: Iterable[str]) -> dict[str, Info]:
        """Return the info of each agent: the identifiers of the actors in the rows of ``actors``, if it has them."""
        found = {agent: self._parts.identifiers(agent) for agent in agents}
        return {agent: {} if names is None else {"actors": names} for agent, names in found.items()}

    def _arrive(self, present: PresentVehicles) -> None:
        """Set the simulator to the state of the core."""
        self._scene, self._shown, self._steps = present

    def _apply_alone(self, agent: str, action: NDArray[np.generic]) -> bool:
        """Apply an action; return whether the vehicle stays on the road, so that the step can stay uneventful."""
        if self._followers.agents:
            self._followers.react((agent,), self._driving.is_inside_lane)
        self._off_road = [] if self._driving.apply(agent, action) else [agent]
        motion = self._driving.moving.get(agent)
        return not self._off_road and (motion is None or not motion.events)

    def _is_core_wrong(self, observations: Observations, usual: UsualSteps | None) -> bool:
        """Return whether the compiled core returns other values than the Python code that it replaces."""
        core, self._scene.core = self._scene.core, None
        # Readers of parts keep state, so they read each step once; `reads_right` compares all values that they read.
        plain = {} if self.observation_layouts else self._observe_all()
        self._scene.core = core
        same = all(plain[agent].tobytes() == observations[agent].tobytes() for agent in plain)
        return not (same and self._sight.reads_right() and (usual is None or usual.reads_right()))

    def restore_observation(self, agent: str, array: NDArray[np.generic]) -> object:
        """Return the parts that an agent observes, from their recorded array."""
        return self.observation_layouts[agent].restore(array)

    def identifiers(self, agent: str) -> tuple[str, ...] | None:
        """Return the identifiers of the actors in the rows of ``actors``; None if the agent does not observe them."""
        return self._parts.identifiers(agent)

    def _blank(self, agent: str) -> NDArray[np.generic]:
        layout = self.observation_layouts.get(agent)
        return self._kinematics.blank() if layout is None else layout.blank()

    def _observe_all(self) -> Observations:
        return {agent: self._observe(agent, self._scene.roster.index[agent]) for agent in self.agents}

    def _read_scene(self) -> None:
        """Read the scene after the last step."""
        try:
            self._scene = self._look_with.look(self._steps, self._off_road)
        except libsumo.TraCIException:
            self._sight.look_around()  # an agent's own code has removed a vehicle, which SUMO does not report
            self._scene = self._look_with.look(self._steps, self._off_road)
        if self._scene.contacts and self._driving.moving:
            self._scene.contacts = tuple(one for one in self._scene.contacts if self._is_contact(one))

    def _is_contact(self, contact: Contact) -> bool:
        """Return whether a reported collision is one; only outlines tell for a vehicle that moves freely.

        SUMO examines collisions before it places such a vehicle.
        """
        scene, names = self._scene, (contact.collider, contact.victim)
        rows = [scene.roster.index[name] for name in names if name in scene.roster.index]
        if len(rows) < 2 or self._driving.moving.keys().isdisjoint(names):
            return True
        return first_contact(scene.previous if scene.swept else None, scene, rows[0], rows[1]) is not None

    def _observe(self, agent: str, row: int) -> NDArray[np.generic]:
        edge, lane = sumo.vehicle_getRoadID(agent), sumo.vehicle_getLaneIndex(agent)
        is_on_lane = lane >= 0
        if not is_on_lane:  # parked, or moved away by remote control: at its last lane
            edge, lane = self._last_lanes.get(agent) or (edge, 0)
        self._last_lanes[agent] = edge, lane
        self._scene.agent_lanes[agent] = f"{edge}_{lane}"
        if agent in self.observation_layouts:
            perceived = None if self.at_once is None else self.at_once.core.perceived(self._steps)
            if perceived is not None:  # readers keep state, so they read each step once
                return perceived
            moment = AgentMoment(
                scene=self._scene, row=row, lane=f"{edge}_{lane}", hidden=self._kinematics.hidden_from(agent)
            )
            return self._parts.observe(agent, moment)
        lanes = self._driving.lanes(edge)
        from_left, lateral_speed = self._driving.from_left(edge, lane), 0.0
        if self._lateral and is_on_lane:
            aside, lateral_speed = self._driving.aside(agent)
            from_left += aside
        return self._kinematics.observe(
            self._scene,
            row,
            distance=sumo.vehicle_getDistance(agent) - self._start[agent],
            from_left=from_left,
            lateral_speed=lateral_speed,
            lanes=lanes,
        )


# Crash signatures contain the function names of an error's frames. So both wrappers name their function `step`, like
# the method that runs a whole step.
def _part(do: Callable[P, T]) -> Callable[P, T]:
    def step(*given: P.args, **named: P.kwargs) -> T:
        try:
            return do(*given, **named)
        except _TRACI_ERRORS as error:
            raise _failure_of(error) from error

    return step


def _simulating(driving: Driving) -> Callable[[], None]:
    # The wrappers of libsumo and of `guard_against_agents` around it take 4 of the 75 µs of a step in the core.
    listening = libsumo._stepManager
    step_alone = getattr(sumo.simulation_step, "__wrapped__", sumo.simulation_step)

    def step() -> None:
        try:
            if refused_calls or listening._stepListeners or libsumo.simulationStep is not _simulation_step:
                libsumo.simulationStep()
            else:
                step_alone(0.0)
            if driving.moving:
                driving.settle()
        except _TRACI_ERRORS as error:
            raise _failure_of(error, is_simulating=True) from error

    return step


def _failure_of(error: BaseException, *, is_simulating: bool = False) -> EpisodeError:
    """Return the failure of a trial: SUMO's own in a step, and an invalid trial if SUMO refuses a call of crashhunt."""
    if is_simulating or isinstance(error, libsumo.FatalTraCIError):
        return SimulatorError(f"SUMO gave up: {_one_line(error)}")
    return InvalidEpisodeError(f"crashhunt can no longer observe or control a vehicle: SUMO says: {_one_line(error)}")


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
