"""The screen of a gate."""

from __future__ import annotations

from types import SimpleNamespace

from crashhunt.report import describe_gate, gate_summary
from crashhunt.report._gate_report import _rate
from crashhunt.statistics import GateReport, Interval, SideCounts
from crashhunt.statistics._hunt_pairs import ScenarioCounts


def test_lines_of_a_verdict_fit_a_terminal_of_80_columns():
    found = GateReport(
        verdict="worse", base="planners:Long", head="planners:Short", pairs=12_138, only_base=1002, only_head=1013,
        both=1003, evidence=1.23e21, difference=Interval(-0.0174, 0.1942), seed=26, dir="kept",
    )  # fmt: skip
    text = describe_gate(found)
    assert max(map(len, text.splitlines())) <= 80
    for part in ("12,138 pairs:", "evidence: 1.23e21; 20 decides", "-0.0174 to +0.194 crashes", "HEAD minus BASE"):
        assert part in text


def test_rate_of_a_side_has_its_interval_or_the_reason_why_not():
    rate = {"crashes": 1, "trials": 1200, "excluded": {}, "certain": Interval(0.001, 0.02), "why_not": ""}
    assert _rate(SimpleNamespace(**rate)).startswith("1 crash in 1,200 trials, ")
    assert _rate(SimpleNamespace(**rate)).endswith(" per trial")
    none = rate | {"crashes": 3, "certain": None, "why_not": "no trial is valid", "excluded": {"trained_on": 7}}
    found = _rate(SimpleNamespace(**none))
    assert found.startswith("3 crashes in 1,200 trials (")
    assert "7" in found
    assert found.endswith(", no rate: no trial is valid")


def test_rate_of_a_killed_version_excludes_later_trials():
    rate = {"crashes": 1, "trials": 13, "certain": Interval(0.001, 0.02), "why_not": ""}
    rates = (
        SimpleNamespace(**rate, excluded={"after_unfinished": 1}),
        SimpleNamespace(**rate, excluded={"after_unfinished": 140, "invalid": 2}),
    )
    text = describe_gate(report(head=SideCounts(killed=3), rates=rates))
    assert "BASE: 1 crash in 13 trials, at least 0.001, at most 0.02 per trial\n" in text
    assert (
        "HEAD: 1 crash in 13 trials and 2 invalid, at least 0.001, at most 0.02 per trial; 140 trials after a" in text
    )


def report(verdict="worse", *, base=None, head=None, invalid=0, types=None, **more):
    """Return a gate's report on two hunts, with the given sides in the second."""
    counts = {"pairs": 60, "only_base": 0, "only_head": 8, "both": 1}
    sides = base or SideCounts(), head or SideCounts()
    scenarios = (
        ScenarioCounts(name="a", **counts),
        ScenarioCounts(name="b", **counts, invalid=invalid, sides=sides, types=types or {}),
    )
    given = {"difference": Interval(0.004, 0.2), "scenarios": scenarios, **more}
    return GateReport(verdict=verdict, base="m:Old", head="m:New", evidence=31.5, **counts, **given)


def test_trials_that_do_not_start_or_have_no_result_are_counted_with_their_reason():
    head = SideCounts(not_started=8, example="trial 3: ValueError: no weights (ego, reset)")
    base = SideCounts(killed=2, unknown=1, example="trial 7: killed from outside 3 times")
    found = report(head=head, base=base, invalid=1)
    counts = found.to_json()
    assert (counts["invalid"], counts["not_started"]) == (1, {"base": 0, "head": 8})
    assert (counts["killed"], counts["unknown"]) == ({"base": 2, "head": 0}, {"base": 1, "head": 0})
    assert counts["scenarios"][1]["not_started"] == {"base": 0, "head": 8}
    for text in (describe_gate(found), gate_summary(found).replace("\\", "")):
        for part in (
            "worse: HEAD m:New fails more often than BASE m:Old",
            "HEAD does not start in 8 of these pairs, which count as failures (trial 3: ValueError: no weights",
            "3 pairs without a result: BASE was killed from outside in 2 and could not be set up in 1 (trial 7: killed",
            "; the verdict holds for any result",
            "1 pair not counted: the trial is invalid with both versions",
        ):
            assert part in text
    assert "difference: +0.004 to +0.2 failures per trial" in describe_gate(found)
    assert "60 pairs: 0 fail only with BASE, 8 only with HEAD, 1 with both" in describe_gate(found)
    assert "the verdict must hold for any result" in describe_gate(report("undecided", base=base))
    assert "60 pairs: 0 crash only with BASE" in describe_gate(report())


def test_crash_types_that_only_one_version_has_are_named():
    types = {"A": (10, 0), "B": (0, 10), "both": (1, 1), "C": (0, 1), "D": (0, 2), "E": (0, 1)}
    found = report("no_difference", types=types, margin=0.05)
    for text in (describe_gate(found), gate_summary(found)):
        assert "crash type only with BASE: A (10 crashes)" in text
        assert "crash types only with HEAD: B (10 crashes), D (2 crashes), C (1 crash) and 1 more" in text
    assert {"type": "both", "base": 1, "head": 1} in found.to_json()["crash_types"]
    assert "crash type" not in describe_gate(report(types={"both": (1, 1)}))


def test_interval_of_a_verdict_shows_on_which_side_of_0_it_lies():
    assert "difference: +4e-6 to +0.2 crashes" in describe_gate(report(difference=Interval(4e-6, 0.2)))
    assert "difference: -0.2 to -4e-6 crashes" in describe_gate(report("better", difference=Interval(-0.2, -4e-6)))


def test_cautions_are_on_the_screen_and_in_the_summary():
    caution = "BASE and HEAD use the same file: /opt/planner (ego.binary)"
    found = report(cautions=(caution,))
    assert f"but {caution}" in describe_gate(found)
    assert caution.replace("_", "\\_") in gate_summary(found)
    assert found.to_json()["cautions"] == [caution]
