"""Resolution of a user's request: find the scenario, check the arguments, and return complete settings."""

from __future__ import annotations

import secrets
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.base.text import listed, one_of
from crashhunt.disturbances import parse_fixed, parse_rates
from crashhunt.native import HOW_TO_REBUILD, outdated_modules
from crashhunt.oracles import chosen_oracles, outcomes_brought
from crashhunt.plans._arguments import settings_of_agents, specs_of_scenario
from crashhunt.plans._choices import (
    check_branch,
    check_rare,
    chosen_actions,
    chosen_disturbances,
    chosen_observations,
    chosen_requirements,
    disturber,
    model_apart,
    name_scenario_in_errors,
    notes_on_declarations,
    parse_crash_on,
    refuse_misplaced_plans,
    with_notes_on_crashes,
    without_refuted_notes,
)
from crashhunt.plans._code import CodeFacts, describe_code, notes_on_programs, with_reuse
from crashhunt.plans._executor_choice import sized
from crashhunt.plans._run_options import TrialOptions
from crashhunt.plans._settings import HuntSettings, RunSettings, fields_of
from crashhunt.samplers import HuntFacts, NamedSampler, varies_only_asked
from crashhunt.scenario import (
    FIXED_LOAD_ORDER,
    Scenario,
    load_order_of,
    load_scenario,
    scenario_digest,
    titles,
    with_action,
    with_observations,
)
from crashhunt.trial import CRASHES, CallSignature, Constant

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from crashhunt.plans._request import Request

    Surveyor = Callable[[Scenario, Request, HuntSettings], Scenario]


def plan(request: Request, *, survey: Surveyor | None = None) -> tuple[Scenario, HuntSettings]:
    """Resolve a user's request to a scenario and settings; see `plan_with_code`."""
    return plan_with_code(request, survey=survey)[:2]


def plan_with_code(request: Request, *, survey: Surveyor | None = None) -> tuple[Scenario, HuntSettings, CodeFacts]:
    """Resolve a user's request; also return the declarations of the code that the request names.

    ``survey`` is called last because it may take long, and invalid requests are refused before.

    Raises:
        CrashhuntError: the request is invalid.
    """
    request = request.checked()
    loaded = load_scenario(request.scenario, ego=request.ego)
    scenario, settings, code = _planned(request, loaded, None)
    if survey is not None and (surveyed := survey(loaded, request, settings)) is not loaded:
        scenario, settings, code = _planned(request, surveyed, code)
    return scenario, settings, code


def _planned(request: Request, scenario: Scenario, code: CodeFacts | None) -> tuple[Scenario, HuntSettings, CodeFacts]:
    """Resolve a request in a loaded scenario, with the facts about its code if they are known."""
    brought = _locators(request, scenario)
    scenario = _agents_in(scenario.with_agents(brought), dict.fromkeys(scenario.agents, request.action))
    with name_scenario_in_errors(request, scenario):
        disturb = chosen_disturbances(request, scenario)
    if code is None or any(setup.agent not in code.signatures for setup in scenario.agents.values()):
        observed = chosen_observations(request.observe, scenario, {})
        code = describe_code(
            with_observations(scenario, observed), oracles=request.oracles, disturb=disturb, sampler=request.sampler,
            executor=request.executor, timeout_s=request.timeout_s,
        )  # fmt: skip
    hunted = not varies_only_asked(request.sampler)
    signatures = {agent: code.signatures[setup.agent] for agent, setup in scenario.agents.items()}
    acting = chosen_actions(request.action, scenario, signatures, brought)
    scenario = _agents_in(scenario, acting)
    requirements = chosen_requirements(request, scenario)
    oracles = chosen_oracles([*request.oracles, *requirements], code.oracles)
    scenario = without_refuted_notes(scenario, requirements)
    new_outcomes = outcomes_brought(oracles, code.oracles)
    crash_on, limits = parse_crash_on(request.crash_on, new_outcomes)
    if crash_on == CRASHES:  # the default
        crash_on += tuple(outcome for outcome in new_outcomes if outcome not in crash_on)
    observations = chosen_observations(request.observe, scenario, signatures, brought)
    options = {name: getattr(request, name) for name in fields_of(TrialOptions)}
    options |= {
        "seed": request.seed if request.seed is not None else secrets.randbits(32),
        "crash_on": crash_on,
        "disturb": disturb,
    }
    settings = HuntSettings(
        **options,
        scenario=str(request.scenario),
        scenario_digest=scenario_digest(scenario),
        trials=request.trials,
        max_steps=request.max_steps,
        oracles=oracles,
        events=limits,
        agents=settings_of_agents(request, scenario, signatures, acting, observations, hunted=hunted),
        scenario_arguments=specs_of_scenario(request, scenario, disturb, hunted=hunted),
        run=request.run,
    )
    scenario = with_observations(scenario, observations)
    settings = with_reuse(settings, scenario)
    scenario = with_notes_on_crashes(_with_notes(scenario, request.run), settings, request, code.oracles)
    notes = (*code.notes, *_notes_on_statistics(settings, signatures), *notes_on_declarations(scenario, signatures))
    notes += (*notes_on_programs(settings), *_notes_on_constants(settings, hunted=hunted))
    scenario = replace(scenario, notes=(*scenario.notes, *notes))
    refuse_misplaced_plans(
        scenario, [*parse_rates(disturb), *(one.what for one in parse_fixed(disturb, tuple(scenario.agents)))]
    )
    find = partial(model_apart, code, request.timeout_s)
    with name_scenario_in_errors(request, scenario):
        disturber(scenario, settings.disturb, tuple(settings.agents), find=find)  # it refuses what cannot be meant
    check_branch(settings)
    sampler = sampler_of(settings)  # it refuses what it cannot sample
    check_rare(settings, scenario, find, sampler)
    # Last, as looking for the executor imports what runs trials: what is refused is refused sooner.
    return scenario, replace(settings, run=sized(settings.run)), code


def _with_notes(scenario: Scenario, run: RunSettings) -> Scenario:
    """Return the scenario with notes on the accelerator or compiled core, and on the reason if it is not used."""
    accelerator, core = scenario.backend.accelerator, core_of(scenario, run)
    notes = [accelerator.note(scenario) if accelerator is not None and run.accelerate else ""]
    notes.append(f"the compiled core is {core}" if core is not None else "")
    load_order = scenario.backend.load_order
    if load_order is not None and (order := load_order_of(scenario)) != FIXED_LOAD_ORDER:
        notes.append(f"the order of {load_order.what} is {order}; a trial may differ between processes")
    if outdated := outdated_modules():
        notes.append(f"compiled from other sources than those installed: {listed(outdated)}. Fix: {HOW_TO_REBUILD}")
    return replace(scenario, notes=(*scenario.notes, *filter(None, notes)))


def _notes_on_statistics(settings: HuntSettings, signatures: Mapping[str, CallSignature]) -> Iterator[str]:
    """Yield a note for each unused file next to a policy that may contain its statistics of `VecNormalize`."""
    for agent, chosen in settings.agents.items():
        path = chosen.arguments["path"].distribution if "path" in chosen.arguments else None
        is_asked = "normalize" in signatures[agent].arguments and "normalize" not in chosen.arguments
        if is_asked and isinstance(path, Constant) and isinstance(path.value, str):
            for file in sorted(Path(path.value).parent.glob("*.pkl")):
                yield f"{file.name} is next to the policy and is not used; if VecNormalize wrote it: normalize={file}"


def _notes_on_constants(settings: HuntSettings, *, hunted: bool) -> Iterator[str]:
    """Yield a note if a sampler varies only the arguments with a range in the request, and there is none."""
    if not hunted and all(len(distribution.grid(2)) == 1 for distribution in settings.space.values()):
        fix = "Fix: give a range, such as --arg speed=5:30:5"
        yield f"--sampler {settings.sampler} varies no argument: all trials have the same arguments. {fix}"


def core_of(scenario: Scenario, run: RunSettings) -> str | None:
    """Return as text whether trials use the simulator's compiled core; None if the simulator has no compiled core."""
    core = scenario.backend.core
    if core is None:
        return None
    why_not = core.why_not(scenario) if run.native else "--no-native"
    return f"not used: {why_not}" if why_not else "used"


def with_settings(scenario: Scenario, settings: HuntSettings) -> Scenario:
    """Return the scenario with the agents and the acceleration that the settings choose."""
    missing = scenario.agents.keys() ^ settings.agents.keys()
    if missing:
        raise UsageError(
            f"only one of hunt.toml and the scenario has the controlled vehicle {min(missing)!r}",
            fix="name the same vehicles in both",
        )
    if scenario.backend.accelerator is not None and not settings.run.accelerate:
        scenario = scenario.backend.accelerator.switched_off(scenario)
    if scenario.backend.core is not None and not settings.run.native:
        scenario = scenario.backend.core.switched_off(scenario)
    if settings.events:
        scenario = replace(scenario, events={**scenario.events, **settings.events})
    if scenario.backend.actions:  # elsewhere than it was hunted, it may be another simulator's
        scenario = _agents_in(scenario, {agent: chosen.action or "" for agent, chosen in settings.agents.items()})
    observations = {agent: chosen.observation for agent, chosen in settings.agents.items() if chosen.observation}
    scenario = with_observations(scenario, observations) if scenario.backend.observations else scenario
    return scenario.with_agents({agent: chosen.agent for agent, chosen in settings.agents.items()})


def _agents_in(scenario: Scenario, actions: Mapping[str, str]) -> Scenario:
    """Return the scenario with the requested forms of actions; an empty form keeps the scenario's form."""
    for agent, action in actions.items():
        if action and not scenario.backend.actions:
            meant = titles(lambda backend: bool(backend.actions))
            fix = "omit --action, because the environment defines the form of its actions"
            raise UsageError(
                f"--action {action} is for {meant}, but the scenario {scenario.name} has another simulator", fix=fix
            )
        if action:
            scenario = with_action(scenario, agent, action, where="--action")
    return scenario


def sampler_of(settings: HuntSettings) -> NamedSampler:
    """Return a new sampler for a hunt's settings.

    Raises:
        PluginError: the sampler does not exist, cannot be created, or is not a sampler.
        CrashhuntError: the sampler refuses the argument space.
    """
    hunt = HuntFacts(settings.seed, settings.crash_on)
    return NamedSampler(settings.sampler, settings.space, points=settings.points, hunt=hunt)


def _locators(request: Request, scenario: Scenario) -> dict[str, str]:
    locators: dict[str, str] = {}
    ids = ", ".join(scenario.agents)
    for agent, locator in request.locators.items():
        if not agent and len(scenario.agents) > 1:
            raise UsageError(
                f"--agent {locator!r} names no vehicle, but the scenario has several: {ids}",
                fix=f"write --agent {next(iter(scenario.agents))}={locator}",
            )
        if agent and agent not in scenario.agents:
            fix = one_of(agent, scenario.agents, give="the scenario has")
            raise UsageError(f"--agent: there is no controlled vehicle {agent!r}", fix=fix)
        locators[agent or next(iter(scenario.agents))] = locator
    return locators
