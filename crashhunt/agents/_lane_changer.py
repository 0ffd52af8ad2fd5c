"""A lane changer that does not see what drives beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from crashhunt.agents._car_following import X, Y, find_leader, idm_acceleration
from crashhunt.space import Argument, Range

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["LaneChanger"]

LANE_WIDTH_M = 3.2


class LaneChanger:
    """Overtakes slower traffic, and looks over its shoulder everywhere but in a blind spot.

    Args:
        blind_spot_m: the length beside and behind it that it does not see when it changes lanes, in m.
        patience_s: how long it follows before it overtakes, in s.
        desired_speed: in m/s.
        step_length_s: of the simulation, in s.
    """

    def __init__(
        self,
        blind_spot_m: Annotated[
            float, Argument("blind_spot_m", distribution=Range(0.0, 10.0), unit="m", help="length it does not see")
        ] = 2.0,
        patience_s: Annotated[
            float, Argument("patience_s", distribution=Range(1.0, 10.0), unit="s", help="follows so long first")
        ] = 3.0,
        desired_speed: Annotated[
            float, Argument("desired_speed", distribution=Range(15.0, 30.0), unit="m/s", help="on a free road")
        ] = 22.0,
        step_length_s: Annotated[float, Argument("step_length_s", unit="s", help="of the simulation")] = 0.1,
    ) -> None:
        self.blind_spot_m = blind_spot_m
        self.patience_s = patience_s
        self.desired_speed = desired_speed
        self.step_length_s = step_length_s
        self._waited_s = 0.0

    def reset(self, seed: int) -> None:
        """Be patient again."""
        self._waited_s = 0.0

    def act(self, observation: NDArray[np.float32]) -> tuple[float, int]:
        """Return (target speed, lane change)."""
        speed = float(observation[0, 3])
        leader = find_leader(observation)
        acceleration = idm_acceleration(speed, leader, desired_speed=self.desired_speed, headway_s=1.2)
        target = max(0.0, speed + max(-8.0, min(2.5, acceleration)) * self.step_length_s)
        blocked = leader is not None and leader.gap < 2.5 * max(speed, 5.0) and speed < 0.9 * self.desired_speed
        self._waited_s = self._waited_s + self.step_length_s if blocked else 0.0
        if self._waited_s < self.patience_s:
            return target, 0
        # Lane 0 of the layout is the leftmost: y of the own row is the distance from its centre.
        has_left = float(observation[0, 2]) > LANE_WIDTH_M / 2
        for change, side, possible in ((1, -LANE_WIDTH_M, has_left), (-1, LANE_WIDTH_M, not has_left)):
            if possible and self._is_clear(observation, side):
                self._waited_s = 0.0
                return target, change
        return target, 0

    def _is_clear(self, observation: NDArray[np.float32], side: float) -> bool:
        for row in observation[1:].tolist():
            if row[0] > 0.5 and abs(row[Y] - side) < 1.6 and -15.0 < row[X] < 15.0:
                if -4.0 - self.blind_spot_m < row[X] < -4.0 + self.blind_spot_m:
                    continue  # not seen
                return False
        return True
