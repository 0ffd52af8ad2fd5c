"""Chooses actions, observed parts, requirements and crash outcomes, from options, scenario and agent's class."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError, UsageError
from crashhunt.base.text import one_of
from crashhunt.oracles import REQUIREMENT, check_requirement, requirement_oracles
from crashhunt.scenario import action_settings, canonical_action, check_action
from crashhunt.simulators import parse_parts
from crashhunt.trial import CRASHES, EVENTS
from crashhunt.world import LIMITS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from crashhunt.plans._settings import Request
    from crashhunt.scenario import Scenario
    from crashhunt.trial import Outcome, Signature


def chosen_actions(
    asked: str, scenario: Scenario, signatures: Mapping[str, Signature], brought: Collection[str] = ()
) -> dict[str, str]:
    """Return the form of actions of each agent for which the command line or the agent's class chooses one.

    The command line takes precedence over the scenario, and the scenario over the class of its own agent. A class that
    ``--agent`` names takes precedence over the scenario, because the scenario's form is that of the scenario's agent.

    Args:
        asked: value of ``--action``; may be empty.
        scenario: scenario with its agents.
        signatures: signature of each agent.
        brought: the vehicles for which ``--agent`` names the agent.

    Raises:
        UsageError: an agent cannot return actions of the chosen form, or names a form that does not exist.
    """
    if not scenario.backend.actions:
        return {}
    found = {}
    for agent, setup in scenario.agents.items():
        signature = signatures[agent]
        action_settings(signature.action, where=f"action of {setup.agent}")
        action_settings(asked, where="--action")
        if asked:
            found[agent] = asked
        elif signature.action and (setup.action is None or agent in brought):
            found[agent] = signature.action
        check_action(found.get(agent, setup.action), signature.actions, setup.agent)
    return found


def refuse_late_plans(scenario: Scenario, kinds: Iterable[str]) -> None:
    """Refuse late actions of agents that return plans: a plan is relative to the step in which it is returned.

    Args:
        scenario: scenario with its agents.
        kinds: kinds of the disturbances.

    Raises:
        UsageError: the actions of an agent are plans, and a disturbance delays them.
    """
    for agent, setup in scenario.agents.items():
        if setup.action_form in ("trajectory", "target_pose") and "late_action" in kinds:
            message = f"--disturb late_action: {agent} returns a {setup.action_form}, which cannot be delayed"
            raise UsageError(message, fix="omit late_action, or give --action acceleration_steering")


def notes_on_actions(scenario: Scenario, signatures: Mapping[str, Signature]) -> Iterator[str]:
    """Yield a note for each agent whose class names another form of actions than the hunt uses."""
    for agent, setup in scenario.agents.items():
        named = signatures[agent].action
        if scenario.backend.actions and named and canonical_action(named) != setup.action_form:
            yield f"the action of {agent} is {setup.action_form}, which takes precedence over {named} of {setup.agent}"


# Chooses the parts that each agent observes: the command line, the scenario or the agent's class names them.


def chosen_observations(
    asked: Sequence[str], scenario: Scenario, signatures: Mapping[str, Signature], brought: Collection[str] = ()
) -> dict[str, tuple[str, ...]]:
    """Return the parts of each agent for which the command line, the scenario or the agent's class names parts.

    The command line takes precedence over the scenario, and the scenario over the class of its own agent. A class that
    ``--agent`` names takes precedence over the scenario.

    Args:
        asked: value of ``--observe``; may be empty.
        scenario: scenario with its agents.
        signatures: signature of each agent; without one, only the command line and the scenario count.
        brought: the vehicles for which ``--agent`` names the agent.

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

    Args:
        scenario: the scenario; if it has requirements itself, no such note was made.
        requirements: the requirements of the hunt.
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

    Args:
        words: the values of ``--crash-on``.
        brought: the outcomes of the chosen oracles, which ``--crash-on`` may name as well.

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
