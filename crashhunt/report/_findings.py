"""A kind of crashes as something to be told at a place in the agent's code: for reviews, alerts and summaries."""

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
from crashhunt.base.files import whole_file
from crashhunt.base.text import one_line
from crashhunt.base.version import __version__
from crashhunt.crashes import own_frames
from crashhunt.snapshots import Snapshot

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.corpus import CaseReport
    from crashhunt.crashes import Bundle, Group, Signature


__all__ = [
    "Finding",
    "corpus_annotations",
    "corpus_summary",
    "crash_annotations",
    "crashes_summary",
    "findings_of",
    "write_sarif",
]


@dataclass(frozen=True, slots=True)
class Finding:
    """A kind of crashes, and where to tell it.

    Args:
        rule: the outcome, such as ``collision``.
        title: of the kind.
        message: what happened in the shortest example, and how to look at it.
        file: the agent's, relative to its project; empty where nobody knows.
        line: of the file, from 1: that of the failure, else the one in which the agent is defined.
        fingerprint: the same for the same kind, whenever it is found.
        known: the case of a corpus that is the same; empty for none.
        group: the crashes.
    """

    rule: str
    title: str
    message: str
    file: str
    line: int
    fingerprint: str
    known: str
    group: Group


def findings_of(groups: Sequence[Group], known: Mapping[Signature, str] | None = None) -> list[Finding]:
    """Return the kinds of crashes, in the order of their groups; no code of theirs is run.

    Args:
        groups: of the crashes.
        known: the cases of a corpus by kind.
    """
    found = []
    for group in groups:
        example = group.shortest
        file, line = _place(example)
        count = "1 crash" if group.count == 1 else f"{group.count} crashes"
        fault = f" At fault: {group.fault}." if group.fault not in ("", "nobody can tell") else ""
        message = f"{example.result.summary}.{fault} {count}; look at it: crashhunt show {example.path}"
        found.append(
            Finding(
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
    """Where in the agent's project to tell of a crash."""
    failure = bundle.result.failure
    for frame in own_frames(failure) if failure is not None else ():
        if name := _in_project(frame.file):
            return name, frame.line
    return _definition(bundle.hunt / layout.SNAPSHOTS / bundle.snapshot, bundle.driver)


@cache
def _definition(snapshot: Path, driver: str) -> tuple[str, int]:
    """Where the class or function is that drives."""
    kept = Snapshot(snapshot)
    try:
        agents = kept.settings().agents
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
    """The name of a file in the project that it is of: of a snapshot's, where it was; empty where it is of none."""
    parts = file.parts
    for place in range(len(parts) - 1, 2, -1):
        if parts[place - 1] == layout.CODE and parts[place - 3] == layout.SNAPSHOTS:
            if parts[place].startswith("@"):  # a work tree
                return "/".join(parts[place + 1 :])
            return "" if parts[place] == layout.PACKAGE.name else "/".join(parts[place:])
    here = Path.cwd()
    return file.relative_to(here).as_posix() if file.is_relative_to(here) else ""


# What hunts and corpora have found, for a CI: a summary in Markdown, and annotations as GitHub's runners read them.

_MOST = 10  # annotations of one step that GitHub shows
_SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|~])")
_ICONS = {"still": "💥", "changed": "🔀", "fixed": "✅", "cannot_run": "🚫"}


def crashes_summary(findings: Sequence[Finding], *, compared: bool = False) -> str:
    """Return the kinds of crashes as Markdown, a row each.

    Args:
        findings: the kinds.
        compared: whether it was looked up which of them a corpus has.
    """
    if not findings:
        return "### crashhunt: no crash was saved\n"
    crashes, new = sum(finding.group.count for finding in findings), sum(not finding.known for finding in findings)
    title = f"### crashhunt: {_count(crashes, 'crash', 'crashes')} of {_count(len(findings), 'kind', 'kinds')}"
    lines = [f"{title}, {new} new" if compared else title, ""]
    names = ["crashes", "kind", "at fault", "shortest", "steps", *(["in the corpus"] if compared else [])]
    lines += [_row(names), _row(["---:", "---", "---", "---", "---:", *(["---"] if compared else [])])]
    for finding in findings:
        group, shortest = finding.group, finding.group.shortest
        cells = [str(group.count), _plain(finding.title), group.fault, f"`{shortest.id}`", str(shortest.result.steps)]
        lines.append(_row([*cells, *([f"`{finding.known}`" if finding.known else "**new**"] if compared else [])]))
    lines += ["", "The shortest of each kind:", ""]
    for finding in findings:
        place = f" (`{finding.file}`, line {finding.line})" if finding.file else ""
        lines.append(f"- {_plain(finding.group.shortest.result.summary)}{place}")
    return "\n".join([*lines, ""])


def crash_annotations(findings: Sequence[Finding]) -> list[str]:
    """Return a command of GitHub's for each kind that is new, at its place in the code; of many, the first ten."""
    return [
        _command("error", finding.title, finding.message, finding.file, finding.line)
        for finding in findings
        if not finding.known
    ][:_MOST]


def corpus_summary(reports: Sequence[CaseReport]) -> str:
    """Return what came of the cases of a corpus as Markdown, those first that are not as expected."""
    wrong = sum(not report.ok for report in reports)
    said = f"{_count(wrong, 'is', 'are')} not as expected" if wrong else "all as expected"
    lines = [f"### crashhunt corpus: {_count(len(reports), 'case', 'cases')}, {said}", ""]
    lines += [_row(["", "case", "expected", "today", "what happens", "note"]), _row(["---"] * 6)]
    for report in sorted(reports, key=lambda report: report.ok):
        got = report.got.replace("_", " ")
        today = got if report.ok else f"**{got}**"
        cells = [f"`{report.path}`", report.expected, today, _plain(report.now), _plain(report.note)]
        lines.append(_row([_ICONS[report.got] if report.ok else "❌", *cells]))
    tighter = [report for report in reports if report.may_be_tightened]
    if tighter:
        lines += ["", "Fixed, and may be tightened: `expect` may say `fixed` in"]
        lines += ["", *(f"- `{report.path / layout.CASE}`" for report in tighter)]
    return "\n".join([*lines, ""])


def corpus_annotations(reports: Sequence[CaseReport]) -> list[str]:
    """Return a command of GitHub's for each case that is not as expected, or that may be tightened."""
    found = []
    for report in sorted(reports, key=lambda report: report.ok):
        file = (report.path / layout.CASE).as_posix()
        if not report.ok:
            title, *words = report.describe().splitlines()
            found.append(_command("error", title, "\n".join(words) or title, file, 1))
        elif report.may_be_tightened:
            words = ["it does not crash any more: expect may say fixed"]
            found.append(_command("notice", f"{report.path.name}: may be tightened", words[0], file, 1))
    return found[:_MOST]


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _plain(text: str) -> str:
    """Words as Markdown, in which no character means anything."""
    return _SPECIAL.sub(r"\\\1", one_line(text))


def _command(level: str, title: str, message: str, file: str, line: int) -> str:
    place = f"file={_value(file)},line={line}," if file else ""
    return f"::{level} {place}title={_value(title)}::{_data(message)}"


def _data(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _value(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")


# Kinds of crashes as SARIF 2.1.0 (OASIS), which GitHub's code scanning and editors read: an alert a kind.

_HOME = "https://github.com/crashhunt/crashhunt"
_RULES = {
    "collision": "A controlled vehicle and another actor touched",
    "off_road": "A controlled vehicle left the road",
    "agent_error": "The agent raised an exception, or gave an action that is none",
    "simulator_error": "The simulator gave up in the middle of an episode",
    "process_died": "The process of a trial died",
    "hang": "A trial took longer than its wall-clock limit",
}


def write_sarif(findings: Sequence[Finding], target: Path) -> None:
    """Write kinds of crashes, all of it or nothing; what is there is replaced.

    Each is at a place in the agent's code; where nobody knows it, at the settings of its hunt. Its fingerprint is that
    of the kind, so that whoever compares two such files knows which alerts are new. Kinds that a corpus has are notes.

    Raises:
        HuntDirectoryError: the file cannot be written.
    """
    rules = list(dict.fromkeys(finding.rule for finding in findings))
    driver = {
        "name": "crashhunt",
        "version": __version__,
        "informationUri": _HOME,
        "rules": [
            {
                "id": rule,
                "shortDescription": {"text": _RULES.get(rule, rule.replace("_", " ").capitalize())},
                "helpUri": f"{_HOME}/blob/main/crashhunt/guide/reference/outcomes.md",
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
    with whole_file(target) as temporary:
        temporary.write_text(json.dumps(found, indent=1), encoding="utf-8")


def _result(finding: Finding, rule: int) -> dict[str, object]:
    uri = quote(finding.file) or _settings(finding.group.shortest.hunt)
    place = {"artifactLocation": {"uri": uri}, "region": {"startLine": finding.line}}
    return {
        "ruleId": finding.rule,
        "ruleIndex": rule,
        "level": "note" if finding.known else "error",
        "message": {"text": f"{finding.title}: {finding.message}"},
        "locations": [{"physicalLocation": place}],
        # The second one is what GitHub goes by: without it, another line of code would be another alert.
        "partialFingerprints": {
            "crashhuntKind/v1": finding.fingerprint,
            "primaryLocationLineHash": f"{finding.fingerprint}:1",
        },
        "properties": {"crashes": finding.group.count, "fault": finding.group.fault, "known": finding.known},
    }


def _settings(hunt: Path) -> str:
    """Where the settings of a hunt are: from here, and as a whole where they are elsewhere."""
    file, here = (hunt / layout.HUNT).resolve(), Path.cwd().resolve()
    return quote(file.relative_to(here).as_posix()) if file.is_relative_to(here) else file.as_uri()
