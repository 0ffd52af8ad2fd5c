"""What a run without something says of what a collision hangs on."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.analysis._causes import _Candidate, _Search
from crashhunt.crashes import Factor
from crashhunt.trial import Choice, Disturbance, Outcome, Range, TrialSpec

SPEC = TrialSpec(7, 1, {"ego": {}}, {}, 99)


def search():
    """One for a trial whose scene never changes."""
    found = object.__new__(_Search)
    found._spec = SPEC
    found._hit = SimpleNamespace(collider="ego", victim="x")
    found._recording = Recorded()
    return found


class Recorded:
    """Of a run that did the same."""

    steps = 8

    def like(self, other):
        return self

    def __init__(self, *disturbances):
        self.disturbances = disturbances

    def scene(self, number):
        return SimpleNamespace(data=np.zeros(1))


def told(step, what, vehicle):
    return SimpleNamespace(step=step, what=what, vehicle=vehicle)


@pytest.mark.parametrize(
    ("disturbances", "ending"),
    [
        ([told(5, "gone", "x")], "none"),
        ([told(5, "gone", "")], "unclear"),  # it could not be done, for x
        ([told(2, "brake", "x"), told(5, "gone", "")], "unclear"),  # was busy with what the trial is disturbed by
        ([], "unclear"),
    ],
)
def test_run_in_which_the_actor_was_not_held_is_unclear(disturbances, ending):
    held = Disturbance(5, "itself", "gone", 0.0, 1.0, "ego", "x")
    spec = TrialSpec(7, 1, {"ego": {}}, {}, 99, disturbances=(held,))
    asked = _Candidate(Factor("other", "x", "there", 8), [(4, spec)], inside=True)
    result = SimpleNamespace(outcome=Outcome.SURVIVED, collision=None)
    ended = SimpleNamespace(place=0, result=result, recording=Recorded(*disturbances))
    assert search().ending(asked, 0, ended).ending == ending


def test_values_are_drawn_as_the_hunt_draws_them():
    drawn = search()._drawn_argument
    options = tuple(range(20))
    chosen = drawn("a", Choice(options))
    assert sorted(chosen) == [*options]
    assert chosen != [*options]  # the first are asked about, and must not always be the same
    assert chosen == drawn("a", Choice(options)) != drawn("b", Choice(options))
    assert len({*drawn("a", Range(0.0, 1.0))}) == 8
    assert {*drawn("a", Range(1, 2, integer=True))} == {1, 2}
