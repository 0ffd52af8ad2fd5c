"""``crashhunt corpus add|run|list``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import UsageError
from crashhunt.base.text import command_line, count_of, in_lines
from crashhunt.cli._common import (
    INTERRUPTED,
    add_ci_options,
    add_json,
    add_parallel,
    crash_id,
    opened_crash,
    refuse_below,
    shown_progress,
    tell,
)
from crashhunt.cli._trust import add_trust, check_trust, run_trusted

if TYPE_CHECKING:
    from crashhunt.cli._common import CommandOptions, Commands, Parser
    from crashhunt.corpus import CaseReport


def add_corpus(commands: Commands) -> None:
    """Add the command ``corpus`` to the parser."""
    corpus = commands.add_parser(
        "corpus",
        help="keep crashes in a repository, and check that they stay fixed",
        description="Keep crashes in your repository, each with the result that you expect from today's code.",
    )
    inner = corpus.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_add(inner)
    _add_run(inner)
    listing = inner.add_parser("list", help="list the cases", description="List the cases of a corpus.")
    _add_places(listing)
    add_json(listing)
    listing.set_defaults(command=_list)


def _add_add(commands: Commands) -> None:
    add = commands.add_parser(
        "add",
        help="put crashes into a corpus",
        description="Add crashes to a corpus. A crash in a corpus consists of its seed, its arguments, its scenario "
        "and its log; a large log is shortened. The code of crashhunt and of the agent is excluded, "
        "because a corpus tests the current code.",
    )
    add.add_argument(
        "bundles", metavar="BUNDLE", type=Path, nargs="+",
        help="the folder of a crash or of a hunt, or a file that crashhunt export wrote",
    )  # fmt: skip
    add.add_argument(
        "--crash", metavar="ID", type=crash_id, action="append", default=[],
        help="of a hunt: the crash to add; the option may be given several times; default: the shortest crash",
    )  # fmt: skip
    add.add_argument("--to", metavar="CORPUS", type=Path, required=True, help="the folder of the corpus")
    add.add_argument(
        "--expect", choices=("still", "fixed"),
        help="the expected result: still, which means that the crash reproduces (the default), or fixed",
    )  # fmt: skip
    add.add_argument("--note", metavar="TEXT", help="a note on the crash, for readers of the corpus")
    add_trust(add)
    add_json(add)
    add.set_defaults(command=_add)


def _add_run(commands: Commands) -> None:
    run = commands.add_parser(
        "run",
        help="run every case again with today's code",
        description="Run every case again with today's code, and report whether the case still crashes, is fixed, or "
        "has another crash now. Exits with 1 if a result is not the expected one.",
    )
    _add_places(run)
    run.add_argument(
        "--keep", metavar="DIR", type=Path,
        help="save every crash in this folder, in the form of a hunt that crashhunt show, replay and report accept",
    )  # fmt: skip
    add_parallel(run, "cases that run at a time")
    add_trust(run)
    add_ci_options(run)
    add_json(run)
    run.set_defaults(command=_run)


def _add_places(parser: Parser) -> None:
    parser.add_argument("places", metavar="CORPUS", type=Path, nargs="+", help="the folder of a corpus, or of a case")


def _add(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.corpus import add_case
    from crashhunt.crashes import list_bundles

    if options.crash and len(options.bundles) > 1:
        raise UsageError(
            f"--crash chooses a crash of one hunt, and {len(options.bundles)} bundles are given",
            fix="give the directory of one hunt",
        )
    answers = []
    for path, crash in [(path, crash) for path in options.bundles for crash in options.crash or [""]]:
        with opened_crash(path, crash) as (bundle, archive):
            # Every run of the corpus runs what its cases name.
            run_trusted(partial(check_trust, bundle), bundle, archive, options, path=path)
            added = add_case(bundle, options.to, expect=options.expect, note=options.note)
            data = added.case.to_json()
            answers.append({**data, "new": added.new})
            log = added.case.kind_of_log()
            options.say(_added(data["path"], data["bytes"], log=log, new=added.new))
            if added.changed:
                options.say(in_lines([f"  expect is now {added.case.expect}{_note(added.case.note)}"]))
            if added.judged:
                options.say("  its causes are in the corpus now")
            others = (
                0 if crash or archive is not None or (path / layout.CRASH).is_file() else len(list_bundles(path)) - 1
            )
            if others > 0:
                options.say(
                    f"  one of {others + 1} crashes; to add another one, give --crash ID; to add all of them, give "
                    f"{command_line(path)}/crashes/*"
                )
            if bundle.confirmed is False:
                options.say("  warning: it is flaky, so that it may be fixed by luck")
    options.print_json({"cases": answers})
    return 0


def _added(path: str, size: int, *, log: str, new: bool) -> str:
    said = f"{size / 1024:.0f} KiB" + {"whole": "", "compact": ", with a compact log"}.get(log, ", without a log")
    return in_lines([f"{command_line(path)} {'is new' if new else 'was there already'} ({said})"])


def _note(note: str) -> str:
    return f", note {note!r}" if note else ""


def _run(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.base.signals import stop_requests
    from crashhunt.corpus import find_cases, run_cases
    from crashhunt.report import corpus_annotations, corpus_summary

    refuse_below(options, parallel=0)
    cases = find_cases(options.places)
    if not options.trust:
        _trust_cases(cases, options)
    with stop_requests() as asked, shown_progress("running the corpus", as_json=options.json) as watch:
        reports = run_cases(
            cases, parallel=options.parallel, keep=options.keep, watch=watch, stopped=lambda: bool(asked),
            trusted=True,
        )  # fmt: skip
    options.say(_summary_of(reports, len(cases)))
    tell(options, corpus_summary(reports), corpus_annotations(reports))
    options.print_json({"cases": [report.to_json() for report in reports]})
    if len(reports) < len(cases):
        return INTERRUPTED
    return 0 if all(report.ok for report in reports) else 1


def _trust_cases(cases: list[Path], options: CommandOptions) -> None:
    """Check that every case is trusted before the first case runs; ask at the terminal once for each origin."""
    from crashhunt.corpus import untrusted_case

    for path in cases:
        bundle = untrusted_case(path)
        if bundle is not None:
            run_trusted(partial(check_trust, bundle), bundle, None, options, path=path)


_COUNT_WORDS = {
    "still": ("still crashes", "still crash"),
    "fixed": ("fixed", "fixed"),
    "changed": ("crashes in another way", "crash in another way"),
    "cannot_run": ("cannot run", "cannot run"),
}


def _summary_of(reports: list[CaseReport], count: int) -> str:
    lines = [report.describe() for report in reports if not report.ok]
    lines += [f"{report.path.name}: {report.line}" for report in reports if report.ok and report.got == "still"]
    tighter = [report for report in reports if report.may_be_tightened]
    lines += [
        f"{report.path.name}: fixed; to be warned if it crashes again, set expect = 'fixed' in "
        f"{report.path / layout.CASE}"
        for report in tighter
    ]
    counts = ", ".join(
        f"{number} {words[number > 1]}"
        for got, words in _COUNT_WORDS.items()
        if (number := sum(report.got == got for report in reports))
    )
    wrong = sum(not report.ok for report in reports)
    ended = "" if len(reports) == count else f"; interrupted after {len(reports)}"
    lines.append(
        f"{count_of(count, 'case')}: {counts or 'none has ended'}{ended}"
        + (f"; {wrong} not as expected" if wrong else "")
    )
    return "\n".join(lines)


def _list(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.corpus import find_cases, read_case

    cases = [read_case(path) for path in find_cases(options.places)]
    for case in cases:
        note = f"  ({case.note})" if case.note else ""
        options.say(in_lines([f"{command_line(case.path)}  {case.expect}  {case.crash}{note}"]))
    options.print_json({"cases": [case.to_json() for case in cases]})
    return 0
