"""``crashhunt run``."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.isolation import OWN_THREAD
from crashhunt.base.resources import error_of_next_thread, limit_behind
from crashhunt.cli._common import (
    BAD_INPUT,
    DONE,
    INTERRUPTED,
    NO_VALID_TRIAL,
    THE_ANSWER_IS_NO,
    add_json,
    add_options,
    chosen_options,
    integer,
    make_console,
    unwritable_output,
)
from crashhunt.cli._rate import exit_code_of
from crashhunt.cli._short_help import GROUPS, ShortHelp

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.cli._common import CommandOptions, Commands
    from crashhunt.hunts import HuntStatus

_leave = os._exit  # which is refused to samplers, also while they are imported
_LONG_WAIT_S = 3.0  # after which people wonder


def add_run(commands: Commands) -> None:
    """Add the command ``run`` to the parser."""
    run = commands.add_parser(
        "run",
        help="hunt for a crash",
        description="Hunt for a crash: run trials in parallel, each with its own seed and arguments, and stop after "
        "the first crash. The same command on the same DIR resumes the hunt.",
        usage="%(prog)s [option]... DIR PARALLEL TRIALS MAX_STEPS",
        add_help=False,
    )
    hidden: dict[str, Any] = {"nargs": 0, "default": argparse.SUPPRESS}
    run.add_argument("-h", "--help", action=ShortHelp, **hidden, help="show the most used options")
    run.add_argument("--help-all", action="help", help="show all options")
    run.add_argument("directory", metavar="DIR", type=Path, help="directory of the hunt; created if it does not exist")
    run.add_argument(
        "parallel", metavar="PARALLEL", type=integer, help="number of trials that run at a time; 0: one per core"
    )
    run.add_argument(
        "trials",
        metavar="TRIALS",
        type=integer,
        help="maximum number of trials; 0: no limit, which needs --for or a bar for the rate",
    )
    run.add_argument("max_steps", metavar="MAX_STEPS", type=integer, help="maximum number of steps of a trial")
    groups = {name: run.add_argument_group(title) for name, title in GROUPS.items()}
    add_options(groups)
    groups["kept"].add_argument(
        "--overwrite", action="store_true", help="start a new hunt even if DIR contains another hunt"
    )
    groups["output"].add_argument("--fail-on-crash", action="store_true", help="exit with 1 if a crash was found")
    add_json(groups["output"])
    run.set_defaults(command=_run)


def _run(options: CommandOptions, words: list[str]) -> int:
    # Exit at once, because nothing has to be kept before the hunt takes over, and an import in user code could swallow
    # an exception.
    signal.signal(signal.SIGINT, lambda *_: _leave_at_once(as_json=options.json))
    from crashhunt.api import prepare

    waiting = _start_wait_notice(options)
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
    from crashhunt.dashboard import has_dashboard
    from crashhunt.report import Watcher, describe_hunt

    signal.signal(signal.SIGINT, signal.default_int_handler)  # after the hunt, "before it began" is wrong
    console = make_console(stderr=options.json)
    agents = ", ".join(setup.agent for setup in hunt.settings.agents.values())
    with Watcher(console, f"crashhunt: {hunt.scenario.name}, {agents}", hunt.scenario.notes) as watcher:
        try:
            report = hunt.run(_of_output(watcher, 2 if options.json else 1))
        except _OutputClosedError as error:
            raise BrokenPipeError from error
        watcher.tell_notes()  # where there was nothing to run
    described = describe_hunt(report, has_dashboard=console.is_terminal and has_dashboard())
    console.print(described, soft_wrap=True)
    options.print_json(report.to_json())
    if report.stopped_because == "no_valid_trial":
        return NO_VALID_TRIAL
    if report.stopped_because == "interrupted":
        return INTERRUPTED
    if report.unconfirmed:
        return INTERRUPTED
    if report.rate is not None:
        return exit_code_of([report.rate.verdict])
    found = report.crashes or report.copied is not None
    return THE_ANSWER_IS_NO if found and options.fail_on_crash else DONE


class _OutputClosedError(BaseException):
    """The reader of the output has gone. No exception of a hunt, which would be recorded as a failure of the hunt."""


def _of_output(watch: Callable[[HuntStatus], None], descriptor: int) -> Callable[[HuntStatus], None]:
    """Return a function that shows a status, and whose errors name the output instead of the directory of the hunt."""

    def show(status: HuntStatus) -> None:
        try:
            watch(status)
        except BrokenPipeError as error:
            raise _OutputClosedError from error
        except OSError as error:
            raise unwritable_output(error, descriptor) from error

    return show


def _start_wait_notice(options: CommandOptions) -> threading.Timer:
    """Return a timer that explains a long wait; the caller cancels it."""

    def tell() -> None:
        from crashhunt.scenario import configurations

        scenario = Path(str(options.scenario))
        found = (known.waiting for known in configurations() if scenario.name.endswith(known.endings))
        if (waiting := next(found, "")) and scenario.is_file():
            print(waiting, file=sys.stderr, flush=True)

    timer = threading.Timer(_LONG_WAIT_S, tell)
    timer.name = OWN_THREAD
    timer.daemon = True
    if options.ego in (None, "", "any"):
        timer.start()
    return timer


def _leave_at_once(*, as_json: bool) -> NoReturn:
    error, code = CrashhuntError("interrupted before the hunt began"), INTERRUPTED
    if no_thread := error_of_next_thread():  # OpenBLAS raises SIGINT
        error, code = CrashhuntError("no thread could be started", fix=limit_behind(no_thread)), BAD_INPUT
    with suppress(OSError):
        os.write(2, f"crashhunt: {error}\n".encode())
    if as_json:
        with suppress(OSError):
            os.write(1, json.dumps(error.to_json()).encode() + b"\n")
    _leave(code)
