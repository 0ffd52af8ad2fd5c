"""A lane changer that does not see what drives beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from crashhunt.agents._car_following import (
    CAR_LENGTH_M,
    COS_H,
    VX,
    PathCurvature,
    X,
    Y,
    actors,
    check_layout,
    find_leader,
    idm_acceleration,
    off_path,
)
from crashhunt.agents._forms import meta_actions, wanted_meta_action
from crashhunt.trial import Argument, Range

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from gymnasium import Space
    from numpy.typing import NDArray

__all__ = ["LaneChanger"]

LANE_WIDTH_M = 3.2  # SUMO's default; an observation has no lanes to count
LEFT, RIGHT = 1, -1  # as in the action
MIN_GAP_M = 5.0  # a truck's half is up to 2.5 m longer than a car's
REACTION_S = 1.0  # of whoever is behind in the other lane, before it brakes
BRAKE = 4.0  # m/s², what it expects of whoever has to brake after a lane change


class LaneChanger:
    """Overtakes slower traffic on either side, and looks over its shoulder everywhere but in a blind spot.

    Without a blind spot it changes lanes only into a gap in which nobody has to brake hard. It knows of a lane to its
    left from the layout of the observation, and of one to its right from having been there or seen somebody there.

    Args:
        blind_spot_m: how far back from its own centre a vehicle in the next lane goes unnoticed, in m.
        patience_s: how long it follows before it overtakes, in s.
        desired_speed: in m/s.
        step_length_s: of the simulation, in s.
        observation_space: of the vehicle.
        action_space: of the vehicle; (target speed, lane change), or discrete meta-actions.

    Raises:
        ValueError: an argument makes no sense, or the observation has other columns than the default ones.
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
        step_length_s: float = 0.1,
        observation_space: Space[object] | None = None,
        action_space: Space[object] | None = None,
    ) -> None:
        if not step_length_s > 0:
            raise ValueError(f"step_length_s must be above 0, not {step_length_s}")
        check_layout(observation_space)
        self._meta = meta_actions(action_space)
        self.blind_spot_m = blind_spot_m
        self.patience_s = patience_s
        self.desired_speed = desired_speed
        self.step_length_s = step_length_s
        self._path = PathCurvature(step_length_s)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Be patient again."""
        self._path.reset()
        self._waited_s = 0.0
        self._from_left = 0.0
        self._rightmost = 0.0

    def act(self, observation: NDArray[np.float32]) -> tuple[float, int] | int:
        """Return (target speed, lane change), or the meta-action for it."""
        curvature = self._path.update(observation)
        self._look_for_lanes(observation, curvature)
        speed = float(observation[0, VX])
        leader = find_leader(observation, curvature=curvature)
        acceleration = idm_acceleration(speed, leader, desired_speed=self.desired_speed, headway_s=1.2)
        target = max(0.0, speed + max(-8.0, min(2.5, acceleration)) * self.step_length_s)
        blocked = leader is not None and leader.gap < 2.5 * max(speed, 5.0) and speed < 0.9 * self.desired_speed
        self._waited_s = self._waited_s + self.step_length_s if blocked else 0.0
        change = self._choose(observation, curvature) if self._waited_s >= self.patience_s else 0
        if change:
            self._waited_s = 0.0
            self._from_left -= change * LANE_WIDTH_M
        if self._meta is not None:
            return self._meta[wanted_meta_action(acceleration, change)]
        return target, change

    def _choose(self, observation: NDArray[np.float32], curvature: float) -> int:
        for change, exists in (
            (LEFT, self._from_left > LANE_WIDTH_M / 2),
            (RIGHT, self._rightmost - self._from_left > LANE_WIDTH_M / 2),
        ):
            if exists and self._is_clear(observation, -change * LANE_WIDTH_M, curvature):
                return change
        return 0

    def _look_for_lanes(self, observation: NDArray[np.float32], curvature: float) -> None:
        """Keep track of the lanes: where it is, and how far right somebody has been seen going its way."""
        from_left = float(observation[0, Y])
        if abs(from_left - self._from_left) > LANE_WIDTH_M / 2:
            self._rightmost = 0.0  # it has not moved, so the road has: another number of lanes
        self._from_left = from_left
        self._rightmost = max(self._rightmost, from_left)
        for row in actors(observation):
            if (
                row[COS_H] > 0.9
                and abs(row[X]) < 20.0
                and off_path(row, lateral=LANE_WIDTH_M, curvature=curvature) < 0.5
            ):
                self._rightmost = max(self._rightmost, from_left + LANE_WIDTH_M)

    def _is_clear(self, observation: NDArray[np.float32], side: float, curvature: float) -> bool:
        return not any(
            off_path(row, lateral=side, curvature=curvature) < LANE_WIDTH_M / 2
            and not -self.blind_spot_m < row[X] <= 0
            and _is_too_close(row)
            for row in actors(observation)
        )


def _is_too_close(row: Sequence[float]) -> bool:
    """Whether the hindmost of the two would have to brake harder than it is expected to."""
    closing = max(0.0, -row[VX] if row[X] > 0 else row[VX])
    gap = abs(row[X]) - CAR_LENGTH_M
    return gap < MIN_GAP_M + closing * REACTION_S + closing * closing / (2 * BRAKE)
