"""Traffic events of highway-env: who stands, and who drives against its lane."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from crashhunt.simulators._standstill import Standstill
from crashhunt.world import Event

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from highway_env.vehicle.kinematics import Vehicle

__all__ = ["HighwayEvents"]


class HighwayEvents:
    """What is told of the controlled vehicles of one episode.

    Args:
        step_length_s: of a step.
        events: `Scenario.events`, which says after how long somebody stands.
        lanes_are_road: whether lanes are there to be driven along; where they are bays, no way is the wrong one.
    """

    def __init__(self, step_length_s: float, events: Mapping[str, float], *, lanes_are_road: bool) -> None:
        self._standstill = Standstill(step_length_s, events)
        self._lanes_are_road = lanes_are_road
        self._wrong: set[str] = set()

    def look(self, agent: str, vehicle: Vehicle, point: tuple[float, float], lane: str) -> Iterator[Event]:
        """Tell what has happened to a vehicle in a step, after which it is at a point of a scene."""
        speed = float(vehicle.speed)
        if stood := self._standstill.look(agent, speed):
            yield Event("not_moving", agent, f"{agent} had stood still for {stood:g} s", (), lane, *point, speed)
        along, _ = vehicle.lane.local_coordinates(vehicle.position)
        turn = float(vehicle.heading) - float(vehicle.lane.heading_at(along))
        # Of lanes above each other, highway-env takes the one that runs as the vehicle does.
        if not self._lanes_are_road or abs(speed) < Standstill.SPEED or math.cos(turn) * speed >= -0.5 * abs(speed):
            self._wrong.discard(agent)
        elif agent not in self._wrong:
            self._wrong.add(agent)
            how = "backwards" if speed < 0 else "the wrong way"
            yield Event("wrong_way", agent, f"{agent} drove {how} on lane {lane}", (), lane, *point, speed)
