"""``crashhunt shrink``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.base.text import command_line, in_lines
from crashhunt.cli._common import (
    INTERRUPTED,
    add_crash,
    add_json,
    add_parallel,
    duration_s,
    integer,
    opened_crash,
    refuse_below,
    shown_progress,
)
from crashhunt.cli._trust import add_trust, run_trusted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.analysis import Shrunk
    from crashhunt.cli._common import CommandOptions, Commands
    from crashhunt.crashes import Bundle

_DEFAULT_TRIALS = 500


def add_shrink(commands: Commands) -> None:
    """Add the command ``shrink`` to the parser."""
    shrink = commands.add_parser(
        "shrink",
        help="minimize a crash while its crash type stays the same",
        description="Minimize a crash while its crash type stays the same: remove other actors, drop disturbances, and "
        "set arguments to their defaults and to round numbers. If the crash still needs more than a few other actors, "
        "shrink moves these along their recorded paths, tries again to remove each of them, and cuts off the "
        "beginning of the trial. Each candidate is run with the "
        "code of the snapshot. The result is a new crash next to the first, ID.small. If you interrupt the command, it "
        "keeps the best result, and the same command resumes. Exits with 1 if the crash does not reproduce.",
    )
    add_crash(shrink)
    shrink.add_argument(
        "--budget", metavar="TRIALS", type=integer, default=_DEFAULT_TRIALS,
        help=f"maximum number of trials; default: {_DEFAULT_TRIALS}",
    )  # fmt: skip
    shrink.add_argument(
        "--for", metavar="TIME", dest="time", default="",
        help="time limit, such as 1m or 90s; after this time, two more runs confirm the result",
    )  # fmt: skip
    shrink.add_argument(
        "--form", choices=("either", "traffic", "scripted"), default="either",
        help="whether other actors keep driving (traffic), or are moved along their recorded paths (scripted); "
            "default: traffic if few actors remain, otherwise scripted",
    )  # fmt: skip
    add_parallel(shrink)
    add_trust(shrink)
    add_json(shrink)
    shrink.set_defaults(command=_shrink)


def _shrink(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.analysis import shrink
    from crashhunt.base.signals import stop_requests

    refuse_below(options, budget=1, parallel=0)
    time_s = duration_s(options.time, "--for")
    if options.directory.is_file():
        raise UsageError(
            "shrink writes its result next to the crash, and cannot write into an exported file",
            fix="unpack this zip file into a new folder, and give that folder",
            where=str(options.directory),
        )
    with opened_crash(options.directory, options.crash) as (bundle, _), stop_requests() as asked:

        def run(trusted: bool | None) -> Shrunk:
            with shown_progress(f"minimizing {bundle.id}", as_json=options.json) as watch:
                return shrink(
                    bundle, budget=options.budget, time_s=time_s, form=options.form, parallel=options.parallel,
                    watch=watch, stopped=lambda: bool(asked), trusted=trusted,
                )  # fmt: skip

        found = run_trusted(run, bundle, None, options)
    options.answer(_summary_of(found), found.to_json())
    if found.ended == "interrupted":
        return INTERRUPTED
    return 1 if found.verdict == "not_reproduced" else 0


def _summary_of(found: Shrunk) -> str:
    was, small = found.bundle.result, found.small
    lines = [f"{found.bundle.id}: {was.summary}"]
    if small is None:
        what = "nothing has been removed yet" if _interruption_words(found) else "nothing can be removed"
        what = "cannot be minimized" if found.verdict == "not_reproduced" else what
        why = found.why or (found.ended if _interruption_words(found) else "")
        lines.append(f"  {what}: {why}" if why else f"  {what}")
        lines += [f"  note: {note}" for note in found.notes]
        return in_lines(lines)
    (before, after), (agents, agents_left), result = found.others, found.agents, small.result
    moved = "" if found.scripted is None else _replaced_words(found.scripted)
    other, other_now = (one.collision.other if one.collision is not None else "" for one in (was, result))
    lines += [
        f"{small.id}: {result.summary}",
        *([f"  the crash type is the same, with {other_now} instead of {other}"] if other != other_now else []),
        f"  other actors: {before} before, {after} now; steps: {was.steps} before, {result.steps} now",
        *([f"  agents: {agents} before, {agents_left} now"] if agents_left < agents else []),
        *([f"  {moved}"] if moved else []),
        *([f"  the first {found.steps_cut} steps are removed"] if found.steps_cut else []),
        *(f"  {name} was {left} and is {right}" for name, (left, right) in found.changed.items()),
        f"  {found.trials} trials"
        + (f"; stopped early: {found.why or found.ended}" if _interruption_words(found) else ""),
        f"  saved in {command_line(small.path)}",
        _confirmation_words(small),
        *(f"  note: {note}" for note in found.notes),
    ]
    return in_lines(lines)


def _confirmation_words(small: Bundle) -> str:
    if small.confirmed:
        return "  confirmed: bit-identical when replayed in a new process"
    if small.confirmed is None:
        return f"  not confirmed: {small.why_unconfirmed or 'interrupted'}"
    return "  flaky: the replay in a new process deviates"


def _replaced_words(names: Sequence[str]) -> str:
    if not names:
        return "no traffic"
    return f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} moved as recorded, independent of the agent"


def _interruption_words(found: Shrunk) -> bool:
    return found.ended != "done"
