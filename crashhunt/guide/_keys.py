"""The reference of ``scenario.toml`` and ``suite.toml``, made from the dataclasses that read them."""

from __future__ import annotations

import ast
import re
from typing import TYPE_CHECKING

from crashhunt.guide._api import as_markdown, definition

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["describe_keys"]

_SCENARIO = (
    ("At the top", "crashhunt.scenario", "Scenario"),
    ("[observation]", "crashhunt.scenario", "ObservationSetup"),
    ("[arguments.NAME], [agents.ID.arguments.NAME]", "crashhunt.scenario", "ArgumentSetup"),
    ("[agents.ID]", "crashhunt.scenario", "AgentSetup"),
    ("[sumo]", "crashhunt.scenario.backends.sumo._table", "SumoSetup"),
    ("[highway]", "crashhunt.scenario.backends.highway", "HighwaySetup"),
    ("[gym]", "crashhunt.scenario.backends.gym", "GymSetup"),
    ("crash, in [gym]", "crashhunt.scenario.backends.gym", "CrashRule"),
)
# Fields of Scenario that no file has, and the one that stands for the tables that come below.
_NO_KEY = re.compile(r"^- `(?:tables|\w+`: .*not part of (?:the file|it)\b).*\n(?:  .*\n)*", re.MULTILINE)


def describe_keys() -> str:
    """Return every table of both files with its keys, as Markdown."""
    return "\n".join((*_scenario(), *_suite()))


def _scenario() -> Iterator[str]:
    yield "## scenario.toml\n"
    for title, module, name in _SCENARIO:
        yield f"### {title}\n"
        yield _NO_KEY.sub("", _keys(module, name))


def _suite() -> Iterator[str]:
    from crashhunt.plans import hunt_options

    yield "## suite.toml\n"
    yield "`[defaults]` and each `[[hunts]]` have the same keys; what a hunt says itself wins.\n"
    own = _keys("crashhunt.suites", "SuiteEntry").rstrip()
    yield own
    options = [option.line.partition(": ") for option in hunt_options()]
    named = [option for option in options if f"- `{option[0]}`" not in own]
    yield from (f"- `{name}`: {as_markdown(meaning).strip()}" for name, _, meaning in named)


def _keys(module: str, name: str) -> str:
    """The keys of a table, without what the docstring says before them."""
    found = definition(module, name)
    text = as_markdown(ast.get_docstring(found) if found else "")
    _, heading, keys = text.partition("*Arguments*:\n\n")
    if not heading:
        raise LookupError(f"{module}.{name} does not say what its keys are")
    return keys.partition("\n*")[0].rstrip() + "\n"
