"""Scenarios: what a trial takes place in. A scenario says how to make an episode; it never is one.

A scenario is a folder with a ``scenario.toml``, or a bare ``.sumocfg`` that nobody wrote for us.
"""

from __future__ import annotations

import difflib
import os
import string
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.errors import ArgumentError, ScenarioError
from crashhunt.simulators._sumo_files import RESERVED
from crashhunt.space import Argument, Kind, Value, kind_of, parse_spec

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = [
    "AgentSetup",
    "ArgumentSetup",
    "ObservationSetup",
    "Scenario",
    "SumoSetup",
    "argument_values",
    "asked_for",
    "load_scenario",
    "scenario_from_dict",
    "shipped_folder",
    "shipped_scenarios",
    "with_action",
]

DEFAULT_AGENT = "crashhunt.agents:KeepLaneWithSpeed"


@dataclass(frozen=True, kw_only=True)
class ArgumentSetup:
    """``[arguments.NAME]`` or ``[agents.ID.arguments.NAME]``.

    Args:
        range: what a hunt tries, as a specification such as ``5:40``; empty where it stays at the default.
        default: the value when nobody asks for another.
        unit: for people.
        help: for people.
        option: of a scenario argument, the SUMO option that it sets, such as ``scale``.
            Where there is none, it fills ``${NAME}`` in the scenario's route and additional files.
    """

    range: str = ""
    default: bool | int | float | str | None = None
    unit: str = ""
    help: str = ""
    option: str = ""

    def argument(self, name: str, where: str) -> Argument:
        """Return what this says about the argument ``name``."""
        kind: Kind | None = kind_of(self.default) if self.default is not None else None
        distribution = parse_spec(self.range, kind, where=f"{where}.{name}.range") if self.range else None
        return Argument(name, kind, self.default, distribution, self.unit, self.help)


@dataclass(frozen=True, kw_only=True)
class AgentSetup:
    """``[agents.ID]``: one controlled vehicle and who drives it.

    Args:
        agent: ``module:attribute``, or the name of a registered agent.
        existing: take over the vehicle ID of the traffic; otherwise one with that id is added.
        type: the vehicle type of the added one.
        route: the route of the added one, by its id.
        edges: or the edges that it drives along (two: the way between them is looked up).
        depart_s: when it enters, in s of simulation time; the end of the warm-up by default.
        depart_lane: as SUMO's departLane.
        depart_pos: as SUMO's departPos.
        depart_speed: as SUMO's departSpeed.
        action: ``continuous`` is (target speed, lane change); ``meta`` is highway-env's DiscreteMetaAction.
        target_speeds: the speeds that FASTER and SLOWER of ``meta`` step through, in m/s.
        speed_mode: SUMO's speed mode bits; 6 keeps physical limits and ignores the safe speed.
        arguments: what is known about the agent's arguments here.
    """

    agent: str = DEFAULT_AGENT
    existing: bool = False
    type: str = "DEFAULT_VEHTYPE"
    route: str = ""
    edges: tuple[str, ...] = ()
    depart_s: float | None = None
    depart_lane: str = "best"
    depart_pos: str = "base"
    depart_speed: str = "max"
    action: Literal["continuous", "meta"] = "continuous"
    target_speeds: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
    speed_mode: int = 6
    arguments: dict[str, ArgumentSetup] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ObservationSetup:
    """``[observation]``: what an agent is shown; the layout is highway-env's Kinematics.

    Args:
        vehicles: rows: the controlled vehicle and its nearest actors.
        features: columns.
        normalize: scale to [-1, 1] by highway-env's ranges.
    """

    vehicles: int = 8
    features: tuple[Literal["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h"], ...] = (
        "presence",
        "x",
        "y",
        "vx",
        "vy",
        "cos_h",
        "sin_h",
    )
    normalize: bool = False


@dataclass(frozen=True, kw_only=True)
class SumoSetup:
    """``[sumo]``: files, relative to the scenario's folder, and further options of SUMO.

    Args:
        net: the network.
        routes: route files.
        additional: additional files.
        options: further options of SUMO without their dashes, such as ``lateral-resolution``.
    """

    net: str
    routes: tuple[str, ...] = ()
    additional: tuple[str, ...] = ()
    options: dict[str, bool | int | float | str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """What a trial takes place in.

    Args:
        title: one line, for people.
        simulator: the name of a registered simulator, or ``module:attribute``.
        step_length_s: the control step, in s.
        warmup_s: simulation time before the controlled vehicles enter, in s.
        insertion_timeout_s: how much later they may enter before the episode is invalid, in s.
        observation: what agents are shown.
        arguments: the arguments that shape the traffic.
        agents: agent id to controlled vehicle.
        sumo: files and options, where the simulator is SUMO.
        schema: of the file format.
        name: what people call it; the folder's name by default.
        folder: where its files are; not part of the file.
        notes: what was decided on the user's behalf, for people; not part of the file.
    """

    title: str = ""
    simulator: str = "sumo"
    step_length_s: float = 0.1
    warmup_s: float = 0.0
    insertion_timeout_s: float = 30.0
    observation: ObservationSetup = field(default_factory=ObservationSetup)
    arguments: dict[str, ArgumentSetup] = field(default_factory=dict)
    agents: dict[str, AgentSetup] = field(default_factory=lambda: {"ego": AgentSetup()})
    sumo: SumoSetup | None = None
    schema: Literal[1] = 1
    name: str = ""
    folder: Path = Path()
    notes: tuple[str, ...] = ()

    @property
    def origin(self) -> str:
        """Where errors about it point."""
        return str(self.folder / "scenario.toml")

    def files(self) -> Iterator[str]:
        """Yield the files that an episode reads, relative to the folder."""
        if self.sumo is not None:
            yield self.sumo.net
            yield from self.sumo.routes
            yield from self.sumo.additional

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
    package = Path(__file__).resolve().parent
    inside = package / "scenarios"
    return inside if inside.is_dir() else package.parent / "scenarios"


def shipped_scenarios() -> tuple[str, ...]:
    """Return the names of the scenarios that come with crashhunt."""
    return tuple(sorted(path.parent.name for path in shipped_folder().glob("*/scenario.toml")))


def load_scenario(name: str | Path, *, ego: str = "") -> Scenario:
    """Load a scenario.

    Args:
        name: of a shipped one, or the path of a folder, a ``scenario.toml`` or a ``.sumocfg``.
        ego: for a ``.sumocfg``, which vehicle is controlled: ``VEHICLE``, ``vehicle=ID``, ``route=ID`` or
            ``edges=FROM,TO``.

    Raises:
        ScenarioError: it does not exist or is not valid, with file, key, value and the fix.
    """
    path = Path(name)
    text = str(name)
    if text in shipped_scenarios():  # a folder of the same name is ./NAME
        path = shipped_folder() / text
    if path.is_dir():
        path = path / "scenario.toml"
    if not path.is_file():
        close = difflib.get_close_matches(text, shipped_scenarios(), 1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        shipped = ", ".join(shipped_scenarios())
        raise ScenarioError(
            f"there is no scenario {text!r}",
            fix=f"{hint}give one of {shipped}, or the path of a folder, a scenario.toml or a .sumocfg",
        )
    if path.suffix == ".toml":
        if ego:
            raise ScenarioError(
                f"--ego {ego!r} is for a bare .sumocfg", fix="set the vehicle under [agents] instead", where=str(path)
            )
        return _load_toml(path)
    if path.name.endswith((".sumocfg", ".sumo.cfg")):
        from crashhunt.sumocfg import load_sumocfg

        return load_sumocfg(path, ego=ego)
    raise ScenarioError(
        f"{path.name!r} is neither a scenario.toml nor a .sumocfg", fix="give one of the two", where=str(path)
    )


def _load_toml(path: Path) -> Scenario:
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"not valid TOML: {error}", fix="mend the file", where=str(path)) from None
    except OSError as error:
        raise ScenarioError(f"cannot be read: {error.strerror}", where=str(path)) from None
    for key in ("folder", "notes"):
        if key in data:
            raise ScenarioError(f"unknown key {key!r}", fix="remove it", where=str(path))
    scenario = scenario_from_dict(data, where=str(path), folder=path.resolve().parent)
    _check(scenario, str(path))
    return scenario


def scenario_from_dict(data: dict[str, Any], *, where: str, folder: Path) -> Scenario:
    """Validate what a ``scenario.toml`` says, without looking at the files that it names.

    Raises:
        ScenarioError: with the key, its value and the fix.
    """
    from crashhunt._validation import validate

    scenario = validate(Scenario, data, where=where, error=ScenarioError)
    return replace(scenario, folder=folder, name=scenario.name or folder.name)


def _check(scenario: Scenario, where: str) -> None:
    def refuse(key: str, value: object, message: str, fix: str) -> None:
        raise ScenarioError(f"{key} = {value!r} {message}", fix=fix, where=where)

    if not scenario.agents:
        refuse("agents", {}, "names no controlled vehicle", "add a table [agents.ego]")
    for key in ("step_length_s", "insertion_timeout_s"):
        value = getattr(scenario, key)
        if not 0 < value < float("inf"):
            refuse(key, value, "is not a time above 0", "give seconds, such as 0.1")
    if not 0 <= scenario.warmup_s < float("inf"):
        refuse("warmup_s", scenario.warmup_s, "is not a time", "give seconds, such as 20.0")
    if scenario.observation.vehicles < 1:
        refuse("observation.vehicles", scenario.observation.vehicles, "is below 1", "give at least 1")
    if scenario.simulator == "sumo" and scenario.sumo is None:
        refuse("sumo", None, "is missing", "add a table [sumo] with net and routes")
    for option in scenario.sumo.options if scenario.sumo else ():
        if option in RESERVED:
            refuse("sumo.options", option, "is an option that crashhunt sets itself", "remove it")
    for file in scenario.files():
        path = Path(os.path.normpath(scenario.folder / file))
        if not path.is_file():
            refuse("sumo", file, "does not exist", f"give a path relative to {scenario.folder}")
        if not path.is_relative_to(scenario.folder):
            refuse("sumo", file, "lies outside the scenario's folder", "move it inside, so that it can be archived")
    for file in (*scenario.sumo.routes, *scenario.sumo.additional) if scenario.sumo else ():
        for name in asked_for((scenario.folder / file).read_bytes()):
            if name not in scenario.arguments:
                refuse("arguments", sorted(scenario.arguments), f"has no {name!r}, which {file} asks for", "declare it")
    for agent, setup in scenario.agents.items():
        named = [key for key in ("existing", "route", "edges") if getattr(setup, key)]
        if scenario.sumo is not None and len(named) != 1:
            refuse(f"agents.{agent}", named, "must have one of existing, route, edges", "give exactly one of them")
        if not setup.target_speeds or list(setup.target_speeds) != sorted(set(setup.target_speeds)):
            refuse(
                f"agents.{agent}.target_speeds", setup.target_speeds, "does not rise", "list speeds from low to high"
            )
    try:
        scenario.scenario_arguments()
        for agent in scenario.agents:
            scenario.agent_arguments(agent)
    except ArgumentError as error:
        raise ScenarioError(error.message, fix=error.fix, where=error.where) from None


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
