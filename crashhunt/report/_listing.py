"""Lists of registered agents, oracles and disturbances, of scenarios and of actions, with ranges and units."""

from __future__ import annotations

import inspect
from functools import partial
from typing import TYPE_CHECKING, NotRequired, TypedDict, cast

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.isolation import work_apart
from crashhunt.base.plugins import Group, is_foreign, locate, registered
from crashhunt.base.text import aligned
from crashhunt.requirements import TRAFFIC_RULES
from crashhunt.scenario import ACTIONS, installed_backends, load_scenario, shipped_scenarios
from crashhunt.simulators import MODIFIERS, ON, PARTS, parse_parts
from crashhunt.trial import signature_of, without_folder

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from crashhunt.base.json_types import Plain
    from crashhunt.scenario import ActionComponent
    from crashhunt.simulators import Column, Setting
    from crashhunt.trial import Argument, Kind, Value

_IMPORT_S = 60.0


class ArgumentEntry(TypedDict):
    """An argument of an entry; its unknown values are null."""

    name: str
    kind: Kind | None
    default: Value | None
    range: str | None
    unit: str
    help: str


class ComponentEntry(TypedDict):
    """A number of an action or a column of an observation; ``low`` and ``high`` are its bounds."""

    name: str
    unit: str
    range: str
    low: float
    high: float
    help: str


class ListingEntry(TypedDict):
    """An entry of ``list`` with ``--json``; only scenarios have ``simulator`` and ``agents``.

    Only actions and observations have ``components``. Only observations have the keys from ``shape`` on: the shape with
    the default settings, and the name and the unit of each column. A part without columns has the unit of its values.
    """

    name: str
    locator: str
    title: str
    arguments: list[ArgumentEntry]
    warning: NotRequired[str]
    simulator: NotRequired[str]
    agents: NotRequired[dict[str, list[ArgumentEntry]]]
    components: NotRequired[list[ComponentEntry]]
    shape: NotRequired[list[int]]
    columns: NotRequired[list[str]]
    units: NotRequired[list[str]]


def list_registered(group: Group) -> list[ListingEntry]:
    """Return the registered objects of a group. An object that cannot be imported is listed with a warning."""
    found: list[ListingEntry] = []
    for name, point in registered(group).items():
        entry: ListingEntry = {"name": name, "locator": point.value, "title": "", "arguments": []}
        looked_up = partial(_described, group, name)
        try:
            if is_foreign(group, name):  # which may end the process that imports it
                described = work_apart(looked_up, task=f"{name!r} cannot be imported", timeout_s=_IMPORT_S)
            else:
                described = looked_up()
            entry |= cast("ListingEntry", described)
        except CrashhuntError as error:
            entry["warning"] = str(error)
        found.append(entry)
    return found


def _described(group: Group, name: str, _report: object = None) -> Plain:
    factory = locate(group, name)
    title = (inspect.getdoc(factory) or "").partition("\n")[0]
    return {"title": title, "arguments": _arguments(signature_of(factory).arguments.values())}


def list_scenarios() -> list[ListingEntry]:
    """Return the scenarios that come with crashhunt."""
    found: list[ListingEntry] = []
    for name in shipped_scenarios():
        scenario = load_scenario(name)
        found.append(
            {
                "name": name,
                "locator": ", ".join(f"{agent} driven by {setup.agent}" for agent, setup in scenario.agents.items()),
                "title": scenario.title,
                "simulator": scenario.simulator,
                "arguments": _arguments(scenario.scenario_arguments().values()),
                "agents": {agent: _arguments(scenario.agent_arguments(agent).values()) for agent in scenario.agents},
            }
        )
    return found


def list_actions() -> list[ListingEntry]:
    """Return the forms of actions that a scenario, an agent's class or ``--action`` may name, with their components."""
    return [
        {
            "name": name,
            "locator": form.shape or ", ".join(form.names),
            "title": form.title,
            "arguments": [
                {
                    "name": one.name, "kind": "str" if one.choices else "float", "default": one.default,
                    "range": one.range, "unit": one.unit, "help": one.help,
                }
                for one in form.settings
            ],
            "components": [_component(one, one.help) for one in form.components],
        }
        for name, form in ACTIONS.items()
    ]  # fmt: skip


def list_requirements() -> list[ListingEntry]:
    """Return the traffic rules that ``--require`` accepts by name."""
    return [
        {"name": rule.name, "locator": rule.formula, "title": f"{rule.title} Source: {rule.source}", "arguments": []}
        for rule in TRAFFIC_RULES.values()
    ]


def list_observations() -> list[ListingEntry]:
    """Return the parts that agents may observe, with the titles of the simulators that have each part."""
    found: list[ListingEntry] = []
    for name, part in {**PARTS, **MODIFIERS}.items():
        having = [backend for _, backend in installed_backends() if backend.observations]
        simulators = [backend.title for backend in having if name in MODIFIERS or name in backend.observations]
        if not simulators:
            continue
        shape = [length for one in parse_parts([name], where="") for length in one.shape] if name in PARTS else []
        columns = part.values_of_last_axis
        described = [(one, one.meaning) for one in columns]
        described += [(one, f"with relation={ON} only: {one.meaning}") for one in part.relation]
        found.append(
            {
                "name": name,
                "locator": ", ".join(simulators),
                "title": part.meaning[0].upper() + part.meaning[1:] + ".",
                "arguments": [_setting_entry(setting) for setting in part.settings],
                "shape": shape,
                "columns": [column.name for column in part.columns],
                "units": [column.unit for column in columns],
                "components": [_component(column, meaning) for column, meaning in described],
            }
        )
    return found


def _component(one: ActionComponent | Column, meaning: str) -> ComponentEntry:
    return {
        "name": one.name, "unit": one.unit, "range": one.range, "low": float(one.low), "high": float(one.high),
        "help": meaning,
    }  # fmt: skip


def _setting_entry(setting: Setting) -> ArgumentEntry:
    entry: ArgumentEntry = {
        "name": setting.name, "kind": "float", "default": setting.default,
        "range": f"{setting.low:g}:{setting.high:g}", "unit": setting.unit, "help": setting.meaning,
    }  # fmt: skip
    if words := setting.choices:
        entry |= {"kind": "str", "default": words[int(setting.default)], "range": ",".join(words), "unit": ""}
    elif setting.is_whole:
        entry |= {"kind": "int", "default": int(setting.default)}
    return entry


def describe(entries: Sequence[ListingEntry]) -> str:
    """Return a list of agents, oracles, scenarios or actions as text."""
    blocks = []
    for entry in entries:
        lines = [f"{entry['name']}  ({entry['locator']})", f"    {entry['title']}"]
        if entry.get("shape"):
            lines.append(f"    shape {tuple(entry['shape'])}")
        lines += _columns(
            "    ", [(one["name"], one["range"], one["unit"], one["help"]) for one in entry.get("components", ())]
        )
        if "components" in entry and entry["arguments"]:
            first = entry["arguments"][0]
            lines.append(f"    settings, such as {entry['name']}:{first['name']}={first['default']}:")
        lines += _table("    ", entry["arguments"])
        for agent, arguments in entry.get("agents", {}).items():
            if arguments:
                lines += [f"    arguments of {agent}, as they are hunted here:", *_table("        ", arguments)]
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


def _arguments(arguments: Iterable[Argument]) -> list[ArgumentEntry]:
    return [
        {
            "name": argument.name,
            "kind": argument.kind,
            "default": argument.default,
            "range": str(argument.distribution) if argument.distribution is not None else None,
            "unit": argument.unit,
            "help": argument.help,
        }
        for argument in arguments
    ]


def _table(indent: str, arguments: Sequence[ArgumentEntry]) -> list[str]:
    rows = []
    for entry in arguments:
        default = "" if entry["range"] else "required"
        if entry["default"] is not None:
            default = f"default {without_folder(entry['default'])}"
        rows.append((entry["name"], entry["range"] or "", default, entry["unit"], entry["help"]))
    return _columns(indent, rows)


def _columns(indent: str, rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the rows of a table as aligned lines; all columns are aligned to the left."""
    return [indent + line for line in aligned(rows, left=range(len(rows[0])))] if rows else []
