"""Switches the accelerator of highway-env on and off: bit-identical results in a fraction of the time.

The accelerator replaces methods of highway-env's roads, environments and observations, in this process only. For
everything that it does not know, such as a class that overrides one of these methods, highway-env's own code runs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from highway_env.envs.common import observation as highway_env_observation
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.observation import (
    ExitObservation,
    KinematicObservation,
    KinematicsGoalObservation,
    OccupancyGridObservation,
)
from highway_env.envs.highway_env import HighwayEnv
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from crashhunt.highway.accelerator._observe import (
    close_objects,
    fill_lanes,
    fill_times,
    observe,
    observe_exit,
    observe_goal,
    observe_grid,
)
from crashhunt.highway.accelerator._roads import (
    forget,
    is_intact,
    look,
    methods_of,
    network_of,
    take,
    take_for_observation,
    watches,
)
from crashhunt.highway.accelerator._substep_loop import (
    can_run_alone,
    collide_one_by_one,
    enforce,
    finish,
    rewards,
    run_step,
    simulate,
)
from crashhunt.highway.accelerator._supported import (
    Watch,
    is_genuine,
    kind_of,
    left_alone as left_alone,
    originals,
    reason_against,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

    from highway_env.road.lane import LaneIndex
    from highway_env.vehicle.controller import MDPVehicle
    from highway_env.vehicle.kinematics import Vehicle


def switch_on() -> str:
    """Accelerate highway-env in this process.

    Returns:
        The reason why highway-env cannot be accelerated; empty if it is accelerated.
    """
    if watches:
        return why_not()
    _restore()  # a user's module may have put back one of our methods after the accelerator was switched off
    reason = reason_against()
    if not reason:
        alone = can_run_alone()
        for owner, name, faster in _REPLACEMENTS:
            current = getattr(owner, name)
            if alone if owner is AbstractEnv else is_genuine(_qualified(owner, name), current):
                originals[_name(owner, name)] = current
                setattr(owner, name, faster)
        # highway-env calls a replacement of one of our methods, so watching them is unnecessary. The exception is
        # `neighbour_vehicles`, which accelerated decisions bypass.
        ours = {_name(owner, name) for owner, name, _ in _REPLACEMENTS}
        watches["roads"] = Watch.of_roads(ours - {"Road.neighbour_vehicles"})
        watches["observations"] = Watch.of_observations(ours)
    return reason


def switch_off() -> None:
    """Restore highway-env's methods; a method that other code has replaced in the meantime is not restored."""
    forget()
    _restore()


def _restore() -> None:
    for owner, name, faster in _REPLACEMENTS:
        if vars(owner).get(name) is faster:
            setattr(owner, name, originals[_name(owner, name)])


def _qualified(owner: type | ModuleType, name: str) -> str:
    return f"{owner.__qualname__}.{name}" if isinstance(owner, type) else name


def _name(owner: type | ModuleType, name: str) -> str:
    return f"{owner.__qualname__ if isinstance(owner, type) else owner.__name__}.{name}"


def is_on() -> bool:
    """Return whether the accelerator is switched on."""
    return bool(watches)


def why_not() -> str:
    """Return why the accelerator currently has no effect; empty if it has an effect or is switched off."""
    return next((watch.reason for watch in [*watches.values()] if watch.reason), "")


def _act(self: Road) -> None:
    if len(self.vehicles) < 2:
        for vehicle in self.vehicles:
            vehicle.act()
        return
    state = take(self) or look(self)
    if state is None or not state.roster.decides:
        originals["Road.act"](self)
        return
    state.traffic.act()
    state.owner.keep(state)


def _step(self: Road, dt: float) -> None:
    if len(self.vehicles) + len(self.objects) < 2 and not any(map(_slides, self.vehicles)):
        # This is cheaper than the original, which loops over pairs, and than the kernel.
        for vehicle in self.vehicles:
            vehicle.step(dt)
        if len(self.vehicles) + len(self.objects) > 1:
            collide_one_by_one(self, dt)
        return
    state = take(self) or look(self)
    if state is None or not state.roster.moves or type(dt) is not float:
        _step_one_by_one(self, dt)
    elif state.traffic.step(dt):
        state.owner.keep(state)
    else:
        finish(self, dt)


def _slides(vehicle: Vehicle) -> bool:
    """Return whether the kernel computes the dynamic bicycle model of a vehicle, which is slow in highway-env."""
    kind = kind_of(type(vehicle))
    return kind.slides and kind.moves


def _step_one_by_one(road: Road, dt: float) -> None:
    """Compute the result of `Road.step`; the kernel checks pairs if it knows the vehicles afterwards."""
    for vehicle in road.vehicles:
        vehicle.step(dt)
    state = look(road) if type(dt) is float else None
    if state is not None:
        state.traffic.collide(dt)
    else:
        collide_one_by_one(road, dt)


def _simulate(self: AbstractEnv, action: object = None) -> None:
    if self.road is None or len(self.road.vehicles) < 2:
        originals["AbstractEnv._simulate"](self, action)
    else:
        simulate(self, action, _ROAD_REPLACEMENTS, _observe)


def _step_env(self: AbstractEnv, action: object) -> object:
    return run_step(self, action, _simulate)


def _rewards(self: HighwayEnv, action: object) -> dict[str, float]:
    del action  # highway-env's rewards do not depend on it
    return rewards(self)


def _neighbour_vehicles(self: Road, vehicle: Vehicle, lane_index: LaneIndex | None = None) -> object:
    state = look(self)
    lane = state.owner.network.number_of(lane_index or vehicle.lane_index) if state is not None else None
    found = state.traffic.neighbour_vehicles(vehicle, lane) if state is not None and lane is not None else None
    return found or originals["Road.neighbour_vehicles"](self, vehicle, lane_index)


def _close_objects_to(
    self: Road,
    vehicle: Vehicle,
    distance: float,
    count: int | None = None,
    see_behind: bool = True,
    sort: bool = True,
    vehicles_only: bool = False,
) -> object:
    state = look(self)
    if state is not None:
        found = close_objects(
            state, vehicle, distance, count, see_behind=see_behind, sort=sort, vehicles_only=vehicles_only
        )
        if found is not None:
            return found
    return originals["Road.close_objects_to"](self, vehicle, distance, count, see_behind, sort, vehicles_only)


def _enforce_road_rules(self: RegulatedRoad) -> None:
    kept = take(self)
    state = kept or look(self)
    if state is None or not state.roster.predicts or not enforce(self, state.traffic):
        originals["RegulatedRoad.enforce_road_rules"](self)
    elif kept is not None and kept.traffic.read():
        kept.owner.keep(kept)


def _observe(self: KinematicObservation) -> object:
    road = self.env.road
    kept = take_for_observation(road)
    can_search = _is_plain(self, KinematicObservation) and _searches(road)
    found = observe(self, kept or look(road)) if can_search else None
    return found if found is not None else originals["KinematicObservation.observe"](self)


def _searches(road: Road) -> bool:
    """Return whether highway-env searches a road for close objects; a user's search must run exactly once."""
    kind = type(road)
    return kind.close_objects_to is _close_objects_to and kind.close_vehicles_to is _CLOSE_VEHICLES_TO


def _observe_exit(self: ExitObservation) -> object:
    can_search = _is_plain(self, ExitObservation) and _searches(self.env.road)
    found = observe_exit(self, look(self.env.road)) if can_search else None
    return found if found is not None else originals["ExitObservation.observe"](self)


def _observe_goal(self: KinematicsGoalObservation) -> object:
    found = observe_goal(self) if _is_plain(self, KinematicsGoalObservation) else None
    return found if found is not None else originals["KinematicsGoalObservation.observe"](self)


def _observe_grid(self: OccupancyGridObservation) -> object:
    found = observe_grid(self, look(self.env.road)) if _is_plain(self, OccupancyGridObservation) else None
    return found if found is not None else originals["OccupancyGridObservation.observe"](self)


def _fill_road_layer_by_lanes(
    self: OccupancyGridObservation, layer_index: int, lane_perception_distance: float = 100
) -> None:
    network = network_of(self.env.road) if _is_plain(self, OccupancyGridObservation) else None
    if network is None or not fill_lanes(self, network, layer_index, lane_perception_distance):
        originals["OccupancyGridObservation.fill_road_layer_by_lanes"](self, layer_index, lane_perception_distance)


def _compute_ttc_grid(
    env: AbstractEnv, time_quantization: float, horizon: float, vehicle: MDPVehicle | None = None
) -> object:
    is_usual = is_intact("observations") and isinstance(env.road, Road)
    state = look(env.road) if is_usual else None
    if state is not None:
        observer = vehicle if vehicle is not None else env.vehicle
        found = fill_times(env, state, observer, time_quantization, horizon)
        if found is not None:
            return found
    original = originals[_name(highway_env_observation, "compute_ttc_grid")]
    return original(env, time_quantization, horizon, vehicle)


def _is_plain(observation: KinematicObservation | OccupancyGridObservation, kind: Any) -> bool:
    """Return whether an observation has a known class, observes a road, and has no replaced method."""
    return bool(
        type(observation) is kind
        and is_intact("observations")
        and isinstance(observation.env.road, Road)
        and _OBSERVATION_METHODS[kind].isdisjoint(vars(observation))
    )


_CLOSE_VEHICLES_TO = Road.close_vehicles_to
_OBSERVATIONS = (KinematicObservation, ExitObservation, KinematicsGoalObservation, OccupancyGridObservation)
_OBSERVATION_METHODS = {kind: methods_of(kind) for kind in _OBSERVATIONS}
_REPLACEMENTS: tuple[tuple[type | ModuleType, str, Callable[..., object]], ...] = (
    (Road, "act", _act),
    (Road, "step", _step),
    (Road, "neighbour_vehicles", _neighbour_vehicles),
    (Road, "close_objects_to", _close_objects_to),
    (RegulatedRoad, "enforce_road_rules", _enforce_road_rules),
    (AbstractEnv, "_simulate", _simulate),
    (AbstractEnv, "step", _step_env),
    (HighwayEnv, "_rewards", _rewards),
    (KinematicObservation, "observe", _observe),
    (ExitObservation, "observe", _observe_exit),
    (KinematicsGoalObservation, "observe", _observe_goal),
    (OccupancyGridObservation, "observe", _observe_grid),
    (OccupancyGridObservation, "fill_road_layer_by_lanes", _fill_road_layer_by_lanes),
    (highway_env_observation, "compute_ttc_grid", _compute_ttc_grid),
)
_ROAD_REPLACEMENTS = [replaced for replaced in _REPLACEMENTS if replaced[0] in (Road, RegulatedRoad)]
