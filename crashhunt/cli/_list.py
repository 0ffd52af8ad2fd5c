"""``crashhunt list``: what crashhunt includes, and what is installed.

`_KINDS` is the only place that names the kinds of things: help, completion, JSON and the words of earlier versions
follow from it.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt import report
from crashhunt.base.errors import UsageError
from crashhunt.base.text import command_line, one_line, visible
from crashhunt.cli._common import CommandOptions, Commands, add_json

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.report import ListingEntry

_KINDS: dict[str, Callable[[], list[ListingEntry]]] = {
    "actions": lambda: report.list_actions(),
    "agents": lambda: report.list_registered("agents"),
    "disturbances": lambda: report.list_registered("disturbances"),
    "observations": lambda: report.list_observations(),
    "oracles": lambda: report.list_registered("oracles"),
    "requirements": lambda: report.list_requirements(),
    "scenarios": lambda: report.list_scenarios(),
}
"""Kinds of things that can be listed, each with a function that returns its entries."""


def add_list(commands: Commands) -> None:
    """Add the command to the parser."""
    text = f"list the {', '.join([*_KINDS][:-1])} and {[*_KINDS][-1]} that crashhunt includes or that are installed"
    listing = commands.add_parser("list", help=text, description=text[0].upper() + text[1:] + ".")
    listing.add_argument(
        "what", nargs="?", metavar="WHAT", choices=[*_KINDS],
        help=f"{', '.join(_KINDS)}: describe each of this kind; without WHAT: print the names of all kinds",
    )  # fmt: skip
    listing.add_argument(
        "--copy", nargs=2, metavar=("NAME", "DIR"), help="with scenarios: copy a scenario into a new folder, to edit it"
    )
    add_json(listing)
    listing.set_defaults(command=_list)


def with_list(words: Sequence[str]) -> list[str]:
    """Return a command line in which a kind alone, such as ``agents``, becomes ``list agents``."""
    return ["list", *words] if words and words[0] in _KINDS else list(words)


def _list(options: CommandOptions, _words: list[str]) -> int:
    if options.copy is not None:
        return _copy(options)
    listed = {name: entries() for name, entries in _KINDS.items() if options.what in (None, name)}
    for entry in (entry for entries in listed.values() for entry in entries):
        if "warning" in entry:
            print(one_line(f"crashhunt: warning: {entry['warning']}"), file=sys.stderr)
    if options.json:
        print(json.dumps(listed))
    elif options.what is not None:
        print(visible(report.describe(listed[options.what])))
    else:
        names = [f"{kind}: {', '.join(entry['name'] for entry in entries)}" for kind, entries in listed.items()]
        print(visible("\n".join([*names, "crashhunt list WHAT describes each, such as crashhunt list agents"])))
    return 0


def _copy(options: CommandOptions) -> int:
    from crashhunt.scenario import copy_shipped_scenario

    name, folder = options.copy
    if options.what != "scenarios":
        fix = command_line("crashhunt", "list", "scenarios", "--copy", name, folder)
        raise UsageError("--copy copies a scenario", fix=f"run {fix}")
    copy_shipped_scenario(name, Path(folder))
    if options.json:
        print(json.dumps({"scenarios": [entry for entry in report.list_scenarios() if entry["name"] == name]}))
    else:
        hunt = f"crashhunt run OUT 0 100 1000 {command_line('--scenario', folder)}"
        print(visible(f"{command_line(folder)} has the files of {name}. Hunt in it: {hunt}"))
    return 0
