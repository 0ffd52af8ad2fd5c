"""The screen of a gate."""

from __future__ import annotations

from crashhunt.estimation import GateReport
from crashhunt.rates import Interval
from crashhunt.report import describe_gate


def test_lines_of_a_verdict_fit_a_terminal_of_80_columns():
    found = GateReport(
        verdict="worse", base="planners:Long", head="planners:Short", pairs=12_138, only_base=1002, only_head=1013,
        both=1003, evidence=1.23e21, difference=Interval(-0.0174, 0.1942), seed=26, dir="kept",
    )  # fmt: skip
    text = describe_gate(found)
    assert max(map(len, text.splitlines())) <= 80
    for part in ("12,138 pairs:", "evidence: 1.23e+21; 20 decides", "-1.74% to +19.42%", "HEAD minus BASE"):
        assert part in text
