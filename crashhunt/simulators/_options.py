"""Scenario arguments as entries of what an environment is told."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.base.plain import Plain
    from crashhunt.scenario import Scenario
    from crashhunt.trial import Value

__all__ = ["as_tables", "merge"]


def as_tables(scenario: Scenario, arguments: Mapping[str, Value]) -> list[dict[str, object]]:
    """Return each argument as a table of its own with the entry that it sets, nested where that is dotted."""
    tables = []
    for name, value in arguments.items():
        option = scenario.arguments[name].option or name if name in scenario.arguments else name
        *path, last = option.split(".")
        table: dict[str, object] = {last: value}
        for part in reversed(path):
            table = {part: table}
        tables.append(table)
    return tables


def merge(config: dict[str, object], table: Plain) -> None:
    """Write the entries of a table into a configuration; a table with another ``type`` replaces, others are merged."""
    for key, value in table.items():
        old = config.get(key)
        if isinstance(old, dict) and isinstance(value, dict) and value.get("type", old.get("type")) == old.get("type"):
            merge(old, value)
        else:
            config[key] = value
