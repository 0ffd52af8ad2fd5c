"""Distance and time that the controlled vehicles drive, computed from the recorded scenes.

For each agent, the module computes the integral of its speed over the steps in which the agent is in the scene
(trapezoidal rule), and the number of these steps. Warm-up steps are not recorded, so they do not count.

Invariant: the sums depend on the scenes only, not on how the scenes are grouped into frames. Therefore the compiled
core, which records many steps at once, gives bit-identical sums. The reason is that `numpy.cumsum` adds in order.
`numpy.sum` adds in pairs, and its rounding depends on the grouping.

Reason for speeds instead of positions: a lane change or a teleport moves a vehicle within one step. The trapezoidal
rule is exact if the acceleration is constant within a step. SUMO's Euler integration uses the speed at the end of the
step. The two distances differ by at most half a step at the difference between first and last speed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.world._scene import Frame


_ROUNDING_DIGITS = 3  # mm and ms


class DrivenMeter:
    """Measures the distance and the time that agents drive, many scenes at a time."""

    def __init__(self, agents: Sequence[str], step_length_s: float) -> None:
        self.step_length_s = self._dt = step_length_s
        self._last: dict[str, float | None] = dict.fromkeys(agents)  # speed in the last scene; None where it was absent
        self._speeds, self._steps, self._seen = 0.0, 0, False

    def add(self, frames: Sequence[Frame]) -> None:
        """Add scenes, in order; scene 0 is the scene before the first step."""
        for agent in self._last:
            run: list[NDArray[np.float64]] = []
            for frame in frames:
                row = frame.roster.index.get(agent)
                if row is None:
                    self._add_run(agent, run)
                    run, self._last[agent] = [], None
                else:
                    run.append(frame.columns[:, 3 * len(frame.roster) + row])
            self._add_run(agent, run)

    def _add_run(self, agent: str, run: list[NDArray[np.float64]]) -> None:
        """Add successive scenes in which an agent is present."""
        if not run:
            return
        self._seen = True
        last = self._last[agent]
        speeds = np.abs(np.concatenate(run if last is None else [np.array([last]), *run]))
        means = (speeds[1:] + speeds[:-1]) / 2
        self._speeds = float(np.cumsum(np.concatenate(([self._speeds], means)))[-1])
        self._steps += len(means)
        self._last[agent] = float(speeds[-1])

    @property
    def driven_m(self) -> float | None:
        """The distance driven by all agents together, in m; None if no scene has an agent, or if a speed is unknown."""
        meters = self._speeds * self._dt
        return round(meters, _ROUNDING_DIGITS) if self._seen and math.isfinite(meters) else None

    @property
    def driven_s(self) -> float | None:
        """The time driven by all agents together, in s of simulation time; None if no scene has an agent."""
        return round(self._steps * self._dt, _ROUNDING_DIGITS) if self._seen else None
