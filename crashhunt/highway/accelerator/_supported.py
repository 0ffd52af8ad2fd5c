"""Checks that the accelerator applies: known versions of highway-env, genuine functions, and known classes."""

from __future__ import annotations

import builtins
import functools
import hashlib
import inspect
import logging
import re
from abc import ABC
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import highway_env
import numpy as np
from highway_env import utils
from highway_env.envs import highway_env as highways
from highway_env.envs.common import abstract, action, finite_mdp, observation
from highway_env.road import lane, regulation, road
from highway_env.vehicle import behavior, controller, dynamics, kinematics, objects

from crashhunt.highway.accelerator._kernel import Contents, kernel, why_not
from crashhunt.highway.accelerator._known_versions import ACCELERATED, reason_against_version

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from types import ModuleType

    Space = dict[str, Any] | type  # the dictionary of a module, or a class


# Detects replaced functions of highway-env, which a user's module may replace at any time.

MODULES = (utils, lane, regulation, road, behavior, controller, dynamics, kinematics, objects)
"""The modules in which every function matters to the accelerator; of `observation`, only a few classes matter."""

_NUMPY = (
    "abs", "arange", "arccos", "arcsin", "arctan", "arctan2", "argmin", "array", "array_equal", "clip", "concatenate",
    "cos", "diff", "dot", "linalg", "max", "min", "power", "sign", "sin", "sqrt", "sum", "tan", "tile", "vstack",
    "zeros",
)  # fmt: skip


class Watch:
    """Detects replaced, added and removed members of namespaces. Numbers are exempt, because they are read at each use.

    A check costs a few microseconds, so it can run in every sub-step.

    Args:
        places: Namespaces, that is, dictionaries of modules or classes, with their names for messages.
        but: Members that are not watched, as ``Class.name``.
    """

    def __init__(self, places: Iterable[tuple[str, Space]], but: Iterable[str] = ()) -> None:
        skipped = frozenset(but)
        self._places: list[_Place] = [_Place(name, owner, skipped) for name, owner in places]
        self._changed: _Place | None = None
        self._reported = ""
        self._contents: Contents | None = None

    @classmethod
    def of_roads(cls, but: Iterable[str]) -> Watch:
        """Return a watch of roads, lanes and vehicles, and of the functions of NumPy that they use."""
        places: list[tuple[str, Space]] = [(module.__name__, vars(module)) for module in MODULES]
        for module in MODULES:
            places += _classes(module)
        numpy = {name: getattr(np, name) for name in _NUMPY}
        watch = cls(places, but)
        watch._places.append(_Place("numpy", vars(np), frozenset(), tuple(numpy)))
        watch._places.append(_Place("numpy.linalg", vars(np.linalg), frozenset(), ("norm",)))
        return watch

    @classmethod
    def of_observations(cls, but: Iterable[str]) -> Watch:
        """Return a watch of the classes of the accelerated observations."""
        kinds = ("", "Kinematic", "KinematicsGoal", "OccupancyGrid", "Exit", "MultiAgent")
        wanted = ("ObservationType", *[f"{kind}Observation" for kind in kinds])
        places: list[tuple[str, Space]] = [(module.__name__, vars(module)) for module in (observation, finite_mdp)]
        return cls([*places, *(place for place in _classes(observation) if place[0] in wanted)], but)

    @property
    def intact(self) -> bool:
        """Return whether no member has changed; each changed member is logged once."""
        if self._contents is not None and self._contents.is_same():
            return True
        contents = contents_of(
            [place.container for place in self._places]
        )  # another thread may change them from here on
        suspects = [self._changed] if self._changed is not None and self._changed.changed() else self._places
        self._changed = next((place for place in suspects if place.changed()), None)
        if self._changed is None:
            self._contents = contents  # a changed or new member that does not matter
            return True
        changed = self._changed.changed()
        if changed != self._reported:
            self._reported = changed
            logging.getLogger("crashhunt").warning("the accelerator is disabled: %s has been replaced", changed)
        return False

    @property
    def reason(self) -> str:
        """A sentence about a replaced member; empty if no member has changed."""
        return f"{self._reported} has been replaced" if not self.intact else ""


class _Place:
    """A namespace with the members that it had at the start."""

    def __init__(self, name: str, owner: Space, but: frozenset[str], names: tuple[str, ...] | None = None) -> None:
        self.name = name
        self.space: Mapping[str, object] = vars(owner) if isinstance(owner, type) else owner
        space = self.space
        if names is None:
            names = tuple(
                key
                for key, value in space.items()
                if f"{name}.{key}" not in but and not _special(key) and not is_plain(value)
            )
            self._seen = frozenset(space)
            self._but = frozenset(key for key in space if f"{name}.{key}" in but)
            self.container: object = owner
        else:  # of a large foreign namespace such as NumPy's, watch only these names
            self._seen = self._but = frozenset(space)
            self.container = (space, *names)
        #: the watched members
        self.members = {key: space[key] for key in names}

    def changed(self) -> str:
        """Return the first changed name that is watched; empty if there is none."""
        missing = object()
        for name, value in self.members.items():
            if self.space.get(name, missing) is not value:
                return f"{self.name}.{name}"
        if self._but is not self._seen:
            for name in self.space.keys() - self._seen - self._but:
                # A new name may hide a method of a base class or a built-in function.
                if not is_plain(self.space[name]) or hasattr(builtins, name) or _is_method(self.name, name):
                    return f"{self.name}.{name}"
        return ""


def is_plain(value: object) -> bool:
    """Return whether a member of a class is a plain value: not a function, property, other descriptor or module."""
    return not callable(value) and not hasattr(type(value), "__get__") and not inspect.ismodule(value)


def _special(name: str) -> bool:
    return name in ("__doc__", "__builtins__", "__dict__", "__weakref__", "_abc_impl", "__warningregistry__")


def contents_of(containers: Iterable[object]) -> Contents:
    """Return the contents of namespaces and other containers in the kernel, which finds changes in microseconds."""
    module = kernel()
    assert module is not None
    return module.Contents(list(containers))


def _classes(module: ModuleType) -> list[tuple[str, type]]:
    found = [value for value in vars(module).values() if isinstance(value, type)]
    return [(kind.__qualname__, kind) for kind in found if kind.__module__ == module.__name__]


def _is_method(owner: str, name: str) -> bool:
    """Return whether a base class has a method with this name, which a value of the class would hide."""
    kinds = [kind for module in (*MODULES, observation) for key, kind in vars(module).items() if key == owner]
    return any(not is_plain(inspect.getattr_static(base, name)) for kind in kinds if isinstance(kind, type)
               for base in kind.__mro__[1:] if name in vars(base))  # fmt: skip


_MODULES = (*MODULES, observation)
_SOURCES = (*_MODULES, abstract, finite_mdp, action, highways)  # of the last four, only a few functions matter

_COLLISION_METHODS = (
    "handle_collisions",
    "_is_colliding",
    "polygon",
    "direction",
    "velocity",
    "lane_distance_to",
    "on_road",
)
_MOVEMENT_METHODS = ("step", "clip_actions", "on_state_update")
_DRIVING_METHODS: tuple[str, ...] = (
    "act",
    "follow_road",
    "steering_control",
    "speed_control",
    "acceleration",
    "desired_gap",
)
_DRIVING_METHODS += (
    "change_lane_policy",
    "mobil",
    "collect_data",
    "add_features",
    "acceleration_features",
    "steering_features",
)
_DYNAMICS_METHODS = ("state", "derivative_func")
_PREDICTION_METHODS = ("predict_trajectory_constant_speed",)
_DESCRIPTION_METHODS = ("to_dict", "destination", "destination_direction", "lane_offset")
_SPECIAL = (
    "__bool__", "__len__", "__eq__", "__ne__", "__lt__", "__hash__", "__getattribute__", "__getattr__", "__setattr__",
    "__delattr__", "__copy__", "__deepcopy__", "__reduce__", "__reduce_ex__", "__getstate__", "__setstate__",
    "__class__", "__array__", "__float__", "__iter__", "__getitem__", "__contains__", "__add__", "__radd__",
)  # fmt: skip
"""A class that overrides one of these may run arbitrary code wherever highway-env uses an object of it."""
_VALUES = (
    "road", "position", "heading", "speed", "lane_index", "lane", "collidable", "solid", "check_collisions", "diagonal",
    "crashed", "hit", "impact", "prediction_type", "action", "history", "target_lane_index", "target_speed", "route",
    "timer", "enable_lane_change", "speed_index", "target_speeds", "is_yielding", "yield_timer", "color", "log", "data",
    "collecting_data", "lateral_speed", "yaw_rate", "ACCELERATION_PARAMETERS", "STEERING_PARAMETERS",
)  # fmt: skip
"""Attributes of vehicles that must be plain values, so that the accelerator may read them any number of times."""
_BASES = {
    behavior.LinearVehicle: "linear",
    behavior.IDMVehicle: "idm",
    controller.MDPVehicle: "controlled",
    controller.ControlledVehicle: "controlled",
    dynamics.BicycleVehicle: "nothing",
    kinematics.Vehicle: "nothing",
    objects.Obstacle: "",
    objects.Landmark: "",
    objects.RoadObject: "",
}
_OUTLINE_CONSTANTS: tuple[str, ...] = ("LENGTH", "WIDTH")
_LIMIT_CONSTANTS = (*_OUTLINE_CONSTANTS, "MAX_SPEED", "MIN_SPEED")
_STEERING_CONSTANTS = (*_LIMIT_CONSTANTS, "TAU_PURSUIT", "KP_LATERAL", "KP_HEADING", "MAX_STEERING_ANGLE", "KP_A")
_IDM_CONSTANTS = (
    *_STEERING_CONSTANTS,
    "COMFORT_ACC_MAX",
    "COMFORT_ACC_MIN",
    "DISTANCE_WANTED",
    "TIME_WANTED",
    "ACC_MAX",
    "POLITENESS",
)
_IDM_CONSTANTS += ("LANE_CHANGE_DELAY", "LANE_CHANGE_MIN_ACC_GAIN", "LANE_CHANGE_MAX_BRAKING_IMPOSED")
NUMBERS_OF = {
    "": _OUTLINE_CONSTANTS,
    "nothing": _LIMIT_CONSTANTS,
    "controlled": _STEERING_CONSTANTS,
    "idm": _IDM_CONSTANTS,
    "linear": _IDM_CONSTANTS,
}
"""Class attributes with the parameters of vehicles, by model of decision; a vehicle may override them."""
_METHODS = frozenset(
    (
        *_COLLISION_METHODS,
        *_MOVEMENT_METHODS,
        *_DYNAMICS_METHODS,
        *_DRIVING_METHODS,
        *_PREDICTION_METHODS,
        *_DESCRIPTION_METHODS,
    )
)
_ORIGINALS = {
    (owner, name): inspect.getattr_static(owner, name, None)
    for owner in _BASES
    for name in (*_METHODS, *_SPECIAL, "index_to_speed")
}
# By identity, because a class that a user makes with ``type(name, bases, members)`` has the module name `abc`.
_CLASSES_WATCHED = frozenset(id(kind) for module in MODULES for _, kind in _classes(module)) | {id(ABC), id(object)}

originals: dict[str, Callable[..., Any]] = {}
"""The replaced methods of highway-env by ``Class.name``; empty until the accelerator is first switched on."""


class Own:
    """The members of a user's class that override members of its base class in highway-env.

    Args:
        kind: The class.
        base: The class in highway-env from which it is derived.
        values: Names of members that must be plain values.
    """

    def __init__(self, kind: type, base: type, values: Iterable[str]) -> None:
        self._kind, self._base = kind, base
        self._mro = kind.__mro__
        # The members that a user can change later; `Watch` covers highway-env's own classes.
        parts = [part for part in self._mro if id(part) not in _CLASSES_WATCHED]
        self._contents = contents_of(parts)
        values = {*values, *(name for name in dir(base) if is_plain(inspect.getattr_static(base, name)))}
        self.names = [name for name in _SPECIAL if self.has(name)]
        self.names += [name for name in sorted(values) if name[:2] != "__" and not is_plain(self._member(name))]
        self.plain = type(kind) is type(base) and not self.names

    def has(self, name: str) -> bool:
        """Return whether the class overrides this member of its base class."""
        return self._member(name) is not inspect.getattr_static(self._base, name, None)

    def _member(self, name: str) -> object:
        return inspect.getattr_static(self._kind, name, None)

    @property
    def current(self) -> bool:
        """Return whether the class has not changed since this object was created."""
        return self._kind.__mro__ is self._mro and self._contents.is_same()


class VehicleClass:
    """The behaviour that a class of vehicles or objects inherits unchanged from its base class in highway-env.

    Attributes:
        plain: Whether all attributes that the accelerator reads are plain values.
        collides: Whether the collision check is inherited.
        moves: Whether the movement is inherited.
        slides: Whether the class uses the dynamic bicycle model, which highway-env's own code computes.
        times: Whether the vehicles of the class count the time since their last lane-change decision.
        drives: The inherited decision model: ``idm``, ``linear``, ``controlled`` or ``nothing``; empty if it is not
            inherited.
        predicts: Whether the prediction of trajectories is inherited.
        describes: Whether ``to_dict`` and the methods that it calls are inherited.
        chooses: Whether the choice between target speeds is inherited.
        base: The decision model of the base class.
        methods: Names of methods, which an object of the class must not override.
        fixed: The names of these methods, and of the parameters that objects of the class usually share.
    """

    def __init__(self, kind: type) -> None:
        base = next((base for base in kind.__mro__ if base in _BASES), None)
        self.own = Own(kind, base or kind, _VALUES)
        self.plain = base is not None and self.own.plain

        def leaves(names: tuple[str, ...]) -> bool:
            return self.plain and all(
                inspect.getattr_static(kind, name, None) is _ORIGINALS[base, name] for name in names
            )

        moving = issubclass(kind, kinematics.Vehicle)
        self.collides = leaves(_COLLISION_METHODS)
        self.slides = base is dynamics.BicycleVehicle
        self.moves = (
            moving and self.collides and leaves((*_MOVEMENT_METHODS, *(_DYNAMICS_METHODS if self.slides else ())))
        )
        self.times = base in (behavior.IDMVehicle, behavior.LinearVehicle)
        self.drives = _BASES[base] if base is not None and self.collides and leaves(_DRIVING_METHODS) else ""
        self.predicts = self.moves and leaves((*_PREDICTION_METHODS, *_DRIVING_METHODS))
        self.describes = self.collides and leaves(_DESCRIPTION_METHODS)
        self.chooses = self.collides and issubclass(kind, controller.MDPVehicle) and leaves(("index_to_speed",))
        self.base = _BASES[base] if base is not None else ""
        self.methods = frozenset(name for name in dir(kind) if not is_plain(inspect.getattr_static(kind, name, None)))
        self.fixed = self.methods | frozenset(NUMBERS_OF[self.base])
        if moving and not (self.moves and self.drives):
            own = self.own.names + [
                name for name in sorted(_METHODS)
                if base is not None and inspect.getattr_static(kind, name, None) is not _ORIGINALS[base, name]
            ]  # fmt: skip
            name = f"{kind.__module__}.{kind.__qualname__}"
            if left_alone.get(name) != own:
                left_alone[name] = own
                logging.getLogger("crashhunt").info("not accelerated: %s has its own %s", name, ", ".join(own))

    def is_of(self, thing: object) -> bool:
        """Return whether an object overrides no method of its class."""
        return self.methods.isdisjoint(vars(thing))


left_alone: dict[str, list[str]] = {}
"""Classes that are not accelerated, or only in part, each with the members that it overrides."""


def kind_of(kind: type) -> VehicleClass:
    """Return the properties of a class in its current state."""
    found = _kinds.get(kind)
    if found is None or not found.own.current:
        found = _kinds[kind] = VehicleClass(kind)
    return found


def kinds_of(things: Iterable[object]) -> list[VehicleClass]:
    """Return the properties of the class of each object."""
    types = list(map(type, things))
    known = {kind: kind_of(kind) for kind in set(types)}
    return list(map(known.__getitem__, types))


_kinds: dict[type, VehicleClass] = {}


def are_numbers(values: Iterable[object]) -> bool:
    """Return whether all values are exactly of the types float, int or NumPy's float64, not of a subclass."""
    return _NUMBERS.issuperset(map(type, values))


_NUMBERS = frozenset((float, int, np.float64))


def reason_against() -> str:
    """Return why the accelerator must not be used in this process; empty if it may be used."""
    version = highway_env.__version__
    if reason := reason_against_version(version):
        return reason
    if installed_digest() != ACCELERATED[version]:
        return f"the installed highway-env {version} is not the published one"
    for name, function in _functions():
        place = getattr(getattr(function, "__code__", None), "co_filename", "something else")
        if place not in _FILES:
            return f"{name} has been replaced by {place}"
        if function.__qualname__ != name:  # such as another method of highway-env
            return f"{name} has been replaced by {function.__qualname__}"
    return f"the compiled kernel is not used: {why_not()}" if kernel() is None else ""


@functools.cache
def installed_digest() -> str:
    """Return the digest of the modules of the installed highway-env in which the accelerator replaces something."""
    digest = hashlib.blake2b(digest_size=8)
    for module in _SOURCES:
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()


_FILES = {str(module.__file__) for module in _SOURCES}


def is_genuine(name: str, function: Callable[..., object]) -> bool:
    """Return whether a function comes from highway-env's source and has the given name, such as ``Class.method``."""
    place = getattr(getattr(function, "__code__", None), "co_filename", "")
    return place in _FILES and function.__qualname__ == name


def _without_context_manager(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function that `contextlib.contextmanager` wraps, as highway-env does; otherwise the function itself.

    A user's wrapper is not removed, because `functools.wraps` gives it the name of highway-env's function.
    """
    wraps = getattr(function, "__code__", None) is _CONTEXT_MANAGER_CODE
    found: Callable[..., Any] = getattr(function, "__wrapped__", function) if wraps else function
    return found


_CONTEXT_MANAGER_CODE = contextmanager(lambda: iter(())).__code__


def _functions() -> Iterator[tuple[str, Callable[..., object]]]:
    """Yield the current functions and methods of all classes and functions that the modules define, with names."""
    for module, kind, name in _definitions():
        owner = getattr(module, name)
        members = vars(owner).items() if kind == "class" else [("", owner)]
        for member, found in members:
            function = getattr(found, "fget", None) or getattr(found, "__func__", found)
            if callable(function) and hasattr(function, "__module__") and not isinstance(function, type):
                yield f"{name}.{member}".rstrip("."), _without_context_manager(function)


@functools.cache  # the source of a module that has been imported is read once
def _definitions() -> list[tuple[ModuleType, str, str]]:
    """Return the classes and functions that the source of each module defines: module, ``def`` or ``class``, name."""
    found = []
    for module in _MODULES:
        source = Path(str(module.__file__)).read_text(encoding="utf-8")
        found += [(module, kind, name) for kind, name in re.findall(r"^(def|class) (\w+)", source, re.MULTILINE)]
    return found
