"""Crashes of one type are divided by cause: few are judged, and the others get the nearest cause."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from crashhunt.analysis import _types_by_cause
from crashhunt.analysis._types_by_cause import divide_by_cause, find_cause
from crashhunt.base.errors import CrashhuntError
from crashhunt.crashes import INTERRUPTED, Judgement, Reference, Why
from crashhunt.replays import ReplayOptions
from crashhunt.trial import Outcome


class AllChosen:
    """A division that has every crash judged, in turn."""

    def __init__(self, most):
        self.most, self.judged, self._open, self._causes = most, {}, [], {}

    def add(self, number, steps, features):
        self._open.append(number)

    def choose(self):
        return self._open.pop(0) if self._open and len(self.judged) < self.most else None

    def settle(self, place, cause):
        if cause is not None:
            self.judged[place] = self._causes[place] = cause

    def causes(self):
        return self._causes


@pytest.fixture
def bundles(monkeypatch):
    """Five crashes with the causes b, a, b, an error and c."""
    written = []
    made = [SimpleNamespace(name=name, result=SimpleNamespace(steps=5)) for name in "babxc"]

    def find_cause(bundle, options, *, parallel, stopped):
        if bundle.name == "x":
            raise CrashhuntError("no trial can be run")
        judged = SimpleNamespace(write=lambda: written.append(bundle.name)) if bundle.name != "c" else bundle
        return bundle.name, judged

    monkeypatch.setattr(_types_by_cause, "find_cause", find_cause)
    monkeypatch.setattr(_types_by_cause, "features_of", lambda bundle: None)
    monkeypatch.setattr(_types_by_cause, "changing", nullcontext)
    monkeypatch.setattr(_types_by_cause, "judgement_of", lambda bundle: None)
    monkeypatch.setattr(_types_by_cause, "Division", AllChosen)
    return SimpleNamespace(group=SimpleNamespace(bundles=made), written=written, made=made)


@pytest.mark.parametrize(
    ("known", "omission", "runs", "cause"),
    [
        (None, "braked too late", ["omission"], (None, "braked too late")),
        (None, None, ["omission", "why"], ("found", None)),
        (Judgement(why=Why(steps=7)), None, ["omission"], (Why(steps=7), None)),
        (Judgement(reference=Reference(omission="x")), None, [], (None, "x")),
        (Judgement(reference=Reference()), None, ["why"], ("found", None)),
        (Judgement(why=Why(why_not=INTERRUPTED)), None, ["omission", "why"], ("found", None)),
    ],
    ids=str,
)
def test_only_missing_runs_are_made_and_factors_are_removed_only_without_an_omission(
    monkeypatch, known, omission, runs, cause
):
    made = []
    crash = SimpleNamespace(result=SimpleNamespace(outcome=Outcome.COLLISION), is_near_miss=False)

    def prepare(bundle, options):
        assert (bundle, options) == (crash, ReplayOptions())
        return "rerun"

    def find_omission(rerun, **words):
        assert rerun == "rerun"
        made.append("omission")
        return Reference(omission=omission)

    def judge(bundle, options, **words):
        assert (bundle, options, words["runs"], words["drivers"]) == (crash, None, 1, False)
        made.append("why")
        return Judgement(why="found")

    def cause_of(bundle, found):
        assert bundle is crash
        return found and (found.why, found.reference.omission)

    monkeypatch.setattr(_types_by_cause, "with_judgement", lambda bundle, found: (bundle, cause_of(bundle, found)))
    monkeypatch.setattr(_types_by_cause, "judgement_of", lambda _: known)
    for function in (prepare, find_omission, judge, cause_of):
        monkeypatch.setattr(_types_by_cause, function.__name__, function)
    assert find_cause(crash) == (cause, (crash, cause))
    assert made == runs
    for outcome, is_near_miss in ((Outcome.AGENT_ERROR, False), (Outcome.HANG, False), (Outcome.SURVIVED, True)):
        crash = SimpleNamespace(result=SimpleNamespace(outcome=outcome), is_near_miss=is_near_miss)
        assert find_cause(crash) == (None, crash)  # of which no run tells the cause
    assert made == runs


def test_most_frequent_cause_comes_first_and_an_error_costs_one_crash_only(bundles):
    found = divide_by_cause(bundles.group)
    assert [(one.cause, [member.name for member in one.members]) for one in found] == [
        ("b", ["b", "b"]), ("a", ["a"]), ("c", ["c"])
    ]  # fmt: skip
    assert found[0].judged == (bundles.made[0], bundles.made[2])
    assert bundles.written == ["b", "a", "b"]  # the results of the last were there before


def test_results_are_written_if_that_is_asked_for(bundles):
    divide_by_cause(bundles.group, write=False)
    assert bundles.written == []


def test_interrupted_judgement_divides_nothing(bundles):
    answers = iter([False, False, False, True])  # it is stopped while the second crash is judged
    found = divide_by_cause(bundles.group, stopped=lambda: next(answers))
    assert [one.cause for one in found] == ["b"]
    assert bundles.written == ["b"]
