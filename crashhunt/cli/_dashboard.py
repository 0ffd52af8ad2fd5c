"""``crashhunt dashboard``."""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.cli._common import DONE, CommandOptions, Commands, add_json, integer

if TYPE_CHECKING:
    from crashhunt.dashboard import Address


def add_dashboard(commands: Commands) -> None:
    """Add the command ``dashboard`` to the parser."""
    dashboard = commands.add_parser(
        "dashboard",
        help="show hunts live in the browser",
        description="Show hunts live in the browser: a table of all hunts, a page per hunt with curves, arguments and "
        "crash types, and an animation of each crash. Prints the address and runs until Ctrl-C. Without "
        "--allow-control, the dashboard writes nothing into the folders of hunts and runs no code of a bundle.",
    )
    dashboard.add_argument(
        "paths", metavar="PATH", type=Path, nargs="*",
        help="hunts, suites, folders that contain hunts at any depth, or files that crashhunt export wrote; default: "
        "the current folder",
    )  # fmt: skip
    dashboard.add_argument(
        "--port", metavar="N", type=integer, default=8642, help="port to listen on; 0: any free port; default: 8642"
    )
    dashboard.add_argument(
        "--host", metavar="HOST", default="127.0.0.1",
        help="address to listen on; an address that other machines reach needs a token; default: 127.0.0.1",
    )  # fmt: skip
    dashboard.add_argument(
        "--token",
        metavar="TEXT",
        default="",
        help="secret token that the browser of each reader must send; default: a random token if --host needs a token",
    )
    dashboard.add_argument("--no-browser", action="store_true", help="do not open a browser")
    dashboard.add_argument(
        "--allow-control", action="store_true",
        help="allow readers of the dashboard to stop running hunts, and to replay, judge and minimize crashes",
    )  # fmt: skip
    add_json(dashboard)
    dashboard.set_defaults(command=_dashboard)


def _dashboard(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.dashboard import serve

    def announce(address: Address) -> None:
        if options.json:
            found = {"url": address.url, "host": address.host, "port": address.port, "token": address.token}
            print(json.dumps(found), flush=True)
        options.say(f"{address.url}\nCtrl-C ends the dashboard.")
        sys.stdout.flush()

    with suppress(KeyboardInterrupt):  # the usual end
        serve(
            options.paths or [Path()],
            host=options.host,
            port=options.port,
            token=options.token,
            browser=not options.no_browser and not options.json,
            allow_control=options.allow_control,
            announce=announce,
        )
    return DONE
