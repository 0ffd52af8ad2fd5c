"""Manoeuvres of UN R157: the paths of other vehicles, computed from the arguments of a scenario.

SUMO simulates the controlled vehicle. All other vehicles are moved exactly along their paths, in steps: first the speed
changes, then the position by the new speed. All vehicles drive along the x axis, on two lanes of one edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from libsumo import _libsumo as sumo

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.sumo._options import MANOEUVRE_ARGUMENTS
from crashhunt.world import Actor, ActorState, Path, Paths

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from crashhunt.trial import Value

_STEPS = 600  # after these steps, the other vehicles drive straight on
_START_M = 300.0  # front of the controlled vehicle along the road
_LENGTH_M, _WIDTH_M = 4.3, 1.9
_LATERAL_RATE_MPS2 = 1.5
_KMH = 3.6
_ROUNDING = 1e-9


@dataclass(slots=True)
class _Mover:
    """A vehicle that moves in steps.

    Args:
        x: position of the front along the road, in m.
        y: position across the road, in m.
        speed: speed along the road, in m/s.
    """

    x: float
    y: float
    speed: float

    def state(self) -> ActorState:
        return ActorState(self.x, self.y, 0.0, self.speed)

    def drive(self, step_s: float, *, lateral: float = 0.0) -> None:
        self.x += self.speed * step_s
        self.y += lateral * step_s


def manoeuvre_paths(manoeuvre: str, agent: str, arguments: Mapping[str, Value], step_s: float) -> Paths:
    """Return the paths of all vehicles of a manoeuvre, with the controlled vehicle at its start.

    Args:
        manoeuvre: ``cut_in``, ``cut_out`` or ``deceleration``.
        agent: identifier of the controlled vehicle.
        arguments: the arguments of the scenario, as in `MANOEUVRE_ARGUMENTS`.
        step_s: step length, in s.

    Raises:
        InvalidEpisodeError: an argument is out of its range.
    """
    values = {name: _number(name, arguments[name]) for name in MANOEUVRE_ARGUMENTS[manoeuvre]}
    lanes = sorted(str(lane) for lane in sumo.lane_getIDList() if not str(lane).startswith(":"))
    if len(lanes) != 2:
        raise InvalidEpisodeError(f"the network has {len(lanes)} lanes, and a manoeuvre needs 2")
    right_to_left = values.get("side", -1.0) < 0
    own, next_lane = (lanes[1], lanes[0]) if right_to_left else (lanes[0], lanes[1])
    own_y, next_y = (float(sumo.lane_getShape(lane)[0][1]) for lane in (own, next_lane))
    speed = values["ego_kmh"] / _KMH
    makers = {"cut_in": _cut_in, "cut_out": _cut_out, "deceleration": _deceleration}
    movers = makers[manoeuvre](values, speed, own_y, next_y, step_s)
    rows = [next(movers) for _ in range(_STEPS + 1)]
    others = tuple(
        Path(
            actor=_car(name),
            first=0,
            states=tuple(row[name] for row in rows),
            lanes=tuple(_lanes(rows, name, {own: own_y, next_lane: next_y})),
        )
        for name in rows[0]
    )
    start = Path(actor=_car(agent), first=0, states=(ActorState(_START_M, own_y, 0.0, speed),), lanes=((0, own),))
    return Paths(time_s=0.0, steps=_STEPS, agents=(start,), others=others)


def _car(name: str) -> Actor:
    return Actor(id=name, kind="passenger", length=_LENGTH_M, width=_WIDTH_M)


def _number(name: str, value: Value) -> float:
    number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    low, high = (-1.0, 1.0) if name == "side" else (0.0, 1000.0)
    if not low <= number <= high:
        raise InvalidEpisodeError(
            f"the argument {name} is {value!r} (allowed: {low:g} to {high:g})", fix="give a value in this range"
        )
    return number


def _lanes(rows: list[dict[str, ActorState]], name: str, lanes: Mapping[str, float]) -> Iterator[tuple[int, str]]:
    last = ""
    for step, row in enumerate(rows):
        lane = min(lanes, key=lambda one: abs(lanes[one] - row[name].y))
        if lane != last:
            yield step, lane
        last = lane


def _cut_in(
    values: Mapping[str, float], speed: float, own_y: float, next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield states of a vehicle that cuts in; `gap_m` is the gap when its lateral speed is full."""
    full, other_speed = values["lateral_mps"], values["other_kmh"] / _KMH
    run_up = math.ceil(full / _LATERAL_RATE_MPS2 / step_s - _ROUNDING)
    ramp = [min(full, _LATERAL_RATE_MPS2 * step_s * (number + 1)) for number in range(run_up)]
    towards = math.copysign(1.0, own_y - next_y)
    gap = values["gap_m"] + (speed - other_speed) * run_up * step_s
    other = _Mover(_START_M + gap + _LENGTH_M, next_y - towards * sum(ramp) * step_s, other_speed)
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
    leader = _Mover(_START_M + values["headway_s"] * speed + _LENGTH_M, own_y, speed)
    standing = _Mover(leader.x + values["front_m"] + _LENGTH_M, own_y, 0.0)
    while True:
        yield {"leader": leader.state(), "standing": standing.state()}
        room = standing.x - _LENGTH_M - leader.x
        if room <= leader.speed * step_s and abs(leader.y - standing.y) < _WIDTH_M and room > -2 * _LENGTH_M:
            leader.speed = 0.0
        lateral = min(values["lateral_mps"], abs(next_y - leader.y) / step_s) if leader.speed > 0 else 0.0
        leader.drive(step_s, lateral=towards * lateral)


def _deceleration(
    values: Mapping[str, float], speed: float, own_y: float, _next_y: float, step_s: float
) -> Iterator[dict[str, ActorState]]:
    """Yield states of a vehicle ahead that brakes until it stands."""
    leader = _Mover(_START_M + values["headway_s"] * speed + _LENGTH_M, own_y, speed)
    while True:
        yield {"leader": leader.state()}
        leader.speed = max(0.0, leader.speed - values["decel_mps2"] * step_s)
        leader.drive(step_s)
