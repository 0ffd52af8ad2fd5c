"""``crashhunt replay``."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from crashhunt.cli._common import add_crash, add_json, integer, opened_crash, pairs, say
from crashhunt.errors import UsageError

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
    replay.add_argument("--trust", action="store_true", help="run the code of an exported crash that a stranger made")
    replay.add_argument("--force", action="store_true", help="replay even from a snapshot that is damaged")
    add_json(replay)
    replay.set_defaults(command=_replay)


def _replay(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.replay import ReplayOptions, replay
    from crashhunt.report import describe_replay
    from crashhunt.settings import read_settings

    chosen = ReplayOptions(
        code="log" if options.from_log else options.code,
        changes=pairs(options.sets, "--set"),
        force=options.force,
        times=options.times,
    )
    with opened_crash(options.directory, options.crash) as (bundle, archive):
        trusted = archive is None or archive.made_here or options.trust
        if archive is not None and not trusted and chosen.code != "log":
            agents = {agent.agent for agent in read_settings(bundle.hunt / "hunt.toml").agents.values()}
            raise UsageError(
                f"it says that {archive.made_by} made it on {archive.made_at}, and a replay runs the code in it "
                f"({', '.join(sorted(agents))})",
                fix="give --trust if you trust whoever gave it to you, or --from-log to run none of it",
                where=str(options.directory),
            )
        report = replay(bundle, replace(chosen, trusted=trusted))
    say(describe_replay(report), as_json=options.json)
    if options.json:
        print(json.dumps(report.to_json()))
    return 0 if set(report.verdicts) == {options.expect} else 1
