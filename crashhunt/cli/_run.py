"""``crashhunt run``."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from crashhunt.base.errors import CrashhuntError
from crashhunt.cli._common import (
    DONE,
    INTERRUPTED,
    NO_VALID_TRIAL,
    THE_ANSWER_IS_NO,
    add_json,
    add_options,
    chosen_options,
    integer,
)
from crashhunt.cli._rate import exit_code_of

if TYPE_CHECKING:
    import argparse

    from crashhunt.cli._common import Commands

__all__ = ["add_run"]

_LONG_WAIT_S = 3.0  # after which people wonder


def add_run(commands: Commands) -> None:
    """Add the command."""
    run = commands.add_parser(
        "run",
        help="hunt for a crash",
        description="Hunt for a crash: run trials in parallel, each with its own seed and arguments, and stop as soon "
        "as one crashes. The same command on the same DIR resumes the hunt.",
    )
    run.add_argument("directory", metavar="DIR", type=Path, help="where everything is kept; made if it is not there")
    run.add_argument("parallel", metavar="PARALLEL", type=integer, help="trials at a time; 0: one per core")
    run.add_argument("trials", metavar="TRIALS", type=integer, help="how many trials at most; 0: no limit, with --for")
    run.add_argument("max_steps", metavar="MAX_STEPS", type=integer, help="the bound on each trial, in steps")
    what = run.add_argument_group("what is hunted")
    how = run.add_argument_group("how it is hunted")
    add_options({"what": what, "how": how})
    how.add_argument("--overwrite", action="store_true", help="start a new hunt, even if DIR holds another one")
    how.add_argument("--fail-on-crash", action="store_true", help="exit with 1 if a crash was found")
    add_json(how)
    run.set_defaults(command=_run)


def _run(options: argparse.Namespace, words: list[str]) -> int:
    # Exit at once, because nothing has to be kept before the hunt takes over, and an import in user code could swallow
    # an exception.
    signal.signal(signal.SIGINT, lambda *_: _leave_at_once(as_json=options.json))
    from crashhunt.api import prepare

    waiting = _tell_of_the_survey(options)
    try:
        hunt = prepare(
            options.directory,
            options.parallel,
            options.trials,
            options.max_steps,
            overwrite=options.overwrite,
            command=["crashhunt", *words],
            **chosen_options(options),
        )
    finally:
        waiting.cancel()
    from rich.console import Console

    from crashhunt.report import Watcher, describe_hunt

    console = Console(stderr=options.json, highlight=False)
    agents = ", ".join(setup.agent for setup in hunt.settings.agents.values())
    with Watcher(console, f"crashhunt: {hunt.scenario.name}, {agents}", hunt.scenario.notes) as watcher:
        report = hunt.run(watcher)
        watcher.tell_notes()  # where there was nothing to run
    console.print(describe_hunt(report), markup=False, soft_wrap=True)
    if options.json:
        print(json.dumps(report.to_json()))
    if report.stopped_because == "no_valid_trial":
        return NO_VALID_TRIAL
    if report.stopped_because == "interrupted":
        return INTERRUPTED
    if report.rate is not None:
        return exit_code_of([report.rate.verdict])
    found = report.crashes or report.copied is not None
    return THE_ANSWER_IS_NO if found and options.fail_on_crash else DONE


def _tell_of_the_survey(options: argparse.Namespace) -> threading.Timer:
    """Return a timer that explains a long wait; the caller cancels it."""

    def tell() -> None:
        scenario = Path(str(options.scenario))
        if scenario.is_file() and scenario.suffix != ".toml":  # only a simulator's own configuration is surveyed
            limit = "60 s of processor time at most"
            print(f"simulating the plain traffic, to find vehicles that enter ({limit})", file=sys.stderr, flush=True)

    timer = threading.Timer(_LONG_WAIT_S, tell)
    timer.daemon = True
    if options.ego in (None, "", "any"):
        timer.start()
    return timer


def _leave_at_once(*, as_json: bool) -> NoReturn:
    error = CrashhuntError("interrupted before the hunt began")
    if as_json:
        os.write(1, json.dumps(error.to_json()).encode() + b"\n")
    os.write(2, f"crashhunt: {error}\n".encode())
    os._exit(INTERRUPTED)
