"""Whether highway-env's functions are still its own: a user's module may replace them at any time."""

from __future__ import annotations

import builtins
import inspect
import logging
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
from highway_env import utils
from highway_env.envs.common import observation
from highway_env.road import lane, regulation, road
from highway_env.vehicle import behavior, controller, dynamics, kinematics, objects

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from types import ModuleType

__all__ = ["MODULES", "Watch", "is_plain"]

MODULES = (utils, lane, regulation, road, behavior, controller, dynamics, kinematics, objects)
"""In which everything matters to the accelerator; of `observation`, a few classes do."""

_NUMPY = (
    "abs", "arange", "arccos", "arcsin", "arctan", "arctan2", "argmin", "array", "array_equal", "clip", "concatenate",
    "cos", "diff", "dot", "linalg", "max", "min", "power", "sign", "sin", "sqrt", "sum", "tan", "tile", "vstack",
    "zeros",
)  # fmt: skip


class Watch:
    """Notices whatever is replaced, added or removed, but for numbers: these are read where they are used.

    Looking costs about ten microseconds, so that it can be done in every sub-step.

    Args:
        places: namespaces by how messages name them.
        but: members that do not matter, as ``Class.name``.
    """

    def __init__(self, places: Iterable[tuple[str, Mapping[str, object]]], but: Iterable[str] = ()) -> None:
        skipped = frozenset(but)
        self._places: list[_Place] = [_Place(name, space, skipped) for name, space in places]
        self._told = ""

    @classmethod
    def of_roads(cls, but: Iterable[str]) -> Watch:
        """Watch all that roads, lanes and vehicles are made of, and what of NumPy they use."""
        places = [(module.__name__, vars(module)) for module in MODULES]
        for module in MODULES:
            places += _classes(module)
        numpy = {name: getattr(np, name) for name in _NUMPY}
        watch = cls(places, but)
        watch._places.append(_Place("numpy", vars(np), frozenset(), tuple(numpy)))
        watch._places.append(_Place("numpy.linalg", vars(np.linalg), frozenset(), ("norm",)))
        return watch

    @classmethod
    def of_observations(cls, but: Iterable[str]) -> Watch:
        """Watch what the observations that are sped up are made of."""
        kinds = ("", "Kinematic", "KinematicsGoal", "OccupancyGrid", "Exit", "MultiAgent")
        wanted = ("ObservationType", *[f"{kind}Observation" for kind in kinds])
        places = [(name, space) for name, space in _classes(observation) if name in wanted]
        return cls([(observation.__name__, vars(observation)), *places], but)

    @property
    def intact(self) -> bool:
        """Whether all is as it was; where it is not, that is logged once."""
        for place in self._places:
            if len(place.space) != place.size or not place.same():
                changed = place.changed()
                if changed:
                    if changed != self._told:
                        self._told = changed
                        message = "the accelerator steps aside: %s has been replaced"
                        logging.getLogger("crashhunt").warning(message, changed)
                    return False
        return True

    @property
    def reason(self) -> str:
        """What has been replaced; empty where all is as it was."""
        return f"{self._told} has been replaced" if not self.intact else ""


class _Place:
    """One namespace."""

    def __init__(
        self, name: str, space: Mapping[str, object], but: frozenset[str], names: tuple[str, ...] | None = None
    ) -> None:
        self.name = name
        self.space = space
        self.size = len(space)
        if names is None:
            names = tuple(
                key
                for key, value in space.items()
                if f"{name}.{key}" not in but and not _special(key) and not is_plain(value)
            )
            self._seen = frozenset(space)
            self._but = frozenset(key for key in space if f"{name}.{key}" in but)
        else:  # of a namespace that is large and others' business, only these
            self._seen = self._but = frozenset(space)
        self._names = names
        self._get: Callable[[Mapping[str, object]], tuple[object, ...]] = _getter(names)
        self._values = self._get(space)

    def same(self) -> bool:
        try:
            # Tuples compare what is not the very same by its own `==`: nobody's function is equal to another.
            return self._get(self.space) == self._values
        except Exception:
            return False

    def changed(self) -> str:
        """The first name that matters and is not what it was."""
        missing = object()
        for name, value in zip(self._names, self._values, strict=True):
            if self.space.get(name, missing) is not value:
                return f"{self.name}.{name}"
        if self._but is not self._seen:
            for name in self.space.keys() - self._seen - self._but:
                # A name that is new may be in the way of one further up, or of one that Python has.
                if not is_plain(self.space[name]) or hasattr(builtins, name) or _is_method(self.name, name):
                    return f"{self.name}.{name}"
        self.size = len(self.space)
        return ""


def is_plain(value: object) -> bool:
    """Whether a member of a class is a mere value: no function, property or other thing with a life of its own."""
    return not callable(value) and not hasattr(type(value), "__get__") and not inspect.ismodule(value)


def _special(name: str) -> bool:
    return name in ("__doc__", "__builtins__", "__dict__", "__weakref__", "_abc_impl", "__warningregistry__")


def _getter(names: tuple[str, ...]) -> Callable[[Mapping[str, object]], tuple[object, ...]]:
    if len(names) > 1:
        return itemgetter(*names)
    return lambda space: tuple([space[name] for name in names])


def _classes(module: ModuleType) -> list[tuple[str, Mapping[str, object]]]:
    found = [value for value in vars(module).values() if isinstance(value, type)]
    return [(kind.__qualname__, vars(kind)) for kind in found if kind.__module__ == module.__name__]


def _is_method(owner: str, name: str) -> bool:
    """Whether a class has a method of that name further up, which a value would hide."""
    kinds = [kind for module in (*MODULES, observation) for key, kind in vars(module).items() if key == owner]
    return any(not is_plain(inspect.getattr_static(base, name)) for kind in kinds if isinstance(kind, type)
               for base in kind.__mro__[1:] if name in vars(base))  # fmt: skip
