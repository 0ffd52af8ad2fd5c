"""A vehicle that an agent does not see for a while; it is left out of the observation, and nothing else changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crashhunt.simulators._kinematics import Kinematics

__all__ = ["Unseen"]


class Unseen:
    """Hides one vehicle from one agent, from the next observation on.

    Args:
        kinematics: which makes the observations.
        agent: who does not see it.
        vehicle: whom.
    """

    how_strong = 1.0

    def __init__(self, kinematics: Kinematics, agent: str, vehicle: str) -> None:
        self._hidden = kinematics.hidden
        self._pair = agent, vehicle
        self._hidden.add(self._pair)

    def keep(self) -> None:
        """It stays hidden."""

    def end(self) -> None:
        """Show it again."""
        self._hidden.discard(self._pair)
