"""Fault injection on highway-env: a disturbance overrides the decisions of a vehicle in every sub-step until it ends.

The override happens between `Road.act` and `Road.step`, so that it does not matter whether the accelerator computed the
decisions.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from highway_env.road.regulation import RegulatedRoad
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle

from crashhunt.world import place_words

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence

    from highway_env.road.road import Road, RoadNetwork
    from numpy.typing import NDArray

    from crashhunt.simulators import ActiveDisturbance
    from crashhunt.trial import Disturbance


# Paths of vehicles through a junction: which paths cross the agent's path.

_REACH_M = 80.0  # length of a path ahead of its vehicle
_STEP_M = 2.0  # distance between the points of a path
_MEETS_M = 2.5  # two paths cross if two of their points are nearer than this

_Road = tuple[str, str]


def place_of(agent: Any, other: Any) -> str:
    """Return the place of a vehicle relative to an agent, such as ``left ahead``, from positions and not from lanes."""
    dx, dy = (other.position - agent.position).tolist()
    c, s = math.cos(agent.heading), math.sin(agent.heading)
    return place_words(dx * c + dy * s, dx * s - dy * c, agent.LENGTH)  # y points down


def crosses(network: RoadNetwork, agent: Any, other: Any) -> bool:
    """Return whether the paths of two vehicles cross, and neither vehicle is on a road of the other vehicle's path."""
    own_roads, own = _way(network, agent)
    roads, way = _way(network, other)
    if other.lane_index[:2] in own_roads or agent.lane_index[:2] in roads:
        return False
    offset = own[:, None, :] - way[None, :, :]
    return bool((np.hypot(offset[..., 0], offset[..., 1]) < _MEETS_M).any())


def _way(network: RoadNetwork, vehicle: Any) -> tuple[set[_Road], NDArray[np.float64]]:
    """Return the roads of a vehicle's path, and the points of the path, 2 m apart."""
    along = float(vehicle.lane.local_coordinates(vehicle.position)[0])
    roads, points, driven = set(), [vehicle.position], 0.0
    for index in lanes_ahead(network, vehicle):
        roads.add(index[:2])
        lane = network.get_lane(index)
        while along < lane.length and driven < _REACH_M:
            points.append(lane.position(along, 0.0))
            along, driven = along + _STEP_M, driven + _STEP_M
        if driven >= _REACH_M:
            break
        along = 0.0
    return roads, np.array(points)


def lanes_ahead(
    network: RoadNetwork, vehicle: Any, index: tuple[str, str, int] | None = None
) -> Iterator[tuple[str, str, int]]:
    """Yield a vehicle's lane and the lanes after it, up to a fork for which the vehicle has no route.

    At such a fork, `RoadNetwork.next_lane` would draw a lane at random and change the simulation.
    """
    start, end, number = index or vehicle.lane_index
    # Only a ControlledVehicle has a planned route.
    route = vehicle.route if isinstance(vehicle, ControlledVehicle) else None
    planned = {road[0]: road[1] for road in route or ()}
    seen = set()
    while (start, end) not in seen:
        yield start, end, number
        seen.add((start, end))
        after = network.graph.get(end, {})
        onward = planned.get(end) or (next(iter(after)) if len(after) == 1 else None)
        if onward not in after:
            return
        start, end, number = end, onward, min(number, len(after[onward]) - 1)


# Vehicles further away are no target: in the same lane, in a neighbouring lane, on a crossing path.
_IN_LANE_M, _NEIGHBOUR_LANE_M, _CROSSING_M = 100.0, 50.0, 80.0
_DAWDLING_DECELERATION_MPS2 = 1.5


class HighwayDisturbances:
    """Finds the target vehicles of disturbances in one episode, and disturbs them."""

    def __init__(self, road: Road, controlled: Collection[Any]) -> None:
        self._road = road
        self._controlled = controlled
        self._active: list[_Active] = []

    @property
    def is_active(self) -> bool:
        """Whether any vehicle is currently disturbed."""
        return bool(self._active)

    def before_moving(self, dt: float) -> None:
        """Override the decisions of disturbed vehicles for the next sub-step of ``dt`` s."""
        for active in self._active:
            if not active.vehicle.crashed:
                active.override(dt)

    def after_moving(self) -> None:
        """Undo the effects of right-of-way rules on disturbed vehicles, before the vehicles decide again."""
        for active in self._active:
            active.after()

    def resolve_target(self, agent: Any, disturbance: Disturbance) -> Any | None:
        """Return the target vehicle; None if no vehicle is at the place."""
        if disturbance.what == "ignore_priority":
            return self._crossing(agent, disturbance.who)
        return self.at(agent, disturbance.who)

    def _crossing(self, agent: Any, who: str) -> Any | None:
        """Return the nearest vehicle at a place around the agent whose path crosses the agent's path."""
        if not isinstance(self._road, RegulatedRoad):
            return None  # without right-of-way rules, vehicles never give way
        near = []
        for other in self._road.vehicles:
            if not isinstance(other, IDMVehicle) or any(other is vehicle for vehicle in self._controlled):
                continue
            dx, dy = (other.position - agent.position).tolist()
            squared = dx * dx + dy * dy
            if squared <= _CROSSING_M**2 and place_of(agent, other) == who:
                near.append((squared, other))
        near.sort(key=lambda found: found[0])
        return next((other for _, other in near if crosses(self._road.network, agent, other)), None)

    def at(self, agent: Any, who: str) -> Any | None:
        """Return the vehicle at a place around an agent, in its lane or a neighbouring lane; None if there is none."""
        side, _, along = who.rpartition(" ") if who in ("ahead", "behind") else who.partition(" ")
        start, end, number = agent.lane_index
        lane = (start, end, number + {"left": -1, "right": 1}.get(side, 0))
        if not 0 <= lane[2] < len(self._road.network.graph[start][end]):
            return None
        near = []
        for other in self._road.neighbour_vehicles(agent, lane):
            if not isinstance(other, IDMVehicle) or any(other is vehicle for vehicle in self._controlled):
                continue
            distance = float(agent.lane_distance_to(other))
            overlaps = bool(side) and abs(distance) < (agent.LENGTH + other.LENGTH) / 2
            place = "" if overlaps else "ahead" if distance > 0 else "behind"
            if place == along and abs(distance) <= (_NEIGHBOUR_LANE_M if side else _IN_LANE_M):
                near.append((abs(distance), other))
        return min(near, key=lambda found: found[0])[1] if near else None

    def disturb(self, vehicle: Any, disturbance: Disturbance, agent: Any) -> ActiveDisturbance | None:
        """Disturb a vehicle until the disturbance ends; return None if the vehicle cannot be disturbed in this way."""
        strong = disturbance.how_strong
        hardest = min(strong, float(vehicle.ACC_MAX))
        active: _Active
        if disturbance.what in ("brake", "stop"):
            limit = float(vehicle.ACC_MAX)
            active = _Slows(
                vehicle, self._release, hardest, hardest, strengths=[min(one, limit) for one in disturbance.strengths]
            )
        elif disturbance.what == "dawdle":
            target = max(0.0, 1.0 - strong) * float(vehicle.speed)
            active = _Slows(vehicle, self._release, strong, _DAWDLING_DECELERATION_MPS2, target=target)
        elif disturbance.what == "speed":
            active = _Speeds(vehicle, self._release, strong)
        elif disturbance.what == "ignore_priority":
            active = _Ignores(vehicle, self._release, 1.0)
        elif disturbance.what == "late_merge":
            left = self._left_of_lane(vehicle)
            if left is None or vehicle.lane_index != vehicle.target_lane_index:
                return None
            active = _MergesLate(vehicle, self._release, min(strong, left))
        else:
            in_other_lane = vehicle.lane_index[:2] == agent.lane_index[:2] and vehicle.lane_index != agent.lane_index
            if not in_other_lane or vehicle.lane_index != vehicle.target_lane_index:
                return None  # the vehicle is on another road, in the agent's lane, or already changing lanes
            active = _CutsIn(vehicle, self._release, hardest, agent.lane_index)
        self._active.append(active)
        return active

    def hold(self, vehicle: Any, what: str) -> ActiveDisturbance | None:
        """Apply a hold to a vehicle until the hold ends; return None for an object that does not drive."""
        if not isinstance(vehicle, IDMVehicle):
            return None
        kind = {"keep_speed": _KeepsSpeed, "keep_lane": _KeepsLane}.get(what)
        if kind is None:
            self._road.vehicles.remove(vehicle)
            return _Active(vehicle, lambda _: None, 1.0)
        active: _Active = kind(vehicle, self._release, 1.0)
        self._active.append(active)
        return active

    def _left_of_lane(self, vehicle: Any) -> float | None:
        """Return the rest of a vehicle's lane, in m, if the lane ends; None otherwise.

        highway-env numbers lanes from the left. A lane ends if a following road has no lane with its number.
        """
        _, end, number = vehicle.lane_index
        after = self._road.network.graph.get(end, {})
        if not number or not after or number < min(len(lanes) for lanes in after.values()):
            return None
        return _distance_to_lane_end(vehicle)

    def _release(self, active: _Active) -> None:
        self._active.remove(active)


class _Active:
    """A disturbance or hold of a vehicle, until `end`."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Active], None], how_strong: float) -> None:
        self.vehicle = vehicle
        self.how_strong = how_strong
        self._release = let_go

    def override(self, dt: float) -> None:
        """Change the vehicle's decision for a sub-step of ``dt`` s."""

    def after(self) -> None:
        """Undo the effects of the sub-step that has ended."""

    def keep(self) -> None:
        """Do nothing, because `override` runs in every sub-step."""

    def end(self) -> None:
        """Let the vehicle drive by itself again."""
        self._release(self)

    def _brake(self, deceleration: float, dt: float, down_to: float = 0.0) -> None:
        """Brake with at least the given deceleration until the speed is ``down_to``."""
        action, speed = self.vehicle.action, float(self.vehicle.speed)
        wanted = max(-deceleration, min(0.0, (down_to - speed) / dt))
        if speed <= down_to:
            wanted = (down_to - speed) / dt if down_to > 0 else 0.0
        action["acceleration"] = min(float(action["acceleration"]), wanted)


class _Slows(_Active):
    """Makes the vehicle brake to a target speed and keep it."""

    def __init__(
        self,
        vehicle: Any,
        let_go: Callable[[_Active], None],
        how_strong: float,
        deceleration: float,
        *,
        target: float = 0.0,
        strengths: Sequence[float] = (),
    ) -> None:
        super().__init__(vehicle, let_go, how_strong)
        self._later = iter(strengths)
        self._deceleration = next(self._later, deceleration)
        self._target = target

    def keep(self) -> None:
        self._deceleration = next(self._later, self._deceleration)

    def override(self, dt: float) -> None:
        self._brake(self._deceleration, dt, self._target)


class _Speeds(_Active):
    """Raises the vehicle's desired speed; the vehicle keeps its distance to others as before."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Active], None], share: float) -> None:
        super().__init__(vehicle, let_go, share)
        self._before = vehicle.target_speed
        vehicle.target_speed = (1.0 + share) * self._before

    def end(self) -> None:
        self.vehicle.target_speed = self._before
        super().end()


class _WithoutOwnChanges(_Active):
    """A disturbance in which the vehicle does not change lanes by its own model (MOBIL)."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Active], None], how_strong: float) -> None:
        super().__init__(vehicle, let_go, how_strong)
        self._before = vehicle.enable_lane_change
        vehicle.enable_lane_change = False

    def end(self) -> None:
        self.vehicle.enable_lane_change = self._before
        super().end()


class _CutsIn(_WithoutOwnChanges):
    """Makes the vehicle change lanes as soon as no vehicle overlaps it there, and optionally brake in the new lane."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Active], None], deceleration: float, lane: Any) -> None:
        super().__init__(vehicle, let_go, deceleration)
        self._lane = lane
        self._begin()

    def override(self, dt: float) -> None:
        if self.vehicle.target_lane_index != self._lane:
            self._begin()
        if self.how_strong and self.vehicle.lane_index == self._lane:
            self._brake(self.how_strong, dt)

    def _begin(self) -> None:
        _change(self.vehicle, self._lane)


class _KeepsSpeed(_Active):
    """Makes the vehicle keep its speed, even with an obstacle ahead."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Active], None], how_strong: float) -> None:
        super().__init__(vehicle, let_go, how_strong)
        self._speed = float(vehicle.speed)

    def override(self, dt: float) -> None:
        self.vehicle.action["acceleration"] = (self._speed - float(self.vehicle.speed)) / dt


class _KeepsLane(_WithoutOwnChanges):
    """Makes the vehicle keep its lane."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Active], None], how_strong: float) -> None:
        super().__init__(vehicle, let_go, how_strong)
        vehicle.target_lane_index = vehicle.lane_index


class _MergesLate(_WithoutOwnChanges):
    """Keeps the vehicle in a lane that ends, and lets it change lanes late.

    The change begins when the rest of the lane is short enough and no vehicle overlaps in the neighbouring lane.
    """

    def __init__(self, vehicle: Any, let_go: Callable[[_Active], None], left: float) -> None:
        super().__init__(vehicle, let_go, left)
        start, end, number = self._ending = vehicle.lane_index
        self._lane = (start, end, number - 1)

    def override(self, dt: float) -> None:
        vehicle = self.vehicle
        if vehicle.target_lane_index == self._ending and _distance_to_lane_end(vehicle) <= self.how_strong:
            _change(vehicle, self._lane)


class _Ignores(_Active):
    """Makes the vehicle ignore right of way: it continues whenever the right-of-way rules would stop it."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Active], None], how_strong: float) -> None:
        super().__init__(vehicle, let_go, how_strong)
        self.after()

    def after(self) -> None:
        vehicle = self.vehicle
        if getattr(vehicle, "is_yielding", False):  # as `RegulatedRoad` does when a vehicle need not yield any more
            vehicle.target_speed = vehicle.lane.speed_limit
            del vehicle.color
            vehicle.is_yielding = False


def _distance_to_lane_end(vehicle: Any) -> float:
    """Return the distance of a vehicle to the end of its lane, in m."""
    return float(vehicle.lane.length - vehicle.lane.local_coordinates(vehicle.position)[0])


def _change(vehicle: Any, lane: Any) -> None:
    """Make a vehicle change lanes, unless another vehicle overlaps it in that lane."""
    for other in vehicle.road.neighbour_vehicles(vehicle, lane):
        room = (vehicle.LENGTH + other.LENGTH) / 2 if other is not None else 0.0
        if other is not None and abs(vehicle.lane_distance_to(other)) <= room:
            return
    vehicle.target_lane_index = lane
