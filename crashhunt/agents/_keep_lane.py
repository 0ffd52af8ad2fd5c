"""The simplest agent: one speed, never another lane."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from crashhunt.agents._forms import meta_actions
from crashhunt.trial import Argument, Range

if TYPE_CHECKING:
    from gymnasium import Space

__all__ = ["KeepLaneWithSpeed"]


class KeepLaneWithSpeed:
    """Keeps its lane at a constant speed, whatever is in front of it.

    Args:
        speed: in m/s.
        action_space: of the vehicle; with discrete meta-actions it answers IDLE, FASTER or SLOWER.

    Raises:
        ValueError: it has other actions.
    """

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
        """Nothing to forget."""

    def act(self, observation: Any) -> object:
        """Return (speed, 0), or the meta-action that brings the speed nearer."""
        if self._meta is None:
            return self.speed, 0
        error = self.speed - float(observation[0, 3])
        return self._meta["FASTER" if error > 2.5 else "SLOWER" if error < -2.5 else "IDLE"]
