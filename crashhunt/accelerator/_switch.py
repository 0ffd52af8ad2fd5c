"""The accelerator of highway-env: the same results to the bit, with far less work.

It replaces a few methods of highway-env's roads and of one observation, in this process only. Whatever it does not
know, such as a class that overrides what it speeds up, is left to highway-env's own code.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.observation import (
    KinematicObservation,
    KinematicsGoalObservation,
    OccupancyGridObservation,
)
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from crashhunt.accelerator._drive import decide
from crashhunt.accelerator._move import collide, collide_one_by_one, enforce
from crashhunt.accelerator._observe import close_objects, fill_lanes, observe, observe_goal
from crashhunt.accelerator._roads import (
    forget,
    frame_of,
    is_known,
    look,
    methods_of,
    network_of,
    prepared,
    take,
    watches,
)
from crashhunt.accelerator._substep_loop import can_run_alone, simulate
from crashhunt.accelerator._vehicle_arrays import Crowd
from crashhunt.accelerator._versions import Watch, left_alone, originals, reason_against

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from highway_env.road.lane import LaneIndex
    from highway_env.vehicle.kinematics import Vehicle


__all__ = ["Acceleration", "accelerate", "is_on", "left_alone", "switch_off", "switch_on", "why_not"]


def switch_on() -> str:
    """Speed highway-env up in this process.

    Returns:
        Why not; empty where it is faster now.
    """
    if watches:
        return why_not()
    _restore()  # what a user's module replaced while it was on, and put back after it was switched off
    reason = reason_against()
    if not reason:
        alone = can_run_alone()
        for owner, name, faster in _REPLACED:
            if owner is not AbstractEnv or alone:
                originals[_name(owner, name)] = getattr(owner, name)
                setattr(owner, name, faster)
        # Whoever replaces one of ours has it called; but vehicles that decide together ask nobody for neighbours.
        ours = {_name(owner, name) for owner, name, _ in _REPLACED}
        watches["roads"] = Watch.of_roads(ours - {"Road.neighbour_vehicles"})
        watches["observations"] = Watch.of_observations(ours)
    return reason


def switch_off() -> None:
    """Have highway-env as it was; what somebody else has replaced meanwhile stays, and does without us."""
    forget()
    _restore()


def _restore() -> None:
    for owner, name, faster in _REPLACED:
        if vars(owner).get(name) is faster:
            setattr(owner, name, originals[_name(owner, name)])


def _name(owner: type, name: str) -> str:
    return f"{owner.__qualname__}.{name}"


def is_on() -> bool:
    """Whether somebody has asked for it, and it could be done."""
    return bool(watches)


def why_not() -> str:
    """Say why it is not fast at this moment; empty where it is, or where nobody has asked for it."""
    return next((watch.reason for watch in watches.values() if watch.reason), "")


def _act(self: Road) -> None:
    if len(self.vehicles) < 2:
        for vehicle in self.vehicles:
            vehicle.act()
        return
    everybody = take(self) or look(self)
    if everybody is not None:
        found, crowd, frame = everybody
        if decide(self, frame, crowd):
            found.keep(crowd, frame)
            return
    originals["Road.act"](self)


def _step(self: Road, dt: float) -> None:
    if len(self.vehicles) + len(self.objects) < 2:  # nothing to gain: cheaper than the original, which looks for pairs
        for vehicle in self.vehicles:
            vehicle.step(dt)
        if len(self.vehicles) + len(self.objects) > 1:
            collide_one_by_one(self, dt)
        return
    everybody = take(self)
    if everybody is None and not is_known(self):
        originals["Road.step"](self, dt)
        return
    found, crowd, before = everybody or (prepared(self, known=True), Crowd(self), None)
    frame = None
    if found is not None and crowd.moves and not self.record_history:
        frame = found.move(crowd, dt, before)
    if frame is None:
        for vehicle in self.vehicles:
            vehicle.step(dt)
        crowd = Crowd(self)
    if collide(self, dt, crowd) and found is not None and frame is not None:
        found.keep(crowd, frame)


def _simulate(self: AbstractEnv, action: object = None) -> None:
    if self.road is None or len(self.road.vehicles) < 2:
        originals["AbstractEnv._simulate"](self, action)
    else:
        simulate(self, action, _OF_ROADS)


def _neighbour_vehicles(self: Road, vehicle: Vehicle, lane_index: LaneIndex | None = None) -> object:
    frame = frame_of(self)
    row = frame.row.get(id(vehicle)) if frame is not None else None
    key = lane_index or vehicle.lane_index
    if frame is not None and row is not None and key:
        found = frame.neighbours(vehicle, row, key)
        if found is not None:
            return found
    return originals["Road.neighbour_vehicles"](self, vehicle, lane_index)


def _close_objects_to(
    self: Road,
    vehicle: Vehicle,
    distance: float,
    count: int | None = None,
    see_behind: bool = True,
    sort: bool = True,
    vehicles_only: bool = False,
) -> object:
    frame = frame_of(self)
    if frame is not None:
        found = close_objects(
            frame, vehicle, distance, count, see_behind=see_behind, sort=sort, vehicles_only=vehicles_only
        )
        if found is not None:
            return found
    return originals["Road.close_objects_to"](self, vehicle, distance, count, see_behind, sort, vehicles_only)


def _enforce_road_rules(self: RegulatedRoad) -> None:
    everybody = take(self)
    if (everybody is not None or prepared(self) is not None) and enforce(self):
        if everybody is not None:
            found, crowd, frame = everybody
            found.keep(crowd, frame)
    else:
        originals["RegulatedRoad.enforce_road_rules"](self)


def _observe(self: KinematicObservation) -> object:
    if _is_plain(self, KinematicObservation):
        found = observe(self, frame_of(self.env.road))
        if found is not None:
            return found
    return originals["KinematicObservation.observe"](self)


def _observe_goal(self: KinematicsGoalObservation) -> object:
    found = observe_goal(self) if _is_plain(self, KinematicsGoalObservation) else None
    return found if found is not None else originals["KinematicsGoalObservation.observe"](self)


def _fill_road_layer_by_lanes(
    self: OccupancyGridObservation, layer_index: int, lane_perception_distance: float = 100
) -> None:
    network = network_of(self.env.road) if _is_plain(self, OccupancyGridObservation) else None
    if network is not None:
        fill_lanes(self, network, layer_index, lane_perception_distance)
    else:
        originals["OccupancyGridObservation.fill_road_layer_by_lanes"](self, layer_index, lane_perception_distance)


def _is_plain(observation: KinematicObservation | OccupancyGridObservation, kind: Any) -> bool:
    """Whether an observation of a road is of a class that is known, and nobody has replaced a part of it."""
    return bool(
        type(observation) is kind
        and watches
        and watches["observations"].intact
        and isinstance(observation.env.road, Road)
        and _SHOWN[kind].isdisjoint(vars(observation))
    )


_OBSERVATIONS = (KinematicObservation, KinematicsGoalObservation, OccupancyGridObservation)
_SHOWN = {kind: methods_of(kind) for kind in _OBSERVATIONS}
_REPLACED: tuple[tuple[type, str, Callable[..., object]], ...] = (
    (Road, "act", _act),
    (Road, "step", _step),
    (Road, "neighbour_vehicles", _neighbour_vehicles),
    (Road, "close_objects_to", _close_objects_to),
    (RegulatedRoad, "enforce_road_rules", _enforce_road_rules),
    (AbstractEnv, "_simulate", _simulate),
    (KinematicObservation, "observe", _observe),
    (KinematicsGoalObservation, "observe", _observe_goal),
    (OccupancyGridObservation, "fill_road_layer_by_lanes", _fill_road_layer_by_lanes),
)
_OF_ROADS = [replaced for replaced in _REPLACED if issubclass(replaced[0], Road)]


# ``crashhunt.accelerate()``: highway-env faster in a process of your own, such as one that trains a policy.


class Acceleration:
    """What `accelerate` has done, as it stands at the moment: true where highway-env is faster.

    As a context manager it is undone at the end of the block, unless it was in place before.
    """

    def __init__(self, reason: str, *, before: bool) -> None:
        self._reason = reason
        self._before = before

    @property
    def reason(self) -> str:
        """Why highway-env is as slow as ever, such as that a module of yours has replaced one of its functions."""
        from crashhunt.accelerator import _switch

        if self._reason:
            return self._reason
        return _switch.why_not() if _switch.is_on() else "it has been undone"

    @property
    def left_alone(self) -> dict[str, tuple[str, ...]]:
        """The classes of vehicles met so far that are not sped up, or in part only, with what is their own."""
        from crashhunt.accelerator import _switch

        return {name: tuple(own) for name, own in _switch.left_alone.items()}

    def undo(self) -> None:
        """Have highway-env as it was."""
        from crashhunt.accelerator import _switch

        _switch.switch_off()

    def __bool__(self) -> bool:
        return not self.reason

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._before:
            self.undo()

    def __repr__(self) -> str:
        if self.reason:
            return f"<highway-env is not accelerated: {self.reason}>"
        own = "; ".join(f"{name} has its own {', '.join(names)}" for name, names in self.left_alone.items())
        return f"<highway-env is accelerated{f', but {own}' if own else ''}>"


def accelerate() -> Acceleration:
    """Speed highway-env up in this process: the same results to the bit, in a fraction of the time.

    What it does not know is left to highway-env's own code, and looked at again in every step: another version of it,
    classes of yours that override what is sped up, functions and methods that somebody replaces, on a class, a module
    or one object. A hunt does this by itself.

    Returns:
        What came of it: its truth value says whether, ``reason`` why not, ``left_alone`` which classes are not sped
        up, and ``undo()``, or the end of a ``with`` block, has highway-env as it was.

    Example:
        >>> import crashhunt
        >>> with crashhunt.accelerate() as faster:
        ...     print(faster)
        <highway-env is accelerated>
    """
    from crashhunt.accelerator import _switch

    before = _switch.is_on()
    return Acceleration(_switch.switch_on(), before=before)
