"""An agent that acts at random."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from crashhunt.trial import Argument

if TYPE_CHECKING:
    from gymnasium import Space

__all__ = ["RandomAgent"]


class RandomAgent:
    """Draws an action from the action space and holds it for a while.

    Args:
        hold_steps: for how many steps it holds each action.
        action_space: of the vehicle.
    """

    def __init__(
        self,
        action_space: Space[object],
        hold_steps: Annotated[int, Argument("hold_steps", unit="steps", help="before it draws again")] = 10,
    ) -> None:
        if hold_steps < 1:
            raise ValueError(f"hold_steps must be at least 1, not {hold_steps}")
        self._space = action_space
        self._hold = hold_steps
        self._left = 0
        self._action: object = None

    def reset(self, seed: int) -> None:
        """Seed the space."""
        self._space.seed(seed)
        self._left = 0

    def act(self, observation: object) -> object:
        """Return the action that is held."""
        if self._left == 0:
            self._left = self._hold
            self._action = self._space.sample()
        self._left -= 1
        return self._action
