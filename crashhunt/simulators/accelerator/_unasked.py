"""Leaves out an environment's own observation where something else is shown, and nobody can tell."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Generic

import highway_env
from gymnasium import Env
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.observation import (
    ExitObservation,
    KinematicObservation,
    MultiAgentObservation,
    OccupancyGridObservation,
)
from highway_env.envs.parking_env import ParkingEnv

from crashhunt.simulators.accelerator._known import Own, kinds_of
from crashhunt.simulators.accelerator._roads import methods_of, watches

if TYPE_CHECKING:
    from highway_env.envs.common.observation import ObservationType

__all__ = ["Unasked"]

_LASTING_NOTHING = (KinematicObservation, ExitObservation, OccupancyGridObservation)
_HOMES = tuple(str(Path(file).parent) for file in (highway_env.__file__, __file__))  # one method is the accelerator's


class Unasked:
    """While this is entered, an environment observes nothing; it must be stepped there, and no more.

    It observes as ever where an observation lasts, such as one that draws random numbers, where the environment needs
    it, and where code of somebody's is asked for it: a class of environments or vehicles, a method that is replaced.

    Args:
        env: the environment, after its reset.
    """

    def __init__(self, env: AbstractEnv) -> None:
        self._env = env
        self._left_out: ObservationType | None = None

    def __enter__(self) -> None:
        seeing = self._env.observation_type
        if self._can_be_left_out(seeing):
            seeing.observe = _nothing
            self._left_out = seeing

    def __exit__(self, *_: object) -> None:
        if self._left_out is not None:
            del self._left_out.observe
            self._left_out = None

    def _can_be_left_out(self, seeing: ObservationType) -> bool:
        if not watches:
            return False
        eyes = seeing.agents_observation_types if type(seeing) is MultiAgentObservation else [seeing]
        if not all(map(_lasts_not, eyes)) or not all(_methods_of(eye).isdisjoint(vars(eye)) for eye in (seeing, *eyes)):
            return False
        road = self._env.road
        things = [*road.vehicles, *road.objects]
        return (
            _is_genuine(self._env)
            and all(watch.intact for watch in watches.values())
            and all(kind.describes and kind.is_of(thing) for kind, thing in zip(kinds_of(things), things, strict=True))
        )


def _nothing() -> None:
    """See nothing."""


def _lasts_not(eye: ObservationType) -> bool:
    """Whether an observation changes nothing but what it returns."""
    if type(eye) not in _LASTING_NOTHING:
        return False
    values = vars(eye)
    # The range of the features is chosen when it is first needed.
    settled = bool(values["features_range"]) or not values.get("normalize", True)
    return settled and values.get("order") != "shuffled"


class _Environments:
    """A class of environments, all of whose methods are highway-env's own, or not."""

    def __init__(self, kind: type[AbstractEnv]) -> None:
        self.own = Own(kind, AbstractEnv, ())
        self.methods = methods_of(kind)
        # A car park looks at what is shown to say who has arrived.
        self.genuine = not issubclass(kind, ParkingEnv) and all(
            base in (object, Env, Generic) or _is_own(base) for base in kind.__mro__
        )


def _is_own(kind: type) -> bool:
    """Whether a class is defined in highway-env, and so are all functions of its."""
    if not kind.__module__.startswith("highway_env."):
        return False
    functions = (getattr(found, "fget", None) or getattr(found, "__func__", found) for found in vars(kind).values())
    codes = (inspect.unwrap(function).__code__ for function in functions if inspect.isfunction(function))
    return all(code.co_filename.startswith(_HOMES) for code in codes)


_kinds: dict[type, _Environments] = {}
_methods: dict[type, frozenset[str]] = {}


def _is_genuine(env: AbstractEnv) -> bool:
    kind = type(env)
    found = _kinds.get(kind)
    if found is None or not found.own.current:
        found = _kinds[kind] = _Environments(kind)
    return found.genuine and found.methods.isdisjoint(vars(env))


def _methods_of(eye: ObservationType) -> frozenset[str]:
    kind = type(eye)
    if kind not in _methods:
        _methods[kind] = methods_of(kind)
    return _methods[kind]
