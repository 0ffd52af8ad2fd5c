"""The agent protocol. No base class is needed."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

__all__ = ["Agent"]


@runtime_checkable
class Agent(Protocol):
    """Drives one vehicle.

    An agent is written as ``package.module:attribute`` and called with its arguments as keywords, once per trial and
    vehicle; a parameter named ``observation_space`` or ``action_space`` receives the Gymnasium space, and one named
    ``step_length_s`` the time from one step to the next, in s. Two further methods are optional: ``panels()`` returns
    pictures of what it thinks and is called only when somebody renders, and ``close()`` is called at the end of the
    trial.
    """

    def reset(self, seed: int) -> None:
        """Forget everything; from here on, draw random numbers from ``seed`` only."""

    def act(self, observation: Any) -> Any:
        """Return an action inside the vehicle's action space.

        Args:
            observation: inside its observation space. Never written to again by anybody else.
        """
