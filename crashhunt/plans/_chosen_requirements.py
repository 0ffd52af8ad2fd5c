"""The requirements of a hunt, from the command line or the scenario."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.oracles import REQUIREMENT, check_requirement, requirement_oracles

if TYPE_CHECKING:
    from crashhunt.plans._settings import Request
    from crashhunt.scenario import Scenario

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
