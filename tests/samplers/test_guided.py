"""The portfolio: what it measures the model against, and how many trials the model has."""

from __future__ import annotations

import copy
import functools
import math

import numpy as np
import pytest
from spaces import ask, spec_of

from crashhunt.samplers import Cube, GuidedSampler, HuntFacts, NamedSampler
from crashhunt.samplers._guided import Peaks, Portfolio
from crashhunt.samplers._learning import ScoredTrial
from crashhunt.space import Choice, Range
from crashhunt.trial import Outcome, TrialResult

SPACE = {("ego", name): Range(0.0, 1.0) for name in "xy"}
PLACES = np.random.default_rng(1).random((400, 2))
ORDER = (
    "rhhhhrMMhMrMMhMrhhhhrMhMMrhMMhrMhhMrhhhhrMMMMrMMMMrMMMMrhMMMrMMMhrhMMhrMMhhrhhMhrhMhMrMMMMrhMhMrhMhMrMhhMrMhhM"
    "rhMhMrhMhMrMhMhrhMhMrMhMhrMhhMrhMhhrhMMMrhhMMrhhhh"
)
"""The origin of each trial: r is random, h the even search, M the model."""
EXAMPLES = (
    (6, 1, 1, 2, "c", 0.140904965848, 19.907727678),
    (23, 10, 12, 3, "b", 0.252606461152, 36.3482439369),
    (44, 10, 34, 5, "b", 0.309534205846, 30.0550818037),
    (72, 57, 57, 6, "b", 0.280770520203, 26.5331487658),
    (104, 101, 101, 6, "b", 0.29252860552, 30.614367232),
    (131, 101, 106, 6, "b", 0.292464964451, 34.1304091916),
)
"""Number, seed, parent and arguments of some trials of the model."""


def portfolio_told(*trials):
    """One that was told origins and scores, each trial somewhere else."""
    return copy.deepcopy(_portfolio_told(*trials))


@functools.cache
def _portfolio_told(*trials):
    made = Portfolio(Cube(SPACE), SPACE, HuntFacts())
    for number, (origin, score) in enumerate(trials):
        made.tell(ScoredTrial(number, PLACES[number], number, score, origin))
    return made


def proposals(made, first, many=40):
    return [made.propose(place, np.random.default_rng(place)) for place in range(first, first + many)]


def share_of_the_model(made, first, many=60):
    return sum(draft.origin == "model" for draft in proposals(made, first, many)) / many


RISING = [("random", 0.01 * number) for number in range(100)]


def test_the_model_is_measured_against_all_that_nothing_guided_and_nothing_else():
    trials = [("random", 0.1), ("halton", 0.2), ("start", 0.3), ("model", 0.4)]
    assert portfolio_told(*trials, ("random", 1.0), ("model", 1.0))._unguided == [0.1, 0.2, 0.3, 1.0]


def test_the_model_proposes_only_where_its_payoff_exceeds_one_and_a_half():
    def share(score):
        """After 30 trials of the model, of which the last made progress."""
        return share_of_the_model(portfolio_told(*RISING, *[("model", score)] * 30, ("random", 0.9999)), 131)

    assert share(0.6) < 0.05  # a payoff of log 2.5 is 0.9
    assert 0.1 < share(0.765) < 0.6  # 1.45
    assert share(0.9) > 0.8  # 2.3


def test_a_model_without_any_trial_is_believed_in_and_one_trial_changes_that():
    assert share_of_the_model(portfolio_told(*RISING), 100) == pytest.approx(1 - math.exp(-2 / 1.5), abs=0.1)
    assert share_of_the_model(portfolio_told(*RISING, ("model", 0.5)), 101) < 0.7


def test_share_of_a_peak_falls_by_e_in_14_trials_of_the_model_for_each_argument_without_progress():
    def weight(*trials):
        made = [
            ScoredTrial(number, np.array([0.5, 0.5]) + 1e-4 * number, number, score, origin)
            for number, (origin, score) in enumerate(trials)
        ]
        return next(iter(Peaks([*made, ScoredTrial(99, np.zeros(2), 99, -1.0)], 2).weights.values()))

    first = ("random", 0.5)
    assert weight(first) == 1.0
    assert weight(first, *[("model", 0.4)] * 28) == pytest.approx(math.exp(-1))
    assert weight(first, *[("random", 0.4)] * 28) == 1.0
    assert weight(first, *[("model", 0.4)] * 28, ("model", 0.74)) == pytest.approx(math.exp(-29 / 28))
    assert weight(first, *[("model", 0.4)] * 28, ("model", 0.76)) == 1.0  # half of the distance to 1
    assert weight(first, *[("model", 0.4)] * 28, ("halton", 0.76)) == 1.0
    assert weight(("model", 0.0)) == pytest.approx(math.exp(-1 / 28))


def test_what_the_highest_peak_does_not_get_other_peaks_and_the_even_search_share():
    def score(point):
        return max(0.9 - 2.0 * float(np.linalg.norm(point - 0.2)), 0.8 - 2.0 * float(np.linalg.norm(point - 0.8)), 0.0)

    made = Portfolio(Cube(SPACE), SPACE, HuntFacts())
    for number in range(60):
        made.tell(ScoredTrial(number, PLACES[number], number, score(PLACES[number]), "random"))

    def places(first):
        drafts = [draft for draft in proposals(made, first) if draft.origin == "model"]
        points = np.array([draft.point for draft in drafts]).reshape(-1, 2)
        return [int((np.linalg.norm(points - peak, axis=1) < 0.3).sum()) for peak in (0.2, 0.8)]

    highest, other = places(60)
    assert highest > 10 * other
    for number in range(60, 160):
        if number % 5:
            made.tell(ScoredTrial(number, np.array([0.2, 0.2]) + 1e-4 * number, number, 0.89, "model"))
        else:
            made.tell(ScoredTrial(number, PLACES[number], number, score(PLACES[number]), "random"))
    highest, other = places(160)
    assert other > 3 * highest
    even = sum(draft.origin == "halton" for draft in proposals(made, 160))
    assert 0.5 * other < even < 2 * other


def test_distance_between_peaks_is_that_of_trials_that_nothing_guided():
    even = [ScoredTrial(number, np.array([0.1 * number, 0.0]), number, 0.9 - 0.1 * number) for number in range(9)]
    dense = [
        ScoredTrial(number, np.array([1e-3 * (number - 8), 0.0]), number, 0.95, "model") for number in range(9, 60)
    ]
    assert len(Peaks([*even, *dense], 2).weights) == len(Peaks([*even, dense[0]], 2).weights)


def test_where_all_trials_are_as_critical_there_is_no_peak_that_is_worth_a_trial():
    assert share_of_the_model(portfolio_told(*[("random", 0.0)] * 40), 40) == 0.0
    assert share_of_the_model(portfolio_told(*[("random", 0.0)] * 40, ("random", 0.1)), 41) > 0.5


@pytest.mark.parametrize(("name", "version"), [("guided", 7), ("mutation", 2), ("cross-entropy", 2), ("cma-es", 2)])
def test_hunts_of_another_version_are_recognized(name, version):
    assert NamedSampler(name, SPACE, points=4).version == version


def test_traffic_of_the_parent_does_not_count_as_payoff_as_far_as_it_explains_danger():
    def earned(score, seed, odds=-2.0):
        made = portfolio_told(*RISING)
        made._model.parameters = made._model.parameters._replace(seeded=odds)
        made.tell(ScoredTrial(100, PLACES[100], seed, score, "model", parent=99))
        return made._earned - 2.0

    payoff = math.log(101 / 1.5)
    assert earned(0.985, 99, odds=0.0) == pytest.approx(0.5 * payoff + 0.5)
    assert earned(0.985, 99, odds=9.0) == pytest.approx(1.0, abs=0.02)
    assert earned(0.99, 99, odds=9.0) == pytest.approx(1.0, abs=0.02)  # as critical as its parent
    assert earned(0.985, 99, odds=-9.0) == pytest.approx(payoff, abs=0.02)
    assert earned(0.005, 99, odds=9.0) == earned(0.005, 99, odds=-9.0) == pytest.approx(math.log(101 / 99.5))
    assert earned(0.985, 100) == pytest.approx(payoff)
    assert earned(0.995, 99) == pytest.approx(math.log(101 / 0.5))


def test_after_a_crash_the_model_learns_from_what_is_not_in_its_basin():
    made = portfolio_told(*[("random", 0.02 * number) for number in range(40)])
    fitted = made._model.parameters
    made.tell(ScoredTrial(40, PLACES[39] + 1e-3, 100, 1.0, "model"))
    assert made._model.parameters is fitted
    learned = {trial.number for trial in made._model.trials}
    assert 39 not in learned
    assert 5 < len(learned) < 40
    made.tell(ScoredTrial(41, PLACES[39] + 2e-3, 101, 0.9, "random"))
    assert 41 not in {trial.number for trial in made._model.trials}


def test_the_model_does_not_go_where_a_crash_is_known_and_the_even_search_does():
    def score(place):
        away, other = (float(np.linalg.norm(place - PLACES[number])) for number in (7, 17))
        return max(1.0 - 2.0 * away, 0.8 - 2.0 * other, 0.0)

    assert np.linalg.norm(PLACES[7] - PLACES[17]) > 0.5
    made = portfolio_told(*[("random", score(PLACES[number])) for number in range(60)])
    drafts = proposals(made, 60)

    def are_covered(origin):
        points = np.array([draft.point for draft in drafts if draft.origin == origin])
        return made._known.cover(points, np.full(len(points), -1)), points

    even, _ = are_covered("halton")
    guided, points = are_covered("model")
    assert even.any()
    assert len(guided) > 10
    assert not guided.any()
    assert np.median(np.linalg.norm(points - PLACES[17], axis=1)) < 0.25  # they climb the other peak


def test_after_a_crash_the_model_has_the_fewer_trials_the_fewer_new_types_it_finds_than_chance():
    def share(*crashes):
        made = portfolio_told(*[("random", 0.01 * number) for number in range(20)], *[("model", 0.3)] * 5)
        for number, (origin, kind) in enumerate(crashes, start=25):
            made.tell(ScoredTrial(number, PLACES[number], number, 1.0, origin, kind=kind))
        return sum(made._is_worthwhile(np.random.default_rng(place)) for place in range(400)) / 400

    before = share()
    assert before > 0.9
    guided = [("model", "side swipe"), ("model", "head-on"), ("model", "off road")]
    assert share(*guided) > 0.9
    luck = [("halton", f"{number}") for number in range(8)]
    assert share(*luck, *guided) < 0.75 * before
    assert share(*luck, *[("model", "0")] * 30) < 0.05


def test_without_a_type_a_crash_is_new_where_none_is_known_near_to_it():
    made = portfolio_told(*[("random", 0.01 * number) for number in range(60)])
    for number, place in enumerate((PLACES[7], PLACES[7] + 0.001, PLACES[17]), start=60):
        made.tell(ScoredTrial(number, place, number, 1.0, "model"))
    assert made._found == {True: (2.5, 4.0), False: (0.5, 61.0)}


def test_nothing_keeps_the_traffic_of_a_crash_that_is_known():
    made = portfolio_told(
        *[("random", 0.6 - 0.4 * float(np.linalg.norm(PLACES[number] - PLACES[7]))) for number in range(40)]
    )
    assert 7 in {draft.seed for draft in proposals(made, 40)}
    made.tell(ScoredTrial(40, np.clip(PLACES[7] + 0.4, 0.0, 1.0), 7, 1.0, "model", parent=7, kind="rear end"))
    made.tell(ScoredTrial(41, PLACES[7] + 0.05, 7, 0.9, "model", parent=7))  # which was under way
    assert {7, 41}.isdisjoint(trial.number for trial in made._model.trials)
    again = {draft.seed for draft in proposals(made, 42)}
    assert len(again) > 1
    assert 7 not in again


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
    words = {"random": "r", "halton": "h", "model": "M"}
    assert "".join(words[one.origin] for one in asked) == ORDER
    for number, seed, parent, n, w, x, y in EXAMPLES:
        one = asked[number]
        assert (one.seed, one.parent) == (seed, parent)
        wanted = {("", "n"): n, ("", "w"): w, ("ego", "x"): pytest.approx(x), ("ego", "y"): pytest.approx(y)}
        assert dict(one.arguments) == wanted
