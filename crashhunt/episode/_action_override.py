"""Drivers that overrule an agent from a step on, and an agent that takes control after recorded actions.

An overruled agent brakes, changes lanes and brakes, or keeps its lane or its speed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.agents import Closes, Recorded
from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.base.foreign_code import supports
from crashhunt.scenario import ACTIONS, OVERRIDES_ONLY
from crashhunt.simulators import (
    MAX_ACCELERATION,
    NamesMetaActions,
    SupportsFullBraking,
    TranslatesMotion,
)

if TYPE_CHECKING:
    from crashhunt.agents import Agent
    from crashhunt.simulators import ActionForm, Simulator
    from crashhunt.trial import Handover


_SPEED_AND_LANE, ACCELERATION = ACTIONS["speed_and_lane"].names, ACTIONS["acceleration"].names
WITH_LANE_CHANGE = (_SPEED_AND_LANE, ACCELERATION)
_WITH_LANE = (*WITH_LANE_CHANGE, ACTIONS["speed_and_lateral"].names)
_WITH_SPEED = (*_WITH_LANE, OVERRIDES_ONLY)  # whose driver also changes lanes
_LANE_ACTIONS = ("LANE_LEFT", "LANE_RIGHT")
_SPEED_ACTIONS = ("FASTER", "SLOWER")


class Overruling:
    """The common part of the drivers that take the place of an agent: its episodes and its end."""

    _driver: Agent
    _step: int

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._step = 0
        self._driver.reset(seed)

    def drive(self, observation: object) -> tuple[int, object]:
        """Let the agent act; return the number of the step and the action of the agent."""
        step, self._step = self._step, self._step + 1
        return step, self._driver.act(observation)

    def close(self) -> None:
        """Close the agent."""
        if supports(self._driver, Closes):
            self._driver.close()


class Braking(Overruling):
    """Lets an agent drive up to a step. After this step, the vehicle brakes as hard as it can, or changes lanes.

    Raises:
        InvalidEpisodeError: the simulator has no action for this manoeuvre.
    """

    def __init__(self, driver: Agent, simulator: Simulator, agent: str, after: int, manoeuvre: str = "brake") -> None:
        braking = simulator.full_braking(agent) if supports(simulator, SupportsFullBraking) else None
        if braking is None:
            raise InvalidEpisodeError(f"{agent} cannot be made to brake fully: its simulator has no action for it")
        self._driver, self._after = driver, after
        self._choose = braking.choose or (lambda: braking.action)
        self._first = None if manoeuvre == "brake" else _lane_change(simulator, agent, manoeuvre)
        self._step = 0

    def act(self, observation: object) -> object:
        """Return the agent's action, or the braking action after the step."""
        step, self._step = self._step, self._step + 1
        if step < self._after:
            return self._driver.act(observation)
        return self._first if step == self._after and self._first is not None else self._choose()


class Keeping(Overruling):
    """Lets an agent drive, and after a step prevents lane changes or speed changes of its vehicle.

    Raises:
        InvalidEpisodeError: The action form has no known lanes and speeds.
    """

    def __init__(self, driver: Agent, simulator: Simulator, agent: str, after: int, keeps: str) -> None:
        form = simulator.actions[agent]
        self._idle = _idle(form)
        self._steers = steering_of(simulator, agent)
        known = _WITH_LANE if keeps == "lane" else _WITH_SPEED
        if self._idle is None and self._steers is None and tuple(form.names) not in known:
            raise InvalidEpisodeError(
                f"the {keeps} of {agent} cannot be held: it is unknown which lanes and speeds its actions choose"
            )
        self._driver, self._simulator, self._agent, self._form = driver, simulator, agent, form
        self._after, self._stays = after, keeps == "lane"
        self._step, self._speed = 0, 0.0

    def act(self, observation: object) -> object:
        """Return the agent's action, with the overruled parts replaced."""
        step, self._step = self._step, self._step + 1
        if step == self._after:
            scene = self._simulator.scene()
            self._speed = max(0.0, float(scene.speeds[scene.roster.index[self._agent]]))
        action = self._driver.act(observation)
        return action if step < self._after else self._kept(action)

    def _kept(self, action: object) -> object:
        encoded = self._form.encode(action)
        if self._steers is not None:
            speed = None if self._stays else self._speed
            return self._steers.action_with(self._agent, encoded, speed_mps=speed, keeps_lane=self._stays)
        if self._idle is None:
            value, change = encoded.tolist()
            kept = 0.0 if tuple(self._form.names) == ACCELERATION else self._speed
            change = int(change) if tuple(self._form.names) in (*WITH_LANE_CHANGE, OVERRIDES_ONLY) else change
            return (value, 0) if self._stays else (kept, change)
        space = self._form.space
        assert supports(space, NamesMetaActions)
        word = space.meanings[int(encoded[0])]
        return self._idle if word in (_LANE_ACTIONS if self._stays else _SPEED_ACTIONS) else action


class HandedOver(Overruling):
    """Repeats the recorded actions of a vehicle up to a step, and lets its agent act after that.

    The agent is created before the first step, as in every trial. The agent is reset after the last recorded action,
    with the seed of the trial. The agent's first observation is the observation after this step, so the agent does not
    receive observations of earlier steps.
    """

    def __init__(self, driver: Agent, handover: Handover) -> None:
        self._driver, self._after = driver, handover.after
        self._recorded = Recorded(handover.log, handover.agent)
        self._step, self._seed = 0, 0

    def reset(self, seed: int) -> None:
        """Begin to repeat recorded actions; the agent is reset after the last of them."""
        self._step, self._seed = 0, seed
        self._recorded.reset(seed)

    def act(self, observation: object) -> object:
        """Return the recorded action, or the agent's action after the handover."""
        step, self._step = self._step, self._step + 1
        if step < self._after:
            return self._recorded.act(observation)
        if step == self._after:
            self._driver.reset(self._seed)
        return self._driver.act(observation)


def _idle(form: ActionForm) -> int | None:
    """Return the action that changes neither speed nor lane; None if there is none."""
    space = form.space
    return (
        tuple(space.meanings).index("IDLE") if supports(space, NamesMetaActions) and "IDLE" in space.meanings else None
    )


def steering_of(simulator: Simulator, agent: str) -> TranslatesMotion | None:
    """Return what translates the actions of a vehicle that moves freely; None for other vehicles."""
    return simulator if supports(simulator, TranslatesMotion) and simulator.is_steered(agent) else None


def _lane_change(simulator: Simulator, agent: str, side: str) -> object:
    """Return the action that changes lanes, and that also brakes if the action space allows both at once.

    Raises:
        InvalidEpisodeError: the vehicle has no action for a lane change.
    """
    form = simulator.actions[agent]
    if tuple(form.names) in (_SPEED_AND_LANE, OVERRIDES_ONLY):
        return 0.0, 1 if side == "left" else -1
    if tuple(form.names) == ACCELERATION:
        return -MAX_ACCELERATION, 1 if side == "left" else -1
    name = f"LANE_{side.upper()}"
    if supports(form.space, NamesMetaActions) and name in form.space.meanings:
        return tuple(form.space.meanings).index(name)
    raise InvalidEpisodeError(
        f"{agent} cannot be made to change to the {side} lane: none of its actions is known to change the lane"
    )
