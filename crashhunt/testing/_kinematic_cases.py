"""The three kinds of cases of UN R157, for many cases at a time; the own vehicles move as a simulator says.

The steps are those of the published comparison of the driver models: 0.1 s; first the speed, then the position with the
new speed; contact is examined before the step. Both vehicles are 4.3 m long and 1.9 m wide, and lanes are 3.5 m wide.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING, Protocol

import numpy as np

from crashhunt.agents import GRAVITY_MPS2, REFERENCE_MODELS, Situation

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from contextlib import AbstractContextManager

    from numpy.typing import NDArray

    Values = NDArray[np.float64]
    Flags = NDArray[np.bool_]
    Columns = Mapping[str, Values]

STEP_S = 0.1
LENGTH_M, WIDTH_M, LANE_WIDTH_M = 4.3, 1.9, 3.5
LATERAL_ACCELERATION_MPS2 = 1.5
WANDERING_M = 0.375
"""Distance from the middle of its lane from which on a vehicle leaves the lane. Source: R157, table 1."""
_STEPS = 350
_TIE = 1e-9
_KMH = 3.6
# A contact of the vehicle ahead with the standing vehicle is one from this distance on.
_FRONT_CONTACT_M = 0.5
# In cut-outs, R157 has the careful human react when the standing vehicle becomes visible, at any distance.
_REACTS_AT_ONCE = {"cc_human": {"early_s": 1000.0}}
_SIDE_GAP_M = LANE_WIDTH_M - WIDTH_M  # between vehicles in the middles of neighbouring lanes
# Middle of the own lane in the frame of the road; positions are sums of steps, and decide exact ties by their rounding.
_OWN_LANE_M = 2 * LANE_WIDTH_M


class Vehicles(Protocol):
    """The own vehicles of all cases, which drive with commanded accelerations."""

    speeds: Values

    def drive(self, accelerations: Values) -> Values:
        """Simulate one step with accelerations in m/s²; return the way that each vehicle has driven in it, in m."""


class KinematicVehicles:
    """Vehicles whose speed changes by the acceleration; the position changes by the new speed."""

    def __init__(self, speeds: Values) -> None:
        self.speeds = speeds

    def drive(self, accelerations: Values) -> Values:
        """Move all vehicles for one step; return their ways in m."""
        self.speeds = np.maximum(self.speeds + accelerations * STEP_S, 0.0)
        moved: Values = self.speeds * STEP_S
        return moved


def run_up_steps(lateral_speed: Values) -> NDArray[np.int_]:
    """Return the number of steps in which a lateral speed grows from 0, at 1.5 m/s²."""
    tenths = np.round(lateral_speed * 10)
    # Speeds of a grid are multiples of 0.1 in floating point, such as 0.6000000000000001, which needs one step more.
    speed = np.where(np.abs(lateral_speed * 10 - tenths) < _TIE, tenths * 0.1, lateral_speed)
    return np.ceil(speed / LATERAL_ACCELERATION_MPS2 / STEP_S).astype(int)


def solve_cut_in(cases: Columns, model: str, vehicles: Vehicles) -> dict[str, Values]:
    """Return 0 (no collision), 1 (own front beyond the other front at contact) or 2 for each case of a cut-in.

    Args:
        cases: ``ego_kmh``, ``other_kmh``, ``gap_m`` (at the moment at which the lateral speed is full), and
            ``lateral_mps``.
        model: name of the model that drives.
        vehicles: the own vehicles, with their first speeds.
    """
    speed, other_speed = vehicles.speeds, cases["other_kmh"] / _KMH
    full, count = cases["lateral_mps"], len(cases["gap_m"])
    driver = REFERENCE_MODELS[model](count, STEP_S)
    run_up = run_up_steps(full)
    gap = cases["gap_m"] + (speed - other_speed) * run_up * STEP_S
    moved, lateral = np.zeros(count), np.zeros(count)
    for step in range(int(run_up.max(initial=0))):
        lateral = np.minimum(full, lateral + LATERAL_ACCELERATION_MPS2 * STEP_S)
        moved = moved + np.where(step < run_up, lateral, 0.0) * STEP_S
    y = _OWN_LANE_M - WIDTH_M / 2 - _SIDE_GAP_M - WIDTH_M / 2 - moved
    lateral, answer = np.zeros(count), np.zeros(count)
    seen = np.ones(count, bool)
    for _ in range(_STEPS + int(run_up.max(initial=0))):
        side = np.abs(y - _OWN_LANE_M) - WIDTH_M
        touches = (side < 0) & (gap <= 0) & (gap > -2 * LENGTH_M) & (answer == 0)
        answer[touches] = np.where(gap[touches] > -LENGTH_M, 2, 1)
        acceleration = driver.brake(_situation(speed, other_speed, gap, side, lateral, seen))
        lateral = np.where(y < _OWN_LANE_M, np.minimum(full, lateral + LATERAL_ACCELERATION_MPS2 * STEP_S), 0.0)
        moved, speed = vehicles.drive(acceleration), vehicles.speeds
        gap = gap - (moved - other_speed * STEP_S)
        y = y + lateral * STEP_S
        if np.all(
            (full == 0)
            | (answer > 0)
            | driver.dismissed
            | (gap <= -2 * LENGTH_M)
            | ((side < 0) & (speed <= other_speed))
        ):
            break
    return {model: np.where(driver.dismissed, 0.0, answer)}


def solve_cut_out(cases: Columns, model: str, vehicles: Vehicles) -> dict[str, Values]:
    """Return for each case of a cut-out whether the own vehicle and the vehicle ahead hit the standing vehicle.

    The driver sees the standing vehicle when the vehicle ahead is 0.375 m off the middle of its lane, or has hit it and
    stands. The run ends when the own vehicle stands.

    Args:
        cases: ``ego_kmh``, ``front_m`` (from the vehicle ahead to the standing vehicle), and ``lateral_mps``.
        model: name of the model that drives.
        vehicles: the own vehicles, with their first speeds.
    """
    speed, lateral = vehicles.speeds, np.abs(cases["lateral_mps"])
    count = len(speed)
    driver = REFERENCE_MODELS[model](count, STEP_S, **_REACTS_AT_ONCE.get(model, {}))
    following = driver.following_distance(speed)
    gap, front, front_speed = following, cases["front_m"], speed
    distance = gap + LENGTH_M + front  # to the obstacle: the standing vehicle, or the vehicle ahead that has hit it
    y, zero = np.zeros(count), np.zeros(count)
    answer, front_answer, ended = np.zeros(count), np.zeros(count, bool), np.zeros(count, bool)
    for _ in range(_STEPS):
        hits = (front <= _FRONT_CONTACT_M) & (front > -2 * LENGTH_M) & (y < WIDTH_M - _TIE) & ~ended & ~front_answer
        front_answer |= hits
        front_speed = np.where(front_answer, 0.0, front_speed)
        distance = np.where(hits, np.minimum(distance, gap), distance)
        answer[(distance <= 0) & ~ended] = 1
        ended |= (speed <= 0) | (answer > 0)
        if np.all(ended):
            break
        visible = (y >= WANDERING_M - _TIE) | front_answer
        situation = _situation(speed, zero, distance, zero - WIDTH_M, zero, visible)
        moved, speed = vehicles.drive(driver.brake(situation)), vehicles.speeds
        distance = distance - moved
        gap = gap - (moved - front_speed * STEP_S)
        front = front - front_speed * STEP_S
        y = y + lateral * STEP_S
    return {model: answer, f"front_{model}": front_answer.astype(float), f"gap_{model}": following}


def solve_car_following(cases: Columns, model: str, vehicles: Vehicles) -> dict[str, Values]:
    """Return for each case of a braking leader whether the own vehicle hits it, and with which speed difference.

    Args:
        cases: ``ego_kmh`` and ``decel_g``, the deceleration of the vehicle ahead in units of 9.81 m/s².
        model: name of the model that drives.
        vehicles: the own vehicles, with their first speeds.
    """
    speed = vehicles.speeds
    leader, count = speed, len(speed)
    driver = REFERENCE_MODELS[model](count, STEP_S)
    following = gap = driver.following_distance(speed)
    answer, difference, zero = np.zeros(count), np.zeros(count), np.zeros(count)
    seen = np.ones(count, bool)
    for _ in range(_STEPS):
        hits = (gap <= 0) & (answer == 0)
        answer[hits], difference[hits] = 1, (speed - leader)[hits]
        acceleration = driver.brake(_situation(speed, leader, gap, zero - WIDTH_M, zero, seen))
        leader = np.maximum(leader - cases["decel_g"] * GRAVITY_MPS2 * STEP_S, 0.0)
        moved, speed = vehicles.drive(acceleration), vehicles.speeds
        gap = gap - (moved - leader * STEP_S)
    return {model: answer, f"gap_{model}": following, f"dv_{model}": difference}


def _situation(
    speed: Values, other_speed: Values, gap: Values, lateral_gap: Values, lateral_speed: Values, visible: Flags
) -> Situation:
    """Return what the drivers see of the other vehicles, which have the same length as their own."""
    length = np.full(len(speed), LENGTH_M)
    return Situation(
        speed=speed, other_speed=other_speed, gap=gap, lateral_gap=lateral_gap, lateral_speed=lateral_speed,
        length=length, other_length=length, visible=visible,
    )  # fmt: skip


_SOLVERS: Mapping[str, Callable[[Columns, str, Vehicles], dict[str, Values]]] = {
    "cut_in": solve_cut_in,
    "cut_out": solve_cut_out,
    "car_following": solve_car_following,
}


def solve(
    kind: str, cases: Columns, model: str, make: Callable[[Values], AbstractContextManager[Vehicles]] | None = None
) -> dict[str, Values]:
    """Return the answers of a model to cases of a kind, by the names of their columns."""
    speeds = cases["ego_kmh"] / _KMH
    with nullcontext(KinematicVehicles(speeds)) if make is None else make(speeds) as vehicles:
        return _SOLVERS[kind](cases, model, vehicles)
