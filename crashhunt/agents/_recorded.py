"""An agent that plays the actions of a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from crashhunt.trial import Argument

__all__ = ["Recorded"]


class Recorded:
    """Plays the recorded actions of one agent, one a step.

    Args:
        log: the path of a ``log.mcap``.
        agent: whose actions.
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
        """Begin at the first action."""
        self._next = 0

    def act(self, observation: object) -> object:
        """Return the next action.

        Raises:
            IndexError: the log is exhausted; it never drives on silently.
        """
        if self._next >= len(self._actions):
            raise IndexError(f"the log has {len(self._actions)} actions, and the episode asks for one more")
        self._next += 1
        return self._actions[self._next - 1]
