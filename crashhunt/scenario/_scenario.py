"""Scenarios, and the descriptors of the simulators in which scenarios run.

A `Scenario` describes how to set up an episode. A scenario is plain data, so reading, writing or hashing it imports no
simulator. A `Backend` is the descriptor of a simulator. Scenarios, plans, snapshots and replays use the descriptor for
everything that differs between simulators.

The descriptor of a simulator is optional. Without a descriptor, a scenario has no table for the simulator, and
crashhunt refuses to replay the recorded actions of an untrusted bundle in this simulator. To give your simulator a
descriptor, make a `Backend` in a module that does not import the simulator, because commands that only read a scenario
import it. Register it under the simulator's name::

    [project.entry-points."crashhunt.simulators"]
    mysim = "mypackage.simulator:MySimulator"

    [project.entry-points."crashhunt.backends"]
    mysim = "mypackage.backend:BACKEND"

Then a ``scenario.toml`` may contain a table ``[mysim]``. The simulator reads this table by ``scenario.table(MySetup)``.
"""

from __future__ import annotations

import hashlib
import importlib
import json
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict, TypeVar

from crashhunt.base import layout
from crashhunt.base.errors import PluginError, ScenarioError
from crashhunt.base.integrity import digest_of_file
from crashhunt.base.plugins import load_attribute, registered
from crashhunt.base.text import listed
from crashhunt.scenario._action_forms import action_settings, canonical_action, with_whole_vehicle_visible
from crashhunt.trial import Argument, Kind, kind_of, parse_spec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from importlib.metadata import EntryPoint

    from crashhunt.base.json_types import Json, Plain
    from crashhunt.trial import Value
    from crashhunt.world import RightOfWay, StopLine


# The tables of a ``scenario.toml`` that every simulator has.

DEFAULT_AGENT = "crashhunt.agents:KeepLaneWithSpeed"
DEFAULT_SIMULATOR = "sumo"
"""The simulator of a ``scenario.toml`` without one. It may never change: it is part of the file format, and messages to
workers of older versions omit default values."""


@dataclass(frozen=True, kw_only=True)
class ArgumentSetup:
    """The table ``[arguments.NAME]`` or ``[agents.ID.arguments.NAME]`` of a scenario.

    Args:
        range: the values that a hunt tries, as a specification such as ``5:40``; if empty, a hunt uses only the
            default.
        default: the value used if the user requests no other value.
        unit: unit of the values, such as ``m/s``.
        help: description of the argument in one line.
        option: the target of a scenario argument: an option of SUMO such as ``scale``, or a dotted entry of an
            environment's configuration or keywords such as ``observation.vehicles_count``. If it is empty, the argument
            fills ``${NAME}`` in SUMO's route and additional files, or sets the entry with the argument's name.
    """

    range: str = ""
    default: bool | int | float | str | None = None
    unit: str = ""
    help: str = ""
    option: str = ""

    def argument(self, name: str, where: str) -> Argument:
        """Return the argument that this table describes, with the given name."""
        kind: Kind | None = kind_of(self.default) if self.default is not None else None
        distribution = parse_spec(self.range, kind, where=f"{where}.{name}.range") if self.range else None
        return Argument(
            name=name, kind=kind, default=self.default, distribution=distribution, unit=self.unit, help=self.help
        )


@dataclass(frozen=True, kw_only=True)
class AgentSetup:
    """``[agents.ID]``: one controlled vehicle and its agent.

    All keys but ``agent``, ``reuse`` and ``arguments`` apply to SUMO only.

    Args:
        agent: the agent that drives, as ``module:attribute`` or by the name of a registered agent.
        existing: whether the agent controls the vehicle ID of the traffic; otherwise, a vehicle with this id is added.
        replaces: name of a scenario argument that names a vehicle of the traffic. When this vehicle has entered, the
            controlled vehicle replaces it.
        type: SUMO's vehicle type of the added vehicle.
        route: id of the added vehicle's route.
        edges: edges of the added vehicle's route, instead of ``route``; for two edges, the shortest route between them
            is used.
        depart_s: time at which the vehicle enters, in s of simulation time; by default the end of the warm-up. For a
            vehicle that ``replaces`` another vehicle, the latest time at which the other vehicle may be expected.
        depart_lane: lane of departure, as in SUMO's departLane.
        depart_pos: position of departure, as in SUMO's departPos.
        depart_speed: speed at departure, as in SUMO's departSpeed.
        action: form of the actions, a name that ``crashhunt list actions`` shows. Settings follow, such as
            ``trajectory:frame=ego``. The default is the form that the agent's class declares, or else
            ``speed_and_lane``.
        target_speeds: the target speeds that the actions FASTER and SLOWER of ``meta`` select in order, in m/s.
        observation: parts that the agent observes, such as ``ego`` or ``actors:rows=8``; ``crashhunt list
            observations`` prints all parts. Without this key, the agent's class chooses the parts, or else the agent
            observes Kinematics.
        reuse: whether the program of the agent (``exec``) drives in one trial after another; see ``--reuse``.
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
    action: str | None = None
    target_speeds: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
    speed_mode: int = 6
    observation: tuple[str, ...] | None = None
    reuse: bool = False
    arguments: dict[str, ArgumentSetup] = field(default_factory=dict)

    @property
    def action_form(self) -> str:
        """The name of the form of the actions."""
        return canonical_action(self.action)

    @property
    def action_settings(self) -> dict[str, float | str]:
        """The value of every setting of the form of the actions, by name."""
        return action_settings(self.action)

    @property
    def observes_parts(self) -> bool:
        """Whether the agent observes parts that it or the scenario names, and not the default observation."""
        return bool(self.observation) and self.observation != ("kinematics",)

    @property
    def refused_disturbances(self) -> frozenset[str]:
        """The kinds of disturbances that would make the agent's plans begin where the vehicle is not.

        A plan begins where the vehicle is in the step of the plan, with its speed. So a plan cannot be delayed, and an
        exact trajectory cannot be made from a wrong or late observation.
        """
        if self.action_form not in ("trajectory", "target_pose"):
            return frozenset()
        is_exact = self.action_settings.get("tracker") == "interpolation"
        return frozenset({"late_action", *(("late_observation", "noisy_observation") if is_exact else ())})


@dataclass(frozen=True, kw_only=True)
class ObservationSetup:
    """``[observation]``: the observation of an agent, in the layout of highway-env's Kinematics.

    Args:
        vehicles: number of rows: the controlled vehicle and its nearest actors.
        features: names of the columns; ``kind`` is the type of the actor: 1 motor vehicle, 2 two-wheeler, 3 pedestrian,
            4 rail vehicle, 5 obstacle.
        normalize: whether values are scaled to [-1, 1] by the ranges of highway-env.
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
_WARNING = "warning: "  # what the notes begin with that are facts about each trial


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """The setting of a trial: network, traffic, controlled vehicles and their arguments.

    Args:
        title: description of the scenario in one line.
        simulator: the name of a registered simulator, or ``module:attribute``.
        step_length_s: length of a control step, in s; some simulators derive it from their own configuration.
        warmup_s: simulation time before the controlled vehicles enter, in s.
        insertion_timeout_s: maximum delay until the controlled vehicles enter, in s; after this delay, the episode is
            invalid.
        observation: layout of the observations; None for the simulator's own layout, or the default.
        arguments: the arguments that shape the traffic.
        agents: setup of each controlled vehicle, by agent id.
        tables: the tables of plugin simulators by name; in ``scenario.toml``, the tables are top-level keys. The
            simulator's `Backend` gives the dataclass of its table.
        events: limits of traffic events that differ from the default, such as ``not_moving`` in s.
        disturbances: disturbances, which are faults of other vehicles and of the agent's sensors: rate per second by
            name. Only hunts use disturbances.
        requirement: what must hold, as formulas in temporal logic, by name. Only hunts use requirements.
        schema: version of the file format.
        name: name shown to users; by default the name of the folder.
        folder: folder of the scenario's files; not part of the file.
        file: path of the file that was read, relative to the folder; workers do not receive it.
        notes: decisions of crashhunt, as texts for the user; not part of the file.
        added: keys that a later version of crashhunt wrote into the file; only a worker of that version reads them.
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
    requirement: dict[str, str] = field(default_factory=dict)
    schema: Literal[1] = 1
    name: str = ""
    folder: Path = Path()
    file: str = layout.SCENARIO
    notes: tuple[str, ...] = ()
    added: dict[str, object] = field(default_factory=dict, compare=False)

    @property
    def origin(self) -> str:
        """The path with which error messages identify the scenario."""
        return str(self.folder / self.file)

    @property
    def warnings(self) -> list[str]:
        """The notes that are warnings, such as of demand that the simulator omits; facts about each trial."""
        return [note.removeprefix(_WARNING) for note in self.notes if note.startswith(_WARNING)]

    @property
    def backends(self) -> dict[str, Backend]:
        """The descriptor of the scenario's simulator, by name; if it has none, the descriptors of its tables.

        If the scenario names your own class (``module:attribute``) that drives a known simulator, the scenario's table
        for this simulator determines the descriptor.
        """
        names = (self.simulator,) if backend_of(self.simulator) is not None else tuple(self.tables)
        return {name: found for name in names if (found := backend_of(name)) is not None}

    @property
    def backend(self) -> Backend:
        """The descriptor of the scenario's simulator; an empty descriptor if there is none."""
        return next(iter(self.backends.values()), Backend())

    def table(self, kind: type[T]) -> T:
        """Return the table of a simulator, given the table's dataclass.

        Raises:
            ScenarioError: the scenario has no such table.
        """
        found = next((table for table in self.tables.values() if isinstance(table, kind)), None)
        if found is None:
            name = next((name for name, backend in self.backends.items() if backend.table is kind), kind.__name__)
            raise ScenarioError(f"the scenario has no [{name}] table", fix="add it", where=self.origin)
        return found

    def with_table(self, table: object) -> Scenario:
        """Return this scenario with the given table in place of its table of the same dataclass."""
        return replace(
            self, tables={name: table if type(old) is type(table) else old for name, old in self.tables.items()}
        )

    def files(self) -> Iterator[str]:
        """Yield the paths of the files that an episode reads, relative to the folder.

        Raises:
            ScenarioError: one of the files names a file that does not exist.
        """
        for backend in self.backends.values():
            yield from backend.files(self)

    def texts(self) -> Iterator[str]:
        """Yield the paths of the files that may contain ``${NAME}``.

        Raises:
            ScenarioError: one of the files names a file that does not exist.
        """
        for backend in self.backends.values():
            yield from backend.texts(self)

    def modules(self) -> Iterator[str]:
        """Yield the modules that the simulator imports besides the agents, such as environments and crash rules."""
        locators = [self.simulator]
        for backend in self.backends.values():
            locators += backend.modules(self)
        yield from (locator.partition(":")[0] for locator in locators if ":" in locator)

    def scenario_arguments(self) -> dict[str, Argument]:
        """Return the arguments that shape the traffic."""
        return {name: setup.argument(name, f"{self.origin}: arguments") for name, setup in self.arguments.items()}

    def agent_arguments(self, agent: str) -> dict[str, Argument]:
        """Return the settings of an agent's arguments in the scenario."""
        where = f"{self.origin}: agents.{agent}.arguments"
        return {name: setup.argument(name, where) for name, setup in self.agents[agent].arguments.items()}

    def with_agents(self, locators: dict[str, str]) -> Scenario:
        """Return this scenario with other agents. The arguments of the replaced agents are dropped."""
        agents = dict(self.agents)
        for agent, locator in locators.items():
            if agents[agent].agent != locator:
                agents[agent] = replace(agents[agent], agent=locator, arguments={})
        return replace(self, agents=agents)


def with_action(scenario: Scenario, agent: str, action: str, where: str = "action") -> Scenario:
    """Return the scenario with another form of actions for one agent; `where` names the form's origin in messages.

    Raises:
        UsageError: the form of actions or a setting of it does not exist.
    """
    action_settings(action, where=where)
    setup = replace(scenario.agents[agent], action=action)
    return replace(scenario, agents={**scenario.agents, agent: setup})


def with_whole_vehicles_visible(scenario: Scenario) -> Scenario:
    """Return the scenario with the forms of actions that `with_whole_vehicle_visible` returns."""
    agents = {
        agent: replace(setup, action=with_whole_vehicle_visible(setup.action))
        for agent, setup in scenario.agents.items()
    }
    return replace(scenario, agents=agents) if scenario.backend.actions else scenario


def with_observations(scenario: Scenario, observations: Mapping[str, tuple[str, ...]]) -> Scenario:
    """Return the scenario with the parts that agents observe, by agent; the other agents do not change."""
    agents = {
        agent: replace(setup, observation=observations[agent]) if agent in observations else setup
        for agent, setup in scenario.agents.items()
    }
    return replace(scenario, agents=agents)


def argument_values(scenario: Scenario) -> dict[str, Value]:
    """Return the default of every scenario argument."""
    return {name: setup.default for name, setup in scenario.arguments.items() if setup.default is not None}


# A digest of what a scenario is: its files, and what it says.


class HasDigest(TypedDict):
    """The recorded properties of a file, of which only the digest is needed."""

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
    """Return a digest of files and of plain data together.

    Each description contains the digest of its file as ``blake2b``. The data can be expressed as JSON.
    """
    content = {name: entry["blake2b"] for name, entry in files.items()}
    text = json.dumps(content if plain_data is None else [content, plain_data], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def as_in_file(data: Plain) -> dict[str, object]:
    """Return the fields of a scenario as plain data, with the tables of simulators on the same level as in a file."""
    found: dict[str, object] = {}
    for key, value in data.items():
        found |= value if key == "tables" and isinstance(value, dict) else {key: value}
    return found


def as_plain_data(scenario: Scenario) -> dict[str, object]:
    """Return a scenario as plain data that TOML can hold, without values that are valid only in this process."""

    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items() if item is not None}
        return [plain(item) for item in value] if isinstance(value, list | tuple) else value

    said = asdict(replace(scenario, folder=Path()))
    data = as_in_file({key: plain(value) for key, value in said.items() if value is not None})
    for later in ("events", "disturbances", "requirement"):  # which an earlier crashhunt does not know
        if not data[later]:
            del data[later]
    return {key: value for key, value in data.items() if key not in ("folder", "file", "notes", "added")}


# The descriptor of a simulator.


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A file format of a simulator whose files can be run without a ``scenario.toml``.

    Args:
        endings: endings of file names, such as ``.sumocfg``; messages name the first ending.
        load: function that returns the scenario for the path of a file and the value of ``--ego``, which may be empty.
        arguments: the scenario arguments that every scenario of this format has, for shell completion.
        takes_ego: whether ``--ego`` selects the controlled vehicle of a scenario of this format.
        waiting: description of a slow step of loading; empty if loading is fast.
    """

    endings: tuple[str, ...]
    load: Callable[[Path, str], Scenario]
    arguments: tuple[str, ...] = ()
    takes_ego: bool = True
    waiting: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Accelerator:
    """An accelerator of a simulator: only the speed changes, and results stay bit-identical.

    Args:
        switched_off: function that returns a scenario with the accelerator disabled, as ``--no-accelerate`` requests.
        note: function that returns a note for the user if the accelerator has no effect; empty if it has an effect or
            is disabled.
    """

    switched_off: Callable[[Scenario], Scenario]
    note: Callable[[Scenario], str]


@dataclass(frozen=True, slots=True, kw_only=True)
class CompiledCore:
    """The optional compiled core of a simulator, with bit-identical results."""

    # function that returns a scenario with the compiled core disabled, as ``--no-native`` requests
    switched_off: Callable[[Scenario], Scenario]
    # function that returns why the compiled core is not used, as a text after "not used: "; empty if it is used
    why_not: Callable[[Scenario], str]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadOrder:
    """An order in which a simulator processes objects at load; crashhunt fixes this order if it can.

    If the order is not fixed, results depend on the memory addresses in a process.
    """

    what: str  # description of the objects that are processed in this order
    keep: Callable[[Scenario], Scenario]  # function that returns a scenario with the simulator's own order
    # function that returns why the order is not fixed, as a text after "not fixed: "; empty if it is fixed
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

    The functions are called with the scenario, whose table is ``scenario.table(KIND)``. Paths are relative to its
    folder.

    Args:
        title: name of the simulator for users.
        table: the dataclass of the simulator's table in ``scenario.toml``. The types of the dataclass's fields must be
            importable at run time. Allowed are numbers, text, lists, tuples, tables of these, and further dataclasses.
        example: the required keys of the table, for the message about a missing table.
        keys: the optional keys of ``scenario.toml`` that this simulator uses (``warmup_s``, ``insertion_timeout_s``,
            ``agents.route``, …). All other optional keys are refused. ``keys`` is None if the keys are unknown.
        shows_itself: whether agents receive the simulator's own observation if the scenario has no ``[observation]``.
        check: function that raises `ScenarioError` for an invalid scenario; it also receives the path of the file for
            the message.
        check_names: function that refuses names which the scenario's files do not define; it receives the value of
            ``--ego``, and is not called for scenarios that have already run.
        files: function that yields the files that an episode reads; they are part of the digest and of the snapshot.
        texts: function that yields the files of an episode that may contain ``${NAME}`` for a scenario argument.
        relocated: function that returns the contents of one of ``texts`` in a form that stays valid if the folder
            moves; None if the contents are already valid everywhere.
        modules: function that yields the user's modules that the simulator imports in addition to the agents, as
            ``module:attribute``. Names without a colon are ignored, so the id of an environment is allowed.
        notes: function that yields texts for the user about decisions of crashhunt.
        versions: the Python distributions on whose versions the simulator's results depend.
        variables: names of environment variables on which results depend; their values are recorded together with the
            versions.
        per_processor: whether the simulator may round differently on another processor type.
        step_length_s: function that returns the control step, in s, if it differs from the scenario's step length.
        reported_events: the types of traffic events that the simulator reports; None if they are unknown.
        disturbances: the types of traffic disturbances that the simulator supports; None if they are unknown.
        varying_disturbances: the types whose strength may be a signal: `Disturbance.strengths`.
        signal_arguments: function that returns the scenario arguments that may be signals; the simulator receives the
            stored form, which `crashhunt.trial.fold_signals` makes a function of the time.
        actions: the forms of actions that ``--action`` may select, as ``crashhunt list actions`` names them; empty if
            the environment defines the form of its actions.
        observations: the parts of observations that ``--observe`` may select.
        accelerator: the accelerator of the simulator; None if there is none.
        core: the compiled core of the simulator; None if there is none.
        load_order: the order of objects at load on which results depend; None if there is none.
        configurations: file formats of the simulator that can be run without a ``scenario.toml``.
        explained: function that returns the error in the scenario after a failed setup, from the failure's message and
            the printed output; None if the scenario is not the cause.
        side_effect: function that returns the side effects of an untrusted scenario, as a text after "the crash was not
            made on this machine, and"; empty if there are none. The function receives the values of the trial's
            scenario arguments, and the specifications of text arguments. Without this function, untrusted scenarios are
            refused.
        right_of_way: function that returns which vehicles must yield at the junctions of the map; None if this is
            unknown.
        stop_lines: function that returns the stop lines of the map; None if the simulator has none.
        shows_actors: whether scenes may contain actors. If this value is False, modes that compare the distances of
            actors are refused before the first trial.
        plays_paths: whether the simulator can move other actors along recorded paths.
        one_per_process: whether a process can run only one simulation at a time.
        forkable: whether a process can safely fork after creating the simulator, because the simulator starts no
            threads. If this value is False, crashhunt makes a trial fork before the first trial to find out.
        survey: how crashhunt finds, before a hunt, the vehicles that an agent can replace in one of the
            ``configurations``.
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
    varying_disturbances: tuple[str, ...] = ()
    signal_arguments: Callable[[Scenario], Iterable[str]] = _no_notes
    actions: tuple[str, ...] = ()
    observations: tuple[str, ...] = ()
    accelerator: Accelerator | None = None
    core: CompiledCore | None = None
    load_order: LoadOrder | None = None
    configurations: tuple[Configuration, ...] = ()
    explained: Callable[[str, str, Scenario], ScenarioError | None] | None = None
    side_effect: Callable[[Scenario, Mapping[str, Value], Iterable[str]], str] | None = None
    right_of_way: Callable[[Scenario], RightOfWay | None] | None = None
    stop_lines: Callable[[Scenario], tuple[StopLine, ...]] | None = None
    shows_actors: bool = True
    plays_paths: bool = False
    one_per_process: bool = False
    forkable: bool = False
    survey: TrafficSurvey | None = None

    def __post_init__(self) -> None:
        if self.table is not None and not is_dataclass(self.table):
            # What is no dataclass would neither be written down nor sent to a worker.
            raise TypeError(f"the table of a backend must be a dataclass, but {self.table!r} is not a dataclass")


# Which simulators have a descriptor, and where it is.


# Crashhunt's own simulators are found by module and not by entry point: a bundle brings a crashhunt of its own along,
# and what is installed around it may be of a version in which they are elsewhere.
_OWN_BACKENDS = {
    "gym": "crashhunt.gym._descriptor",
    "highway": "crashhunt.highway._descriptor",
    "sumo": "crashhunt.sumo._descriptor",
    "toy": "crashhunt.simulators._toy_descriptor",
}
SIMULATOR_PACKAGES = tuple(sorted({module.rpartition(".")[0] for module in _OWN_BACKENDS.values()}))
"""The packages of crashhunt that contain its simulators."""


def _plugin_backends() -> Mapping[str, EntryPoint]:
    return registered("backends")


def backend_names() -> tuple[str, ...]:
    """Return the names of simulators with a descriptor, crashhunt's own simulators first; no module is imported."""
    return tuple(dict.fromkeys((*_OWN_BACKENDS, *_plugin_backends())))


@cache
def backend_of(name: str) -> Backend | None:
    """Return the descriptor of a simulator; None if the simulator has no descriptor.

    Args:
        name: name under which the simulator is registered; a ``module:attribute`` has no descriptor.

    Raises:
        PluginError: the descriptor cannot be imported, or is not a `Backend`.
    """
    if name in _OWN_BACKENDS:
        own: Backend = importlib.import_module(_OWN_BACKENDS[name]).BACKEND
        return own
    point = _plugin_backends().get(name)
    if point is None:
        return None
    found = load_attribute(point.value, shown=name, installed=True)
    if not isinstance(found, Backend):
        message = f"the backend {name!r} is a {type(found).__name__}, not a Backend"
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
    """Yield the file formats of simulators whose files can be run without a ``scenario.toml``."""
    for _, backend in installed_backends():
        yield from backend.configurations


def titles(chosen: Callable[[Backend], bool]) -> str:
    """Return the titles of the simulators for whose descriptor a function returns true, as text."""
    return listed(
        (backend.title or name for name, backend in installed_backends() if chosen(backend)), none="another simulator"
    )


# What a hunt finds out about the plain traffic of a configuration before its first trial.


class RunToSurvey(TypedDict):
    """One run of the unmodified traffic."""

    seed: int
    values: dict[str, Value]


class SurveyJob(TypedDict):
    """The JSON data from which the process that simulates the unmodified traffic reads its job.

    ``scenario`` is the result of `as_plain_data`, and ``folder`` contains the scenario's files. ``stage`` is a private
    folder of the process, and ``answer`` is the file for the JSON list of completed runs. The process stops
    simulating when it has used ``processor_time_limit_s`` of CPU time.
    """

    scenario: Plain
    folder: str
    stage: str
    answer: str
    processor_time_limit_s: float
    runs: list[RunToSurvey]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficSurvey:
    """How a simulator finds the vehicles that an agent can replace: it simulates the traffic before the hunt."""

    # module with a function ``main()``, which runs in its own process; its only argument is the file of a `SurveyJob`
    module: str
    # function that returns the scenario with the candidates that the runs confirm, given the output of ``module``. The
    # function raises `ScenarioError` if no trial can be valid.
    refine: Callable[[Scenario, Json], Scenario]
    # function that returns the scenario with the candidates of an earlier hunt, given that hunt's scenario; None if the
    # hunt drew no candidates
    restore: Callable[[Scenario, Scenario], Scenario | None]


# The order in which a simulator processes a scenario at load: whether it is fixed, and as it was for a recorded crash.
#
# ``environment.json`` of a snapshot holds it (``load_order``). Where it is missing, the order was not fixed.

FIXED_LOAD_ORDER = "fixed"


def load_order_of(scenario: Scenario) -> str | None:
    """Return ``fixed`` or ``not fixed: REASON`` for the load order; None if the results do not depend on an order."""
    order = scenario.backend.load_order
    if order is None:
        return None
    why_not = order.why_not(scenario)
    return f"not fixed: {why_not}" if why_not else FIXED_LOAD_ORDER


def with_recorded_load_order(scenario: Scenario, recorded: str | None) -> Scenario:
    """Return the scenario with the load order that a recorded crash had: the fixed order, or the simulator's own order.

    The load order is the order in which the simulator processes objects when it loads the scenario. ``recorded`` is the
    value of ``load_order`` in the snapshot; None if the snapshot has none.
    """
    order = scenario.backend.load_order
    return scenario if order is None or recorded == FIXED_LOAD_ORDER else order.keep(scenario)


def load_order_change(scenario: Scenario, recorded: str | None) -> str:
    """Return how the load order here differs from the recorded order, as a clause; empty if both are equal.

    An order that was not fixed is kept by `with_recorded_load_order`. A difference therefore arises only if the
    recorded order was fixed, and cannot be fixed here. ``recorded`` is the value of ``load_order`` in the snapshot;
    None if the snapshot has none.
    """
    order, now = scenario.backend.load_order, load_order_of(scenario)
    if order is None or recorded != FIXED_LOAD_ORDER or now == FIXED_LOAD_ORDER:
        return ""
    return f"the order of {order.what} was fixed and is {now}"
