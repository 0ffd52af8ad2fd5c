"""``crashhunt replay``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from crashhunt.cli._common import add_crash, add_json, integer, pairs, say

if TYPE_CHECKING:
    import argparse

__all__ = ["add_replay"]


def add_replay(commands: Any) -> None:
    """Add the command."""
    replay = commands.add_parser(
        "replay",
        help="run a saved crash again and say whether it is the same",
        description="Run a saved crash again in a fresh process, from its bundle alone, and compare every observation, "
        "action and scene with the log. Exits with 1 where the verdict is not the expected one.",
    )
    add_crash(replay)
    who = replay.add_mutually_exclusive_group()
    who.add_argument(
        "--code", choices=("snapshot", "current"), default="snapshot",
        help="drive with the code of the snapshot (the default), or with today's, to see whether a fix works",
    )  # fmt: skip
    who.add_argument(
        "--from-log", action="store_true", help="drive with the recorded actions, without the agent's code"
    )
    replay.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[], dest="sets",
        help="another value for an argument of the agent (ID.NAME for one of several) or of the scenario",
    )  # fmt: skip
    replay.add_argument("--times", metavar="N", type=integer, default=1, help="repeat, and say how many runs agreed")
    replay.add_argument(
        "--expect", choices=("reproduced", "fixed"), default="reproduced",
        help="the verdict for which the exit code is 0; default: reproduced",
    )  # fmt: skip
    replay.add_argument("--force", action="store_true", help="replay even from a snapshot that is damaged")
    add_json(replay)
    replay.set_defaults(command=_replay)


def _replay(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.bundle import find_bundle
    from crashhunt.replay import ReplayOptions, replay
    from crashhunt.report import describe_replay

    chosen = ReplayOptions(
        code="log" if options.from_log else options.code,
        changes=pairs(options.sets, "--set"),
        force=options.force,
        times=options.times,
    )
    report = replay(find_bundle(options.directory, options.crash), chosen)
    say(describe_replay(report), as_json=options.json)
    if options.json:
        print(json.dumps(report.to_json()))
    return 0 if set(report.verdicts) == {options.expect} else 1
