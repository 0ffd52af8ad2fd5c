"""The configuration of a highway-env environment, and the reset of class attributes that environments change."""

from __future__ import annotations

import math
from copy import deepcopy
from typing import TYPE_CHECKING, Any, TypeAlias

from highway_env.vehicle.objects import RoadObject

from crashhunt.base.errors import ScenarioError
from crashhunt.base.text import did_you_mean
from crashhunt.highway._descriptor import HighwaySetup
from crashhunt.simulators import as_tables, merge

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from crashhunt.scenario import Scenario
    from crashhunt.trial import Value

Config: TypeAlias = dict[str, Any]
"""The configuration of a highway-env environment; highway-env's classes define its entries."""

_Plain: TypeAlias = dict[str, int | float | str]
Changes: TypeAlias = dict[type, _Plain]
"""Plain attributes of the classes of road objects in which an environment has changed one."""

_NUMBER_OR_TEXT = (int, float, str)  # a union would be made again for each attribute of each class
_pristine: Changes = {}
_changes: Changes = {}  # in force: those of the environment that was reset last


def configured(default: Config, scenario: Scenario, arguments: Mapping[str, Value]) -> Config:
    """Return the configuration of an environment for one trial.

    Raises:
        ScenarioError: An entry does not exist, or two values contradict each other.
    """
    config = deepcopy(dict(default))
    tables = [deepcopy(scenario.table(HighwaySetup).config), *as_tables(scenario, arguments)]
    for table in tables:
        _check_keys(scenario, config, table)
        merge(config, table)
    if scenario.table(HighwaySetup).time_limit == "none" and not any("duration" in table for table in tables):
        config |= {"duration": math.inf} if "duration" in config else {}
    policy, simulation = config["policy_frequency"], config["simulation_frequency"]
    if not 0 < policy <= simulation:
        message = f"must be above 0 and at most simulation_frequency, {simulation}"
        raise mistake(
            scenario, "config.policy_frequency", policy, message, "change policy_frequency or simulation_frequency"
        )
    _set_controlled_vehicles(scenario, config)
    _use_tuples(config["observation"])
    return config


def mistake(scenario: Scenario, key: str, value: object, message: str, fix: str) -> ScenarioError:
    """Return the error for a wrong entry of the table ``[highway]``."""
    return ScenarioError(f"highway.{key} = {value!r} {message}", fix=fix, where=scenario.origin)


def restore_classes(changes: Changes | None = None) -> None:
    """Restore class attributes that environments change, such as drivers' jam distance; then apply changes."""
    changes = changes or {}
    for kind, plain, was in _kinds():
        wanted = changes.get(kind, was)
        if plain != wanted:
            for name in plain.keys() - wanted.keys():
                delattr(kind, name)
            for name, value in wanted.items():
                setattr(kind, name, value)
    _keep(changes)


def note_changes() -> Changes:
    """Return what the environment that was just reset has changed in classes, for `apply_changes`."""
    return _keep({kind: plain for kind, plain, was in _kinds() if plain != was})


def apply_changes(changes: Changes) -> None:
    """Give classes the attributes of an environment again, if another environment of this process was reset since."""
    if changes != _changes:
        restore_classes(changes)


def _keep(changes: Changes) -> Changes:
    _changes.clear()
    _changes.update(changes)
    return changes


def _kinds() -> Iterator[tuple[type, _Plain, _Plain]]:
    """Yield each class of road objects, with its plain attributes now and before the first environment."""
    waiting: list[type] = [RoadObject]
    while waiting:
        kind = waiting.pop()
        waiting += kind.__subclasses__()
        plain = {name: value for name, value in vars(kind).items() if isinstance(value, _NUMBER_OR_TEXT)}
        yield kind, plain, _pristine.setdefault(kind, plain)


def _set_controlled_vehicles(scenario: Scenario, config: Config) -> None:
    """Configure as many controlled vehicles as the scenario has agents."""
    count = len(scenario.agents)
    if "controlled_vehicles" in config:
        config["controlled_vehicles"] = count
    elif count > 1:
        message = f"has one controlled vehicle; the scenario has {count} agents"
        raise mistake(scenario, "id", scenario.table(HighwaySetup).id, message, "name only one agent")
    if count > 1:
        for key in ("action", "observation"):
            if not config[key]["type"].startswith("MultiAgent"):
                config[key] = {"type": f"MultiAgent{key.capitalize()}", f"{key}_config": config[key]}


def _check_keys(scenario: Scenario, config: Config, table: Iterable[str]) -> None:
    for key in table:
        if key not in config and not key.endswith("_reward"):  # highway-env takes 0 for a missing reward
            fix = did_you_mean(key, config) or f"use one of {', '.join(config)}"
            raise mistake(scenario, "config", key, "does not exist in the environment's configuration", fix)


def _use_tuples(table: Config | list[object]) -> None:
    """Turn lists in the observation's configuration into tuples where highway-env needs tuples, which TOML lacks."""
    for inner in table.values() if isinstance(table, dict) else table:
        if isinstance(inner, dict | list):
            _use_tuples(inner)
    if isinstance(table, dict) and "observation_shape" in table:
        table["observation_shape"] = tuple(table["observation_shape"])
