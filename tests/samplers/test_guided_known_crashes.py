"""Crashes that are known keep others away by what their results say of manner and place."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from spaces import ask, spec_of

from crashhunt.samplers import Cube, GuidedSampler, HuntFacts, RandomSampler
from crashhunt.samplers._guided import KnownCrashes
from crashhunt.samplers._strategy import ScoredTrial, scored_trial
from crashhunt.space import Range
from crashhunt.trial import Collision, Failure, Outcome, TrialResult
from crashhunt.world import Event

UNIT = {("ego", f"x{index}"): Range(0.0, 1.0) for index in range(4)}


def crash(x, kind="", seed=0):
    return ScoredTrial(0, np.array([x, x, x, x]), seed, 1.0, kind=kind)


def at(x):
    return np.array([x, x, x, x])


def test_without_manner_and_place_arguments_are_all_there_is():
    known = KnownCrashes(4)
    assert not known
    assert not known.cover(at(0.5))
    assert known.add(crash(0.5))
    assert known
    assert known.cover(at(0.59))
    assert not known.cover(at(0.61))
    trials = [crash(x, seed=1) for x in (0.61, 0.59, 0.1)]
    assert known.outside(trials) == [trials[0], trials[2]]
    assert known.outside([]) == []
    assert not known.add(crash(0.55))  # nothing new


def test_crashes_of_one_kind_keep_next_to_nothing_away_until_three_in_a_row_were_nothing_new():
    known = KnownCrashes(4)
    assert known.add(crash(0.5, "rear end"))
    assert not known.cover(at(0.53))
    assert known.add(crash(0.53, "rear end"))
    assert known.add(crash(0.56, "rear end"))
    assert not known.cover(at(0.6))
    assert known.add(crash(0.59, "side swipe"))  # so it begins anew
    assert known.add(crash(0.62, "rear end"))
    assert known.add(crash(0.65, "side swipe"))
    assert known.add(crash(0.9, "rear end"))  # that is elsewhere
    assert not known.cover(at(0.7))
    assert known.add(crash(0.68, "rear end"))
    assert known.cover(at(0.75))
    assert not known.cover(at(0.85))
    assert not known.add(crash(0.75, "rear end"))


def test_where_another_kind_comes_there_is_more_to_find():
    known = KnownCrashes(4)
    assert known.add(crash(0.5))
    assert known.add(crash(0.55, "side swipe"))
    assert not known.cover(at(0.58))
    assert not known.cover(at(0.53))
    assert known.cover(at(0.51))


def two_peaks(known):
    """Tell trials along a diagonal: criticality falls from 0.5 to 0.7, and rises again to 0.9."""
    for number in range(41):
        x = 0.5 + number / 80
        known.see(ScoredTrial(number, at(x), number, 0.95 - 3 * abs(x - 0.5) if x < 0.7 else 0.7 - 2 * abs(x - 0.9)))


def test_basin_of_a_crash_without_news_is_excluded_and_another_peak_is_not():
    known = KnownCrashes(4)
    two_peaks(known)
    assert not known.cover(at(0.65))
    known.add(crash(0.5, seed=100))
    assert known.cover(at(0.65))
    assert known.cover(at(0.66), 7)
    assert not known.cover(at(0.75))
    assert not known.cover(at(0.95))
    trials = [crash(x, seed=101) for x in (0.65, 0.8)]
    assert known.outside(trials) == trials[1:]


def test_basin_of_a_crash_is_excluded_only_when_its_neighbourhood_yields_known_types():
    known = KnownCrashes(4)
    two_peaks(known)
    for x in (0.5, 0.54, 0.58):
        known.add(crash(x, "rear end", 100))
        assert not known.cover(at(0.67))
    known.add(crash(0.62, "rear end", 100))
    assert known.cover(at(0.67))
    known.add(crash(0.6, "side swipe", 100))  # it is open again
    assert not known.cover(at(0.67))


def test_basins_depend_on_the_order_of_criticality_alone():
    covered = []
    for scaled in (lambda score: score, lambda score: 0.45 * score, lambda score: score**2):
        known = KnownCrashes(4)
        for number in range(41):
            x = 0.5 + number / 80
            score = 0.95 - 3 * abs(x - 0.5) if x < 0.7 else 0.7 - 2 * abs(x - 0.9)
            known.see(ScoredTrial(number, at(x), number, scaled(score)))
        known.add(crash(0.5, seed=100))
        covered.append([known.cover(at(x)) for x in np.linspace(0.5, 1.0, 200)])
    assert 40 < sum(covered[0]) < 160
    assert covered[0] == covered[1] == covered[2]


def test_basins_are_made_again_after_16_trials_without_a_crash():
    known = KnownCrashes(4)
    known.see(ScoredTrial(0, at(0.5), 0, 0.9))
    known.add(crash(0.45, seed=100))
    made = []
    for number in range(1, 36):
        before = known._ground
        known.see(ScoredTrial(number, at(0.5), number, 0.5))
        made.append(known._ground is not before)
    assert [number for number, again in enumerate(made, start=1) if again] == [16, 32]


def test_types_of_the_last_256_crashes_are_known():
    known = KnownCrashes(4)
    for number in range(256):
        known.add(crash(0.5, f"type {number}"))
    assert not known.is_new(crash(0.5, "type 0"))
    known.add(crash(0.5, "type 256"))
    assert known.is_new(crash(0.5, "type 0"))
    assert not known.is_new(crash(0.5, "type 1"))


def test_trials_in_a_basin_are_learned_from_when_they_turn_out_to_be_at_another_peak():
    known = KnownCrashes(4)
    for number in range(20):
        assert [one.number for one in known.see(ScoredTrial(number, at(0.5 + number / 100), number, 0.9))] == [number]
    known.see(ScoredTrial(20, at(0.72), 20, 0.1))
    known.add(crash(0.5, seed=100))
    assert known.cover(at(0.55))
    found = [known.see(ScoredTrial(number, at(0.3 + number / 80), number, number / 80)) for number in range(21, 53)]
    late = [len(trials) for trials in found if len(trials) > 1]
    assert late
    assert len({one.number for trials in found for one in trials}) == sum(map(len, found))  # none of them twice


def test_several_kinds_at_the_very_same_arguments_keep_nothing_away_by_the_first_of_them():
    """As it is with choices and whole numbers, where other traffic leads from the same values to another crash."""
    known = KnownCrashes(4)
    for kind in ("rear end", "side swipe", "off road"):
        assert known.add(crash(0.5, kind))
        assert known.cover(at(0.5))
        assert not known.cover(at(0.53))


def test_the_oldest_of_many_crashes_is_forgotten():
    known = KnownCrashes(4)
    for number in range(33):
        assert known.add(crash(float(number)))
    assert not known.cover(at(0.0))
    assert all(known.cover(at(float(number))) for number in range(1, 33))


def test_the_traffic_of_a_crash_is_known_wherever_its_arguments_are():
    known = KnownCrashes(4)
    assert known.add(crash(0.5, "rear end", seed=7))
    assert known.cover(at(0.9), 7)
    assert not known.cover(at(0.9), 8)
    assert not known.cover(at(0.9))
    trials = [crash(0.9, seed=seed) for seed in (7, 8)]
    assert known.outside(trials) == [trials[1]]
    for seed in range(8, 8 + 1024):
        known.add(crash(0.5, "rear end", seed))
    assert not known.cover(at(0.9), 7)  # the oldest are forgotten
    assert known.cover(at(0.9), 8)


def kind_of(**evidence):
    outcome = evidence.pop("outcome", Outcome.COLLISION)
    spec = spec_of(0, ask(RandomSampler(UNIT), 0))
    return scored_trial(TrialResult(spec, outcome, danger=0.5, **evidence), Cube(UNIT), HuntFacts()).kind


def test_kinds_are_reported_by_manner_and_road_and_by_what_was_raised():
    hit = Collision("ego", "collider", "ego", "a", kind="collision", lane="north_1")
    assert kind_of(collision=hit) == "collision collider collision north"
    assert kind_of(collision=replace(hit, cell="fell 012")) == "collision collider collision north fell 012"
    same = Collision("ego", "collider", "ego", "b", kind="collision", lane="north_0", x=3.0)
    assert kind_of(collision=same) == kind_of(collision=hit)
    other = Collision("ego", "victim", "b", "ego", kind="collision", lane="north_0")
    assert kind_of(collision=other) != kind_of(collision=hit)
    junction = Collision("ego", "collider", "ego", "a", kind="collision", lane=":J1_0_0")
    assert kind_of(collision=junction) != kind_of(collision=hit)
    raised = kind_of(outcome=Outcome.AGENT_ERROR, failure=Failure("ValueError", "no", agent="ego"))
    assert raised == "agent_error ValueError ego"
    assert kind_of() == ""
    assert kind_of(outcome=Outcome.SURVIVED) == ""
    light = Event("red_light", "ego", "ego ran the red light", lane="north_1")
    assert kind_of(event=light) == "collision red_light north"


def test_a_danger_is_never_a_crash_and_a_crash_is_the_greatest_danger():
    spec = spec_of(0, ask(RandomSampler(UNIT), 0))
    for outcome, danger, score in (
        (Outcome.SURVIVED, 1.0, math.nextafter(1.0, 0.0)),
        (Outcome.FINISHED, -0.5, 0.0),
        (Outcome.COLLISION, None, 1.0),
        (Outcome.HANG, 0.2, 1.0),
    ):
        told = scored_trial(TrialResult(spec, outcome, danger=danger), Cube(UNIT), HuntFacts())
        assert (told.score, told.crashed) == (score, score == 1.0)
    assert scored_trial(TrialResult(spec, Outcome.SURVIVED), Cube(UNIT), HuntFacts()) is None
    assert scored_trial(TrialResult(spec, Outcome.INVALID), Cube(UNIT), HuntFacts()) is None


def test_a_hunt_that_continues_comes_back_to_arguments_that_lead_to_several_kinds():
    """All crashes are in one small region, and of four kinds: whoever kept away from it would find one."""
    lanes = ["north_0", "south_0", "east_0", "west_0"]

    def found(seed):
        sampler, kinds = GuidedSampler(UNIT, hunt=HuntFacts(seed)), []
        for number in range(400):
            proposal = ask(sampler, number, seed)
            x = np.array([*proposal.arguments.values()])
            away = float(np.linalg.norm(x - 0.7))
            hit = Collision("ego", "collider", "ego", lane=lanes[number % 4]) if away < 0.1 else None
            outcome = Outcome.COLLISION if hit else Outcome.SURVIVED
            kinds += [hit.lane] if hit else []
            danger = 1.0 if hit else 0.95 - away / 2
            sampler.tell(TrialResult(spec_of(number, proposal), outcome, danger=danger, collision=hit))
        return kinds

    hunts = [found(seed) for seed in range(2)]
    assert sum(len(set(kinds)) for kinds in hunts) >= 6
    assert max(map(len, hunts)) < 60
