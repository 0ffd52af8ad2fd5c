"""A car-following agent with a reaction delay, and the part of it that lane changers share."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Annotated

from crashhunt.space import Argument, Range

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["CarFollowing", "Leader", "find_leader", "idm_acceleration"]

CAR_LENGTH_M = 5.0
# Row layout of the observation: presence, x, y, vx, vy, cos_h, sin_h; x ahead and y to the right of the vehicle.
X, Y, VX = 1, 2, 3


class Leader:
    """The nearest vehicle ahead in a lane.

    Args:
        gap: bumper to bumper, if both are cars, in m.
        closing_speed: positive when the gap shrinks, in m/s.
    """

    __slots__ = ("closing_speed", "gap")

    def __init__(self, gap: float, closing_speed: float) -> None:
        self.gap = gap
        self.closing_speed = closing_speed


def find_leader(
    observation: NDArray[np.float32], *, lateral: float = 0.0, curvature: float = 0.0, half_width: float = 1.7
) -> Leader | None:
    """Return the nearest vehicle ahead whose centre is within ``half_width`` of a path.

    Args:
        observation: in the default layout.
        lateral: how far to the right of the vehicle the path runs, in m.
        curvature: of the path, positive to the right, in 1/m; a radar's constant-curvature path prediction.
        half_width: in m.
    """
    best: Leader | None = None
    for row in observation[1:].tolist():
        if row[0] < 0.5:
            break  # present rows come first
        ahead = row[X]
        if ahead > 0 and abs(row[Y] - lateral - curvature * ahead * ahead / 2) < half_width:
            gap = ahead - CAR_LENGTH_M
            if best is None or gap < best.gap:
                best = Leader(gap, -row[VX])
    return best


def idm_acceleration(
    speed: float, leader: Leader | None, *, desired_speed: float, headway_s: float, standstill_gap: float = 3.0
) -> float:
    """Return the acceleration of the Intelligent Driver Model, in m/s².

    Source: Treiber, Hennecke, Helbing: Congested traffic states in empirical observations and microscopic
    simulations, Physical Review E 62 (2000), 1805, with 2 m/s² of acceleration and comfortable deceleration.
    """
    free = 1 - (speed / max(desired_speed, 0.1)) ** 4
    if leader is None:
        return 2.0 * free
    dynamic = speed * headway_s + speed * leader.closing_speed / (2 * math.sqrt(2.0 * 2.0))
    wanted = standstill_gap + max(0.0, dynamic)
    return 2.0 * (free - (wanted / max(leader.gap, 0.1)) ** 2)


class CarFollowing:
    """Follows the vehicle in front by the Intelligent Driver Model, on what it saw a moment ago.

    It is safe for most of its arguments. A long delay together with a short headway and weak brakes is not.

    Args:
        delay_s: how old the observation is that it acts on, in s.
        headway_s: the time gap that it keeps, in s.
        max_brake: the hardest that it brakes, in m/s².
        desired_speed: with a free road, in m/s.
        step_length_s: of the simulation, in s; turns the delay into steps.
    """

    def __init__(
        self,
        delay_s: Annotated[
            float, Argument("delay_s", distribution=Range(0.0, 1.2), unit="s", help="acts on observations this old")
        ] = 0.3,
        headway_s: Annotated[
            float, Argument("headway_s", distribution=Range(0.6, 2.5), unit="s", help="time gap that it keeps")
        ] = 1.5,
        max_brake: Annotated[
            float, Argument("max_brake", distribution=Range(3.0, 8.0), unit="m/s²", help="hardest braking")
        ] = 6.0,
        desired_speed: Annotated[float, Argument("desired_speed", unit="m/s", help="on a free road")] = 25.0,
        step_length_s: Annotated[float, Argument("step_length_s", unit="s", help="of the simulation")] = 0.1,
    ) -> None:
        if step_length_s <= 0:
            raise ValueError(f"step_length_s must be above 0, not {step_length_s}")
        self.headway_s = headway_s
        self.max_brake = max_brake
        self.desired_speed = desired_speed
        self.step_length_s = step_length_s
        self._seen: deque[NDArray[np.float32]] = deque(maxlen=round(delay_s / step_length_s) + 1)
        self._heading: float | None = None
        self._curvature = 0.0

    def reset(self, seed: int) -> None:
        """Forget what was seen."""
        self._seen.clear()
        self._heading = None
        self._curvature = 0.0

    def act(self, observation: NDArray[np.float32]) -> tuple[float, int]:
        """Return (target speed, 0)."""
        self._seen.append(observation)
        seen = self._seen[0]
        leader = find_leader(seen, curvature=self.path_curvature(seen))
        own_speed = float(observation[0, VX])
        wanted = idm_acceleration(
            float(seen[0, VX]), leader, desired_speed=self.desired_speed, headway_s=self.headway_s
        )
        acceleration = max(-self.max_brake, min(2.0, wanted))
        return max(0.0, own_speed + acceleration * self.step_length_s), 0

    def path_curvature(self, observation: NDArray[np.float32]) -> float:
        """Return the smoothed curvature of the own path, positive to the right, in 1/m."""
        speed = float(observation[0, VX])
        heading = math.atan2(float(observation[0, 6]), float(observation[0, 5]))
        if self._heading is not None and speed > 1.0:
            turned = math.remainder(heading - self._heading, math.tau)
            self._curvature += 0.3 * (turned / (speed * self.step_length_s) - self._curvature)
        self._heading = heading
        return self._curvature
