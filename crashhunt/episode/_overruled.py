"""An agent that is overruled from a step on: it brakes, or changes lanes and brakes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.agents import Closes
from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.base.faculties import offers
from crashhunt.simulators import BrakesFully, HasMeanings

if TYPE_CHECKING:
    from crashhunt.agents import Agent
    from crashhunt.simulators import Simulator

__all__ = ["Braking"]


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
        braking = simulator.full_braking(agent) if offers(simulator, BrakesFully) else None
        if braking is None:
            raise InvalidEpisodeError(f"nobody knows how {agent} brakes as hard as it can")
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
        if offers(self._driver, Closes):
            self._driver.close()


def _lane_change(simulator: Simulator, agent: str, side: str) -> object:
    """The action that changes lanes, and brakes where one action can say both.

    Raises:
        InvalidEpisodeError: the vehicle has none.
    """
    form = simulator.actions[agent]
    if tuple(form.names) == ("target_speed", "lane_change"):
        return 0.0, 1 if side == "left" else -1
    name = f"LANE_{side.upper()}"
    if offers(form.space, HasMeanings) and name in form.space.meanings:
        return tuple(form.space.meanings).index(name)
    raise InvalidEpisodeError(f"nobody knows how {agent} changes lanes to the {side}")
