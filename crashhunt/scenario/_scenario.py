"""Scenarios: what a trial takes place in. A scenario says how to make an episode; it never is one.

A scenario is a folder with a ``scenario.toml``, or a bare ``.sumocfg`` that nobody wrote for us.
"""

from __future__ import annotations

import os
import string
import tomllib
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

from crashhunt.base import layout
from crashhunt.base.errors import ArgumentError, ScenarioError
from crashhunt.base.layout import PACKAGE
from crashhunt.base.names import did_you_mean, listed, near_path, one_of
from crashhunt.base.plugins import registered
from crashhunt.scenario._tables import AgentSetup, ArgumentSetup, GymSetup, HighwaySetup, ObservationSetup, SumoSetup
from crashhunt.scenario.backends.sumo import (
    INPUTS,
    RESERVED,
    canonical,
    check_names,
    is_true,
    nested_files,
    read_xml,
    writes,
    written_by,
)
from crashhunt.world import LIMITS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from crashhunt.trial import Argument, Value

__all__ = [
    "Scenario",
    "argument_values",
    "asked_for",
    "check_options",
    "load_scenario",
    "scenario_from_dict",
    "shipped_folder",
    "shipped_scenarios",
    "with_action",
]

_STEP_LENGTH_S = 0.1  # ten decisions a second, as drivers' models are made for
_ENDINGS = (".toml", ".sumocfg", ".sumo.cfg")
_TABLES = {"sumo": "net and routes", "highway": "the id of the environment", "gym": "the id of the environment"}


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """What a trial takes place in.

    Args:
        title: one line, for people.
        simulator: the name of a registered simulator, or ``module:attribute``.
        step_length_s: the control step, in s; highway-env's follows from its policy_frequency.
        warmup_s: simulation time before the controlled vehicles enter, in s.
        insertion_timeout_s: how much later they may enter before the episode is invalid, in s.
        observation: what agents are shown; None for what the simulator shows of itself, which on SUMO is the default.
        arguments: the arguments that shape the traffic.
        agents: agent id to controlled vehicle.
        sumo: files and options, where the simulator is SUMO.
        highway: the environment, where it is highway-env.
        gym: the environment, where it is another one of Gymnasium.
        events: limits of traffic events, such as ``not_moving`` in s, where they are not the default.
        schema: of the file format.
        name: what people call it; the folder's name by default.
        folder: where its files are; not part of the file.
        file: what was read, relative to the folder; not part of it, and not of what crosses to a worker.
        notes: what was decided on the user's behalf, for people; not part of the file.
    """

    title: str = ""
    simulator: str = "sumo"
    step_length_s: float = _STEP_LENGTH_S
    warmup_s: float = 0.0
    insertion_timeout_s: float = 30.0
    observation: ObservationSetup | None = None
    arguments: dict[str, ArgumentSetup] = field(default_factory=dict)
    agents: dict[str, AgentSetup] = field(default_factory=lambda: {"ego": AgentSetup()})
    sumo: SumoSetup | None = None
    highway: HighwaySetup | None = None
    gym: GymSetup | None = None
    events: dict[str, float] = field(default_factory=dict)
    schema: Literal[1] = 1
    name: str = ""
    folder: Path = Path()
    file: str = layout.SCENARIO
    notes: tuple[str, ...] = ()

    @property
    def origin(self) -> str:
        """Where errors about it point."""
        return str(self.folder / self.file)

    def files(self) -> Iterator[str]:
        """Yield the files that an episode reads, relative to the folder.

        Raises:
            ScenarioError: one of them names a file that is not there.
        """
        if self.sumo is not None:
            yield self.sumo.net
            yield from self.texts()
            for option, value in self.sumo.options.items():
                if canonical(option) in INPUTS:
                    yield from (name.strip() for name in str(value).split(",") if name.strip())

    def texts(self) -> Iterator[str]:
        """Yield those of the files that may say ``${NAME}``: routes, additional ones, and what these have SUMO read.

        Raises:
            ScenarioError: one of them names a file that is not there.
        """
        if self.sumo is not None:
            named = (*self.sumo.routes, *self.sumo.additional)
            yield from named
            yield from nested_files(self.folder, named, inside=True)

    def modules(self) -> Iterator[str]:
        """Yield the modules that the simulator imports besides the agents': those of environments and crash rules."""
        locators = [self.simulator]
        if self.highway is not None:
            locators.append(self.highway.id)
        if self.gym is not None:
            locators += [self.gym.id, self.gym.crash.function]
        yield from (locator.partition(":")[0] for locator in locators if ":" in locator)

    def scenario_arguments(self) -> dict[str, Argument]:
        """The arguments that shape the traffic."""
        return {name: setup.argument(name, f"{self.origin}: arguments") for name, setup in self.arguments.items()}

    def agent_arguments(self, agent: str) -> dict[str, Argument]:
        """What the scenario knows about the arguments of an agent."""
        where = f"{self.origin}: agents.{agent}.arguments"
        return {name: setup.argument(name, where) for name, setup in self.agents[agent].arguments.items()}

    def with_agents(self, locators: dict[str, str]) -> Scenario:
        """Return this scenario with other agents at the wheel; what it says of the old ones' arguments is dropped."""
        agents = dict(self.agents)
        for agent, locator in locators.items():
            if agents[agent].agent != locator:
                agents[agent] = replace(agents[agent], agent=locator, arguments={})
        return replace(self, agents=agents)


def shipped_folder() -> Path:
    """Return the folder of the scenarios that come with crashhunt."""
    inside = PACKAGE / "scenarios"
    return inside if inside.is_dir() else PACKAGE.parent / "scenarios"


def shipped_scenarios() -> tuple[str, ...]:
    """Return the names of the scenarios that come with crashhunt."""
    return tuple(sorted(path.parent.name for path in shipped_folder().glob("*/scenario.toml")))


def load_scenario(name: str | Path, *, ego: str = "", kept: bool = False) -> Scenario:
    """Load a scenario.

    Args:
        name: of a shipped one, or the path of a folder, a ``scenario.toml`` or a ``.sumocfg``.
        ego: for a ``.sumocfg``, which vehicle is controlled: ``VEHICLE``, ``vehicle=ID``, ``route=ID`` or
            ``edges=FROM,TO``.
        kept: it is that of a snapshot, which has been run: what was accepted then is not refused now.

    Raises:
        ScenarioError: it does not exist or is not valid, with file, key, value and the fix.
    """
    path = Path(name)
    text = str(name)
    if text in shipped_scenarios():  # a folder of the same name is ./NAME
        path = shipped_folder() / text
    if path.is_dir():
        path = path / layout.SCENARIO
    if not path.is_file():
        if path.parent.is_dir() and path.parent == Path(name):
            inside = sorted(str(file) for file in path.parent.iterdir() if file.name.endswith(_ENDINGS))
            fix = f"give {listed(inside)}" if inside else "give the folder that has one"
            raise ScenarioError("the folder has no scenario.toml", fix=fix, where=text)
        fix = f"{near_path(path, *_ENDINGS) or did_you_mean(text, shipped_scenarios())} give one of "
        fix += f"{listed(shipped_scenarios())}, or the path of a folder, a scenario.toml or a .sumocfg"
        raise ScenarioError(f"there is no scenario {text!r}", fix=" ".join(fix.split()))
    if path.suffix == ".toml":
        if ego:
            raise ScenarioError(
                f"--ego {ego!r} is for a bare .sumocfg", fix="set the vehicle under [agents] instead", where=str(path)
            )
        scenario = _load_toml(path, kept=kept)
    elif path.name.endswith(_ENDINGS):
        from crashhunt.scenario.backends.sumo import load_sumocfg

        scenario = load_sumocfg(path, ego=ego)
    else:
        raise ScenarioError(
            f"{path.name!r} is neither a scenario.toml nor a .sumocfg", fix="give one of the two", where=str(path)
        )
    if not kept:
        check_names(scenario, ego)
    return scenario


def _load_toml(path: Path, *, kept: bool) -> Scenario:
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"not valid TOML: {error}", fix="mend the file", where=str(path)) from None
    except OSError as error:
        raise ScenarioError(f"cannot be read: {error.strerror}", where=str(path)) from None
    for key in ("folder", "file", "notes"):
        if key in data:
            raise ScenarioError(f"unknown key {key!r}", fix="remove it", where=str(path))
    scenario = scenario_from_dict(data, where=str(path), folder=path.resolve().parent)
    scenario = replace(scenario, file=path.name)
    _check_arguments(scenario, kept=kept)
    agents = {agent: _beside(setup, scenario.folder) for agent, setup in scenario.agents.items()}
    scenario = replace(scenario, agents=agents)
    _check(scenario, str(path))
    if "schema" not in data and not kept:
        # Some day there will be another one, and then nobody knows which of the two this file is.
        raise ScenarioError("the key 'schema' is missing", fix="add schema = 1", where=str(path))
    return scenario if kept or scenario.sumo is None else _noted(scenario, scenario.sumo)


def _noted(scenario: Scenario, sumo: SumoSetup) -> Scenario:
    """Tell what SUMO would write and does not."""
    named = [name for option in sumo.options if writes(name := canonical(option))]
    found = [f"{', '.join(named)} (nothing is written)"] if named else []
    found += written_by(scenario.folder, (*sumo.routes, *sumo.additional))
    note = f"of {scenario.file}, a trial does not take over: {'; '.join(found)}"
    return replace(scenario, notes=(*scenario.notes, note)) if found else scenario


def scenario_from_dict(data: dict[str, Any], *, where: str, folder: Path) -> Scenario:
    """Validate what a ``scenario.toml`` says, without looking at the files that it names.

    Raises:
        ScenarioError: with the key, its value and the fix.
    """
    from crashhunt.base.validation import validate

    scenario = validate(Scenario, data, where=where, error=ScenarioError)
    observation = scenario.observation
    if observation is None and scenario.simulator not in ("highway", "gym"):
        observation = ObservationSetup()  # said in full, so that a snapshot says it too
    return replace(scenario, folder=folder, name=scenario.name or folder.name, observation=observation)


def _beside(setup: AgentSetup, folder: Path) -> AgentSetup:
    """The agent's arguments, where a default that names a file beside the ``scenario.toml`` is its path."""
    found = {}
    for name, argument in setup.arguments.items():
        default = argument.default
        if isinstance(default, str) and default and (folder / default).is_file():
            argument = replace(argument, default=str(folder / default))
        found[name] = argument
    return replace(setup, arguments=found)


def _refuse(where: str, key: str, value: object, message: str, fix: str) -> NoReturn:
    raise ScenarioError(f"{key} = {value!r} {message}", fix=fix, where=where)


def _check(scenario: Scenario, where: str) -> None:
    if not scenario.agents:
        _refuse(where, "agents", {}, "names no controlled vehicle", "add a table [agents.ego]")
    if ":" not in scenario.simulator and scenario.simulator not in registered("simulators"):
        fix = f"{one_of(scenario.simulator, registered('simulators'))}, or module:attribute"
        _refuse(where, "simulator", scenario.simulator, "is not registered", fix)
    for key in ("step_length_s", "insertion_timeout_s"):
        value = getattr(scenario, key)
        if not 0 < value < float("inf"):
            _refuse(where, key, value, "is not a time above 0", "give seconds, such as 0.1")
    if not 0 <= scenario.warmup_s < float("inf"):
        _refuse(where, "warmup_s", scenario.warmup_s, "is not a time", "give seconds, such as 20.0")
    if scenario.observation is not None and scenario.observation.vehicles < 1:
        _refuse(where, "observation.vehicles", scenario.observation.vehicles, "is below 1", "give at least 1")
    for simulator, example in _TABLES.items():
        if scenario.simulator == simulator and getattr(scenario, simulator) is None:
            _refuse(where, simulator, None, "is missing", f"add a table [{simulator}] with {example}")
    for simulator in _TABLES:
        table = getattr(scenario, simulator)
        if scenario.simulator in _TABLES and scenario.simulator != simulator and table is not None:
            _refuse(where, "simulator", scenario.simulator, f"has no use for the table [{simulator}]", "remove it")
    if scenario.sumo is not None:
        _check_sumo(scenario, scenario.sumo, where)
    elif scenario.simulator in _TABLES:
        _check_environment(scenario, where)
    for kind, limit in scenario.events.items():
        if kind not in LIMITS:
            _refuse(where, "events", kind, "has no limit", f"give some of {', '.join(LIMITS)}")
        if not 0 < limit < float("inf"):
            _refuse(where, f"events.{kind}", limit, "is no limit", f"give {LIMITS[kind][1]} above 0")


def _check_arguments(scenario: Scenario, *, kept: bool) -> None:
    """Refuse ranges that are none, and defaults outside of them."""
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
                _refuse(scenario.origin, f"{table}.{name}.default", setup.default, message, fix)


def _check_sumo(scenario: Scenario, sumo: SumoSetup, where: str) -> None:
    check_options(sumo.options, where)
    for name, argument in scenario.arguments.items():
        if argument.option:
            check_options({argument.option: ""}, f"{where}: arguments.{name}")
    for file in scenario.files():
        path = Path(os.path.normpath(scenario.folder / file))
        if not path.is_file():
            _refuse(where, "sumo", file, "does not exist", f"give a path relative to {scenario.folder}")
        if not path.is_relative_to(scenario.folder):
            fix = "move it inside, so that it can be archived"
            _refuse(where, "sumo", file, "lies outside the scenario's folder", fix)
        if "," in path.name:
            _refuse(where, "sumo", file, "has a comma, at which SUMO begins another file", "rename it")
    for file in () if sumo.literal else scenario.texts():
        for name in asked_for(read_xml(scenario.folder / file)):
            if name not in scenario.arguments:
                message = f"has no {name!r}, which {file} asks for"
                _refuse(where, "arguments", sorted(scenario.arguments), message, "declare it")
    for agent, setup in scenario.agents.items():
        named = [key for key in ("existing", "route", "edges") if getattr(setup, key)]
        if len(named) != 1:
            message = "must have one of existing, route, edges"
            _refuse(where, f"agents.{agent}", named, message, "give exactly one of them")
        speeds = setup.target_speeds
        if not speeds or list(speeds) != sorted(set(speeds)):
            _refuse(where, f"agents.{agent}.target_speeds", speeds, "does not rise", "list speeds from low to high")


def check_options(options: Mapping[str, object], where: str) -> None:
    """Refuse options of SUMO with which a trial would mean something else.

    Raises:
        ScenarioError: with the option.
    """
    seen: dict[str, str] = {}
    for option, value in options.items():
        name = canonical(option)
        if name in RESERVED:
            _refuse(where, "sumo.options", option, "is an option that crashhunt sets itself", "remove it")
        if name == "mesosim" and (value == "" or is_true(value)):
            message = "simulates queues: vehicles jump from one to the next, and none can be driven"
            _refuse(where, f"sumo.options.{option}", value, message, "remove it, to simulate every vehicle")
        if name in ("configuration-file", "load-state"):
            message = "names a file that says more than a trial may take over"
            _refuse(where, "sumo.options", option, message, "write its options here instead, and begin at a time")
        if name in seen:
            _refuse(where, "sumo.options", option, f"is another name of {seen[name]!r}", "give it once")
        seen[name] = option


def _check_environment(scenario: Scenario, where: str) -> None:
    """What only SUMO would heed is refused, not passed over."""
    plain = AgentSetup()
    for agent, setup in scenario.agents.items():
        for item in fields(AgentSetup):
            value = getattr(setup, item.name)
            if item.name not in ("agent", "arguments") and value != getattr(plain, item.name):
                _refuse(where, f"agents.{agent}.{item.name}", value, "is for SUMO", "remove it")
    for name in ("warmup_s", "insertion_timeout_s"):
        if getattr(scenario, name) != getattr(Scenario, name):
            _refuse(where, name, getattr(scenario, name), "is for SUMO", "remove it")
    if scenario.highway is not None and scenario.step_length_s != _STEP_LENGTH_S:
        fix = "set policy_frequency in highway.config"
        _refuse(where, "step_length_s", scenario.step_length_s, "is not for highway-env", fix)
    if scenario.gym is not None and len(scenario.agents) != 1:
        _refuse(
            where, "agents", sorted(scenario.agents), "are several, and a Gymnasium environment has one", "keep one"
        )
    if scenario.gym is not None and scenario.observation is not None:
        _refuse(where, "observation", "", "is not for Gymnasium environments, which show what they show", "remove it")


def asked_for(content: bytes) -> list[str]:
    """Return the arguments that a file asks for as ``${NAME}``."""
    if b"${" not in content:
        return []
    return string.Template(content.decode("utf-8", "replace")).get_identifiers()


def with_action(scenario: Scenario, agent: str, action: str) -> Scenario:
    """Return the scenario with another form of action for one agent.

    Raises:
        ScenarioError: there is no such form.
    """
    if action not in ("continuous", "meta"):
        raise ScenarioError(f"there is no form of action {action!r}", fix="give continuous or meta")
    setup = replace(scenario.agents[agent], action=action)  # type: ignore[arg-type]
    return replace(scenario, agents={**scenario.agents, agent: setup})


def argument_values(scenario: Scenario) -> dict[str, Value]:
    """Return the default of every scenario argument."""
    return {name: setup.default for name, setup in scenario.arguments.items() if setup.default is not None}
