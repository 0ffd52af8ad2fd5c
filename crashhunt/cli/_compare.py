"""``crashhunt compare``."""

from __future__ import annotations

import sys
from pathlib import Path

from crashhunt.base import layout
from crashhunt.base.text import command_line
from crashhunt.cli._common import CommandOptions, Commands, add_json
from crashhunt.plans import RATE_PERS


def add_compare(commands: Commands) -> None:
    """Add the command ``compare`` to the parser."""
    compare = commands.add_parser(
        "compare",
        help="report which of several hunts crashes less",
        description="Compare the crash rates of hunts, with confidence intervals. For trials with the same seeds, "
        "report whether the agent of a hunt crashes less often than the agent of the first hunt. Before you compare, "
        "run a hunt with each version of the agent, and give both hunts the same --seed and --keep-going.",
    )
    compare.add_argument(
        "directories", metavar="DIR", type=Path, nargs="+", help="directories of at least two hunts, or of suites"
    )
    compare.add_argument(
        "--per", choices=RATE_PERS, default="trial",
        help="the unit of the crash rates and of their difference: trial, hour or 1000km; default: trial",
    )  # fmt: skip
    compare.add_argument("--csv", action="store_true", help="print the table as CSV, with a line for each hunt")
    compare.add_argument("--html", metavar="FILE", type=Path, help="write an HTML page with plots")
    add_json(compare)
    compare.set_defaults(command=_compare)


def _compare(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.report import comparison_page, describe_comparison
    from crashhunt.results import find_searches
    from crashhunt.statistics import compare

    hunts = []
    for directory in options.directories:
        for hunt in find_searches(directory):
            if hunt == directory or (hunt / layout.HUNT).exists():
                hunts.append(hunt)
            else:
                options.say(f"{command_line(hunt)} has not begun, and is excluded", to_stderr=True)
    found = compare(*hunts, per=options.per)
    if options.csv:
        found.write_csv(sys.stdout)
    else:
        options.say(describe_comparison(found))
    if options.html is not None:
        comparison_page(found, options.html)
        options.say(f"{command_line(options.html)} has the plots", to_stderr=options.csv)
    options.print_json(found.to_json())
    return 0
