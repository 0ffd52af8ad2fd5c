"""Observations and actions of any Gymnasium space as arrays, which recordings can hold."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from gymnasium import Env, Space, Wrapper, spaces
from gymnasium.wrappers import TimeLimit

from crashhunt.base.errors import ActionError
from crashhunt.base.foreign_code import Boundary, Party, describe_value, is_masked
from crashhunt.recording import OPAQUE_SHAPE, decode_value, encode_value
from crashhunt.simulators._actions import SpaceAction, cast

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.base.json_types import Plain
    from crashhunt.scenario import Scenario
    from crashhunt.simulators._protocol import ActionForm


_ARRAY_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_MAX_ORIGINALS: Final = 256  # objects of a user's classes that may be needed again, because an agent sees them late
_OPAQUE_MARK: Final = b'{"opaque":'  # in the text of a value with a part that cannot be restored; texts escape quotes
_ABSENT: Final = type("_Absent", (), {"__repr__": lambda _: "absent"})()  # for a part that an observation lacks
_SPACE_BOUNDARY = Boundary(Party.ENVIRONMENT, "space conversion")
_ACTION_BOUNDARY = Boundary(Party.ENVIRONMENT, "action conversion")


class ObservationForm:
    """Converts the observations of an environment into arrays.

    An observation is recorded unchanged if its space is an array. Observations of a Dict or Tuple space of arrays are
    flattened, if flattening loses no information. Any other observation is recorded as the text of its value
    (`encode_value`).
    """

    def __init__(self, space: Space[Any]) -> None:
        self.original = space  # the environment's observation space
        self._values: _Values | None = None
        self.flattened = False
        self.space: Space[Any] = space  # the space of the arrays
        if not _is_array(space):
            self.flattened = _flattens_exactly(space)
            self.space = spaces.flatten_space(space) if self.flattened else OpaqueSpace(space)
            self._values = None if self.flattened else _Values()
        # whether agents receive another object than the array; call `restore` to get this object
        self.structured = self.space is not space
        self._dtype = np.dtype(self.space.dtype)

    def encode(self, observation: object) -> NDArray[np.generic]:
        """Return a new array with the type and shape of `space`.

        Raises:
            ForeignError: The environment's observation does not have the form of the environment's observation space.
        """
        if self._values is not None:
            return self._values.encode(observation)
        with _SPACE_BOUNDARY:  # the observation is the environment's, of any class
            if self.flattened:
                with _quiet():
                    observation = self._flat(observation)
            array = np.array(observation, self._dtype)
            shape = self.space.shape or ()
            return array if array.shape == shape else _reshaped(array, shape)

    def restore(self, array: NDArray[np.generic]) -> object:
        """Return the observation that the agent receives, from its array."""
        if self._values is not None:
            return self._values.restore(array)
        return spaces.unflatten(self.original, array) if self.flattened else array

    def contains(self, observation: object, array: NDArray[np.generic]) -> bool:
        """Return whether an observation lies inside the environment's observation space."""
        with _SPACE_BOUNDARY, _quiet():
            if self.structured:
                return bool(self.original.contains(observation))
            return bool(self.space.contains(array)) and _has_values_of(array, observation)

    def misfit(self, observation: object) -> str:
        """Return the place of the first part of an observation that lies outside its space, such as ``['image']``."""
        with _SPACE_BOUNDARY, _quiet():
            return _misfit(self.original, observation)[0]

    def _flat(self, observation: object) -> object:
        with suppress(KeyError, TypeError, ValueError, IndexError):  # of an observation without the form of the space
            flat = spaces.flatten(self.original, observation)
            # Outside the space, a number may become another one without an error: a Discrete -1 becomes the largest.
            if self.original.contains(observation) or _equal(spaces.unflatten(self.original, flat), observation):
                return flat
        path, space, part = _misfit(self.original, observation)
        form = f", of shape {part.shape}" if isinstance(part, np.ndarray) and part.shape != space.shape else ""
        raise ValueError(f"observation{path} does not have the form of {space}: it is {describe_value(part)}{form}")


def _misfit(space: Space[Any], value: Any, path: str = "") -> tuple[str, Space[Any], Any]:
    """Return place, space and value of the first part of a value that lies outside its space; the part may be absent.

    The place of the whole value is empty.
    """
    parts: Mapping[Any, Space[Any]] = {}
    if isinstance(space, spaces.Dict) and isinstance(value, Mapping):
        parts = space.spaces
    elif isinstance(space, spaces.Tuple) and isinstance(value, tuple | list) and len(value) == len(space.spaces):
        parts = dict(enumerate(space.spaces))
    for key, inner in parts.items():
        part = value[key] if isinstance(space, spaces.Tuple) or key in value else _ABSENT
        if part is _ABSENT or not inner.contains(part):
            return _misfit(inner, part, f"{path}[{key!r}]")
    return path, space, value


def _reshaped(array: NDArray[np.generic], shape: tuple[int, ...]) -> NDArray[np.generic]:
    """Return an array with another shape, if no axis is exchanged with another one.

    Raises:
        ValueError: the shapes differ by more than axes of length 1, and neither array has a single axis.
    """
    lengths = [[length for length in one if length != 1] for one in (array.shape, shape)]
    if array.size != math.prod(shape) or (lengths[0] != lengths[1] and min(map(len, lengths)) > 1):
        raise ValueError(f"the observation has the shape {array.shape}, and its space {shape}")
    return array.reshape(shape)


def _has_values_of(array: NDArray[np.generic], observation: Any) -> bool:
    """Return whether a converted observation has its values, except for the rounding of floats to fewer bits."""
    found = np.asarray(observation)
    is_exact = np.can_cast(found.dtype, array.dtype) or found.dtype.kind == array.dtype.kind == "f"
    return is_exact or np.array_equal(found.ravel(), array.ravel())


def has_nan(observation: object) -> bool:
    """Return whether an observation of any space contains NaN."""
    if isinstance(observation, Mapping):
        return any(map(has_nan, observation.values()))
    if isinstance(observation, list | tuple):
        return any(map(has_nan, observation))
    return isinstance(observation, float | np.ndarray | np.generic) and _is_nan(np.asarray(observation))


def _is_nan(array: NDArray[Any]) -> bool:
    return array.dtype.kind in "fc" and bool(np.isnan(array).any())


class OpaqueSpace(Space[Any]):
    """The space of recorded values: arrays of bytes of any length, each the text of a value of another space."""

    def __init__(self, original: Space[Any]) -> None:
        super().__init__(OPAQUE_SHAPE, np.uint8)
        self.original = original

    @property
    def is_np_flattenable(self) -> bool:
        """Return False, because the arrays have no fixed size."""
        return False

    def sample(self, *args: Any, **kwargs: Any) -> NDArray[np.uint8]:
        """Return the text of a sample of the original space."""
        return encode_value(self.original.sample(*args, **kwargs))

    def contains(self, x: Any) -> bool:
        """Return whether an array contains the text of a value of the space."""
        if not (isinstance(x, np.ndarray) and x.dtype == np.uint8 and x.ndim == 1):
            return False
        try:
            decode_value(x)
        except ValueError:
            return False
        return True

    def __repr__(self) -> str:
        return f"OpaqueSpace({self.original!r})"


class _Values:
    """Converts values of any class to arrays and back.

    A value that a recording cannot hold is restored as the object itself, in the process that has encoded it.
    """

    def __init__(self) -> None:
        self._originals: dict[bytes, object] = {}

    def encode(self, value: object) -> NDArray[np.generic]:
        """Return an array of bytes with the text of a value."""
        array = encode_value(value)
        text = array.tobytes()
        if _OPAQUE_MARK in text:
            self._originals.pop(text, None)
            self._originals[text] = value
            if len(self._originals) > _MAX_ORIGINALS:
                del self._originals[next(iter(self._originals))]
        return array

    def restore(self, array: NDArray[np.generic]) -> object:
        """Return the value that an array represents: a copy, or the object itself if the value cannot be restored."""
        text = array.tobytes()
        return self._originals[text] if text in self._originals else decode_value(array)[0]


@contextmanager
def _quiet() -> Iterator[None]:
    """Return a context without warnings, because Gymnasium warns whenever it converts lists and numbers to arrays."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _is_array(space: Space[Any]) -> bool:
    return isinstance(space, _ARRAY_SPACES) and _can_be_recorded(np.dtype(space.dtype))


def _can_be_recorded(dtype: np.dtype[Any]) -> bool:
    """Return whether logs can store arrays of a type without losing a bit."""
    return (dtype.kind == "f" and dtype.itemsize in (4, 8)) or dtype.kind in "ib" or dtype.str[1:] in ("u1", "u2", "u4")


def _leaves(space: Space[Any]) -> Iterator[Space[Any]]:
    """Yield the spaces inside Dict and Tuple spaces, and empty such spaces, which Gymnasium cannot flatten."""
    if isinstance(space, spaces.Dict | spaces.Tuple) and len(space.spaces):
        for part in space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces:
            yield from _leaves(part)
    else:
        yield space


def _flattens_exactly(space: Space[Any]) -> bool:
    """Return whether flattening and unflattening a value of a space loses no information."""
    leaves = list(_leaves(space))
    if isinstance(space, _ARRAY_SPACES) or not leaves or not all(isinstance(leaf, _ARRAY_SPACES) for leaf in leaves):
        return False
    dtype = np.dtype(spaces.flatten_space(space).dtype)
    return _can_be_recorded(dtype) and all(_fits(leaf, dtype) for leaf in leaves)


def _fits(leaf: Space[Any], dtype: np.dtype[Any]) -> bool:
    if not isinstance(leaf, spaces.Box):  # flattening makes zeros and ones of it
        return True
    if not np.can_cast(leaf.dtype, dtype, "safe"):
        return False
    if np.dtype(leaf.dtype).kind in "iu" and dtype.kind == "f":
        exact = 2 ** (np.finfo(dtype).nmant + 1)
        return bool(leaf.low.size == 0 or (leaf.low.min() >= -exact and leaf.high.max() <= exact))
    return True


def _equal(one: Any, other: Any) -> bool:
    """Return whether two structures contain equal numbers."""
    if isinstance(one, Mapping):
        return isinstance(other, Mapping) and all(key in other and _equal(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(_equal, one, other))
    left, right = np.asarray(one), np.asarray(other)
    return np.array_equal(left, right.astype(left.dtype), equal_nan=left.dtype.kind == "f")


class FlatAction:
    """A Dict or Tuple action, which is recorded as a flat array."""

    names: tuple[str, ...] = ()

    def __init__(self, space: Space[object]) -> None:
        self.space = space
        self._flat = spaces.flatten_space(space)

    def encode(self, action: object) -> NDArray[np.generic]:
        """Return the flattened action; an action that is already flattened does not change."""
        array: NDArray[np.generic] = np.empty(0)
        try:
            if isinstance(action, np.ndarray) and action.shape == self._flat.shape:
                array = cast(action, np.dtype(self._flat.dtype))
                structured = spaces.unflatten(self.space, array)
                # A one-hot part may have two ones. `unflatten` would silently use the first, so compare the way back.
                again = np.asarray(spaces.flatten(self.space, structured))
                inside = self.space.contains(structured) and np.allclose(again, array, rtol=1e-3, atol=1e-3)
            else:
                with _quiet():
                    inside = not _any_masked(action) and self.space.contains(action)
                    array = np.asarray(spaces.flatten(self.space, action)) if inside else array
        except Exception:  # reading the agent's object runs the agent's code, which may raise anything
            inside = False
        if not inside:
            raise ActionError(
                f"the action {describe_value(action)} is not in {self.space}", fix="return an action in this space"
            )
        return array


class OpaqueAction:
    """An action of a space without a fixed size, such as Text, Sequence or Graph, recorded as the text of its value."""

    names: tuple[str, ...] = ()
    encoded_shape = OPAQUE_SHAPE

    def __init__(self, space: Space[object]) -> None:
        self.space = space
        self._values = _Values()

    def encode(self, action: object) -> NDArray[np.generic]:
        """Return the text of the action; an action that is already encoded does not change."""
        array = self._values.encode(action)
        # The copy contains no code of the agent's. So if the space fails, it is the space's own fault.
        if self._contains(self._values.restore(array)):
            return array
        if OpaqueSpace(self.space).contains(action):
            given = np.array(action)
            if self._contains(self._values.restore(given)):
                return given
        raise ActionError(
            f"the action {describe_value(action)} is not in {self.space}", fix="return an action in this space"
        )

    def restore(self, array: NDArray[np.generic]) -> object:
        """Return the action that an array represents."""
        return self._values.restore(array)

    def _contains(self, action: object) -> bool:
        with _ACTION_BOUNDARY, _quiet():
            return bool(self.space.contains(action))


def _any_masked(action: object) -> bool:
    parts = action.values() if isinstance(action, Mapping) else action if isinstance(action, list | tuple) else ()
    return is_masked(action) or any(map(_any_masked, parts))


def action_form(space: Space[Any]) -> ActionForm:
    """Return the action form of a Gymnasium space."""
    if _is_array(space):
        return SpaceAction(space)
    return FlatAction(space) if _flattens_exactly(space) else OpaqueAction(space)


def native(form: ActionForm, action: NDArray[np.generic]) -> object:
    """Return an encoded action in the form that the environment expects: a number, an array or a nested structure."""
    if isinstance(form, OpaqueAction):
        return form.restore(action)
    if isinstance(form, FlatAction):
        return spaces.unflatten(form.space, action)
    return action.item() if isinstance(form.space, spaces.Discrete) else np.array(action)


# Action masks, as sb3-contrib (`action_masks`) and PettingZoo (`info["action_mask"]`) define them.

_MASK_METHOD: Final = "action_masks"
_MASK_KEY: Final = "action_mask"


def has_action_masks(env: Env[Any, Any], info: Mapping[str, Any]) -> bool:
    """Return whether an environment, one of its wrappers or its last info gives action masks."""
    return env.has_wrapper_attr(_MASK_METHOD) or info.get(_MASK_KEY) is not None


def action_mask_of(env: Env[Any, Any], info: Mapping[str, Any], space: Space[Any]) -> NDArray[np.bool_] | None:
    """Return which actions an environment allows now; None if it gives no masks.

    Args:
        env: The environment with its wrappers.
        info: The last info.
        space: The action space; the mask has one value per action, those of several discrete actions in a row.

    Raises:
        ValueError: The mask does not have the form of the action space.
    """
    if not has_action_masks(env, info):
        return None
    is_method = env.has_wrapper_attr(_MASK_METHOD)
    given = env.get_wrapper_attr(_MASK_METHOD)() if is_method else info[_MASK_KEY]
    parts = given if isinstance(given, tuple | list) else [given]
    mask = np.concatenate([np.ravel(part) for part in parts])
    size = _number_of_choices(space)
    if mask.dtype.kind not in "biuf" or mask.size != size:
        name = f"{_MASK_METHOD}()" if is_method else f"info[{_MASK_KEY!r}]"
        raise ValueError(f"{name} is {describe_value(given)}; it must have {size} values for actions in {space}")
    return mask.astype(bool)


def _number_of_choices(space: Space[Any]) -> int:
    if isinstance(space, spaces.MultiBinary):
        return 2 * int(np.prod(space.shape))
    if isinstance(space, spaces.MultiDiscrete):
        return int(space.nvec.sum())
    return int(space.n) if isinstance(space, spaces.Discrete) else 0


# Scenario arguments set entries in the configuration of an environment.


def as_tables(scenario: Scenario, arguments: Mapping[str, object]) -> list[dict[str, object]]:
    """Return the values of arguments as nested tables; the argument ``a.b`` sets the entry ``b`` of table ``a``."""
    tables = []
    for name, value in arguments.items():
        option = scenario.arguments[name].option or name if name in scenario.arguments else name
        *path, last = option.split(".")
        table: dict[str, object] = {last: value}
        for part in reversed(path):
            table = {part: table}
        tables.append(table)
    return tables


def merge(config: dict[str, object], table: Plain) -> None:
    """Write the entries of a table into a configuration.

    Nested tables are merged. A table whose ``type`` differs replaces the existing table.
    """
    for key, value in table.items():
        old = config.get(key)
        if isinstance(old, dict) and isinstance(value, dict) and value.get("type", old.get("type")) == old.get("type"):
            merge(old, value)
        else:
            config[key] = value


def reseed_in_place(generator: np.random.Generator | np.random.RandomState, seed: int) -> None:
    """Set a generator to the state of a new generator with the given seed, for all objects that share the generator."""
    if isinstance(generator, np.random.RandomState):
        generator.seed(seed)
        return
    generator.bit_generator.state = type(generator.bit_generator)(seed).state


def time_limit_of(env: Env[Any, Any]) -> int | None:
    """Return the number of steps after which a wrapper of an environment truncates its episodes; None without it."""
    limits = []
    while isinstance(env, Wrapper):
        if isinstance(env, TimeLimit):
            limits.append(env._max_episode_steps)
        env = env.env
    return min(limits, default=None)
