"""The model of danger: what it makes of trials, and that it tells traffic from arguments."""

from __future__ import annotations

import numpy as np
import pytest

from crashhunt.samplers import Cube
from crashhunt.samplers._guided import Niches
from crashhunt.samplers._model import Model, Process
from crashhunt.samplers._strategy import ScoredTrial
from crashhunt.space import Choice, Range

PLANE = Cube({("ego", "x"): Range(0.0, 1.0), ("ego", "y"): Range(0.0, 1.0)})


def process(points, scores, seeds=None, **parameters):
    points = np.array(points, dtype=float)
    told = {"scales": np.full(points.shape[1], 3.0), "noise": 0.01, "seeded": 0.0}
    told |= {"categorical": np.zeros(points.shape[1], dtype=bool)} | parameters
    seeds = np.arange(len(points)) if seeds is None else np.array(seeds)
    return Process(points, seeds, np.array(scores, dtype=float), **told)


def test_what_is_near_a_dangerous_trial_is_worth_more_than_what_is_near_a_harmless_one():
    known = process([[0.0], [0.5], [1.0]], [0.1, 0.2, 0.9])
    near_worst, near_best = known.worth(np.array([[0.02], [0.97]]), np.array([-1, -1]), 0.1)
    assert near_best > near_worst


def test_the_more_is_wanted_the_further_from_what_is_known_it_looks():
    known = process([[0.0], [0.5], [1.0]], [0.1, 0.2, 0.9])
    near, far = np.array([[1.01], [2.5]]), np.array([-1, -1])
    assert [int(np.argmax(known.worth(near, far, ambition))) for ambition in (0.01, 5.0)] == [0, 1]


def test_only_the_order_of_scores_counts():
    points, scores = [[0.1], [0.4], [0.8]], np.array([0.1, 0.5, 0.4])
    asked = np.array([[0.3], [0.6]]), np.array([-1, -1]), 0.3
    assert process(points, scores).worth(*asked) == pytest.approx(process(points, scores**5).worth(*asked))


def test_the_seed_of_a_dangerous_trial_is_worth_more_than_that_of_a_harmless_one():
    known = process([[0.0], [0.3], [0.5]], [0.1, 0.9, 0.2], seeds=[7, 8, 9], seeded=0.8)
    kept, other = known.worth(np.array([[0.33]] * 2), np.array([8, 7]), 0.3)
    assert kept > other + 0.5
    told_nothing = process([[0.0], [0.3], [0.5]], [0.1, 0.9, 0.2], seeds=[7, 8, 9])
    assert len({*told_nothing.worth(np.array([[0.33]] * 2), np.array([8, 7]), 0.3).tolist()}) == 1


def test_a_value_of_a_choice_is_like_itself_and_unlike_all_others():
    flags = np.array([True])
    known = process([[0.0], [1.0], [2.0]], [0.1, 0.9, 0.2], categorical=flags)
    worth = known.worth(np.array([[0.0], [2.0], [3.0]]), np.full(3, -1), 0.3)
    assert np.argmax(worth) == 2  # nobody has tried that one
    cube = Cube({("", "word"): Choice(("a", "b", "c")), ("", "x"): Range(0.0, 1.0)})
    assert cube.values(np.array([[0.5, 0.5], [1.0, 0.2]])).tolist() == [[1.0, 0.5], [2.0, 0.2]]


def trials(danger_of, count, seeds=None):
    rng = np.random.default_rng(3)
    for number in range(count):
        point = rng.random(2)
        yield ScoredTrial(number, point, number if seeds is None else number % seeds, danger_of(point, number))


def test_noise_and_arguments_are_distinguished():
    luck = np.random.default_rng(5)
    clear, blurred = Model(PLANE), Model(PLANE)
    for told in trials(lambda point, _: float(1 - abs(point - 0.6).sum() / 2), 60):
        clear.tell(told)
    for told in trials(lambda *_: float(luck.random()), 60):
        blurred.tell(told)
    assert clear._parameters.noise < 3 < blurred._parameters.noise


def test_fit_moves_parameters_by_one_step_at_a_time():
    model, steps = Model(PLANE), set()
    for told in trials(lambda point, _: float(1 - abs(point - 0.6).sum() / 2), 60):
        before = model._parameters
        model.tell(told)
        after = model._parameters
        steps |= {after.noise - before.noise, after.seeded - before.seeded, *(after.lengths - before.lengths).tolist()}
    assert steps == {-1, 0, 1}


def test_a_model_proposes_as_soon_as_there_are_more_trials_than_arguments():
    model, few = Model(PLANE), [*trials(lambda *_: 0.5, 3)]
    for trial in few:
        assert model.propose(0, np.random.default_rng(1)) is None
        model.tell(trial)
    assert model.propose(0, np.random.default_rng(1)) is not None


def test_a_model_proposes_what_leads_uphill():
    model = Model(PLANE)
    for told in trials(lambda point, _: float(1 - np.linalg.norm(point - 0.8)), 25):
        model.tell(told)
    drafts = [model.propose(number, np.random.default_rng(number)) for number in range(40)]
    assert np.median([np.linalg.norm(draft.point - 0.8) for draft in drafts]) < 0.25
    assert len({draft.parent for draft in drafts}) > 2


def test_what_is_most_dangerous_has_most_neighbours_and_each_candidate_is_one_of_its_parent():
    model = Model(PLANE)
    best = [ScoredTrial(place, np.full(2, (place + 0.5) / 12), place, 0.9 - place / 20) for place in range(12)]
    points, places, kept = model._candidates(best, np.random.default_rng(1))
    assert places.mean() < 5
    away = np.array([np.abs(point - best[place].point).min() for point, place in zip(points, places, strict=True)])
    assert (away < 1e-12).mean() > 0.2  # one of two arguments is as its parent's
    assert 0.2 < kept.mean() < 0.6


def test_another_peak_is_climbed_where_the_highest_leads_nowhere():
    def two(point, _):
        return float(max(0.9 - np.linalg.norm(point - 0.8), 0.6 - 2 * np.linalg.norm(point - 0.2)))

    niches = Niches(PLANE, Model(PLANE))
    assert niches.propose(0, np.random.default_rng(0)) is None
    for told in trials(two, 60):
        niches.tell(told)
    niches.begin()
    drafts = [niches.propose(number, np.random.default_rng(number)) for number in range(20)]
    away = [np.linalg.norm(draft.point - 0.2) for draft in drafts if draft is not None]
    assert np.median(away) < 0.25
    niches.tell(ScoredTrial(59, np.array([0.8, 0.81]), 59, 0.95, "model"))
    foot = niches._foot.score
    assert niches._record == foot  # that is another peak
    niches.tell(ScoredTrial(60, np.array([0.2, 0.21]), 60, 0.7, "niche"))
    assert niches._record == 0.7 > foot
    for number in range(61, 70):
        niches.tell(ScoredTrial(number, np.array([0.21, 0.2]), number, 0.5, "niche"))
    assert niches.propose(70, np.random.default_rng(0)) is None  # it came no nearer, and so it was left
