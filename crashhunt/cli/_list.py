"""``crashhunt agents``, ``disturbances``, ``oracles`` and ``scenarios``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.text import command_line, one_line, visible
from crashhunt.cli._common import add_json

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from crashhunt.cli._common import Commands
    from crashhunt.report import ListingEntry

__all__ = ["add_lists"]


def add_lists(commands: Commands) -> None:
    """Add the commands to the parser."""
    for name, command, text in (
        ("agents", _agents, "list the agents that crashhunt includes or that are installed, with their arguments"),
        ("disturbances", _disturbances, "list the disturbances that crashhunt includes or that are installed"),
        ("oracles", _oracles, "list the oracles that crashhunt includes or that are installed, with their arguments"),
        ("scenarios", _scenarios, "list the scenarios that crashhunt includes, with their arguments, or copy one"),
    ):
        listing = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name == "scenarios":
            listing.add_argument(
                "--copy", nargs=2, metavar=("NAME", "DIR"), help="copy a scenario into a new folder, to edit it"
            )
        add_json(listing)
        listing.set_defaults(command=command)


def _agents(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.report import list_agents

    return _print_listing("agents", list_agents(), as_json=options.json)


def _disturbances(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.report import list_disturbances

    return _print_listing("disturbances", list_disturbances(), as_json=options.json)


def _oracles(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.report import list_oracles

    return _print_listing("oracles", list_oracles(), as_json=options.json)


def _scenarios(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.report import list_scenarios

    if options.copy is not None:
        from crashhunt.scenario import copy_shipped_scenario

        name, folder = options.copy
        copy_shipped_scenario(name, Path(folder))
        if options.json:
            entries = [entry for entry in list_scenarios() if entry.get("name") == name]
            return _print_listing("scenarios", entries, as_json=True)
        hunt = f"crashhunt run OUT 0 100 1000 {command_line('--scenario', folder)}"
        print(visible(f"{command_line(folder)} has the files of {name}. Hunt in it: {hunt}"))
        return 0
    return _print_listing("scenarios", list_scenarios(), as_json=options.json)


def _print_listing(name: str, entries: Sequence[ListingEntry], *, as_json: bool) -> int:
    from crashhunt.report import describe

    for entry in entries:
        if "warning" in entry:
            print(one_line(f"crashhunt: warning: {entry['warning']}"), file=sys.stderr)
    print(json.dumps({name: entries}) if as_json else visible(describe(entries)))
    return 0
