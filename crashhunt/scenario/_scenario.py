"""Scenarios: what a trial takes place in. A scenario says how to make an episode; it never is one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from crashhunt.base import layout
from crashhunt.base.errors import ScenarioError
from crashhunt.scenario._backend import Backend
from crashhunt.scenario._registry import backend_of
from crashhunt.scenario._tables import AgentSetup, ArgumentSetup, ObservationSetup
from crashhunt.scenario.backends import DEFAULT_SIMULATOR

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.trial import Argument, Value

__all__ = ["STEP_LENGTH_S", "Scenario", "argument_values", "with_action"]

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
        tables: what simulators of their own want to know, by the name of the table; in the file, they stand beside
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
