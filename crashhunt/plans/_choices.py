"""Chooses actions, observed parts, requirements, crash outcomes and disturbances for a hunt, and checks them."""

from __future__ import annotations

import math
import re
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, ScenarioError, UsageError
from crashhunt.base.plugins import is_foreign, registered
from crashhunt.base.text import one_of
from crashhunt.disturbances import (
    ModelApart,
    disturber_of,
    locate_model,
    parse_fixed,
    parse_rates,
    signals_of_fixed,
    word_of,
)
from crashhunt.oracles import (
    ORACLES_OF_ACTORS,
    REQUIREMENT,
    check_requirement,
    oracle_name,
    outcomes_brought,
    requirement_oracles,
)
from crashhunt.plans._code import IMPORT_S, CodeFacts
from crashhunt.scenario import action_settings, backend_of, canonical_action, check_action, with_whole_vehicle_visible
from crashhunt.simulators import parse_parts
from crashhunt.trial import CRASHES, EVENTS, Outcome
from crashhunt.world import LIMITS

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from crashhunt.disturbances import DisturbanceModel, DisturbanceSampler
    from crashhunt.plans._request import Request
    from crashhunt.plans._settings import HuntSettings
    from crashhunt.samplers import NamedSampler
    from crashhunt.scenario import Scenario
    from crashhunt.trial import CallSignature, Category


def chosen_actions(
    asked: str, scenario: Scenario, signatures: Mapping[str, CallSignature], brought: Collection[str] = ()
) -> dict[str, str]:
    """Return the form of actions of each agent for which the command line or the agent's class chooses one.

    The command line takes precedence over the scenario, and the scenario over the class of its own agent. A class that
    ``--agent`` names takes precedence over the scenario, because the scenario's form is that of the scenario's agent.
    ``asked`` is the value of ``--action``, and ``brought`` has the vehicles for which ``--agent`` names the agent.

    Raises:
        UsageError: an agent cannot return actions of the chosen form, or names a form that does not exist.
    """
    if not scenario.backend.actions:
        return {}
    found = {}
    for agent, setup in scenario.agents.items():
        signature = signatures[agent]
        action_settings(signature.action, where=f"action of {setup.agent}")
        if asked:
            found[agent] = asked
        elif signature.action and (setup.action is None or agent in brought):
            found[agent] = signature.action
        check_action(found.get(agent, setup.action), signature.actions, setup.agent)
        action = found.get(agent, setup.action)
        visible = with_whole_vehicle_visible(action)
        if visible is not None and visible != action:
            found[agent] = visible
    return found


def refuse_misplaced_plans(scenario: Scenario, kinds: Iterable[str]) -> None:
    """Refuse disturbances that would make the plans of an agent begin where the vehicle is not.

    Raises:
        UsageError: an agent returns plans, and a disturbance does not fit them.
    """
    kinds = tuple(kinds)
    for agent, setup in scenario.agents.items():
        for kind in (one for one in kinds if one in setup.refused_disturbances):
            if kind == "late_action":
                message = f"--disturb late_action: {agent} returns a {setup.action_form}, which cannot be delayed"
                raise UsageError(message, fix="omit late_action, or give --action acceleration_steering")
            message = f"--disturb {kind}: {agent} would return a trajectory that does not begin where the vehicle is"
            raise UsageError(message, fix=f"give --action trajectory:tracker=pure_pursuit, or omit {kind}")


def notes_on_declarations(scenario: Scenario, signatures: Mapping[str, CallSignature]) -> Iterator[str]:
    """Yield notes on the agents whose class names another form than the hunt uses, or names none as a hunt reads it."""
    for agent, setup in scenario.agents.items():
        examples = {"action": '"acceleration"', "observation": '["ego", "actors"]'}
        for name, kind in signatures[agent].unread.items():
            yield (
                f"the attribute {name} of {setup.agent} is ignored, because its type is {kind}; set it in the class, "
                f"such as {name} = {examples[name]}"
            )
        named = signatures[agent].action
        if scenario.backend.actions and named and canonical_action(named) != setup.action_form:
            yield f"the action of {agent} is {setup.action_form}, which takes precedence over {named} of {setup.agent}"


# Chooses the parts that each agent observes: the command line, the scenario or the agent's class names them.


def chosen_observations(
    asked: Sequence[str], scenario: Scenario, signatures: Mapping[str, CallSignature], brought: Collection[str] = ()
) -> dict[str, tuple[str, ...]]:
    """Return the parts of each agent for which the command line, the scenario or the agent's class names parts.

    The command line takes precedence over the scenario, and the scenario over the class of its own agent. A class that
    ``--agent`` names takes precedence over the scenario. ``asked`` is the value of ``--observe``, and ``brought`` has
    the vehicles for which ``--agent`` names the agent. Without the signature of an agent, only the command line and the
    scenario count.

    Raises:
        UsageError: a part does not exist, or the simulator does not have it.
    """
    found = {}
    for agent, setup in scenario.agents.items():
        words, where = tuple(asked), "--observe"
        of_class = signatures[agent].observation if agent in signatures else ()
        if not words and setup.observation and not (of_class and agent in brought):
            words, where = setup.observation, f"agents.{agent}.observation"
        elif not words:
            words, where = of_class, f"observation of {setup.agent}"
        if words:
            parse_parts(words, scenario.backend.observations, where=where)
            found[agent] = words
    return found


# The requirements of a hunt, from the command line or the scenario.


_REQUIREMENT_NAME = re.compile(r"[A-Za-z_]\w*")


def chosen_requirements(request: Request, scenario: Scenario) -> list[str]:
    """Return the requirements as oracles: those of the request, or those of the scenario if the request has none.

    Raises:
        UsageError: a requirement is no formula, has a window that does not fit the step length, or is not decided
            within the maximum number of steps.
    """
    texts, option = list(request.requirements), "--require"
    if not texts and scenario.requirement:
        wrong = next((name for name in scenario.requirement if not _REQUIREMENT_NAME.fullmatch(name)), None)
        if wrong is not None:
            fix = "give letters, digits and underscores"
            raise ScenarioError(f"{wrong!r} is not a name of a requirement", fix=fix, where=scenario.origin)
        texts = [f"{name}={formula}" for name, formula in scenario.requirement.items()]
        option = f"{scenario.origin}: requirement"
    found = requirement_oracles(texts, option)
    step_s = scenario.backend.step_length_s(scenario)
    for oracle in found:
        check_requirement(oracle, step_s, request.max_steps, option)
    return found


def without_refuted_notes(scenario: Scenario, requirements: list[str]) -> Scenario:
    """Return the scenario without the notes that do not apply if there is a requirement.

    For a scenario that has requirements itself, no such note was made.
    """
    if not requirements or scenario.requirement:
        return scenario
    with_one = replace(scenario, requirement={REQUIREMENT: "true"})
    made, apply = (
        {note for backend in one.backends.values() for note in backend.notes(one)} for one in (scenario, with_one)
    )
    return replace(scenario, notes=tuple(note for note in scenario.notes if note in apply or note not in made))


def parse_crash_on(
    words: Sequence[str], brought: Sequence[Outcome] = ()
) -> tuple[tuple[Outcome, ...], dict[str, float]]:
    """Return the outcomes that ``--crash-on`` names, and the limits that it gives.

    ``brought`` has the outcomes of the chosen oracles, which ``--crash-on`` may name as well.

    Raises:
        UsageError: an outcome does not exist, or a limit is invalid.
    """
    known = tuple(dict.fromkeys((*CRASHES, *EVENTS, *brought)))
    crashes = [str(outcome) for outcome in known]
    names, limits = [], {}
    for word in words:
        name, colon, limit = str(word).partition(":")
        if name not in crashes:
            raise UsageError(
                f"--crash-on {name!r} is not an outcome that can count as a crash",
                fix=one_of(name, crashes, give="give some of"),
            )
        if colon:
            limits[name] = _limit(name, limit)
        names.append(name)
    if not names:
        raise UsageError("--crash-on names no outcome", fix=f"give some of {','.join(crashes)}")
    return tuple(outcome for outcome in known if outcome in names), limits


def _limit(name: str, text: str) -> float:
    if name not in LIMITS:
        raise UsageError(
            f"--crash-on {name}:{text}: {name} has no limit",
            fix=f"write {name} alone; only {' and '.join(LIMITS)} have a limit",
        )
    unit = LIMITS[name][1]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        fix = f"give {unit} above 0, such as {name}:{'30' if unit == 's' else '6'}"
        raise UsageError(f"--crash-on {name}:{text}: {text!r} is not a limit", fix=fix)
    return value


# The disturbances.


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
    find = partial(model_apart, None, settings.run.timeout_s)
    return disturber(scenario, settings.disturb, tuple(settings.agents), find=find)


def model_apart(code: CodeFacts | None, timeout_s: float, name: str) -> DisturbanceModel:
    """Return the disturbance model of a name; a model of the user runs in a separate process."""
    known = code.disturbances.get(name, "") if code is not None else ""
    if known or is_foreign("disturbances", name):
        return ModelApart(name, known, timeout_s=IMPORT_S + timeout_s)
    return locate_model(name)


@contextmanager
def name_scenario_in_errors(request: Request, scenario: Scenario) -> Iterator[None]:
    """Return a context that adds the scenario's name to errors of disturbances that the scenario defines."""
    try:
        yield
    except CrashhuntError as error:
        if request.disturb:
            raise
        message = error.message.replace("--disturb", "[disturbances]", 1)
        raise type(error)(message, fix=error.fix, where=error.where or scenario.origin) from error


def chosen_disturbances(request: Request, scenario: Scenario) -> tuple[str, ...]:
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


_MAX_RARE_CHANCE = 0.2  # per step: above that a first onset is no rare event, and plain trials are cheaper


def check_branch(settings: HuntSettings) -> None:
    """Refuse `--branch` without disturbances at random steps."""
    if settings.branch and not parse_rates(settings.disturb):
        fix = "give rates, such as --disturb brake=0.02,cut_in=0.02"
        raise UsageError("--branch needs disturbances, but the hunt has none", fix=fix)


def check_rare(
    settings: HuntSettings, scenario: Scenario, find: Callable[[str], DisturbanceModel], sampler: NamedSampler
) -> None:
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
    if not sampler.independent:
        message = f"--rare needs independent trials, but --sampler {settings.sampler} draws dependent trials"
        raise UsageError(message, fix="use --sampler random")
    excluded = {
        "--seeds": settings.seeds, "--probe": settings.probe, "--branch": settings.branch, "--distinct": run.distinct,
        "--only-at-fault": run.only_at_fault, "--until-rate": run.until_rate,
    }  # fmt: skip
    if given := next((flag for flag, value in excluded.items() if value), None):
        raise UsageError(f"--rare and {given} exclude each other", fix=f"omit {given}")
    drawn = disturber(scenario, settings.disturb, agents, find=find)
    assert drawn is not None
    for name, rate in drawn.rates.items():
        if drawn.chance(name) > _MAX_RARE_CHANCE:
            most = _MAX_RARE_CHANCE / drawn.step_length_s
            message = (
                f"--rare: --disturb {name}={rate:g} begins with the probability {drawn.chance(name):.2g} in each "
                f"step, which is above {_MAX_RARE_CHANCE:g}"
            )
            raise UsageError(message, fix=f"give at most {most:g} a second, or omit --rare")


def with_notes_on_crashes(
    scenario: Scenario, settings: HuntSettings, request: Request, described: Mapping[str, Mapping[str, Category]]
) -> Scenario:
    """Add notes on oracles and outcomes that never occur with this simulator; refuse a hunt that looks only for them.

    The user's own oracles may report these outcomes from other evidence.
    """
    backend = backend_of(scenario.simulator)
    if backend is None:
        return scenario
    reported, crash_on = backend.reported_events, settings.crash_on
    own = [text for text in settings.oracles if not _is_built_in(text)]
    brought = outcomes_brought(own, described)
    never = [kind for kind in crash_on if kind in EVENTS and reported is not None and kind not in (*reported, *brought)]
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
            fix = f"it reports {', '.join(reported)}" if reported else "remove it"
            raise UsageError(
                f"--crash-on {names}: the simulator {scenario.simulator!r} cannot report these outcomes", fix=fix
            )
        notes.append(f"the simulator {scenario.simulator!r} never reports {names}")
    return replace(scenario, notes=(*scenario.notes, *notes))


def _is_built_in(oracle: str) -> bool:
    point = registered("oracles").get(oracle_name(oracle))
    return point is not None and point.value.startswith(f"{layout.PACKAGE.name}.")
