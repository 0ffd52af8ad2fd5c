"""The agent protocol. No base class is needed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Agent", "Closes", "DrawsPanels", "NeedsLibraries"]


@runtime_checkable
class Agent(Protocol):
    """Drives one vehicle.

    An agent is written as ``package.module:attribute`` and called with its arguments as keywords, once per trial and
    vehicle; a parameter named ``observation_space`` or ``action_space`` receives the Gymnasium space, and one named
    ``step_length_s`` the time from one step to the next, in s. What not every agent can do is a protocol of its own:
    `DrawsPanels` and `Closes`; and `NeedsLibraries` of what makes it. Whoever has the method or attribute offers it.
    """

    def reset(self, seed: int) -> None:
        """Forget everything; from here on, draw random numbers from ``seed`` only."""

    def act(self, observation: Any) -> Any:
        """Return an action inside the vehicle's action space.

        Args:
            observation: inside its observation space. Never written to again by anybody else.
        """


class DrawsPanels(Protocol):
    """An agent that shows what it thinks."""

    def panels(self) -> object:
        """Return panels in a nest of mappings and sequences, whose keys are their labels.

        Called after `Agent.act`, and only when somebody renders: it must not change what the agent does next.
        """


class Closes(Protocol):
    """An agent that has something to let go of."""

    def close(self) -> None:
        """Let go of everything; called once, at the end of the trial, however it ended."""


class NeedsLibraries(Protocol):
    """What makes agents (a class or function) that import libraries which take long to load."""

    @property
    def libraries(self) -> Sequence[str]:
        """Modules to import before any trial's time runs; one that is missing is left for the agent to tell."""
