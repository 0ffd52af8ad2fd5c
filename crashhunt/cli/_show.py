"""``crashhunt show``."""

from __future__ import annotations

import json
from typing import Final

from crashhunt.base.errors import UsageError
from crashhunt.base.text import visible
from crashhunt.cli._common import CommandOptions, Commands, add_crash, add_json, number, opened_crash

_MIN_BRAKING_MPS2: Final = 0.1


def add_show(commands: Commands) -> None:
    """Add the command ``show`` to the parser."""
    show = commands.add_parser(
        "show",
        help="describe the last seconds of a crash or a near miss",
        description="Describe the last seconds before a crash, in words and a table. For a near miss, describe the "
        "seconds around its closest moment. The table has the positions, speeds and closing speeds of the vehicles, "
        "and the decisions of the agent. The text also names the last step from which braking avoids the crash. The "
        "hunt has found this step by simulation. Runs no code of the bundle.",
    )
    add_crash(show)
    show.add_argument(
        "--last-seconds",
        metavar="S",
        type=number,
        default=5.0,
        help="number of seconds before the crash to describe; default: 5",
    )
    show.add_argument(
        "--braking",
        metavar="A",
        type=number,
        help="calculate the last step from which braking with A m/s² avoids the crash, if the other vehicle moves as "
        "recorded",
    )
    add_json(show)
    show.set_defaults(command=_show)


def _show(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.report import Story

    if not 0 < options.last_seconds < float("inf"):
        raise UsageError(f"--last-seconds is {options.last_seconds:g}", fix="give a number above 0")
    # The calculation continues until the vehicle stands, which takes forever if it hardly brakes.
    if options.braking is not None and not _MIN_BRAKING_MPS2 <= options.braking < float("inf"):
        raise UsageError(f"--braking is {options.braking:g}", fix=f"give a number of at least {_MIN_BRAKING_MPS2}")
    with opened_crash(options.directory, options.crash) as (bundle, _):
        story = Story(bundle, last_s=options.last_seconds, braking=options.braking)
    print(json.dumps(story.to_json()) if options.json else visible(story.describe()))
    return 0
