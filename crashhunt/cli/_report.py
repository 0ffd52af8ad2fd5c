"""``crashhunt report``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.text import command_line
from crashhunt.cli._common import add_crash, add_json, integer, opened_hunt, refuse_below, shown_progress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.cli._common import CommandOptions, Commands
    from crashhunt.crashes import Bundle
    from crashhunt.results import FoundCrashes


def add_report(commands: Commands) -> None:
    """Add the command ``report`` to the parser."""
    report = commands.add_parser(
        "report",
        help="write one HTML file that shows a hunt and animates its crashes",
        description="Write one HTML file that needs no network and no other file. The file shows the numbers of the "
        "hunt, plots of arguments against outcomes, and an animated replay of each crash. Runs no code of the bundle.",
    )
    add_crash(report, default="all crashes")
    report.add_argument(
        "--output", "-o", metavar="FILE", type=Path, help="the HTML file to write; default: DIR/report.html"
    )
    report.add_argument(
        "--crashes",
        metavar="N",
        type=integer,
        default=20,
        help="animate at most N crashes and at most N near misses; default: 20",
    )
    add_json(report)
    report.set_defaults(command=_report)


def _report(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.crashes import find_bundle, list_near_misses
    from crashhunt.report import write_report
    from crashhunt.results import find_crashes, hunt_state

    refuse_below(options, crashes=0)
    with opened_hunt(options.directory) as (hunt, exported):
        state = hunt_state(hunt)
        alone = exported or (hunt / layout.CASE).is_file()  # one crash, which never had a ledger
        if state.damaged and not alone and not options.crash:  # a page without its trials would pass for all of it
            raise HuntDirectoryError(state.detail)
        found = find_crashes(hunt, 0 if options.crash else options.crashes)
        shown = [find_bundle(hunt, options.crash)] if options.crash else list(found.shown)
        near_misses = [] if options.crash else list_near_misses(hunt)
        near = near_misses[: options.crashes]
        target = options.output or (Path(f"{options.directory}.html") if exported else hunt / layout.REPORT)
        with shown_progress(f"writing {target}", as_json=options.json) as watch:
            size = write_report(
                hunt,
                [*shown, *near],
                target,
                found=found,
                near_misses=len(near_misses),
                name=options.directory.resolve().name,
                watch=watch,
            )
    also = f", and the {len(near)} most critical of {len(near_misses)} near misses" if near else ""
    count = f"{len(shown)} of {found.tally.found} crashes"
    options.say(f"{command_line(target)} ({size / 1e6:.1f} MB) shows {count}{_shown_crashes(found, shown)}{also}")
    if options.json:
        data: dict[str, object] = {
            "file": str(target),
            "bytes": size,
            "crashes": [bundle.id for bundle in shown],
            "crashes_found": found.tally.found,
            "crashes_saved": found.saved,
        }
        if near:
            data |= {"near_misses": [bundle.id for bundle in near], "near_misses_saved": len(near_misses)}
        print(json.dumps(data))
    return 0


def _shown_crashes(found: FoundCrashes, shown: Sequence[Bundle]) -> str:
    """Return as text which crashes are shown; empty if all are shown, or if the user has named one."""
    if not found.shown:
        return ""
    chosen = ": the shortest of each type, then the shortest of all" if len(shown) < found.saved else ""
    return chosen + (f" ({found.saved} have a bundle)" if found.saved < found.tally.found else "")
