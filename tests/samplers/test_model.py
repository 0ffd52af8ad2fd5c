"""The model of danger: what it makes of trials, and that it tells traffic from arguments."""

from __future__ import annotations

import numpy as np
import pytest

from crashhunt.samplers import Cube
from crashhunt.samplers._model import TRIALS, Model, Process, _Parameters
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


def model_of(known):
    model = Model(PLANE)
    for number in range(1, len(known) + 1):
        model.learn(known[max(0, number - TRIALS) : number])
    return model


def test_noise_and_arguments_are_distinguished():
    luck = np.random.default_rng(5)
    clear = model_of([*trials(lambda point, _: float(1 - abs(point - 0.6).sum() / 2), 60)])
    blurred = model_of([*trials(lambda *_: float(luck.random()), 60)])
    assert clear.parameters.shares[0] < 0.2 < blurred.parameters.shares[0]


def test_fit_moves_a_length_a_share_or_all_lengths_by_one_step_or_begins_again():
    start = _Parameters(np.array([1.0, -1.0]), 0.0, 2.0)
    found = [start.stepped(turn, 1) for turn in range(10)]
    assert [one.lengths.tolist() for one in found[:3]] == [[2, -1], [1, -1], [2, 0]]
    assert [(one.noise, one.seeded) for one in found[:5]] == [(0, 2), (2, 2), (0, 2), (-2, -2), (0, 4)]
    assert found[5].lengths.tolist() == [1, 0]
    assert start.stepped(3, -1).noise == -4
    assert [start.stepped(turn, 1).lengths.tolist() for turn in range(3, 33, 5)] == [
        [-length] * 2 for length in (0, 1, 2, 3, 4, 0)
    ]


def test_a_fit_with_much_noise_is_left_for_short_lengths_without_noise():
    cube = Cube({("ego", "x"): Range(0.0, 1.0)})
    model = Model(cube)
    points = np.linspace(0.0, 1.0, 60)[:, None]
    known = [ScoredTrial(number, point, number, float(np.sin(20 * point[0]))) for number, point in enumerate(points)]
    model.remember(known)
    model.parameters = _Parameters(np.zeros(1), 2.0, -2.0)
    for _ in range(40):
        model.learn(known)
    assert model.parameters.shares[0] < 0.2
    assert model.parameters.lengths[0] < -1


def test_shares_stay_between_half_a_value_of_an_argument_and_the_rest():
    for odds, share in ((-50.0, 0.5 / TRIALS), (0.0, 0.5), (50.0, 1.0 - 0.5 / TRIALS)):
        assert _Parameters(np.zeros(2), odds, odds).shares == pytest.approx((share, share))


def test_a_model_proposes_as_soon_as_there_are_more_trials_than_arguments():
    model, few = Model(PLANE), [*trials(lambda *_: 0.5, 3)]
    for number in range(3):
        assert model.propose(np.random.default_rng(1)) is None
        model.learn(few[: number + 1])
    assert model.propose(np.random.default_rng(1)) is not None


def test_a_model_proposes_what_leads_uphill():
    model = model_of([*trials(lambda point, _: float(1 - np.linalg.norm(point - 0.8)), 25)])
    drafts = [model.propose(np.random.default_rng(number)) for number in range(40)]
    assert np.median([np.linalg.norm(draft.point - 0.8) for draft in drafts]) < 0.25


def test_a_model_proposes_nothing_that_is_excluded():
    model = model_of([*trials(lambda point, _: float(1 - np.linalg.norm(point - 0.8)), 25)])
    draft = model.propose(np.random.default_rng(1), lambda points, _: points[:, 0] > 0.5)
    assert draft is not None
    assert draft.point[0] <= 0.5
    assert model.propose(np.random.default_rng(1), lambda points, _: np.ones(len(points), dtype=bool)) is None


def test_a_model_climbs_another_peak_where_only_its_trials_are_parents():
    def two(point, _):
        return float(max(0.9 - np.linalg.norm(point - 0.8), 0.6 - 2 * np.linalg.norm(point - 0.2)))

    model = model_of([*trials(two, 60)])
    around = np.array([np.linalg.norm(trial.point - 0.2) < 0.3 for trial in model.trials])
    drafts = [
        model.propose(
            np.random.default_rng(number), lambda points, _: np.linalg.norm(points - 0.2, axis=1) > 0.3, around
        )
        for number in range(20)
    ]
    assert {draft.parent for draft in drafts} <= {
        trial.number for trial, near in zip(model.trials, around, strict=True) if near
    }
    assert np.median([np.linalg.norm(draft.point - 0.2) for draft in drafts]) < 0.2
    assert model.propose(np.random.default_rng(1), None, np.zeros(60, dtype=bool)) is None


def test_best_score_to_exceed_is_that_of_the_given_trials():
    known = process([[0.0], [0.5], [1.0]], [0.1, 0.2, 0.9])
    asked = np.array([[0.02], [0.97]]), np.array([-1, -1]), 0.1
    assert (known.worth(*asked, np.array([True, True, False])) > known.worth(*asked)).all()


def test_what_is_most_dangerous_has_most_neighbours_and_each_candidate_is_one_of_its_parent():
    known = np.array([np.full(2, (place + 0.5) / 12) for place in range(12)])
    points, places, kept = Model(PLANE)._candidates(known, np.random.default_rng(1))
    assert places.mean() < 5
    away = np.abs(points - known[places]).min(axis=1)
    assert (away < 1e-12).mean() > 0.1  # one of two arguments is as its parent's
    assert 0.2 < kept.mean() < 0.6
