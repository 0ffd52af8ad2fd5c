"""The short help of ``crashhunt run``: the most used options, and the names of all others by group."""

from __future__ import annotations

import argparse
import sys
import textwrap
from typing import NoReturn

from crashhunt.plans import hunt_options

_MIN_HELP_COLUMNS = 32  # in a narrower terminal, the terminal breaks the lines
GROUPS = {
    "what": "what is tested",
    "search": "search",
    "faults": "faults and probes",
    "kept": "what is kept",
    "run": "how it runs",
    "output": "output",
}


class ShortHelp(argparse.Action):
    """Action that prints the most used options, and the names of all other options by group."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """Print the help and exit."""
        parser._print_message(short_help(parser), sys.stdout)
        parser.exit()


def short_help(parser: argparse.ArgumentParser) -> str:
    """Return the short help of ``crashhunt run``, for the width of the terminal."""
    briefs = {option.name: option.about.brief for option in hunt_options() if option.about.brief}
    short = argparse.ArgumentParser(
        parser.prog, usage=parser.usage, description=parser.description, add_help=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    width = max(_MIN_HELP_COLUMNS, short._get_formatter()._width)
    short.description = textwrap.fill(parser.description or "", width)
    most_used, others = short.add_argument_group("most used options"), []
    for group in parser._action_groups:
        names = []
        for action in group._group_actions:
            if not action.option_strings:
                short.add_argument(action.dest, metavar=action.metavar, help=action.help)
            elif action.dest in briefs:
                takes = {"action": "store_true"} if action.nargs == 0 else {"metavar": action.metavar}
                most_used.add_argument(action.option_strings[-1], help=briefs[action.dest], **takes)
            else:
                names.append(action.option_strings[-1])
        if names and group.title in GROUPS.values():
            line = f"  {group.title}: {' '.join(names)}"
            others.append(textwrap.fill(line, width, subsequent_indent="    ", break_on_hyphens=False))
    short.epilog = "\n".join(["other options:", *others, "", f"{parser.prog} --help-all describes all options."])
    return short.format_help()
