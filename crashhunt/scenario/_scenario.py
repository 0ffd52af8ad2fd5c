"""Scenarios, and the descriptors of simulators that they need.

A `Scenario` says how to make an episode. It is plain data: no simulator is imported to read, write or digest it. A
`Backend` is the descriptor of a simulator. Scenarios, plans, snapshots and replays ask it for everything that differs
between simulators.

A simulator may have no descriptor. Then a scenario has no table for it, and crashhunt refuses to drive the recorded
actions of an untrusted bundle in it. To give your simulator a descriptor, make a `Backend` in a module that does not
import the simulator, because commands that only read a scenario import it. Register it under the simulator's name::

    [project.entry-points."crashhunt.simulators"]
    mysim = "mypackage.simulator:MySimulator"

    [project.entry-points."crashhunt.backends"]
    mysim = "mypackage.backend:BACKEND"

Then a ``scenario.toml`` may have a table ``[mysim]``. The simulator reads it by ``scenario.table(MySetup)``.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import pkgutil
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict, TypeVar

import crashhunt.scenario.backends
from crashhunt.base import layout
from crashhunt.base.errors import PluginError, ScenarioError
from crashhunt.base.integrity import digest_of_file
from crashhunt.base.plugins import load_attribute, registered
from crashhunt.base.text import listed
from crashhunt.scenario.backends import DEFAULT_SIMULATOR
from crashhunt.trial import Argument, Kind, kind_of, parse_spec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from importlib.metadata import EntryPoint

    from crashhunt.base.json_types import Json, Plain
    from crashhunt.trial import Value
    from crashhunt.world import RightOfWay


__all__ = [
    "STEP_LENGTH_S",
    "Accelerator",
    "AgentSetup",
    "ArgumentSetup",
    "Backend",
    "CompiledCore",
    "Configuration",
    "ObservationSetup",
    "RunToSurvey",
    "Scenario",
    "SurveyJob",
    "TrafficSurvey",
    "argument_values",
    "as_in_file",
    "as_plain_data",
    "backend_names",
    "backend_of",
    "configurations",
    "digest_of_described",
    "installed_backends",
    "scenario_digest",
    "titles",
    "with_action",
]


# The tables of a ``scenario.toml`` that every simulator has.

DEFAULT_AGENT = "crashhunt.agents:KeepLaneWithSpeed"


@dataclass(frozen=True, kw_only=True)
class ArgumentSetup:
    """``[arguments.NAME]`` or ``[agents.ID.arguments.NAME]``.

    Args:
        range: the values that a hunt tries, as a specification such as ``5:40``; empty for only the default.
        default: the value without a request for another one.
        unit: unit of the values, such as ``m/s``.
        help: description in one line.
        option: option of a scenario argument, its target: an option of SUMO such as ``scale``, or a dotted entry of an
            environment's configuration or keywords such as ``observation.vehicles_count``. Without an option, it
            fills ``${NAME}`` in SUMO's route and additional files, or sets the entry of its own name.
    """

    range: str = ""
    default: bool | int | float | str | None = None
    unit: str = ""
    help: str = ""
    option: str = ""

    def argument(self, name: str, where: str) -> Argument:
        """Return the argument with the given name."""
        kind: Kind | None = kind_of(self.default) if self.default is not None else None
        distribution = parse_spec(self.range, kind, where=f"{where}.{name}.range") if self.range else None
        return Argument(
            name=name, kind=kind, default=self.default, distribution=distribution, unit=self.unit, help=self.help
        )


@dataclass(frozen=True, kw_only=True)
class AgentSetup:
    """``[agents.ID]``: one controlled vehicle and its agent. All but the first and the last are SUMO's.

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
        arguments: the arguments of the agent that the scenario describes.
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
    """``[observation]``: the observation of an agent, in the layout of highway-env's Kinematics.

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
    """The setting of a trial: network, traffic, controlled vehicles and their arguments.

    Args:
        title: description in one line.
        simulator: the name of a registered simulator, or ``module:attribute``.
        step_length_s: the control step, in s; that of some simulators follows from their own configuration.
        warmup_s: simulation time before the controlled vehicles enter, in s.
        insertion_timeout_s: maximum delay of their entry, in s; after it, the episode is invalid.
        observation: layout of the observations; None for the simulator's own layout, or the default.
        arguments: the arguments that shape the traffic.
        agents: agent id to controlled vehicle.
        tables: the tables of plugin simulators by name; in the file, they are on the same level as
            these keys. Each is of the dataclass that the simulator's `Backend` says.
        events: limits of traffic events, such as ``not_moving`` in s, where they are not the default.
        disturbances: faults of other vehicles and of the agent's sensors: name to a rate per second. Only hunts use
            them.
        schema: schema of the file format.
        name: name for users; by default the name of the folder.
        folder: folder of its files; not part of the file.
        file: path of the file that was read, relative to the folder; it is not sent to workers.
        notes: decisions of crashhunt, as texts for the user; not part of the file.
        added: keys that a later version has written into the file; only a worker of that version reads them.
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
        """The place that errors about the scenario name."""
        return str(self.folder / self.file)

    @property
    def backends(self) -> dict[str, Backend]:
        """The descriptor of the scenario's simulator, by name; without one, the descriptors of its tables.

        So a class of your own that drives a simulator which is known may be given as ``module:attribute``.
        """
        names = (self.simulator,) if backend_of(self.simulator) is not None else tuple(self.tables)
        return {name: found for name in names if (found := backend_of(name)) is not None}

    @property
    def backend(self) -> Backend:
        """The descriptor of the scenario's simulator; an empty descriptor if there is none."""
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
        """Yield the files that may contain ``${NAME}``.

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
        """Return the scenario's settings of the arguments of an agent."""
        where = f"{self.origin}: agents.{agent}.arguments"
        return {name: setup.argument(name, where) for name, setup in self.agents[agent].arguments.items()}

    def with_agents(self, locators: dict[str, str]) -> Scenario:
        """Return this scenario with other agents. The arguments of the replaced agents are dropped."""
        agents = dict(self.agents)
        for agent, locator in locators.items():
            if agents[agent].agent != locator:
                agents[agent] = replace(agents[agent], agent=locator, arguments={})
        return replace(self, agents=agents)


def with_action(scenario: Scenario, agent: str, action: str) -> Scenario:
    """Return the scenario with another form of action for one agent.

    Raises:
        ScenarioError: the form of action does not exist.
    """
    if action not in ("continuous", "meta"):
        raise ScenarioError(f"{action!r} is not a form of action", fix="give continuous or meta")
    setup = replace(scenario.agents[agent], action=action)  # type: ignore[arg-type]
    return replace(scenario, agents={**scenario.agents, agent: setup})


def argument_values(scenario: Scenario) -> dict[str, Value]:
    """Return the default of every scenario argument."""
    return {name: setup.default for name, setup in scenario.arguments.items() if setup.default is not None}


# A digest of what a scenario is: its files, and what it says.


class HasDigest(TypedDict):
    """The recorded properties of a file."""

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


def digest_of_described(files: Mapping[str, HasDigest], *, plain_data: object = None) -> str:
    """Return a digest of files and of plain data.

    Args:
        files: name of each file to an entry with its digest, ``blake2b``.
        plain_data: what JSON can hold; None if only the files matter.
    """
    content = {name: entry["blake2b"] for name, entry in files.items()}
    text = json.dumps(content if plain_data is None else [content, plain_data], sort_keys=True)
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


# The descriptor of a simulator.


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A file format of the simulator that can be run without a ``scenario.toml``.

    Args:
        endings: endings of its name, such as ``.sumocfg``; messages name the first one.
        load: returns it as a scenario, from its path and from what ``--ego`` says, which may be empty.
        arguments: the scenario arguments that every such scenario has, for completion in the shell.
        takes_ego: whether ``--ego`` chooses its controlled vehicle.
        waiting: a slow step of loading, in words; empty if there is none.
    """

    endings: tuple[str, ...]
    load: Callable[[Path, str], Scenario]
    arguments: tuple[str, ...] = ()
    takes_ego: bool = True
    waiting: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Accelerator:
    """An accelerator of a simulator: results are bit-identical, only the speed changes.

    Args:
        switched_off: returns a scenario without it, as ``--no-accelerate`` asks for.
        note: returns a note for a user if it has no effect; empty if it has one, or is switched off.
    """

    switched_off: Callable[[Scenario], Scenario]
    note: Callable[[Scenario], str]


@dataclass(frozen=True, slots=True, kw_only=True)
class CompiledCore:
    """An optional compiled part, with bit-identical results.

    Args:
        switched_off: returns a scenario without it, as ``--no-native`` asks for.
        why_not: returns why it is not used, in words that follow "not used: "; empty if it is.
    """

    switched_off: Callable[[Scenario], Scenario]
    why_not: Callable[[Scenario], str]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadOrder:
    """An order in which a simulator processes a scenario at load, which crashhunt fixes where it can.

    Without it, results depend on the memory addresses in a process.

    Args:
        what: the objects that are in the order, in words.
        keep: returns a scenario that keeps the simulator's own order.
        why_not: returns why the order is not fixed, in words that follow "not fixed: "; empty if it is.
    """

    what: str
    keep: Callable[[Scenario], Scenario]
    why_not: Callable[[Scenario], str]


def _no_notes(_scenario: Scenario) -> Iterable[str]:
    return ()


def _accepted(_scenario: Scenario, _where: str) -> None:
    return None


def _same_scenario(_scenario: Scenario, _ego: str) -> None:
    return None


def _own_arguments(scenario: Scenario) -> float:
    return scenario.step_length_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Backend:
    """The properties of a simulator that other packages need; all of them are optional.

    Functions are called with the scenario, whose table is ``scenario.table(KIND)``; paths are relative to its folder.

    Args:
        title: name for users.
        table: the dataclass of its table in ``scenario.toml``; its types must be there at run time, and may be numbers,
            text, lists, tuples and tables of those, and further dataclasses.
        example: the required keys of the table, for the message about a missing table.
        keys: those keys of ``scenario.toml`` that not every simulator heeds and this one does (``warmup_s``,
            ``insertion_timeout_s``, ``agents.route``, …): all others are refused. None if that is unknown.
        shows_itself: whether agents are shown what the simulator shows of itself, where there is no ``[observation]``.
        check: raises `ScenarioError` for a scenario that cannot be meant, given the file for its ``where``.
        check_names: the same for what its files do not define, given what ``--ego`` says; not asked about what has run.
        files: what an episode reads; it is part of the digest, and travels in the snapshot.
        texts: those of ``files`` that may say ``${NAME}``, for a scenario argument.
        relocated: returns the content of one of ``texts`` as it is right wherever its folder goes, None if it is.
        modules: the code of the user's that it imports besides the agents', as ``module:attribute``. Names without
            a colon are ignored, so the id of an environment is allowed.
        notes: lines for the user about decisions of crashhunt.
        versions: the distributions on whose version everything depends that it computes.
        variables: variables of the environment, on which it depends; written down with the versions.
        per_processor: whether it may round otherwise on another processor.
        step_length_s: the control step, in s, where it is not the scenario's own.
        reported_events: the types of traffic events that it reports; None if that is unknown.
        disturbances: the types of disturbances of the traffic that it supports; None if that is unknown.
        actions: the forms of action (``continuous``, ``meta``) that ``--action`` may choose.
        accelerator: the accelerator of the simulator; None if it has none.
        core: the compiled part; None if there is none.
        load_order: the order at load on which its results depend; None if there is none.
        configurations: file formats that can be run without a ``scenario.toml``.
        explained: returns the mistake in the scenario after a failed setup, from the message of the failure and from
            printed output; None if the scenario is not the cause.
        side_effect: of a stranger's scenario, returns what it would do besides simulating, in words that
            follow "the crash is a stranger's, and"; empty if it does nothing else. It is given the values of the
            trial's scenario arguments, and the specifications of those that are texts. Without, strangers are refused.
        right_of_way: returns the vehicles that have to give way at the junctions of the map; None if unknown.
        plays_paths: whether it can move others along recorded ways.
        one_per_process: whether a process can have only one simulation at a time.
        forkable: whether it is known that a process can be forked after it has made the simulator, which starts no
            threads. Otherwise a fork finds out before the first trial.
        survey: how it finds, before a hunt, the vehicles that an agent can replace in one of its ``configurations``.
    """

    title: str = ""
    table: type | None = None
    example: str = "what it needs"
    keys: frozenset[str] | None = None
    shows_itself: bool = False
    check: Callable[[Scenario, str], None] = _accepted
    check_names: Callable[[Scenario, str], None] = _same_scenario
    files: Callable[[Scenario], Iterable[str]] = _no_notes
    texts: Callable[[Scenario], Iterable[str]] = _no_notes
    relocated: Callable[[Path], bytes | None] | None = None
    modules: Callable[[Scenario], Iterable[str]] = _no_notes
    notes: Callable[[Scenario], Iterable[str]] = _no_notes
    versions: tuple[str, ...] = ()
    variables: tuple[str, ...] = ()
    per_processor: bool = False
    step_length_s: Callable[[Scenario], float] = _own_arguments
    reported_events: tuple[str, ...] | None = None
    disturbances: tuple[str, ...] | None = None
    actions: tuple[str, ...] = ()
    accelerator: Accelerator | None = None
    core: CompiledCore | None = None
    load_order: LoadOrder | None = None
    configurations: tuple[Configuration, ...] = ()
    explained: Callable[[str, str, Scenario], ScenarioError | None] | None = None
    side_effect: Callable[[Scenario, Mapping[str, Value], Iterable[str]], str] | None = None
    right_of_way: Callable[[Scenario], RightOfWay | None] | None = None
    plays_paths: bool = False
    one_per_process: bool = False
    forkable: bool = False
    survey: TrafficSurvey | None = None

    def __post_init__(self) -> None:
        if self.table is not None and not is_dataclass(self.table):
            # What is no dataclass would neither be written down nor sent to a worker.
            raise TypeError(f"the table of a backend is a dataclass, and {self.table!r} is none")


# Which simulators have a descriptor, and where it is.


@cache
def _own_backends() -> tuple[str, ...]:
    # Crashhunt's own simulators are found by module and not by entry point: a bundle brings a crashhunt of its own
    # along, and what is installed around it may be of a version in which they are elsewhere.
    return tuple(sorted(module.name for module in pkgutil.iter_modules(crashhunt.scenario.backends.__path__)))


def _plugin_backends() -> Mapping[str, EntryPoint]:
    return registered("backends")


def backend_names() -> tuple[str, ...]:
    """Return the simulators that have a descriptor, those that come with crashhunt first; nothing is imported."""
    return tuple(dict.fromkeys((*_own_backends(), *_plugin_backends())))


@cache
def backend_of(name: str) -> Backend | None:
    """Return the descriptor of a simulator; None if it has none.

    Args:
        name: name under which the simulator is registered; a ``module:attribute`` has none.

    Raises:
        PluginError: there is one, and it cannot be imported, or is something else.
    """
    if name in _own_backends():
        own: Backend = importlib.import_module(f"crashhunt.scenario.backends.{name}").BACKEND
        return own
    point = _plugin_backends().get(name)
    if point is None:
        return None
    found = load_attribute(point.value, shown=name)
    if not isinstance(found, Backend):
        message = f"the backend {name!r} is a {type(found).__name__}"
        raise PluginError(message, fix="make it a crashhunt.scenario.Backend", where=point.value)
    return found


def installed_backends() -> Iterator[tuple[str, Backend]]:
    """Yield all usable descriptors by name; broken ones are skipped."""
    for name in backend_names():
        try:
            found = backend_of(name)
        except PluginError:
            continue
        if found is not None:
            yield name, found


def configurations() -> Iterator[Configuration]:
    """Yield the files of simulators' own that are run as they are."""
    for _, backend in installed_backends():
        yield from backend.configurations


def titles(chosen: Callable[[Backend], bool]) -> str:
    """Return in words what simulators something is for."""
    return listed(
        (backend.title or name for name, backend in installed_backends() if chosen(backend)), none="another simulator"
    )


# What a hunt finds out about the plain traffic of a configuration before its first trial.


class RunToSurvey(TypedDict):
    """One run of the plain traffic."""

    seed: int
    values: dict[str, Value]


class SurveyJob(TypedDict):
    """What the process that simulates the plain traffic reads from its JSON file.

    ``scenario`` is what `as_plain_data` returns, ``folder`` holds the scenario's files, ``stage`` is a folder of the
    process's own, ``answer`` the file for the JSON list of completed runs. The process ends a run after
    ``processor_time_limit_s`` since its start.
    """

    scenario: Plain
    folder: str
    stage: str
    answer: str
    processor_time_limit_s: float
    runs: list[RunToSurvey]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficSurvey:
    """How a simulator finds the vehicles that an agent can replace: it simulates the traffic before the hunt.

    Args:
        module: its ``main()`` runs in its own process, with the file of a `SurveyJob` as its only argument.
        refine: returns the scenario with the candidates that the runs confirm, from what ``module`` answered. Raises
            `ScenarioError` where no trial can be valid.
        restore: returns the scenario with the candidates of an earlier hunt, given the scenario that this hunt kept;
            None if the hunt drew no candidates.
    """

    module: str
    refine: Callable[[Scenario, Json], Scenario]
    restore: Callable[[Scenario, Scenario], Scenario | None]
