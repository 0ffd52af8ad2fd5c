"""What a stranger's crash may make this process do when its recorded actions are driven: simulate, and nothing else."""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

from crashhunt.errors import UsageError
from crashhunt.plugins import registered

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.plugins import Group
    from crashhunt.scenario import Scenario
    from crashhunt.settings import HuntSettings

__all__ = ["refuse_side_effects"]

_WRITING = ("output", "file", "save", "log", "registry", "remote-port")


def refuse_side_effects(scenario: Scenario, settings: HuntSettings) -> None:
    """Refuse a scenario that would run code of its choice or write files.

    Raises:
        UsageError: with what it would do.
    """
    names: list[tuple[Group, str]] = [("simulators", scenario.simulator)]
    names += [("oracles", name) for name in settings.oracles]
    for group, name in names:
        if name not in registered(group):
            raise _refusal(f"it would import {name!r}")
    if scenario.sumo is None:
        return
    for option in scenario.sumo.options:
        if any(word in option for word in _WRITING):
            raise _refusal(f"it sets SUMO's option {option!r}")
    for name in (*scenario.sumo.routes, *scenario.sumo.additional):
        for tag, attribute in _attributes(scenario.folder / name):
            if attribute == "file" or "output" in attribute:
                raise _refusal(f"{name} has <{tag} {attribute}=…>, with which SUMO writes a file")


def _attributes(path: Path) -> list[tuple[str, str]]:
    opened = gzip.open if path.suffix == ".gz" else open
    try:
        with opened(path, "rb") as content:
            return [(element.tag, name) for _, element in ET.iterparse(content) for name in element.keys()]  # noqa: SIM118
    except (ET.ParseError, OSError, EOFError) as error:
        raise _refusal(f"{path.name} cannot be checked: {error}") from None


def _refusal(reason: str) -> UsageError:
    return UsageError(f"the crash is a stranger's, and {reason}", fix="give --trust if you trust who made it")
