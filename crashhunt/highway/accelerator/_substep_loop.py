"""The loop over an environment's sub-steps, which keeps the vehicles' state in the kernel while no foreign code runs.

Foreign code is the code of the user or of a library other than highway-env. Foreign code may change a vehicle at any
time, so the state is read again after foreign code has run.
"""

from __future__ import annotations

import inspect
import math
from pathlib import Path
from typing import TYPE_CHECKING, Generic

import highway_env
import numpy as np
from gymnasium import Env
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ActionType, DiscreteMetaAction
from highway_env.envs.common.observation import (
    ExitObservation,
    KinematicObservation,
    MultiAgentObservation,
    OccupancyGridObservation,
)
from highway_env.envs.parking_env import ParkingEnv
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle

from crashhunt.highway.accelerator._onlooker import Onlooker
from crashhunt.highway.accelerator._roads import Prepared, cached, is_known, look, methods_of, prepared, watches
from crashhunt.highway.accelerator._supported import Own, is_genuine, kinds_of, originals

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from highway_env.envs.common.observation import ObservationType
    from highway_env.envs.highway_env import HighwayEnv

    from crashhunt.highway.accelerator._kernel import Traffic


# The parts of a sub-step that stay in Python: checks of pairs by highway-env, and right of way at intersections.


def finish(road: Road, dt: float) -> None:
    """Finish a sub-step with highway-env's code, because the kernel has found a number that is not finite."""
    for vehicle in road.vehicles:
        vehicle.on_state_update()
    collide_one_by_one(road, dt)


def collide_one_by_one(road: Road, dt: float) -> None:
    """Check all pairs of objects for collisions, with highway-env's own code."""
    for number, vehicle in enumerate(road.vehicles):
        for other in road.vehicles[number + 1 :]:
            vehicle.handle_collisions(other, dt)
        for other in road.objects:
            vehicle.handle_collisions(other, dt)


def enforce(road: RegulatedRoad, traffic: Traffic) -> bool:
    """Compute the result of `RegulatedRoad.enforce_road_rules`, with one prediction per vehicle.

    Returns:
        Whether the rules were applied; False, with nothing changed, if highway-env must predict a path.
    """
    vehicles = road.vehicles
    conflicts = traffic.conflicts()
    if conflicts is None:
        return False
    for vehicle in vehicles:
        if getattr(vehicle, "is_yielding", False):
            if vehicle.yield_timer >= road.YIELD_DURATION * road.REGULATION_FREQUENCY:
                vehicle.target_speed = vehicle.lane.speed_limit
                delattr(vehicle, "color")
                vehicle.is_yielding = False
            else:
                vehicle.yield_timer += 1
    for row, other, is_certain in conflicts:
        one, two = vehicles[row], vehicles[other]
        if not is_certain and not road.is_conflict_possible(one, two):
            continue
        yielding = road.respect_priorities(one, two)
        if yielding is not None and isinstance(yielding, ControlledVehicle) and not isinstance(yielding, MDPVehicle):
            yielding.color = road.YIELDING_COLOR
            yielding.target_speed = 0
            yielding.is_yielding = True
            yielding.yield_timer = 0
    return True


# What a step computes for each agent: the effect of its meta-action, and the rewards of `HighwayEnv`.


_CLIP = np.clip
_ONE = np.float64(1)
_SPEED_CHANGES = {"SLOWER": -1, "IDLE": 0, "FASTER": 1}
_DTYPES = (np.dtype(np.float64), np.dtype(np.int64))
_MEMBERS = [(owner, name) for owner in (ActionType, DiscreteMetaAction) for name in ("act", "controlled_vehicle")]
_ORIGINALS = [vars(owner).get(name) for owner, name in _MEMBERS]


def choose(env: AbstractEnv, action: object) -> bool:
    """Apply that part of `DiscreteMetaAction.act` whose effect remains after the next `Road.act`.

    `MDPVehicle.act` chooses a target speed or lane, and then computes steering and acceleration. `Road.act` computes
    both again from the same state before any code reads them. The road of the environment has just been checked: no
    vehicle on it has own methods.

    Returns:
        Whether the action was applied; False, with nothing changed, if highway-env must apply it.
    """
    deciding = env.action_type
    if type(deciding) is not DiscreteMetaAction or type(action) not in (int, np.int64) or "act" in vars(deciding):
        return False
    if [vars(owner).get(name) for owner, name in _MEMBERS] != _ORIGINALS or type(deciding.actions) is not dict:
        return False
    meaning = deciding.actions.get(action)
    change = _SPEED_CHANGES.get(meaning) if type(meaning) is str else None
    vehicle = deciding.controlled_vehicle
    if change is None or type(vehicle) is not MDPVehicle:
        return False
    road = env.road
    if vehicle.road is not road or not any(other is vehicle for other in road.vehicles):
        return False
    try:
        at_end = road.network.get_lane(vehicle.target_lane_index).after_end(vehicle.position)
    except Exception:
        return False  # highway-env raises the same error
    return not at_end and (not change or _change_speed(vehicle, change))


def _change_speed(vehicle: MDPVehicle, change: int) -> bool:
    """Compute the result of `MDPVehicle.act` for the target speed; return False if the speeds are unusual."""
    speed, speeds = vehicle.speed, vehicle.target_speeds
    if type(speed) not in (float, np.float64) or type(speeds) is not np.ndarray:
        return False
    if speeds.ndim != 1 or speeds.size < 2 or speeds.dtype not in _DTYPES:
        return False
    first, last = float(speeds[0]), float(speeds[-1])
    if first == last:
        return False
    nearest = (float(speed) - first) / (last - first) * (speeds.size - 1)
    if not math.isfinite(nearest):
        return False
    index = min(max(round(nearest), 0), speeds.size - 1) + change
    vehicle.speed_index = min(max(index, 0), speeds.size - 1)
    vehicle.target_speed = speeds[vehicle.speed_index]
    return True


def rewards(env: HighwayEnv) -> dict[str, float]:
    """Return the result of `HighwayEnv._rewards`, in which the speed is limited by faster code."""
    vehicle = env.vehicle
    neighbours = env.road.network.all_side_lanes(vehicle.lane_index)
    lane = vehicle.target_lane_index[2] if isinstance(vehicle, ControlledVehicle) else vehicle.lane_index[2]
    forward_speed = vehicle.speed * np.cos(vehicle.heading)
    scaled_speed = utils.lmap(forward_speed, env.config["reward_speed_range"], [0, 1])
    return {
        "collision_reward": float(vehicle.crashed),
        "right_lane_reward": lane / max(len(neighbours) - 1, 1),
        "high_speed_reward": _clip_to_unit(scaled_speed),
        "on_road_reward": float(vehicle.on_road),
    }


def _clip_to_unit(value: float) -> float:
    """Return the result of ``np.clip(value, 0, 1)``."""
    if type(value) is not np.float64 or np.clip is not _CLIP or not value > 0:
        clipped: float = np.clip(value, 0, 1)  # decides about the sign of zero, and about NaN
        return clipped
    return value if value < 1 else _ONE


_CALLED_METHODS = ("step", "_simulate", "_automatic_rendering")
_READ_ATTRIBUTES = ("steps", "config", "viewer", "enable_auto_render", "road", "action_type", "observation_type")


class _EnvironmentKind:
    """Properties of a class of environments."""

    def __init__(self, kind: type[AbstractEnv]) -> None:
        self.own = Own(kind, AbstractEnv, _READ_ATTRIBUTES)
        # whether only code of highway-env runs between sub-steps, except for the agents' actions
        self.is_plain = self.own.plain and not self.own.has("_automatic_rendering")
        # the names of those methods that the class inherits from `AbstractEnv`
        self.inherits = frozenset(name for name in ("_simulate", "vehicle") if not self.own.has(name))


_kinds: dict[type, _EnvironmentKind] = {}


def run_step(env: AbstractEnv, action: object, simulate_steps: Callable[..., None]) -> object:
    """Run `AbstractEnv.step`, in which the environment observes directly after its last sub-step."""
    found = cached(env.road)
    in_place = "_simulate" not in vars(env) and vars(AbstractEnv).get("_simulate") is simulate_steps
    if found is None or found.in_step or not in_place:
        return originals["AbstractEnv.step"](env, action)
    found.in_step = True
    try:
        return originals["AbstractEnv.step"](env, action)
    finally:
        found.in_step = False
        found.distrust()


def can_run_alone() -> bool:
    """Return whether the functions that highway-env calls between sub-steps are its own; store them in `originals`."""
    found = {f"AbstractEnv.{name}": getattr(AbstractEnv, name) for name in _CALLED_METHODS}
    originals.update(found)
    return all(is_genuine(name, function) for name, function in found.items())


def simulate(
    env: AbstractEnv,
    action: object,
    replaced: Iterable[tuple[object, str, object]],
    observe: Callable[[KinematicObservation], object],
) -> None:
    """Compute the result of `AbstractEnv._simulate`.

    Args:
        env: The environment.
        action: The action of the environment's agents, or None.
        replaced: The replacements that must be in place: for each, the owner of the method, its name and the
            replacement.
        observe: The replacement of `KinematicObservation.observe`.
    """
    road = env.road
    kind = _kind_of(env)
    found = prepared(road) if _runs_alone(env, kind) and _are_in_place(replaced) and is_known(road) else None
    if found is None or not found.drives_all():
        originals["AbstractEnv._simulate"](env, action)
        return
    frames = _frames(env)
    can_fuse = type(road) is Road
    can_act = "vehicle" in kind.inherits
    observes = False
    found.alone = True
    frame = -1
    try:
        while (frame := frame + 1) < frames:
            acts = action is not None and not env.config["manual_control"] and env.steps % _frames(env) == 0
            if acts and not (can_act and frame == 0 and found.checked and choose(env, action)):
                found.distrust()
                env.action_type.act(action)
                found.distrust()
            if can_fuse and _waits(road):
                due = frames if action is None else _frames(env) - env.steps % _frames(env)
                done = _run(env, found, min(frames - frame, due))
                if done:
                    frame += done - 1
                    continue
            env.road.act()
            if _interferes(road):
                found.distrust()
            env.road.step(1 / env.config["simulation_frequency"])
            if _interferes(road):
                found.distrust()
            env.steps += 1
            if frame < frames - 1:
                env._automatic_rendering()
        observes = found.in_step and "_simulate" in kind.inherits and _observes_with(env, observe)
    finally:
        found.alone = False
        if not observes:
            found.distrust()
    env.enable_auto_render = False


def _run(env: AbstractEnv, found: Prepared, count: int) -> int:
    """Let the kernel run several sub-steps; return the number of sub-steps that it has run."""
    road = env.road
    state = look(road)
    dt = 1 / env.config["simulation_frequency"]
    if state is None or state.owner is not found or type(dt) is not float:
        return 0
    if not state.roster.decides or not state.roster.moves:
        return 0
    try:
        done, unfinished = state.traffic.run(count, dt, "step" in vars(road))
    except BaseException:
        env.steps += state.traffic.completed()
        raise
    if unfinished:
        finish(road, dt)
        done += 1
    env.steps += done
    if done and not unfinished:
        found.keep(state)
    if done and "step" in vars(road):
        vars(road)["step"].look()
        if _interferes(road):
            found.distrust()
    return done


def _frames(env: AbstractEnv) -> int:
    return int(env.config["simulation_frequency"] // env.config["policy_frequency"])


def _kind_of(env: AbstractEnv) -> _EnvironmentKind:
    kind = type(env)
    found = _kinds.get(kind)
    if found is None or not found.own.current:
        found = _kinds[kind] = _EnvironmentKind(kind)
    return found


def _runs_alone(env: AbstractEnv, kind: _EnvironmentKind) -> bool:
    """Return whether only agents, vehicles and an `Onlooker` run between the sub-steps of an environment."""
    road = env.road
    if type(road) not in (Road, RegulatedRoad) or env.viewer is not None:
        return False
    if "_automatic_rendering" in vars(env) or "act" in vars(road):
        return False
    if "step" in vars(road) and type(vars(road)["step"]) is not Onlooker:
        return False
    return kind.is_plain and type(env.config) is dict


def _observes_with(env: AbstractEnv, observe: Callable[[KinematicObservation], object]) -> bool:
    """Return whether an environment's observation is made by a function, before other code can change the road."""
    observing = vars(env).get("observation_type")
    in_place = vars(KinematicObservation).get("observe") is observe
    return in_place and type(observing) is KinematicObservation and "observe" not in vars(observing)


def _are_in_place(replaced: Iterable[tuple[object, str, object]]) -> bool:
    """Return whether no method that highway-env calls in a sub-step has been wrapped or replaced."""
    rendering = vars(AbstractEnv).get("_automatic_rendering")
    return rendering is originals["AbstractEnv._automatic_rendering"] and all(
        vars(owner).get(name) is faster for owner, name, faster in replaced
    )


def _waits(road: Road) -> bool:
    """Return whether the observers of a road's sub-steps need to be called only at a crash."""
    onlooker = vars(road).get("step")
    return onlooker is None or (type(onlooker) is Onlooker and onlooker.waits())


def _interferes(road: Road) -> bool:
    onlooker = vars(road).get("step")
    return onlooker is not None and (type(onlooker) is not Onlooker or onlooker.interferes())


# Skips an environment's own observation if the agent gets another observation and the skip has no other effect.

_STATELESS_OBSERVATIONS = (KinematicObservation, ExitObservation, OccupancyGridObservation)
_GENUINE_FOLDERS = tuple(
    str(Path(file).parent) for file in (highway_env.__file__, __file__)
)  # the accelerator replaces a method


class SkippedObservation:
    """A context in which one step of an environment skips its own observation.

    The environment still observes in three cases:

    - The observation has effects, such as drawing random numbers.
    - The environment itself needs the observation.
    - A class or method of the user could notice the skip.
    """

    def __init__(self, env: AbstractEnv) -> None:
        self._env = env
        self._skipped: ObservationType | None = None

    def __enter__(self) -> None:
        seeing = self._env.observation_type
        if self._can_be_skipped(seeing):
            seeing.observe = _observe_nothing
            self._skipped = seeing

    def __exit__(self, *_: object) -> None:
        if self._skipped is not None:
            del self._skipped.observe
            self._skipped = None

    def _can_be_skipped(self, seeing: ObservationType) -> bool:
        if not watches:
            return False
        eyes = seeing.agents_observation_types if type(seeing) is MultiAgentObservation else [seeing]
        if not all(map(_is_stateless, eyes)):
            return False
        if not all(_methods_of(eye).isdisjoint(vars(eye)) for eye in (seeing, *eyes)):
            return False
        road = self._env.road
        things = [*road.vehicles, *road.objects]
        return (
            _is_genuine(self._env)
            and all(watch.intact for watch in [*watches.values()])
            and all(kind.describes and kind.is_of(thing) for kind, thing in zip(kinds_of(things), things, strict=True))
        )


def _observe_nothing() -> None:
    """Return no observation."""


def _is_stateless(eye: ObservationType) -> bool:
    """Return whether making an observation has no effect except its return value."""
    if type(eye) not in _STATELESS_OBSERVATIONS:
        return False
    values = vars(eye)
    # The first observation sets the range of the features, which later observations use.
    settled = bool(values["features_range"]) or not values.get("normalize", True)
    return settled and values.get("order") != "shuffled"


class _Environments:
    """Properties of a class of environments: whether all its methods are highway-env's own."""

    def __init__(self, kind: type[AbstractEnv]) -> None:
        self.own = Own(kind, AbstractEnv, ())
        self.methods = methods_of(kind)
        # A parking environment reads the observation to decide whether the vehicle has arrived.
        self.genuine = not issubclass(kind, ParkingEnv) and all(
            base in (object, Env, Generic) or _is_own(base) for base in kind.__mro__
        )


def _is_own(kind: type) -> bool:
    """Return whether a class and all its functions are defined in highway-env or in the accelerator."""
    if not kind.__module__.startswith("highway_env."):
        return False
    functions = (getattr(found, "fget", None) or getattr(found, "__func__", found) for found in vars(kind).values())
    codes = (function.__code__ for function in functions if inspect.isfunction(function))
    return all(code.co_filename.startswith(_GENUINE_FOLDERS) for code in codes)


_observation_types: dict[type, _Environments] = {}
_methods: dict[type, frozenset[str]] = {}


def _is_genuine(env: AbstractEnv) -> bool:
    kind = type(env)
    found = _observation_types.get(kind)
    if found is None or not found.own.current:
        found = _observation_types[kind] = _Environments(kind)
    return found.genuine and found.methods.isdisjoint(vars(env))


def _methods_of(eye: ObservationType) -> frozenset[str]:
    kind = type(eye)
    if kind not in _methods:
        _methods[kind] = methods_of(kind)
    return _methods[kind]
