"""Facts about the code that a hunt names, found without running user code in this process.

A user's module may end or stop the process that imports it. One fork of this process imports all such modules, returns
the facts that the command needs, and ends. After that, only the processes of trials import the modules again.

Samplers and executors are parts of the hunt itself, so this process imports them afterwards. By then, a sampler or
executor module that ends or stops its process has been refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from crashhunt.base.agent_locators import can_fork, is_program
from crashhunt.base.errors import PluginError, ProgramError
from crashhunt.base.isolation import files_read_apart, work_apart
from crashhunt.base.plugins import Group, ImportedModules, is_foreign, is_foreign_module, locate
from crashhunt.base.temporary import temporary_folder
from crashhunt.base.text import listed
from crashhunt.disturbances import described_model, modules_of_models, parse_rates
from crashhunt.oracles import described_oracle, modules_of, oracle_name
from crashhunt.plans._executor_choice import executor_name
from crashhunt.trial import CallSignature, signature_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from crashhunt.base.isolation import Report
    from crashhunt.base.json_types import Plain
    from crashhunt.plans._settings import HuntSettings
    from crashhunt.scenario import Scenario
    from crashhunt.trial import Category


IMPORT_S = 60.0  # besides the time limit of a trial


@dataclass(frozen=True, slots=True)
class CodeFacts:
    """The declarations of the code that a hunt names: of its agents, user-defined oracles and disturbances."""

    signatures: Mapping[str, CallSignature]  # arguments of each agent, by the agent's locator
    # outcomes of each user-defined oracle with their categories, by the text that chooses the oracle in ``--oracle``
    oracles: Mapping[str, Mapping[str, Category]] = field(default_factory=dict)
    # the kind of each user-defined disturbance model, by name
    disturbances: Mapping[str, str] = field(default_factory=dict)
    # the modules that a process with all of this code has imported; None if all modules are crashhunt's own
    imported: ImportedModules | None = None
    notes: tuple[str, ...] = ()  # what the user should know, as lines of text


def describe_code(
    scenario: Scenario, *, oracles: Sequence[str], disturb: Sequence[str], sampler: str, executor: str, timeout_s: float
) -> CodeFacts:
    """Return the declarations of a scenario's agents, and of the other code that options name.

    Imports may take 60 s longer than a trial.

    Raises:
        CrashhuntError: user code cannot be imported, or has ended or stopped its process.
    """
    locators = sorted({setup.agent for setup in scenario.agents.values()})
    programs = [locator for locator in locators if is_program(locator)]
    chosen = [text for text in oracles if is_foreign("oracles", oracle_name(text)) and text != "none"]
    models = [name for name in parse_rates(disturb) if is_foreign("disturbances", name)]
    modules = [*scenario.modules(), *modules_of(oracles), *modules_of_models(disturb)]
    machinery: list[tuple[Group, str]] = [("samplers", sampler), ("executors", executor_name(executor))]
    machinery = [(group, name) for group, name in machinery if is_foreign(group, name) and not _is_of_optuna(name)]
    foreign = [locator for locator in locators if is_foreign("agents", locator)]

    def described(report: Report) -> Plain:
        signatures, outcomes, kinds = {}, {}, {}
        for locator in sorted({*locators} - {*programs}):
            report(f"{locator!r} cannot be imported")
            signatures[locator] = signature_of(locate("agents", locator)).to_json()
        for text in chosen:
            report(f"the oracle {oracle_name(text)!r} cannot be created")
            outcomes[text] = described_oracle(text)
        for name in models:
            report(f"the disturbance {name!r} cannot be created")
            kinds[name] = described_model(name)
        for group, name in machinery:
            report(f"the {group.removesuffix('s')} {name!r} cannot be imported")
            locate(group, name)
        imported = _import(locators, modules, report)
        return {"signatures": signatures, "oracles": outcomes, "disturbances": kinds, "imported": imported.to_json()}

    if not (foreign or chosen or models or machinery or any(map(is_foreign_module, modules))):
        return CodeFacts({locator: signature_of(locate("agents", locator)) for locator in locators})
    declared, notes = _declared(programs, scenario, timeout_s) if programs else ({}, [])
    data: Any = work_apart(described, task="what it names cannot be imported", timeout_s=IMPORT_S + timeout_s)
    signatures = {locator: CallSignature.from_json(found) for locator, found in data["signatures"].items()} | declared
    revisions = {locator: one.revision for locator, one in declared.items() if one.revision}
    return CodeFacts(
        signatures=signatures, oracles=data["oracles"], disturbances=data["disturbances"],
        imported=replace(ImportedModules.from_json(data["imported"]), revisions=revisions), notes=tuple(notes),
    )  # fmt: skip


def _declared(
    locators: Sequence[str], scenario: Scenario, limit_s: float
) -> tuple[dict[str, CallSignature], list[str]]:
    """Return the arguments that programs declare, and a note for each program that has failed.

    A program that fails takes any argument. The trials report the failure, each as an error of the agent. The
    simulator, whose spaces a program receives, is created in a fork of its own, because its files are not the agent's.

    Raises:
        PluginError: a declared default is outside of its range.
    """

    def described(report: Report) -> Plain:
        found: dict[str, Any] = {"signatures": {}, "notes": []}
        with temporary_folder("agent") as stage:
            for locator in locators:
                report(f"{locator!r} cannot be described")
                agent = next(name for name, setup in scenario.agents.items() if setup.agent == locator)
                simulator = locate("simulators", scenario.simulator)(scenario, stage)
                try:
                    signature = locate("agents", locator).declared_signature(agent, simulator, limit_s=limit_s)
                except ProgramError as error:
                    found["notes"].append(f"{locator} has not declared its arguments: {error}")
                    signature = CallSignature({}, open=True, given=())
                _check_defaults(locator, signature)
                found["signatures"][locator] = signature.to_json()
        return found

    data: Any = work_apart(described, task="the programs cannot be described", timeout_s=IMPORT_S + limit_s)
    return {locator: CallSignature.from_json(found) for locator, found in data["signatures"].items()}, data["notes"]


def _check_defaults(locator: str, signature: CallSignature) -> None:
    """Refuse defaults outside of their range.

    Raises:
        PluginError: a default is outside of its range.
    """
    for name, one in signature.arguments.items():
        if one.default is not None and one.distribution is not None and not one.distribution.contains(one.default):
            raise PluginError(
                f"{locator!r}: the default of its argument {name}, {one.default}, is outside its range "
                f"{str(one.distribution)!r}",
                fix="declare a default within it, or widen the range",
            )


def imported_by(scenario: Scenario, settings: HuntSettings) -> ImportedModules:
    """Return the modules that trials import.

    A separate process imports the modules if any module is not crashhunt's own.

    Raises:
        CrashhuntError: a module cannot be imported, or has ended or stopped its process.
    """
    locators = sorted({setup.agent for setup in scenario.agents.values()})
    modules = [*scenario.modules(), *modules_of(settings.oracles), *modules_of_models(settings.disturb)]
    foreign = any(is_foreign("agents", locator) for locator in locators) or any(map(is_foreign_module, modules))
    if not foreign:
        return ImportedModules.here(locators, modules)
    data: Any = work_apart(
        lambda report: _import(locators, modules, report).to_json(), task="what it names cannot be imported",
        timeout_s=IMPORT_S + settings.run.timeout_s,
    )  # fmt: skip
    return ImportedModules.from_json(data)


def _import(locators: Sequence[str], modules: Sequence[str], report: Callable[[str], None]) -> ImportedModules:
    """Import agents and modules, and report each import before it begins."""

    def each(names: Sequence[str]) -> Iterator[str]:
        for name in names:
            report(f"{name!r} cannot be imported")
            yield name

    return replace(ImportedModules.here(each(locators), each(modules)), read=tuple(files_read_apart()))


def _is_of_optuna(name: str) -> bool:
    return name.lower().startswith("optuna:")


def notes_on_programs(settings: HuntSettings) -> Iterator[str]:
    """Yield the price of forks of trials in which a program drives, and the agents without a time limit per step."""
    in_python = [name for name, chosen in settings.agents.items() if not is_program(chosen.agent)]
    if settings.run.step_timeout_s and in_python:
        yield f"--step-timeout does not limit {listed(in_python)}, an agent in Python; --timeout limits the trial"
    names = [name for name, chosen in settings.agents.items() if not can_fork(chosen.agent)]
    forking = {"--probe": settings.probe, "--branch": settings.branch, "--rare": settings.rare}
    for option in [flag for flag, value in forking.items() if value and names]:
        yield (
            f"each fork of {option} starts the program of {listed(names)} again and sends it the observations of all "
            "earlier steps, because a running program cannot be copied"
        )
    if settings.run.reuse:
        reused = reused_agents(settings)
        yield (
            f"the program of {listed(reused)} drives in one trial after another; {settings.run.audit:.0%} of the "
            "trials without a crash run again with a new program"
            if reused
            else "--reuse has no effect: no agent is a program (exec:)"
        )


_REUSE_AUDIT = 0.05  # share of the trials without a crash that run again with a new program


def with_reuse(settings: HuntSettings, scenario: Scenario) -> HuntSettings:
    """Return the settings in which programs drive in several trials if the scenario says so, with an audit."""
    agents = scenario.agents.items()
    declared = any(setup.reuse and setup.agent == settings.agents[name].agent for name, setup in agents)
    reuse = settings.run.reuse or declared
    audit = settings.run.audit or (_REUSE_AUDIT if reuse and reused_agents(settings) else 0.0)
    return replace(settings, run=replace(settings.run, reuse=reuse, audit=audit))


def reused_agents(settings: HuntSettings) -> tuple[str, ...]:
    """Return the vehicles whose program can drive in one trial after another."""
    return tuple(name for name, chosen in settings.agents.items() if not can_fork(chosen.agent))
