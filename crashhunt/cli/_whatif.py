"""``crashhunt whatif``."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from crashhunt.cli._common import (
    DONE,
    INTERRUPTED,
    GivenOnce,
    WordsWithCommas,
    add_crash,
    add_json,
    add_parallel,
    duration_s,
    integer,
    number,
    opened_crash,
    pairs,
    refuse_below,
    shown_progress,
)
from crashhunt.cli._trust import add_trust, run_trusted

if TYPE_CHECKING:
    from crashhunt.analysis import Counts
    from crashhunt.cli._common import CommandOptions, Commands


def add_whatif(commands: Commands) -> None:
    """Add the command ``whatif`` to the parser."""
    whatif = commands.add_parser(
        "whatif",
        help="run a saved crash again with a change, many times, and count how often it crashes",
        description="Run the trial of a crash again with other arguments, with another agent from a step on, or with "
        "other random numbers from a step on, and count the outcomes. Each run starts at step 0. If the change "
        "begins at a later step, a run counts only if it is bit-identical to the recording up to this step.",
    )
    add_crash(whatif)
    whatif.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[], dest="sets",
        help="another value for an argument, as with crashhunt replay; with --from-step or --before, only an argument "
        "of the agent, which has the other value from that step on",
    )  # fmt: skip
    moment = whatif.add_mutually_exclusive_group()
    moment.add_argument(
        "--from-step",
        metavar="K",
        type=integer,
        help="the step K after which the change begins: the first K steps stay as recorded",
    )
    moment.add_argument(
        "--before",
        metavar="SECONDS",
        type=number,
        help="in place of --from-step: the change begins this many seconds of simulation before the crash",
    )
    whatif.add_argument(
        "--agent", metavar="MODULE:NAME", action=GivenOnce, default="",
        help="another agent, which drives after the step K of --from-step, or from the start. Up to step K, the "
        "recorded actions are repeated; then the agent is reset. If there are several agents, write ID=MODULE:NAME",
    )  # fmt: skip
    whatif.add_argument(
        "--arg",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="an argument of the agent that --agent names; the option may be given several times",
    )
    whatif.add_argument(
        "--futures", action="store_true",
        help="after step K, give the simulator's random generators a new seed, which is different in each run",
    )  # fmt: skip
    whatif.add_argument(
        "--overrule", metavar="HOW", default="",
        help="from step K on, override the agent: brake; left or right (change lanes, and brake); keep_lane; or "
        "keep_speed. Or let a reference driver correct unsafe speeds (reference_speed), unsafe lane changes "
        "(reference_lanes) or both (reference). If there are several agents, write ID=HOW",
    )  # fmt: skip
    whatif.add_argument(
        "--leave-out",
        metavar="ID,…",
        action=WordsWithCommas,
        default="",
        help="run the trial without the actors that have these ids",
    )
    whatif.add_argument(
        "--code", choices=("snapshot", "current"), default=None,
        help="run the agent's code from the snapshot, or today's code; default: current with --agent, otherwise "
        "snapshot. With --code current and --from-step K, today's code drives after step K",
    )  # fmt: skip
    whatif.add_argument(
        "--times", metavar="N", type=integer, help="number of runs; default: 50 with --futures, otherwise 1"
    )
    add_parallel(whatif, "runs at a time")
    whatif.add_argument(
        "--for", metavar="TIME", default="", dest="time",
        help="stop after this time; the counts then include only the runs with lower numbers than the first "
        "unfinished run",
    )  # fmt: skip
    add_trust(whatif)
    add_json(whatif)
    whatif.set_defaults(command=_whatif)


def _whatif(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.base.signals import stop_requests

    refuse_below(options, times=1, parallel=0)
    time_s = duration_s(options.time, "--for")
    sets, arguments = pairs(options.sets, "--set"), pairs(options.arg, "--arg")
    from crashhunt.analysis import WhatIfOptions, interventions_of, what_if

    with opened_crash(options.directory, options.crash) as (bundle, archive), stop_requests() as stops:
        asked = interventions_of(
            bundle, changes=sets, from_step=options.from_step, before_s=options.before, agent=options.agent,
            arguments=arguments, futures=options.futures, overrule=options.overrule,
            leave_out=tuple(filter(None, options.leave_out.split(","))), code=options.code,
        )  # fmt: skip

        def run(trusted: bool | None) -> Counts:
            with shown_progress(f"running {bundle.id}", as_json=options.json) as watch:
                return what_if(
                    bundle,
                    asked,
                    WhatIfOptions(
                        code=options.code or ("current" if options.agent else "snapshot"),
                        times=options.times or 0,
                        parallel=options.parallel or len(os.sched_getaffinity(0)),
                        time_s=time_s,
                        trusted=trusted,
                        watch=watch,
                        stopped=lambda: bool(stops),
                    ),
                )

        counts = run_trusted(run, bundle, archive, options)
    options.answer("\n".join(counts.lines()), counts.to_json())
    return INTERRUPTED if stops else DONE
