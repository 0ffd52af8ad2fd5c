"""The progress of a hunt as numbers: what is left, what came nearest, what each strategy has found."""

from __future__ import annotations

import math
import time
from types import SimpleNamespace

import pytest

from crashhunt.hunts._progress import HuntStatus, Progress
from crashhunt.trial import Outcome, TrialResult, TrialSpec


def result(number=0, outcome=Outcome.SURVIVED, *, origin="", **evidence):
    return TrialResult(TrialSpec(number, 1, {}, {}, 9, origin=origin), outcome, 9, **evidence)


def status(**given):
    plain = {
        "phase": "hunting", "planned": 40, "done": 10, "outcomes": {}, "rate_per_s": 2.0, "elapsed_s": 5.0,
        "nearest": None, "workers": {}, "crashes": 0,
    }  # fmt: skip
    return HuntStatus(**plain | given)


@pytest.mark.parametrize(
    ("given", "left"),
    [
        ({}, 15.0),
        ({"done": 50}, 0.0),
        ({"time_left_s": 4.0}, 4.0),
        ({"trials_left_s": 7.0}, 7.0),
        ({"trials_left_s": 7.0, "time_left_s": 4.0}, 4.0),
        ({"rate_per_s": 0.0}, math.inf),
        ({"planned": 0, "time_left_s": 9.0}, 9.0),
        ({"planned": 0}, math.inf),
    ],
    ids=str,
)
def test_time_left_ends_with_the_trials_or_the_time(given, left):
    assert status(**given).seconds_left == left


@pytest.mark.parametrize(
    ("given", "share"),
    [
        ({}, 0.25),
        ({"time_left_s": 5.0}, 0.5),
        ({"time_left_s": 45.0}, 0.25),
        ({"planned": 0}, 0.0),
        ({"planned": 0, "time_left_s": 15.0}, 0.25),
        ({"planned": 0, "elapsed_s": 0.0, "time_left_s": 0.0}, 1.0),
    ],
    ids=str,
)
def test_share_done_is_that_of_trials_or_of_time(given, share):
    assert status(**given).share_done == share


def counted(*results, crashed=()):
    progress = Progress()
    for one in results:
        progress.count(one, crashed=one.spec.number in crashed, planned=9)
    return progress


def test_last_invalid_trial_is_kept_unless_it_counts_as_a_crash():
    invalid = result(0, Outcome.INVALID)
    assert counted(invalid, result(1)).last_invalid is invalid
    assert counted(invalid, crashed=(0,)).last_invalid is None


def test_rate_on_the_last_screen_counts_every_trial():
    progress = Progress()
    progress.counted = SimpleNamespace(running=lambda *, now: {"trials": 2 if now else 1})
    rates = [progress.status(phase, 2, has_disturbances=False).rate for phase in ("hunting", "done")]
    assert rates == [{"trials": 1}, {"trials": 2}]


def test_time_limit_of_a_hunt_counts_down_to_zero():
    assert Progress(until=time.monotonic() - 1).time_left_s == 0.0
    assert Progress().time_left_s == math.inf
