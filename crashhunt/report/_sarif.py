"""Kinds of crashes as SARIF 2.1.0 (OASIS), which GitHub's code scanning and editors read: an alert a kind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from crashhunt.base import layout
from crashhunt.base.files import whole_file
from crashhunt.base.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.report._findings import Finding

__all__ = ["write_sarif"]

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
