"""``crashhunt replay``."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from crashhunt.cli._common import add_crash, add_json, integer, opened_crash, pairs, say
from crashhunt.errors import UsageError
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    import argparse

    from crashhunt.bundle import Bundle

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
    look = replay.add_argument_group(
        "to look into it", "The agent then runs with the terminal at hand, so that breakpoints in its code work."
    )
    stop = look.add_mutually_exclusive_group()
    stop.add_argument("--until", metavar="STEP", type=integer, help="stop after this step")
    stop.add_argument("--before", metavar="N", type=integer, help="stop N steps before the crash")
    look.add_argument(
        "--pdb", action="store_true",
        help="drop into the agent's act in the last step, with agent, observation, scene and step at hand",
    )  # fmt: skip
    look.add_argument(
        "--print", metavar="FIELD,…", default="", dest="fields",
        help="print a table of the steps: x, y, heading, speed, reward, time_to_collision_s, gap_m, "
        "required_deceleration, action or its parts, observation[ROW,NAME]",
    )  # fmt: skip
    replay.add_argument("--trust", action="store_true", help="run the code of an exported crash that a stranger made")
    replay.add_argument("--force", action="store_true", help="replay even from a snapshot that is damaged")
    add_json(replay)
    replay.set_defaults(command=_replay)


def _replay(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.replay import ReplayOptions, replay
    from crashhunt.report import describe_replay, format_table, steps_table
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
        until, stop_at = _stops(options, bundle)
        report = replay(bundle, replace(chosen, trusted=trusted, until=until, stop_at=stop_at, to_stderr=options.json))
    answer = report.to_json()
    if options.fields:
        fields = re.split(r",(?![^\[]*\])", options.fields)  # not at the comma of observation[ROW,NAME]
        table = steps_table(report.recording, fields, bundle.driver)
        say("\n".join([*format_table(table), ""]), as_json=options.json)
        answer["table"] = table
    say(describe_replay(report), as_json=options.json)
    if options.json:
        print(json.dumps(answer))
    return 0 if set(report.verdicts) == {options.expect} else 1


def _stops(options: argparse.Namespace, bundle: Bundle) -> tuple[int, int]:
    """Where to stop, and where to drop into the agent's code; 0 for nowhere."""
    crash = bundle.result.steps
    if options.json and options.pdb:
        raise UsageError("--pdb needs the terminal, and --json is for programs", fix="leave one of them out")
    if options.before is not None:
        until = crash - options.before
        if not 1 <= until <= crash:
            raise UsageError(f"--before is {options.before}, and the crash is at step {crash}", fix="give less")
    elif options.until is not None:
        until = options.until
        if until < 1:
            raise UsageError(f"--until is {until}", fix="give at least 1")
    elif options.pdb:
        # An agent that failed did so in the step after the last complete one.
        until = crash + (bundle.result.outcome is Outcome.AGENT_ERROR)
    else:
        return 0, 0
    return until, until if options.pdb else 0
