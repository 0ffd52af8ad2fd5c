"""What a result says of itself, in one line."""

from __future__ import annotations

from dataclasses import replace

import pytest

from crashhunt.trial import (
    KILLED,
    Branches,
    Collision,
    Failure,
    Forced,
    ForcedCopy,
    Outcome,
    Stress,
    TrialResult,
    TrialSpec,
)  # fmt: skip
from crashhunt.world import ClosestApproach, Event

SPEC = TrialSpec(3, 7, {}, {}, max_steps=100)


def hit(role: str, collider: str, victim: str, kind: str = "") -> Collision:
    return Collision("ego", role, collider, victim, ("overlap",), kind)


@pytest.mark.parametrize(
    ("outcome", "evidence", "says"),
    [
        (Outcome.COLLISION, {"collision": hit("collider", "ego", "car 1")}, "ego drove into car 1 at step 9"),
        (Outcome.COLLISION, {"collision": hit("victim", "car 1", "ego")}, "ego was hit by car 1 at step 9"),
        (Outcome.COLLISION, {"collision": hit("alone", "ego", "", "fell")}, "ego crashed (fell) at step 9"),
        (Outcome.OFF_ROAD, {"collision": hit("alone", "ego", "", "off_road")}, "ego left the road at step 9"),
        (Outcome.RED_LIGHT, {"event": Event("red_light", "ego", "ego ran 'c'")}, "ego ran 'c', at step 9"),
        (Outcome.AGENT_ERROR, {"failure": Failure("KeyError", "'x'", "Trace", "ego")}, "ego: KeyError: 'x'"),
        (Outcome.AGENT_ERROR, {"failure": Failure("AssertionError", "", "Trace", "ego")}, "ego: AssertionError"),
        (Outcome.SIMULATOR_ERROR, {"failure": Failure("KeyError", "'x'", "Trace")}, "KeyError: 'x'"),
        (Outcome.HANG, {"failure": Failure("timeout", "it hung", "the stack", "ego")}, "it hung"),
        (Outcome.PROCESS_DIED, {"failure": Failure("signal", "killed", "Trace", exit_code=-9)}, "killed"),
        (Outcome.INVALID, {"failure": Failure("invalid", "no vehicle")}, "no vehicle"),
        (Outcome.SURVIVED, {}, "survived after 9 steps"),
    ],
)
def test_a_result_in_one_line(outcome, evidence, says):
    assert TrialResult(SPEC, outcome, steps=9, **evidence).summary == says


def forced(**given):
    return Forced(survival=0.5, masses={}, **given)


@pytest.mark.parametrize(
    ("evidence", "again"),
    [
        ({}, False),
        ({"stress": Stress(1.0)}, False),
        ({"stress": Stress(1.0, may_be_asked_again=True)}, True),
        ({"branches": Branches(may_be_asked_again=True)}, True),
        ({"forced": forced(may_be_asked_again=True), "stress": Stress(1.0)}, True),
        ({"failure": Failure(KILLED, "killed")}, True),
        ({"failure": Failure("signal", "killed")}, False),
    ],
    ids=str,
)
def test_trial_whose_processes_were_killed_from_outside_runs_again(evidence, again):
    assert TrialResult(SPEC, Outcome.SURVIVED, **evidence).is_to_be_run_again is again


def test_run_that_was_killed_or_only_now_takes_too_long_is_no_answer():
    first, late = TrialResult(SPEC, Outcome.SURVIVED), TrialResult(SPEC, Outcome.HANG)
    assert late.is_no_answer_to(first.outcome)
    assert replace(first, failure=Failure(KILLED, "killed")).is_no_answer_to(first.outcome)
    assert not late.is_no_answer_to(late.outcome)
    assert not first.is_no_answer_to(late.outcome)


@pytest.mark.parametrize(
    ("evidence", "asked"),
    [
        ({}, True),
        ({"stress": Stress(None)}, False),
        ({"stress": Stress(1.0), "branches": Branches(), "forced": forced()}, True),
        ({"branches": Branches(unanswered=1)}, False),
        ({"forced": forced(unanswered=1)}, False),
    ],
    ids=str,
)
def test_trial_is_fully_asked_if_no_fork_lacks_a_result(evidence, asked):
    assert TrialResult(SPEC, Outcome.SURVIVED, **evidence).is_fully_asked is asked


def test_steps_of_a_trial_and_of_what_it_needed():
    result = TrialResult(SPEC, Outcome.SURVIVED, steps=9)
    assert (result.steps_begun, result.other_steps) == (9, 0)
    forks = {"stress": Stress(1.0, steps=3), "branches": Branches(steps=4), "forced": forced(steps=5)}
    failed = TrialResult(SPEC, Outcome.AGENT_ERROR, steps=9, failure=Failure("E", "e"), setup_steps=100, **forks)
    assert (failed.steps_begun, failed.other_steps) == (10, 112)


def test_more_critical_trials_come_later_and_unmeasured_ones_first():
    near, far = ClosestApproach(time_to_collision_s=0.5), ClosestApproach(time_to_collision_s=4.0)
    order = [
        TrialResult(SPEC, Outcome.SURVIVED, closest=far),
        TrialResult(SPEC, Outcome.SURVIVED, closest=near),
        TrialResult(SPEC, Outcome.SURVIVED, danger=0.2, closest=near),
        TrialResult(SPEC, Outcome.SURVIVED, danger=0.9, closest=far),
    ]
    assert sorted(order[2:] + order[:2], key=lambda result: result.nearness) == order


def test_defaults_of_a_result_count_nothing():
    result = TrialResult(SPEC, Outcome.SURVIVED)
    numbers = (result.steps, result.sim_time_s, result.wall_s, result.setup_s, result.worker, result.kept)
    assert numbers == (0, 0, 0, 0, 0, False)
    copy = ForcedCopy(cell="brake", onset=3, weight=0.25, branched=2)
    assert (copy.step, copy.within, copy.disturbed) == (0, 1.0, True)


def test_runs_are_identical_if_outcome_and_digest_are():
    one = TrialResult(SPEC, Outcome.SURVIVED, digest="a")
    assert one.is_identical_run(TrialResult(SPEC, Outcome.SURVIVED, digest="a", wall_s=9.0))
    assert not one.is_identical_run(TrialResult(SPEC, Outcome.SURVIVED, digest="b"))
    assert not one.is_identical_run(TrialResult(SPEC, Outcome.FINISHED, digest="a"))


def test_texts_of_a_failure_can_be_written_as_utf_8():
    failure = Failure("a\udc80", "b\udc80", "c\udc80", last_output="d\udc80")
    for text in (failure.kind, failure.message, failure.traceback, failure.last_output):
        assert text.encode()[1:] == b"\\udc80"
