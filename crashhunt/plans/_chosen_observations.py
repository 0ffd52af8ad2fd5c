"""Chooses the parts that each agent observes: the command line, the scenario or the agent's class names them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.simulators import parse_parts

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from crashhunt.scenario import Scenario
    from crashhunt.trial import Signature


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
