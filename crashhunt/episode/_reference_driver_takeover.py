"""An agent that drives until a model of a competent driver perceives a risk, and brakes as the model from then on.

The models are those of `crashhunt.agents.REFERENCE_MODELS`. A model reacts to one other vehicle, and controls the speed
only. The agent still runs and sees everything, but its actions have no effect after the model has perceived the risk.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.agents import REFERENCE_MODELS, Situation
from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.base.foreign_code import supports
from crashhunt.episode._action_override import Overruling, steering_of
from crashhunt.scenario import ACTIONS
from crashhunt.simulators import MAX_ACCELERATION, ReportsSurroundings

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.agents import Agent
    from crashhunt.base.codec import JsonObject
    from crashhunt.simulators import Simulator
    from crashhunt.trial import Overruled
    from crashhunt.world import Neighbor, Scene, Surroundings

_SPEED_AND_LANE, _SPEED_AND_LATERAL = ACTIONS["speed_and_lane"].names, ACTIONS["speed_and_lateral"].names
_ACCELERATION = ACTIONS["acceleration"].names
_FORMS = (_SPEED_AND_LANE, _SPEED_AND_LATERAL, _ACCELERATION)
_NEAR_M = 30.0  # nearer vehicles are measured by their outlines, and others by the road
_STRAIGHT_RAD = math.radians(3.0)  # between the headings, for a measurement by outlines
_PARALLEL_RAD = 1e-6  # between the headings of vehicles on the same straight road
_BESIDE_M = 1.0  # lateral gap to a vehicle in the next lane that is not measured
_MAX_LATERAL_MPS = 5.0  # a vehicle that jumps to another lane has no greater lateral speed


class CompetentDriver(Overruling):
    """Lets an agent drive, and after a step replaces it by a model when the model perceives a risk.

    Raises:
        InvalidEpisodeError: the model cannot drive the vehicle.
    """

    def __init__(self, driver: Agent, simulator: Simulator, overruled: Overruled) -> None:
        if not supports(simulator, ReportsSurroundings):
            raise InvalidEpisodeError("the simulator reports no surroundings of the vehicle")
        self._names = tuple(simulator.actions[overruled.agent].names)
        self._steers = steering_of(simulator, overruled.agent)
        if self._names not in _FORMS and self._steers is None:
            raise InvalidEpisodeError("the actions of the agent set neither a speed nor an acceleration")
        self._driver, self._simulator, self._see = driver, simulator, simulator.surroundings
        self._agent, self._other, self._after = overruled.agent, overruled.other, overruled.after
        self._name, self._step_s = overruled.reference, simulator.step_length_s
        self._model = REFERENCE_MODELS[self._name](1, self._step_s)
        self._step = 0
        self._lateral_gap: float | None = None
        self._response: JsonObject | None = None

    @property
    def responses(self) -> list[JsonObject]:
        """One entry: when the model perceived the risk, the situation then and at the end, and the smallest gap."""
        return [] if self._response is None else [self._response]

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._lateral_gap, self._response = None, None
        self._model = REFERENCE_MODELS[self._name](1, self._step_s)
        super().reset(seed)

    def act(self, observation: object) -> object:
        """Return the agent's action, or the action of the model after it has perceived the risk."""
        step, action = self.drive(observation)
        if step < self._after:
            return action
        scene, around = self._simulator.scene(), self._see(self._agent)
        found = _measured(scene, self._agent, self._other, around)
        speed = around.speed_mps
        acceleration = 0.0
        if found is not None:
            gap, lateral_gap, other_speed, lengths = found
            towards = 0.0 if self._lateral_gap is None else (self._lateral_gap - lateral_gap) / self._step_s
            self._lateral_gap = lateral_gap
            situation = Situation(
                speed=np.array([speed]),
                other_speed=np.array([other_speed]),
                gap=np.array([gap]),
                lateral_gap=np.array([lateral_gap]),
                lateral_speed=np.array([min(max(0.0, towards), _MAX_LATERAL_MPS)]),
                length=np.array([lengths[0]]),
                other_length=np.array([lengths[1]]),
                visible=np.array([True]),
            )
            acceleration = float(self._model.brake(situation)[0])
            if self._response is None and bool(self._model.perceived[0]):
                self._response = {
                    "faculty": "longitudinal",
                    "kind": self._name,
                    "actor": self._other,
                    "first": step,
                    "last": step,
                    "gap_m": gap,
                    "speed_mps": speed,
                    "actor_speed_mps": other_speed,
                    "least_gap_m": gap,
                    "in_junction": False,
                }
            if self._response is not None:
                self._response |= {"last": step, "last_gap_m": gap, "last_closing_mps": speed - other_speed}
                if lateral_gap < 0:
                    self._response["least_gap_m"] = min(self._response["least_gap_m"], gap)
        if self._response is None:
            return action
        if any(crossing.actor == self._other for crossing in around.crossing):
            self._response["in_junction"] = True
        return self._braking(speed, acceleration)

    def _braking(self, speed: float, acceleration: float) -> object:
        """Return an action with the acceleration of the model; a vehicle that moves freely keeps its lane."""
        target = max(0.0, speed + acceleration * self._step_s)
        if self._steers is not None:
            return self._steers.action_with(self._agent, None, speed_mps=target, keeps_lane=True)
        if self._names == _SPEED_AND_LANE:
            return target, 0
        if self._names == _SPEED_AND_LATERAL:
            return target, 0.0
        value = max(-MAX_ACCELERATION, min(MAX_ACCELERATION, (target - speed) / self._step_s))
        return value, 0


def _measured(
    scene: Scene, agent: str, other: str, around: Surroundings
) -> tuple[float, float, float, tuple[float, float]] | None:
    """Return gap, lateral gap and speed of another vehicle, and the lengths of both; None if it is not ahead.

    A near vehicle on a straight road is measured by the outlines. In a bend, and farther away, the simulator says which
    vehicles are ahead on the path and in the neighbouring lanes.
    """
    rows = scene.roster.index
    if agent not in rows or other not in rows:
        return None
    own, its = rows[agent], rows[other]
    one, two = scene.roster.actors[own], scene.roster.actors[its]
    lengths = one.length, two.length
    speed = max(0.0, float(scene.speeds[its]))
    turn = math.remainder(scene.headings[its] - scene.headings[own], math.tau)
    # Halfway between both headings, a circular arc from one vehicle to the other has no sideways part.
    heading = scene.headings[own] + turn / 2
    dx, dy = (scene.centers[its] - scene.centers[own]).tolist()
    along = dx * math.cos(heading) + dy * math.sin(heading)
    gap = along - sum(lengths) / 2
    lateral_gap = abs(dy * math.cos(heading) - dx * math.sin(heading)) - (one.width + two.width) / 2
    near = abs(along) <= _NEAR_M
    if near and abs(turn) <= _STRAIGHT_RAD:
        return gap, lateral_gap, speed, lengths
    found = _among(around.ahead, other)
    if found is not None:
        return found.gap_m, -min(one.width, two.width), speed, lengths
    found = _among((side.ahead for side in around.sides.values()), other)
    if found is not None:
        return found.gap_m, max(_BESIDE_M, lateral_gap if abs(turn) <= _STRAIGHT_RAD else 0.0), speed, lengths
    # A vehicle that the simulator does not know is moved along a path, and is measured by the outlines if it can be.
    return (gap, lateral_gap, speed, lengths) if not near and abs(turn) <= _PARALLEL_RAD else None


def _among(neighbors: Iterable[Neighbor | None], actor: str) -> Neighbor | None:
    return next((one for one in neighbors if one is not None and one.actor == actor), None)
