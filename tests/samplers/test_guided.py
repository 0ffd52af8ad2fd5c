"""The portfolio: whom it measures strategies against, and who has how many trials."""

from __future__ import annotations

import numpy as np

from crashhunt.samplers import Cube, HuntFacts
from crashhunt.samplers._guided import Portfolio
from crashhunt.samplers._told import Told
from crashhunt.space import Range

SPACE = {("ego", name): Range(0.0, 1.0) for name in "xy"}
PLACES = np.random.default_rng(1).random((400, 2))


def portfolio_told(*trials):
    """One that was told origins and scores, each trial somewhere else."""
    made = Portfolio(Cube(SPACE), SPACE, HuntFacts())
    for number, (origin, score) in enumerate(trials):
        made.tell(Told(number, PLACES[number], number, score, origin))
    return made


def test_strategies_are_measured_against_all_that_nothing_guided_and_nothing_else():
    trials = [("random", 0.1), ("halton", 0.2), ("start", 0.3), ("model", 0.4), ("mutation", 0.5), ("niche", 0.6)]
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
    assert sum(stuck._shares().values()) < 0.1 < sum(portfolio_told(*trials, ("model", 0.895))._shares().values())


def test_as_long_as_nothing_came_near_strategies_have_a_third_at_most():
    trials = [("random", 0.02 * number) for number in range(10)]
    far, near = (portfolio_told(*trials, *[("model", score)] * 6)._shares() for score in (0.45, 0.55))
    assert 0.3 < sum(far.values()) < 0.37 < 0.6 < sum(near.values()) < 0.73
    assert far["model"] > 2 * far["mutation"]


def test_after_a_crash_strategies_begin_anew_with_what_is_not_near_to_it():
    made = portfolio_told(*[("random", 0.02 * number) for number in range(40)])
    model, mutation = made._strategies.values()
    middle = PLACES[7]
    made.tell(Told(40, middle, 40, 1.0, "model"))
    assert not {model, mutation} & {*made._strategies.values()}
    assert made._model._parameters is model._parameters  # what was fitted stays
    outside = [number for number in range(40) if np.linalg.norm(PLACES[number] - middle) >= 0.1 * 2**0.5]
    assert 20 < len(outside) < 40
    for strategy in (made._strategies["mutation"]._corpus, made._strategies["model"]._best):
        assert sorted(told.number for told in strategy) == outside
    again = [*made._strategies.values()]
    made.tell(Told(41, middle + 0.05, 41, 1.0, "model"))  # nothing new
    assert [*made._strategies.values()] == again
    made.tell(Told(42, middle + 0.02, 42, 0.9, "random"))
    assert all(told.number != 42 for told in made._strategies["mutation"]._corpus)


def test_no_strategy_goes_where_a_crash_is_known_and_the_even_search_does():
    trials = [("random", 1.0 - float(np.linalg.norm(PLACES[number] - PLACES[7]))) for number in range(60)]
    made = portfolio_told(*trials)
    assert trials[7][1] == 1.0  # it is one
    drafts = [made.propose(number, np.random.default_rng(number)) for number in range(60, 120)]
    even = [made._known.cover(draft.point) for draft in drafts if draft.origin == "halton"]
    others = [made._known.cover(draft.point) for draft in drafts if draft.origin != "halton"]
    assert any(even)
    assert others
    assert not any(others)
