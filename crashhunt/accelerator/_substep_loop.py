"""An environment's sub-steps, in which nobody is looked at again for as long as nobody else's code can have run."""

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
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from crashhunt.accelerator._roads import methods_of, prepared, watches
from crashhunt.accelerator._versions import Own, is_genuine, kinds_of, originals

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from highway_env.envs.common.observation import ObservationType


__all__ = ["Onlooker", "Unasked", "can_run_alone", "simulate"]


# Somebody who looks on while a road moves on, and says when he does more than that.


class Onlooker:
    """Stands on a road in the place of its ``step``. What has been computed for a road holds while he only looks.

    Meanwhile headings may be Python's floats, which are NumPy's after a step of the environment.

    Args:
        advance: the road's own ``step``.
        before: called before it, with how long the sub-step is (s).
        after: called after it.
        interferes: whether these two may change anything about the road, as it is asked before and after each
            sub-step; never, if that is not said.
    """

    def __init__(
        self,
        advance: Callable[[float], None],
        *,
        before: Callable[[float], None] | None = None,
        after: Callable[[], None] | None = None,
        interferes: Callable[[], bool] = bool,
    ) -> None:
        self._advance = advance
        self._before = before
        self._after = after
        self.interferes = interferes

    def __deepcopy__(self, memo: dict[int, object]) -> Onlooker:
        """Stay the same on a copy of the road, as a function does."""
        return self

    def __call__(self, dt: float) -> None:
        """Move the road on."""
        if self._before is not None:
            self._before(dt)
        self._advance(dt)
        if self._after is not None:
            self._after()


_CALLED = ("_simulate", "_automatic_rendering")
_READ = ("steps", "config", "viewer", "enable_auto_render", "road", "action_type")
_kinds: dict[type, Own] = {}


def can_run_alone() -> bool:
    """Whether what highway-env calls between sub-steps is its own; remembers it."""
    found = {f"AbstractEnv.{name}": getattr(AbstractEnv, name) for name in _CALLED}
    originals.update(found)
    return all(is_genuine(name, function) for name, function in found.items())


def simulate(env: AbstractEnv, action: object, replaced: Iterable[tuple[type, str, object]]) -> None:
    """`AbstractEnv._simulate`.

    Args:
        env: the environment.
        action: of its agents, if any.
        replaced: what has to be in place: the owner of a method, its name and what that has been replaced with.
    """
    road = env.road
    found = prepared(road) if _runs_alone(env) and _are_in_place(replaced) else None
    if found is None:
        originals["AbstractEnv._simulate"](env, action)
        return
    frames = _frames(env)
    found.alone = True
    try:
        for frame in range(frames):
            if action is not None and not env.config["manual_control"] and env.steps % _frames(env) == 0:
                found.distrust()
                env.action_type.act(action)
                found.distrust()
            env.road.act()
            if _interferes(road):
                found.distrust()
            env.road.step(1 / env.config["simulation_frequency"])
            if _interferes(road):
                found.distrust()
            env.steps += 1
            if frame < frames - 1:
                env._automatic_rendering()
    finally:
        found.alone = False
        found.distrust()
    env.enable_auto_render = False


def _frames(env: AbstractEnv) -> int:
    return int(env.config["simulation_frequency"] // env.config["policy_frequency"])


def _runs_alone(env: AbstractEnv) -> bool:
    """Whether only the actions' code and what looks on runs between the sub-steps of an environment."""
    road, kind = env.road, type(env)
    if type(road) not in (Road, RegulatedRoad) or env.viewer is not None:
        return False
    if "_automatic_rendering" in vars(env) or "act" in vars(road):
        return False
    if "step" in vars(road) and type(vars(road)["step"]) is not Onlooker:
        return False
    if not all(known.drives and known.moves for known in kinds_of(road.vehicles)):
        return False
    own = _kinds.get(kind)
    if own is None or not own.current:
        own = _kinds[kind] = Own(kind, AbstractEnv, _READ)
    return own.plain and not own.has("_automatic_rendering") and type(env.config) is dict


def _are_in_place(replaced: Iterable[tuple[type, str, object]]) -> bool:
    """Whether nobody has wrapped what highway-env calls in a sub-step."""
    rendering = vars(AbstractEnv).get("_automatic_rendering")
    return rendering is originals["AbstractEnv._automatic_rendering"] and all(
        vars(owner).get(name) is faster for owner, name, faster in replaced
    )


def _interferes(road: Road) -> bool:
    onlooker = vars(road).get("step")
    return onlooker is not None and (type(onlooker) is not Onlooker or onlooker.interferes())


# Leaves out an environment's own observation where something else is shown, and nobody can tell.

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


_observation_types: dict[type, _Environments] = {}
_methods: dict[type, frozenset[str]] = {}


def _is_genuine(env: AbstractEnv) -> bool:
    kind = type(env)
    found = _observation_types.get(kind)
    if found is None or not found.own.current:
        found = _observation_types[kind] = _Environments(kind)
    return found.genuine and found.methods.isdisjoint(vars(env))


def _methods_of(eye: ObservationType) -> frozenset[str]:
    kind = type(eye)
    if kind not in _methods:
        _methods[kind] = methods_of(kind)
    return _methods[kind]
