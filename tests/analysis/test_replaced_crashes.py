"""Which periods and runs decide what an agent omitted."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.analysis._omissions import _Search
from crashhunt.crashes import Omission, ReferenceRun
from crashhunt.trial import Outcome, TrialSpec


class Scripted(_Search):
    """A search in a trial that is not run: each faculty has an ending."""

    def __init__(self, **endings):
        self.runs, self.endings = [], endings
        self._left, self._end, self._dt, self._agent = 20, 47, 0.1, "ego"
        self._result = SimpleNamespace(digest="d")
        self._rerun = SimpleNamespace(spec=TrialSpec(0, 1, {"ego": {}}, {}, max_steps=60))

    def _run(self, specs, faculty, steps):
        result = SimpleNamespace(digest="d", outcome=Outcome.SURVIVED)
        self._left -= len(specs)
        return [SimpleNamespace(result=result, responses=()) for _ in specs]

    def _candidates(self, responses):
        return [{"faculty": "longitudinal", "kind": "vehicle", "actor": "x", "first": 25}]

    def _judged(self, faculty, step, ended):
        return ReferenceRun(faculty=faculty, step=step, ending=self.endings[faculty])

    def _omission(self, candidate, faculty):
        return Omission(
            faculty=faculty, kind=candidate["kind"], actor="x", step=25, instead="sped up", speed_mps=9.0
        )  # fmt: skip


@pytest.mark.parametrize(
    ("longitudinal", "both", "faculty", "runs"),
    [
        ("none", "none", "longitudinal", ["longitudinal"] * 3),
        ("other", "none", "both", ["longitudinal"] * 3 + ["both"] * 3),
        ("other", "other", None, ["longitudinal"] * 3 + ["both"] * 3),
        ("same", "none", None, ["longitudinal"] * 3),  # the same crash: braking is not what is missing
        ("unclear", "none", None, ["longitudinal"] * 3),
    ],
)
def test_another_crash_by_the_other_faculty_hides_no_omission(longitudinal, both, faculty, runs):
    found = Scripted(longitudinal=longitudinal, both=both).find("it differs")
    assert (found.omission and found.omission.faculty) == faculty
    assert [run.faculty for run in found.runs] == runs
    assert not found.why_not
    if faculty is not None:
        assert {run.ending for run in found.deciding} == {"none"}
        assert found.omission.kind == "vehicle"


def period(faculty="longitudinal", actor="x", first=10, last=40, **more):
    return {"faculty": faculty, "actor": actor, "first": first, "last": last, **more}


@pytest.mark.parametrize(
    ("periods", "first"),
    [
        ([period(first=1), period("lateral", first=2), period(first=3, last=45)], [2, 3, 1]),
        ([period(first=1, actor="y"), period(first=2, actor=""), period(first=3)], [2, 3]),
        ([period(first=number, last=number + 30) for number in range(9)], [8, 7, 6, 5]),
        ([period(first=1, last=19), period(first=2, last=20)], [2]),  # it ended more than 10 s before the crash
    ],
)
def test_lane_changes_and_then_the_latest_periods_with_the_collision_partner_are_examined(periods, first):
    search = object.__new__(_Search)
    search._end, search._dt, search._other = 60, 0.25, "x"
    assert [one["first"] for one in search._candidates(tuple(periods))] == first
