"""The search for the last step from which a manoeuvre avoids a collision, against trying every step."""

from __future__ import annotations

import random

import pytest

from crashhunt.analysis._avoidability import AvoidanceSearch, CannotError, Tried
from crashhunt.crashes import Attempt, Judgement


class Runs:
    """Says what comes of every manoeuvre after every step.

    Args:
        helps: manoeuvre to the steps from which it avoids the collision; one that is missing cannot be done.
        special: step to another ending than a hit.
    """

    def __init__(self, helps, special=None):
        self.helps, self.special, self.asked = helps, special or {}, []

    def __call__(self, manoeuvre, steps):
        if manoeuvre not in self.helps:
            raise CannotError(f"nobody knows how to {manoeuvre}")
        for step in steps:
            self.asked.append((manoeuvre, step))
            yield Tried(step, "avoided" if step in self.helps[manoeuvre] else self.special.get(step, "hit"), 8.0)


def found(runs, end=40, start=30, most=10**6, parallel=1):
    search = AvoidanceSearch(end, start, runs, runs=most, parallel=parallel)
    search.all()
    judgement = search.judgement()
    assert len(runs.asked) == len(set(runs.asked)) == judgement.runs <= most
    assert {(one.manoeuvre, step) for one in judgement.attempts for step in one.endings} == set(runs.asked)
    return judgement


@pytest.mark.parametrize("parallel", [1, 3])
@pytest.mark.parametrize("last", [-1, 0, 17, 38, 39])
@pytest.mark.parametrize("start", [0, 39])
def test_it_is_the_last_step_and_everything_after_it_was_run(parallel, last, start):
    judgement = found(Runs({"brake": range(last + 1)}), start=start, parallel=parallel)
    (brake,) = judgement.attempts
    assert brake.last_step == (None if last < 0 else last)
    assert brake.all_later_run
    assert brake.too_late_step == (last + 1 if last < 39 else None)
    assert judgement.avoidable is (last >= 0)


def test_helping_need_not_end_for_good():
    draw = random.Random(3)
    for parallel in (1, 2, 4):
        for _ in range(60):
            steps = {step for step in range(40) if draw.random() < draw.choice((0.05, 0.5))}
            runs = Runs({"brake": steps, "left": set(), "right": set()})
            judgement = found(runs, start=draw.randrange(40), parallel=parallel)
            assert judgement.attempts[0].last_step == max(steps, default=None)
            assert judgement.attempts[0].all_later_run


def test_changing_lanes_is_tried_only_where_braking_helps_no_more():
    runs = Runs({"brake": range(31), "left": range(36), "right": ()})
    judgement = found(runs)
    assert judgement.best.manoeuvre == "left"
    assert judgement.best.last_step == 35
    assert min(step for manoeuvre, step in runs.asked if manoeuvre != "brake") == 31
    assert [one.manoeuvre for one in found(Runs({"brake": range(40), "left": range(40)})).attempts] == ["brake"]


@pytest.mark.parametrize(("most", "verdict"), [(1, "unknown"), (2, "unknown"), (3, "invalid")])
def test_no_verdict_of_invalid_where_no_runs_remain_for_lane_changes(most, verdict):
    helpless = {"brake": (), "left": (), "right": ()}
    judgement = found(Runs(helpless), end=1, start=0, most=most)
    assert judgement.verdict == verdict
    assert judgement.avoidable is (False if verdict == "invalid" else None)
    assert bool(judgement.why_not) is (verdict == "unknown")
    assert not found(Runs({**helpless, "brake": [0]}), end=2, start=0, most=1).why_not


@pytest.mark.parametrize("most", [1, 2, 5, 9])
def test_no_more_is_said_than_the_runs_have_shown(most):
    judgement = found(Runs({"brake": range(21), "left": (), "right": ()}), start=39, most=most)
    brake = judgement.attempts[0]
    if brake.last_step is None:
        assert judgement.avoidable is None
    assert brake.all_later_run is (brake.endings.keys() >= set(range((brake.last_step or -1) + 1, 40)))
    never = found(Runs({"brake": (), "left": (), "right": ()}), most=most)
    assert never.avoidable is None or {0} <= never.attempts[0].endings.keys()


def test_what_cannot_be_known_is_not_known():
    assert found(Runs({})) == Judgement((), "nobody knows how to brake")
    judgement = found(Runs({"brake": ()}, {30: "diverged"}))
    assert judgement.avoidable is None
    assert "not the same up to step 30" in judgement.why_not
    unclear = found(Runs({"brake": ()}, {12: "unclear"}))
    assert unclear.avoidable is None
    assert not unclear.attempts[0].all_later_run
    assert found(Runs({"brake": ()}, {12: "other"})).avoidable is False
    assert found(Runs({"brake": ()}), end=0).why_not == "it crashed in its first step"


def test_json_lists_the_runs():
    data = Judgement((Attempt("brake", 9, {7: "avoided", 8: "hit"}, 8.0),)).to_json()
    assert data == {
        "avoidable": True, "manoeuvre": "brake", "last_step": 7, "runs": 2, "why_not": "",
        "attempts": [
            {"manoeuvre": "brake", "endings": {"7": "avoided", "8": "hit"}, "last_step": 7, "too_late_step": 8,
             "all_later_run": True, "deceleration": 8.0, "changed": []},
        ],
        "verdict": "avoidable", "visible_step": None,
        "preventable_by": dict.fromkeys(("cc_human", "fsm", "rss", "reg157")),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("endings", "visible", "verdict"),
    [
        ({7: "avoided", 8: "hit"}, 7, "avoidable"),
        ({7: "avoided", 8: "hit"}, 8, "too late when visible"),
        ({6: "avoided", 8: "hit"}, 7, "unknown"),  # nobody has run what is between
        ({0: "hit", 7: "hit", 8: "other"}, 7, "invalid"),
        ({0: "other", 8: "hit"}, 0, "unknown"),  # it could at least have crashed otherwise
        ({7: "hit", 8: "hit"}, 7, "too late when visible"),
        ({7: "hit", 8: "unclear"}, 7, "unknown"),
        ({8: "hit"}, None, "unknown"),
    ],
)
def test_too_late_when_visible_is_a_verdict_of_its_own(endings, visible, verdict):
    judgement = Judgement((Attempt("brake", 9, endings),), visible_step=visible)
    assert judgement.verdict == verdict
