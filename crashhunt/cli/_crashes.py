"""``crashhunt crashes``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.cli._common import add_json, say

if TYPE_CHECKING:
    import argparse

    from crashhunt.cli._common import Commands

__all__ = ["add_crashes"]


def add_crashes(commands: Commands) -> None:
    """Add the command."""
    crashes = commands.add_parser(
        "crashes",
        help="say how many different crashes were found",
        description="Group the crashes of hunts: those are one kind that happened in the same manner, with the agent "
        "in the same role, or in the same function. A line a kind, the most frequent first.",
    )
    crashes.add_argument("directories", metavar="DIR", type=Path, nargs="+", help="of hunts or suites")
    add_json(crashes)
    crashes.set_defaults(command=_crashes)


def _crashes(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.crashes import list_bundles
    from crashhunt.hunts import dropped_crashes, find_hunts
    from crashhunt.report import describe_groups
    from crashhunt.triage import group_crashes

    hunts = list(dict.fromkeys(hunt for directory in options.directories for hunt in find_hunts(directory)))
    bundles = (bundle for hunt in hunts for bundle in list_bundles(hunt))
    found = group_crashes(bundles, dropped_crashes(hunts))
    say(describe_groups(found.groups), as_json=options.json)
    for why in found.left_out:
        say(f"left out: {why}", as_json=True)
    if options.json:
        print(json.dumps({"groups": [group.to_json() for group in found.groups], "left_out": list(found.left_out)}))
    return 0
