"""The portfolio: what it measures the model against, and how many trials the model has."""

from __future__ import annotations

import numpy as np
import pytest
from spaces import ask, spec_of

from crashhunt.samplers import Cube, GuidedSampler, HuntFacts, NamedSampler
from crashhunt.samplers._guided import Niches, Portfolio
from crashhunt.samplers._model import Model
from crashhunt.samplers._strategy import ScoredTrial
from crashhunt.space import Choice, Range
from crashhunt.trial import Outcome, TrialResult

SPACE = {("ego", name): Range(0.0, 1.0) for name in "xy"}
PLACES = np.random.default_rng(1).random((400, 2))


def portfolio_told(*trials):
    """One that was told origins and scores, each trial somewhere else."""
    made = Portfolio(Cube(SPACE), SPACE, HuntFacts())
    for number, (origin, score) in enumerate(trials):
        made.tell(ScoredTrial(number, PLACES[number], number, score, origin))
    return made


def test_strategies_are_measured_against_all_that_nothing_guided_and_nothing_else():
    trials = [("random", 0.1), ("halton", 0.2), ("start", 0.3), ("model", 0.4), ("niche", 0.6)]
    assert portfolio_told(*trials, ("random", 1.0), ("model", 1.0))._unguided == [0.1, 0.2, 0.3, 1.0]


def test_peaks_besides_the_highest_wear_out_nobodys_patience_but_their_own():
    trials = [("random", 0.05 * number) for number in range(10)]
    stuck = portfolio_told(*trials, *[("model", 0.895)] * 20)
    assert stuck._is_stuck
    assert not portfolio_told(*trials, *[("model", 0.895)] * 14)._is_stuck
    assert not portfolio_told(*trials, *[("model", 0.895)] * 6, *[("niche", 0.895)] * 20)._is_stuck
    assert not portfolio_told(*trials, *[("random", 0.895)] * 20)._is_stuck
    assert stuck._niches._foot is not None  # it looks for another one
    assert portfolio_told(*trials, *[("model", 0.895)] * 14)._niches._foot is None
    assert stuck._share() < 0.1 < portfolio_told(*trials, ("model", 0.895))._share()


def test_as_long_as_nothing_came_near_the_model_has_a_third_at_most():
    trials = [("random", 0.02 * number) for number in range(10)]
    far, near = (portfolio_told(*trials, *[("model", score)] * 6)._share() for score in (0.45, 0.55))
    assert (far, near) == (0.35, 0.7)


def test_the_model_has_the_fewer_trials_the_less_its_payoff_exceeds_that_of_chance():
    trials = [("random", 0.01 * number) for number in range(100)]

    def share(score):
        return portfolio_told(*trials, *[("model", score)] * 100)._share()

    assert share(0.5) == 0.02  # a payoff of log 2 is below the mean
    assert 0.1 < share(0.8) < 0.4  # log 5 is 1.6
    assert share(0.9) == 0.7


def test_strategies_far_more_critical_than_most_unguided_trials_are_stuck_without_progress():
    trials = [("random", 0.015 * number) for number in range(60)]
    assert portfolio_told(*trials, *[("model", 0.88)] * 20)._is_stuck  # above 59 of 60, a payoff of 3.7
    assert not portfolio_told(*trials, *[("model", 0.74)] * 20)._is_stuck  # above 50 of 60, a payoff of 1.8


def test_strategies_are_ahead_only_of_unguided_trials_that_are_less_critical():
    trials = [("random", 0.6)] * 12
    assert portfolio_told(*trials, *[("model", 0.6)] * 10)._ahead == 0.0
    assert portfolio_told(*trials, *[("model", 0.61)] * 10)._ahead == pytest.approx(1.0 - 0.9**10)


def test_next_peak_is_searched_after_12_trials_and_then_32_trials_after_each_failure():
    niches = Niches(Cube(SPACE), Model(Cube(SPACE)))
    searched = []
    for number in range(80):
        niches.tell(ScoredTrial(number, PLACES[number], number, 0.0))  # equal everywhere, so there is no peak
        before = niches._not_before
        niches.begin()
        if niches._not_before != before:
            searched.append(number + 1)
    assert searched == [12, 44, 76]


@pytest.mark.parametrize(("name", "version"), [("guided", 3), ("mutation", 2), ("cross-entropy", 2), ("cma-es", 2)])
def test_hunts_of_another_version_are_recognized(name, version):
    assert NamedSampler(name, SPACE, points=4).version == version


def test_another_peak_is_abandoned_where_danger_stays_as_far_from_a_crash():
    cube = Cube(SPACE)

    def is_climbed(nearer, trials):
        niches = Niches(cube, Model(cube))
        for number in range(40):
            niches.tell(ScoredTrial(number, PLACES[number], number, 0.01 * number))
        niches.begin()
        foot = niches._foot
        for number in range(40, 40 + trials):
            niches.tell(ScoredTrial(number, foot.point, number, 1.0 - nearer * (1.0 - foot.score), "niche"))
        return niches._foot is foot

    assert is_climbed(0.86, 6)
    assert not is_climbed(0.86, 7)  # five, and one for each argument
    assert is_climbed(0.84, 7)
    assert not is_climbed(0.84, 8)


def test_after_a_crash_the_model_begins_again_with_what_is_not_in_its_basin():
    made = portfolio_told(*[("random", 0.02 * number) for number in range(40)])
    model = made._model
    middle = PLACES[7]
    made.tell(ScoredTrial(40, middle, 40, 1.0, "model"))
    assert made._model is not model
    assert made._model._parameters is model._parameters  # what was fitted stays
    near = {number for number in range(40) if np.linalg.norm(PLACES[number] - middle) < 0.1 * 2**0.5}
    outside = [number for number in range(40) if not made._known.cover(PLACES[number])]
    assert near
    assert near.isdisjoint(outside)
    assert 10 < len(outside) < 40
    assert sorted(told.number for told in made._model._best) == outside
    again = made._model
    made.tell(ScoredTrial(41, middle + 0.05, 41, 1.0, "model"))  # nothing new
    assert made._model is again
    made.tell(ScoredTrial(42, middle + 0.02, 42, 0.9, "random"))
    assert all(told.number != 42 for told in made._model._best)


def test_no_strategy_goes_where_a_crash_is_known_and_the_even_search_does():
    def score(place):
        away, other = (float(np.linalg.norm(place - PLACES[number])) for number in (7, 17))
        return max(1.0 - 2.0 * away, 0.8 - 2.0 * other, 0.0)

    assert np.linalg.norm(PLACES[7] - PLACES[17]) > 0.5
    made = portfolio_told(*[("random", score(PLACES[number])) for number in range(60)])
    drafts = [made.propose(number, np.random.default_rng(number)) for number in range(60, 160)]
    even = [made._known.cover(draft.point) for draft in drafts if draft.origin == "halton"]
    others = [draft.point for draft in drafts if draft.origin != "halton"]
    assert any(even)
    assert len(others) > 10
    assert not any(made._known.cover(point) for point in others)
    assert np.median([np.linalg.norm(point - PLACES[17]) for point in others]) < 0.25  # they climb the other peak


def test_after_a_crash_strategies_are_drawn_the_less_the_fewer_new_types_they_find_than_chance():
    def drawn(*crashes):
        made = portfolio_told(*[("random", 0.01 * number) for number in range(10)], *[("model", 0.45)] * 12)
        for number, (origin, kind) in enumerate(crashes, start=22):
            made.tell(ScoredTrial(number, PLACES[number], number, 1.0, origin, kind=kind))
        return sum(bool(made._drawn(np.random.default_rng(place))) for place in range(400)) / 400

    before = drawn()
    assert 0.35 < before < 0.53
    one = ("random", "rear end")
    assert 0.1 * before < drawn(one) < 0.6 * before
    assert drawn(one, ("model", "side swipe"), ("niche", "head-on"), ("model", "off road")) > 0.6 * before
    luck = [("halton", f"{number}") for number in range(8)]
    assert drawn(*luck) < 0.25 * before
    assert drawn(*luck, *[("model", "0")] * 30) == pytest.approx(0.02 / 0.8, abs=0.03)  # probes alone


def test_without_manner_and_place_a_crash_is_new_where_none_is_known_near_to_it():
    made = portfolio_told(*[("random", 0.01 * number) for number in range(60)])
    for number, place in enumerate((PLACES[7], PLACES[7] + 0.01, np.array([0.99, 0.99]) - PLACES[7]), start=60):
        made.tell(ScoredTrial(number, place, number, 1.0, "model"))
    assert made._kinds == {True: (2.5, 4.0), False: (0.5, 61.0)}


def test_nothing_keeps_the_traffic_of_a_crash_that_is_known():
    made = portfolio_told(*[("random", 0.6 if number == 7 else 0.005 * number) for number in range(40)])

    def seeds(first):
        return [made.propose(place, np.random.default_rng(place)).seed for place in range(first, first + 60)]

    assert 7 in seeds(40)
    made.tell(ScoredTrial(40, np.clip(PLACES[7] + 0.4, 0.0, 1.0), 7, 1.0, "model", parent=7, kind="rear end"))
    assert not made._known.cover(PLACES[7])
    made.tell(ScoredTrial(41, PLACES[7] + 0.05, 7, 0.9, "model", parent=7))  # which was under way
    assert {7, 41}.isdisjoint(told.number for told in made._model._best)
    again = seeds(42)
    assert any(seed is not None for seed in again)
    assert 7 not in again
    made.tell(ScoredTrial(42, PLACES[9], 100, 0.95, "random"))
    assert 100 in seeds(43)
    model = made._model
    made.tell(ScoredTrial(43, np.clip(PLACES[7] + 0.41, 0.0, 1.0), 100, 1.0, "model", parent=42, kind="rear end"))
    assert made._model is model  # nothing new, so that it goes on
    assert 100 not in seeds(44)


def test_where_all_trials_are_as_dangerous_there_is_no_other_peak():
    cube = Cube(SPACE)
    niches = Niches(cube, Model(cube))
    for number in range(40):
        niches.tell(ScoredTrial(number, PLACES[number], number, 0.0))
    niches.begin()
    assert niches.propose(40, np.random.default_rng(1)) is None


def test_what_is_proposed_before_the_first_crash_is_what_it_was():
    """The published figures rest on it. All strategies have their turn, and danger leads nowhere in the end."""
    space = {("ego", "x"): Range(0.0, 1.0), ("ego", "y"): Range(1.0, 100.0, log=True)}
    space |= {("", "n"): Range(1, 9, integer=True), ("", "w"): Choice(("a", "b", "c"))}
    sampler, asked = GuidedSampler(space, hunt=HuntFacts(5)), []
    for number in range(160):
        asked.append(ask(sampler, number))
        spec = spec_of(number, asked[-1])
        (n, w), (x, y) = (tuple(of.values()) for of in (spec.scenario_arguments, spec.arguments["ego"]))
        away = 0.4 * abs(x - 0.3) + 0.2 * abs(np.log10(y) - 1.5) + 0.02 * abs(n - 6) + 0.1 * (w != "b")
        danger = round(0.85 - away - 0.15 * (spec.seed * 7919 % 101) / 101, 3)
        sampler.tell(TrialResult(spec, Outcome.SURVIVED, danger=danger))
    words = {"random": "r", "halton": "h", "model": "M", "niche": "n"}
    assert "".join(words[one.origin] for one in asked) == (
        "rhhhhrMMMhrhhhhrhhhhrhMhhrMhhhrhhhhrhhMMrMMMMrMMMMrMhhhrMMMMrMhMMrMMhMrhhhhrhhhhrhhhhrhhMMrhhhMrhhhhrhhhnrhhhMrh"
        "hhhrhhhhrhhhMrhhMhrhhhhrhhhhrhhhhrnhhhrhnMhrhhhh"
    )
    for number, seed, parent, n, w, x, y in (
        (8, 1, 1, 2, "a", 0.08388773606, 79.3810655082),
        (39, 1, 1, 5, "b", 0.25851476557, 22.0720469012),
        (59, 1, 39, 4, "b", 0.25880850712, 86.5473482466),
        (128, 30, 124, 9, "b", 0.30796978421, 32.8802697827),
        (153, 30, 67, 9, "b", 0.27381822640, 28.0759898208),
    ):
        one = asked[number]
        assert (one.seed, one.parent) == (seed, parent)
        wanted = {("", "n"): n, ("", "w"): w, ("ego", "x"): pytest.approx(x), ("ego", "y"): pytest.approx(y)}
        assert dict(one.arguments) == wanted
