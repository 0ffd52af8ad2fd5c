"""What the accelerator knows: versions of highway-env by their source, and classes by their methods."""

from __future__ import annotations

import hashlib
import inspect
import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import highway_env
import numpy as np
from highway_env import utils
from highway_env.envs.common import observation
from highway_env.road import lane, regulation, road
from highway_env.vehicle import behavior, controller, kinematics, objects

from crashhunt.simulators._versions import ACCELERATED

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["Kind", "kind_of", "reason_against", "replaced"]

_MODULES = (utils, observation, lane, regulation, road, behavior, controller, kinematics, objects)

_COLLIDES = ("handle_collisions", "_is_colliding", "polygon", "direction", "velocity", "lane_distance_to", "on_road")
_MOVES = ("step", "clip_actions", "on_state_update")
_DRIVES: tuple[str, ...] = ("act", "follow_road", "steering_control", "speed_control", "acceleration", "desired_gap")
_DRIVES += ("change_lane_policy", "mobil")
_PREDICTS = ("predict_trajectory_constant_speed",)
_DESCRIBES = ("to_dict",)
_BASES = {
    behavior.IDMVehicle: "idm",
    controller.MDPVehicle: "controlled",
    controller.ControlledVehicle: "controlled",
    kinematics.Vehicle: "nothing",
    objects.Obstacle: "",
    objects.Landmark: "",
    objects.RoadObject: "",
}
_ORIGINALS = {
    (owner, name): inspect.getattr_static(owner, name, None)
    for owner in _BASES
    for name in (*_COLLIDES, *_MOVES, *_DRIVES, *_PREDICTS, *_DESCRIBES)
}


replaced: dict[str, Any] = {}
"""The methods of highway-env that are replaced at the moment, by name; nothing where it is as it was."""


class Kind:
    """What is known about a class of vehicles or objects: what it leaves as its base in highway-env has it.

    Args:
        kind: the class.

    Attributes:
        collides: whether it collides as that does.
        moves: whether it moves so.
        times: whether it counts the time since it last thought of changing lanes.
        drives: how it decides: ``idm``, ``controlled``, ``nothing``; empty where that is not known.
        predicts: whether where it will be is foreseen so.
        describes: whether it describes itself so.
    """

    def __init__(self, kind: type) -> None:
        base = next(base for base in kind.__mro__ if base in _BASES)

        def leaves(names: tuple[str, ...]) -> bool:
            return all(inspect.getattr_static(kind, name, None) is _ORIGINALS[base, name] for name in names)

        moving = issubclass(kind, kinematics.Vehicle)
        self.collides = leaves(_COLLIDES)
        self.moves = moving and self.collides and leaves(_MOVES)
        self.times = base is behavior.IDMVehicle
        self.drives = _BASES[base] if self.collides and leaves(_DRIVES) else ""
        self.predicts = moving and leaves(_PREDICTS)
        self.describes = leaves(_DESCRIBES)
        if moving and not (self.moves and self.drives):
            own = [
                name for name in sorted(_ALL) if inspect.getattr_static(kind, name, None) is not _ORIGINALS[base, name]
            ]
            name = f"{kind.__module__}.{kind.__qualname__}"
            logging.getLogger("crashhunt").info("not accelerated: %s has its own %s", name, ", ".join(own))

    def is_of(self, thing: Any) -> bool:
        """Whether an object has no method of its own instead of its class's."""
        return _ALL.isdisjoint(vars(thing))


_ALL = frozenset((*_COLLIDES, *_MOVES, *_DRIVES, *_PREDICTS, *_DESCRIBES))


def kind_of(kind: type) -> Kind:
    """Return what is known about a class."""
    found = _kinds.get(kind)
    if found is None:
        found = _kinds[kind] = Kind(kind)
    return found


_kinds: dict[type, Kind] = {}


def reason_against() -> str:
    """Say why the accelerator must not be used in this process; empty where it may."""
    version = highway_env.__version__
    if version not in ACCELERATED:
        return f"highway-env {version} is not known to it; it knows {', '.join(ACCELERATED)}"
    digest = hashlib.blake2b(digest_size=8)
    for module in _MODULES:
        digest.update(Path(str(module.__file__)).read_bytes())
    if digest.hexdigest() != ACCELERATED[version]:
        return f"the installed highway-env {version} is not the published one"
    for name, function in _functions():
        place = getattr(getattr(function, "__code__", None), "co_filename", "something else")
        if place not in _FILES:
            return f"{name} has been replaced by {place}"
    if not hasattr(np, "vecdot"):
        return f"it needs NumPy 2.0, and {np.__version__} is installed"
    if not _arrays_equal_scalars():
        return "NumPy's functions give other results for arrays than for single numbers on this processor"
    return ""


_FILES = {str(module.__file__) for module in _MODULES}


def _functions() -> Iterator[tuple[str, Any]]:
    """All functions and methods that the sources of the modules define, by name, as they are now."""
    for module in _MODULES:
        source = Path(str(module.__file__)).read_text(encoding="utf-8")
        for kind, name in re.findall(r"^(def|class) (\w+)", source, re.MULTILINE):
            owner = getattr(module, name)
            members = vars(owner).items() if kind == "class" else [("", owner)]
            for member, found in members:
                function = getattr(found, "fget", None) or getattr(found, "__func__", found)
                if callable(function) and hasattr(function, "__module__") and not isinstance(function, type):
                    yield f"{name}.{member}".rstrip("."), inspect.unwrap(function)


def _arrays_equal_scalars() -> bool:
    """Whether the functions that are used on arrays give the very numbers that highway-env gets one at a time."""
    rng = np.random.default_rng(0)
    values, others = rng.normal(size=203) * 10.0 ** rng.integers(-6, 3, 203).astype(float), rng.uniform(3.5, 4.5, 203)
    inside = np.clip(values, -1.0, 1.0)
    for function in (np.cos, np.sin, np.tan, np.arctan, np.arcsin):
        if function(inside).tolist() != [function(value) for value in inside.tolist()]:
            return False
        if function is not np.arcsin and function(values).tolist() != [function(value) for value in values.tolist()]:
            return False
    if ((values + np.pi) % (2 * np.pi)).tolist() != [float((value + np.pi) % (2 * np.pi)) for value in values.tolist()]:
        return False
    bases = np.abs(values)
    powers = [np.power(base, exponent) for base, exponent in zip(bases.tolist(), others.tolist(), strict=True)]
    if np.power(bases, others).tolist() != powers:
        return False
    if np.power(values, 2).tolist() != [np.power(value, 2) for value in values.tolist()]:
        return False
    pairs, against = rng.normal(size=(203, 2)), rng.normal(size=(203, 2))
    products = [float(np.dot(one, two)) for one, two in zip(pairs, against, strict=True)]
    return bool(np.vecdot(pairs, against).tolist() == products)
