"""What a scenario must be, whatever simulator it is for; what its simulator demands is in its `Backend`."""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from crashhunt.base.errors import ArgumentError, ScenarioError
from crashhunt.base.names import one_of
from crashhunt.base.plugins import registered
from crashhunt.scenario._registry import backend_of, titles
from crashhunt.scenario._scenario import Scenario
from crashhunt.scenario._tables import AgentSetup
from crashhunt.world import LIMITS

if TYPE_CHECKING:
    from crashhunt.scenario._backend import Backend

__all__ = ["check", "check_arguments", "refuse", "unregistered"]


def refuse(where: str, key: str, value: object, message: str, fix: str) -> NoReturn:
    """Refuse the value of a key of a scenario.

    Raises:
        ScenarioError: always.
    """
    raise ScenarioError(f"{key} = {value!r} {message}", fix=fix, where=where)


def unregistered(simulator: str, where: str) -> ScenarioError:
    """Return the error about a simulator that is not installed."""
    fix = f"{one_of(simulator, registered('simulators'))}, or module:attribute"
    return ScenarioError(f"simulator = {simulator!r} is not registered", fix=fix, where=where)


def check(scenario: Scenario, where: str, *, kept: bool) -> None:
    """Refuse a scenario that cannot be meant.

    Args:
        scenario: with the folder in which its files are.
        where: the file that it was read from.
        kept: it has been run.

    Raises:
        ScenarioError: with key, value and fix.
    """
    if not scenario.agents:
        refuse(where, "agents", {}, "names no controlled vehicle", "add a table [agents.ego]")
    if ":" not in scenario.simulator and scenario.simulator not in registered("simulators"):
        raise unregistered(scenario.simulator, where)
    for key in ("step_length_s", "insertion_timeout_s"):
        value = getattr(scenario, key)
        if not 0 < value < float("inf"):
            refuse(where, key, value, "is not a time above 0", "give seconds, such as 0.1")
    if not 0 <= scenario.warmup_s < float("inf"):
        refuse(where, "warmup_s", scenario.warmup_s, "is not a time", "give seconds, such as 20.0")
    if scenario.observation is not None and scenario.observation.vehicles < 1:
        refuse(where, "observation.vehicles", scenario.observation.vehicles, "is below 1", "give at least 1")
    _check_tables(scenario, where, kept=kept)
    for name, backend in scenario.backends.items():
        _check_files(scenario, name, backend, where)
        if backend.keys is not None:
            _check_keys(scenario, backend.keys, where)
        backend.check(scenario, where)
    for kind, limit in scenario.events.items():
        if kind not in LIMITS:
            refuse(where, "events", kind, "has no limit", f"give some of {', '.join(LIMITS)}")
        if not 0 < limit < float("inf"):
            refuse(where, f"events.{kind}", limit, "is no limit", f"give {LIMITS[kind][1]} above 0")


def check_arguments(scenario: Scenario, *, kept: bool) -> None:
    """Refuse ranges that are none, and defaults outside of them.

    Raises:
        ScenarioError: with the argument.
    """
    tables = {"arguments": scenario.arguments}
    tables |= {f"agents.{agent}.arguments": setup.arguments for agent, setup in scenario.agents.items()}
    for table, setups in tables.items():
        for name, setup in setups.items():
            try:
                range_ = setup.argument(name, f"{scenario.origin}: {table}").distribution
            except ArgumentError as error:
                raise ScenarioError(error.message, fix=error.fix, where=error.where) from None
            if range_ is not None and setup.default is not None and not range_.contains(setup.default) and not kept:
                message, fix = f"is outside its range {setup.range!r}", "give a default within it, or widen the range"
                refuse(scenario.origin, f"{table}.{name}.default", setup.default, message, fix)


def _check_tables(scenario: Scenario, where: str, *, kept: bool) -> None:
    simulator, backend = scenario.simulator, backend_of(scenario.simulator)
    if backend is None:  # a class of somebody's own, which may have a use for any of them
        return
    if backend.table is not None and simulator not in scenario.tables:
        refuse(where, simulator, None, "is missing", f"add a table [{simulator}] with {backend.example}")
    for name in scenario.tables:
        if name != simulator and not kept:
            refuse(where, "simulator", simulator, f"has no use for the table [{name}]", "remove it")


def _check_files(scenario: Scenario, name: str, backend: Backend, where: str) -> None:
    for file in backend.files(scenario):
        path = Path(os.path.normpath(scenario.folder / file))
        if not path.is_file():
            refuse(where, name, file, "does not exist", f"give a path relative to {scenario.folder}")
        if not path.is_relative_to(scenario.folder):
            fix = "move it inside, so that it can be archived"
            refuse(where, name, file, "lies outside the scenario's folder", fix)


def _check_keys(scenario: Scenario, heeded: frozenset[str], where: str) -> None:
    """Refuse what only another simulator would heed, instead of passing it over."""
    plain = AgentSetup()
    for agent, setup in scenario.agents.items():
        for item in fields(AgentSetup):
            value = getattr(setup, item.name)
            common = item.name in ("agent", "arguments") or f"agents.{item.name}" in heeded
            if not common and value != getattr(plain, item.name):
                refuse(where, f"agents.{agent}.{item.name}", value, _meant_for(f"agents.{item.name}"), "remove it")
    for key in ("warmup_s", "insertion_timeout_s"):
        value = getattr(scenario, key)
        if key not in heeded and value != getattr(Scenario, key):
            refuse(where, key, value, _meant_for(key), "remove it")


def _meant_for(key: str) -> str:
    return f"is for {titles(lambda backend: key in (backend.keys or ()))}"
