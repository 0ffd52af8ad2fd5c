"""highway-env as a simulator: any environment, any configuration, any number of controlled vehicles.

highway-env's y axis points down and its headings grow clockwise. Scenes mirror both, so that they look like the picture
in highway-env's viewer.
"""

from __future__ import annotations

import logging
import math
import random
import warnings
from collections import Counter
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

from crashhunt.highway._fast_import import highway_env  # before anything else imports it

# isort: split
import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.wrappers import OrderEnforcing, TimeLimit
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ContinuousAction, DiscreteMetaAction, MultiAgentAction
from highway_env.envs.common.observation import MultiAgentObservation
from highway_env.envs.parking_env import ParkingEnv
from highway_env.vehicle.objects import Obstacle, RoadObject

from crashhunt.base.errors import InvalidEpisodeError, ScenarioError
from crashhunt.base.foreign_code import Boundary, Party, number_of, truth_of
from crashhunt.base.plugins import describe_unused_clone
from crashhunt.highway._config import apply_changes, configured, mistake, note_changes, restore_classes
from crashhunt.highway._descriptor import BACKEND, HighwaySetup
from crashhunt.highway._disturbances import HighwayDisturbances
from crashhunt.highway._lane_parts import LANE_PARTS, LaneParts
from crashhunt.highway._lanes_and_contacts import (
    Hidden,
    HighwayEvents,
    VehicleFilter,
    contact_of,
    is_at_an_end,
    lane_place,
    lanes_of,
)
from crashhunt.highway._scripted import Puppet, Puppets
from crashhunt.highway._steering import action_with, is_steered, motion_of
from crashhunt.highway._surroundings import surroundings_of
from crashhunt.highway.accelerator import Onlooker, kernel
from crashhunt.highway.accelerator._known_versions import ACCELERATED
from crashhunt.scenario import argument_values
from crashhunt.simulators import (
    FullBraking,
    Kinematics,
    MetaAction,
    ObservationForm,
    SceneObserver,
    Unseen,
    action_form,
    action_mask_of,
    as_tables,
    has_nan,
    native,
    reseed_in_place,
    time_limit_of,
)
from crashhunt.world import Actor, Lane, Roster, Scene

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from gymnasium import Space
    from highway_env.envs.common.action import ActionType
    from numpy.typing import NDArray

    from crashhunt.highway.accelerator import Poses
    from crashhunt.scenario import Scenario
    from crashhunt.simulators import ActionForm, ActiveDisturbance, Info, Observations, Options, StepResult
    from crashhunt.trial import Disturbance, Value
    from crashhunt.world import Contact, Event, Motion, Paths, Surroundings

_PACKAGES = frozenset(("highway_env", "gymnasium", "typing", "builtins"))
_REPLACED_WRAPPERS = (OrderEnforcing, TimeLimit)  # whose work this simulator does itself
_STEP_FIX = "return one number or bool for each agent from step()"
_AVAILABLE_NOTICE = "the environment has no action_masks(), so the masks are highway-env's available actions"
_MASK = Boundary(Party.SIMULATOR, "action mask")
_LANE_INTERVAL_STEPS = 10  # steps between two scenes that contain the lane of each vehicle

assert highway_env  # importing it registers its environments


class HighwaySimulator:
    """Runs the episodes of a scenario on highway-env, each in a new environment.

    A control step is a step of the policy. An episode ends after ``max_steps``, the ``duration`` of the configuration,
    or the registered ``max_episode_steps``. A terminated agent idles until the episode ends.

    Raises:
        ScenarioError: The environment or an entry of its configuration does not exist, or it has too few vehicles.
    """

    def __init__(self, scenario: Scenario, stage: Path) -> None:
        self._scenario = scenario
        self._setup = scenario.table(HighwaySetup)
        self._kinematics = Kinematics(scenario.observation) if scenario.observation is not None else None
        self._possible = tuple(scenario.agents)
        self._parts = SceneObserver(scenario.agents, LANE_PARTS)
        self.observation_layouts = self._parts.layouts
        self._is_accelerated = _switch_accelerator(is_wanted=self._setup.accelerate)
        self._compiled = kernel() if self._is_accelerated else None
        self.agents: list[str] = []
        self.notices: dict[str, None] = {}
        self._lane_names: dict[tuple[str, str, int], str] = {}
        self._spare: AbstractEnv | None = None
        if notice := describe_unused_clone(highway_env):
            self._notice(notice)
        try:
            self.reset(seed=0, options={"arguments": argument_values(scenario)})  # to read its spaces
        except InvalidEpisodeError as error:
            raise ScenarioError(str(error), fix="check [highway] and the arguments", where=scenario.origin) from error

    reported_events = BACKEND.reported_events
    disturbing_kinds = BACKEND.disturbances or ()

    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Observations, Info]:
        """Create the environment and begin an episode with all agents."""
        try:
            env = self._make((options or {}).get("arguments", {}))
            shown, self._info = env.reset(seed=seed, options={"config": env.config})
        except ScenarioError:
            raise
        except Exception as error:
            message = f"highway-env could not set up the episode: {type(error).__name__}: {error}"
            raise InvalidEpisodeError(message) from error
        self._class_changes = note_changes()
        self._adopt(env)
        self._lane_names.clear()
        self.agents = list(self._possible)
        self._known: dict[int, tuple[RoadObject, Actor]] = {}
        self._counts: Counter[str] = Counter()
        self._seen: tuple[int, ...] = ()
        self._crashed: set[str] = set()
        self.was_truncated = False
        self._contacts: list[Contact] = []
        self._steps = 0
        self._taking_part: VehicleFilter | None = None
        self._puppets: Puppets | None = None
        self._begins_s = 0.0
        if (script := (options or {}).get("script")) is not None:
            self._start_scripts(script)
            shown = env.observation_type.observe()
        elif (only := (options or {}).get("only")) is not None:
            self._taking_part = VehicleFilter(env.road, only, self.agents, self._objects, self._actor)
            if self._taking_part.remove():
                shown = env.observation_type.observe()
        self._driven = dict.fromkeys(self.agents, 0.0)
        self._places = {agent: vehicle.position.tolist() for agent, vehicle in self._controlled.items()}
        self._on_road = {agent: bool(vehicle.on_road) for agent, vehicle in self._controlled.items()}
        self._disturbances = HighwayDisturbances(env.road, self._controlled.values())
        self._watch()
        self._events = HighwayEvents(self.step_length_s, self._scenario.events, lanes_are_road=self._lanes_are_road)
        self._read_scene(())
        if self._kinematics is not None:
            self._kinematics.hidden.clear()
        self._parts.begin(self._begins_s, self.step_length_s, seed)
        return self._show(self.agents, shown), {}

    party = Party.SIMULATOR
    foreign_packages = ("highway_env",)
    why_no_reseeding = ""

    def reseed(self, seed: int) -> None:
        """Re-seed the environment's generator, which its road and vehicles share."""
        reseed_in_place(self._env.np_random, seed)
        if self._env.road.np_random is not self._env.np_random:
            reseed_in_place(self._env.road.np_random, seed)

    def step(self, actions: Mapping[str, NDArray[np.generic]]) -> StepResult:
        """Step the environment with the agents' actions; the rewards are the environment's."""
        given = [
            native(self.actions[agent], actions[agent]) if agent in actions else self._idle(agent)
            for agent in self._possible
        ]
        self._contacts = []
        if self._steps >= self._lifted_at:
            self._notice(
                f"trials run beyond the {self._own_duration_s:g} s after which {self._setup.id!r} ends its episodes: "
                'set highway.time_limit = "registered" to end them there'
            )
        apply_changes(self._class_changes)
        with self._skipping:
            shown, reward, terminated, truncated, info = self._env.step(tuple(given) if self._many_act else given[0])
        self._info = info
        self._steps += 1
        if self._taking_part is not None:
            self._taking_part.remove()
        if self._puppets is not None:
            self._puppets.enter(self._steps)
        off_road: list[str] = []
        arrived: list[str] = []
        for agent, vehicle in self._controlled.items():
            (x, y), (was_x, was_y) = vehicle.position.tolist(), self._places[agent]
            self._driven[agent] += math.hypot(x - was_x, y - was_y)
            self._places[agent] = [x, y]
            was, self._on_road[agent] = self._on_road[agent], bool(vehicle.on_road)
            if self._lanes_are_road and agent in actions and was and not self._on_road[agent]:
                (arrived if is_at_an_end(vehicle, self._env.road.network) else off_road).append(agent)
        self._read_scene(tuple(off_road))
        self._scene.events = tuple([event for agent in actions for event in self._events_of(agent)])
        is_terminated = truth_of(terminated, "terminated", _STEP_FIX)
        is_cut = truth_of(truncated, "truncated", _STEP_FIX)
        if self._steps >= self._kept_until:
            self._notice(
                f"the environment {self._setup.id!r} ends an episode after {self._own_duration_s:g} s, which is its "
                'own duration; set highway.time_limit = "none" to lift it'
            )
        is_cut = is_cut or self._steps == self._max_episode_steps
        ended = is_terminated or is_cut
        rewards = info.get("agents_rewards", (reward,) * len(self._possible))
        arrived += [
            agent
            for agent, over in zip(self._possible, info.get("agents_terminated", ()), strict=False)
            if truth_of(over, "info['agents_terminated']", _STEP_FIX)
        ]
        at_an_end = self._crashed.union(arrived, off_road)
        self.was_truncated = is_cut and not is_terminated and at_an_end.isdisjoint(actions)
        terminations = {agent: ended or agent in self._crashed or agent in arrived for agent in actions}
        self.agents = [agent for agent in self.agents if not terminations.get(agent, False)]
        return (
            self._show(actions, shown),
            {agent: self._reward(rewards[self._possible.index(agent)]) for agent in actions},
            terminations,
            dict.fromkeys(actions, False),
            dict.fromkeys(actions, info),
        )

    def _reward(self, value: object) -> float:
        number = number_of(value, "the reward", _STEP_FIX)
        if math.isnan(number):
            self._notice(f"the reward is NaN in the environment {self._setup.id!r}")
        return number

    def _notice(self, notice: str) -> None:
        self.notices[notice] = None

    def action_mask(self, agent: str) -> NDArray[np.bool_] | None:
        """Return the mask of the environment, or else highway-env's available actions; None for other actions."""
        kind = self._kinds[agent]
        with _MASK:
            mask = None if self._many_act else action_mask_of(self._env, self._info, self.actions[agent].space)
            if mask is None and isinstance(kind, DiscreteMetaAction):
                mask = np.isin(np.arange(len(kind.actions)), kind.get_available_actions())
                self._notice(_AVAILABLE_NOTICE)
        return mask

    def scene(self) -> Scene:
        """Return the state of all vehicles and obstacles."""
        return self._scene

    def lanes(self) -> list[Lane]:
        """Return all lanes; curved lanes have points at most 2 m apart."""
        return lanes_of(self._env.road.network, self._lane_name)

    def full_braking(self, agent: str) -> FullBraking | None:
        """Return the action for the hardest braking; None if the agent's actions do not keep it in its lane."""
        kind = self._kinds[agent]
        if isinstance(kind, DiscreteMetaAction) and "SLOWER" in kind.actions_indexes:
            return FullBraking(kind.actions_indexes["SLOWER"], "by answering SLOWER in every step")
        return None

    def surroundings(self, agent: str) -> Surroundings:
        """Return what a careful driver of an agent's vehicle would consider."""
        vehicle = self._controlled[agent]
        others = (thing for thing in self._objects() if thing is not vehicle)
        kind = self._kinds[agent]
        limits = tuple(kind.acceleration_range) if isinstance(kind, ContinuousAction) else None
        return surroundings_of(self._env.road.network, vehicle, others, lambda thing: self._actor(thing).id, limits)

    def is_steered(self, agent: str) -> bool:
        """Whether the actions of a vehicle are an acceleration and a steering angle."""
        return is_steered(self._kinds[agent])

    def motion_of(self, agent: str, action: NDArray[np.generic]) -> Motion:
        """Return what an action does within the next step."""
        return motion_of(self._kinds[agent], self._controlled[agent], action, self.step_length_s)

    def action_with(
        self, agent: str, action: NDArray[np.generic] | None, *, speed_mps: float | None, keeps_lane: bool
    ) -> NDArray[np.generic]:
        """Return an action with another speed, or with the steering that keeps the lane."""
        kind, vehicle = self._kinds[agent], self._controlled[agent]
        return action_with(kind, vehicle, action, self.step_length_s, speed_mps=speed_mps, keeps_lane=keeps_lane)

    def resolve_target(self, disturbance: Disturbance) -> str:
        """Return the vehicle that a disturbance names by a place, such as ``ahead``; empty if there is none."""
        found = self._disturbances.resolve_target(self._controlled[disturbance.agent], disturbance)
        return "" if found is None else self._actor(found).id

    def disturb(self, vehicle: str, disturbance: Disturbance) -> ActiveDisturbance | None:
        """Disturb a vehicle until the disturbance ends."""
        thing = next(thing for thing, actor in self._known.values() if actor.id == vehicle)
        if disturbance.what == "unseen":
            if disturbance.agent in self.observation_layouts:
                return Unseen(self._parts, disturbance.agent, vehicle)
            if self._kinematics is not None:
                return Unseen(self._kinematics, disturbance.agent, vehicle)
            return Hidden(self._env.road, self._seeing[disturbance.agent], thing)
        return self._disturbances.disturb(thing, disturbance, self._controlled[disturbance.agent])

    def hold(self, vehicle: str, what: str) -> ActiveDisturbance | None:
        """Apply a hold to a vehicle until the hold ends; return None if that is impossible."""
        present = {id(thing) for thing in self._env.road.vehicles}
        found = (thing for thing, actor in self._known.values() if actor.id == vehicle and id(thing) in present)
        return self._disturbances.hold(next(found, None), what)

    @property
    def entered(self) -> list[str]:
        """Identifiers of all actors that have entered; empty if no actor is excluded."""
        return [] if self._taking_part is None else self._taking_part.entered

    @property
    def scripted(self) -> bool:
        """Whether the other actors of this episode follow recorded paths."""
        return self._puppets is not None

    def ready_process(self) -> None:
        """Construct the environment of the next episode, so that each fork of this process only resets it."""
        before = _generator_states()
        spare = self._construct()
        # A user's code may draw from the generators of the process, which each trial seeds before it constructs.
        if _is_highway_envs_own(type(spare)) and _generator_states() == before:
            self._spare = spare

    def tidy(self) -> None:
        """Restore class attributes that the environment has changed."""
        restore_classes()

    def close(self) -> None:
        """Close the environment."""
        self._env.close()

    def _make(self, arguments: Mapping[str, Value]) -> AbstractEnv:
        """Create the environment and set its configuration, which the next reset applies."""
        env, self._spare = self._spare or self._construct(), None
        own = env.config.get("duration")
        env.config = configured(env.config, self._scenario, arguments)
        tables = (self._setup.config, *as_tables(self._scenario, arguments))
        is_default = isinstance(own, int | float) and not any("duration" in table for table in tables)
        self._own_duration_s = own if is_default else math.inf
        at_step: float = self._own_duration_s * env.config["policy_frequency"]
        is_lifted = self._setup.time_limit == "none"
        self._lifted_at = at_step if is_lifted else math.inf
        self._kept_until = math.inf if is_lifted else at_step
        return env

    def _construct(self) -> AbstractEnv:
        restore_classes()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # for an outdated version, which the user chose
                made: Any = gymnasium.make(self._setup.id, disable_env_checker=True)
        except (gymnasium.error.Error, ImportError) as error:
            message = " ".join(str(error).split())
            raise mistake(
                self._scenario, "id", self._setup.id, message, "set an id such as 'highway-fast-v0'"
            ) from None
        env = made.unwrapped
        if not isinstance(env, AbstractEnv):
            fix = 'write simulator = "gym"'
            raise mistake(self._scenario, "id", self._setup.id, "is not an environment of highway-env", fix)
        self._max_episode_steps = None if self._setup.time_limit == "none" else time_limit_of(made)
        while isinstance(made, gymnasium.Wrapper):
            if not isinstance(made, _REPLACED_WRAPPERS) and not type(made).__module__.startswith("highway_env."):
                what, fix = f"has the wrapper {type(made).__name__}, which would be lost", 'write simulator = "gym"'
                raise mistake(self._scenario, "id", self._setup.id, what, fix)
            made = made.env
        return env

    def _adopt(self, env: AbstractEnv) -> None:
        """Read the vehicles, spaces and action forms of a new environment."""
        self._env = env
        self._lane_parts = LaneParts(env.road.network)
        is_unused = self._kinematics is not None or len(self.observation_layouts) == len(self._possible)
        self._skipping: AbstractContextManager[None] = nullcontext()
        if is_unused and self._is_accelerated:
            from crashhunt.highway.accelerator import SkippedObservation

            self._skipping = SkippedObservation(env)
        rate = env.config["simulation_frequency"]
        self.step_length_s = int(rate // env.config["policy_frequency"]) / rate  # highway-env rounds sub-steps down
        chosen = self._setup.off_road
        self._lanes_are_road = chosen if chosen is not None else not isinstance(env, ParkingEnv)
        self._many_act = isinstance(env.action_type, MultiAgentAction)
        self._many_see = isinstance(env.observation_type, MultiAgentObservation)
        kinds = env.action_type.agents_action_types if self._many_act else [env.action_type]
        seen = env.observation_space.spaces if self._many_see else [env.observation_space]
        eyes = env.observation_type.agents_observation_types if self._many_see else [env.observation_type]
        self._seeing = dict(zip(self._possible, eyes, strict=False))
        self._controlled = dict(zip(self._possible, env.controlled_vehicles, strict=True))
        self._kinds = dict(zip(self._possible, kinds, strict=True))
        self.actions: dict[str, ActionForm] = {agent: _form(kind) for agent, kind in self._kinds.items()}
        self._forms = dict(zip(self._possible, map(ObservationForm, seen), strict=True))
        self.observation_spaces: dict[str, Space[object]]
        self.shown_spaces: dict[str, Space[object]] = {}
        if self._kinematics is not None:
            self.observation_spaces = dict.fromkeys(self._possible, self._kinematics.space)
            self.observation_names = self._kinematics.features
        else:
            self.observation_spaces = {agent: form.space for agent, form in self._forms.items()}
            self.shown_spaces = {agent: form.original for agent, form in self._forms.items() if form.structured}
            kind = env.observation_type.agents_observation_types[0] if self._many_see else env.observation_type
            self.observation_names = tuple(getattr(kind, "features", ())) if len(seen[0].shape or ()) == 2 else ()
        for agent, layout in self.observation_layouts.items():
            self.observation_spaces[agent], self.shown_spaces[agent] = layout.flat_space, layout.space

    def _start_scripts(self, script: Paths) -> None:
        """Move the other actors along recorded paths; an agent whose path is scripted no longer drives."""
        driven = {path.actor.id for path in script.agents}
        self._controlled = {agent: vehicle for agent, vehicle in self._controlled.items() if agent in driven}
        self.agents = list(self._controlled)
        config = self._env.config
        sub_steps = int(config["simulation_frequency"] // config["policy_frequency"])
        self._puppets = Puppets(self._env.road, script, self._controlled, sub_steps, self.step_length_s)
        self._begins_s = script.time_s
        self._known |= {id(thing): (thing, actor) for thing, actor in self._puppets.actors}

    def _idle(self, agent: str) -> Any:
        kind, space = self._kinds[agent], self.actions[agent].space
        if isinstance(kind, DiscreteMetaAction):
            return kind.actions_indexes["IDLE"]
        return space.n // 2 if isinstance(space, Discrete) else np.zeros(space.shape, space.dtype)

    def _show(self, agents: Iterable[str], shown: Any) -> Observations:
        by_parts = {agent: self._observe_parts(agent) for agent in agents if agent in self.observation_layouts}
        others = [agent for agent in agents if agent not in by_parts]
        if self._kinematics is not None:
            return by_parts | {agent: self._observe(agent) for agent in others}
        each = shown if self._many_see else (shown,)
        found = {agent: self._forms[agent].encode(each[self._possible.index(agent)]) for agent in others}
        if any(map(has_nan, found.values())):
            self._notice(f"the environment {self._setup.id!r} shows its agent an observation that contains NaN")
        return by_parts | found

    def _observe_parts(self, agent: str) -> NDArray[np.generic]:
        """Return the recorded array of the parts that an agent observes."""
        vehicle, objects = self._controlled[agent], self._objects()
        network = self._env.road.network
        return self._parts.observe(
            agent,
            self._scene,
            distance=self._driven[agent],
            place=lambda row: lane_place(network, vehicle, objects[row]),
            # highway-env's y points down, so that its positive angles turn to the right.
            steering=0.0 - float(vehicle.action["steering"]) if "steering" in (vehicle.action or {}) else None,
            other=lambda request: self._lane_parts.read(vehicle, request),
        )

    def _observe(self, agent: str) -> NDArray[np.float32]:
        """Return the agent's observation in the Kinematics layout that SUMO scenarios use as well."""
        assert self._kinematics is not None
        vehicle = self._controlled[agent]
        along, right = vehicle.lane.local_coordinates(vehicle.position)
        start, end, number = vehicle.lane_index
        turn = math.remainder(float(vehicle.heading) - float(vehicle.lane.heading_at(along)), math.tau)
        return self._kinematics.observe(
            self._scene,
            self._scene.roster.index[agent],
            distance=self._driven[agent],
            from_left=float(right) + number * float(vehicle.lane.width_at(along)),
            lateral_speed=float(vehicle.speed) * math.sin(turn),
            lanes=len(self._env.road.network.graph[start][end]),
        )

    def _watch(self) -> None:
        """Record a contact in the sub-step in which it happens, because highway-env then pushes and brakes vehicles."""
        disturbances = self._disturbances

        def after() -> None:
            disturbances.after_moving()
            for agent, vehicle in self._controlled.items():
                if vehicle.crashed and agent not in self._crashed:
                    self._crashed.add(agent)
                    lane = self._lane_name(vehicle.lane_index)
                    self._contacts.append(contact_of(agent, vehicle, self._objects(), self._actor, lane))

        road = self._env.road
        road.step = Onlooker(
            road.step,
            before=disturbances.before_moving,
            after=after,
            interferes=lambda: disturbances.is_active,
            waits=lambda: not disturbances.is_active,
        )

    def _objects(self) -> list[RoadObject]:
        """Return all vehicles and obstacles that can be hit."""
        road = self._env.road
        return [*road.vehicles, *(thing for thing in road.objects if thing.solid and thing.collidable)]

    def _actor(self, thing: RoadObject) -> Actor:
        found = self._known.get(id(thing))
        if found is None:
            name = next((agent for agent, vehicle in self._controlled.items() if vehicle is thing), "")
            if not name:
                what = "obstacle" if isinstance(thing, Obstacle) else "vehicle"
                self._counts[what] += 1
                name = f"{what}.{self._counts[what]}"
            # Keep a reference to the object, so that no later object can get the same id().
            found = (
                thing,
                Actor(id=name, kind=type(thing).__name__, length=float(thing.LENGTH), width=float(thing.WIDTH)),
            )
            self._known[id(thing)] = found
        return found[1]

    def _read_scene(self, off_road: tuple[str, ...]) -> None:
        things = self._objects()
        seen = tuple(map(id, things))
        if seen != self._seen:
            self._seen = seen
            self._roster = Roster(tuple(map(self._actor, things)))
        poses = None
        if self._compiled is not None and self._puppets is None:
            poses = self._compiled.mirrored_poses(things, self._roster.half_lengths)
        points, headings, speeds = poses if poses is not None else self._poses(things)
        contacts = tuple(self._contacts)
        lanes: tuple[str, ...] = ()
        if self._steps % _LANE_INTERVAL_STEPS == 0 or contacts or off_road:
            lanes = tuple([self._lane_name(thing.lane_index) for thing in things])
        time_s = self._begins_s + self._steps * self.step_length_s
        self._scene = Scene(time_s, self._roster, points, headings, speeds, contacts, off_road, lanes)
        for agent, vehicle in self._controlled.items():
            self._scene.agent_lanes[agent] = self._lane_name(vehicle.lane_index)

    def _poses(self, things: list[RoadObject]) -> Poses:
        """Return the points, headings and speeds of objects in a scene."""
        points, headings, speeds = [], [], []
        for thing, half in zip(things, self._roster.half_lengths, strict=True):
            if isinstance(thing, Puppet):
                points.append((thing.shown.x, thing.shown.y))
                headings.append(thing.shown.heading)
                speeds.append(thing.shown.speed)
                continue
            (x, y), heading = thing.position.tolist(), float(thing.heading)
            points.append((x + half * math.cos(heading), 0.0 - (y + half * math.sin(heading))))  # avoids -0.0
            headings.append(0.0 - heading)
            speeds.append(float(thing.speed))
        return points, headings, speeds

    def _events_of(self, agent: str) -> Iterator[Event]:
        vehicle = self._controlled[agent]
        point = self._scene.points[self._scene.roster.index[agent]]
        return self._events.look(agent, vehicle, point, self._lane_name(vehicle.lane_index))

    def _lane_name(self, index: tuple[str, str, int]) -> str:
        found = self._lane_names.get(index)
        if found is None:
            found = self._lane_names[index] = "_".join(map(str, index))
        return found


def _switch_accelerator(*, is_wanted: bool) -> bool:
    """Switch the accelerator on or off, and return whether highway-env is accelerated."""
    if highway_env.__version__ not in ACCELERATED:  # it may lack names that the accelerator imports
        return False
    from crashhunt.highway.accelerator import switch_off, switch_on

    if not is_wanted:
        switch_off()
        return False
    if reason := switch_on():
        logging.getLogger(__name__).warning("the accelerator is disabled: %s", reason)
    return not reason


def _is_highway_envs_own(kind: type) -> bool:
    return all(base.__module__.partition(".")[0] in _PACKAGES for base in kind.__mro__)


def _generator_states() -> tuple[object, ...]:
    """Return the states of the random generators of the process."""
    numpy: Any = np.random.get_state()  # noqa: NPY002 - a user's code may use the global generator
    return random.getstate(), numpy[0], numpy[1].tobytes(), numpy[2:]


def _form(kind: ActionType) -> ActionForm:
    if isinstance(kind, DiscreteMetaAction):
        return MetaAction(tuple(kind.actions[number] for number in range(len(kind.actions))))
    return action_form(kind.space())
