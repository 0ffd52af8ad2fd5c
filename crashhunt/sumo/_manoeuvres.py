"""Manoeuvres of UN R157: the paths of other vehicles, computed from the arguments of a scenario.

SUMO simulates the controlled vehicle. All other road users are moved exactly along their paths. All vehicles drive
along the x axis, on two lanes of one edge.
"""

from __future__ import annotations

import math
from itertools import chain
from typing import TYPE_CHECKING, cast

from libsumo import _libsumo as sumo

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.sumo._options import arguments_of
from crashhunt.trial import InputSignal, fold_signals
from crashhunt.world import START_M, ActorState, Path, Paths, actor_of_manoeuvre, manoeuvre_motions

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from crashhunt.trial import Value

_STEPS = 600  # after these steps, the other vehicles drive straight on
_KMH = 3.6
_SIGNED = {"side": 1.0, "from_side": 1.0, "offset_m": 10.0, "impact_m": 10.0, "beside_m": 100.0}
_ABOVE_ZERO = {"period_s": 0.1}


def manoeuvre_paths(manoeuvre: str, agent: str, arguments: Mapping[str, Value], step_s: float) -> Paths:
    """Return the paths of all vehicles of a manoeuvre, with the controlled vehicle at its start.

    Args:
        manoeuvre: as in the table of the scenario.
        agent: identifier of the controlled vehicle.
        arguments: the arguments of the scenario, as in `arguments_of`.
        step_s: step length, in s.

    Raises:
        InvalidEpisodeError: an argument is out of its range.
    """
    names = arguments_of(manoeuvre, arguments)
    folded = fold_signals(arguments)
    values = {name: _checked(name, folded[name]) for name in names}
    ego_kmh = cast("float", values["ego_kmh"])
    slower_kmh = values.get("slower_kmh", 0.0)
    if manoeuvre == "cut_in" and not callable(slower_kmh) and slower_kmh > ego_kmh:
        raise InvalidEpisodeError(
            f"slower_kmh is {slower_kmh:g} (allowed: 0 to ego_kmh, {ego_kmh:g})",
            fix="give a smaller value",
        )
    lanes = sorted(str(lane) for lane in sumo.lane_getIDList() if not str(lane).startswith(":"))
    if len(lanes) != 2:
        raise InvalidEpisodeError(f"the network has {len(lanes)} lanes, and a manoeuvre needs 2")
    right_to_left = cast("float", values.get("side", -1.0)) < 0
    own, next_lane = (lanes[1], lanes[0]) if right_to_left else (lanes[0], lanes[1])
    own_y, next_y = (float(sumo.lane_getShape(lane)[0][1]) for lane in (own, next_lane))
    speed = ego_kmh / _KMH
    states = manoeuvre_motions(manoeuvre, values, own_y, next_y, step_s)
    rows = [next(states) for _ in range(_STEPS + 1)]
    others = tuple(_path(name, rows, {own: own_y, next_lane: next_y}) for name in dict.fromkeys(chain(*rows)))
    start = Path(
        actor=actor_of_manoeuvre(agent), first=0, states=(ActorState(START_M, own_y, 0.0, speed),), lanes=((0, own),)
    )
    return Paths(time_s=0.0, steps=_STEPS, agents=(start,), others=others)


def _checked(name: str, value: object) -> float | InputSignal:
    if not isinstance(value, InputSignal):
        return _number(name, value)
    for point in value.points:
        _number(name, point)
    return value


def _number(name: str, value: object) -> float:
    number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    low, high = (-_SIGNED[name], _SIGNED[name]) if name in _SIGNED else (_ABOVE_ZERO.get(name, 0.0), 1000.0)
    if not low <= number <= high:
        raise InvalidEpisodeError(
            f"the argument {name} is {value!r} (allowed: {low:g} to {high:g})", fix="give a value in this range"
        )
    return number


def _path(name: str, rows: list[dict[str, ActorState]], lanes: Mapping[str, float]) -> Path:
    first = next(step for step, row in enumerate(rows) if name in row)
    states = tuple(row[name] for row in rows[first:])
    return Path(actor=actor_of_manoeuvre(name), first=first, states=states, lanes=tuple(_lanes(first, states, lanes)))


def _lanes(first: int, states: tuple[ActorState, ...], lanes: Mapping[str, float]) -> Iterator[tuple[int, str]]:
    last = ""
    for step, state in enumerate(states, first):
        lane = min(lanes, key=lambda one: abs(lanes[one] - state.y))
        if lane != last:
            yield step, lane
        last = lane
