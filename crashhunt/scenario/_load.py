"""Loading of scenarios by name or path: a folder with a ``scenario.toml``, or a configuration file of a simulator."""

from __future__ import annotations

import json
import os
import re
import tomllib
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from crashhunt.base import layout
from crashhunt.base.agent_locators import anchored, is_program, relative_to
from crashhunt.base.codec import known_part
from crashhunt.base.errors import ArgumentError, HuntDirectoryError, ScenarioError, UsageError
from crashhunt.base.files import cannot_write
from crashhunt.base.integrity import read_bounded
from crashhunt.base.layout import PACKAGE, SCENARIO
from crashhunt.base.plugins import registered
from crashhunt.base.text import any_of, did_you_mean, listed, near_path, one_of
from crashhunt.base.validation import validate
from crashhunt.scenario._action_forms import FORMER_DEFAULT_ACTION, action_settings
from crashhunt.scenario._scenario import (
    AgentSetup,
    ObservationSetup,
    Scenario,
    backend_names,
    backend_of,
    configurations,
    titles,
)
from crashhunt.world import LIMITS

if TYPE_CHECKING:
    from crashhunt.base.json_types import Plain
    from crashhunt.scenario._scenario import Backend, Configuration


# What a scenario must be, whatever simulator it is for; what its simulator demands is in its `Backend`.


def refuse(where: str, key: str, value: object, message: str, fix: str) -> NoReturn:
    """Raise an error that refuses the value of a key of a scenario.

    Raises:
        ScenarioError: in every case; the message names key, value and fix.
    """
    raise ScenarioError(f"{key} = {value!r} {message}", fix=fix, where=where)


def unregistered(simulator: str, where: str) -> ScenarioError:
    """Return the error about a simulator that is not installed."""
    fix = f"{one_of(simulator, registered('simulators'))}, or module:attribute"
    return ScenarioError(f"simulator = {simulator!r} is not registered", fix=fix, where=where)


def check(scenario: Scenario, where: str, *, kept: bool) -> None:
    """Refuse an invalid scenario.

    A scenario that was ``kept`` has already run in a hunt.

    Raises:
        ScenarioError: the scenario is invalid; the message names the key, the value and the fix.
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
    for agent, setup in scenario.agents.items():
        try:
            action_settings(setup.action, where=f"agents.{agent}.action")
        except UsageError as error:
            raise ScenarioError(error.message, fix=error.fix, where=where) from None
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
            refuse(where, f"events.{kind}", limit, "is not a limit", f"give {LIMITS[kind][1]} above 0")


def check_arguments(scenario: Scenario, *, kept: bool) -> None:
    """Refuse invalid ranges of arguments, and defaults outside of their range.

    Raises:
        ScenarioError: an argument is invalid; the message names the argument.
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
    if backend is None:  # a user's class, which may use any of them
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
    """Refuse keys that only another simulator uses, instead of ignoring them."""
    plain = AgentSetup()
    for agent, setup in scenario.agents.items():
        for item in fields(AgentSetup):
            value = getattr(setup, item.name)
            common = item.name in ("agent", "arguments") or f"agents.{item.name}" in heeded
            if not common and value not in (getattr(plain, item.name), FORMER_DEFAULT_ACTION):
                refuse(where, f"agents.{agent}.{item.name}", value, _suggestion(f"agents.{item.name}"), "remove it")
    for key in ("warmup_s", "insertion_timeout_s"):
        value = getattr(scenario, key)
        if key not in heeded and value != getattr(Scenario, key):
            refuse(where, key, value, _suggestion(key), "remove it")


def _suggestion(key: str) -> str:
    return f"is for {titles(lambda backend: key in (backend.keys or ()))}"


# The scenarios that come with crashhunt.


def shipped_folder() -> Path:
    """Return the folder of the scenarios that come with crashhunt."""
    inside = PACKAGE / "scenarios"
    return inside if inside.is_dir() else PACKAGE.parent / "scenarios"


def shipped_scenarios() -> tuple[str, ...]:
    """Return the names of the scenarios that come with crashhunt."""
    return tuple(sorted(path.parent.name for path in shipped_folder().glob(f"*/{SCENARIO}")))


def _is_shipped(name: str) -> bool:
    """Return whether a name is one of `shipped_scenarios`, without a look at the others."""
    is_name = name == os.path.basename(name) and name not in ("", os.curdir, os.pardir)  # noqa: PTH119
    return is_name and os.path.isfile(shipped_folder() / name / SCENARIO)  # noqa: PTH113


def copy_shipped_scenario(name: str, to: Path) -> None:
    """Copy the files of a scenario that comes with crashhunt into a new folder.

    Args:
        name: Name of the scenario.
        to: Path of the new folder; an existing folder must be empty.

    Raises:
        ScenarioError: The scenario does not exist.
        HuntDirectoryError: The folder is not empty or cannot be written.
    """
    if name not in shipped_scenarios():
        fix = f"{did_you_mean(name, shipped_scenarios())} give one of {listed(shipped_scenarios())}"
        raise ScenarioError(f"no scenario {name!r} comes with crashhunt", fix=fix.strip())
    if to.exists() and (not to.is_dir() or any(to.iterdir())):
        raise HuntDirectoryError("the folder is not empty", fix="give a new folder", where=str(to))
    source = shipped_folder() / name
    text = (source / SCENARIO).read_text(encoding="utf-8")
    files = [file for file in source.iterdir() if file.is_file() and file.name != SCENARIO]
    for shared in re.findall(r'"(\.\./[^"]+)"', text):  # a file of another scenario, such as weights
        files.append(source / shared)
        text = text.replace(f'"{shared}"', f'"{Path(shared).name}"')
    try:
        to.mkdir(parents=True, exist_ok=True)
        for file in files:
            (to / file.name).write_bytes(file.read_bytes())
        (to / SCENARIO).write_text(text, encoding="utf-8")
    except OSError as error:
        raise cannot_write(to, error) from error


_INTERNAL_FIELDS = ("folder", "file", "notes", "added")  # of a Scenario, and not of a file


def load_scenario(name: str | Path, *, ego: str = "", kept: bool = False) -> Scenario:
    """Load a scenario.

    Args:
        name: name of a shipped scenario, or the path of a folder, a ``scenario.toml`` or a simulator's configuration.
        ego: for a simulator's configuration, the controlled vehicle in the syntax of `--ego`.
        kept: whether the scenario is that of a snapshot. A snapshot has run before, so its scenario is accepted without
            a check.

    Raises:
        ScenarioError: the scenario does not exist or is not valid; the message names file, key, value and fix.
    """
    path = _path_of(name)
    if path.suffix == ".toml":
        if ego:
            bare = [known.endings[0] for known in configurations() if known.takes_ego]
            message = f"--ego {ego!r} can be used only with a {any_of(bare)}, not with a scenario.toml"
            raise ScenarioError(message, fix="choose the vehicle in the table [agents] of the file", where=str(path))
        scenario = _load_toml(path, kept=kept)
    else:
        scenario = _configuration(path).load(path, ego)
    if not kept:
        for backend in scenario.backends.values():
            backend.check_names(scenario, ego)
        if _is_shipped(str(name)) and _has_scenario(Path(name)) and not Path(name).samefile(path.parent):
            note = f"the scenario {name} is the one that comes with crashhunt; --scenario ./{name} is the folder here"
            scenario = replace(scenario, notes=(*scenario.notes, note))
    return scenario


def _has_scenario(folder: Path) -> bool:
    return folder.is_dir() and any(any(folder.glob(f"*{ending}")) for ending in (SCENARIO, *_endings()[1:]))


def endings() -> tuple[str, ...]:
    """Return the file name endings of scenarios, for messages: those of simulators' configurations, and ``.toml``."""
    return (".toml", *(configuration.endings[0] for configuration in configurations()))


def scenario_from_dict(data: Plain, *, where: str, folder: Path, tolerant: bool = False) -> Scenario:
    """Validate the contents of a ``scenario.toml`` without reading the files that it names.

    Args:
        data: contents of the file.
        where: path of the file, for error messages.
        folder: folder that contains the files of the scenario.
        tolerant: whether crashhunt itself wrote the file, possibly a later version; unknown keys are then kept as
            ``added``.

    Raises:
        ScenarioError: the contents are invalid; the message names the key, its value and the fix.
    """
    added: dict[str, object] = {}
    if tolerant:
        data, added = _split_known_keys(data)
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
        name: validate(kind, data[name], where=where, error=ScenarioError, under=name) for name, kind in kinds.items()
    }
    own = _table_kind(scenario.simulator)
    if own is not None and scenario.simulator not in tables and _is_optional(own):
        tables[scenario.simulator] = own()
    observation = scenario.observation
    if observation is None and not scenario.backend.shows_itself:
        observation = ObservationSetup()  # said in full, so that a snapshot says it too
    name = scenario.name or folder.name
    return replace(scenario, tables=tables, folder=folder, name=name, observation=observation, added=added)


def _split_known_keys(data: Plain) -> tuple[dict[str, object], dict[str, object]]:
    """Return the keys that this version knows, and the keys that a later version added."""
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


def _is_optional(kind: type) -> bool:
    return all(item.default is not MISSING or item.default_factory is not MISSING for item in fields(kind))


def _keys_of_a_file() -> list[str]:
    keys = [item.name for item in fields(Scenario) if item.name not in ("tables", *_INTERNAL_FIELDS)]
    return [*keys, *(name for name in backend_names() if _table_kind(name) is not None)]


def _path_of(name: str | Path) -> Path:
    """Return the path of the scenario file that a name or path refers to."""
    path, text = Path(name), str(name)
    if _is_shipped(text):  # a folder of the same name is ./NAME
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
    fix += f"{listed(shipped_scenarios())}, or {_PATH} {_file_names()}"
    raise ScenarioError(f"there is no scenario {text!r}", fix=" ".join(fix.split()))


def _endings() -> tuple[str, ...]:
    return (".toml", *(ending for configuration in configurations() for ending in configuration.endings))


_PATH = "the path of a folder or of one of these files:"


def _file_names() -> str:
    return any_of([layout.SCENARIO, *(f"*{ending}" for ending in endings()[1:])])


def _configuration(path: Path) -> Configuration:
    for configuration in configurations():
        if path.name.endswith(configuration.endings):
            return configuration
    raise ScenarioError("the file is not a scenario", fix=f"give {_PATH} {_file_names()}", where=str(path))


def _load_toml(path: Path, *, kept: bool) -> Scenario:
    try:
        data = tomllib.loads(read_bounded(path).decode())
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"not valid TOML: {error}", fix="correct the file", where=str(path)) from None
    except OSError as error:
        raise ScenarioError(
            f"cannot be read: {error.strerror}", fix="check that the file exists and may be read", where=str(path)
        ) from None
    for key in _INTERNAL_FIELDS:
        if key in data:
            raise ScenarioError(f"unknown key {key!r}", fix="remove it", where=str(path))
    if not kept:
        _join_commands(data, str(path), path.resolve().parent)
    scenario = scenario_from_dict(data, where=str(path), folder=path.resolve().parent, tolerant=kept)
    scenario = replace(scenario, file=path.name)
    check_arguments(scenario, kept=kept)
    agents = {agent: _resolve_default_path(setup, scenario.folder) for agent, setup in scenario.agents.items()}
    scenario = replace(scenario, agents=agents)
    check(scenario, str(path), kept=kept)
    if "schema" not in data and not kept:
        # A later schema may exist some day, and a file without this key would then be ambiguous.
        raise ScenarioError("the key 'schema' is missing", fix="add schema = 1", where=str(path))
    if kept:
        return scenario
    notes = (note for backend in scenario.backends.values() for note in backend.notes(scenario))
    return replace(scenario, notes=(*scenario.notes, *notes))


def _join_commands(data: Plain, where: str, folder: Path) -> None:
    """Replace ``agent = { exec = ["./planner", …] }`` by the locator ``exec:…``, and ``{ lib = "…" }`` by ``lib:…``.

    Relative paths of such an agent, and of one that is written as such a locator, begin in the scenario's folder.

    Raises:
        ScenarioError: the command is not a list of texts, or the path of the library or FMU is not a text.
        PluginError: the text is not a command line.
    """
    agents = data.get("agents")
    for name, table in agents.items() if isinstance(agents, dict) else ():
        agent = table.get("agent") if isinstance(table, dict) else None
        if isinstance(agent, str) and is_program(agent):
            table["agent"] = anchored(agent, folder)
        elif isinstance(agent, dict):
            words, files = agent.get("exec"), [(key, agent[key]) for key in ("lib", "fmu") if key in agent]
            is_list = isinstance(words, list) and all(isinstance(word, str) for word in words)
            if len(agent) == len(files) == 1 and isinstance(files[0][1], str) and files[0][1]:
                table["agent"] = anchored(":".join(files[0]), folder)
            elif isinstance(words, list) and is_list and any(words[:1]) and agent.keys() <= {"exec", "reuse"}:
                table["agent"] = relative_to(folder, words)
                table |= {"reuse": agent["reuse"]} if "reuse" in agent else {}
            else:
                fix = 'write agent = { exec = ["./planner", "--mode", "test"] } or agent = { lib = "./libplanner.so" }'
                refuse(where, f"agents.{name}.agent", agent, "is neither a command nor a library or an FMU", fix)


def _resolve_default_path(setup: AgentSetup, folder: Path) -> AgentSetup:
    """Return the agent setup, in which defaults that name a file of the scenario's folder are replaced by its path."""
    found = {}
    for name, argument in setup.arguments.items():
        default = argument.default
        if isinstance(default, str) and default and os.path.isfile(folder / default):  # noqa: PTH113 - however long
            argument = replace(argument, default=str(folder / default))
        found[name] = argument
    return replace(setup, arguments=found)
