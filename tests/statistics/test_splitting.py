"""Splitting, against a random walk whose crash probability is known; levels, their test, and the stages of a hunt."""

from __future__ import annotations

import copy
import math
import random
import statistics
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from crashhunt.episode import COPIES_PER_LEVEL, run_path
from crashhunt.statistics import (
    PILOT_ROOTS,
    TRIALS_PER_ROOT,
    RareCounter,
    choose_levels,
    crash_shares,
    tree_of,
    why_unfit,
)
from crashhunt.statistics._rate_of_running_hunt import SplittingForcings, SplittingWatch
from crashhunt.trial import CRASHES, Forced, ForcedCopy, Forcing, Outcome, Reseeding, TrialResult, TrialSpec

UP, DOWN, STEPS = 0.1, 0.35, 60


@dataclass
class Walk:
    """A path that crashes at its top; the measure is its place."""

    rng: random.Random
    top: int = 7
    place: int = 0
    at: int = 0
    reached: int = 0
    weight: float = 1.0

    @property
    def measure(self):
        return self.place

    @property
    def is_over(self):
        return self.place >= self.top or self.at >= STEPS

    def step(self):
        self.at += 1
        drawn = self.rng.random()
        self.place = self.place + 1 if drawn < UP else max(0, self.place - (drawn < UP + DOWN))

    def fork(self, grow):
        made = copy.copy(self)
        made.rng = random.Random(self.rng.random())
        return grow(made)

    def end(self):
        crash = "collision" if self.place >= self.top else ""
        return ForcedCopy(f"level {self.reached}", 0, self.weight, 0, crash, self.at, disturbed=False)


def truth(top):
    """Return the crash probability by dynamic programming."""
    places, crashed = [1.0] + [0.0] * (top - 1), 0.0
    for _ in range(STEPS):
        after = [0.0] * (top + 1)
        for place, mass in enumerate(places):
            after[max(0, place - 1)] += mass * DOWN
            after[place] += mass * (1.0 - UP - DOWN)
            after[place + 1] += mass * UP
        crashed += after.pop()
        places = after
    return crashed


def tree(number, levels, seed=0, peak=0.0):
    """Return the result of a root with its copies."""
    own, *copies = run_path(Walk(random.Random(f"{seed} {number}")), levels)
    spec = TrialSpec(number, number, {}, {}, STEPS, forcing=Forcing(1.0, levels=tuple(levels)))
    forced = Forced(own.weight, {}, tuple(copies), sum(copy.step for copy in copies), peak=peak)
    return TrialResult(spec, Outcome.COLLISION if own.crash else Outcome.SURVIVED, own.step, forced=forced)


def test_trees_have_the_weight_of_one_trial_and_estimate_its_crash_probability_without_bias():
    found, counter = [], RareCounter(1.0)
    for number in range(1500):
        result = tree(number, (2, 3, 5))
        weights = [result.forced.survival, *(copy.weight for copy in result.forced.copies)]
        assert math.fsum(weights) == pytest.approx(1.0)
        root = tree_of(result, CRASHES)
        found.append(root.value)
        counter.add(root)
    true = truth(7)
    error = statistics.stdev(found) / math.sqrt(len(found))
    assert abs(statistics.fmean(found) - true) < 3 * error
    assert error < 0.5 * math.sqrt(true * (1 - true) / len(found))  # of as many plain trials
    low, high = counter.certain()
    assert low <= true <= high
    estimate = counter.estimate()
    assert estimate.estimated.low <= true <= estimate.estimated.high
    assert estimate.undisturbed == estimate.estimate


def test_levels_are_each_reached_by_a_third_of_the_pilots_that_reach_the_one_before():
    peaks = [number / 100 for number in range(PILOT_ROOTS)]
    levels = choose_levels(peaks)
    assert [sum(peak >= level for peak in peaks) for level in levels] == [
        PILOT_ROOTS // COPIES_PER_LEVEL**number for number in (1, 2, 3)
    ]
    assert choose_levels([0.0] * 60 + [0.5] * 4) == (0.5,)
    assert choose_levels([0.1] * 54 + [90.0] * 10) == (0.1, 1.0)  # just before a crash, nothing is left to chance
    assert choose_levels([0.0] * PILOT_ROOTS) == choose_levels([]) == ()


def test_crash_shares_weigh_the_paths_beyond_each_level():
    third, ninth = 1 / 3, 1 / 9
    copies = (ForcedCopy("level 2", 1, ninth, 0, "collision"), ForcedCopy("level 1", 1, third, 0))
    trees = [(Forced(1.0, {}), False), (Forced(ninth, {}, copies), False)]
    assert crash_shares(trees, 2) == pytest.approx([ninth / (1 + 2 * ninth + third), ninth / (2 * ninth + third), 0.5])
    assert math.isnan(crash_shares(trees, 3)[3])


@pytest.mark.parametrize(
    ("shares", "says"),
    [
        ([0.01, 0.02, 0.05], ""),
        ([0.0], "in 64 pilot roots, no agent came closer to a vehicle ahead"),
        ([0.0, 0.0], "none of 64 pilot roots and their copies crashed"),
        ([0.1, 0.13], "P(crash) from level 1 is 1.3 times that of a trial (at least 2 times)"),
        ([0.1, 0.2, 0.3], "P(crash) from level 2 is 1.5 times that from level 1 (at least 2 times)"),
        ([0.1, math.nan], "none of 64 pilot roots and their copies reached level 1"),
    ],
)
def test_levels_that_do_not_double_the_crash_probability_are_refused_with_the_ratio(shares, says):
    assert says in why_unfit(shares)
    assert bool(says) == bool(why_unfit(shares))


class Rows(dict):
    """A ledger."""

    def result(self, number):
        return self.get(number)


def hunt(top, groups):
    """Return a ledger of so many roots, each with its plain trials, and what watches the hunt."""
    rows, settings = Rows(), SimpleNamespace(max_steps=STEPS, crash_on=CRASHES, run=SimpleNamespace(until_error=""))
    forcings = SplittingForcings(settings, rows)
    for number in range(groups * TRIALS_PER_ROOT):
        forcing = forcings.of(number)
        levels = forcing.levels if forcing is not None else ()
        group = number // TRIALS_PER_ROOT
        rows[number] = tree(number, levels, seed=top, peak=0.3 if group % 3 else 0.2)
        assert (forcing is None) == (number % TRIALS_PER_ROOT > 0)
        assert (levels == ()) == (forcing is None or group < PILOT_ROOTS)
    watch = SplittingWatch(settings, rows)
    watch.read()
    return rows, watch


def test_hunt_learns_levels_from_pilots_that_do_not_count_and_ends_where_these_fail():
    rows, watch = hunt(top=7, groups=2 * PILOT_ROOTS)
    assert watch.levels == (0.3,)
    assert watch.roots == 0
    assert watch.estimate().estimate is None
    plain = [rows[number] for number in rows if number % TRIALS_PER_ROOT or number < PILOT_ROOTS * TRIALS_PER_ROOT]
    assert watch.estimate().plain == len(plain)  # for the certain bounds; the first pilots have no copies
    assert watch.estimate().certain[1] < 1
    assert (watch.refusal != "") == watch.is_over
    before = [SplittingForcings.needed(number * TRIALS_PER_ROOT) for number in (0, 63, 64, 127, 128, 900)]
    assert before == [0, 0, 320, 320, 640, 640]
    few = SplittingWatch(watch._settings, Rows({number: rows[number] for number in range(37 * TRIALS_PER_ROOT)}))
    few.read()
    assert few.estimate().why_not == "37 of 128 pilot roots have ended"


def test_hunt_without_a_vehicle_ahead_ends_after_the_first_pilots():
    rows = Rows()
    settings = SimpleNamespace(max_steps=STEPS, crash_on=CRASHES, run=SimpleNamespace(until_error=""))
    for number in range(65 * TRIALS_PER_ROOT):
        rows[number] = tree(number, ())
    watch = SplittingWatch(settings, rows)
    watch.read()
    assert watch.estimate().why_not == watch.refusal == "in 64 pilot roots, no agent came closer to a vehicle ahead"


def test_reseeding_at_several_steps_survives_json_and_an_older_version_refuses_it():
    spec = TrialSpec(1, 2, {}, {}, 60, reseeding=Reseeding(20, 7, ((5, 3), (9, 4))))
    assert TrialSpec.from_json(spec.to_json()) == spec
    assert [spec.reseeding.seed_after(step) for step in (5, 9, 20, 21)] == [3, 4, 7, None]
    assert spec.to_json()["requires"] == ["reseeding", "earlier"]
    assert "earlier" not in TrialSpec(1, 2, {}, {}, 60, reseeding=Reseeding(20, 7)).to_json()["reseeding"]
