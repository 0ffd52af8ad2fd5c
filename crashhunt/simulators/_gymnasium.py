"""Observations and actions of any Gymnasium space as arrays of a fixed shape, which recordings can hold."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from gymnasium import spaces

from crashhunt.base.errors import ActionError, ScenarioError
from crashhunt.simulators._actions import SpaceAction, cast, describe_action, is_masked

if TYPE_CHECKING:
    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.base.json_types import Plain
    from crashhunt.scenario import Scenario
    from crashhunt.simulators._protocol import ActionForm
    from crashhunt.trial import Value


__all__ = ["FlatAction", "ObservationForm", "action_form", "as_tables", "merge", "native", "reseed_in_place"]


_ARRAYS = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


class ObservationForm:
    """Converts the observations of an environment into arrays of a fixed shape.

    Args:
        space: The environment's observation space. Observations of a Dict or Tuple space are flattened.

    Raises:
        ScenarioError: The space has no fixed size.
    """

    def __init__(self, space: Space[object]) -> None:
        self.original = space
        self.flattened = not isinstance(space, _ARRAYS)
        if self.flattened and not space.is_np_flattenable:
            raise ScenarioError(
                f"observations of the space {space} have no fixed size", fix="wrap the environment so that they have"
            )
        self.space: Space[object] = spaces.flatten_space(space) if self.flattened else space
        self._dtype = np.dtype(self.space.dtype)

    def encode(self, observation: object) -> NDArray[np.generic]:
        """Return a new array with the type and shape of `space`."""
        if self.flattened:
            observation = spaces.flatten(self.original, observation)
        return np.array(observation, self._dtype).reshape(self.space.shape or ())


class FlatAction:
    """A Dict or Tuple action, which is recorded as a flat array.

    Args:
        space: The environment's action space.
    """

    names: tuple[str, ...] = ()

    def __init__(self, space: Space[object]) -> None:
        if not space.is_np_flattenable:
            raise ScenarioError(f"actions of the space {space} have no fixed size", fix="wrap the environment")
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
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # Gymnasium warns that it turns lists into arrays
                    inside = not _any_masked(action) and self.space.contains(action)
                    array = np.asarray(spaces.flatten(self.space, action)) if inside else array
        except Exception:  # reading the agent's object runs the agent's code, which may raise anything
            inside = False
        if not inside:
            raise ActionError(f"the action {describe_action(action)} is not in {self.space}", fix="return one that is")
        return array


def _any_masked(action: object) -> bool:
    parts = action.values() if isinstance(action, Mapping) else action if isinstance(action, list | tuple) else ()
    return is_masked(action) or any(map(_any_masked, parts))


def action_form(space: Space[object]) -> ActionForm:
    """Return the action form of a Gymnasium space."""
    return SpaceAction(space) if isinstance(space, _ARRAYS) else FlatAction(space)


def native(form: ActionForm, action: NDArray[np.generic]) -> object:
    """Return an encoded action in the form that the environment expects: a number, an array or a structure."""
    if isinstance(form, FlatAction):
        return spaces.unflatten(form.space, action)
    return action.item() if isinstance(form.space, spaces.Discrete) else np.array(action)


# Scenario arguments set entries in the configuration of an environment.


def as_tables(scenario: Scenario, arguments: Mapping[str, Value]) -> list[dict[str, object]]:
    """Return a table for each argument, with the entry that it sets; ``a.b`` sets the entry ``b`` of table ``a``."""
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

    Tables inside it are merged. A table whose ``type`` differs replaces the existing table.
    """
    for key, value in table.items():
        old = config.get(key)
        if isinstance(old, dict) and isinstance(value, dict) and value.get("type", old.get("type")) == old.get("type"):
            merge(old, value)
        else:
            config[key] = value


def reseed_in_place(generator: np.random.Generator | np.random.RandomState, seed: int) -> None:
    """Set a generator to the state of a new generator with this seed, for all objects that share the generator."""
    if isinstance(generator, np.random.RandomState):
        generator.seed(seed)
        return
    generator.bit_generator.state = type(generator.bit_generator)(seed).state
