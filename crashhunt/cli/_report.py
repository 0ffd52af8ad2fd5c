"""``crashhunt report``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.cli._common import add_crash, add_json, integer, opened_hunt, say, shown_progress

if TYPE_CHECKING:
    import argparse

    from crashhunt.cli._common import Commands

__all__ = ["add_report"]


def add_report(commands: Commands) -> None:
    """Add the command."""
    report = commands.add_parser(
        "report",
        help="write one HTML file that shows a hunt and animates its crashes",
        description="Write one HTML file that needs no network and no other file: the hunt in numbers, what was tried "
        "against how it went, and an animated replay of each crash. Runs no code of the bundle.",
    )
    add_crash(report)
    report.add_argument("--output", "-o", metavar="FILE", type=Path, help="the file; default: DIR/report.html")
    report.add_argument(
        "--crashes",
        metavar="N",
        type=integer,
        default=20,
        help="how many to animate, and as many near misses; default: 20",
    )
    add_json(report)
    report.set_defaults(command=_report)


def _report(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.crashes import find_bundle, list_bundles, list_near_misses
    from crashhunt.hunts import hunt_state
    from crashhunt.report import write_report

    if options.crashes < 0:
        raise UsageError(f"--crashes is {options.crashes}", fix="give at least 0")
    with opened_hunt(options.directory) as (hunt, exported):
        state = hunt_state(hunt)
        if state.damaged and not exported and not options.crash:  # a page without its trials would pass for all of it
            raise HuntDirectoryError(state.detail)
        bundles = [find_bundle(hunt, options.crash)] if options.crash else list_bundles(hunt)
        bundles.sort(key=lambda bundle: (bundle.result.steps, bundle.result.spec.number))
        shown = bundles[: options.crashes]
        near = [] if options.crash else list_near_misses(hunt)[: options.crashes]
        target = options.output or (Path(f"{options.directory}.html") if exported else hunt / layout.REPORT)
        with shown_progress(f"writing {target}", as_json=options.json) as watch:
            size = write_report(hunt, [*shown, *near], target, name=options.directory.resolve().name, watch=watch)
    also = f", and the {len(near)} most dangerous near misses" if near else ""
    left = f", the {len(shown)} with the fewest steps" if len(shown) < len(bundles) else ""
    say(
        f"{target} ({size / 1e6:.1f} MB) shows {len(shown)} of {len(bundles)} crashes{left}{also}", as_json=options.json
    )
    if options.json:
        also_json = {"near_misses": [bundle.id for bundle in near]} if near else {}
        print(json.dumps({"file": str(target), "bytes": size, "crashes": [bundle.id for bundle in shown], **also_json}))
    return 0
