"""What a status screen tells of a search is what its trials were."""

from __future__ import annotations

from crashhunt.hunts._progress import Progress
from crashhunt.trial import Outcome, TrialResult, TrialSpec


def told(progress, danger, origin="", *, crashed=False):
    spec = TrialSpec(0, 1, {}, {}, max_steps=1, origin=origin)
    result = TrialResult(spec, Outcome.COLLISION if crashed else Outcome.SURVIVED, danger=danger)
    progress.count(result, crashed=crashed, planned=9)


def test_shares_and_mean_dangers_are_those_of_the_trials_and_a_crash_counts_as_one():
    progress = Progress()
    assert progress.searching.status().strategies == ()
    for danger, origin in ((0.1, "random"), (0.3, "mutation"), (None, "random"), (0.5, "mutation")):
        told(progress, danger, origin)
    told(progress, 0.2, "mutation", crashed=True)
    mutation, random = progress.searching.status().strategies
    assert (mutation.name, mutation.trials, mutation.share, mutation.crashes) == ("mutation", 3, 0.6, 1)
    assert abs(mutation.danger - 0.6) < 1e-12
    assert (random.name, random.danger, random.crashes) == ("random", 0.1, 0)


def test_the_greatest_danger_grew_with_the_last_trial_that_was_more_dangerous_than_all():
    progress = Progress()
    assert progress.searching.status().grown_trials is None
    for danger, ago in ((0.1, 0), (0.3, 0), (0.2, 1), (0.3, 2), (0.4, 0)):
        told(progress, danger)
        assert progress.searching.status().grown_trials == ago
    told(progress, 1.0, crashed=True)
    assert progress.searching.status().grown_trials == 1
    assert progress.searching.status().strategies == ()  # random draws have no name
