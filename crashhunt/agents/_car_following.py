"""A car-following agent with a reaction delay, and the perception that it shares with lane changers."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from crashhunt.agents._protocol import SPEED_OR_META, meta_actions, wanted_meta_action
from crashhunt.base.errors import UsageError
from crashhunt.trial import Argument, Range

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy as np
    from gymnasium import Space
    from numpy.typing import NDArray

CAR_LENGTH_M = 5.0  # highway-env's, and SUMO's default; the observation does not say how long others are
_PATH_HALF_WIDTH_M = 1.7
_STANDSTILL_GAP_M = 4.0  # includes the part of half a truck that exceeds half a car
# The default layout: presence, x, y, vx, vy, cos_h, sin_h; x ahead and y to the right of the vehicle.
PRESENCE, X, Y, VX, VY, COS_H, SIN_H = range(7)


@dataclass(frozen=True, slots=True)
class Leader:
    """The nearest vehicle ahead on a path."""

    gap: float  # gap from bumper to bumper if both vehicles are cars, in m; an observation contains no lengths
    closing_speed: float  # speed at which the gap shrinks, in m/s; negative if it grows


def check_layout(space: Space[object] | None) -> None:
    """Refuse an observation space that lacks the columns which the agent reads.

    Raises:
        UsageError: the observation space has parts, or not the columns presence, x, y, vx, vy, cos_h and sin_h.
    """
    if space is None:
        return
    from gymnasium.spaces import Dict  # takes no time here: the maker of the space has imported it

    if isinstance(space, Dict):
        message = f"the agent observes Kinematics, but would receive the parts {', '.join(space)}"
        raise UsageError(message, fix="name no parts for it, or --observe kinematics")
    columns = (space.shape or (0,))[-1]
    if columns != SIN_H + 1:
        raise UsageError(
            "the agent needs the default features (presence, x, y, vx, vy, cos_h, sin_h), but the observation has "
            f"{columns} columns",
            fix="give the observation these features in the scenario file",
        )


def actors(observation: NDArray[np.float32]) -> Iterator[list[float]]:
    """Yield the rows of the other actors."""
    for row in observation[1:].tolist():
        if row[PRESENCE] < 0.5:
            return  # present rows come first
        yield row


def off_path(row: Sequence[float], *, lateral: float, curvature: float) -> float:
    """Return how far an actor is from a path, in m; 0 if the actor may be on the path.

    A bend may begin or end anywhere between the vehicle and the actor, and an observation does not show where. The path
    therefore lies between two curves: one keeps the present curvature, and the other is an arc that has the actor's
    heading at its end. An actor between these curves counts as on the path, because braking for it is safe.

    Args:
        row: row of the actor in the observation.
        lateral: distance of the path to the right of the vehicle, in m.
        curvature: curvature of the path at the vehicle, positive to the right, in 1/m.
    """
    ahead, right = row[X], row[Y] - lateral
    low = high = curvature * ahead * ahead / 2
    if row[COS_H] > 0.5:  # within 60 degrees of the own heading, so that it may have followed the same bend
        arc = math.atan2(row[SIN_H], row[COS_H]) * ahead / 2
        low, high = min(low, arc), max(high, arc)
    return max(low - right, right - high, 0.0)


def find_leader(observation: NDArray[np.float32], *, lateral: float = 0.0, curvature: float = 0.0) -> Leader | None:
    """Return the nearest vehicle ahead whose centre is within 1.7 m of a path.

    Oncoming traffic is never a leader, because it keeps to its own side of the road.

    Args:
        observation: observation in the default layout.
        lateral: distance of the path to the right of the vehicle, in m.
        curvature: curvature of the path at the vehicle, positive to the right, in 1/m.
    """
    nearest: Leader | None = None
    for row in actors(observation):
        if row[X] <= 0 or row[COS_H] < -0.5:
            continue
        if off_path(row, lateral=lateral, curvature=curvature) >= _PATH_HALF_WIDTH_M:
            continue
        gap = row[X] - CAR_LENGTH_M
        if nearest is None or gap < nearest.gap:
            nearest = Leader(gap, -row[VX])
    return nearest


class PathCurvature:
    """Estimates the curvature of the vehicle's path from changes of its heading, like the path prediction of a radar.

    Args:
        step_length_s: step length between two observations, in s.
    """

    def __init__(self, step_length_s: float) -> None:
        self._step_length_s = step_length_s
        self.reset()

    def reset(self) -> None:
        """Delete all earlier observations."""
        self._heading: float | None = None
        self._value = 0.0

    def update(self, observation: NDArray[np.float32]) -> float:
        """Return the smoothed curvature, positive to the right, in 1/m."""
        own = observation[0].tolist()
        heading = math.atan2(own[SIN_H], own[COS_H])
        if self._heading is not None and own[VX] > 1.0:
            turned = math.remainder(heading - self._heading, math.tau)
            self._value += 0.3 * (turned / (own[VX] * self._step_length_s) - self._value)
        self._heading = heading
        return self._value


def idm_acceleration(
    speed: float,
    leader: Leader | None,
    *,
    desired_speed: float,
    headway_s: float,
    comfort: float = 2.0,
) -> float:
    """Return the acceleration of the Intelligent Driver Model, in m/s².

    Source: Treiber, Hennecke, Helbing: Congested traffic states in empirical observations and microscopic
    simulations, Physical Review E 62 (2000), 1805, equations 2 and 3.

    Args:
        speed: speed of the vehicle, in m/s.
        leader: the vehicle ahead; None on a free road.
        desired_speed: desired speed on a free road, in m/s.
        headway_s: time gap, in s.
        comfort: maximum acceleration and comfortable deceleration, which are equal, in m/s².
    """
    free = 1 - (speed / max(desired_speed, 0.1)) ** 4
    if leader is None:
        return comfort * free
    dynamic = speed * headway_s + speed * leader.closing_speed / (2 * comfort)
    wanted = _STANDSTILL_GAP_M + max(0.0, dynamic)
    return comfort * (free - (wanted / max(leader.gap, 0.1)) ** 2)


class SpeedAgent:
    """The common part of agents that choose an acceleration, from an observation in the default layout."""

    actions = SPEED_OR_META

    def __init__(
        self, step_length_s: float, observation_space: Space[object] | None, action_space: Space[object] | None
    ) -> None:
        if not step_length_s > 0:
            raise ValueError(f"step_length_s must be above 0, not {step_length_s}")
        check_layout(observation_space)
        self._meta = meta_actions(action_space)
        self.step_length_s = step_length_s
        self._path = PathCurvature(step_length_s)

    def _action(self, speed: float, acceleration: float, change: int = 0) -> tuple[float, int] | int:
        """Return (target speed, lane change) for an acceleration in m/s², or the corresponding meta-action."""
        if self._meta is not None:
            return self._meta[wanted_meta_action(acceleration, change)]
        return max(0.0, speed + acceleration * self.step_length_s), change


class CarFollowing(SpeedAgent):
    """Follows the vehicle in front by the Intelligent Driver Model, with a delayed observation.

    The agent is safe for most of its arguments. The agent is not safe with a long delay, a short headway and weak
    brakes.

    Args:
        delay_s: age of the observation on which the agent acts, in s.
        headway_s: time gap that the agent keeps, in s.
        max_brake: maximum deceleration, in m/s².
        desired_speed: desired speed with a free road, in m/s.
        step_length_s: step length of the simulation, in s; used to convert the delay to steps.
        observation_space: observation space of the vehicle.
        action_space: action space of the vehicle; with discrete meta-actions, the agent returns IDLE, FASTER or SLOWER.

    Raises:
        ValueError: an argument is out of range, or the observation does not have the default columns.
    """

    def __init__(
        self,
        delay_s: Annotated[
            float, Argument("delay_s", distribution=Range(0.0, 1.2), unit="s", help="acts on observations this old")
        ] = 0.3,
        headway_s: Annotated[
            float, Argument("headway_s", distribution=Range(0.5, 2.5), unit="s", help="time gap that it keeps")
        ] = 1.5,
        max_brake: Annotated[
            float, Argument("max_brake", distribution=Range(3.0, 8.0), unit="m/s²", help="hardest braking")
        ] = 6.0,
        desired_speed: Annotated[float, Argument("desired_speed", unit="m/s", help="on a free road")] = 25.0,
        step_length_s: float = 0.1,
        observation_space: Space[object] | None = None,
        action_space: Space[object] | None = None,
    ) -> None:
        if not delay_s >= 0:
            raise ValueError(f"delay_s must be at least 0, not {delay_s}")
        super().__init__(step_length_s, observation_space, action_space)
        self.headway_s = headway_s
        self.max_brake = max_brake
        self.desired_speed = desired_speed
        self._seen: deque[NDArray[np.float32]] = deque(maxlen=round(delay_s / step_length_s) + 1)

    def reset(self, seed: int) -> None:
        """Delete all earlier observations."""
        self._seen.clear()
        self._path.reset()

    def act(self, observation: NDArray[np.float32]) -> tuple[float, int] | int:
        """Return (target speed, 0), or the corresponding meta-action."""
        self._seen.append(observation)
        seen = self._seen[0]
        leader = find_leader(seen, curvature=self._path.update(seen))
        wanted = idm_acceleration(
            float(seen[0, VX]), leader, desired_speed=self.desired_speed, headway_s=self.headway_s
        )
        return self._action(float(observation[0, VX]), max(-self.max_brake, min(2.0, wanted)))
