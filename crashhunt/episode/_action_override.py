"""An agent that is overruled from a step on, or that takes over from a recording at a step.

An overruled agent brakes, changes lanes and brakes, keeps its lane or its speed, or has a reference driver.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.agents import Closes, Recorded
from crashhunt.base.capabilities import supports
from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.episode._reference_driver import ReferenceDriver
from crashhunt.simulators import BrakesFully, HasMeanings

if TYPE_CHECKING:
    from crashhunt.agents import Agent
    from crashhunt.simulators import ActionForm, Simulator
    from crashhunt.trial import Handover, Overruled


__all__ = ["Braking", "Keeping", "TakingOver", "overruled_agent"]


_LANES = ("LANE_LEFT", "LANE_RIGHT")
_SPEEDS = ("FASTER", "SLOWER")


def overruled_agent(driver: Agent, simulator: Simulator, overruled: Overruled) -> Agent:
    """Return an agent that drives as another one up to a step.

    Args:
        driver: the other one.
        simulator: which has been reset.
        overruled: how, and from when on.

    Raises:
        InvalidEpisodeError: the simulator does not know how.
    """
    if overruled.reference:
        return ReferenceDriver(driver, simulator, overruled)
    if overruled.keeps:
        return Keeping(driver, simulator, overruled.agent, overruled.after, overruled.keeps)
    return Braking(driver, simulator, overruled.agent, overruled.after, overruled.manoeuvre)


class Braking:
    """Lets an agent drive up to a step, and from then on brakes as hard as the vehicle can, perhaps changing lanes.

    Args:
        driver: the agent.
        simulator: which knows how the vehicle brakes.
        agent: the vehicle.
        after: the step after which it brakes.
        manoeuvre: as in `Overruled`.

    Raises:
        InvalidEpisodeError: the simulator does not know.
    """

    def __init__(self, driver: Agent, simulator: Simulator, agent: str, after: int, manoeuvre: str = "brake") -> None:
        braking = simulator.full_braking(agent) if supports(simulator, BrakesFully) else None
        if braking is None:
            raise InvalidEpisodeError(f"{agent} cannot be made to brake fully: its simulator has no action for it")
        self._driver, self._after = driver, after
        self._action = braking.action
        self._first = braking.action if manoeuvre == "brake" else _lane_change(simulator, agent, manoeuvre)
        self._step = 0

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._step = 0
        self._driver.reset(seed)

    def act(self, observation: object) -> object:
        """Return the driver's action, or that of braking."""
        step, self._step = self._step, self._step + 1
        if step == self._after:
            return self._first
        return self._driver.act(observation) if step < self._after else self._action

    def close(self) -> None:
        """Close the driver."""
        if supports(self._driver, Closes):
            self._driver.close()


class Keeping:
    """Lets an agent drive, and from a step on keeps it from changing lanes, or from changing its speed.

    Args:
        driver: the agent.
        simulator: which knows how fast the vehicle is.
        agent: the vehicle.
        after: the step after which it is kept from that.
        keeps: ``lane`` keeps it from changing lanes, ``speed`` holds its speed.

    Raises:
        InvalidEpisodeError: The action form has no known lanes and speeds.
    """

    def __init__(self, driver: Agent, simulator: Simulator, agent: str, after: int, keeps: str) -> None:
        form = simulator.actions[agent]
        self._idle = _idle(form)
        if self._idle is None and tuple(form.names) != ("target_speed", "lane_change"):
            raise InvalidEpisodeError(f"{agent} cannot be held: its actions have no known lanes and speeds")
        self._driver, self._simulator, self._agent, self._form = driver, simulator, agent, form
        self._after, self._stays = after, keeps == "lane"
        self._step, self._speed = 0, 0.0

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._step = 0
        self._driver.reset(seed)

    def act(self, observation: object) -> object:
        """Return the driver's action, without what it is kept from."""
        step, self._step = self._step, self._step + 1
        if step == self._after:
            scene = self._simulator.scene()
            self._speed = max(0.0, float(scene.speeds[scene.roster.index[self._agent]]))
        action = self._driver.act(observation)
        return action if step < self._after else self._kept(action)

    def close(self) -> None:
        """Close the driver."""
        if supports(self._driver, Closes):
            self._driver.close()

    def _kept(self, action: object) -> object:
        encoded = self._form.encode(action)
        if self._idle is None:
            speed, change = encoded.tolist()
            return (speed, 0) if self._stays else (self._speed, int(change))
        space = self._form.space
        assert supports(space, HasMeanings)
        word = space.meanings[int(encoded[0])]
        return self._idle if word in (_LANES if self._stays else _SPEEDS) else action


class TakingOver:
    """Plays the recorded actions of a vehicle up to a step, and asks its agent from that step on.

    The agent is made before the first step, as in every trial. It is reset after the last recorded action, with the
    seed of the trial, and the first observation that it is shown is that after the step. It has seen nothing of the
    steps before.

    Args:
        driver: the agent.
        handover: the vehicle, its log and the step.
    """

    def __init__(self, driver: Agent, handover: Handover) -> None:
        self._driver, self._after = driver, handover.after
        self._recorded = Recorded(handover.log, handover.agent)
        self._step, self._seed = 0, 0

    def reset(self, seed: int) -> None:
        """Begin an episode; the agent is reset later."""
        self._step, self._seed = 0, seed
        self._recorded.reset(seed)

    def act(self, observation: object) -> object:
        """Return the recorded action, or that of the agent."""
        step, self._step = self._step, self._step + 1
        if step < self._after:
            return self._recorded.act(observation)
        if step == self._after:
            self._driver.reset(self._seed)
        return self._driver.act(observation)

    def close(self) -> None:
        """Close the agent."""
        if supports(self._driver, Closes):
            self._driver.close()


def _idle(form: ActionForm) -> int | None:
    """The action of doing nothing; None where there is none."""
    space = form.space
    return tuple(space.meanings).index("IDLE") if supports(space, HasMeanings) and "IDLE" in space.meanings else None


def _lane_change(simulator: Simulator, agent: str, side: str) -> object:
    """The action that changes lanes, and brakes where one action can say both.

    Raises:
        InvalidEpisodeError: the vehicle has none.
    """
    form = simulator.actions[agent]
    if tuple(form.names) == ("target_speed", "lane_change"):
        return 0.0, 1 if side == "left" else -1
    name = f"LANE_{side.upper()}"
    if supports(form.space, HasMeanings) and name in form.space.meanings:
        return tuple(form.space.meanings).index(name)
    raise InvalidEpisodeError(
        f"{agent} cannot be made to change to the {side} lane: its actions have no known lane change"
    )
