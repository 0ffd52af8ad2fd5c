"""What hunts and corpora have found, for a CI: a summary in Markdown, and annotations as GitHub's runners read them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.text import one_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.corpus import CaseReport
    from crashhunt.report._findings import Finding

__all__ = ["corpus_annotations", "corpus_summary", "crash_annotations", "crashes_summary"]

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
