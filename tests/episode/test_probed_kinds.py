"""What copies are asked of each kind of disturbance: from as good as nothing to the worst that is plausible."""

from __future__ import annotations

import math

from crashhunt.disturbances import disturber_of
from crashhunt.episode._probes import PROBED
from crashhunt.trial import CELLS, KINDS, SENSOR_KINDS, steps_of


def test_every_kind_is_asked_for():
    assert sorted(kind.what for kind in PROBED) == sorted(KINDS)
    for kind in PROBED:
        assert set(kind.who) <= set(CELLS)
        assert (kind.who == ("itself",)) == (kind.what in SENSOR_KINDS)


def test_the_worst_is_one_that_the_models_draw():
    draws = disturber_of(dict.fromkeys(KINDS, 0.1), agents=("ego",), step_length_s=0.1)
    for kind in PROBED:
        for who in kind.who:
            assert math.isfinite(draws.log_likelihood([kind.disturbance(1.0, who, "ego", 3)], 10)), kind.what


def test_what_is_milder_is_weaker_shorter_or_earlier_and_some_only_happen_or_not():
    by_name = {kind.what: kind for kind in PROBED}

    def asked(what, share):
        one = by_name[what].disturbance(share, "ahead", "ego", 7)
        assert (one.step, one.agent, one.who, one.what) == (7, "ego", "ahead", what)
        return one.how_strong, one.how_long

    assert asked("brake", 0.5) == (3.0, 3.0)
    assert asked("dawdle", 0.25) == (0.125, 10.0)
    assert asked("unseen", 0.5) == (1.0, 2.0)
    assert asked("ignore_priority", 0.2) == (1.0, 1.0)
    assert asked("late_merge", 0.5) == (27.5, 10.0)  # m that are left of its lane
    assert asked("cut_in", 0.5) == asked("cut_in", 1.0) == (0.0, 4.0)
    assert asked("step_out", 0.5) == asked("step_out", 1.0) == (1.4, 6.0)


def test_what_is_graded_in_seconds_is_asked_for_in_whole_steps():
    by_name = {kind.what: kind for kind in PROBED}

    def asked(what, dt):
        kind = by_name[what]
        some = [kind.disturbance(share, "ahead", "ego", 7) for share in kind.shares(dt)]
        return [one.how_long if kind.grade == "length" else one.how_strong for one in some]

    assert asked("late_action", 0.1) == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]
    assert asked("late_observation", 0.25) == [0.25, 0.5, 0.75, 0.9375]
    assert asked("late_action", 1.0) == [0.9375]  # one step, which is the worst already
    assert asked("late_action", 2.0) == []  # one step is more than the worst
    assert asked("unseen", 1.0) == [1.0, 2.0, 3.0, 3.75]
    assert asked("brake", 1.0) == [6.0 * share / 16 for share in range(1, 16)]
    assert len(asked("unseen", 0.01)) == 15
    for kind in PROBED:
        for dt in (0.02, 0.1, 0.2, 0.5, 1.0, 2.0):
            shares = kind.shares(dt)
            assert list(shares) == sorted(set(shares))
            assert all(0 < share <= 15 / 16 for share in shares)
            if kind.grade == "length":
                some = [kind.disturbance(share, "ahead", "ego", 7).how_long for share in shares]
                assert len({steps_of(long, dt) for long in some}) == len(some)
