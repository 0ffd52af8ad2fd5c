"""Action forms: speed and lane change, highway-env's meta-actions, and any Box or Discrete space of Gymnasium."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.boundaries import Boundary, Party
from crashhunt.base.errors import ActionError
from crashhunt.base.scalars import describe_value, is_masked

if TYPE_CHECKING:
    from gymnasium import Space
    from numpy.typing import NDArray

MAX_TARGET_SPEED = 100.0  # m/s; a Box space needs a finite bound, and no road vehicle is faster
_ACTION_BOUNDARY = Boundary(Party.ENVIRONMENT, "action conversion")
META_ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
"""The meta-actions in the order of highway-env's DiscreteMetaAction."""


class SpeedAndLaneChange:
    """The action ``(target_speed, lane_change)``, as a tuple or an array.

    ``target_speed`` is in m/s, from 0 to 100. ``lane_change`` is -1 (right), 0 or 1 (left).
    """

    names = ("target_speed", "lane_change")

    def __init__(self) -> None:
        from gymnasium import spaces

        speed = spaces.Box(0.0, MAX_TARGET_SPEED, (), np.float64)
        self.space: Space[object] = spaces.Tuple((speed, spaces.Discrete(3, start=-1)))

    def encode(self, action: Any) -> NDArray[np.float64]:
        """Return the action as a float64 array of shape (2,)."""
        try:
            speed, lane_change = action
            # Most agents return this form in every step, so check it first.
            usual = action.__class__ is tuple and speed.__class__ is float and lane_change.__class__ is int
            if usual and 0.0 <= speed <= MAX_TARGET_SPEED and -1 <= lane_change <= 1:
                return np.array(action)
            # NaN and masked values fail both comparisons. Unpacking a dictionary would have returned its keys.
            if (
                not isinstance(action, dict | set | frozenset)
                and 0.0 <= speed <= MAX_TARGET_SPEED
                and lane_change in (-1, 0, 1)
            ):
                array = np.array((speed, lane_change))
                if array.dtype.kind in "fiubO" and array.shape == (2,):  # refuses complex numbers
                    return array.astype(np.float64, copy=False)
        except Exception:  # the agent's object may raise anything when it is compared
            pass
        fix = f"return a speed within 0 and {MAX_TARGET_SPEED:g} m/s, and -1, 0 or 1"
        raise ActionError(f"the action {describe_value(action)} is not (target_speed, lane_change)", fix=fix)


class SpaceAction:
    """An action inside a Box, Discrete, MultiDiscrete or MultiBinary space.

    Numbers count by their value: True is 1, and a float64 value is accepted by a float32 space. Values that the type of
    the space cannot hold are refused, such as a float for an integer, 300 for eight bits, complex and masked numbers.
    """

    names: tuple[str, ...] = ()

    def __init__(self, space: Space[object]) -> None:
        from gymnasium.spaces import Box

        self.space = space
        self._dtype = np.dtype(space.dtype)
        self._is_box = isinstance(space, Box)

    def encode(self, action: object) -> NDArray[np.generic]:
        """Return an array of the space's type and shape."""
        array: NDArray[np.generic] | None = None
        with suppress(Exception):  # converting the agent's object runs the agent's code, which may raise anything
            array = cast(action, self._dtype)
        if array is None or not self._contains(array):
            raise ActionError(
                f"the action {describe_value(action)} is not in {self.space}", fix="return an action in this space"
            )
        return array

    def _contains(self, array: NDArray[np.generic]) -> bool:
        # The array has no code of the agent's. So if the space fails, which may be a user's, it is the space's fault.
        try:
            return bool(self.space.contains(array if self.space.shape or self._is_box else array[()]))
        except BaseException as error:
            _ACTION_BOUNDARY.wrap(error)


class MetaAction(SpaceAction):
    """highway-env's DiscreteMetaAction: 0 LANE_LEFT, 1 IDLE, 2 LANE_RIGHT, 3 FASTER, 4 SLOWER; or some of these.

    Args:
        meanings: The name of each number, from 0. Agents find the names in the attribute ``meanings`` of the space.
    """

    names = ("meta_action",)

    def __init__(self, meanings: tuple[str, ...] = META_ACTIONS) -> None:
        from gymnasium import spaces

        super().__init__(spaces.Discrete(len(meanings)))
        self.space.meanings = meanings  # type: ignore[attr-defined]
        self._count = len(meanings)

    def encode(self, action: object) -> NDArray[np.generic]:
        """Return the action as an int64 array of shape (1,)."""
        # Most agents return an integer in every step, so check for an integer first.
        if (type(action) is int or type(action) is np.int64) and 0 <= action < self._count:
            return np.array((action,), np.int64)
        if isinstance(action, np.ndarray) and action.size == 1:
            action = action.reshape(())
        return super().encode(action).reshape(1)


def cast(action: object, dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    """Return an action as an array of the given type; an action that is already encoded does not change.

    Raises:
        TypeError, ValueError: The conversion would change the action by more than rounding.
    """
    if is_masked(action):
        raise ValueError("the action has masked elements, and these have no value")
    given = np.asarray(action)
    if given.dtype == dtype:
        return given.copy()  # the agent may change its own array afterwards
    with np.errstate(over="ignore"):  # the comparison below refuses values that became infinite
        array = given.astype(dtype, casting="same_kind")
    # Integers that are too large wrap around silently, and floats that are too large become infinite.
    same = array == given if dtype.kind in "biu" else np.isfinite(array) == np.isfinite(given)
    if not np.all(same):
        raise ValueError("the data type of the action space cannot represent the value")
    return array
