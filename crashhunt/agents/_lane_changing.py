"""A lane changer with a blind spot, and a lane changer with MOBIL."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from crashhunt.agents._car_following import (
    CAR_LENGTH_M,
    COS_H,
    VX,
    Leader,
    SpeedAgent,
    X,
    Y,
    actors,
    find_leader,
    idm_acceleration,
    off_path,
)
from crashhunt.trial import Argument, Range

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy as np
    from gymnasium import Space
    from numpy.typing import NDArray


LANE_WIDTH_M = 3.2  # SUMO's default; an observation has no lanes to count
LEFT, RIGHT = 1, -1  # as in the action
MIN_GAP_M = 5.0  # a truck's half is up to 2.5 m longer than a car's
REACTION_S = 1.0  # of the follower in the target lane, before it brakes
BRAKE = 4.0  # m/s²: deceleration that it accepts for the follower in the target lane


class LaneChanger(SpeedAgent):
    """Overtakes slower traffic on either side, and observes the next lane except for a blind spot.

    Without a blind spot, the agent changes lanes only into a gap in which no vehicle has to brake hard. The agent
    detects a lane to its left by the layout of the observation. It detects a lane to its right only after a vehicle has
    been there.

    Args:
        blind_spot_m: length of the blind spot in the neighbouring lane, backwards from the agent's centre, in m.
        patience_s: time that the agent follows a slower vehicle before it overtakes, in s.
        desired_speed: desired speed in m/s.
        step_length_s: step length of the simulation, in s.
        observation_space: observation space of the vehicle.
        action_space: action space of the vehicle; (target speed, lane change), or discrete meta-actions.

    Raises:
        ValueError: an argument is out of range, or the observation does not have the default columns.
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
        super().__init__(step_length_s, observation_space, action_space)
        self.blind_spot_m = blind_spot_m
        self.patience_s = patience_s
        self.desired_speed = desired_speed
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin a new waiting time."""
        self._path.reset()
        self._waited_s = 0.0
        self._from_left = 0.0
        self._rightmost = 0.0

    def act(self, observation: NDArray[np.float32]) -> tuple[float, int] | int:
        """Return (target speed, lane change), or the corresponding meta-action."""
        curvature = self._path.update(observation)
        self._update_lanes(observation, curvature)
        speed = float(observation[0, VX])
        leader = find_leader(observation, curvature=curvature)
        acceleration = idm_acceleration(speed, leader, desired_speed=self.desired_speed, headway_s=1.2)
        blocked = leader is not None and leader.gap < 2.5 * max(speed, 5.0) and speed < 0.9 * self.desired_speed
        self._waited_s = self._waited_s + self.step_length_s if blocked else 0.0
        change = self._choose(observation, curvature) if self._waited_s >= self.patience_s else 0
        if change:
            self._waited_s = 0.0
            self._from_left -= change * LANE_WIDTH_M
        return self._action(speed, max(-8.0, min(2.5, acceleration)), change)

    def _choose(self, observation: NDArray[np.float32], curvature: float) -> int:
        for change in self._changes():
            if self._is_clear(observation, -change * LANE_WIDTH_M, curvature):
                return change
        return 0

    def _changes(self) -> Iterator[int]:
        """Yield the lane changes for which there is a lane, the left one first."""
        if self._from_left > LANE_WIDTH_M / 2:
            yield LEFT
        if self._rightmost - self._from_left > LANE_WIDTH_M / 2:
            yield RIGHT

    def _update_lanes(self, observation: NDArray[np.float32], curvature: float) -> None:
        """Update the agent's lane, and the rightmost lane in which a vehicle in its direction was seen."""
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
    """Return whether the rear one of the agent and an actor would have to brake harder than expected of it."""
    closing = max(0.0, -row[VX] if row[X] > 0 else row[VX])
    gap = abs(row[X]) - CAR_LENGTH_M
    return gap < MIN_GAP_M + closing * REACTION_S + closing * closing / (2 * BRAKE)


# The Intelligent Driver Model with MOBIL lane changes: the baseline against which others are compared.

_MAX_IMPOSED_DECELERATION_MPS2 = 2.0
"""The greatest deceleration that MOBIL imposes on the follower in the new lane."""


class IntelligentDriver(LaneChanger):
    """Follows by the Intelligent Driver Model and changes lanes by MOBIL, as the traffic of highway-env does.

    Source: Kesting, Treiber, Helbing: General lane-changing model MOBIL for car-following models, Transportation
    Research Record 1999 (2007), 86, equations 2 and 4 (symmetric rules).

    Args:
        desired_speed: desired speed in m/s.
        headway_s: time gap, in s.
        politeness: weight of the other vehicles' acceleration, relative to the agent's own.
        gain: minimum advantage for a lane change, in m/s².
        patience_s: time between two decisions about lanes, in s.
        step_length_s: step length of the simulation, in s.
        observation_space: observation space of the vehicle.
        action_space: action space of the vehicle.

    Raises:
        ValueError: an argument is out of range, or the observation does not have the default columns.
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
        """Return (target speed, lane change), or the corresponding meta-action."""
        curvature = self._path.update(observation)
        self._update_lanes(observation, curvature)
        speed = float(observation[0, VX])
        own = self._accelerate(speed, find_leader(observation, curvature=curvature))
        self._waited_s += self.step_length_s
        change = 0
        if self._waited_s >= self.patience_s and speed > 1.0:
            self._waited_s = 0.0
            change = self._best(observation, curvature, speed, own)
            self._from_left -= change * LANE_WIDTH_M
        return self._action(speed, max(-8.0, min(2.5, own)), change)

    def _accelerate(self, speed: float, leader: Leader | None) -> float:
        return idm_acceleration(speed, leader, desired_speed=self.desired_speed, headway_s=self.headway_s)

    def _best(self, observation: NDArray[np.float32], curvature: float, speed: float, own: float) -> int:
        best, change = self.gain, 0
        for side in self._changes():
            lateral = -side * LANE_WIDTH_M
            leader = find_leader(observation, lateral=lateral, curvature=curvature)
            after = self._accelerate(speed, leader)
            loss = 0.0
            behind = _follower(observation, lateral, curvature)
            if behind is not None:
                gap, its_speed = behind[0], speed + behind[1]
                braking = self._accelerate(its_speed, Leader(gap, behind[1]))
                if braking < -_MAX_IMPOSED_DECELERATION_MPS2:
                    continue
                before = None
                if leader is not None:
                    before = Leader(gap + CAR_LENGTH_M + leader.gap, behind[1] + leader.closing_speed)
                loss = self._accelerate(its_speed, before) - braking
            if leader is not None and (leader.gap < 0 or after < -_MAX_IMPOSED_DECELERATION_MPS2):
                continue
            advantage = after - own - self.politeness * loss
            if advantage > best:
                best, change = advantage, side
        return change


def _follower(observation: NDArray[np.float32], lateral: float, curvature: float) -> tuple[float, float] | None:
    """Return the gap to the nearest actor behind on a path, in m, and by how much it is faster, in m/s."""
    half = LANE_WIDTH_M / 2
    behind = [
        row for row in actors(observation) if row[X] <= 0 and off_path(row, lateral=lateral, curvature=curvature) < half
    ]
    nearest = max(behind, key=lambda row: row[X], default=None)
    return None if nearest is None else (-nearest[X] - CAR_LENGTH_M, nearest[VX])
