"""Applies actions and holds to SUMO's vehicles."""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.scenario import ACTIONS
from crashhunt.simulators import META_ACTIONS
from crashhunt.sumo._drivable_area import DrivableArea
from crashhunt.sumo._free_motion import FreeMotion
from crashhunt.sumo.maps import is_left_hand

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.scenario import AgentSetup
    from crashhunt.simulators import ActiveDisturbance


# Calls go to libsumo's extension module, because the wrapper functions of the package cost twice as much.

FREE_FORMS = tuple(name for name, form in ACTIONS.items() if form.moves_freely)
_NO_SPEED_CHECKS = 0  # speed mode: the vehicle drives the commanded speed
_ALL_SPEED_CHECKS = 31  # speed mode: SUMO's default, with which a vehicle drives as its models decide
_NO_LANE_CHANGES = 0  # lane change mode
_OWN_LANE_CHANGES = 0b011001010101  # lane change mode: SUMO's default


class Driving:
    """Applies actions to vehicles."""

    def __init__(self, setups: Mapping[str, AgentSetup], step_length_s: float, net: Path) -> None:
        self._setups, self._step_length_s, self._net = setups, step_length_s, net
        self._edges: dict[str, list[float]] = {}
        self._closed_lanes: dict[tuple[str, str], bool] = {}
        self._targets: dict[str, int] = {}
        self._durations = {
            agent: float(setup.action_settings.get("lane_change_duration_s", 0.0)) for agent, setup in setups.items()
        }
        self._changes: dict[str, float] = {}  # the rest of each lane change under way, in m to the left
        ways: dict[str, Callable[[str, NDArray[np.generic]], bool]] = {
            "speed_and_lane": self._apply_speed,
            "speed_and_lateral": self._apply_drift,
            "meta": self._apply_meta,
            "acceleration": self._apply_acceleration,
            "sumo": self._apply_override,
            **dict.fromkeys(FREE_FORMS, self._move_freely),
        }
        self._ways = {agent: ways[setup.action_form] for agent, setup in setups.items()}
        self._lateral_speeds: dict[str, float] = {}
        self._overridden: set[str] = set()
        self._area = DrivableArea()
        self.moving: dict[str, FreeMotion] = {}
        """The motion of each vehicle that moves freely in this episode."""

    def begin(self, agents: Iterable[str]) -> None:
        """Reset the state of the last episode, but keep data that was read from the network."""
        self._targets = dict.fromkeys(agents, -1)
        self._lateral_speeds.clear()
        self._changes.clear()
        self._overridden.clear()
        self.moving.clear()
        for agent in self._targets:
            form = self._setups[agent].action_form
            if form == "sumo":
                self._leave_to_sumo(agent)
            elif form in FREE_FORMS:
                settings = self._setups[agent].action_settings
                self.moving[agent] = FreeMotion(agent, form, self._step_length_s, self._area, settings)
        if self.moving:
            self._area.read_obstacles()

    def apply(self, agent: str, action: NDArray[np.generic]) -> bool:
        """Apply an encoded action; return whether the vehicle stays on the road."""
        try:
            return self._ways[agent](agent, action)
        except libsumo.TraCIException:
            if agent in sumo.vehicle_getIDList():
                raise
            return True  # the vehicle has left: the agent's own code may have removed it

    def _apply_speed(self, agent: str, action: NDArray[np.generic]) -> bool:
        speed, change = action.tolist()
        sumo.vehicle_setSpeed(agent, speed)
        return self._move_to_lane(agent, int(change))

    def _apply_acceleration(self, agent: str, action: NDArray[np.generic]) -> bool:
        """Set the speed that the vehicle has after a step of this acceleration; SUMO applies the limits of its type."""
        acceleration, change = action.tolist()
        sumo.vehicle_setSpeed(agent, max(0.0, sumo.vehicle_getSpeed(agent) + acceleration * self._step_length_s))
        return self._move_to_lane(agent, int(change))

    def _move_to_lane(self, agent: str, change: int) -> bool:
        """Change lanes at once, or drift for the duration that the setting of the form states.

        A new lane change is ignored until the last one has ended. Where the road ends before, the vehicle drifts to the
        middle of the lane that it is on.
        """
        duration = self._durations[agent]
        if not duration:
            return not change or self._change_lane(agent, change)
        edge, lane = sumo.vehicle_getRoadID(agent), sumo.vehicle_getLaneIndex(agent)
        if edge.startswith(":") or lane < 0:
            if agent in self._changes:
                self._changes[agent] = -self._side * sumo.vehicle_getLateralLanePosition(agent)
                self._lateral_speeds[agent] = 0.0
            return True
        rest = self._changes.get(agent, 0.0)
        widths = self._widths(edge)
        if not rest and change:
            found = self.neighboring_lane(agent, change)
            if found is None or not found[0]:
                return found is None
            rest = change * (widths[lane] + widths[lane + found[1]]) / 2
        if not rest:
            self._lateral_speeds[agent] = 0.0
            return True
        most = widths[lane] / duration * self._step_length_s
        left = max(-most, min(most, rest))
        self._changes[agent] = rest - left if abs(rest) > abs(left) else 0.0
        return self._drift(agent, left)

    def _apply_drift(self, agent: str, action: NDArray[np.generic]) -> bool:
        """Set the speed, and move the vehicle across its lane at a speed."""
        speed, left = action.tolist()
        sumo.vehicle_setSpeed(agent, speed)
        return self._drift(agent, left * self._step_length_s)

    def _drift(self, agent: str, left: float) -> bool:
        """Move the vehicle across its lane, or into the next lane when its centre is over the line.

        SUMO without its sublane model moves no vehicle across a lane, but keeps a lateral position that is set. Inside
        a junction, where lanes have no neighbours, the vehicle keeps its lateral position. ``left`` is the distance to
        the left in the next step, in m.
        """
        edge, lane = sumo.vehicle_getRoadID(agent), sumo.vehicle_getLaneIndex(agent)
        inside = edge.startswith(":") or lane < 0
        self._lateral_speeds[agent] = 0.0 if inside else left / self._step_length_s
        if inside or not left:
            return True
        widths = self._widths(edge)
        offset = self._side * sumo.vehicle_getLateralLanePosition(agent) + left
        change = 0 if abs(offset) <= widths[lane] / 2 else 1 if offset > 0 else -1
        if change:
            found = self.neighboring_lane(agent, change)
            if found is None or not found[0]:
                return False
            target = lane + found[1]
            offset -= change * (widths[lane] + widths[target]) / 2
            sumo.vehicle_moveTo(agent, f"{edge}_{target}", sumo.vehicle_getLanePosition(agent))
        sumo.vehicle_setLateralLanePosition(agent, self._side * offset)
        return True

    @property
    def _side(self) -> float:
        """The sign of SUMO's lateral positions: SUMO mirrors left-hand traffic."""
        return -1.0 if self.left_hand else 1.0

    def _apply_override(self, agent: str, action: NDArray[np.generic]) -> bool:
        """Let SUMO drive, except for what the agent overrides in this step."""
        speed, change = action.tolist()
        if speed < 0 and not change:
            if agent in self._overridden:
                self._leave_to_sumo(agent)
            return True
        self._leave_to_sumo(agent)
        self._overridden.add(agent)
        if speed >= 0:
            sumo.vehicle_setSpeedMode(agent, self._setups[agent].speed_mode)
            sumo.vehicle_setSpeed(agent, speed)
        if change:
            sumo.vehicle_setLaneChangeMode(agent, _NO_LANE_CHANGES)
        return not change or self._change_lane(agent, int(change))

    def _leave_to_sumo(self, agent: str) -> None:
        """Give speed and lane changes of a vehicle back to SUMO's models."""
        self._overridden.discard(agent)
        sumo.vehicle_setSpeedMode(agent, _ALL_SPEED_CHECKS)
        sumo.vehicle_setSpeed(agent, -1.0)
        sumo.vehicle_setLaneChangeMode(agent, _OWN_LANE_CHANGES)

    def _move_freely(self, agent: str, action: NDArray[np.generic]) -> bool:
        return self.moving[agent].apply(action)

    def settle(self) -> None:
        """Complete a step that SUMO has simulated."""
        for motion in self.moving.values():
            motion.settle()

    def is_inside_lane(self, agent: str) -> bool:
        """Return whether an agent's whole vehicle is inside a straight part of the lane of a road that SUMO assigns."""
        lane = sumo.vehicle_getLaneID(agent)
        motion = self.moving.get(agent)
        if motion is not None:
            return bool(lane == motion.inside and not lane.startswith(":"))
        aside = abs(sumo.vehicle_getLateralLanePosition(agent)) + sumo.vehicle_getWidth(agent) / 2
        return bool(lane and aside <= sumo.lane_getWidth(lane) / 2)

    def _apply_meta(self, agent: str, encoded: NDArray[np.generic]) -> bool:
        """Apply a meta-action as highway-env does: FASTER and SLOWER select the next target speed."""
        action, targets = META_ACTIONS[int(encoded[0])], self._setups[agent].target_speeds
        if self._targets[agent] < 0:
            speed = sumo.vehicle_getSpeed(agent)
            self._targets[agent] = min(range(len(targets)), key=lambda index: abs(targets[index] - speed))
        shift = {"FASTER": 1, "SLOWER": -1}.get(action, 0)
        self._targets[agent] = max(0, min(len(targets) - 1, self._targets[agent] + shift))
        sumo.vehicle_setSpeed(agent, targets[self._targets[agent]])
        change = {"LANE_LEFT": 1, "LANE_RIGHT": -1}.get(action, 0)
        if change:
            self._change_lane(agent, change)  # a change without a neighbouring lane does nothing, as in highway-env
        return True

    def _change_lane(self, agent: str, change: int) -> bool:
        """Change to a neighbouring lane at once; return False if there is no lane that the vehicle may use."""
        lane = self.neighboring_lane(agent, change)
        if lane is None:
            return True  # inside a junction there are no neighbouring lanes, and no road to leave
        exists, direction = lane
        if exists:
            sumo.vehicle_changeLane(agent, sumo.vehicle_getLaneIndex(agent) + direction, self._step_length_s)
        return exists

    def neighboring_lane(self, agent: str, change: int) -> tuple[bool, int] | None:
        """Return whether the vehicle may use a neighbouring lane, and the difference of SUMO's lane indices.

        The result is None inside a junction, where lanes have no neighbours, and for a vehicle off its lane. The change
        is 1 to the left, and -1 to the right.
        """
        edge, lane = sumo.vehicle_getRoadID(agent), sumo.vehicle_getLaneIndex(agent)
        if edge.startswith(":") or lane < 0:
            return None
        lanes = self.lanes(edge)
        direction = -change if self.left_hand else change
        target = lane + direction
        exists = 0 <= target < lanes
        if exists and self._is_closed(f"{edge}_{target}", sumo.vehicle_getVehicleClass(agent)):
            exists = False
        return exists, direction

    def lanes(self, edge: str) -> int:
        """Return the number of lanes of an edge."""
        return len(self._widths(edge))

    def _widths(self, edge: str) -> list[float]:
        """Return the widths in m of the lanes of an edge; sidewalks and bicycle lanes often have another."""
        found = self._edges.get(edge)
        if found is None:
            lanes = sumo.edge_getLaneNumber(edge)
            found = self._edges[edge] = [sumo.lane_getWidth(f"{edge}_{lane}") for lane in range(lanes)]
        return found

    @cached_property
    def left_hand(self) -> bool:
        """Whether traffic drives on the left: SUMO then mirrors the network and numbers lanes from the left."""
        return is_left_hand(self._net)

    def from_left(self, edge: str, lane: int) -> float:
        """Return the distance in m from the centre line of an edge's leftmost lane to that of the given lane."""
        widths = self._widths(edge)
        between = widths[: lane + 1] if self.left_hand else widths[lane:]
        if all(width == between[0] for width in between):
            return (len(between) - 1) * between[0]  # exact, where a sum would be rounded
        return sum(between) - (between[0] + between[-1]) / 2

    def aside(self, agent: str) -> tuple[float, float]:
        """Return how far a vehicle is right of its lane's centre line, in m, and its speed to the right, in m/s."""
        sign = 1.0 if self.left_hand else -1.0
        drift = self._lateral_speeds.get(agent)  # SUMO reports no speed of a vehicle whose lateral position is set
        speed = sign * sumo.vehicle_getLateralSpeed(agent) if drift is None else -drift
        return sign * sumo.vehicle_getLateralLanePosition(agent), speed

    def _is_closed(self, lane: str, vehicle_class: str) -> bool:
        found = self._closed_lanes.get((lane, vehicle_class))
        if found is None:
            allowed = sumo.lane_getAllowed(lane)
            found = bool(allowed) and vehicle_class not in allowed and vehicle_class != "ignoring"
            self._closed_lanes[lane, vehicle_class] = found
        return found


# Holds for counterfactual runs: keep a vehicle's speed or lane, or remove the vehicle.


def hold_vehicle(vehicle: str, what: str) -> ActiveDisturbance | None:
    """Apply a hold to a vehicle from the next step on; return None if the vehicle is not in the simulation.

    The hold is one of `HELD`.
    """
    if vehicle not in sumo.vehicle_getIDList():
        return None
    if what == "gone":
        libsumo.vehicle.remove(vehicle)
        return _Gone(vehicle)
    return _KeepsSpeed(vehicle) if what == "keep_speed" else _KeepsLane(vehicle)


class VehicleCommand:
    """A command to a vehicle until its end. The vehicle may leave the simulation before."""

    how_strong = 1.0
    speeds: ClassVar[dict[str, float | None]] = {}
    """The speeds that commands have set, in m/s, by vehicle; None for a vehicle whose speed mode is also commanded."""
    lanes: ClassVar[set[str]] = set()
    """The vehicles whose lane changes are commanded."""
    speed_modes: ClassVar[dict[str, int]] = {}
    change_modes: ClassVar[dict[str, int]] = {}
    """The modes of vehicles that have other modes while an agent's vehicle is in their way; see `Followers`."""

    def __init__(self, vehicle: str) -> None:
        self._vehicle = vehicle

    @classmethod
    def forget_all(cls) -> None:
        """Forget the commands and modes of the last episode."""
        for known in (cls.speeds, cls.lanes, cls.speed_modes, cls.change_modes):
            known.clear()

    def _set_speed(self, speed: float) -> None:
        sumo.vehicle_setSpeed(self._vehicle, speed)
        self.speeds[self._vehicle] = speed

    def _command_speed_mode(self, mode: int) -> int:
        """Set the speed mode; return the mode to restore."""
        before = self.speed_modes.get(self._vehicle)
        before = sumo.vehicle_getSpeedMode(self._vehicle) if before is None else before
        sumo.vehicle_setSpeedMode(self._vehicle, mode)
        self.speeds[self._vehicle] = None
        return int(before)

    def _command_lane_changes(self, mode: int) -> int:
        """Set the lane change mode; return the mode to restore."""
        before = self.change_modes.get(self._vehicle)
        before = sumo.vehicle_getLaneChangeMode(self._vehicle) if before is None else before
        sumo.vehicle_setLaneChangeMode(self._vehicle, mode)
        self.lanes.add(self._vehicle)
        return int(before)

    def _release_lane_changes(self, mode: int) -> None:
        self.lanes.discard(self._vehicle)
        sumo.vehicle_setLaneChangeMode(self._vehicle, mode)

    def keep(self) -> None:
        """Continue the command for a step."""
        with suppress(libsumo.TraCIException):  # SUMO's error for a vehicle that has left
            self._command()

    def end(self) -> None:
        """Let the vehicle drive by itself again."""
        with suppress(libsumo.TraCIException):
            self._release()

    def _command(self) -> None:
        """Command the vehicle in a step; by default, SUMO keeps the first command."""

    def _release(self) -> None:
        self.speeds.pop(self._vehicle, None)
        sumo.vehicle_setSpeed(self._vehicle, -1.0)


class _Gone(VehicleCommand):
    """The hold of a vehicle that has been removed for the rest of the episode."""

    def _release(self) -> None:
        """Do nothing, because the vehicle does not return."""


class _KeepsSpeed(VehicleCommand):
    """Makes the vehicle keep its speed, even with an obstacle ahead."""

    def __init__(self, vehicle: str) -> None:
        super().__init__(vehicle)
        self.how_strong = float(sumo.vehicle_getSpeed(vehicle))
        self._before = self._command_speed_mode(_NO_SPEED_CHECKS)
        sumo.vehicle_setSpeed(vehicle, self.how_strong)

    def _release(self) -> None:
        sumo.vehicle_setSpeedMode(self._vehicle, self._before)
        super()._release()


class _KeepsLane(VehicleCommand):
    """Makes the vehicle keep its lane."""

    def __init__(self, vehicle: str) -> None:
        super().__init__(vehicle)
        self._before = self._command_lane_changes(_NO_LANE_CHANGES)

    def _release(self) -> None:
        self._release_lane_changes(self._before)
