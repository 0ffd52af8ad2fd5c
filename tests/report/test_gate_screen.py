"""The screen of a gate."""

from __future__ import annotations

from types import SimpleNamespace

from crashhunt.estimation import GateReport
from crashhunt.rates import Interval
from crashhunt.report import describe_gate
from crashhunt.report._gate import _rate


def test_lines_of_a_verdict_fit_a_terminal_of_80_columns():
    found = GateReport(
        verdict="worse", base="planners:Long", head="planners:Short", pairs=12_138, only_base=1002, only_head=1013,
        both=1003, evidence=1.23e21, difference=Interval(-0.0174, 0.1942), seed=26, dir="kept",
    )  # fmt: skip
    text = describe_gate(found)
    assert max(map(len, text.splitlines())) <= 80
    for part in ("12,138 pairs:", "evidence: 1.23e+21; 20 decides", "-1.74% to +19.42%", "HEAD minus BASE"):
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
