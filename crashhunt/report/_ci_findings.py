"""Crash types as findings at a line of the agent's code: for CI annotations, SARIF alerts and Markdown summaries."""

from __future__ import annotations

import ast
import hashlib
import json
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePath
from typing import TYPE_CHECKING
from urllib.parse import quote

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.files import output_file
from crashhunt.base.text import command_line, count_of, one_line
from crashhunt.base.version import __version__
from crashhunt.crashes import own_frames
from crashhunt.report._judgement_words import fault_words, list_preventing
from crashhunt.snapshots import Snapshot

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.corpus import CaseReport
    from crashhunt.crashes import Bundle, Group, Signature


@dataclass(frozen=True, slots=True)
class CrashFinding:
    """A crash type, and the line of code at which an annotation for it is shown."""

    rule: str  # outcome of the crashes, such as ``collision``
    title: str  # title of the crash type
    message: str  # summary of the shortest crash, and the command that shows it
    file: str  # the agent's file, relative to its project; empty if unknown
    line: int  # line in the file, counted from 1: of the failure, or else of the agent's definition
    fingerprint: str  # identifier of the crash type, which is the same in every hunt
    known: str  # name of the corpus case with the same crash type; empty if there is no such case
    group: Group  # the crashes of the crash type


def findings_of(groups: Sequence[Group], known: Mapping[Signature, str] | None = None) -> list[CrashFinding]:
    """Return the crash types in the order of their groups; no code of the bundles runs.

    ``known`` has the name of the case in the corpus for each known crash type.
    """
    found = []
    for group in groups:
        example = group.shortest
        file, line = _place(example)
        fault = f" At fault: {fault_words(group.fault)}." if group.fault not in ("", "nobody can tell") else ""
        show = command_line("crashhunt", "show", example.path)
        prevented = f" Preventable ({words})." if (words := list_preventing(group.preventable_by)) else ""
        message = f"{example.result.summary}.{fault}{prevented} {count_of(group.count, 'crash')}. To look at it: {show}"
        found.append(
            CrashFinding(
                rule=group.signature.outcome,
                title=one_line(str(group.signature)),
                message=one_line(message),
                file=file,
                line=line,
                fingerprint=_fingerprint(group.signature),
                known=(known or {}).get(group.signature, ""),
                group=group,
            )
        )
    return found


def _fingerprint(signature: Signature) -> str:
    return hashlib.blake2b(json.dumps(signature.to_json(), sort_keys=True).encode(), digest_size=16).hexdigest()


def _place(bundle: Bundle) -> tuple[str, int]:
    """Return the file and the line of the agent's project to which a crash belongs."""
    failure = bundle.result.failure
    for frame in own_frames(failure) if failure is not None else ():
        if name := _in_project(frame.file):
            return name, frame.line
    return _definition(bundle.hunt / layout.SNAPSHOTS / bundle.snapshot, bundle.driver)


@cache
def _definition(snapshot: Path, driver: str) -> tuple[str, int]:
    """Return the file and the line of the class or function of the agent that drives."""
    kept = Snapshot(snapshot)
    try:
        agents = kept.settings.agents
        module, _, attribute = agents[driver or next(iter(agents))].agent.partition(":")
        for root in kept.code:
            for file in (
                Path(root, *module.split(".")).with_suffix(".py"),
                Path(root, *module.split("."), "__init__.py"),
            ):
                if file.is_file() and (name := _in_project(file)):
                    return name, _line_of(file, attribute)
    except (CrashhuntError, OSError, ValueError, KeyError, StopIteration):
        pass
    return "", 1


def _line_of(file: Path, attribute: str) -> int:
    for node in ast.parse(file.read_bytes()).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == attribute:
            return node.lineno
    return 1


def _in_project(file: PurePath) -> str:
    """Return the path of a file relative to its project; empty if the file belongs to no project."""
    parts = file.parts
    for place in range(len(parts) - 1, 2, -1):
        if parts[place - 1] == layout.CODE and parts[place - 3] == layout.SNAPSHOTS:
            if parts[place].startswith("@"):  # a work tree
                return "/".join(parts[place + 1 :])
            return "" if parts[place] == layout.PACKAGE.name else "/".join(parts[place:])
    here = Path.cwd()
    return file.relative_to(here).as_posix() if file.is_relative_to(here) else ""


# Results of hunts and corpora for CI: a summary in Markdown, and annotations in the syntax of GitHub's runners.

_MAX_ANNOTATIONS = 10  # annotations of each level that GitHub shows for one step
_MARKDOWN_SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|~])")
_ICONS = {"still": "💥", "changed": "🔀", "fixed": "✅", "cannot_run": "🚫"}


def crashes_summary(findings: Sequence[CrashFinding], *, compared: bool = False) -> str:
    """Return the crash types as a Markdown table, with one row for each crash type."""
    if not findings:
        return "### crashhunt: no crash was saved\n"
    crashes, new = sum(finding.group.count for finding in findings), sum(not finding.known for finding in findings)
    title = f"### crashhunt: {count_of(crashes, 'crash')} of {count_of(len(findings), 'type')}"
    lines = [f"{title}, {new} new" if compared else title, ""]
    names = ["crashes", "type", "at fault", "shortest", "steps", *(["in the corpus"] if compared else [])]
    lines += [row_of(names), row_of(["---:", "---", "---", "---", "---:", *(["---"] if compared else [])])]
    for finding in findings:
        group, shortest = finding.group, finding.group.shortest
        cells = [
            str(group.count),
            escaped(finding.title),
            fault_words(group.fault),
            f"`{shortest.id}`",
            str(shortest.result.steps),
        ]
        lines.append(row_of([*cells, *([f"`{finding.known}`" if finding.known else "**new**"] if compared else [])]))
    lines += ["", "The shortest crash of each type:", ""]
    for finding in findings:
        place = f" (`{finding.file}`, line {finding.line})" if finding.file else ""
        lines.append(f"- {escaped(finding.group.shortest.result.summary)}{place}")
    return "\n".join([*lines, ""])


def crash_annotations(findings: Sequence[CrashFinding]) -> list[str]:
    """Return a GitHub annotation command for each new crash type, at its line of code.

    GitHub shows at most ten annotations. If there are more, a notice gives the number shown and the total.
    """
    found = [
        annotation_of("error", finding.title, finding.message, finding.file, finding.line)
        for finding in findings
        if not finding.known
    ]
    return _limited(found, "new crash types")


def corpus_summary(reports: Sequence[CaseReport]) -> str:
    """Return the results of a corpus as Markdown. Unexpected results come first."""
    wrong = sum(not report.ok for report in reports)
    said = f"{wrong} {'is' if wrong == 1 else 'are'} not as expected" if wrong else "all as expected"
    lines = [f"### crashhunt corpus: {count_of(len(reports), 'case')}, {said}", ""]
    lines += [row_of(["", "case", "expected", "today", "what happens", "note"]), row_of(["---"] * 6)]
    for report in sorted(reports, key=lambda report: report.ok):
        got = report.got.replace("_", " ")
        today = got if report.ok else f"**{got}**"
        cells = [f"`{report.path}`", report.expected, today, escaped(report.now), escaped(report.note)]
        lines.append(row_of([_ICONS[report.got] if report.ok else "❌", *cells]))
    tighter = [report for report in reports if report.may_be_tightened]
    if tighter:
        lines += ["", "Fixed cases. Set `expect` to `fixed` in:"]
        lines += ["", *(f"- `{report.path / layout.CASE}`" for report in tighter)]
    return "\n".join([*lines, ""])


def corpus_annotations(reports: Sequence[CaseReport]) -> list[str]:
    """Return a GitHub annotation command for each corpus case with an unexpected result, and for each newly fixed case.

    GitHub shows at most ten annotations of each level. If there are more, a notice gives the number shown and the
    total.
    """
    found, tighter = [], []
    for report in sorted(reports, key=lambda report: report.ok):
        file = (report.path / layout.CASE).as_posix()
        if not report.ok:
            title, *words = report.describe().splitlines()
            found.append(annotation_of("error", title, "\n".join(words) or title, file, 1))
        elif report.may_be_tightened:
            words = ["Set expect = 'fixed', to be warned if it crashes again"]
            tighter.append(annotation_of("notice", f"{report.path.name}: is fixed", words[0], file, 1))
    return [*_limited(found, "cases that are not as expected"), *_limited(tighter, "fixed cases")]


def _limited(annotations: Sequence[str], what: str) -> list[str]:
    """Return at most ten annotations, and a notice if there were more."""
    shown, count = list(annotations[:_MAX_ANNOTATIONS]), len(annotations)
    if count <= _MAX_ANNOTATIONS:
        return shown
    said = f"{_MAX_ANNOTATIONS} of {count} {what} are annotated. The summary of the job has all of them."
    return [annotation_of("notice", f"{_MAX_ANNOTATIONS} of {count} {what} shown", said), *shown]


def row_of(cells: Sequence[str]) -> str:
    """Return a row of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def escaped(text: str) -> str:
    """Return text for Markdown with all special characters escaped."""
    return _MARKDOWN_SPECIAL.sub(r"\\\1", one_line(text))


def annotation_of(level: str, title: str, message: str, file: str = "", line: int = 1) -> str:
    """Return a GitHub annotation command, at a line of a file if one is given."""
    place = f"file={_value(file)},line={line}," if file else ""
    return f"::{level} {place}title={_value(title)}::{_data(message)}"


def _data(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _value(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")


# Crash types as SARIF 2.1.0 (OASIS), which GitHub code scanning and editors read: one alert for each type.

_HOME_URL = "https://github.com/crashhunt/crashhunt"
_RULES = {
    "collision": "A controlled vehicle and another actor touched",
    "off_road": "A controlled vehicle left the road",
    "agent_error": "The agent raised an exception, or returned an invalid action",
    "simulator_error": "The simulator failed during an episode",
    "process_died": "The process of a trial died",
    "hang": "A trial took longer than its wall-clock limit",
}


def write_sarif(findings: Sequence[CrashFinding], target: Path) -> None:
    """Write crash types as a SARIF file. An existing file is replaced. The file is never incomplete.

    Each alert belongs to a line of the agent's code. If that line is unknown, the alert belongs to the settings of the
    hunt. The fingerprint identifies the crash type, so that a comparison of two files shows which alerts are new. The
    alert of a crash type that a corpus contains has the level "note".

    Raises:
        HuntDirectoryError: the file cannot be written.
    """
    rules = list(dict.fromkeys(finding.rule for finding in findings))
    driver = {
        "name": "crashhunt",
        "version": __version__,
        "informationUri": _HOME_URL,
        "rules": [
            {
                "id": rule,
                "shortDescription": {"text": _RULES.get(rule, rule.replace("_", " ").capitalize())},
                "helpUri": f"{_HOME_URL}/blob/main/crashhunt/guide/reference/outcomes.md",
            }
            for rule in rules
        ],
    }
    results = [_result(finding, rules.index(finding.rule)) for finding in findings]
    found = {
        "$schema": "https://json.schemastore.org/sarif-2.1.0.json",
        "version": "2.1.0",
        "runs": [{"tool": {"driver": driver}, "columnKind": "unicodeCodePoints", "results": results}],
    }
    with output_file(target) as temporary:
        temporary.write_text(json.dumps(found, indent=1), encoding="utf-8")


def _result(finding: CrashFinding, rule: int) -> dict[str, object]:
    uri = quote(finding.file) or _settings(finding.group.shortest.hunt)
    place = {"artifactLocation": {"uri": uri}, "region": {"startLine": finding.line}}
    return {
        "ruleId": finding.rule,
        "ruleIndex": rule,
        "level": "note" if finding.known else "error",
        "message": {"text": f"{finding.title}: {finding.message}"},
        "locations": [{"physicalLocation": place}],
        # GitHub compares the second fingerprint. Without it, the alert would be new whenever its line number changes.
        "partialFingerprints": {
            "crashhuntKind/v1": finding.fingerprint,
            "primaryLocationLineHash": f"{finding.fingerprint}:1",
        },
        "properties": {
            "crashes": finding.group.count,
            "fault": finding.group.fault,
            "known": finding.known,
            **({"preventable_by": answers} if (answers := finding.group.preventable_by) is not None else {}),
        },
    }


def _settings(hunt: Path) -> str:
    """Return the settings file of a hunt: a path relative to the current directory, or a URI if it lies elsewhere."""
    file, here = (hunt / layout.HUNT).resolve(), Path.cwd().resolve()
    return quote(file.relative_to(here).as_posix()) if file.is_relative_to(here) else file.as_uri()
