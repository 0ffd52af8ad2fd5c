"""Chooses the form of each agent's actions: the command line, the scenario or the agent's class names it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.scenario import action_settings, canonical_action, check_action

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from crashhunt.scenario import Scenario
    from crashhunt.trial import Signature


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
