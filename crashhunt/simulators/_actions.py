"""How actions are written: continuous, highway-env's meta-actions, and whatever a Gymnasium space allows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.errors import ActionError

if TYPE_CHECKING:
    from gymnasium import Space
    from numpy.typing import NDArray

__all__ = ["META_ACTIONS", "MetaAction", "SpaceAction", "SpeedAndLaneChange"]

MAX_TARGET_SPEED = 100.0
META_ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
"""In the order of highway-env's DiscreteMetaAction."""


class SpeedAndLaneChange:
    """``(target_speed, lane_change)``: m/s in [0, 100], and -1, 0 or 1 (1 is to the left); a tuple or an array."""

    names = ("target_speed", "lane_change")

    def __init__(self) -> None:
        from gymnasium import spaces

        speed = spaces.Box(0.0, MAX_TARGET_SPEED, (), np.float64)
        self.space: Space[Any] = spaces.Tuple((speed, spaces.Discrete(3, start=-1)))

    def encode(self, action: Any) -> NDArray[np.float64]:
        """Return float64, shape (2,)."""
        try:
            speed, lane_change = action
            # NaN fails both comparisons.
            if 0.0 <= speed <= MAX_TARGET_SPEED and lane_change in (-1, 0, 1):
                return np.array((speed, lane_change), np.float64)
        except (TypeError, ValueError, OverflowError):
            pass
        raise ActionError(
            f"the action {action!r} is not (target_speed, lane_change)",
            fix=f"return a speed within 0 and {MAX_TARGET_SPEED:g} m/s, and -1, 0 or 1",
        )


class SpaceAction:
    """Anything inside a Box or Discrete space."""

    names: tuple[str, ...] = ()

    def __init__(self, space: Space[Any]) -> None:
        self.space = space
        self._dtype = np.dtype(space.dtype)

    def encode(self, action: Any) -> NDArray[np.generic]:
        """Return an array of the space's type and shape."""
        try:
            given = np.asarray(action)
            # 1.7 is no discrete action, but 1.0 of a float64 policy is one of a float32 space.
            with np.errstate(over="ignore"):  # what becomes infinite is not inside
                array = given.astype(self._dtype) if np.can_cast(given.dtype, self._dtype, "same_kind") else given
            inside = array.dtype == self._dtype and self.space.contains(array if self.space.shape else array[()])
        except (TypeError, ValueError, OverflowError):
            inside = False
        if not inside:
            raise ActionError(f"the action {action!r} is not in {self.space}", fix="return one that is")
        return array


class MetaAction(SpaceAction):
    """highway-env's DiscreteMetaAction: 0 LANE_LEFT, 1 IDLE, 2 LANE_RIGHT, 3 FASTER, 4 SLOWER; or fewer of them.

    Args:
        meanings: what the numbers from 0 stand for; the space has them as ``meanings`` too, for agents to look up.
    """

    names = ("meta_action",)

    def __init__(self, meanings: tuple[str, ...] = META_ACTIONS) -> None:
        from gymnasium import spaces

        super().__init__(spaces.Discrete(len(meanings)))
        self.space.meanings = meanings  # type: ignore[attr-defined]

    def encode(self, action: Any) -> NDArray[np.generic]:
        """Return int64, shape (1,)."""
        if isinstance(action, np.ndarray) and action.size == 1:
            action = action.reshape(())
        return super().encode(action).reshape(1)
