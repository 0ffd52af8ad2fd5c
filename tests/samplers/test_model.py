"""The model of danger: what it makes of trials, and that it tells traffic from arguments."""

from __future__ import annotations

import numpy as np
import pytest

from crashhunt.samplers import Cube
from crashhunt.samplers._learning import ScoredTrial
from crashhunt.samplers._model import TRIALS, KnownTrials, Model, Process, _Parameters, _ranks
from crashhunt.space import Choice, Range

PLANE = Cube({("ego", "x"): Range(0.0, 1.0), ("ego", "y"): Range(0.0, 1.0)})


def process(points, scores, seeds=None, **parameters):
    points = np.array(points, dtype=float)
    told = {"scales": np.full(points.shape[1], 3.0), "noise": 0.01, "seeded": 0.0} | parameters
    seeds = np.arange(len(points)) if seeds is None else np.array(seeds)
    categorical = told.pop("categorical", np.zeros(points.shape[1], dtype=bool))
    known = KnownTrials(points, seeds, np.array(scores, dtype=float), categorical=categorical)
    return Process(known, **told)


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


def test_score_of_a_trial_is_the_share_that_is_below_it_and_half_of_its_equals():
    assert _ranks(np.array([0.0, 0.9, 0.0, 0.5])).tolist() == [0.25, 0.875, 0.25, 0.625]


def test_many_trials_at_a_peak_do_not_raise_what_is_expected_far_away():
    far = np.array([[-20.0]]), np.array([-1]), 0.0

    def expected(peak):
        """In units of the ranks, of which the least is 0 here, and the greatest is 1."""
        points, scores = [[4.0], [8.0], [12.0], *([0.001 * place] for place in range(peak))], [0.0] * 3 + [0.9] * peak
        known = process(points, scores)
        low, high = known._target.min(), known._target.max()
        assert known.worth(*far)[0] < 0
        return (known._mean - low) / (high - low)

    assert expected(1) == pytest.approx(0.25, abs=0.01)
    assert expected(60) == pytest.approx(0.25, abs=0.02)


def test_kernel_is_that_of_matern_with_five_halves():
    known = process([[0.0]], [0.5], scales=np.ones(1))
    found = known._to(np.array([[0.0], [1.0], [2.0]]), np.full(3, -1))[:, 0]
    assert found == pytest.approx([1.0, 0.523994, 0.138660], abs=1e-6)


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


def trials(danger_of, count, seeds=None, drawn_by=3):
    rng = np.random.default_rng(drawn_by)
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


def test_the_fewer_results_there_are_the_more_parameters_are_fitted_after_each():
    model, known = Model(PLANE), [*trials(lambda point, _: float(point[0]), 50)]
    fitted = {}
    for count in range(1, 51):
        before = model._turn
        model.learn(known[:count])
        fitted[count] = model._turn - before
    assert [fitted[count] for count in (2, 3, 10, 48, 49)] == [0, 32, 9, 2, 1]
    before = model._turn
    model.learn(known[:4])  # as after a crash, whose basin is left out
    assert model._turn - before == 1


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

    away = []
    for drawn_by in range(4):
        model = model_of([*trials(two, 60, drawn_by=drawn_by)])
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
        away += [np.linalg.norm(draft.point - 0.2) for draft in drafts]
    assert np.median(away) < 0.15  # 0.21 of points that are drawn at random around the peak
    assert model.propose(np.random.default_rng(1), None, np.zeros(60, dtype=bool)) is None


def test_best_score_to_exceed_is_that_of_the_given_trials():
    known = process([[0.0], [0.5], [1.0]], [0.1, 0.2, 0.9])
    asked = np.array([[0.02], [0.97]]), np.array([-1, -1]), 0.1
    assert (known.worth(*asked, np.array([True, True, False])) > known.worth(*asked)).all()


def test_what_is_most_dangerous_has_most_neighbours_and_each_candidate_is_one_of_its_parent():
    known = np.array([np.full(2, (place + 0.5) / 12) for place in range(12)])
    points, places, kept = Model(PLANE)._candidates(known, np.random.default_rng(1))
    assert points.shape == (384, 2)
    assert places.mean() < 5
    away = np.abs(points - known[places]).min(axis=1)
    assert (away < 1e-12).mean() > 0.1  # one of two arguments is as its parent's
    assert 0.2 < kept.mean() < 0.6
