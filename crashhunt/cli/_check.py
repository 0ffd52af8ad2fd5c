"""``crashhunt check``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.base.text import command_line, count_of
from crashhunt.cli._common import CommandOptions, Commands, add_json

if TYPE_CHECKING:
    from crashhunt.hunts import Checked


def add_check(commands: Commands) -> None:
    """Add the command ``check`` to the parser."""
    check = commands.add_parser(
        "check",
        help="check that the files on disk are complete and unchanged",
        description="Check that the files on disk are complete, unchanged and consistent: every trial of the ledger, "
        "every crash with its log, and every snapshot of code. The command changes nothing and runs no code. Exits "
        "with 1 if something is damaged, and reports what is lost and how to recover the rest.",
    )
    check.add_argument(
        "directory", metavar="DIR", type=Path,
        help="directory of a hunt, a suite or a crash, or a file that crashhunt export wrote",
    )  # fmt: skip
    check.add_argument(
        "--salvage", metavar="TO", type=Path,
        help="copy the intact parts of a hunt into this new directory, in which the hunt can resume. Damaged trials "
        "are not copied, and the resumed hunt runs these trials again. If this command was killed, run it again",
    )  # fmt: skip
    add_json(check)
    check.set_defaults(command=_check)


def _check(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.hunts import check, salvage

    found = check(options.directory)
    if options.salvage is not None and len(found) != 1:
        raise UsageError(
            f"--salvage takes one hunt, but {len(found)} hunts were found", fix="give the directory of one hunt"
        )
    for each in found:
        options.say(_describe(each))
    saved = None
    if options.salvage is not None:
        saved = salvage(found[0], options.salvage)
        counts = f"{count_of(saved['trials'], 'trial')} and {count_of(saved['crashes'], 'crash')}"
        options.say(f"{counts} are in {command_line(options.salvage)}; resume the hunt there with crashhunt run")
    fine = all(each.fine for each in found)
    options.print_json({"fine": fine, "hunts": [each.to_json() for each in found], "salvaged": saved})
    return 0 if fine else 1


def _describe(found: Checked) -> str:
    near, crashes, minimized = len(found.near_misses), found.crash_count, found.minimized
    counts = [(len(found.trials), "trial")] if found.kind == "hunt" else []
    counts += [(crashes, "crash")] if crashes or not near or found.kind == "hunt" else []
    counts += [(minimized, "minimized crash")] if minimized else []
    counts += [(near, "near miss")] if near else []
    listed = " and ".join(", ".join(count_of(*one) for one in counts).rsplit(", ", 1))
    are = "is" if [count for count, _ in counts] == [1] else "are"
    lines = [f"{command_line(found.dir)}: {listed} {are} intact"]
    if not found.fine:
        bad = [
            count_of(len(numbers), noun)
            for numbers, noun in ((found.damaged_trials, "trial"), (found.damaged_crashes, "crash"))
            if numbers
        ]
        lines[0] += f"; damaged: {', '.join(bad) or 'see below'}"
    for finding in found.findings:
        mark = "damaged" if finding.damaged else "note"
        lines.append(f"  {mark}: {finding.where}: {finding.what}")
        if finding.lost:
            lines.append(f"    lost: {finding.lost}")
        if finding.fix:
            lines.append(f"    {finding.fix}")
    return "\n".join(lines)
