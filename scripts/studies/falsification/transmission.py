"""The benchmark "automatic transmission" of ARCH-COMP as a Gymnasium environment.

A car with an engine, a torque converter and four gears is driven by throttle and brake. Equations and tables: Hoxha,
Abbas and Fainekos, "Benchmarks for temporal logic requirements for automotive systems", ARCH 2014. Integration: Heun's
method with a fixed step of 0.01 s, as long as the step of the competition's model.

``info`` has speed (mph), engine speed (1/min) and gear after each step, which is a step of the integration. AT5 begins
its windows at 0.01 s in place of 0.001 s: the gear is constant within a step.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from chasing_cars import NUMBA, njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

DURATION_S = 30.0
STEP_S = 0.01
_SHIFT_S = 0.08
_ENGINE_INERTIA, _VEHICLE_INERTIA = 0.0219914882835559, 12.09414785731247
_FINAL_DRIVE, _FRICTION, _DRAG = 3.23, 40.0, 0.02
_MPH = 2 * math.pi * 60 / 5280
_MIN_ENGINE_RPM, _MAX_ENGINE_RPM = 600.0, 6000.0
_MAX_THROTTLE, _MAX_BRAKE = 100.0, 325.0
_RATIOS = (2.393, 1.450, 1.000, 0.677)

_THROTTLES = (0, 20, 30, 40, 50, 60, 70, 80, 90, 100)
_ENGINE_RPM = tuple(range(800, 4801, 400))
_TORQUE = (
    (-40, -44, -49, -53, -57, -61, -65, -70, -74, -78, -82),
    (215, 117, 85, 66, 44, 29, 10, -2, -13, -22, -32),
    (245, 208, 178, 148, 122, 104, 85, 66, 48, 33, 18),
    (264, 260, 241, 219, 193, 167, 152, 133, 119, 96, 85),
    (264, 279, 282, 275, 260, 238, 223, 208, 189, 171, 152),
    (267, 290, 293, 297, 290, 275, 260, 256, 234, 212, 193),
    (267, 297, 305, 305, 305, 301, 293, 282, 267, 249, 226),
    (267, 301, 308, 312, 319, 323, 319, 316, 297, 279, 253),
    (267, 301, 312, 319, 327, 327, 327, 327, 312, 293, 267),
    (267, 301, 312, 319, 327, 334, 334, 334, 319, 305, 275),
)
_SPEED_RATIOS = (
    *(number / 10 for number in range(9)), *(number / 100 for number in range(81, 91)), 0.92, 0.94,
)  # fmt: skip
_K_FACTORS = (
    137.4652089938063, 137.06501915685197, 135.86444964598905, 135.66435472751189, 137.56525645304487,
    140.36658531172509, 145.26891081441539, 152.87251771654735, 162.97731109964374, 164.2779280697452,
    166.17882979527823, 167.97968406157264, 170.08068070558275, 172.78196210502438, 175.38319604522741,
    179.58518933324765, 183.58708770279083, 189.89007763482121, 197.69377945543027, 215.90241703685155,
    244.51599037908485,
)  # fmt: skip
_TORQUE_RATIOS = (
    2.232, 2.075, 1.975, 1.846, 1.72, 1.564, 1.409, 1.254, 1.096, 1.08, 1.061, 1.043, 1.028, 1.012, 1.002, 1.002, 1.001,
    0.998, 0.999, 1.001, 1.002,
)  # fmt: skip
_UP_THROTTLES, _DOWN_THROTTLES = (0, 25, 35, 50, 90, 100), (0, 5, 40, 50, 90, 100)
_UP = ((10, 10, 15, 23, 40, 40), (30, 30, 30, 41, 70, 70), (50, 50, 50, 60, 100, 100))
_DOWN = ((5, 5, 5, 5, 30, 30), (20, 20, 25, 30, 50, 50), (35, 35, 40, 50, 80, 80))

_TABLES = tuple(
    np.array(table, float) if NUMBA else table
    for table in (
        _RATIOS, _THROTTLES, _ENGINE_RPM, _TORQUE, _SPEED_RATIOS, _K_FACTORS, _TORQUE_RATIOS, _UP_THROTTLES, _UP,
        _DOWN_THROTTLES, _DOWN,
    )
)  # fmt: skip

_AT6 = {"a": (4, 35), "b": (8, 50), "c": (20, 65)}
REQUIREMENTS = {
    "AT1": "always[0:20] (speed < 120)",
    "AT2": "always[0:10] (rpm < 4750)",
    **{
        f"AT5{gear}": f"always ((gear != {gear} and eventually[0.01:0.1] (gear == {gear})) -> "
        f"eventually[0.01:0.1] always[0:2.5] (gear == {gear}))"
        for gear in range(1, 5)
    },
    **{
        f"AT6{name}": f"always[0:30] (rpm < 3000) -> always[0:{end_s}] (speed < {limit})"
        for name, (end_s, limit) in _AT6.items()
    },
}
REQUIREMENTS["AT6abc"] = " and ".join(f"({REQUIREMENTS[f'AT6{name}']})" for name in _AT6)

SIGNALS = ("speed", "rpm", "gear")


@njit
def _at(places, values, place):  # type: ignore[no-untyped-def]
    """Return a value between those of a table, or beyond its ends, by a straight line."""
    number = 0
    while number < len(places) - 2 and places[number + 1] <= place:
        number += 1
    share = (place - places[number]) / (places[number + 1] - places[number])
    return values[number] + share * (values[number + 1] - values[number])


@njit
def _slopes(engine, wheel, gear, throttle, brake, tables):  # type: ignore[no-untyped-def]
    """Return the derivatives of the engine's speed and of the wheel's speed."""
    ratios, throttles, engine_rpm, torques, speed_ratios, k_factors, torque_ratios = tables[:7]
    ratio = ratios[gear - 1]
    speed_ratio = _FINAL_DRIVE * ratio * wheel / engine
    impeller = (engine / _at(speed_ratios, k_factors, speed_ratio)) ** 2
    output = impeller * _at(speed_ratios, torque_ratios, speed_ratio) * ratio
    row = 0
    while row < len(throttles) - 2 and throttles[row + 1] <= throttle:
        row += 1
    below, above = _at(engine_rpm, torques[row], engine), _at(engine_rpm, torques[row + 1], engine)
    share = (throttle - throttles[row]) / (throttles[row + 1] - throttles[row])
    torque = below + share * (above - below)
    speed = wheel * _MPH
    sign = (1.0 if speed > 0 else 0.0) - (1.0 if speed < 0 else 0.0)
    load = sign * (brake + _FRICTION + _DRAG * speed * speed)
    return (torque - impeller) / _ENGINE_INERTIA, (_FINAL_DRIVE * output - load) / _VEHICLE_INERTIA


@njit
def _advance(state, throttle, brake, tables):  # type: ignore[no-untyped-def]
    """Shift, and integrate one step: the state is engine, wheel, gear, direction of a pending shift and its time."""
    engine, wheel, gear, direction, since_s = state[0], state[1], int(state[2]), state[3], state[4]
    up_throttles, up, down_throttles, down = tables[7:]
    speed, wanted, dt = wheel * _MPH, 0.0, STEP_S
    if gear < 4 and speed > _at(up_throttles, up[gear - 1], throttle):
        wanted = 1.0
    elif gear > 1 and speed < _at(down_throttles, down[gear - 2], throttle):
        wanted = -1.0
    since_s = since_s + dt if wanted != 0 and wanted == direction else 0.0
    direction = wanted
    if wanted != 0 and since_s >= _SHIFT_S - 1e-9:
        gear += int(wanted)
        direction, since_s = 0.0, 0.0
    first = _slopes(engine, wheel, gear, throttle, brake, tables)
    second = _slopes(engine + dt * first[0], wheel + dt * first[1], gear, throttle, brake, tables)
    engine += dt / 2 * (first[0] + second[0])
    state[0] = min(_MAX_ENGINE_RPM, max(_MIN_ENGINE_RPM, engine))
    state[1] = wheel + dt / 2 * (first[1] + second[1])
    state[2], state[3], state[4] = float(gear), direction, since_s


@njit
def _simulate(throttle, brake, tables, found):  # type: ignore[no-untyped-def]
    """Integrate a whole trial; each row of `found` is a sample."""
    state = np.array([1000.0, 0.0, 1.0, 0.0, 0.0])
    found[0] = np.array([0.0, 1000.0, 1.0])
    for step in range(len(throttle)):
        _advance(state, throttle[step], brake[step], tables)
        found[step + 1, 0], found[step + 1, 1], found[step + 1, 2] = state[1] * _MPH, state[0], state[2]


def simulate(throttle: NDArray[np.float64], brake: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the trace of a trial with the given inputs in each step, as the environment produces it."""
    found = np.empty((len(throttle) + 1, 3))
    _simulate(_MAX_THROTTLE * throttle, _MAX_BRAKE * brake, _TABLES, found)
    return dict(zip(SIGNALS, found.T.copy(), strict=True))


class Transmission(gymnasium.Env[Any, Any]):
    """A car with an automatic transmission; the action is the throttle from 0 to 1 and the brake from 0 to 1."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gymnasium.spaces.Box(0.0, 1.0, (2,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, float]]:
        """Put the car at rest, in the first gear."""
        super().reset(seed=seed)
        state = [1000.0, 0.0, 1.0, 0.0, 0.0]
        self._state = np.array(state) if NUMBA else state
        return self._seen()

    def step(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, float]]:
        """Integrate one step with constant throttle and brake."""
        _advance(self._state, _MAX_THROTTLE * float(action[0]), _MAX_BRAKE * float(action[1]), _TABLES)
        observation, info = self._seen()
        return observation, 0.0, False, False, info

    def _seen(self) -> tuple[NDArray[np.float64], dict[str, float]]:
        values = [float(self._state[1]) * _MPH, float(self._state[0]), float(self._state[2])]
        return np.array(values), dict(zip(SIGNALS, values, strict=True))
