"""SUMO's complaints about an episode that it could not set up, as file, key and value that somebody can mend."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario.backends.sumo._names import line_of
from crashhunt.scenario.backends.sumo._table import SumoSetup

if TYPE_CHECKING:
    from crashhunt.scenario._scenario import Scenario

__all__ = ["explained"]

_RAISED = "SUMO could not set up the episode: "
_MENDED = "mend it there"
# SUMO raises one of these, and says on its output what it means.
_VAGUE = ("Process Error", "Could not parse commandline options.")
_STAGED = re.compile(r"/\S*?/stage-\d+/")
_OPTION = re.compile(r"No option with the name '([^']+)' exists|On processing option '--([^']+)'")
_NUMBER = re.compile(r"Invalid (?:Number|Bool) Format(?: \(\w+\))? (\S+)")
_LINE = re.compile(r"In file '([^']+)' At line/column (\d+)")
_VEHICLE = re.compile(r"(?:Invalid|departing) (\w+?)(?: definition)?(?: '[^']*')? for vehicle '([^']+)'")
_KEYS = {"type": "type", "route": "route", "departLane": "depart_lane", "departPos": "depart_pos"}
_KEYS |= {"departSpeed": "depart_speed"}
_DEFINED = re.compile(r"(?:flow|vType|vehicle type|vehicle|trip|route|edge|lane|junction) '([^']+)'")


def explained(message: str, output: str, scenario: Scenario) -> ScenarioError | None:
    """Return what is wrong with a scenario in which no episode could be set up; None where SUMO is not to blame.

    Args:
        message: of the exception in the worker.
        output: what SUMO printed last.
        scenario: as it was loaded, not the copy in which the worker ran.
    """
    said, errors = message.removeprefix(_RAISED), _errors(output)
    died = message.startswith("the process died") and errors
    if not (died or message.startswith(_RAISED)):
        return None
    if died or (errors and said in _VAGUE):
        said = f"{errors[0]} ({message})" if died else errors[0]
    said = _STAGED.sub(f"{scenario.folder}/", said).rstrip(".")
    return _about_an_option(said, scenario) or _about_a_vehicle(said, scenario) or _about_a_file(said, scenario)


def _errors(output: str) -> list[str]:
    """The error messages in what SUMO printed, each in one line; what belongs to one is indented below it."""
    found: list[str] = []
    open_ = False
    for line in output.splitlines():
        if line.startswith("Error: "):
            found.append(line.removeprefix("Error: "))
            open_ = True
        elif open_ and line.startswith(" "):
            found[-1] += f" {line.strip()}"
        else:
            open_ = False
    return found


def _about_an_option(said: str, scenario: Scenario) -> ScenarioError | None:
    options = scenario.table(SumoSetup).options
    keys = {name: f"sumo.options.{name}" for name in options}
    keys |= {setup.option: f"arguments.{name}.option" for name, setup in scenario.arguments.items() if setup.option}
    found, number = _OPTION.search(said), _NUMBER.search(said)
    if found is not None:
        name = found[1] or found[2]
        if name in keys:
            fix = "see https://sumo.dlr.de/docs/sumo.html for its options"
            return ScenarioError(f"{keys[name]}: SUMO says: {said}", fix=fix, where=scenario.origin)
    if number is not None:
        for name, value in options.items():
            if str(value) == number[1]:
                what = f"{keys[name]} = {value!r}: SUMO says: {said}"
                return ScenarioError(what, fix="change the value", where=scenario.origin)
    return None


def _about_a_vehicle(said: str, scenario: Scenario) -> ScenarioError | None:
    found = _VEHICLE.search(said)
    if found is None or found[2] not in scenario.agents or found[1] not in _KEYS:
        return None
    key = _KEYS[found[1]]
    value = getattr(scenario.agents[found[2]], key)
    what = f"agents.{found[2]}.{key} = {value!r}: SUMO says: {said}"
    return ScenarioError(what, fix="change the value", where=scenario.origin)


def _about_a_file(said: str, scenario: Scenario) -> ScenarioError:
    """The file and the line that SUMO names, or in which what it names is defined."""
    line = _LINE.search(said)
    if line is not None:
        text = said[: line.start()].strip()
        return ScenarioError(f"SUMO says: {text}", fix=_MENDED, where=f"{line[1]}, line {line[2]}")
    files = [scenario.folder / name for name in reversed(list(scenario.files()))]  # the network last, which is large
    for name in _DEFINED.findall(said):
        where = line_of(name, files)
        if where:
            return ScenarioError(f"SUMO says: {said}", fix=_MENDED, where=where)
    return ScenarioError(f"SUMO says: {said}", fix="see [sumo] and the files that it names", where=scenario.origin)
