"""An omission is found although the agent then crashes in another way, with its other faculty."""

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
