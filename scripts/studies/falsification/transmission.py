"""The benchmark "automatic transmission" of ARCH-COMP as a Gymnasium environment.

A car with an engine, a torque converter and four gears is driven by throttle and brake. Equations and tables: Hoxha,
Abbas and Fainekos, "Benchmarks for temporal logic requirements for automotive systems", ARCH 2014. Integration: Heun's
method with a fixed step of 0.01 s, as long as the step of the competition's model.

``info`` has the greatest speed (mph) and engine speed (1/min) since the last step. AT5, which compares gears at
distances of 0.001 s, is not included.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

DURATION_S = 30.0
STEP_S = 0.1
_INTEGRATION_S = 0.01
_SHIFT_S = 0.08
_ENGINE_INERTIA, _VEHICLE_INERTIA = 0.0219914882835559, 12.09414785731247
_FINAL_DRIVE, _FRICTION, _DRAG = 3.23, 40.0, 0.02
_MPH = 2 * math.pi * 60 / 5280
_MIN_ENGINE_RPM, _MAX_ENGINE_RPM = 600.0, 6000.0
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

REQUIREMENTS = {
    "AT1": "always[0:20] (speed < 120)",
    "AT2": "always[0:10] (rpm < 4750)",
    "AT6a": "always[0:30] (rpm < 3000) -> always[0:4] (speed < 35)",
    "AT6b": "always[0:30] (rpm < 3000) -> always[0:8] (speed < 50)",
    "AT6c": "always[0:30] (rpm < 3000) -> always[0:20] (speed < 65)",
}


class Transmission(gymnasium.Env[Any, Any]):
    """A car with an automatic transmission; the action is the throttle from 0 to 1 and the brake from 0 to 1."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gymnasium.spaces.Box(0.0, 1.0, (2,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, float]]:
        """Put the car at rest, in the first gear."""
        super().reset(seed=seed)
        self._engine, self._wheel, self._gear = 1000.0, 0.0, 1
        self._direction, self._since_s = 0, 0.0
        return self._observation(), {"speed": 0.0, "rpm": 1000.0}

    def step(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, float]]:
        """Integrate one step with constant throttle and brake."""
        throttle, brake = 100 * float(action[0]), 325 * float(action[1])
        speed = rpm = -math.inf
        for _ in range(round(STEP_S / _INTEGRATION_S)):
            self._shift(throttle)
            self._integrate(throttle, brake)
            speed, rpm = max(speed, self._wheel * _MPH), max(rpm, self._engine)
        return self._observation(), 0.0, False, False, {"speed": speed, "rpm": rpm}

    def _observation(self) -> NDArray[np.float64]:
        return np.array([self._wheel * _MPH, self._engine, self._gear])

    def _shift(self, throttle: float) -> None:
        """Change the gear after the speed was beyond a threshold for some time."""
        speed, gear = self._wheel * _MPH, self._gear
        if gear < 4 and speed > _at(_UP_THROTTLES, _UP[gear - 1], throttle):
            wanted = 1
        elif gear > 1 and speed < _at(_DOWN_THROTTLES, _DOWN[gear - 2], throttle):
            wanted = -1
        else:
            wanted = 0
        self._since_s = self._since_s + _INTEGRATION_S if wanted and wanted == self._direction else 0.0
        self._direction = wanted
        if wanted and self._since_s >= _SHIFT_S - 1e-9:
            self._gear += wanted
            self._direction, self._since_s = 0, 0.0

    def _integrate(self, throttle: float, brake: float) -> None:
        engine, wheel, dt = self._engine, self._wheel, _INTEGRATION_S
        first = self._slopes(engine, wheel, throttle, brake)
        second = self._slopes(engine + dt * first[0], wheel + dt * first[1], throttle, brake)
        engine += dt / 2 * (first[0] + second[0])
        self._engine = min(_MAX_ENGINE_RPM, max(_MIN_ENGINE_RPM, engine))
        self._wheel = wheel + dt / 2 * (first[1] + second[1])

    def _slopes(self, engine: float, wheel: float, throttle: float, brake: float) -> tuple[float, float]:
        """Return the derivatives of the engine's speed and of the wheel's speed."""
        ratio = _RATIOS[self._gear - 1]
        speed_ratio = _FINAL_DRIVE * ratio * wheel / engine
        impeller = (engine / _at(_SPEED_RATIOS, _K_FACTORS, speed_ratio)) ** 2
        output = impeller * _at(_SPEED_RATIOS, _TORQUE_RATIOS, speed_ratio) * ratio
        row = min(len(_THROTTLES) - 2, max(0, bisect_right(_THROTTLES, throttle) - 1))
        below, above = (_at(_ENGINE_RPM, _TORQUE[number], engine) for number in (row, row + 1))
        share = (throttle - _THROTTLES[row]) / (_THROTTLES[row + 1] - _THROTTLES[row])
        torque = below + share * (above - below)
        speed = wheel * _MPH
        sign = (speed > 0) - (speed < 0)
        load = sign * (brake + _FRICTION + _DRAG * speed * speed)
        return (torque - impeller) / _ENGINE_INERTIA, (_FINAL_DRIVE * output - load) / _VEHICLE_INERTIA


def _at(places: Sequence[float], values: Sequence[float], place: float) -> float:
    """Return a value between those of a table, or beyond its ends, by a straight line."""
    number = min(len(places) - 2, max(0, bisect_right(places, place) - 1))
    share = (place - places[number]) / (places[number + 1] - places[number])
    return values[number] + share * (values[number + 1] - values[number])
