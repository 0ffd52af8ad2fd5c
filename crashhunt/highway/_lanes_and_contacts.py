"""Scenes of highway-env: lane shapes, distances, contacts, excluded and hidden vehicles, and traffic events."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle

from crashhunt.simulators import LanePlace, Standstill
from crashhunt.trial import ALL_AGENTS
from crashhunt.world import STANDS_MPS, Contact, Event, Lane, rectangle_gap

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.objects import RoadObject

    from crashhunt.world import Actor


_LANE_STEP_M = 2.0  # distance between the points of a curved lane


def lanes_of(network: RoadNetwork, named: Callable[[tuple[str, str, int]], str]) -> list[Lane]:
    """Return all lanes of a network; curved lanes have points at most 2 m apart."""
    found = []
    for index, lane in network.lanes_dict().items():
        count = 2 if type(lane).__name__ == "StraightLane" else max(2, math.ceil(lane.length / _LANE_STEP_M) + 1)
        points = [lane.position(lane.length * number / (count - 1), 0.0).tolist() for number in range(count)]
        shape = tuple((float(x), -float(y)) for x, y in points)
        found.append(Lane(named(index), float(lane.width_at(lane.length / 2)), shape))
    return found


_MAX_ROADS = 3  # roads between two vehicles that count as being on one lane


def lane_place(network: RoadNetwork, vehicle: RoadObject, other: RoadObject) -> LanePlace:
    """Return the place of an object on the lanes, relative to the lane of a vehicle."""
    start, end, number = other.lane_index
    front = other.position + other.LENGTH / 2 * np.array([math.cos(other.heading), math.sin(other.heading)])
    _, right = other.lane.local_coordinates(front)
    same = vehicle.lane_index == other.lane_index or any(
        network.is_connected_road(
            one.lane_index, two.lane_index, getattr(one, "route", None), same_lane=True, depth=_MAX_ROADS
        )
        for one, two in ((vehicle, other), (other, vehicle))
        if isinstance(one, Vehicle)  # with continuous actions, a vehicle that has no route
    )
    # highway-env counts lanes from the left, and its lateral coordinate points to the right.
    index = len(network.graph[start][end]) - 1 - (number or 0)
    return LanePlace(same_lane=same, offset=0.0 - float(right), index=index)


def is_at_an_end(vehicle: RoadObject, network: RoadNetwork) -> bool:
    """Return whether a vehicle has driven off the end of a lane that has no following lane."""
    along, lateral = vehicle.lane.local_coordinates(vehicle.position)
    inside = abs(lateral) <= vehicle.lane.width_at(along) / 2
    return inside and along > vehicle.lane.length and vehicle.lane_index[1] not in network.graph


def gap(one: RoadObject, two: RoadObject) -> float:
    """Return the distance between the outlines of two objects, in m."""
    x, y = (two.position - one.position).tolist()
    c, s = math.cos(one.heading), math.sin(one.heading)
    halves = [np.array([[thing.LENGTH / 2, thing.WIDTH / 2]]) for thing in (one, two)]
    turn = np.array([two.heading - one.heading])
    return float(rectangle_gap(np.array([[x * c + y * s, y * c - x * s]]), turn, *halves)[0])


def contact_of(
    agent: str,
    vehicle: RoadObject,
    things: Iterable[RoadObject],
    actor_of: Callable[[RoadObject], Actor],
    lane: str,
) -> Contact:
    """Return the contact between a controlled vehicle that has just crashed and the nearest crashed object."""
    # highway-env does not mark a hit obstacle as crashed, so every obstacle is a candidate.
    others = [other for other in things if other is not vehicle and (other.crashed or isinstance(other, Obstacle))]
    hit = min(others, key=lambda other: gap(vehicle, other), default=None)
    if hit is None:
        return Contact(
            collider=agent,
            victim="",
            kind="crashed",
            lane=lane,
            collider_speed=float(vehicle.speed),
            victim_speed=math.nan,
        )
    first, second = (agent, vehicle), (actor_of(hit).id, hit)
    if not _drives_into(vehicle, hit):
        first, second = second, first
    return Contact(
        collider=first[0],
        victim=second[0],
        kind="crashed",
        lane=lane,
        collider_speed=float(first[1].speed),
        victim_speed=float(second[1].speed),
    )


def _drives_into(vehicle: RoadObject, hit: RoadObject) -> bool:
    """Return whether a vehicle drives into the object that it touches; otherwise the object drives into the vehicle."""
    if isinstance(hit, Obstacle):
        return True
    stands, hit_stands = (abs(float(one.speed)) < STANDS_MPS for one in (vehicle, hit))
    if stands != hit_stands:
        return hit_stands  # an actor that stands drives into nothing
    x, y = (hit.position - vehicle.position).tolist()
    ahead: float = x * math.cos(vehicle.heading) + y * math.sin(vehicle.heading)
    closing = float(vehicle.speed) * ahead > 0
    hit_closing = float(hit.speed) * (x * math.cos(hit.heading) + y * math.sin(hit.heading)) < 0
    if closing != hit_closing:  # one may reverse
        return closing
    return ahead > 0


# Vehicles and obstacles that are excluded from an episode.


class VehicleFilter:
    """Removes excluded vehicles and obstacles from the road after the step in which they enter.

    Objects get their names in the order in which they enter, whether they stay or not. An environment that adds
    vehicles during an episode may add different vehicles when some are missing.
    """

    def __init__(
        self,
        road: Road,
        takes_part: Iterable[str],
        agents: Iterable[str],
        things: Callable[[], Iterable[RoadObject]],
        actor_of: Callable[[RoadObject], Actor],
    ) -> None:
        self._road, self._things, self._actor_of = road, things, actor_of
        self._agents = frozenset(agents)
        self._takes_part = frozenset(takes_part) | self._agents
        self.entered: list[str] = []  # identifiers of all objects that have entered, in order, without the agents
        self._seen: set[str] = set()

    def remove(self) -> bool:
        """Remove the excluded objects that have entered; return whether there were any."""
        gone = set()
        for thing in self._things():
            name = self._actor_of(thing).id
            if name not in self._seen and name not in self._agents:
                self._seen.add(name)
                self.entered.append(name)
            if name not in self._takes_part and ALL_AGENTS not in self._takes_part:
                gone.add(id(thing))
        if gone:
            self._road.vehicles = [thing for thing in self._road.vehicles if id(thing) not in gone]
            self._road.objects = [thing for thing in self._road.objects if id(thing) not in gone]
        return bool(gone)


# The disturbance `unseen` where highway-env itself makes the observation.


class Hidden:
    """Hides a vehicle from one agent: removes it from the road while the agent's observation is made."""

    how_strong = 1.0

    def __init__(self, road: Road, seeing: Any, vehicle: Any) -> None:
        self._road = road
        self._seeing = seeing
        self._vehicle = vehicle
        self._look = seeing.observe
        seeing.observe = self._observe

    def keep(self) -> None:
        """Do nothing, because the vehicle stays hidden until `end`."""

    def end(self) -> None:
        """Show the vehicle again."""
        self._vehicle = None

    def _observe(self) -> Any:
        all_vehicles = self._road.vehicles
        if self._vehicle is None:
            return self._look()
        self._road.vehicles = [vehicle for vehicle in all_vehicles if vehicle is not self._vehicle]
        try:
            return self._look()
        finally:
            self._road.vehicles = all_vehicles


# Traffic events on highway-env: vehicles that stand still, and vehicles that drive against the direction of their lane.


class HighwayEvents:
    """Detects traffic events of the controlled vehicles in one episode."""

    def __init__(self, step_length_s: float, events: Mapping[str, float], *, lanes_are_road: bool) -> None:
        self._standstill = Standstill(step_length_s, events)
        self._lanes_are_road = lanes_are_road
        self._wrong: set[str] = set()

    def look(self, agent: str, vehicle: Vehicle, point: tuple[float, float], lane: str) -> Iterator[Event]:
        """Yield the events of a vehicle in a step; ``point`` is its position in the scene after the step."""
        speed = float(vehicle.speed)
        if stood := self._standstill.look(agent, speed):
            yield Event("not_moving", agent, f"{agent} had stood still for {stood:g} s", (), lane, *point, speed)
        along, _ = vehicle.lane.local_coordinates(vehicle.position)
        turn = float(vehicle.heading) - float(vehicle.lane.heading_at(along))
        # Of two lanes at the same place, highway-env assigns the lane with the heading nearest to the vehicle's.
        if not self._lanes_are_road or abs(speed) < Standstill.SPEED or math.cos(turn) * speed >= -0.5 * abs(speed):
            self._wrong.discard(agent)
        elif agent not in self._wrong:
            self._wrong.add(agent)
            how = "backwards" if speed < 0 else "the wrong way"
            yield Event("wrong_way", agent, f"{agent} drove {how} on lane {lane}", (), lane, *point, speed)
