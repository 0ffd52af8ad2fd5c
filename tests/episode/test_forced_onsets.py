"""Copies with a forced first onset: that they crash from the start as they did, change nothing, and leave nothing."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from single_threaded import answer_of

from crashhunt.episode import OnsetForcer
from crashhunt.trial import CRASHES, Outcome, TrialResult, TrialSpec


@pytest.fixture
def ask(tmp_path):
    """Asks a process of one thread."""
    return lambda what: answer_of("forcing", what, tmp_path)


NIGHTLY = [pytest.param(name, marks=pytest.mark.nightly) for name in ("loop", "merge")]


@pytest.mark.parametrize("scenario", ["toy", *NIGHTLY])
def test_copies_of_a_root_crash_from_the_start_as_they_did_and_change_nothing(ask, scenario):
    found = ask(scenario)
    assert found["same"]
    assert found["again"]
    assert found["left"] == 0
    assert found["plain"] is None  # a trial without a forcing is no root
    forced = found["forced"]
    assert forced["survival"] + math.fsum(forced["masses"].values()) == pytest.approx(1.0)
    assert "unanswered" not in forced
    crashes = [one for one in forced["copies"] if one["crash"]]
    assert found["starts"] == [[one["crash"], one["step"], one["disturbed"]] for one in crashes]
    steps = sum(one["step"] - one["branched"] for one in forced["copies"])
    assert forced["steps"] == found["other_steps"] == steps
    for one in forced["copies"]:
        kind = one.get("second") or one["cell"]
        assert one["onset"] - one["branched"] == (2 if kind.startswith("late_observation") else 1)
        assert one["step"] == 150 - 30 * (scenario == "toy") or one["crash"]  # never to a horizon
    for onset, within, ended in found["late"]:  # no second onset from the step after the first to the last one
        assert within == pytest.approx((1 - found["chance"]) ** (ended - onset))
    if scenario != "merge":
        assert crashes
        firsts = [one for one in forced["copies"] if not one.get("second")]
        seconds = [one for one in forced["copies"] if one.get("second")]
        assert all(one.get("within", 1.0) < 1.0 for one in firsts if one["onset"] < one["step"] - 1)
        assert len(firsts) - 1 <= len(seconds) <= 3 * len(firsts)
        weights = {one["weight"] / one["within"] for one in forced["copies"] if one.get("within")}
        assert list(weights) == pytest.approx([found["spacing"]] * len(weights))
        weights = {weight for cell, weight in found["proposed"] if cell == "stop=6.0"}
        assert list(weights) == pytest.approx([found["spacing"] / 4] * len(weights))


def test_root_with_a_copy_that_hangs_or_dies_is_incomplete(ask):
    found = ask("lost")
    outcome, left, asked, again, forced = found["hangs"]
    assert (outcome, left, asked, again) == ("survived", 0, False, False)
    assert (forced["why_unanswered"], forced["copies"]) == ("a copy took longer than 0.3 s", [])
    outcome, left, asked, again, forced = found["dies"]
    assert (outcome, left, asked, again) == ("survived", 0, False, True)  # a resumed hunt runs it again
    assert forced["why_unanswered"] == "a copy was killed by SIGKILL"


END = {"step": 40, "within": 1.0, "branched": 10}


@pytest.mark.parametrize(("answer", "why", "again"), [
    ({"lost": "a copy was killed", "is_from_outside": True}, "a copy was killed", True),
    ({"lost": "a copy failed", "is_from_outside": False}, "a copy failed", False),
    ({"ends": [END | {"outcome": "simulator_error"}]}, "a copy ended by simulator_error", False),
    ({"ends": [END | {"outcome": "invalid"}]}, "a copy ended by invalid", False),
])  # fmt: skip
def test_root_with_a_copy_without_result_is_incomplete(answer, why, again):
    forcer = OnsetForcer(("brake=0.05",), CRASHES, 1.0, lambda _: None)
    forcer._onsets = SimpleNamespace(following=lambda _: None, survival=0.5, masses={})
    forcer.fork_runner.run = lambda _: answer
    forcer._follow(None, None)
    forced = forcer.result(TrialResult(TrialSpec(0, 1, {}, {}, 99), Outcome.SURVIVED)).forced
    assert (forced.unanswered, forced.why_unanswered, forced.may_be_asked_again, forced.copies) == (1, why, again, ())
