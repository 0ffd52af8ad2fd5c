"""``crashhunt bisect``."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.text import in_lines, one_line
from crashhunt.cli._common import add_build, add_crash, add_json, build_limit_s, opened_crash
from crashhunt.cli._trust import add_trust, check_trust, run_trusted

if TYPE_CHECKING:
    from crashhunt.cli._common import CommandOptions, Commands
    from crashhunt.corpus import Got


def add_bisect(commands: Commands) -> None:
    """Add the command ``bisect`` to the parser."""
    bisect = commands.add_parser(
        "bisect",
        help="find the commit that introduced a crash",
        description="Find the commit of the agent's repository that introduced a crash: git bisect, with the crash "
        "as the test. Revisions are checked out in a separate work tree; your own work tree does not change. "
        "Revisions that "
        "cannot run, or crash in another way, are skipped. Exits with 1 if the skipped revisions prevent an answer.",
    )
    add_crash(bisect)
    bisect.add_argument("--good", metavar="REV", required=True, help="a revision in which the crash does not occur")
    bisect.add_argument(
        "--bad", metavar="REV", default="HEAD", help="a revision in which the crash occurs; default: HEAD"
    )
    bisect.add_argument(
        "--from", metavar="FOLDER", type=Path, dest="folder",
        help="folder in the repository from which Python imports the agent; default: the current folder",
    )  # fmt: skip
    add_build(bisect, "each revision")
    add_trust(bisect)
    add_json(bisect)
    bisect.set_defaults(command=_bisect)


def _bisect(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.corpus import bisect

    def show(revision: str, got: Got, why: str) -> None:
        options.say(in_lines([f"{revision[:12]}  {got.replace('_', ' ')}{f': {why}' if why else ''}"]))

    def tell(caution: str) -> None:
        print(f"crashhunt: {caution}", file=sys.stderr, flush=True)

    with opened_crash(options.directory, options.crash) as (bundle, archive):
        run_trusted(partial(check_trust, bundle), bundle, archive, options)
        try:
            found = bisect(
                bundle, options.good, bad=options.bad, folder=options.folder, watch=show, tell=tell,
                build=options.build, build_limit_s=build_limit_s(options),
            )  # fmt: skip
        except KeyboardInterrupt:
            options.say("Interrupted: the commit is not known yet. The same command begins again.")
            raise
    text = f"it is one of {', '.join(one[:12] for one in found.candidates)}"
    if found.commit:
        text = one_line(f"{found.commit[:12]} is the first in which it crashes: {found.subject}")
    options.answer(text, found.to_json())
    return 0 if found.commit else 1
