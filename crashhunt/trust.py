"""What a stranger's crash may make this process do when its recorded actions are driven: simulate, and nothing else."""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any

from crashhunt.errors import UsageError
from crashhunt.plugins import registered

if TYPE_CHECKING:
    from collections.abc import Iterator
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
    for module in scenario.modules():
        raise _refusal(f"it would import {module!r}")
    if scenario.gym is not None and (scenario.gym.kwargs or scenario.arguments):
        raise _refusal("it gives its environment arguments")
    asked = [spec.spec for spec in settings.scenario_arguments.values() if spec.kind == "str"]
    for text in _texts([scenario.highway.config, asked] if scenario.highway else []):
        if "." in text and not text.startswith("highway_env."):  # the class of a vehicle
            raise _refusal(f"its configuration names {text!r}")
    if scenario.sumo is None:
        return
    for option in scenario.sumo.options:
        if any(word in option for word in _WRITING):
            raise _refusal(f"it sets SUMO's option {option!r}")
    for name in (*scenario.sumo.routes, *scenario.sumo.additional):
        for tag, attribute in _attributes(scenario.folder / name):
            if attribute == "file" or "output" in attribute:
                raise _refusal(f"{name} has <{tag} {attribute}=…>, with which SUMO writes a file")


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list | tuple):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


def _attributes(path: Path) -> list[tuple[str, str]]:
    opened = gzip.open if path.suffix == ".gz" else open
    try:
        with opened(path, "rb") as content:
            return [(element.tag, name) for _, element in ET.iterparse(content) for name in element.keys()]  # noqa: SIM118
    except (ET.ParseError, OSError, EOFError) as error:
        raise _refusal(f"{path.name} cannot be checked: {error}") from None


def _refusal(reason: str) -> UsageError:
    return UsageError(f"the crash is a stranger's, and {reason}", fix="give --trust if you trust who made it")
