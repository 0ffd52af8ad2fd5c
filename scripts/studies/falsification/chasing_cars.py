"""The benchmark "chasing cars" of ARCH-COMP as a Gymnasium environment, and the agent that drives it by signals.

The first of five cars accelerates by throttle and brake; each other car chases the car before it in one of three modes.
Equations: Hu, Lygeros and Sastry, "Towards a theory of stochastic hybrid systems", HSCC 2000, as in the model of the
competition. The cars drive towards negative positions. A follower that keeps its speed moves away from its leader.

A step of the environment has many steps of the integration. A follower may change its mode more often than the
environment returns, so ``info`` has the least and the greatest value of each gap since the last step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

try:
    from numba import njit as _njit
except ImportError:  # the same code in Python takes 100 times as long
    NUMBA = False

    def njit(function: Any) -> Any:
        """Return the function as it is."""
        return function
else:
    NUMBA = True
    njit = _njit(cache=True)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.trial import InputSignal

DURATION_S = 100.0
STEP_S = 0.1
INTEGRATION_S = 0.0025
_KEEPING, _CHASING, _BRAKING = 0, 1, 2
_CHASE_ABOVE_M, _BRAKE_BELOW_M, _KEEP_BELOW_M, _CHASE_AGAIN_ABOVE_M = 15.0, 5.0, 10.0, 20.0

REQUIREMENTS = {
    "CC1": "always[0:100] (gap_54_max <= 40)",
    "CC2": "always[0:70] eventually[0:30] (gap_54_max >= 15)",
    "CC3": "always[0:80] (always[0:20] (gap_21_max <= 20) or eventually[0:20] (gap_54_max >= 40))",
    "CC4": "always[0:65] eventually[0:30] always[0:5] (gap_54_min >= 8)",
    "CC5": "always[0:72] eventually[0:8] (always[0:5] (gap_21_min >= 9) -> always[5:20] (gap_54_min >= 9))",
    "CCx": " and ".join(f"always[0:50] (gap_{rear}{rear - 1}_min > 7.5)" for rear in range(2, 6)),
}
"""The requirements, with the value of each gap between two samples that is worst, or that decides ``eventually``."""

SIGNALS = tuple(f"gap_{car + 1}{car}_{which}" for which in ("min", "max") for car in range(1, 5))


@njit
def _advance(positions, speeds, modes, inputs, dt, count, gaps):  # type: ignore[no-untyped-def]
    """Integrate some steps by the explicit method of Euler, and write the least and the greatest gaps into `gaps`."""
    throttle, brake = inputs
    for number in range(4):
        gaps[number], gaps[4 + number] = np.inf, -np.inf
    for _ in range(count):
        positions[0] += dt * speeds[0]
        speeds[0] += dt * (-throttle - brake * speeds[0])
        for car in range(1, 5):
            gap, speed, mode = positions[car] - positions[car - 1], speeds[car], modes[car]
            if mode == _KEEPING:
                if gap >= _CHASE_ABOVE_M:
                    mode = _CHASING
                elif gap <= _BRAKE_BELOW_M:
                    mode = _BRAKING
            elif mode == _CHASING:
                if gap <= _KEEP_BELOW_M:
                    mode = _KEEPING
            elif gap >= _CHASE_AGAIN_ABOVE_M:
                mode = _CHASING
            modes[car] = mode
            if mode == _KEEPING:
                positions[car] += dt * speed
            else:
                positions[car] -= dt * speed
                speeds[car] = speed + (dt if mode == _CHASING else -dt * speed)
            gap = positions[car] - positions[car - 1]
            gaps[car - 1] = min(gaps[car - 1], gap)
            gaps[3 + car] = max(gaps[3 + car], gap)


@njit
def _simulate(throttle, brake, dt, count, gaps):  # type: ignore[no-untyped-def]
    """Integrate a whole trial; each row of `gaps` is a sample."""
    positions, speeds, modes = np.arange(5) * 10.0, np.zeros(5), np.zeros(5, np.int64)
    gaps[0] = 10.0
    for step in range(len(throttle)):
        _advance(positions, speeds, modes, (throttle[step], brake[step]), dt, count, gaps[step + 1])


def simulate(
    throttle: NDArray[np.float64], brake: NDArray[np.float64], integration_s: float = INTEGRATION_S
) -> dict[str, NDArray[np.float64]]:
    """Return the trace of a trial with the given inputs in each step, as the environment produces it."""
    gaps = np.empty((len(throttle) + 1, 8))
    _simulate(throttle, brake, integration_s, round(STEP_S / integration_s), gaps)
    return dict(zip(SIGNALS, gaps.T.copy(), strict=True))


class ChasingCars(gymnasium.Env[Any, Any]):
    """Five cars in a row.

    Args:
        integration_s: step of the integration (explicit Euler), in s.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float64)
    action_space = gymnasium.spaces.Box(0.0, 1.0, (2,), np.float64)

    def __init__(self, integration_s: float = INTEGRATION_S) -> None:
        self._dt, self._count = integration_s, round(STEP_S / integration_s)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, float]]:
        """Put the cars 10 m apart, at rest."""
        super().reset(seed=seed)
        self._positions, self._speeds = _numbers([0.0, 10.0, 20.0, 30.0, 40.0]), _numbers([0.0] * 5)
        self._modes = np.zeros(5, np.int64) if NUMBA else [_KEEPING] * 5
        return np.array(self._positions), dict.fromkeys(SIGNALS, 10.0)

    def step(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, float]]:
        """Integrate one step with constant throttle and brake."""
        inputs, gaps = (float(action[0]), float(action[1])), _numbers([0.0] * 8)
        _advance(self._positions, self._speeds, self._modes, inputs, self._dt, self._count, gaps)
        return np.array(self._positions), 0.0, False, False, dict(zip(SIGNALS, map(float, gaps), strict=True))


def _numbers(values: list[float]) -> Sequence[float] | NDArray[np.float64]:
    """Return numbers in the form that is fastest: lists in Python, arrays with Numba."""
    return np.array(values) if NUMBA else values


class SignalDriver:
    """Drives by signals over time.

    Args:
        throttle: the throttle, from 0 to 1.
        brake: the brake, from 0 to 1.
        step_length_s: length of a step, in s.
    """

    def __init__(self, throttle: InputSignal, brake: InputSignal, step_length_s: float) -> None:
        self._signals, self._step_s = (throttle, brake), step_length_s

    def reset(self, seed: int) -> None:
        """Begin at time 0."""
        self._steps = 0

    def act(self, observation: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return throttle and brake at this time."""
        time_s = self._steps * self._step_s
        self._steps += 1
        return np.array([signal(time_s) for signal in self._signals])
