"""How actions are written: continuous, highway-env's meta-actions, and whatever a Gymnasium space allows."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.errors import ActionError

if TYPE_CHECKING:
    from gymnasium import Space
    from numpy.typing import NDArray

__all__ = ["META_ACTIONS", "MetaAction", "SpaceAction", "SpeedAndLaneChange", "cast", "is_masked", "told"]

MAX_TARGET_SPEED = 100.0  # m/s; no vehicle is faster, and a space needs an end
_LONGEST = 200  # characters of an action in a message
META_ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
"""In the order of highway-env's DiscreteMetaAction."""


class SpeedAndLaneChange:
    """``(target_speed, lane_change)``: m/s in [0, 100], and -1, 0 or 1 (1 is to the left); a tuple or an array."""

    names = ("target_speed", "lane_change")

    def __init__(self) -> None:
        from gymnasium import spaces

        speed = spaces.Box(0.0, MAX_TARGET_SPEED, (), np.float64)
        self.space: Space[object] = spaces.Tuple((speed, spaces.Discrete(3, start=-1)))

    def encode(self, action: Any) -> NDArray[np.float64]:
        """Return float64, shape (2,)."""
        try:
            speed, lane_change = action
            # What most agents return, in every step.
            usual = action.__class__ is tuple and speed.__class__ is float and lane_change.__class__ is int
            if usual and 0.0 <= speed <= MAX_TARGET_SPEED and -1 <= lane_change <= 1:
                return np.array(action)
            # NaN fails both comparisons, as does what is masked. Of a dictionary it would be the keys.
            if (
                not isinstance(action, dict | set | frozenset)
                and 0.0 <= speed <= MAX_TARGET_SPEED
                and lane_change in (-1, 0, 1)
            ):
                array = np.array((speed, lane_change))
                if array.dtype.kind in "fiubO" and array.shape == (2,):  # complex numbers can be compared as well
                    return array.astype(np.float64, copy=False)
        except Exception:  # whatever it is that the agent returned, its comparisons are its own
            pass
        fix = f"return a speed within 0 and {MAX_TARGET_SPEED:g} m/s, and -1, 0 or 1"
        raise ActionError(f"the action {told(action)} is not (target_speed, lane_change)", fix=fix)


class SpaceAction:
    """Anything inside a Box or Discrete space.

    Numbers count by their value: True is 1, and 1.0 of a float64 policy is one of a float32 space. What would have to
    be changed to fit is refused: 1.7 or 1.0 for a whole number, 300 for eight bits, complex numbers, masked ones.
    """

    names: tuple[str, ...] = ()

    def __init__(self, space: Space[object]) -> None:
        self.space = space
        self._dtype = np.dtype(space.dtype)

    def encode(self, action: object) -> NDArray[np.generic]:
        """Return an array of the space's type and shape."""
        try:
            array = cast(action, self._dtype)
            inside = self.space.contains(array if self.space.shape else array[()])
        except Exception:  # whatever it is that the agent returned, turning it into an array runs its code
            inside = False
        if not inside:
            raise ActionError(f"the action {told(action)} is not in {self.space}", fix="return one that is")
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

    def encode(self, action: object) -> NDArray[np.generic]:
        """Return int64, shape (1,)."""
        if isinstance(action, np.ndarray) and action.size == 1:
            action = action.reshape(())
        return super().encode(action).reshape(1)


def cast(action: object, dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    """Return an action as an array of a type; an encoded one stays as it is.

    Raises:
        TypeError, ValueError: that would change it by more than rounding.
    """
    if is_masked(action):
        raise ValueError("a part of it is masked")
    given = np.asarray(action)
    if given.dtype == dtype:
        return given.copy()  # the agent may go on with its own
    with np.errstate(over="ignore"):  # what becomes infinite is refused below
        array = given.astype(dtype, casting="same_kind")
    # Whole numbers wrap around silently, and what is too large for a float becomes infinite.
    same = array == given if dtype.kind in "biu" else np.isfinite(array) == np.isfinite(given)
    if not np.all(same):
        raise ValueError("it does not fit")
    return array


def is_masked(action: object) -> bool:
    """Whether a part of an array is not there."""
    ma = sys.modules.get("numpy.ma")  # NumPy imports it for whoever asks; where nobody has, there is no such array
    return ma is not None and isinstance(action, ma.MaskedArray) and bool(ma.is_masked(action))


def told(action: object) -> str:
    """Return what an agent has returned as errors show it: one line of at most 200 characters."""
    try:
        text = " ".join(repr(action).split())
    except Exception as error:
        text = f"of class {type(action).__name__}, whose repr raises {type(error).__name__},"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
