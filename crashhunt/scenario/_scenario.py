"""Scenarios: what a trial takes place in. A scenario says how to make an episode; it never is one."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict, TypeVar

from crashhunt.base import layout
from crashhunt.base.errors import ScenarioError
from crashhunt.base.integrity import digest_of_file
from crashhunt.scenario._backend import Backend, backend_of
from crashhunt.scenario.backends import DEFAULT_SIMULATOR
from crashhunt.trial import Argument, Kind, kind_of, parse_spec

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from crashhunt.base.json_types import Plain
    from crashhunt.trial import Value


__all__ = [
    "STEP_LENGTH_S",
    "AgentSetup",
    "ArgumentSetup",
    "ObservationSetup",
    "Scenario",
    "argument_values",
    "as_in_file",
    "as_plain_data",
    "digest_of_described",
    "scenario_digest",
    "with_action",
]


# The tables of a ``scenario.toml`` that every simulator has.

DEFAULT_AGENT = "crashhunt.agents:KeepLaneWithSpeed"


@dataclass(frozen=True, kw_only=True)
class ArgumentSetup:
    """``[arguments.NAME]`` or ``[agents.ID.arguments.NAME]``.

    Args:
        range: what a hunt tries, as a specification such as ``5:40``; empty where it stays at the default.
        default: the value without a request for another one.
        unit: for people.
        help: for people.
        option: of a scenario argument, its target: an option of SUMO such as ``scale``, or a dotted entry of an
            environment's configuration or keywords such as ``observation.vehicles_count``. Without an option, it
            fills ``${NAME}`` in SUMO's route and additional files, or sets the entry of its own name.
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
    """``[agents.ID]``: one controlled vehicle and who drives it. All but the first and the last are SUMO's.

    Args:
        agent: ``module:attribute``, or the name of a registered agent.
        existing: take over the vehicle ID of the traffic; otherwise one with that id is added.
        replaces: the name of a scenario argument that names a vehicle of the traffic: when that has entered, this one
            drives on in its place.
        type: the vehicle type of the added one.
        route: the route of the added one, by its id.
        edges: or the edges that it drives along (two: the way between them is looked up).
        depart_s: when it enters, in s of simulation time; the end of the warm-up by default. Of one that ``replaces``
            another, the latest time at which that may be expected.
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
    replaces: str = ""
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
        features: columns; ``kind`` says what a row is: 1 a motor vehicle, 2 a two-wheeler, 3 a person on foot, 4 what
            runs on rails, 5 an obstacle.
        normalize: scale to [-1, 1] by highway-env's ranges.
    """

    vehicles: int = 8
    features: tuple[Literal["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h", "kind"], ...] = (
        "presence",
        "x",
        "y",
        "vx",
        "vy",
        "cos_h",
        "sin_h",
    )
    normalize: bool = False


STEP_LENGTH_S = 0.1  # ten decisions a second, as drivers' models are made for
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """What a trial takes place in.

    Args:
        title: one line, for people.
        simulator: the name of a registered simulator, or ``module:attribute``.
        step_length_s: the control step, in s; that of some simulators follows from their own configuration.
        warmup_s: simulation time before the controlled vehicles enter, in s.
        insertion_timeout_s: how much later they may enter before the episode is invalid, in s.
        observation: what agents are shown; None for what the simulator shows of itself, or the default.
        arguments: the arguments that shape the traffic.
        agents: agent id to controlled vehicle.
        tables: the tables of plugin simulators by name; in the file, they are on the same level as
            these keys. Each is of the dataclass that the simulator's `Backend` says.
        events: limits of traffic events, such as ``not_moving`` in s, where they are not the default.
        disturbances: how often others err, or an agent sees or acts late: name to a rate per second. Hunts heed it, and
            nothing else.
        schema: of the file format.
        name: what people call it; the folder's name by default.
        folder: where its files are; not part of the file.
        file: what was read, relative to the folder; not part of it, and not of what crosses to a worker.
        notes: what was decided on the user's behalf, for people; not part of the file.
        added: what a later version has written into the file, for a worker of that version; nothing here reads it.
    """

    title: str = ""
    simulator: str = DEFAULT_SIMULATOR
    step_length_s: float = STEP_LENGTH_S
    warmup_s: float = 0.0
    insertion_timeout_s: float = 30.0
    observation: ObservationSetup | None = None
    arguments: dict[str, ArgumentSetup] = field(default_factory=dict)
    agents: dict[str, AgentSetup] = field(default_factory=lambda: {"ego": AgentSetup()})
    tables: dict[str, object] = field(default_factory=dict)
    events: dict[str, float] = field(default_factory=dict)
    disturbances: dict[str, float | str] = field(default_factory=dict)
    schema: Literal[1] = 1
    name: str = ""
    folder: Path = Path()
    file: str = layout.SCENARIO
    notes: tuple[str, ...] = ()
    added: dict[str, object] = field(default_factory=dict, compare=False)

    @property
    def origin(self) -> str:
        """Where errors about it point."""
        return str(self.folder / self.file)

    @property
    def backends(self) -> dict[str, Backend]:
        """The descriptor of its simulator, by name; for a simulator that has none, those of its tables.

        So a class of your own that drives a simulator which is known may be given as ``module:attribute``.
        """
        names = (self.simulator,) if backend_of(self.simulator) is not None else tuple(self.tables)
        return {name: found for name in names if (found := backend_of(name)) is not None}

    @property
    def backend(self) -> Backend:
        """The descriptor of its simulator; one that says nothing where there is none."""
        return next(iter(self.backends.values()), Backend())

    def table(self, kind: type[T]) -> T:
        """Return the table of a simulator, by its dataclass.

        Raises:
            ScenarioError: the scenario has none.
        """
        found = next((table for table in self.tables.values() if isinstance(table, kind)), None)
        if found is None:
            name = next((name for name, backend in self.backends.items() if backend.table is kind), kind.__name__)
            raise ScenarioError(f"the scenario has no [{name}] table", fix="add it", where=self.origin)
        return found

    def with_table(self, table: object) -> Scenario:
        """Return this scenario with another table of the same dataclass."""
        return replace(
            self, tables={name: table if type(old) is type(table) else old for name, old in self.tables.items()}
        )

    def files(self) -> Iterator[str]:
        """Yield the files that an episode reads, relative to the folder.

        Raises:
            ScenarioError: one of them names a file that is not there.
        """
        for backend in self.backends.values():
            yield from backend.files(self)

    def texts(self) -> Iterator[str]:
        """Yield those of the files that may say ``${NAME}``.

        Raises:
            ScenarioError: one of them names a file that is not there.
        """
        for backend in self.backends.values():
            yield from backend.texts(self)

    def modules(self) -> Iterator[str]:
        """Yield the modules that the simulator imports besides the agents': those of environments and crash rules."""
        locators = [self.simulator]
        for backend in self.backends.values():
            locators += backend.modules(self)
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


# A digest of what a scenario is: its files, and what it says.


class HasDigest(TypedDict):
    """What is written down of a file."""

    blake2b: str


def scenario_digest(scenario: Scenario) -> str:
    """Return a digest of the scenario's files and settings, independent of its agents."""
    files: dict[str, HasDigest] = {
        name: {"blake2b": digest_of_file(scenario.folder / name)} for name in scenario.files()
    }
    plain = as_plain_data(scenario)
    del plain["agents"]
    files[""] = {"blake2b": json.dumps(plain, sort_keys=True)}
    return digest_of_described(files)


def digest_of_described(files: Mapping[str, HasDigest], *, says: object = None) -> str:
    """Return a digest of files that have been described (name to an entry with ``blake2b``), and of plain data."""
    content = {name: entry["blake2b"] for name, entry in files.items()}
    text = json.dumps(content if says is None else [content, says], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def as_in_file(data: Plain) -> dict[str, object]:
    """Return the fields of a scenario as plain data, in which the simulator's table stands where it does in a file."""
    found: dict[str, object] = {}
    for key, value in data.items():
        found |= value if key == "tables" and isinstance(value, dict) else {key: value}
    return found


def as_plain_data(scenario: Scenario) -> dict[str, object]:
    """Return a scenario as plain data that TOML can hold, without values that belong to this process only."""

    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items() if item is not None}
        return [plain(item) for item in value] if isinstance(value, list | tuple) else value

    said = asdict(replace(scenario, folder=Path()))
    data = as_in_file({key: plain(value) for key, value in said.items() if value is not None})
    for later in ("events", "disturbances"):  # which an earlier crashhunt does not know
        if not data[later]:
            del data[later]
    return {key: value for key, value in data.items() if key not in ("folder", "file", "notes", "added")}
