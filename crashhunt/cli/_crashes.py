"""``crashhunt crashes``."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import UsageError
from crashhunt.base.text import command_line, count_of
from crashhunt.cli._common import (
    DONE,
    INTERRUPTED,
    THE_ANSWER_IS_NO,
    add_ci_options,
    add_json,
    integer,
    refuse_below,
    tell,
)
from crashhunt.cli._trust import add_trust, check_trust

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.cli._common import CommandOptions, Commands, Parser
    from crashhunt.corpus import Case, KnownType
    from crashhunt.crashes import CauseGroup, Group, Groups, Signature

_DEFAULT_RUNS = 8  # `crashhunt.analysis.REPRESENTATIVES`, which takes longer to import than a parser to build


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
    add_known(crashes)
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


def add_known(parser: Parser) -> None:
    """Add the options that compare crash types with a corpus."""
    parser.add_argument(
        "--known", metavar="CORPUS", type=Path,
        help="mark the crash types of which this corpus contains a case that is expected to reproduce; if causes are "
        "stored on both sides, a crash with another cause is new",
    )  # fmt: skip
    parser.add_argument(
        "--fail-on-new", action="store_true",
        help="with --known: exit with 1 if a crash is new, or cannot be compared with the corpus",
    )  # fmt: skip


def _crashes(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.crashes import count_causes, group_crashes, join_causes, list_bundles, read_notes
    from crashhunt.report import describe_causes, describe_groups, describe_note, describe_types_by_version
    from crashhunt.results import crashes_by_version, dropped_crashes, find_hunts

    refuse_below(options, by_cause=1)
    cases = checked_cases(options)
    hunts = list(dict.fromkeys(hunt for directory in options.directories for hunt in find_hunts(directory)))
    bundles = (bundle for hunt in hunts for bundle in list_bundles(hunt))
    found = group_crashes(bundles, dropped_crashes(hunts))
    causes, interrupted = (None, False) if options.by_cause is None else _divide_types(options, found.groups)
    comparison = _Comparison(found, cases, causes)
    known = comparison.known
    options.say(describe_groups(found.groups, known))
    versions = crashes_by_version(hunts, found.groups)
    for line in describe_types_by_version(versions):
        options.say(line)
    if causes is not None:
        options.say(describe_causes(found.groups, causes))
    for why in found.left_out:
        options.say(f"skipped: {why}", to_stderr=True)
    for line in comparison.lines():
        options.say(line)
    notes = [(hunt, note) for hunt in hunts for note in read_notes(hunt)]
    for line in [f"{hunt}: {describe_note(note, whole=False)}" for hunt, note in notes]:
        options.say(line)
    _print_groups(options, found.groups, known)
    if options.json:
        groups = comparison.to_json()
        by_cause: dict[str, object] = {}
        if causes is not None:
            joined = join_causes(found.groups, causes)
            by_cause = {"types_by_cause": count_causes(joined)[0], "by_cause": [one.to_json() for one in joined]}
            pairs = zip(groups, causes, strict=True)
            groups = [{**one, "causes": [each.to_json() for each in of]} for one, of in pairs]
        apart = {"code_versions": versions} if versions else {}
        noted = {"notes": [{"hunt": str(hunt), **note.to_json()} for hunt, note in notes]} if notes else {}
        print(json.dumps({"groups": groups, **by_cause, "left_out": list(found.left_out), **apart, **noted}))
    if interrupted:
        options.say("Interrupted: some causes are not known yet. Run the same command to resume.")
    if interrupted:
        return INTERRUPTED
    return THE_ANSWER_IS_NO if options.fail_on_new and comparison.has_news else DONE


class _Comparison:
    """The crash types of hunts, compared with the cases of a corpus."""

    def __init__(
        self, found: Groups, cases: list[Case] | None, causes: Sequence[Sequence[CauseGroup]] | None = None
    ) -> None:
        from crashhunt.corpus import compare_types

        self._found = found
        self._types: dict[Signature, KnownType] | None = None
        self._is_corpus_empty = cases == []
        if cases is not None:
            given = None if causes is None else [[part.cause for part in parts] for parts in causes]
            self._types = compare_types(found.groups, cases, given)

    @property
    def known(self) -> dict[Signature, str] | None:
        """The path of a case for each known crash type; None without a corpus. A type with a new cause is not known."""
        if self._types is None:
            return None
        return {name: str(one.case.path) for name, one in self._types.items() if not one.new_causes}

    @property
    def has_news(self) -> bool:
        known = self.known
        return known is not None and (len(known) < len(self._found.groups) or bool(self._found.left_out))

    def lines(self) -> list[str]:
        """Return sentences on the comparison, without the crash types that are new."""
        lines = []
        for signature, one in (self._types or {}).items():
            lines += [
                f"new cause of the type {str(signature)!r}: {cause}; the corpus has the type with another cause "
                f"({one.case.path})"
                for cause in one.new_causes
            ]
            if one.by == "type":
                lines.append(
                    f"not judged: {str(signature)!r} is known by its type alone, so another cause would be hidden. "
                    f"Fix: judge a crash of this type, add it to the corpus again, and use --by-cause"
                )
        known = self.known
        if self._is_corpus_empty and self._found.groups:
            lines.append("the corpus has no case yet, so every crash type is new")
        if known is not None and self.has_news:
            new, unknown = len(self._found.groups) - len(known), len(self._found.left_out)
            words = [count_of(new, "new crash type")] if new else []
            words += [f"{unknown} not compared"] if unknown else []
            lines.append(", ".join(words))
        return ["", *lines] if lines else []

    def to_json(self) -> list[JsonObject]:
        """Return the groups in the form that ``crashes --json`` prints."""
        groups = [dict(group.to_json()) for group in self._found.groups]
        if self._types is None:
            return groups
        known = self.known or {}
        types = [self._types.get(group.signature) for group in self._found.groups]
        return [
            {
                **one,
                "known": known.get(group.signature),
                "known_by": None if of is None else of.by,
                "new_causes": [] if of is None else [str(cause) for cause in of.new_causes],
            }
            for one, group, of in zip(groups, self._found.groups, types, strict=True)
        ]


def compare_with_corpus(options: CommandOptions, cases: list[Case]) -> tuple[JsonObject, bool]:
    """Print the crash types of all hunts below the directory of a command, compared with a corpus.

    Returns:
        The types in the form that ``crashes --json`` prints, and whether a type is new or cannot be compared.
    """
    from crashhunt.crashes import group_crashes, list_bundles
    from crashhunt.report import describe_groups
    from crashhunt.results import dropped_crashes, find_hunts

    hunts = find_hunts(options.directory)
    found = group_crashes((bundle for hunt in hunts for bundle in list_bundles(hunt)), dropped_crashes(hunts))
    comparison = _Comparison(found, cases)
    options.say(describe_groups(found.groups, comparison.known))
    for line in (*(f"skipped: {why}" for why in found.left_out), *comparison.lines()):
        options.say(line)
    return {"groups": comparison.to_json(), "not_compared": list(found.left_out)}, comparison.has_news


def _divide_types(options: CommandOptions, groups: Sequence[Group]) -> tuple[list[tuple[CauseGroup, ...]], bool]:
    """Return the crashes of each type, divided by cause, and whether the user has interrupted the division."""
    from crashhunt.analysis import divide_by_cause
    from crashhunt.base.signals import stop_requests
    from crashhunt.replays import ReplayOptions

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


def checked_cases(options: CommandOptions) -> list[Case] | None:
    """Return the cases of the corpus of ``--known``; None without this option.

    Raises:
        UsageError: ``--fail-on-new`` without ``--known``.
        BundleError: The corpus does not exist, or a case cannot be read.
    """
    from crashhunt.corpus import find_cases, read_case

    corpus = options.known
    if corpus is None:
        if options.fail_on_new:
            raise UsageError(
                "--fail-on-new has no corpus to compare the crash types with", fix="add --known CORPUS, such as crashes"
            )
        return None
    if corpus.is_dir() and not any(corpus.rglob(layout.CASE)):
        if (corpus / layout.HUNT).exists():
            add = command_line("crashhunt", "corpus", "add", corpus, "--to", "crashes")
            raise UsageError(
                f"--known {command_line(corpus)} is a hunt, not a corpus", fix=f"make a corpus of it: {add}"
            )
        return []
    return [read_case(path) for path in find_cases([corpus])]


def _print_groups(options: CommandOptions, groups: Sequence[Group], known: dict[Signature, str] | None) -> None:
    from crashhunt.report import crash_annotations, crashes_summary, findings_of, write_sarif

    if options.sarif is None and options.summary is None and not options.annotate:
        return
    findings = findings_of(groups, known)
    if options.sarif is not None:
        write_sarif(findings, options.sarif)
    tell(options, crashes_summary(findings, compared=known is not None), crash_annotations(findings))
