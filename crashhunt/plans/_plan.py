"""Resolution of a user's request: find the scenario, check the arguments, and return complete settings."""

from __future__ import annotations

import secrets
import sys
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import ArgumentError, CrashhuntError, ScenarioError, UsageError
from crashhunt.base.plugins import is_foreign, registered
from crashhunt.base.text import listed, one_of
from crashhunt.disturbances import (
    ModelApart,
    disturber_of,
    locate_model,
    parse_fixed,
    parse_rates,
    signals_of_fixed,
    word_of,
)
from crashhunt.native import HOW_TO_REBUILD, outdated_modules
from crashhunt.oracles import ORACLES_OF_ACTORS, chosen_oracles, oracle_name, outcomes_brought
from crashhunt.plans._argument_owners import Owners, Takes, agent_of
from crashhunt.plans._choices import (
    chosen_actions,
    chosen_observations,
    chosen_requirements,
    notes_on_actions,
    parse_crash_on,
    refuse_late_plans,
    without_refuted_notes,
)
from crashhunt.plans._code import IMPORT_S, CodeFacts, describe_code, notes_on_programs, with_reuse
from crashhunt.plans._run_options import TrialOptions
from crashhunt.plans._settings import (
    AgentSettings,
    ArgumentSpec,
    HuntSettings,
    RunSettings,
    fields_of,
    sized,
    spec_words,
)
from crashhunt.samplers import HuntFacts, NamedSampler, varies_only_asked
from crashhunt.scenario import (
    FIXED_LOAD_ORDER,
    Scenario,
    backend_of,
    load_order_of,
    load_scenario,
    scenario_digest,
    titles,
    with_action,
    with_observations,
)
from crashhunt.trial import (
    CRASHES,
    EVENTS,
    Argument,
    Constant,
    Outcome,
    Signature,
    expand_signal,
    is_signal,
    parse_spec,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from crashhunt.disturbances import DisturbanceModel, DisturbanceSampler
    from crashhunt.plans._settings import Request
    from crashhunt.trial import Category

    Surveyor = Callable[[Scenario, Request, HuntSettings], Scenario]


def plan(request: Request, *, survey: Surveyor | None = None) -> tuple[Scenario, HuntSettings]:
    """Resolve a user's request to a scenario and settings; see `plan_with_code`."""
    return plan_with_code(request, survey=survey)[:2]


def plan_with_code(request: Request, *, survey: Surveyor | None = None) -> tuple[Scenario, HuntSettings, CodeFacts]:
    """Resolve a user's request; also return the declarations of the code that the request names.

    Args:
        request: what the user asks for: scenario, agents, arguments and options.
        survey: function that returns the scenario with the vehicles that an agent can replace. The function is called
            last because it may take long, and invalid requests are refused before.

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
    with _name_scenario_in_errors(request, scenario):
        disturb = _disturb(request, scenario)
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
        agents=_agents(request, scenario, signatures, acting, observations, hunted=hunted),
        scenario_arguments=_scenario_arguments(request, scenario, disturb, hunted=hunted),
        run=request.run,
    )
    scenario = with_observations(scenario, observations)
    settings = with_reuse(settings, scenario)
    scenario = _with_notes_on_crashes(_with_notes(scenario, request.run), settings, request, code.oracles)
    notes = (*code.notes, *_notes_on_statistics(settings, signatures), *notes_on_actions(scenario, signatures))
    notes += (*notes_on_programs(settings),)
    scenario = replace(scenario, notes=(*scenario.notes, *notes))
    refuse_late_plans(
        scenario, [*parse_rates(disturb), *(one.what for one in parse_fixed(disturb, tuple(scenario.agents)))]
    )
    find = partial(_model_apart, code, request.timeout_s)
    with _name_scenario_in_errors(request, scenario):
        disturber(scenario, settings.disturb, tuple(settings.agents), find=find)  # it refuses what cannot be meant
    _check_branch(settings)
    _check_rare(settings, scenario, find)
    sampler_of(settings)  # it refuses what it cannot sample
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


def _notes_on_statistics(settings: HuntSettings, signatures: Mapping[str, Signature]) -> Iterator[str]:
    """Yield a note for each unused file next to a policy that may contain its statistics of `VecNormalize`."""
    for agent, chosen in settings.agents.items():
        path = chosen.arguments["path"].distribution if "path" in chosen.arguments else None
        is_asked = "normalize" in signatures[agent].arguments and "normalize" not in chosen.arguments
        if is_asked and isinstance(path, Constant) and isinstance(path.value, str):
            for file in sorted(Path(path.value).parent.glob("*.pkl")):
                yield f"{file.name} is next to the policy and is not used; if VecNormalize wrote it: normalize={file}"


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
            scenario = with_action(scenario, agent, action)
    return scenario


def disturber(
    scenario: Scenario,
    disturb: Sequence[str],
    agents: Sequence[str],
    *,
    find: Callable[[str], DisturbanceModel] | None = None,
) -> DisturbanceSampler | None:
    """Return the object that draws the disturbances of trials; None if there are none.

    Args:
        scenario: scenario in which disturbances take place.
        disturb: the disturbances as words: ``NAME=RATE`` for random disturbances, or the exact disturbances at given
            steps.
        agents: identifiers of the agents around which disturbances take place.
        find: function that returns the disturbance model of a name; by default the model is imported in this process.

    Raises:
        CrashhuntError: the disturbance does not exist, or the simulator does not support it.
    """
    rates, fixed = parse_rates(disturb), parse_fixed(disturb, tuple(agents))
    if not rates and not fixed:
        return None
    backend = scenario.backend
    return disturber_of(
        rates,
        agents=tuple(agents),
        step_length_s=backend.step_length_s(scenario),
        known=backend.disturbances,
        simulator=backend.title or "the simulator",
        fixed=fixed,
        find=find,
    )


def disturber_apart(scenario: Scenario, settings: HuntSettings) -> DisturbanceSampler | None:
    """Return the object that draws the disturbances of a hunt; a user-defined model draws in a separate process.

    Raises:
        CrashhuntError: a disturbance does not exist, or the simulator does not support it.
    """
    find = partial(_model_apart, None, settings.run.timeout_s)
    return disturber(scenario, settings.disturb, tuple(settings.agents), find=find)


def _model_apart(code: CodeFacts | None, timeout_s: float, name: str) -> DisturbanceModel:
    known = code.disturbances.get(name, "") if code is not None else ""
    if known or is_foreign("disturbances", name):
        return ModelApart(name, known, timeout_s=IMPORT_S + timeout_s)
    return locate_model(name)


def sampler_of(settings: HuntSettings) -> NamedSampler:
    """Return a new sampler for a hunt's settings.

    Raises:
        PluginError: the sampler does not exist, cannot be created, or is not a sampler.
        CrashhuntError: the sampler refuses the argument space.
    """
    hunt = HuntFacts(settings.seed, settings.crash_on)
    return NamedSampler(settings.sampler, settings.space, points=settings.points, hunt=hunt)


@contextmanager
def _name_scenario_in_errors(request: Request, scenario: Scenario) -> Iterator[None]:
    """Return a context that adds the scenario's name to errors of disturbances that the scenario defines."""
    try:
        yield
    except CrashhuntError as error:
        if request.disturb:
            raise
        message = error.message.replace("--disturb", "[disturbances]", 1)
        raise type(error)(message, fix=error.fix, where=error.where or scenario.origin) from error


def _disturb(request: Request, scenario: Scenario) -> tuple[str, ...]:
    """Return the disturbances that the user requests, or else those of the scenario."""
    words = request.disturb or tuple(f"{name}={rate}" for name, rate in scenario.disturbances.items())
    agents = tuple(scenario.agents)
    fixed = parse_fixed(words, agents)
    late = next((one for one in fixed if one.step > request.max_steps), None) if request.disturb else None
    if late is not None:
        fix = f"give a step up to {request.max_steps}, or more MAX_STEPS"
        raise UsageError(f"--disturb {late.what}@{late.step}: a trial has only {request.max_steps} steps", fix=fix)
    begun = [one for one in fixed if one.step <= request.max_steps]  # a scenario is for trials of any length
    signals = {name: signal for name, signal in signals_of_fixed(words, agents).items() if signal[0] in begun}
    able = scenario.backend.varying_disturbances
    for one, _, word in signals.values():
        if one.what not in able:
            message = f"--disturb {word}: the strength of {one.what} cannot vary over time in this scenario"
            fix = f"give a number, or one of {', '.join(able)}" if able else "give a number"
            raise UsageError(message, fix=fix)
    return (
        *(f"{name}={rate!r}" for name, rate in parse_rates(words).items()),
        *(word for _, _, word in signals.values()),
        *(word_of(one, agents) for one in begun if one.signal not in signals),
    )


def _check_branch(settings: HuntSettings) -> None:
    if settings.branch and not parse_rates(settings.disturb):
        fix = "give rates, such as --disturb brake=0.02,cut_in=0.02"
        raise UsageError("--branch needs disturbances, but the hunt has none", fix=fix)
    if settings.branch and sys.platform != "linux":
        raise UsageError("--branch forks processes, which needs Linux", fix="omit --branch")


_MAX_RARE_CHANCE = 0.2  # per step: above that a first onset is no rare event, and plain trials are cheaper


def _check_rare(settings: HuntSettings, scenario: Scenario, find: Callable[[str], DisturbanceModel]) -> None:
    """Refuse disturbances for which `--rare` knows no probability law."""
    run = settings.run
    if not settings.rare:
        if run.until_error:
            raise UsageError(f"--until-error {run.until_error} needs --rare", fix="add --rare")
        return
    if not parse_rates(settings.disturb):
        fix = "give rates, such as --disturb brake=0.02,cut_in=0.02"
        raise UsageError("--rare needs disturbances with rates, but the hunt has none", fix=fix)
    agents = tuple(settings.agents)
    if fixed := parse_fixed(settings.disturb, agents):
        begun = word_of(fixed[0], agents)
        message = f"--rare needs disturbances with rates, but --disturb {begun} begins in every trial"
        raise UsageError(message, fix="give only rates, such as --disturb brake=0.02")
    if not sampler_of(settings).independent:
        message = f"--rare needs independent trials, but --sampler {settings.sampler} draws dependent trials"
        raise UsageError(message, fix="use --sampler random")
    excluded = {
        "--seeds": settings.seeds, "--probe": settings.probe, "--branch": settings.branch, "--distinct": run.distinct,
        "--only-at-fault": run.only_at_fault, "--until-rate": run.until_rate,
    }  # fmt: skip
    if given := next((flag for flag, value in excluded.items() if value), None):
        raise UsageError(f"--rare and {given} exclude each other", fix=f"omit {given}")
    sampler = disturber(scenario, settings.disturb, agents, find=find)
    assert sampler is not None
    for name, rate in sampler.rates.items():
        if sampler.chance(name) > _MAX_RARE_CHANCE:
            most = _MAX_RARE_CHANCE / sampler.step_length_s
            message = (
                f"--rare: --disturb {name}={rate:g} begins with the probability {sampler.chance(name):.2g} in each "
                f"step, which is above {_MAX_RARE_CHANCE:g}"
            )
            raise UsageError(message, fix=f"give at most {most:g} a second, or omit --rare")
    if sys.platform != "linux":
        raise UsageError("--rare forks processes, which needs Linux", fix="omit --rare")


def _with_notes_on_crashes(
    scenario: Scenario, settings: HuntSettings, request: Request, described: Mapping[str, Mapping[str, Category]]
) -> Scenario:
    """Add notes on oracles and outcomes that never occur with this simulator; refuse a hunt that looks only for them.

    The user's own oracles may report these outcomes from other evidence.
    """
    backend = backend_of(scenario.simulator)
    if backend is None:
        return scenario
    told, crash_on = backend.reported_events, settings.crash_on
    own = [text for text in settings.oracles if not _is_built_in(text)]
    brought = outcomes_brought(own, described)
    never = [kind for kind in crash_on if kind in EVENTS and told is not None and kind not in (*told, *brought)]
    blind: list[str] = []
    if not backend.shows_actors:
        blind = [text for text in request.oracles if oracle_name(text) in ORACLES_OF_ACTORS]
        if set(request.crash_on) != set(CRASHES) and not own:
            without = {Outcome.OFF_ROAD, *outcomes_brought(blind, described)}
            never += [kind for kind in crash_on if kind in without and kind not in never]
    notes = [f"--oracle {text} detects nothing: {backend.title} shows no vehicles" for text in blind]
    if never:
        names = ",".join(never)
        if len(never) == len(crash_on):
            fix = f"it reports {', '.join(told)}" if told else "remove it"
            raise UsageError(
                f"--crash-on {names}: the simulator {scenario.simulator!r} cannot report these outcomes", fix=fix
            )
        notes.append(f"the simulator {scenario.simulator!r} never reports {names}")
    return replace(scenario, notes=(*scenario.notes, *notes))


def _is_built_in(oracle: str) -> bool:
    point = registered("oracles").get(oracle_name(oracle))
    return point is not None and point.value.startswith(f"{layout.PACKAGE.name}.")


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


def _agents(
    request: Request,
    scenario: Scenario,
    signatures: Mapping[str, Signature],
    actions: Mapping[str, str],
    observations: Mapping[str, tuple[str, ...]],
    *,
    hunted: bool,
) -> dict[str, AgentSettings]:
    asked: dict[str, dict[str, str]] = {agent: {} for agent in scenario.agents}
    for name, spec in spec_words(request.arguments).items():
        agent, argument = _owner(name, scenario, signatures)
        asked[agent][argument] = spec
    agents: dict[str, AgentSettings] = {}
    duration_s = request.max_steps * scenario.backend.step_length_s(scenario)
    for agent, setup in scenario.agents.items():
        signature = signatures[agent]
        known = scenario.agent_arguments(agent)
        for name in known:
            if name not in signature.arguments and not signature.open:
                raise ScenarioError(
                    f"agents.{agent}.arguments.{name}: {setup.agent} takes no such argument",
                    fix=one_of(name, signature.arguments, give="it takes", none="no arguments"),
                    where=scenario.origin,
                )
        specs: dict[str, ArgumentSpec] = {}
        for name, spec in asked[agent].items():
            specs |= _signal_specs(name, spec, duration_s, f"--arg {name}")
        for name in sorted({*signature.arguments, *known, *asked[agent]} - specs.keys()):
            found = _spec(name, signature.arguments.get(name), known.get(name), asked[agent].get(name), hunted=hunted)
            if found is not None:
                specs[name] = found
            elif name in signature.required:
                raise ArgumentError(
                    f"{setup.agent} needs the argument {name!r}", fix=f"give --arg {name}=SPEC", where=f"agent {agent}"
                )
        agents[agent] = AgentSettings(
            agent=setup.agent, arguments=specs, action=actions.get(agent), observation=observations.get(agent)
        )
    return agents


def _owner(name: str, scenario: Scenario, signatures: Mapping[str, Signature]) -> tuple[str, str]:
    """Return the agent and the name to which an ``--arg`` refers."""
    takes = {agent: Takes(signature.arguments, signature.open) for agent, signature in signatures.items()}
    owner = Owners(takes).of(name, option="--arg")
    if owner is not None:
        return owner
    agent = agent_of(name, scenario.agents)
    if agent:
        where = f"--arg {name}: {scenario.agents[agent].agent}"
        signatures[agent].check([name.removeprefix(f"{agent}.")], where=where)
    if name in scenario.arguments:
        raise ArgumentError(
            f"--arg {name}: {name} is an argument of the scenario, not of an agent", fix=f"write --set {name}=SPEC"
        )
    first = next(iter(scenario.agents))
    signatures[first].check([name], where=f"--arg: {scenario.agents[first].agent}")
    raise AssertionError(name)  # the agent that accepts it is its owner


def _spec(
    name: str, declared: Argument | None, known: Argument | None, asked: str | None, *, hunted: bool
) -> ArgumentSpec | None:
    kind = (declared.kind if declared else None) or (known.kind if known else None)
    if asked is not None:
        distribution = parse_spec(asked, kind, where=f"--arg {name}")
        # A program's 12 has no type, because JSON has one type of numbers.
        if declared and kind is None and type(declared.default) is int and str in map(type, distribution.grid(1)):
            raise ArgumentError(f"--arg {name}: {asked!r} is not a number", fix=f"give one, such as {declared.default}")
        return ArgumentSpec(spec=str(distribution), kind=kind)
    for argument in (known, declared) if hunted else ():
        if argument is not None and argument.distribution is not None:
            # The same text may mean whole numbers or not, depending on the agent's own type.
            return ArgumentSpec(spec=str(parse_spec(str(argument.distribution), kind, where=name)), kind=kind)
    for argument in (known, declared):
        # The constructor's own default too: it may be another one by the time of a replay.
        if argument is not None and argument.default is not None:
            try:
                constant = parse_spec(str(Constant(argument.default)), kind, where=name)
            except ArgumentError:
                if argument is known:
                    raise
                return None  # a default of another type than the annotation, such as `gap: float = "auto"`
            # A text such as "a|b" would be read as a choice, and "7" as a number; so its owner keeps it as a default.
            is_kept = isinstance(constant, Constant) and (argument is known or constant.value == argument.default)
            return ArgumentSpec(spec=str(constant), kind=kind) if is_kept else None
    return None


def _scenario_arguments(
    request: Request, scenario: Scenario, disturb: Sequence[str], *, hunted: bool
) -> dict[str, ArgumentSpec]:
    known = scenario.scenario_arguments()
    wanted: dict[str, str] = {}
    for name, spec in spec_words(request.scenario_arguments).items():
        owner = Owners({}, known).of(name, option="--set")
        if owner is None:
            raise ArgumentError(f"--set: the scenario has no argument {name!r}", fix=one_of(name, known, give="it has"))
        wanted[owner[1]] = spec
    specs: dict[str, ArgumentSpec] = {}
    duration_s = request.max_steps * scenario.backend.step_length_s(scenario)
    for name, argument in known.items():
        asked = wanted.get(name)
        if asked is not None and is_signal(asked):
            able = tuple(scenario.backend.signal_arguments(scenario))
            if name not in able:
                fix = f"give a range, or vary one of {', '.join(able)}" if able else "give a range"
                raise ArgumentError(f"--set {name}: the argument cannot vary over time in this scenario", fix=fix)
            specs |= _signal_specs(name, asked, duration_s, f"--set {name}")
            continue
        if asked is not None:
            spec = str(parse_spec(asked, argument.kind, where=f"--set {name}"))
        elif argument.distribution is not None and (hunted or argument.default is None):
            spec = str(argument.distribution)
        elif argument.default is not None:
            spec = str(Constant(argument.default))
        else:
            raise ScenarioError(
                f"arguments.{name} has neither a default nor a range",
                fix="give it a default or a range",
                where=scenario.origin,
            )
        specs[name] = ArgumentSpec(spec=spec, kind=argument.kind)
    for name, (one, signal, word) in signals_of_fixed(disturb, tuple(scenario.agents)).items():
        specs |= _signal_specs(name, signal, one.how_long, f"--disturb {word}")
    return specs


def _signal_specs(name: str, spec: str, duration_s: float, where: str) -> dict[str, ArgumentSpec]:
    """Return the specifications of a signal and of its points; empty if the specification is no signal."""
    found = expand_signal(name, spec, duration_s, where=where)
    return {part: ArgumentSpec(spec=text, kind="str" if part == name else "float") for part, text in found.items()}
