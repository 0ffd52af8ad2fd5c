"""The Intelligent Driver Model with MOBIL lane changes: the baseline against which others are compared."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from crashhunt.agents._car_following import CAR_LENGTH_M, VX, Leader, X, actors, find_leader, idm_acceleration, off_path
from crashhunt.agents._forms import wanted_meta_action
from crashhunt.agents._lane_changer import LANE_WIDTH_M, LaneChanger
from crashhunt.trial import Argument, Range

if TYPE_CHECKING:
    import numpy as np
    from gymnasium import Space
    from numpy.typing import NDArray

__all__ = ["IntelligentDriver"]

_SAFE_BRAKING = 2.0  # m/s², the hardest that MOBIL imposes on whoever is behind in the new lane


class IntelligentDriver(LaneChanger):
    """Follows by the Intelligent Driver Model and changes lanes by MOBIL, as the traffic of highway-env does.

    Source: Kesting, Treiber, Helbing: General lane-changing model MOBIL for car-following models, Transportation
    Research Record 1999 (2007), 86, equations 2 and 4 (symmetric rules).

    Args:
        desired_speed: in m/s.
        headway_s: time gap, in s.
        politeness: how much the others' acceleration counts, against the own.
        gain: the least advantage for which it changes lanes, in m/s².
        patience_s: the time from one decision about lanes to the next, in s.
        step_length_s: of the simulation, in s.
        observation_space: of the vehicle.
        action_space: of the vehicle.

    Raises:
        ValueError: an argument makes no sense, or the observation has other columns than the default ones.
    """

    def __init__(
        self,
        desired_speed: Annotated[
            float, Argument("desired_speed", distribution=Range(20.0, 30.0), unit="m/s", help="on a free road")
        ] = 28.0,
        headway_s: Annotated[
            float, Argument("headway_s", distribution=Range(0.2, 1.5), unit="s", help="time gap that it keeps")
        ] = 1.5,
        politeness: Annotated[
            float, Argument("politeness", distribution=Range(0.0, 1.0), help="how much others count")
        ] = 0.0,
        gain: Annotated[float, Argument("gain", unit="m/s²", help="worth a lane change")] = 0.2,
        patience_s: Annotated[float, Argument("patience_s", unit="s", help="between two decisions")] = 1.0,
        step_length_s: float = 0.1,
        observation_space: Space[object] | None = None,
        action_space: Space[object] | None = None,
    ) -> None:
        super().__init__(
            blind_spot_m=0.0,
            patience_s=patience_s,
            desired_speed=desired_speed,
            step_length_s=step_length_s,
            observation_space=observation_space,
            action_space=action_space,
        )
        self.headway_s = headway_s
        self.politeness = politeness
        self.gain = gain

    def act(self, observation: NDArray[np.float32]) -> tuple[float, int] | int:
        """Return (target speed, lane change), or the meta-action for it."""
        curvature = self._path.update(observation)
        self._look_for_lanes(observation, curvature)
        speed = float(observation[0, VX])
        own = self._accelerate(speed, find_leader(observation, curvature=curvature))
        self._waited_s += self.step_length_s
        change = 0
        if self._waited_s >= self.patience_s and speed > 1.0:
            self._waited_s = 0.0
            change = self._best(observation, curvature, speed, own)
            self._from_left -= change * LANE_WIDTH_M
        acceleration = max(-8.0, min(2.5, own))
        if self._meta is not None:
            return self._meta[wanted_meta_action(acceleration, change)]
        return max(0.0, speed + acceleration * self.step_length_s), change

    def _accelerate(self, speed: float, leader: Leader | None) -> float:
        return idm_acceleration(speed, leader, desired_speed=self.desired_speed, headway_s=self.headway_s)

    def _best(self, observation: NDArray[np.float32], curvature: float, speed: float, own: float) -> int:
        best, change = self.gain, 0
        lanes = ((1, self._from_left > LANE_WIDTH_M / 2), (-1, self._rightmost - self._from_left > LANE_WIDTH_M / 2))
        for side, exists in lanes:
            if not exists:
                continue
            lateral = -side * LANE_WIDTH_M
            leader = find_leader(observation, lateral=lateral, curvature=curvature)
            after = self._accelerate(speed, leader)
            loss = 0.0
            behind = _follower(observation, lateral, curvature)
            if behind is not None:
                gap, its_speed = behind[0], speed + behind[1]
                braking = self._accelerate(its_speed, Leader(gap, behind[1]))
                if braking < -_SAFE_BRAKING:
                    continue
                before = None
                if leader is not None:
                    before = Leader(gap + CAR_LENGTH_M + leader.gap, behind[1] + leader.closing_speed)
                loss = self._accelerate(its_speed, before) - braking
            if leader is not None and (leader.gap < 0 or after < -_SAFE_BRAKING):
                continue
            advantage = after - own - self.politeness * loss
            if advantage > best:
                best, change = advantage, side
        return change


def _follower(observation: NDArray[np.float32], lateral: float, curvature: float) -> tuple[float, float] | None:
    """The gap to the nearest actor behind on a path, in m, and how much faster it is, in m/s."""
    half = LANE_WIDTH_M / 2
    behind = [
        row for row in actors(observation) if row[X] <= 0 and off_path(row, lateral=lateral, curvature=curvature) < half
    ]
    nearest = max(behind, key=lambda row: row[X], default=None)
    return None if nearest is None else (-nearest[X] - CAR_LENGTH_M, nearest[VX])
