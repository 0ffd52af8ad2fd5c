"""Which hunts run the trials again that could not be set up: those that have not found what they were after."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import pytest

from crashhunt.base import layout
from crashhunt.ledger import Ledger
from crashhunt.plans import HuntSettings, RunSettings, write_settings
from crashhunt.results import HuntState
from crashhunt.suites._hunt_reruns import _replace_invalid
from crashhunt.trial import Failure, Outcome, TrialResult, TrialSpec


@pytest.mark.parametrize(
    ("run", "ended", "again"),
    [
        ({}, "crash", 0),
        ({}, "interrupted", 0),  # while it saved its crash
        ({"keep_going": True}, "all_trials", 1),
        ({"keep_going": True, "distinct": 1}, "distinct", 0),
        ({"only_at_fault": True}, "crash", 0),
        ({"only_at_fault": True}, "all_trials", 1),  # the crash was another's fault
        ({"only_at_fault": True}, "interrupted", 1),
        ({"only_at_fault": True, "keep_going": True, "distinct": 1}, "all_trials", 1),
    ],
)
def test_the_one_that_has_not_found_what_it_was_after_tries_them_again(tmp_path, run, ended, again):
    settings = HuntSettings(scenario="toy", scenario_digest="0", trials=3, max_steps=9, seed=1, run=RunSettings(**run))
    write_settings(tmp_path / layout.HUNT, settings, ["crashhunt", "run"])
    with closing(Ledger(tmp_path / layout.LEDGER, writable=True)) as ledger:
        failure = Failure("invalid", "it does not fit")
        ledger.record(TrialResult(TrialSpec(0, 1, {}, {}, 9), Outcome.INVALID, steps=0, failure=failure), snapshot="0")
        ledger.enter(ended)
    kinds = [{"words": "rear end", "count": 1, "first": "000001-collision", "shortest": "000001-collision"}]
    state = HuntState(str(tmp_path), "crashed", outcomes={"invalid": 1, "collision": 1}, crashes=1, kinds=kinds)
    assert _replace_invalid(tmp_path, replace(state, outcomes={"collision": 1})) == 0
    assert _replace_invalid(tmp_path, state) == again
