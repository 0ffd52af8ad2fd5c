"""What a status screen tells of a search is what its trials were."""

from __future__ import annotations

from crashhunt.hunts._progress import Progress
from crashhunt.trial import Outcome, TrialResult, TrialSpec


def told(progress, danger, origin="", *, crashed=False):
    spec = TrialSpec(0, 1, {}, {}, max_steps=1, origin=origin)
    result = TrialResult(spec, Outcome.COLLISION if crashed else Outcome.SURVIVED, danger=danger)
    progress.count(result, crashed=crashed, planned=9)


def test_the_greatest_danger_grew_with_the_last_trial_that_was_more_dangerous_than_all():
    progress = Progress()
    assert progress.searching.status().grown_trials is None
    for danger, ago in ((0.1, 0), (0.3, 0), (0.2, 1), (0.3, 2), (0.4, 0)):
        told(progress, danger)
        assert progress.searching.status().grown_trials == ago
    told(progress, 1.0, crashed=True)
    assert progress.searching.status().grown_trials == 1
    assert progress.searching.status().strategies == ()  # random draws have no name
