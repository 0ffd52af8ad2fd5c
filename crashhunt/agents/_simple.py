"""The simplest agents: a constant speed, random actions, or recorded actions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from crashhunt.agents._protocol import SPEED_OR_META, meta_actions
from crashhunt.trial import Argument, Range

if TYPE_CHECKING:
    from gymnasium import Space


class KeepLaneWithSpeed:
    """Keeps its lane at a constant speed, and ignores other vehicles.

    Args:
        speed: speed in m/s.
        action_space: action space of the vehicle; with discrete meta-actions, the agent returns IDLE, FASTER or SLOWER.

    Raises:
        ValueError: the actions are neither (target speed, lane change) nor meta-actions.
    """

    actions = SPEED_OR_META

    def __init__(
        self,
        speed: Annotated[
            float, Argument("speed", distribution=Range(5.0, 30.0), unit="m/s", help="held for ever")
        ] = 15.0,
        action_space: Space[object] | None = None,
    ) -> None:
        self.speed = speed
        self._meta = meta_actions(action_space)

    def reset(self, seed: int) -> None:
        """Do nothing, because the agent has no state."""

    def act(self, observation: Any) -> object:
        """Return (speed, 0), or the meta-action that brings the vehicle nearer to this speed."""
        if self._meta is None:
            return self.speed, 0
        error = self.speed - float(observation[0, 3])
        return self._meta["FASTER" if error > 2.5 else "SLOWER" if error < -2.5 else "IDLE"]


# An agent that acts at random.


class RandomAgent:
    """Draws an action from the action space and holds it for a while.

    Args:
        hold_steps: number of steps for which the agent holds each action.
        action_space: action space of the vehicle.
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
        """Seed the action space."""
        self._space.seed(seed)
        self._left = 0

    def act(self, observation: object) -> object:
        """Return the action that the agent currently holds."""
        if self._left == 0:
            self._left = self._hold
            self._action = self._space.sample()
        self._left -= 1
        return self._action


# An agent that plays the actions of a log.


class Recorded:
    """Replays the recorded actions of one agent, one in each step.

    Args:
        log: path of a ``log.mcap``.
        agent: id of the agent whose actions are replayed.
    """

    def __init__(
        self,
        log: Annotated[str, Argument("log", help="path of a log.mcap")],
        agent: Annotated[str, Argument("agent", help="whose actions")] = "ego",
    ) -> None:
        from crashhunt.recording import read_log

        self._actions = read_log(Path(log)).actions(agent)
        self._next = 0

    def reset(self, seed: int) -> None:
        """Start again at the first recorded action."""
        self._next = 0

    def act(self, observation: object) -> object:
        """Return the next recorded action.

        Raises:
            IndexError: the log has no further action.
        """
        if self._next >= len(self._actions):
            raise IndexError(f"the log has {len(self._actions)} actions, but the episode needs one more")
        self._next += 1
        return self._actions[self._next - 1]
