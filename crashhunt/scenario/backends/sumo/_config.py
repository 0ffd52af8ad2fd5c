"""Reading a ``.sumocfg`` as SUMO does: sections, short names, environment variables."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario.backends.sumo._options import ALWAYS, canonical, is_output, is_shown, is_true, writes

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["changes", "is_left_out", "read_config", "split_names"]

_VARIABLE = re.compile(r"\$\{(.+?)\}")
# Why a trial has another value than the configuration; the rest of what is always so changes nothing on the road.
_WHY = {
    "random": "a trial must be the same again",
    "threads": "results depend on their number",
    "device.rerouting.threads": "results depend on their number",
    "collision.action": "vehicles stay where they have met",
    "collision.check-junctions": "crossing traffic collides too",
    "collision.mingap-factor": "vehicles have crashed when they touch",
}


def read_config(path: Path) -> tuple[dict[str, str], list[str]]:
    """Return the options of a configuration by the names that SUMO lists them under, and what to tell about them.

    SUMO does not heed the sections, and replaces ``${NAME}`` by the environment variable and ``~`` by the home
    directory; so that a replay on another machine does not depend on them, that is done here, once.

    Raises:
        ScenarioError: it is not a configuration.
    """
    try:
        root = ET.parse(path).getroot()
    except (ET.ParseError, UnicodeDecodeError, LookupError, ValueError) as error:
        raise ScenarioError(f"not valid XML: {error}", fix="mend the file", where=str(path)) from None
    except OSError as error:
        raise ScenarioError(f"cannot be read: {error.strerror}", where=str(path)) from None
    options: dict[str, str] = {}
    used: dict[str, str] = {}
    for element in root.iter():
        value = element.get("value", element.get("v"))
        if value is None and len(element) == 0 and element is not root:
            value = (element.text or "").strip()  # as it was written long ago
        if not value:
            continue
        name = canonical(element.tag)
        if name in options:
            fix = "remove one of the two"
            raise ScenarioError(f"the option {element.tag} is given twice", fix=fix, where=str(path))
        options[name] = _resolved(value, used)
    notes = [
        f"{path.name} names ${{{name}}}, which is {value!r} now" if value else f"{path.name}: ${{{name}}} is not set"
        for name, value in used.items()
    ]
    return options, notes


def _resolved(value: str, used: dict[str, str]) -> str:
    def variable(match: re.Match[str]) -> str:
        used[match[1]] = found = os.environ.get(match[1], "")
        return found

    if value.startswith("~"):
        value = "${HOME}" + value[1:]
    return _VARIABLE.sub(variable, value.replace(",~", ",${HOME}"))


def split_names(value: str) -> list[str]:
    """Split a list of files; a blank is part of a name."""
    return [name.strip() for name in value.split(",") if name.strip()]


def changes(options: Mapping[str, str]) -> list[str]:
    """Return what a trial does not take over from a configuration, and why, in words."""
    found = []
    for name, value in options.items():
        if name == "seed":
            found.append(f"seed {value} (each trial has its own)")
        elif name in _WHY and not _same(value, ALWAYS[name]):
            found.append(f"{name} {value} (it is {ALWAYS[name]}: {_WHY[name]})")
        elif name == "load-state":
            found.append(f"load-state {value} (a trial begins with an empty road)")
        elif name == "end" and not value.startswith("-"):
            found.append(f"end {value} (until then traffic is added; a trial goes on to its last step)")
    written = [name for name in options if writes(name) and not is_shown(name)]
    if written:
        found.append(f"{', '.join(written)} (nothing is written)")
    return found


def _same(value: str, other: str) -> bool:
    if other in ("true", "false"):
        return is_true(value) is (other == "true")
    try:
        return float(value) == float(other)
    except ValueError:
        return value == other


def is_left_out(name: str) -> bool:
    """Whether an option has no meaning in a trial."""
    return is_output(name) or is_shown(name) or name.startswith("load-state")
