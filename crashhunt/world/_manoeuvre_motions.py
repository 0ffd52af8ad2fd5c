"""Motions of the other vehicles in the manoeuvres of UN R157, without a simulator.

All vehicles move along the x axis, in steps: first the speed changes, then the position by the new speed. The own lane
and the next lane are given by their middles. The controlled vehicle begins with its front at `START_M`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import cast

from crashhunt.world._scene import PERSON, Actor
from crashhunt.world._tracks import ActorState

START_M = 300.0
"""Front of the controlled vehicle along the road at the beginning, in m."""

LENGTH_M, WIDTH_M = 4.3, 1.9
"""Size of a car, in m. Source: the published comparison of the driver models."""

_LATERAL_RATE_MPS2 = 1.5
_MAX_ACCELERATION_MPS2 = 10.0  # of a speed profile that may jump
_KMH = 3.6
_ROUNDING = 1e-9

Given = float | Callable[[float], float]
"""An argument of a manoeuvre: a number, or a function of the time in s."""
_OUTSIDE_M = 3.5  # from the middle of the outer lane to a person next to the road

_SHAPES = {"walker": ("pedestrian", 0.5, 0.5), "motorcycle": ("motorcycle", 2.2, 0.9)}


def actor_of_manoeuvre(name: str) -> Actor:
    """Return a road user of a manoeuvre; every name that is no pedestrian or motorcycle is a car."""
    kind, length, width = _SHAPES.get(name.removeprefix(PERSON), ("passenger", LENGTH_M, WIDTH_M))
    return Actor(id=name, kind=kind, length=length, width=width)


@dataclass(slots=True)
class _Mover:
    """A vehicle that moves in steps."""

    x: float  # position of the front along the road, in m
    y: float  # position across the road, in m
    speed: float  # speed along the road, in m/s

    def state(self) -> ActorState:
        return ActorState(self.x, self.y, 0.0, self.speed)

    def drive(self, step_s: float, *, lateral: float = 0.0) -> None:
        self.x += self.speed * step_s
        self.y += lateral * step_s


def _at(value: Given, time_s: float) -> float:
    """Return an argument at a time in s: the argument itself, unless it is a function of the time."""
    return value(time_s) if callable(value) else value


def manoeuvre_motions(
    manoeuvre: str, values: Mapping[str, Given], own_y: float, next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield the states of the other road users after each step, without end; a road user may appear later.

    The arguments ``decel_mps2``, ``walk_kmh`` and, for ``following``, ``slower_kmh`` may be functions of the time in s.
    The lanes are given by their middle, in m.
    """
    constant = cast("Mapping[str, float]", values)
    return _MOTIONS[manoeuvre](constant, constant["ego_kmh"] / _KMH, own_y, next_y, step_s)


def _cut_in(
    values: Mapping[str, float], speed: float, own_y: float, next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield states of a vehicle that cuts in; `gap_m` is the gap when its lateral speed is full.

    The vehicle has an absolute speed, or is slower by a difference.
    """
    full = values["lateral_mps"]
    other_speed = values["other_kmh"] / _KMH if "other_kmh" in values else speed - values["slower_kmh"] / _KMH
    run_up = math.ceil(full / _LATERAL_RATE_MPS2 / step_s - _ROUNDING)
    ramp = [min(full, _LATERAL_RATE_MPS2 * step_s * (number + 1)) for number in range(run_up)]
    towards = math.copysign(1.0, own_y - next_y)
    gap = values["gap_m"] + (speed - other_speed) * run_up * step_s
    other = _Mover(START_M + gap + LENGTH_M, next_y - towards * sum(ramp) * step_s, other_speed)
    lateral = 0.0
    while True:
        yield {"other": other.state()}
        lateral = min(full, lateral + _LATERAL_RATE_MPS2 * step_s)
        left = (own_y - other.y) * towards
        other.drive(step_s, lateral=towards * min(lateral, max(0.0, left / step_s)))


def _cut_out(
    values: Mapping[str, float], speed: float, own_y: float, next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield states of a vehicle that leaves the lane, and of the standing vehicle before it.

    If the vehicle ahead cannot pass the standing vehicle, it stops behind it at once.
    """
    towards = math.copysign(1.0, next_y - own_y)
    leader = _Mover(START_M + values["headway_s"] * speed + LENGTH_M, own_y, speed)
    standing = _Mover(leader.x + values["front_m"] + LENGTH_M, own_y, 0.0)
    while True:
        yield {"leader": leader.state(), "standing": standing.state()}
        room = standing.x - LENGTH_M - leader.x
        if room <= leader.speed * step_s and abs(leader.y - standing.y) < WIDTH_M and room > -2 * LENGTH_M:
            leader.speed = 0.0
        lateral = min(values["lateral_mps"], abs(next_y - leader.y) / step_s) if leader.speed > 0 else 0.0
        leader.drive(step_s, lateral=towards * lateral)


def _deceleration(
    values: Mapping[str, float], speed: float, own_y: float, _next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield states of a vehicle ahead that brakes until it stands."""
    leader = _Mover(START_M + values["headway_s"] * speed + LENGTH_M, own_y, speed)
    step = 0
    while True:
        yield {"leader": leader.state()}
        leader.speed = max(0.0, leader.speed - _at(values["decel_mps2"], step * step_s) * step_s)
        leader.drive(step_s)
        step += 1


def _lane_keeping(
    values: Mapping[str, float], speed: float, own_y: float, next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield states of a vehicle ahead that swerves in its lane, and of a vehicle in the next lane."""
    leader = _Mover(START_M + values["headway_s"] * speed + LENGTH_M, own_y, speed)
    neighbor = _Mover(START_M + values["beside_m"], next_y, speed)
    step = 0
    while True:
        leader.y = own_y + values["swerve_m"] * math.sin(math.tau * step * step_s / values["period_s"])
        yield {"leader": leader.state(), "beside": neighbor.state()}
        step += 1
        leader.drive(step_s)
        neighbor.drive(step_s)


def _following(
    values: Mapping[str, float], speed: float, own_y: float, _next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield states of a vehicle ahead with a distance to the middle of its lane, whose speed varies.

    The speed oscillates, or is slower than at the beginning by a function of the time, as fast as vehicles can follow.
    """
    leader = _Mover(START_M + values["headway_s"] * speed + LENGTH_M, own_y + values["offset_m"], speed)
    step = 0
    while True:
        yield {"leader": leader.state()}
        step += 1
        slower: Given = values["slower_kmh"]
        wave = 1.0 if callable(slower) else (1 - math.cos(math.tau * step * step_s / values["period_s"])) / 2
        wanted = max(0.0, speed - _at(slower, step * step_s) / _KMH * wave)
        if callable(slower):  # which may jump
            most = _MAX_ACCELERATION_MPS2 * step_s
            wanted = min(max(wanted, leader.speed - most), leader.speed + most)
        leader.speed = wanted
        leader.drive(step_s)


def _blocked_lane(
    values: Mapping[str, float], _speed: float, own_y: float, _next_y: float, _step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield the state of a standing vehicle, with a distance to the middle of the lane."""
    standing = _Mover(START_M + values["distance_m"] + LENGTH_M, own_y + values["offset_m"], 0.0)
    while True:
        yield {"standing": standing.state()}


def _multiple_targets(
    values: Mapping[str, float], _speed: float, own_y: float, _next_y: float, _step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield the states of a standing motorcycle, and of a standing car after it."""
    motorcycle = actor_of_manoeuvre("motorcycle")
    first = _Mover(START_M + values["distance_m"] + motorcycle.length, own_y + values["offset_m"], 0.0)
    second = _Mover(first.x + values["between_m"] + LENGTH_M, own_y, 0.0)
    while True:
        yield {"motorcycle": first.state(), "standing": second.state()}


def _pedestrian(
    values: Mapping[str, float], speed: float, own_y: float, next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield states of a person who crosses the road and is at `impact_m` when a constant speed arrives.

    The person begins outside the road, and walks until it has left the road on the other side.
    """
    side, walk_kmh = math.copysign(1.0, values["from_side"]), values["walk_kmh"]
    walk = _at(walk_kmh, 0.0) / _KMH
    right, left = min(own_y, next_y) - _OUTSIDE_M, max(own_y, next_y) + _OUTSIDE_M
    begin = left if side > 0 else right
    # The person stands outside the road until the walk has to begin, and after it.
    y = own_y + side * (values["impact_m"] + walk * values["distance_m"] / speed) if speed > 0 else begin
    if callable(walk_kmh) and speed > 0:
        arrival = math.ceil(values["distance_m"] / speed / step_s - _ROUNDING)
        walked = sum(walk_kmh(number * step_s) for number in range(arrival)) / _KMH * step_s
        y = own_y + side * (values["impact_m"] + walked)
    step = 0
    x, heading = START_M + values["distance_m"], -side * math.pi / 2
    while True:
        place = min(max(y, right), left)
        yield {f"{PERSON}walker": ActorState(x, place, heading, walk if place == y else 0.0)}
        walk = _at(walk_kmh, step * step_s) / _KMH
        y -= side * walk * step_s
        step += 1


def _detection_range(
    values: Mapping[str, float], speed: float, own_y: float, _next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield the state of a standing motorcycle that appears when a constant speed has come as near as `seen_m`."""
    motorcycle = actor_of_manoeuvre("motorcycle")
    standing = _Mover(START_M + values["distance_m"] + motorcycle.length, own_y + values["offset_m"], 0.0)
    step = 0
    while True:
        appears = values["distance_m"] - speed * step * step_s <= values["seen_m"] + _ROUNDING
        yield {"motorcycle": standing.state()} if appears else {}
        step += 1


_MOTIONS: Mapping[str, Callable[[Mapping[str, float], float, float, float, float], Iterator[dict[str, ActorState]]]] = {
    "cut_in": _cut_in,
    "cut_out": _cut_out,
    "deceleration": _deceleration,
    "lane_keeping": _lane_keeping,
    "following": _following,
    "blocked_lane": _blocked_lane,
    "multiple_targets": _multiple_targets,
    "pedestrian": _pedestrian,
    "detection_range": _detection_range,
}
