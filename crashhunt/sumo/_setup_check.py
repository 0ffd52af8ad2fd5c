"""Checks a scenario for SUMO: its files, its arguments, and the options that trials need."""

from __future__ import annotations

import string
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.scenario import refuse
from crashhunt.sumo._files import read_xml
from crashhunt.sumo._options import RESERVED, SumoSetup, arguments_of, canonical, is_true

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.scenario import Scenario


def check(scenario: Scenario, where: str) -> None:
    """Refuse a scenario whose table, arguments, files and controlled vehicles are not consistent.

    Raises:
        ScenarioError: the scenario is not consistent; the message names key, value and fix.
    """
    sumo = scenario.table(SumoSetup)
    check_options(sumo.options, where)
    for name, argument in scenario.arguments.items():
        if argument.option:
            check_options({argument.option: ""}, f"{where}: arguments.{name}")
    for file in scenario.files():
        if "," in Path(file).name:
            refuse(where, "sumo", file, "has a comma, at which SUMO begins another file", "rename it")
    for file in () if sumo.literal else scenario.texts():
        for name in _asked_for(read_xml(scenario.folder / file)):
            if name not in scenario.arguments:
                message = f"has no {name!r}, which {file} asks for"
                refuse(where, "arguments", sorted(scenario.arguments), message, "declare it")
    for name in arguments_of(sumo.manoeuvre, scenario.arguments) if sumo.manoeuvre else ():
        if name not in scenario.arguments:
            message = f"has no {name!r}, which the manoeuvre {sumo.manoeuvre!r} needs"
            refuse(where, "arguments", sorted(scenario.arguments), message, "declare it")
    if sumo.manoeuvre and len(scenario.agents) != 1:
        refuse(where, "agents", sorted(scenario.agents), "must be one vehicle for a manoeuvre", "declare one agent")
    for agent, setup in scenario.agents.items():
        named = [key for key in ("existing", "route", "edges", "replaces") if getattr(setup, key)]
        if len(named) != 1:
            message = "must have one of existing, route, edges, replaces"
            refuse(where, f"agents.{agent}", named, message, "give exactly one of them")
        if setup.replaces and setup.replaces not in scenario.arguments:
            message = "is no scenario argument"
            refuse(where, f"agents.{agent}.replaces", setup.replaces, message, "declare it: a vehicle's name as a text")
        speeds = setup.target_speeds
        if not speeds or list(speeds) != sorted(set(speeds)):
            refuse(where, f"agents.{agent}.target_speeds", speeds, "does not rise", "list speeds from low to high")


def check_options(options: Mapping[str, object], where: str) -> None:
    """Refuse options of SUMO that would change the meaning of a trial.

    Raises:
        ScenarioError: an option would change the meaning of a trial; the message names the option.
    """
    seen: dict[str, str] = {}
    for option, value in options.items():
        name = canonical(option)
        if name in RESERVED:
            refuse(where, "sumo.options", option, "is an option that crashhunt sets itself", "remove it")
        if name == "mesosim" and (value == "" or is_true(value)):
            message = "simulates queues: vehicles jump from one to the next, and none can be driven"
            refuse(where, f"sumo.options.{option}", value, message, "remove it, to simulate every vehicle")
        if name in ("configuration-file", "load-state"):
            message = "names a file that says more than a trial may take over"
            refuse(where, "sumo.options", option, message, "write its options here instead, and begin at a time")
        if name in seen:
            refuse(where, "sumo.options", option, f"is another name of {seen[name]!r}", "give it once")
        seen[name] = option


def _asked_for(content: bytes) -> list[str]:
    """Return the arguments that a file uses as ``${NAME}``."""
    if b"${" not in content:
        return []
    return string.Template(content.decode("utf-8", "replace")).get_identifiers()
