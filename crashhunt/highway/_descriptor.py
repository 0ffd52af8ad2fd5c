"""Descriptor of highway-env: the table of a scenario, and its consequences.

The descriptor does not import highway-env.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib import metadata
from importlib.util import find_spec
from typing import TYPE_CHECKING, Literal

from crashhunt.base.errors import ScenarioError
from crashhunt.highway.accelerator._known_versions import ACCELERATED
from crashhunt.scenario import STEP_LENGTH_S, Accelerator, Backend
from crashhunt.simulators import SCENE_PARTS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from crashhunt.scenario import Scenario
    from crashhunt.trial import Value

_KERNEL = "_crashhunt_highway"  # the compiled module of the accelerator


@dataclass(frozen=True, kw_only=True)
class HighwaySetup:
    """The table ``[highway]``: an environment of highway-env.

    Args:
        id: id for `gymnasium.make`, such as ``highway-fast-v0``; ``module:ID`` imports your own module first.
        config: changes to the environment's default configuration; tables are merged, but a table with another ``type``
            replaces the default.
        off_road: whether leaving the lanes is a crash; by default yes, except in car parks, whose lanes are parking
            bays.
        time_limit: ``registered`` keeps the ``max_episode_steps`` with which the id is registered, and the ``duration``
            of the environment's own configuration; ``none`` lifts both. A ``duration`` in ``config`` always holds.
        accelerate: whether the accelerator is used; results are bit-identical with and without it.
    """

    id: str
    config: dict[str, object] = field(default_factory=dict)
    off_road: bool | None = None
    time_limit: Literal["registered", "none"] = "registered"
    accelerate: bool = True


def _check(scenario: Scenario, where: str) -> None:
    if scenario.step_length_s != STEP_LENGTH_S:
        message = f"step_length_s = {scenario.step_length_s!r} cannot be used with highway-env"
        raise ScenarioError(message, fix="set policy_frequency in highway.config", where=where)


def _step_length(scenario: Scenario) -> float:
    rate = scenario.table(HighwaySetup).config.get("policy_frequency")
    # Where it is not said, it is once a second in most.
    return 1.0 / rate if isinstance(rate, int | float) and rate > 0 else 1.0


def _as_it_is(scenario: Scenario) -> Scenario:
    return scenario.with_table(replace(scenario.table(HighwaySetup), accelerate=False))


def _not_accelerated(scenario: Scenario) -> str:
    version = metadata.version("highway-env")
    if not scenario.table(HighwaySetup).accelerate:
        return ""
    if version not in ACCELERATED:
        known = ", ".join(ACCELERATED)
        return f"the accelerator does not know highway-env {version} and steps aside; it knows {known}"
    if find_spec(_KERNEL) is None:
        return (
            "highway-env runs at its own speed: the kernel of the accelerator is not built. "
            "Fix: install a C++ compiler and Python's headers, then install crashhunt again"
        )
    return ""


def _side_effect(scenario: Scenario, values: Mapping[str, Value], specifications: Iterable[str]) -> str:
    for text in _texts([scenario.table(HighwaySetup).config, list(specifications), list(values.values())]):
        if "." in text and not text.startswith("highway_env."):  # the class of a vehicle
            return f"its configuration names {text!r}"
    return ""


def _texts(value: object) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list | tuple):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


BACKEND: Backend = Backend(
    title="highway-env",
    table=HighwaySetup,
    example="the id of the environment",
    keys=frozenset({"agents.observation"}),
    shows_itself=True,
    check=_check,
    modules=lambda scenario: (scenario.table(HighwaySetup).id,),
    versions=("highway-env", "numpy"),
    per_processor=True,
    step_length_s=_step_length,
    reported_events=("wrong_way", "not_moving"),
    disturbances=("brake", "stop", "dawdle", "speed", "cut_in", "late_merge", "ignore_priority", "unseen"),
    varying_disturbances=("brake", "stop"),
    observations=(*SCENE_PARTS, "lanes", "route", "speed_limit"),
    accelerator=Accelerator(switched_off=_as_it_is, note=_not_accelerated),
    side_effect=_side_effect,
    plays_paths=True,
    forkable=True,
)
