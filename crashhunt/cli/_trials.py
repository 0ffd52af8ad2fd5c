"""``crashhunt trials``."""

from __future__ import annotations

import io
import sys
from pathlib import Path

from crashhunt.base.errors import UsageError
from crashhunt.base.text import command_line, one_of, visible
from crashhunt.cli._common import CommandOptions, Commands, WordsWithCommas


def add_trials(commands: Commands) -> None:
    """Add the command ``trials`` to the parser."""
    from crashhunt.trial import Outcome

    trials = commands.add_parser(
        "trials",
        help="write the trials of a hunt as a table",
        description="Write a table of the trials of a hunt, one row per trial: number, seed, outcome, steps, closest "
        "approach, and every argument.",
    )
    trials.add_argument("directory", metavar="DIR", type=Path, help="directory of the hunt")
    trials.add_argument(
        "--format", choices=("csv", "json", "jsonl", "parquet"), default="csv",
        help="format of the table; default: csv; parquet needs --out and pip install 'crashhunt[parquet]'",
    )  # fmt: skip
    trials.add_argument("--out", metavar="FILE", type=Path, help="file to write; default: standard output")
    trials.add_argument(
        "--outcome",
        metavar="KIND,…",
        action=WordsWithCommas,
        default="",
        help=f"write only trials with these outcomes: {', '.join(str(kind) for kind in Outcome)}",
    )
    trials.set_defaults(command=_trials)


def _trials(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.base.files import output_file
    from crashhunt.crashes import read_notes
    from crashhunt.report import describe_note
    from crashhunt.results import HuntResults, write_parquet, write_text
    from crashhunt.trial import Outcome, in_order

    outcomes = [name for name in options.outcome.split(",") if name]
    brought: tuple[Outcome, ...] = ()  # by oracles of the hunt
    if any(name not in list(Outcome) for name in outcomes) and options.directory.exists():
        brought = HuntResults(options.directory).settings.crash_on
    known = in_order([*Outcome, *brought])
    for name in outcomes:
        if name not in known:
            raise UsageError(f"--outcome: there is no outcome {name!r}", fix=one_of(name, known, give="give some of"))
    hunt = HuntResults(options.directory)
    for note in read_notes(options.directory):  # the table is for programs, so notes are next to it
        print(describe_note(note), file=sys.stderr)
    if options.out is None:
        if options.format == "parquet":
            raise UsageError("--format parquet cannot be printed on a terminal", fix="give --out FILE")
        if not sys.stdout.isatty():
            write_text(hunt, sys.stdout, options.format, outcomes=outcomes)
            return 0
        shown = io.StringIO()  # of others, for a terminal
        write_text(hunt, shown, options.format, outcomes=outcomes)
        print(visible(shown.getvalue()), end="")
        return 0
    if options.format == "parquet":
        count = write_parquet(hunt, options.out, outcomes=outcomes)
    else:
        with output_file(options.out) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            count = write_text(hunt, file, options.format, outcomes=outcomes)
    print(f"{command_line(options.out)} has {count} trials", file=sys.stderr)
    return 0
