"""``crashhunt run``."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.text import one_line
from crashhunt.cli._common import add_json, integer, number, pairs

if TYPE_CHECKING:
    import argparse

__all__ = ["add_run"]

_SPEC = "a value (20), a range (5:40, 5:40:5), a log range (log:1e-3:1) or a choice (a|b|c)"


def add_run(commands: Any) -> None:
    """Add the command."""
    run = commands.add_parser(
        "run",
        help="hunt for a crash",
        description="Hunt for a crash: run trials in parallel, each with its own seed and arguments, and stop as soon "
        "as one crashes. The same command on the same DIR goes on from where it was.",
    )
    run.add_argument("directory", metavar="DIR", type=Path, help="where everything is kept; made if it is not there")
    run.add_argument("parallel", metavar="PARALLEL", type=integer, help="trials at a time; 0: one per core")
    run.add_argument("trials", metavar="TRIALS", type=integer, help="how many trials at most")
    run.add_argument("max_steps", metavar="MAX_STEPS", type=integer, help="the bound on each trial, in steps")
    what = run.add_argument_group("what is hunted")
    what.add_argument(
        "--scenario", metavar="NAME|PATH", default="loop",
        help="a shipped scenario (see crashhunt scenarios), a folder, a scenario.toml or a .sumocfg; default: loop",
    )  # fmt: skip
    what.add_argument(
        "--ego", metavar="VEHICLE", default="",
        help="for a .sumocfg: the vehicle to control, or route=ID or edges=FROM,TO to add one; default: the first",
    )  # fmt: skip
    what.add_argument(
        "--action", metavar="FORM", default="",
        help="on SUMO: continuous (a speed and a lane change) or meta (highway-env's five actions); default: as the "
        "scenario says, and continuous for a .sumocfg",
    )  # fmt: skip
    what.add_argument(
        "--agent", metavar="[ID=]MODULE:ATTR", action="append", default=[],
        help="who drives: a class or function, or a name that crashhunt agents lists; ID= where the scenario has "
        "several controlled vehicles",
    )  # fmt: skip
    what.add_argument(
        "--arg", metavar="NAME=SPEC", action="append", default=[],
        help=f"what to try for an argument of the agent: {_SPEC}; ID.NAME=SPEC for one of several agents",
    )  # fmt: skip
    what.add_argument(
        "--set", metavar="NAME=SPEC", action="append", default=[], dest="sets",
        help="the same for an argument of the scenario, such as its traffic demand",
    )  # fmt: skip
    how = run.add_argument_group("how it is hunted")
    how.add_argument("--sampler", metavar="NAME", default="random", help="random, grid or sweep; default: random")
    how.add_argument(
        "--points", metavar="N", type=integer, default=10,
        help="values that grid and sweep try of a range without a step; default: 10",
    )  # fmt: skip
    how.add_argument("--seed", metavar="N", type=integer, help="of the hunt; default: a new one, which is printed")
    how.add_argument(
        "--crash-on", metavar="KIND,…",
        help="the outcomes that count as a crash: collision, off_road, agent_error, simulator_error, process_died, "
        "hang, which are the default; and traffic events: red_light, wrong_way, off_route, not_moving (for 60 s, or "
        "not_moving:S), others_collided, hard_braking (or hard_braking:M/S²), teleport",
    )  # fmt: skip
    how.add_argument("--keep-going", action="store_true", help="collect all crashes instead of stopping at the first")
    how.add_argument(
        "--deterministic", action="store_true",
        help="at a crash, let running trials of lower numbers finish: the same seed gives the same crash",
    )  # fmt: skip
    how.add_argument(
        "--timeout", metavar="S", type=number, default=60.0, help="wall-clock limit of a trial, in s; default: 60"
    )
    how.add_argument("--keep-trials", action="store_true", help="keep the logs of every trial, not of crashes only")
    how.add_argument(
        "--no-accelerate", action="store_true",
        help="run highway-env as it is; the accelerator changes no bit, and only the time it takes",
    )  # fmt: skip
    how.add_argument(
        "--recycle-after", metavar="N", type=integer, default=1000,
        help="replace a worker after so many trials; 0: never; default: 1000",
    )  # fmt: skip
    how.add_argument(
        "--audit", metavar="SHARE", type=float, default=0.0,
        help="run this share of the trials without a crash again, each in a fresh process, and say where one is not "
        "the same: 0.02 is one in fifty; default: 0",
    )  # fmt: skip
    how.add_argument(
        "--snapshot-root", metavar="PATH", type=Path, action="append", default=[],
        help="a file or folder that the snapshot takes in besides the agent's own project; may be repeated",
    )  # fmt: skip
    how.add_argument(
        "--snapshot-limit",
        metavar="MB",
        type=number,
        default=500.0,
        help="the most that a snapshot may have; default: 500",
    )
    how.add_argument("--no-snapshot", action="store_true", help="keep no code; a replay then runs what is current")
    how.add_argument("--overwrite", action="store_true", help="begin anew, whatever hunt is in DIR")
    how.add_argument("--fail-on-crash", action="store_true", help="exit with 1 if a crash was found")
    add_json(how)
    run.set_defaults(command=_run)


def _run(options: argparse.Namespace, words: list[str]) -> int:
    # From here to where the hunt takes over there is nothing to keep, and an exception would be lost where somebody
    # else's import swallows it.
    signal.signal(signal.SIGINT, lambda *_: _leave_at_once(as_json=options.json))
    from rich.console import Console

    from crashhunt.api import prepare
    from crashhunt.report import Watcher, describe_hunt
    from crashhunt.snapshots import SnapshotOptions
    from crashhunt.trial import CRASHES

    hunt = prepare(
        options.directory,
        options.parallel,
        options.trials,
        options.max_steps,
        scenario=options.scenario,
        ego=options.ego,
        action=options.action,
        agents=pairs(options.agent, "--agent", named=False),
        arguments=pairs(options.arg, "--arg"),
        scenario_arguments=pairs(options.sets, "--set"),
        sampler=options.sampler,
        points=options.points,
        seed=options.seed,
        crash_on=CRASHES if options.crash_on is None else [name for name in options.crash_on.split(",") if name],
        keep_going=options.keep_going,
        deterministic=options.deterministic,
        keep_trials=options.keep_trials,
        accelerate=not options.no_accelerate,
        timeout_s=options.timeout,
        recycle_after=options.recycle_after,
        audit=options.audit,
        snapshot=SnapshotOptions(
            code=not options.no_snapshot, roots=tuple(options.snapshot_root), limit_mb=options.snapshot_limit
        ),
        overwrite=options.overwrite,
        command=["crashhunt", *words],
    )
    console = Console(stderr=options.json, highlight=False)
    for note in hunt.scenario.notes:
        console.print(one_line(note), markup=False, soft_wrap=True)
    agents = ", ".join(setup.agent for setup in hunt.settings.agents.values())
    with Watcher(console, f"crashhunt: {hunt.scenario.name}, {agents}") as watcher:
        report = hunt.run(watcher)
    console.print(describe_hunt(report), markup=False, soft_wrap=True)
    if options.json:
        print(json.dumps(report.to_json()))
    if report.stopped_because == "no_valid_trial":
        return 3
    if report.stopped_because == "interrupted":
        return 130
    return 1 if report.crashes and options.fail_on_crash else 0


def _leave_at_once(*, as_json: bool) -> NoReturn:
    error = CrashhuntError("interrupted before the hunt began")
    if as_json:
        os.write(1, json.dumps(error.to_json()).encode() + b"\n")
    os.write(2, f"crashhunt: {error}\n".encode())
    os._exit(130)
