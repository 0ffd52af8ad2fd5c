"""``crashhunt crashes``."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import UsageError
from crashhunt.cli._common import add_ci_options, add_json, add_trust, check_trust, integer, say, tell
from crashhunt.cli._exit_codes import DONE, INTERRUPTED

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from crashhunt.cli._common import Commands
    from crashhunt.corpus import Case
    from crashhunt.crashes import CauseGroup, Group, Signature

__all__ = ["add_crashes"]

_DEFAULT_RUNS = 8  # `crashhunt.whatif.REPRESENTATIVES`, which takes longer to import than a parser to build


def add_crashes(commands: Commands) -> None:
    """Add the command ``crashes`` to the parser."""
    crashes = commands.add_parser(
        "crashes",
        help="list the different crash types",
        description="Group the crashes of hunts by crash type: crashes of one type share the kind of encounter and the "
        "role of the agent, or the function that raised the exception. Prints one line for each type, the most "
        "frequent first.",
    )
    crashes.add_argument("directories", metavar="DIR", type=Path, nargs="+", help="directories of hunts or suites")
    crashes.add_argument(
        "--known", metavar="CORPUS", type=Path,
        help="mark the crash types of which this corpus contains a case that is expected to reproduce",
    )  # fmt: skip
    crashes.add_argument(
        "--sarif", metavar="FILE", type=Path, help="write the crash types as SARIF 2.1.0, for code scanning and editors"
    )
    crashes.add_argument(
        "--by-cause", metavar="N", type=integer, nargs="?", const=_DEFAULT_RUNS, default=None,
        help="also list the crashes by cause: analyse up to N crashes of each type as crashhunt judge does, and give "
        "each other crash the cause of the most similar analysed crash; default: 8",
    )  # fmt: skip
    add_trust(crashes)
    add_ci_options(crashes)
    add_json(crashes)
    crashes.set_defaults(command=_crashes)


def _crashes(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.crashes import count_causes, group_crashes, join_causes, list_bundles
    from crashhunt.hunts import dropped_crashes, find_hunts
    from crashhunt.report import describe_causes, describe_groups

    if options.by_cause is not None and options.by_cause < 1:
        raise UsageError(f"--by-cause is {options.by_cause}", fix="give at least 1")
    cases = _cases(options.known)
    hunts = list(dict.fromkeys(hunt for directory in options.directories for hunt in find_hunts(directory)))
    bundles = (bundle for hunt in hunts for bundle in list_bundles(hunt))
    found = group_crashes(bundles, dropped_crashes(hunts))
    known = _types_in_corpus(found.groups, cases)
    causes, interrupted = (None, False) if options.by_cause is None else _divide_types(options, found.groups)
    say(describe_groups(found.groups, known), as_json=options.json)
    if causes is not None:
        say(describe_causes(found.groups, causes), as_json=options.json)
    for why in found.left_out:
        say(f"skipped: {why}", as_json=True)
    _print_groups(options, found.groups, known)
    if options.json:
        groups = [dict(group.to_json()) for group in found.groups]
        by_cause: dict[str, object] = {}
        if causes is not None:
            joined = join_causes(found.groups, causes)
            by_cause = {"types_by_cause": count_causes(joined)[0], "by_cause": [one.to_json() for one in joined]}
            pairs = zip(groups, causes, strict=True)
            groups = [{**one, "causes": [each.to_json() for each in of]} for one, of in pairs]
        if known is not None:
            groups = [{**one, "known": known.get(of.signature)} for one, of in zip(groups, found.groups, strict=True)]
        print(json.dumps({"groups": groups, **by_cause, "left_out": list(found.left_out)}))
    if interrupted:
        say("Interrupted: some causes are not known yet. Run the same command to resume.", as_json=options.json)
    return INTERRUPTED if interrupted else DONE


def _divide_types(options: argparse.Namespace, groups: Sequence[Group]) -> tuple[list[tuple[CauseGroup, ...]], bool]:
    """Return the crashes of each type, divided by cause, and whether the user has interrupted the division."""
    from crashhunt.base.signals import stop_requests
    from crashhunt.replays import ReplayOptions
    from crashhunt.whatif import divide_by_cause

    for first in {group.first.hunt: group.first for group in groups}.values():  # before the first one runs
        check_trust(first, options.trust or None)
    with stop_requests() as stops:
        divided = [
            divide_by_cause(
                group,
                ReplayOptions(force=True, trusted=True),
                most=options.by_cause,
                parallel=len(os.sched_getaffinity(0)),
                stopped=lambda: bool(stops),
            )
            for group in groups
        ]
        return divided, bool(stops)


def _cases(corpus: Path | None) -> list[Case] | None:
    """Return the cases of a corpus; None if no corpus was given."""
    from crashhunt.corpus import find_cases, read_case

    if corpus is None:
        return None
    if corpus.is_dir() and not any(corpus.rglob(layout.CASE)):
        return []
    return [read_case(path) for path in find_cases([corpus])]


def _types_in_corpus(groups: Sequence[Group], cases: list[Case] | None) -> dict[Signature, str] | None:
    """Return for each crash type the name of its corpus case; None if no corpus was given."""
    from crashhunt.corpus import known_kinds

    if cases is None:
        return None
    found = known_kinds((group.signature for group in groups), cases)
    return {signature: str(case.path) for signature, case in found.items()}


def _print_groups(options: argparse.Namespace, groups: Sequence[Group], known: dict[Signature, str] | None) -> None:
    from crashhunt.report import crash_annotations, crashes_summary, findings_of, write_sarif

    if options.sarif is None and options.summary is None and not options.annotate:
        return
    findings = findings_of(groups, known)
    if options.sarif is not None:
        write_sarif(findings, options.sarif)
    tell(options, crashes_summary(findings, compared=known is not None), crash_annotations(findings))
