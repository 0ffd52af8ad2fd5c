"""``crashhunt logs``."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from crashhunt.base.errors import UsageError
from crashhunt.base.text import one_line, visible
from crashhunt.cli._common import CommandOptions, Commands, GivenOnce, chosen_runs, integer, refuse_below


def add_logs(commands: Commands) -> None:
    """Add the command ``logs`` to the parser."""
    logs = commands.add_parser(
        "logs",
        help="show the output and the errors of hunts and trials",
        description="Show three types of logs: the output of hunts and trials (type run), the errors that ended them "
        "(type error), and the changes of a hunt's state (type state). Only crashes and kept trials have logs.",
    )
    logs.add_argument("directory", metavar="DIR", type=Path, help="directory of a hunt or a suite")
    logs.add_argument(
        "--run",
        metavar="ID",
        action="append",
        default=[],
        help="show only this run of a suite, such as town/0; the option may be given several times",
    )
    logs.add_argument("--trial", metavar="N", type=integer, action=GivenOnce, help="show only the logs of this trial")
    logs.add_argument(
        "--type",
        action=GivenOnce,
        choices=("run", "error", "state"),
        help="show only the output of trials (run), only errors (error) or only state changes (state); default: all",
    )
    logs.add_argument("--errors-only", action="store_true", help="the same as --type error")
    logs.add_argument("--follow", action="store_true", help="keep printing while the hunt is running")
    logs.set_defaults(command=_logs)


def _logs(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.results import LogKind, LogReader, hunt_state

    if options.errors_only and options.type not in (None, "error"):
        raise UsageError(f"--errors-only and --type {options.type} contradict each other", fix="give one of them")
    refuse_below(options, trial=0)
    hunts = chosen_runs(options.directory, options.run)
    kinds: tuple[LogKind, ...] = ("run", "error", "state")
    if options.errors_only or options.type is not None:
        kinds = ("error",) if options.errors_only else (options.type,)
    readers = {name: LogReader(hunt, kinds, trial=options.trial) for hunt, name in hunts.items()}
    found = False
    while True:
        running = options.follow and any(hunt_state(hunt).state in ("running", "queued") for hunt in hunts)
        for name, reader in readers.items():
            for title, text in reader.fresh():
                found = True
                where = title if name == "." else f"{name}: {title}"
                print(visible(f"==> {one_line(where)} <==\n{_split_progress_lines(text).rstrip()}\n"), flush=True)
        if not running:
            break
        time.sleep(0.5)
    if not found:
        kept = f"trial {options.trial} printed nothing, or its log was not kept; run --keep-trials keeps all logs"
        print("there is nothing to show" if options.trial is None else kept, file=sys.stderr)
    return 0


def _split_progress_lines(text: str) -> str:
    """Return the states of a progress bar, which has overwritten its own line, as separate lines."""
    return text.replace("\r\n", "\n").replace("\r", "\n")
