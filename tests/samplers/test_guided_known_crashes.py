"""Crashes that are known keep others away by what their results say of manner and place."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from spaces import ask, spec_of

from crashhunt.samplers import Cube, GuidedSampler, HuntFacts, RandomSampler
from crashhunt.samplers._guided import KnownCrashes
from crashhunt.samplers._learning import ScoredTrial, scored_trial
from crashhunt.space import Range
from crashhunt.trial import Collision, Failure, Outcome, TrialResult
from crashhunt.world import Event

UNIT = {("ego", f"x{index}"): Range(0.0, 1.0) for index in range(4)}


def crash(x, kind="", seed=100):
    return ScoredTrial(0, at(x), seed, 1.0, kind=kind)


def at(x):
    return np.array([x, x, x, x])


def is_covered(known, x, seed=-1):
    return bool(known.cover(at(x)[None], np.array([seed]))[0])


def score_of_two_peaks(x):
    """Criticality falls from 0.5 to 0.7, and rises again to 0.9."""
    return 0.95 - 3 * abs(x - 0.5) if x < 0.7 else 0.7 - 2 * abs(x - 0.9)


def along_a_diagonal(score=score_of_two_peaks):
    return [ScoredTrial(number, at(x), number, score(x)) for number, x in enumerate(np.linspace(0.5, 1.0, 41))]


def known_after(*crashes, trials=None):
    known = KnownCrashes()
    for one in crashes:
        known.add(one, along_a_diagonal() if trials is None else trials)
    return known


def test_nothing_is_excluded_before_the_first_crash():
    known, trials = KnownCrashes(), along_a_diagonal()
    assert not known
    assert not is_covered(known, 0.5)
    assert known.outside(trials) == trials
    assert known.outside([]) == []


def test_basin_of_a_crash_without_a_type_is_excluded_and_another_peak_is_not():
    known = known_after(crash(0.5))
    assert known
    assert is_covered(known, 0.5)
    assert is_covered(known, 0.65)
    assert not is_covered(known, 0.75)
    assert not is_covered(known, 0.95)
    trials = [crash(x, seed=101) for x in (0.65, 0.8)]
    assert known.outside(trials) == trials[1:]


def test_basin_of_a_crash_is_excluded_after_three_known_types_in_a_row():
    crashes = [crash(0.5, "rear end"), *[crash(x, "rear end") for x in (0.51, 0.52)]]
    assert not is_covered(known_after(*crashes), 0.6)
    fourth = crash(0.515, "rear end")
    assert is_covered(known_after(*crashes, fourth), 0.6)
    assert is_covered(known_after(*crashes, fourth), 0.67)
    assert not is_covered(known_after(*crashes, crash(0.505, "side swipe"), fourth), 0.6)
    assert not is_covered(known_after(*crashes, crash(0.9, "rear end")), 0.6)  # the fourth is in another basin


def test_a_new_type_in_an_excluded_basin_opens_it_again():
    known = known_after(*[crash(x, "rear end") for x in (0.5, 0.51, 0.52, 0.515)])
    assert is_covered(known, 0.6)
    known.add(crash(0.505, "side swipe"), along_a_diagonal())
    assert not is_covered(known, 0.6)


def test_basins_depend_on_the_order_of_criticality_alone():
    covered = []
    for scaled in (lambda score: score, lambda score: 0.45 * score, lambda score: score**2):
        known = known_after(crash(0.5), trials=along_a_diagonal(lambda x, to=scaled: to(score_of_two_peaks(x))))
        covered.append([is_covered(known, x) for x in np.linspace(0.5, 1.0, 200)])
    assert 40 < sum(covered[0]) < 160
    assert covered[0] == covered[1] == covered[2]


def test_basins_are_computed_again_when_trials_are_added():
    known, trials = known_after(crash(0.5)), along_a_diagonal()
    assert is_covered(known, 0.62)
    known.update([*trials, ScoredTrial(50, at(0.62), 50, 0.99), ScoredTrial(51, at(0.61), 51, 0.98)])
    assert is_covered(known, 0.55)
    untouched = known_after(crash(0.5, "rear end"))
    before = untouched._ground
    untouched.update(trials)
    assert untouched._ground is before  # no basin is excluded, so nothing is computed


def test_a_crash_is_new_by_its_type_and_without_one_by_its_place():
    known = known_after(crash(0.5, "rear end"))
    assert not known.is_new(crash(0.9, "rear end", seed=101))
    assert known.is_new(crash(0.5, "side swipe", seed=101))
    known = known_after(crash(0.5))
    assert not known.is_new(crash(0.6, seed=101))
    assert known.is_new(crash(0.9, seed=101))
    assert not known.is_new(crash(0.9, seed=100))  # the same traffic


def test_the_traffic_of_a_crash_is_known_wherever_its_arguments_are_until_96_crashes_later():
    known = known_after(crash(0.5, "rear end", seed=7), trials=[])
    assert is_covered(known, 0.9, 7)
    assert not is_covered(known, 0.9, 8)
    trials = [crash(0.9, seed=seed) for seed in (7, 8)]
    assert known.outside(trials) == [trials[1]]
    for seed in range(8, 8 + 96):
        known.add(crash(0.5, f"{seed}", seed), [])
    assert not is_covered(known, 0.9, 7)
    assert is_covered(known, 0.9, 8)


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

    kinds = found(0)
    assert len(set(kinds)) >= 3
    assert len(kinds) < 60
