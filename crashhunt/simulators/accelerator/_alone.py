"""An environment's sub-steps, in which nobody is looked at again for as long as nobody else's code can have run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from crashhunt.simulators.accelerator._known import Own, is_genuine, kinds_of, originals
from crashhunt.simulators.accelerator._onlooker import Onlooker
from crashhunt.simulators.accelerator._roads import prepared

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["can_run_alone", "simulate"]

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
