"""An agent that drives as one of the reference models of a competent driver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from crashhunt.agents._car_following import (
    CAR_LENGTH_M,
    COS_H,
    VX,
    VY,
    SpeedAgent,
    X,
    Y,
    actors,
    find_leader,
    idm_acceleration,
    off_path,
)
from crashhunt.agents._reference_models import REFERENCE_MODELS, ReferenceModel, Situation
from crashhunt.trial import Argument

if TYPE_CHECKING:
    from gymnasium import Space
    from numpy.typing import NDArray

_HEADWAY_S = 2.0  # time gap of the careful human driver of R157
_COMFORT_MPS2 = 1.0  # acceleration of a follower. Source: the comparison of the models, see _reference_models.py
_GENTLE_BRAKING_MPS2 = 2.0  # for a speed or gap that is no risk
_ASIDE_M = 6.0  # vehicles that are further from the path are ignored
_SAME_VEHICLE_M = 2.0  # a vehicle seen this near to its expected position is the same one as in the last step
_MAX_LATERAL_MPS = 5.0  # a vehicle that jumps to another lane has no greater lateral speed
_SAME_DIRECTION = 0.5  # least cosine of the angle between the headings


@dataclass(slots=True, eq=False)
class _Watched:
    """A vehicle that the driver watches."""

    ahead: float  # where it is expected in the next observation, in m ahead
    right: float  # where it is expected in the next observation, in m to the right
    model: ReferenceModel  # the driver's reaction to this vehicle
    aside: float  # its distance to the path in the last observation, in m


class ReferenceDriver(SpeedAgent):
    """Keeps its lane, follows at 2 s, and brakes in a risk as a reference model of a competent driver.

    The models and their sources are those of UN R157 and of the literature: `REFERENCE_MODELS`. Without a risk, the
    driver follows by the Intelligent Driver Model with 1 m/s² to accelerate and 2 m/s² to brake. The observation
    contains neither lengths nor widths of other vehicles, so all vehicles count as equally large.

    Args:
        model: name of the model: ``cc_human``, ``fsm``, ``rss`` or ``reg157``.
        desired_speed: desired speed on a free road, in m/s; 0 keeps the speed of the first observation.
        length: length of the vehicles, in m.
        width: width of the vehicles, in m.
        step_length_s: step length of the simulation, in s.
        observation_space: observation space of the vehicle.
        action_space: action space of the vehicle; with discrete meta-actions, the agent returns IDLE, FASTER or SLOWER.

    Raises:
        ValueError: an argument is out of range, or the observation does not have the default columns.
    """

    def __init__(
        self,
        model: Annotated[
            str, Argument("model", help=f"of a competent driver: {', '.join(REFERENCE_MODELS)}")
        ] = "cc_human",
        desired_speed: Annotated[
            float, Argument("desired_speed", unit="m/s", help="on a free road; 0 keeps the first speed")
        ] = 25.0,
        length: Annotated[float, Argument("length", unit="m", help="length of the vehicles")] = CAR_LENGTH_M,
        width: Annotated[float, Argument("width", unit="m", help="width of the vehicles")] = 1.8,
        step_length_s: float = 0.1,
        observation_space: Space[object] | None = None,
        action_space: Space[object] | None = None,
    ) -> None:
        if model not in REFERENCE_MODELS:
            raise ValueError(f"model must be one of {', '.join(REFERENCE_MODELS)}, not {model!r}")
        for name, value, least in (
            ("desired_speed", desired_speed, 0.0),
            ("length", length, math.ulp(0.0)),
            ("width", width, math.ulp(0.0)),
            ("step_length_s", step_length_s, math.ulp(0.0)),
        ):
            if not least <= value < math.inf:
                raise ValueError(f"{name} must be a number {'of at least 0' if least == 0 else 'above 0'}, not {value}")
        super().__init__(step_length_s, observation_space, action_space)
        self.model, self.desired_speed, self.length, self.width = model, desired_speed, length, width
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget all vehicles."""
        self._path.reset()
        self._watched: list[_Watched] = []
        self._desired = self.desired_speed

    def act(self, observation: NDArray[np.float32]) -> tuple[float, int] | int:
        """Return (target speed, 0), or the corresponding meta-action."""
        curvature, speed = self._path.update(observation), float(observation[0, VX])
        if self._desired == 0:
            self._desired = max(speed, 0.1)
        acceleration, at_risk = self._reaction(observation, curvature, speed)
        if not at_risk:
            leader = find_leader(observation, curvature=curvature)
            wanted = idm_acceleration(
                speed, leader, desired_speed=self._desired, headway_s=_HEADWAY_S, comfort=_COMFORT_MPS2
            )
            acceleration = max(-_GENTLE_BRAKING_MPS2, min(_COMFORT_MPS2, wanted))
        return self._action(speed, acceleration)

    def _reaction(self, observation: NDArray[np.float32], curvature: float, speed: float) -> tuple[float, bool]:
        """Return the hardest deceleration that the model asks for, and whether it perceives a risk."""
        known, self._watched = self._watched, []
        hardest, at_risk = 0.0, False
        for row in actors(observation):
            aside = off_path(row, lateral=0.0, curvature=curvature)
            if row[COS_H] < _SAME_DIRECTION or row[X] < -self.length or aside > _ASIDE_M:
                continue
            seen = self._recognize(known, row, aside)
            # The path of the vehicle and not its heading, because a vehicle that is moved exactly keeps its heading.
            towards = (seen.aside - aside) / self.step_length_s
            seen.aside = aside
            situation = Situation(
                speed=np.array([speed]),
                other_speed=np.array([speed + row[VX]]),
                gap=np.array([row[X] - self.length]),
                lateral_gap=np.array([aside - self.width]),
                lateral_speed=np.array([min(max(0.0, towards), _MAX_LATERAL_MPS)]),
                length=np.array([self.length]),
                other_length=np.array([self.length]),
                visible=np.array([True]),
            )
            hardest = min(hardest, float(seen.model.brake(situation)[0]))
            at_risk = at_risk or bool(seen.model.perceived[0])
            seen.ahead, seen.right = row[X] + row[VX] * self.step_length_s, row[Y] + row[VY] * self.step_length_s
            self._watched.append(seen)
        return hardest, at_risk

    def _recognize(self, known: list[_Watched], row: list[float], aside: float) -> _Watched:
        """Return the watched vehicle that a row shows; remove it from the known vehicles."""
        best, nearest = None, _SAME_VEHICLE_M
        for one in known:
            distance = math.hypot(row[X] - one.ahead, row[Y] - one.right)
            if distance < nearest:
                best, nearest = one, distance
        if best is None:
            model = REFERENCE_MODELS[self.model](1, self.step_length_s)
            return _Watched(ahead=row[X], right=row[Y], model=model, aside=aside)
        known.remove(best)
        return best
