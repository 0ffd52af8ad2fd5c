"""What a CI is told: a summary in Markdown, annotations as GitHub's runners read them, SARIF; what a corpus knows."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt.corpus import Case, CaseReport
from crashhunt.corpus._cases import cases_of_type
from crashhunt.crashes import Bundle, Group, Signature
from crashhunt.report import (
    corpus_annotations,
    corpus_summary,
    crash_annotations,
    crashes_summary,
    findings_of,
    write_sarif,
)
from crashhunt.trial import Collision, Failure, Outcome, TrialResult, TrialSpec

CODE = "hunts/h/snapshots/abc/code"
TRACEBACK = f"""Traceback (most recent call last):
  File "/x/site-packages/crashhunt/episode/_episode.py", line 177, in step
    action = agent.act(observation)
  File "/{CODE}/@repo/src/my planner.py", line 13, in act
    return self.plan(observation)
  File "/x/site-packages/numpy/linalg.py", line 99, in solve
    raise ValueError("50 %, or: |")
ValueError: 50 %, or: |
"""


def group(signature, folder, *, number=3, failure=None, summary=""):
    hit = None if failure else Collision("ego", "collider", "ego", "a|b", ("overlap",), "collision", 1.0, 2.0)
    outcome = Outcome.AGENT_ERROR if failure else Outcome.COLLISION
    result = TrialResult(TrialSpec(number, 1, {"ego": {}}, {}, max_steps=9), outcome, 5, collision=hit, failure=failure)
    bundle = Bundle(folder / "crashes" / f"00000{number}-{outcome}", result, 1, "abc", None)
    return Group(signature, (bundle,), ("ego",), dropped=2)


@pytest.fixture
def groups(tmp_path):
    failure = Failure("ValueError", "50 %, or: |", TRACEBACK, "ego")
    return [
        group(Signature("collision", "collider", "rear end"), tmp_path),
        group(
            Signature("agent_error", manner="ValueError", where="my planner.py:act"),
            tmp_path,
            number=4,
            failure=failure,
        ),
    ]


def test_a_failure_is_reported_where_it_was_in_the_agents_code(groups):
    collision, fault = findings_of(groups)
    assert (fault.file, fault.line) == ("src/my planner.py", 13)  # not NumPy's, into which it called
    assert (collision.file, collision.line) == ("", 1)  # there is no snapshot
    lines = crash_annotations([collision, fault])
    assert lines[0].startswith("::error title=rear end%2C the agent into the other::ego drove into a|b at step 5.")
    assert " At fault: the agent. " in lines[0]
    assert lines[1].startswith("::error file=src/my planner.py,line=13,title=ValueError in my planner.py%3Aact::")
    assert "50 %25, or: |" in lines[1]
    notice, *shown = crash_annotations([fault] * 12)
    assert notice.startswith("::notice title=10 of 12 new crash types shown::")
    assert len(shown) == 10


def test_the_same_kind_has_the_same_fingerprint_and_another_has_another(groups, tmp_path):
    first, second = (finding.fingerprint for finding in findings_of(groups))
    again = group(groups[0].signature, tmp_path / "elsewhere", number=5)
    assert findings_of([again])[0].fingerprint == first != second


def test_the_place_of_a_collision_is_where_the_agent_is_defined(tmp_path, groups, monkeypatch):
    snapshot = tmp_path / "snapshots" / "abc"
    code = snapshot / "code" / "@repo" / "pkg"
    code.mkdir(parents=True)
    (code / "planner.py").write_text("import os\n\n\nclass Other: ...\n\n\nclass Planner: ...\n")

    class Kept:
        def __init__(self, path):
            assert path == snapshot
            self.code = (str(snapshot / "code"), str(code))

        @property
        def settings(self):
            driver = type("Driver", (), {"agent": "planner:Planner"})
            return type("Settings", (), {"agents": {"ego": driver}})

    monkeypatch.setattr("crashhunt.report._ci_findings.Snapshot", Kept)
    (finding,) = findings_of(groups[:1])
    assert (finding.file, finding.line) == ("pkg/planner.py", 7)


def test_the_summary_is_a_table_that_nothing_breaks(groups):
    summary = crashes_summary(findings_of(groups))
    assert summary.startswith("### crashhunt: 6 crashes of 2 types\n")
    assert "ego drove into a\\|b" in summary
    rows = [line for line in summary.splitlines() if line.startswith("| ")]
    assert len(rows) == 4
    assert {row.replace("\\|", "").count("|") for row in rows} == {6}
    assert [row.split(" | ")[-3] for row in rows[-2:]] == ["the agent"] * 2  # which may have another name than ego
    compared = crashes_summary(findings_of(groups, {groups[0].signature: "kept/one"}), compared=True)
    assert "2 types, 1 new" in compared
    assert "| `kept/one` |" in compared
    assert crashes_summary([]) == "### crashhunt: no crash was saved\n"


def test_sarif_has_an_alert_a_kind_with_a_place_and_known_ones_are_notes(groups, tmp_path):
    target = tmp_path / "x.sarif"
    write_sarif(findings_of(groups, {groups[0].signature: "kept/one"}), target)
    found = json.loads(target.read_text())
    (run,) = found["runs"]
    assert found["version"] == "2.1.0"
    rules = [rule["id"] for rule in run["tool"]["driver"]["rules"]]
    assert [(one["level"], rules[one["ruleIndex"]]) for one in run["results"]] == [
        ("note", "collision"), ("error", "agent_error"),
    ]  # fmt: skip
    first, second = (one["locations"][0]["physicalLocation"] for one in run["results"])
    assert first["artifactLocation"]["uri"].endswith("/hunt.toml")
    assert second == {"artifactLocation": {"uri": "src/my%20planner.py"}, "region": {"startLine": 13}}
    assert all(one["partialFingerprints"]["primaryLocationLineHash"] for one in run["results"])


def test_a_place_that_no_one_knows_is_the_hunt_however_it_was_given(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    signature, uris = Signature("collision", "collider", "rear end"), []
    for hunt in (Path("a b"), tmp_path / "here" / "a b", Path("../here/a b"), tmp_path / "a b"):
        write_sarif(findings_of([group(signature, hunt)]), tmp_path / "x.sarif")
        (one,) = json.loads((tmp_path / "x.sarif").read_text())["runs"][0]["results"]
        uris.append(one["locations"][0]["physicalLocation"]["artifactLocation"]["uri"])
    assert uris == [*["a%20b/hunt.toml"] * 3, (tmp_path / "a b" / "hunt.toml").as_uri()]


def test_a_corpus_knows_what_is_expected_to_crash_still(groups):
    signature = groups[0].signature
    case = Case(Path("kept/one"), "still", "", "", dict(signature.to_json()))
    assert cases_of_type(signature, [case]) == [case]
    assert cases_of_type(groups[1].signature, [case]) == []
    assert cases_of_type(signature, [replace(case, expect="fixed")]) == []
    assert cases_of_type(signature, [replace(case, signature={})]) == []
    assert cases_of_type(replace(signature, lane_change="agent"), [case]) == []


def test_cases_that_are_not_as_expected_come_first_and_are_reported_next_to_their_files():
    fine = CaseReport(Path("kept/a"), "still", "still", "x", "x", "a | note")
    wrong = CaseReport(Path("kept/b"), "fixed", "changed", "it was", "ValueError: 5 %")
    better = CaseReport(Path("kept/c"), "still", "fixed")
    summary = corpus_summary([fine, wrong, better])
    assert summary.startswith("### crashhunt corpus: 3 cases, 1 is not as expected\n")
    rows = [line for line in summary.splitlines() if line.startswith("| ")]
    assert "kept/b" in rows[2]
    assert "a \\| note" in summary
    assert "- `kept/c/crashhunt-case.toml`" in summary
    error, notice = corpus_annotations([fine, wrong, better])
    assert error.startswith(
        "::error file=kept/b/crashhunt-case.toml,line=1,title=b%3A crashes in another way%2C and fixed"
    )
    assert "now:    ValueError: 5 %25" in error
    assert notice.startswith("::notice file=kept/c/")
