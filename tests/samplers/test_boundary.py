"""The sampler that searches the boundary of crashes on a grid, against the whole grid."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from spaces import spec_of

from crashhunt.errors import UsageError
from crashhunt.samplers import SAMPLE, BoundarySampler, HuntFacts, nearest_labels
from crashhunt.space import Choice, Range
from crashhunt.testing import SamplerContract
from crashhunt.trial import Outcome, TrialResult

SPACE = {
    ("", "gap"): Range(0.0, 40.0, step=2.0),
    ("", "speed"): Range(1.0, 12.0, step=1.0),
    ("ego", "side"): Choice((-1, 1)),
}


def ask(sampler, number):
    return sampler.ask(number, np.random.default_rng(number))


class TestBoundarySampler(SamplerContract):
    @pytest.fixture
    def make(self):
        return lambda space: BoundarySampler(space, points=5, hunt=HuntFacts(1))

    @pytest.fixture
    def space(self):
        return SPACE


def crashes(gap, speed, side):
    """Crash below a curve, except close to the vehicle; the regions of both sides differ."""
    return gap < 3 * speed + 2 * side and gap > speed / 2 + side


def run_all(seed, crashes=crashes):
    sampler, ran = BoundarySampler(SPACE, hunt=HuntFacts(seed, (Outcome.COLLISION,))), {}
    number = 0
    while (proposal := ask(sampler, number)) is not None:
        cell = tuple(proposal.arguments[key] for key in sorted(SPACE))
        assert cell not in ran
        ran[cell] = crashes(*cell)
        outcome = Outcome.COLLISION if ran[cell] else Outcome.SURVIVED
        sampler.tell(TrialResult(spec_of(number, proposal), outcome))
        number += 1
    return ran


@pytest.mark.parametrize("seed", range(5))
def test_map_is_that_of_the_whole_grid_with_fewer_trials(seed):
    axes = [SPACE[key].grid(10) for key in sorted(SPACE)]
    grid = list(itertools.product(*axes))
    ran = run_all(seed)
    shape = tuple(map(len, axes))
    found = nearest_labels(shape, {grid.index(cell): hit for cell, hit in ran.items()})
    assert found.tolist() == [crashes(*cell) for cell in grid]
    assert len(ran) < len(grid) * 0.55


def test_agent_that_never_crashes_needs_the_sample_and_the_corners_only():
    assert len(run_all(1, lambda *_: False)) <= round(0.1 * 21 * 12 * 2) + 8


def test_first_trials_are_a_random_sample_of_the_grid():
    drawn = []
    for seed in range(200):
        sampler = BoundarySampler(SPACE, hunt=HuntFacts(seed))
        proposals = [ask(sampler, number) for number in range(20)]
        assert {proposal.origin for proposal in proposals} == {SAMPLE}
        drawn += [proposal.arguments["", "gap"] for proposal in proposals]
    counts = np.unique(drawn, return_counts=True)[1]
    assert len(counts) == 21
    assert abs(counts - 4000 / 21).max() < 5 * np.sqrt(4000 / 21)


def test_trial_that_could_not_be_set_up_is_neither_crash_nor_run_again():
    sampler, seen = BoundarySampler(SPACE, hunt=HuntFacts(1)), set()
    number = 0
    while (proposal := ask(sampler, number)) is not None:
        assert proposal.arguments.values() not in seen
        sampler.tell(TrialResult(spec_of(number, proposal), Outcome.INVALID))
        number += 1
    assert 50 < number <= 58


def test_grid_that_is_too_large_is_refused():
    with pytest.raises(UsageError, match=r"the grid has 1,002,001 cells \(allowed: 1,000,000\)"):
        BoundarySampler({("", name): Range(0, 1000, step=1) for name in "ab"})
