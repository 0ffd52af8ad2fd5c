"""What the end of a hunt says of its probes and branches, and of those that have no answer."""

from __future__ import annotations

from contextlib import closing
from types import SimpleNamespace

from crashhunt.hunts._reports import BranchReport, ProbeReport
from crashhunt.ledger import Ledger
from crashhunt.report._disturbance_words import describe_branches, describe_probes
from crashhunt.report._page import _trials
from crashhunt.trial import Outcome, Stress, TrialResult, TrialSpec

WHY = "a copy was killed by SIGKILL"


def probed(*margins, open_ones=0, run_again=0, not_finished=0):
    sums = {"not_fully_asked": open_ones, "probes": 62, "steps": 2751, "left_out": 0}
    why = WHY if open_ones else ""
    return SimpleNamespace(probes=ProbeReport(sums, margins, why, run_again, not_finished, (), ()), trial_steps=900)


def test_nothing_plausible_made_them_crash_is_said_of_fully_asked_trials_only():
    assert describe_probes(probed(0.25, 1.0, 1.0, open_ones=2)) == [
        "Robustness margin of 3 trials: least 0.25, median 1.00; 2 of them crashed under no plausible disturbance.",
        "  2 trials were not fully probed: a copy was killed by SIGKILL",
        "  62 probes took 2751 steps, in addition to 900 steps of trials",
    ]
    assert describe_probes(probed(open_ones=1))[:2] == [
        "Robustness margin: no trial was fully probed.",
        "  1 trial was not fully probed: a copy was killed by SIGKILL",
    ]
    assert describe_probes(probed()) == []


def test_what_could_not_be_run_from_the_start_is_distinguished_from_what_did_not_crash():
    line = describe_probes(probed(0.25, run_again=3, not_finished=1))[-1]
    assert line == ("  crashes by the mildest disturbance that reproduce from the start: 0 of 3, and 1 did not finish:")
    sums = {"trials": 8, "moments": 133, "branches": 163, "steps": 8163, "left_out": 28, "crashed": 13,
            "crashed_trials": 5, "not_fully_asked": 1}  # fmt: skip
    branched = BranchReport(sums, WHY, 5, 2, ())
    lines = describe_branches(SimpleNamespace(branches=branched, trial_steps=2400))
    assert lines[1].endswith("; 28 more were skipped, because the step budget of their trials was used up")
    assert lines[2] == "  1 trial was not fully probed: a copy was killed by SIGKILL"
    assert lines[3] == "  likeliest crashes that reproduce from the start: 0 of 5, and 2 did not finish:"


def test_page_counts_trials_that_are_not_fully_asked_apart_from_the_least_margin(tmp_path):
    half = Stress(None, moments=9, moments_asked=1, margin_upper_bound=0.125)
    with closing(Ledger(tmp_path / "ledger.sqlite", writable=True)) as ledger:
        for number, stress in enumerate([Stress(0.5, moments=9, moments_asked=9), half, None]):
            spec = TrialSpec(number, number, {}, {}, max_steps=20)
            ledger.record(TrialResult(spec, Outcome.SURVIVED, steps=20, stress=stress), snapshot="")
    found = _trials(tmp_path, SimpleNamespace(crash_on=("collision",)))
    assert (found["stress"], found["not_fully_asked"]) == ({"margin": 0.5, "trial": 0}, 1)
