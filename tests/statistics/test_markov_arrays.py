"""The study of rare mode runs many roots at once: their onsets are those of crashhunt, and so is the law of copies."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from markov import Model, run_root

from crashhunt.disturbances import first_forcing
from crashhunt.statistics import root_of
from crashhunt.trial import CRASHES, Forcing

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts" / "studies" / "rates"))

from markov_arrays import Arrays, run_roots

ONSETS = 0x6F6E7365  # as crashhunt separates the draws of onsets


@pytest.mark.parametrize(
    "chances",
    [{"late_action": 1e-9, "brake": 2e-9, "stop": 1e-9}, {"stop": 1e-9}, {"late_action": 1e-9, "brake": 2e-9}],
)
def test_roots_at_once_have_the_same_copies_as_one_root_after_another(chances):
    """With chances near 0 nothing is drawn after the forced onsets, so the results are equal to the last bit."""
    model = Model(chances, hidden=2e-3)
    start = first_forcing(model.sampler(), model.steps)
    ratios = {"brake=2.0": 0.5, "stop=6.0": 2.5}
    learned = Forcing(
        1.3 * start.spacing, ratios, second=("late_action=0.5", "brake=4.0"), second_spacing=start.second_spacing / 2
    )
    seeds = [7919 * number + 3 for number in range(24)]
    forcings = [start, learned] * 12
    expected = [run_root(model, model.sampler(), forcing, seed) for forcing, seed in zip(forcings, seeds, strict=True)]

    def points(seed, *number):
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(ONSETS, *number))).random(99)

    def draw(rows, onsets):
        return np.array([points(seeds[row])[onset] for row, onset in zip(rows, onsets, strict=True)])

    def draw_seconds(rows, onsets):
        pairs = zip(rows.tolist(), onsets, strict=True)
        return np.array([points(seeds[row // 1000], row % 1000)[onset] for row, onset in pairs])

    draws = np.array([np.random.default_rng(seed + 1).random((model.steps, 3)) for seed in seeds])
    rng = np.random.default_rng(1)
    found = run_roots(
        Arrays(model), forcings, np.array(seeds), rng, draws=draws, draw=draw, draw_seconds=draw_seconds
    )  # fmt: skip
    assert found == expected
    copies = [copy for result in found for copy in result.forced.copies]
    assert any(copy.crash for copy in copies)
    assert any(copy.second for copy in copies)


def test_many_roots_at_once_estimate_both_parts_without_bias():
    model = Model({"late_action": 0.05, "brake": 0.1, "stop": 0.02}, hidden=1e-3)
    forcing = first_forcing(model.sampler(), model.steps)
    results = run_roots(Arrays(model), [forcing] * 1500, np.arange(1500), np.random.default_rng(2))
    roots = [root_of(result, CRASHES, model.hazard) for result in results]
    for part, truth in zip(("undisturbed", "disturbed"), model.truth(), strict=True):
        values = np.array([getattr(root, part) for root in roots])
        assert abs(values.mean() - truth) < 3 * values.std() / math.sqrt(len(values))
