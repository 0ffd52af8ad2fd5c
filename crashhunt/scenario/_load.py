"""From a name or a path to a scenario: a folder with a ``scenario.toml``, or a configuration of a simulator's own."""

from __future__ import annotations

import json
import os
import tomllib
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import ScenarioError
from crashhunt.base.names import did_you_mean, listed, near_path
from crashhunt.base.plugins import registered
from crashhunt.base.tolerance import known_part
from crashhunt.base.validation import validate
from crashhunt.scenario._checks import check, check_arguments, unregistered
from crashhunt.scenario._registry import backend_names, backend_of, configurations
from crashhunt.scenario._scenario import Scenario
from crashhunt.scenario._shipped import shipped_folder, shipped_scenarios
from crashhunt.scenario._tables import AgentSetup, ObservationSetup

if TYPE_CHECKING:
    from crashhunt.base.plain import Plain
    from crashhunt.scenario._backend import Configuration

__all__ = ["endings", "load_scenario", "scenario_from_dict"]

_INTERNAL = ("folder", "file", "notes", "added")  # of a Scenario, and not of a file


def load_scenario(name: str | Path, *, ego: str = "", kept: bool = False) -> Scenario:
    """Load a scenario.

    Args:
        name: of a shipped one, or the path of a folder, a ``scenario.toml`` or a simulator's own configuration.
        ego: for such a configuration, which vehicle is controlled, as its `Configuration` understands it.
        kept: it is that of a snapshot, which has been run: what was accepted then is not refused now.

    Raises:
        ScenarioError: it does not exist or is not valid, with file, key, value and the fix.
    """
    path = _path_of(name)
    if path.suffix == ".toml":
        if ego:
            message = f"--ego {ego!r} is for a bare {_told()}"
            raise ScenarioError(message, fix="set the vehicle under [agents] instead", where=str(path))
        scenario = _load_toml(path, kept=kept)
    else:
        scenario = _configuration(path).load(path, ego)
    if not kept:
        for backend in scenario.backends.values():
            backend.check_names(scenario, ego)
    return scenario


def endings() -> tuple[str, ...]:
    """Return how people are told of the files that are scenarios: ``.toml``, and those of simulators' own."""
    return (".toml", *(configuration.endings[0] for configuration in configurations()))


def scenario_from_dict(data: Plain, *, where: str, folder: Path, tolerant: bool = False) -> Scenario:
    """Validate what a ``scenario.toml`` says, without looking at the files that it names.

    Args:
        data: what it says.
        where: the file, for the error.
        folder: where its files are.
        tolerant: crashhunt itself has written it, perhaps another version: keys that are not known are kept
            as ``added``.

    Raises:
        ScenarioError: with the key, its value and the fix.
    """
    added: dict[str, object] = {}
    if tolerant:
        data, added = _known(data)
    known = {item.name for item in fields(Scenario)} - {"tables"}
    asked = {name: _table_kind(name) for name in data if name not in known}
    kinds = {name: kind for name, kind in asked.items() if kind is not None}
    wanted = data.get("simulator")
    if isinstance(wanted, str) and wanted in asked.keys() - kinds and wanted not in registered("simulators"):
        raise unregistered(wanted, where)  # its table is not the mistake
    if "tables" in data:  # which only says what the others are
        raise ScenarioError("unknown key 'tables'", fix=f"the keys here are {listed(_keys_of_a_file())}", where=where)
    scenario = validate(
        Scenario,
        {name: value for name, value in data.items() if name not in kinds},
        where=where,
        error=ScenarioError,
        keys=_keys_of_a_file,
    )
    tables: dict[str, object] = {
        name: validate(kind, data[name], where=where, error=ScenarioError, under=name)
        for name, kind in kinds.items()
        if data[name] is not None  # as an older crashhunt sends it to a worker
    }
    own = _table_kind(scenario.simulator)
    if own is not None and scenario.simulator not in tables and _may_be_left_out(own):
        tables[scenario.simulator] = own()
    observation = scenario.observation
    if observation is None and not scenario.backend.shows_itself:
        observation = ObservationSetup()  # said in full, so that a snapshot says it too
    name = scenario.name or folder.name
    return replace(scenario, tables=tables, folder=folder, name=name, observation=observation, added=added)


def _known(data: Plain) -> tuple[dict[str, object], dict[str, object]]:
    """What this version has fields for, and what a later one has added."""
    tables = {name: kind for name in data if (kind := _table_kind(name)) is not None}
    rest = {name: value for name, value in data.items() if name not in tables}
    known: dict[str, object]
    added: dict[str, object]
    known, added = known_part(Scenario, rest)
    own = data.get("simulator")  # of which the table is no addition of a later version, known or not
    known |= {name: added.pop(name) for name in list(added) if name == own}
    for name, kind in tables.items():
        known[name], more = known_part(kind, data[name])
        added |= {name: more} if more else {}
    return known, json.loads(json.dumps(added, default=str))  # it crosses to a worker, which JSON's types do alone


def _table_kind(name: str) -> type | None:
    backend = backend_of(name)
    return backend.table if backend is not None else None


def _may_be_left_out(kind: type) -> bool:
    return all(item.default is not MISSING or item.default_factory is not MISSING for item in fields(kind))


def _keys_of_a_file() -> list[str]:
    keys = [item.name for item in fields(Scenario) if item.name not in ("tables", *_INTERNAL)]
    return [*keys, *(name for name in backend_names() if _table_kind(name) is not None)]


def _path_of(name: str | Path) -> Path:
    """The file that is meant by a name or a path."""
    path, text = Path(name), str(name)
    if text in shipped_scenarios():  # a folder of the same name is ./NAME
        path = shipped_folder() / text
    if path.is_dir():
        path = path / layout.SCENARIO
    if path.is_file():
        return path
    if path.parent.is_dir() and path.parent == Path(name):
        inside = sorted(str(file) for file in path.parent.iterdir() if file.name.endswith(_endings()))
        fix = f"give {listed(inside)}" if inside else "give the folder that has one"
        raise ScenarioError("the folder has no scenario.toml", fix=fix, where=text)
    fix = f"{near_path(path, *_endings()) or did_you_mean(text, shipped_scenarios())} give one of "
    fix += f"{listed(shipped_scenarios())}, or the path of a folder, a scenario.toml or a {_told()}"
    raise ScenarioError(f"there is no scenario {text!r}", fix=" ".join(fix.split()))


def _endings() -> tuple[str, ...]:
    return (".toml", *(ending for configuration in configurations() for ending in configuration.endings))


def _told() -> str:
    return " or a ".join(endings()[1:])


def _configuration(path: Path) -> Configuration:
    for configuration in configurations():
        if path.name.endswith(configuration.endings):
            return configuration
    message, fix = f"{path.name!r} is neither a scenario.toml nor a {_told()}", "give one of the two"
    raise ScenarioError(message, fix=fix, where=str(path))


def _load_toml(path: Path, *, kept: bool) -> Scenario:
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"not valid TOML: {error}", fix="mend the file", where=str(path)) from None
    except OSError as error:
        raise ScenarioError(f"cannot be read: {error.strerror}", where=str(path)) from None
    for key in _INTERNAL:
        if key in data:
            raise ScenarioError(f"unknown key {key!r}", fix="remove it", where=str(path))
    scenario = scenario_from_dict(data, where=str(path), folder=path.resolve().parent, tolerant=kept)
    scenario = replace(scenario, file=path.name)
    check_arguments(scenario, kept=kept)
    agents = {agent: _beside(setup, scenario.folder) for agent, setup in scenario.agents.items()}
    scenario = replace(scenario, agents=agents)
    check(scenario, str(path), kept=kept)
    if "schema" not in data and not kept:
        # Some day there will be another one, and then nobody knows which of the two this file is.
        raise ScenarioError("the key 'schema' is missing", fix="add schema = 1", where=str(path))
    if kept:
        return scenario
    notes = (note for backend in scenario.backends.values() for note in backend.notes(scenario))
    return replace(scenario, notes=(*scenario.notes, *notes))


def _beside(setup: AgentSetup, folder: Path) -> AgentSetup:
    """The agent's arguments, where a default that names a file beside the ``scenario.toml`` is its path."""
    found = {}
    for name, argument in setup.arguments.items():
        default = argument.default
        if isinstance(default, str) and default and os.path.isfile(folder / default):  # noqa: PTH113 - however long
            argument = replace(argument, default=str(folder / default))
        found[name] = argument
    return replace(setup, arguments=found)
