"""Vehicles of highway-env that err: what they have decided is overruled in every sub-step, and then no more.

That happens between deciding and moving, so that it makes no difference whether the accelerator decides for them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from highway_env.road.regulation import RegulatedRoad
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

    from highway_env.road.road import Road, RoadNetwork
    from numpy.typing import NDArray

    from crashhunt.simulators._protocol import ActiveDisturbance
    from crashhunt.trial import Disturbance


__all__ = ["HighwayDisturbances", "crosses", "place_of"]


# The ways of vehicles of highway-env through a junction: which of them cross that of the agent.

_REACH_M = 80.0  # what is further on is not looked at
_STEP_M = 2.0
_MEETS_M = 2.5  # two ways that come so near to each other meet
_HALF_LANE_M = 1.6  # half a lane: who is less to the side is ahead

_Road = tuple[str, str]


def place_of(agent: Any, other: Any) -> str:
    """Return the place of another vehicle around an agent, as the crow flies."""
    dx, dy = (other.position - agent.position).tolist()
    c, s = math.cos(agent.heading), math.sin(agent.heading)
    ahead, right = dx * c + dy * s, dy * c - dx * s  # y points down
    side = "" if abs(right) <= _HALF_LANE_M else "right" if right > 0 else "left"
    along = "ahead" if ahead > agent.LENGTH / 2 else "behind" if ahead < -agent.LENGTH / 2 else ""
    return f"{side} {along}".strip()


def crosses(network: RoadNetwork, agent: Any, other: Any) -> bool:
    """Whether another vehicle's way meets the agent's, and neither comes along the road of the other."""
    own_roads, own = _way(network, agent)
    roads, way = _way(network, other)
    if other.lane_index[:2] in own_roads or agent.lane_index[:2] in roads:
        return False
    offset = own[:, None, :] - way[None, :, :]
    return bool((np.hypot(offset[..., 0], offset[..., 1]) < _MEETS_M).any())


def _way(network: RoadNetwork, vehicle: Any) -> tuple[set[_Road], NDArray[np.float64]]:
    """The roads that it comes along, and points 2 m apart."""
    along = float(vehicle.lane.local_coordinates(vehicle.position)[0])
    roads, points, driven = set(), [vehicle.position], 0.0
    for index in _lanes(network, vehicle):
        roads.add(index[:2])
        lane = network.get_lane(index)
        while along < lane.length and driven < _REACH_M:
            points.append(lane.position(along, 0.0))
            along, driven = along + _STEP_M, driven + _STEP_M
        if driven >= _REACH_M:
            break
        along = 0.0
    return roads, np.array(points)


def _lanes(network: RoadNetwork, vehicle: Any) -> Iterator[tuple[str, str, int]]:
    """Its lane and those after it, as far as there is no doubt; `RoadNetwork.next_lane` would draw where there is."""
    start, end, number = vehicle.lane_index
    # Nobody has planned where a vehicle goes that is steered and not told its lanes.
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


_IN_LANE_M, _BESIDE_M, _CROSSING_M = 100.0, 50.0, 80.0  # who is further away than that is not meant
_GENTLY = 1.5  # m/s²; how a dawdler slows down


class HighwayDisturbances:
    """Finds who is meant in one episode, and overrules them.

    Args:
        road: of the episode.
        controlled: the vehicles that are driven from outside, which are never meant.
    """

    def __init__(self, road: Road, controlled: Collection[Any]) -> None:
        self._road = road
        self._controlled = controlled
        self._erring: list[_Errs] = []

    @property
    def anybody(self) -> bool:
        """Whether somebody errs at the moment."""
        return bool(self._erring)

    def before_moving(self, dt: float) -> None:
        """Overrule what erring vehicles have decided, in the sub-step that follows."""
        for errs in self._erring:
            if not errs.vehicle.crashed:
                errs.overrule(dt)

    def after_moving(self) -> None:
        """Undo what the rules of the road have told erring vehicles, before they decide again."""
        for errs in self._erring:
            errs.after()

    def resolve_target(self, agent: Any, disturbance: Disturbance) -> Any | None:
        """Return who is meant; None where nobody is there."""
        if disturbance.what == "ignore_priority":
            return self._crossing(agent, disturbance.who)
        return self.at(agent, disturbance.who)

    def _crossing(self, agent: Any, who: str) -> Any | None:
        """The nearest one at a place as the crow flies, on a way that crosses the agent's."""
        if not isinstance(self._road, RegulatedRoad):
            return None  # where nobody gives way anyway
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
        """Return the vehicle at a place around an agent, along its lane and those beside it; None where nobody is."""
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
            beside = bool(side) and abs(distance) < (agent.LENGTH + other.LENGTH) / 2
            place = "" if beside else "ahead" if distance > 0 else "behind"
            if place == along and abs(distance) <= (_BESIDE_M if side else _IN_LANE_M):
                near.append((abs(distance), other))
        return min(near, key=lambda found: found[0])[1] if near else None

    def disturb(self, vehicle: Any, disturbance: Disturbance, agent: Any) -> ActiveDisturbance | None:
        """Overrule a vehicle until its disturbance ends; None where it cannot do that."""
        strong = disturbance.how_strong
        hardest = min(strong, float(vehicle.ACC_MAX))
        errs: _Errs
        if disturbance.what in ("brake", "stop"):
            errs = _Slows(vehicle, self._let_go, hardest, hardest)
        elif disturbance.what == "dawdle":
            errs = _Slows(vehicle, self._let_go, strong, _GENTLY, target=max(0.0, 1.0 - strong) * float(vehicle.speed))
        elif disturbance.what == "speed":
            errs = _Speeds(vehicle, self._let_go, strong)
        elif disturbance.what == "ignore_priority":
            errs = _Ignores(vehicle, self._let_go, 1.0)
        elif disturbance.what == "late_merge":
            left = self._left_of_lane(vehicle)
            if left is None or vehicle.lane_index != vehicle.target_lane_index:
                return None
            errs = _MergesLate(vehicle, self._let_go, min(strong, left))
        else:
            beside = vehicle.lane_index[:2] == agent.lane_index[:2] and vehicle.lane_index != agent.lane_index
            if not beside or vehicle.lane_index != vehicle.target_lane_index:
                return None  # as it is on another road, in the lane of the agent, or changes lanes already
            errs = _CutsIn(vehicle, self._let_go, hardest, agent.lane_index)
        self._erring.append(errs)
        return errs

    def hold(self, vehicle: Any, what: str) -> ActiveDisturbance | None:
        """Keep a vehicle from something until that ends; None of a thing that drives nowhere."""
        if not isinstance(vehicle, IDMVehicle):
            return None
        kind = {"keep_speed": _KeepsSpeed, "keep_lane": _KeepsLane}.get(what)
        if kind is None:
            self._road.vehicles.remove(vehicle)
            return _Errs(vehicle, lambda _: None, 1.0)
        errs: _Errs = kind(vehicle, self._let_go, 1.0)
        self._erring.append(errs)
        return errs

    def _left_of_lane(self, vehicle: Any) -> float | None:
        """What is left of a lane that ends, in m: lanes are counted from the left, and fewer come after it."""
        _, end, number = vehicle.lane_index
        after = self._road.network.graph.get(end, {})
        if not number or not after or number < min(len(lanes) for lanes in after.values()):
            return None
        return _left(vehicle)

    def _let_go(self, errs: _Errs) -> None:
        self._erring.remove(errs)


class _Errs:
    """A vehicle that errs, until it is let go."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Errs], None], how_strong: float) -> None:
        self.vehicle = vehicle
        self.how_strong = how_strong
        self._let_go = let_go

    def overrule(self, dt: float) -> None:
        """Change what it has decided for a sub-step of so many s."""

    def after(self) -> None:
        """Change what it has been told in a sub-step that is over."""

    def keep(self) -> None:
        """Go on; it is overruled in every sub-step anyway."""

    def end(self) -> None:
        """Let it drive by itself again."""
        self._let_go(self)

    def _brake(self, deceleration: float, dt: float, down_to: float = 0.0) -> None:
        """Brake at least so hard, and down to a speed at most."""
        action, speed = self.vehicle.action, float(self.vehicle.speed)
        wanted = max(-deceleration, min(0.0, (down_to - speed) / dt))
        if speed <= down_to:
            wanted = (down_to - speed) / dt if down_to > 0 else 0.0
        action["acceleration"] = min(float(action["acceleration"]), wanted)


class _Slows(_Errs):
    """Brakes down to a speed, and keeps to it."""

    def __init__(
        self,
        vehicle: Any,
        let_go: Callable[[_Errs], None],
        how_strong: float,
        deceleration: float,
        *,
        target: float = 0.0,
    ) -> None:
        super().__init__(vehicle, let_go, how_strong)
        self._deceleration = deceleration
        self._target = target

    def overrule(self, dt: float) -> None:
        self._brake(self._deceleration, dt, self._target)


class _Speeds(_Errs):
    """Wants to drive faster than before, and keeps its distance as before."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Errs], None], share: float) -> None:
        super().__init__(vehicle, let_go, share)
        self._before = vehicle.target_speed
        vehicle.target_speed = (1.0 + share) * self._before

    def end(self) -> None:
        self.vehicle.target_speed = self._before
        super().end()


class _CutsIn(_Errs):
    """Changes lanes as soon as nobody is in the very place, and may brake in the new one."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Errs], None], deceleration: float, lane: Any) -> None:
        super().__init__(vehicle, let_go, deceleration)
        self._lane = lane
        self._before = vehicle.enable_lane_change
        vehicle.enable_lane_change = False  # its own mind would have it turn back
        self._begin()

    def overrule(self, dt: float) -> None:
        if self.vehicle.target_lane_index != self._lane:
            self._begin()
        if self.how_strong and self.vehicle.lane_index == self._lane:
            self._brake(self.how_strong, dt)

    def _begin(self) -> None:
        _change(self.vehicle, self._lane)

    def end(self) -> None:
        self.vehicle.enable_lane_change = self._before
        super().end()


class _KeepsSpeed(_Errs):
    """Drives on at its speed, whoever is in its way."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Errs], None], how_strong: float) -> None:
        super().__init__(vehicle, let_go, how_strong)
        self._speed = float(vehicle.speed)

    def overrule(self, dt: float) -> None:
        self.vehicle.action["acceleration"] = (self._speed - float(self.vehicle.speed)) / dt


class _KeepsLane(_Errs):
    """Does not leave the lane that it is in."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Errs], None], how_strong: float) -> None:
        super().__init__(vehicle, let_go, how_strong)
        self._before = vehicle.enable_lane_change
        vehicle.enable_lane_change = False
        vehicle.target_lane_index = vehicle.lane_index

    def end(self) -> None:
        self.vehicle.enable_lane_change = self._before
        super().end()


class _MergesLate(_Errs):
    """Stays in a lane that ends until little of it is left, and then changes as soon as nobody is in the very place."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Errs], None], left: float) -> None:
        super().__init__(vehicle, let_go, left)
        start, end, number = self._ending = vehicle.lane_index
        self._lane = (start, end, number - 1)
        self._before = vehicle.enable_lane_change
        vehicle.enable_lane_change = False

    def overrule(self, dt: float) -> None:
        vehicle = self.vehicle
        if vehicle.target_lane_index == self._ending and _left(vehicle) <= self.how_strong:
            _change(vehicle, self._lane)

    def end(self) -> None:
        self.vehicle.enable_lane_change = self._before
        super().end()


class _Ignores(_Errs):
    """Goes on as if it had priority: whenever the rules stop it, it drives on."""

    def __init__(self, vehicle: Any, let_go: Callable[[_Errs], None], how_strong: float) -> None:
        super().__init__(vehicle, let_go, how_strong)
        self.after()

    def after(self) -> None:
        vehicle = self.vehicle
        if getattr(vehicle, "is_yielding", False):  # as `RegulatedRoad` lets it go
            vehicle.target_speed = vehicle.lane.speed_limit
            del vehicle.color
            vehicle.is_yielding = False


def _left(vehicle: Any) -> float:
    """How far it is to the end of its lane, in m."""
    return float(vehicle.lane.length - vehicle.lane.local_coordinates(vehicle.position)[0])


def _change(vehicle: Any, lane: Any) -> None:
    """Have it change lanes, unless somebody is in the very place."""
    for other in vehicle.road.neighbour_vehicles(vehicle, lane):
        room = (vehicle.LENGTH + other.LENGTH) / 2 if other is not None else 0.0
        if other is not None and abs(vehicle.lane_distance_to(other)) <= room:
            return
    vehicle.target_lane_index = lane
