"""Action forms: a speed or an acceleration with a lane change, bounded numbers, meta-actions, and any simple space."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from crashhunt.base.errors import ActionError
from crashhunt.base.foreign_code import Boundary, Party, describe_value, is_masked
from crashhunt.scenario import ACTIONS

if TYPE_CHECKING:
    from collections.abc import Callable

    from gymnasium import Space
    from numpy.typing import NDArray

T = TypeVar("T")

MAX_TARGET_SPEED = 100.0  # m/s; a Box space needs a finite bound, and no road vehicle is faster
MAX_ACCELERATION = 10.0  # m/s²; no road vehicle brakes harder on dry asphalt
_ACTION_BOUNDARY = Boundary(Party.ENVIRONMENT, "action conversion")
META_ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
"""The meta-actions in the order of highway-env's DiscreteMetaAction."""


class SpeedAndLaneChange:
    """The action ``(target_speed, lane_change)``, as a tuple or an array.

    ``target_speed`` is in m/s, from 0 to 100. ``lane_change`` is -1 (right), 0 or 1 (left).
    """

    names = ACTIONS["speed_and_lane"].names
    _low, _high = 0.0, MAX_TARGET_SPEED
    _fix = f"return a speed within 0 and {MAX_TARGET_SPEED:g} m/s, and -1, 0 or 1"

    def __init__(self) -> None:
        from gymnasium import spaces

        value = spaces.Box(self._low, self._high, (), np.float64)
        self.space: Space[object] = spaces.Tuple((value, spaces.Discrete(3, start=-1)))

    def encode(self, action: Any) -> NDArray[np.float64]:
        """Return the action as a float64 array of shape (2,)."""
        found = _tried(self._encoded, action)
        if found is None:
            message = f"the action {describe_value(action)} is not ({', '.join(self.names)})"
            raise ActionError(message, fix=self._fix)
        return found

    def _encoded(self, action: Any) -> NDArray[np.float64] | None:
        value, lane_change = action
        # Most agents return this form in every step, so check it first.
        usual = action.__class__ is tuple and value.__class__ is float and lane_change.__class__ is int
        if usual and self._low <= value <= self._high and -1 <= lane_change <= 1:
            return np.array(action)
        # NaN and masked values fail both comparisons. Unpacking a dictionary would have returned its keys.
        if (
            not isinstance(action, dict | set | frozenset)
            and self._low <= value <= self._high
            and lane_change in (-1, 0, 1)
        ):
            array = np.array((value, lane_change))
            if array.dtype.kind in "fiubO" and array.shape == (2,):  # refuses complex numbers
                return array.astype(np.float64, copy=False)
        return None


class AccelerationAndLaneChange(SpeedAndLaneChange):
    """The action ``(acceleration, lane_change)``, as a tuple or an array.

    ``acceleration`` is in m/s², from -10 to 10. ``lane_change`` is -1 (right), 0 or 1 (left).
    """

    names = ACTIONS["acceleration"].names
    _low, _high = -MAX_ACCELERATION, MAX_ACCELERATION
    _fix = f"return an acceleration within -{MAX_ACCELERATION:g} and {MAX_ACCELERATION:g} m/s², and -1, 0 or 1"


class SimulatorDrives(SpeedAndLaneChange):
    """The action of an agent that leaves the driving to the simulator: None, or what the agent overrides.

    An override is ``(speed_override, lane_change_override)``, as a tuple or an array. A speed of -1 leaves the speed to
    the simulator, and a lane change of 0 leaves the lane to it.
    """

    names = ("speed_override", "lane_change_override")
    _low = -1.0
    _fix = f"return None, or a speed within 0 and {MAX_TARGET_SPEED:g} m/s (or -1), and -1, 0 or 1"

    def encode(self, action: Any) -> NDArray[np.float64]:
        """Return the action as a float64 array of shape (2,)."""
        encoded = super().encode((-1.0, 0) if action is None else action)
        if -1.0 < encoded[0] < 0.0:
            raise ActionError(f"the speed override {encoded[0]:g} is neither -1 nor a speed", fix=self._fix)
        return encoded


class NumbersAction:
    """An action of one number for each component of a form, as a tuple, a list or an array.

    Args:
        form: name of the form, as ``crashhunt list actions`` shows it.

    Attributes:
        check: function that raises an `ActionError` for an encoded action that the vehicle cannot follow; None if every
            action within the bounds is possible.
    """

    def __init__(self, form: str) -> None:
        from gymnasium import spaces

        self.check: Callable[[NDArray[np.float64]], None] | None = None

        described = ACTIONS[form]
        self._components, self.names, self._layout = described.components, described.names, described.layout
        low, high = np.transpose([(one.low, one.high) for one in self._components])
        self.space: Space[object] = spaces.Box(low, high, dtype=np.float64)
        self._count = len(self._components)
        self.encoded_type = "<f8", (self._count,)

    def encode(self, action: object) -> NDArray[np.float64]:
        """Return the action as a float64 array with one number for each component."""
        array = _tried(cast, action, np.dtype(np.float64))
        if array is None or array.shape != (self._count,):
            what = f"{describe_value(action)}{_form_of(action, array)}"
            raise ActionError(f"the action {what} is not {self._layout}", fix=f"return {self._count} numbers")
        for value, component in zip(array.tolist(), self._components, strict=True):
            if not component.low <= value <= component.high:  # NaN fails the comparison
                allowed = f"within {component.low:g} and {component.high:g} {component.unit}".rstrip()
                raise ActionError(
                    f"{component.name} is {value:g} in the action {self._layout}", fix=f"return it {allowed}"
                )
        found = array.astype(np.float64, copy=False)
        if self.check is not None:
            self.check(found)
        return found


MAX_POINTS = 64  # of a trajectory: each is in the recording of each step
_WIDTH = 5
TRAJECTORY_SHAPE = (MAX_POINTS, _WIDTH)
"""Shape of an encoded trajectory."""


class TrajectoryAction:
    """A trajectory of up to 64 points: an array of the shape (K, 5) with ``time x y heading speed``.

    Times are in s from the present step on, and rise. Positions and headings are those of the centre of the rectangle.
    An encoded trajectory always has 64 rows; the last point is repeated.

    Attributes:
        check: function that raises an `ActionError` for an encoded trajectory that the vehicle cannot follow; None if
            the simulator follows every trajectory.
    """

    names: tuple[str, ...] = ()
    encoded_type = "<f8", TRAJECTORY_SHAPE

    def __init__(self) -> None:
        from gymnasium import spaces

        description = ACTIONS["trajectory"]
        self._components = description.components
        low, high = np.transpose([(one.low, one.high) for one in self._components])
        points = np.ones((MAX_POINTS, 1))
        self.space: Space[object] = spaces.Box(low * points, high * points, dtype=np.float64)
        self.check: Callable[[NDArray[np.float64]], None] | None = None

    def encode(self, action: object) -> NDArray[np.float64]:
        """Return the trajectory as a float64 array of the shape (64, 5)."""
        array = _tried(cast, action, np.dtype(np.float64))
        if array is None or array.ndim != 2 or array.shape[1] != _WIDTH or not 0 < array.shape[0] <= MAX_POINTS:
            fix = f"return an array (K, {_WIDTH}) of time, x, y, heading and speed, with 1 to {MAX_POINTS} rows"
            message = f"the action {describe_value(action)}{_form_of(action, array)} is not a trajectory"
            raise ActionError(message, fix=fix)
        points = array.astype(np.float64, copy=False)
        for component, column in zip(self._components, points.T, strict=True):
            wrong = ~((component.low <= column) & (column <= component.high))  # NaN fails both comparisons
            if wrong.any():
                row = int(wrong.argmax())
                allowed = f"within {component.low:g} and {component.high:g} {component.unit}".rstrip()
                message = f"{component.name} of point {row} of the trajectory is {column[row]:g}"
                raise ActionError(message, fix=f"return it {allowed}")
        steps = np.diff(points[:, 0])
        padding = (points[1:] == points[-1]).all(axis=1)
        wrong = (steps <= 0) & ~(padding & (steps == 0))
        if wrong.any():
            row = int(wrong.argmax())
            message = (
                f"time of point {row + 1} of the trajectory is {points[row + 1, 0]:g} s, after {points[row, 0]:g} s"
            )
            raise ActionError(message, fix="return rising times, in s from the present step on")
        found = np.concatenate([points, np.repeat(points[-1:], MAX_POINTS - len(points), axis=0)])
        if self.check is not None:
            self.check(found)
        return found


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
        array = _tried(cast, action, self._dtype)
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


def _form_of(action: object, array: NDArray[np.generic] | None) -> str:
    """Return the shape of an action, in words; or its type, if it is an array that is not of numbers."""
    if array is not None:
        return f" of the shape {array.shape}"
    return f" of the type {action.dtype}" if isinstance(action, np.ndarray) else ""


def _tried(convert: Callable[..., T], *given: Any) -> T | None:
    """Return what a conversion of an action returns; None if the action cannot be converted.

    Raises:
        Exception: an exception that does not come again. It is not the action's, but for example that of a signal
            handler of the agent.
    """
    try:
        return convert(*given)
    except Exception:  # converting the agent's object runs the agent's code, which may raise anything
        try:
            convert(*given)
        except Exception:
            return None
        raise


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
