"""What an early crashhunt leaves out of a trial is noticed: it has run another one."""

from __future__ import annotations

from dataclasses import replace

import pytest

from crashhunt.crashes import find_bundle, open_archive
from crashhunt.replays import ReplayOptions
from crashhunt.trial import Disturbance, Overruled, TrialSpec
from crashhunt.whatif import judge
from crashhunt.whatif._reruns import NotUnderstoodError, _require_same_trial

SPEC = TrialSpec(1, 2, {"ego": {"speed": 3.0}}, {}, 9)


@pytest.mark.parametrize(
    "asked",
    [
        {"overruled": Overruled("ego", 3)},
        {"overruled": Overruled("ego", 3, keeps="lane")},
        {"disturbances": (Disturbance(3, "itself", "gone", 0.0, 9.0, "ego", "other"),)},
        {"only": ()},
    ],
)
def test_another_trial_than_was_asked_for_is_refused(asked):
    spec = replace(SPEC, **asked)
    _require_same_trial(spec, TrialSpec.from_json(spec.to_json()))
    with pytest.raises(NotUnderstoodError, match="too old"):
        _require_same_trial(spec, SPEC)


@pytest.mark.nightly
def test_a_crash_of_the_first_version_is_judged_by_what_it_understands(request):
    with open_archive(request.path.parent.parent / "e2e" / "bundles" / "crashhunt-0.1.0.zip") as archive:
        found = judge(find_bundle(archive.directory), ReplayOptions(trusted=True), runs=2, why=10, parallel=2)
    assert (found.attempts, found.why_not) == (
        (),
        "the snapshot contains a version of crashhunt that is too old for this command",
    )
    assert found.why is not None
    assert {factor.kind for factor in found.why.factors} <= {"argument", "seed"}
    assert found.why.why_not == found.why_not
