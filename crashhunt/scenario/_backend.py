"""What a simulator is to everybody but itself: one descriptor, of which `Scenario`, plans, snapshots and replays ask.

A simulator needs none: without, a scenario has no table for it, and a stranger's bundle that names it is refused. To
give one to yours, make a `Backend` in a module that does not import the simulator (commands that only read a scenario
import it), and register it under the name that the simulator has::

    [project.entry-points."crashhunt.simulators"]
    mysim = "mypackage.simulator:MySimulator"

    [project.entry-points."crashhunt.backends"]
    mysim = "mypackage.backend:BACKEND"

Then a ``scenario.toml`` may have a table ``[mysim]``, of which the simulator asks by ``scenario.table(MySetup)``.
"""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, TypedDict

import crashhunt.scenario.backends
from crashhunt.base.errors import PluginError
from crashhunt.base.plugins import load_attribute, registered
from crashhunt.base.text import listed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from importlib.metadata import EntryPoint
    from pathlib import Path

    from crashhunt.base.errors import ScenarioError
    from crashhunt.base.json_types import Json, Plain
    from crashhunt.scenario._scenario import Scenario
    from crashhunt.trial import Value
    from crashhunt.world import RightOfWay


__all__ = [
    "Accelerator",
    "Backend",
    "CompiledCore",
    "Configuration",
    "RunToSurvey",
    "SurveyJob",
    "TrafficSurvey",
    "backend_names",
    "backend_of",
    "configurations",
    "installed_backends",
    "titles",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A file of the simulator's own, which is run as it is, without a ``scenario.toml``.

    Args:
        endings: of its name, such as ``.sumocfg``; messages name the first one.
        load: returns it as a scenario, from its path and from what ``--ego`` says, which may be empty.
        arguments: the scenario arguments that every such scenario has, for completion in the shell.
    """

    endings: tuple[str, ...]
    load: Callable[[Path, str], Scenario]
    arguments: tuple[str, ...] = ()


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
    """A compiled part that may be missing, and changes no bit of what is computed.

    Args:
        switched_off: returns a scenario without it, as ``--no-native`` asks for.
        why_not: returns why it is not used, in words that follow "not used: "; empty where it is.
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
        why_not: returns why the order is not fixed, in words that follow "not fixed: "; empty where it is.
    """

    what: str
    keep: Callable[[Scenario], Scenario]
    why_not: Callable[[Scenario], str]


def _nothing(_scenario: Scenario) -> Iterable[str]:
    return ()


def _accepted(_scenario: Scenario, _where: str) -> None:
    return None


def _found(_scenario: Scenario, _ego: str) -> None:
    return None


def _its_own(scenario: Scenario) -> float:
    return scenario.step_length_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Backend:
    """The properties of a simulator that other packages need; all of them are optional.

    Functions are called with the scenario, whose table is ``scenario.table(KIND)``; paths are relative to its folder.

    Args:
        title: how people call it.
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
        relocated: returns the content of one of ``texts`` as it is right wherever its folder goes, None where it is.
        modules: the code of the user's that it imports besides the agents', as ``module:attribute``. Names without
            a colon are ignored, so the id of an environment is allowed.
        notes: what to tell people about what was decided on their behalf, in lines.
        versions: the distributions on whose version everything depends that it computes.
        variables: of the environment, on which it depends; written down with the versions.
        per_processor: whether it may round otherwise on another processor.
        step_length_s: the control step, in s, where it is not the scenario's own.
        reported_events: the types of traffic events that it reports; None if that is unknown.
        disturbances: the types of disturbances of the traffic that it supports; None if that is unknown.
        actions: the forms of action (``continuous``, ``meta``) that ``--action`` may choose.
        accelerator: where it has one.
        core: its compiled part, where it has one.
        load_order: the order at load on which its results depend, where there is one.
        configurations: files of its own that are run as they are.
        explained: returns the mistake in the scenario after a failed setup, from the message of the failure and from
            printed output; None if the scenario is not the cause.
        side_effect: of a stranger's scenario, returns what it would do besides simulating, in words that follow "the
            crash is a stranger's, and"; empty where it does nothing else. It is given the values of the trial's
            scenario arguments, and the specifications of those that are texts. Without, strangers are refused.
        right_of_way: returns who has to give way at the junctions of the map; None where that is not known.
        plays_paths: whether it can move others along recorded ways.
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
    check_names: Callable[[Scenario, str], None] = _found
    files: Callable[[Scenario], Iterable[str]] = _nothing
    texts: Callable[[Scenario], Iterable[str]] = _nothing
    relocated: Callable[[Path], bytes | None] | None = None
    modules: Callable[[Scenario], Iterable[str]] = _nothing
    notes: Callable[[Scenario], Iterable[str]] = _nothing
    versions: tuple[str, ...] = ()
    variables: tuple[str, ...] = ()
    per_processor: bool = False
    step_length_s: Callable[[Scenario], float] = _its_own
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
    forkable: bool = False
    survey: TrafficSurvey | None = None

    def __post_init__(self) -> None:
        if self.table is not None and not is_dataclass(self.table):
            # What is no dataclass would neither be written down nor sent to a worker.
            raise TypeError(f"the table of a backend is a dataclass, and {self.table!r} is none")


# Which simulators have a descriptor, and where it is.


@cache
def _own() -> tuple[str, ...]:
    # Crashhunt's own simulators are found by module and not by entry point: a bundle brings a crashhunt of its own
    # along, and what is installed around it may be of a version in which they are elsewhere.
    return tuple(sorted(module.name for module in pkgutil.iter_modules(crashhunt.scenario.backends.__path__)))


def _others() -> Mapping[str, EntryPoint]:
    return registered("backends")


def backend_names() -> tuple[str, ...]:
    """Return the simulators that have a descriptor, those that come with crashhunt first; nothing is imported."""
    return tuple(dict.fromkeys((*_own(), *_others())))


@cache
def backend_of(name: str) -> Backend | None:
    """Return the descriptor of a simulator; None where it has none.

    Args:
        name: under which the simulator is registered; a ``module:attribute`` has none.

    Raises:
        PluginError: there is one, and it cannot be imported, or is something else.
    """
    if name in _own():
        own: Backend = importlib.import_module(f"crashhunt.scenario.backends.{name}").BACKEND
        return own
    point = _others().get(name)
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
        module: its ``main()`` runs in a process of its own, with the file of a `SurveyJob` as its only argument.
        refine: returns the scenario with the candidates that the runs confirm, from what ``module`` answered. Raises
            `ScenarioError` where no trial can be valid.
        restore: returns the scenario with the candidates of an earlier hunt, given the scenario that this hunt kept;
            None where the hunt drew no candidates.
    """

    module: str
    refine: Callable[[Scenario, Json], Scenario]
    restore: Callable[[Scenario, Scenario], Scenario | None]
