"""Loading of a map, OpenStreetMap or OpenDRIVE, as a scenario that is made from the map."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario import load_scenario
from crashhunt.sumo.maps import cached_scenario

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.scenario import Scenario


def load_map(path: Path, ego: str) -> Scenario:
    """Return the scenario of a map. The scenario is made once, and then kept in the user's cache.

    Raises:
        ScenarioError: the map cannot be used, or ``ego`` names a vehicle.
    """
    if ego:
        fix = "omit the option, or make the scenario yourself: crashhunt init DIR"
        raise ScenarioError(f"--ego {ego!r} cannot be used with a map", fix=fix, where=str(path))
    folder = cached_scenario(path)
    scenario = load_scenario(folder)
    note = f"the scenario of {path.name} is {folder}; crashhunt init makes one that you can edit"
    return replace(scenario, name=path.name.partition(".")[0] or path.name, notes=(note, *scenario.notes))
