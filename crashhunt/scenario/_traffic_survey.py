"""What a hunt finds out about the plain traffic of a configuration before its first trial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.plain import Json, Plain
    from crashhunt.scenario._scenario import Scenario
    from crashhunt.trial import Value

__all__ = ["RunToSurvey", "SurveyJob", "TrafficSurvey"]


class RunToSurvey(TypedDict):
    """One run of the plain traffic."""

    seed: int
    values: dict[str, Value]


class SurveyJob(TypedDict):
    """What the process that simulates the plain traffic reads from its JSON file.

    ``scenario`` is what `as_plain_data` returns, ``folder`` holds the scenario's files, ``stage`` is a folder of the
    process's own, ``answer`` the file for the JSON list of completed runs. The process ends a run after
    ``time_limit_s`` of wall time since its start.
    """

    scenario: Plain
    folder: str
    stage: str
    answer: str
    time_limit_s: float
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
