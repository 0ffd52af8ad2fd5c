"""What every trial has in a step that somebody has chosen."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given, strategies as st

from crashhunt.disturbances import disturber_of, is_fixed, parse_fixed, parse_rates, signals_of_fixed, word_of
from crashhunt.errors import UsageError
from crashhunt.trial import CELLS, KINDS, Disturbance, InputSignal, TrialResult, TrialSpec, why_not

STOP = Disturbance(20, "ahead", "stop", 6.0, 8.0, "ego")
disturbances = st.builds(
    Disturbance, st.integers(1, 10**6), st.sampled_from(CELLS), st.sampled_from(list(KINDS)), st.floats(0, 100),
    st.floats(1e-3, 1e3), st.sampled_from(["ego", "van.2"]),
).filter(lambda one: why_not(one) is None)  # fmt: skip


def disturber(fixed, **rates):
    return disturber_of(rates, agents=("ego",), step_length_s=0.1, known=("brake", "stop"), fixed=fixed)


@given(st.lists(disturbances, unique_by=lambda one: (one.step, one.agent, one.what), max_size=4))
def test_words_and_disturbances_say_the_same(some):
    agents = ("ego", "van.2")
    words = [word_of(one, agents) for one in some]
    assert parse_fixed(words, agents) == tuple(sorted(some, key=lambda one: (one.step, one.agent, one.what)))
    assert all(map(is_fixed, words))
    assert not any(" " in word or "," in word for word in words)
    assert parse_rates(words) == {}


@given(st.text(max_size=30))
def test_any_word_is_a_disturbance_or_refused(text):
    try:
        found = parse_fixed([f"@{text}"], ("ego",))
        found += parse_fixed([f"brake@{text}"], ("ego",))
    except UsageError as error:
        assert error.fix
    else:
        assert all(why_not(one) is None and one.step >= 1 for one in found)


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("brake@124", "'brake@124' is not a disturbance; write KIND@STEP="),
        ("brake@0=ahead:4:2", "is not a disturbance"),
        ("brake@-1=ahead:4:2", "is not a disturbance"),
        ("brake@9=ahead:4", "is not a disturbance"),
        ("@9=ahead:4:2", "is not a disturbance"),
        ("brake@9=above:4:2", "'above' is not a place"),
        ("brake@9=ahead:-4:2", "the strength is -4"),
        ("brake@9=ahead:much:2", "the strength is nan"),
        ("brake@9=ahead:4:0", "the duration is 0"),
        ("dawdle@9=ahead:1.5:2", "dawdle of 1.5 is more than all"),
        ("late_action@9=ahead:1:2", "late_action is not about 'ahead'; it is about itself"),
        ("brake@9=itself:4:2", "brake is not about 'itself'"),
        ("van.brake@9=ahead:4:2", "there is no controlled vehicle 'van'"),
    ],
)
def test_what_cannot_be_meant_is_refused(word, says):
    with pytest.raises(UsageError) as caught:
        parse_fixed([word], ("ego",))
    assert says in str(caught.value)
    assert word in str(caught.value)


def test_whose_it_is_must_be_said_where_there_are_several():
    with pytest.raises(UsageError, match=r"names no agent.*ego.stop@…"):
        parse_fixed(["stop@20=ahead:6:8"], ("ego", "van.2"))
    assert parse_fixed(["van.2.stop@20=ahead:6:8"], ("ego", "van.2"))[0].agent == "van.2"
    with pytest.raises(UsageError, match="another stop already begins at step 20"):
        parse_fixed(["stop@20=ahead:6:8", "ego.stop@20=ahead:1:8"], ("ego",))


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("cut_in", "does not support the disturbance 'cut_in'; it supports brake"),
        ("hop", "no kind of disturbance 'hop'"),
    ],
)
def test_what_the_simulator_cannot_do_is_refused(what, says):
    with pytest.raises(UsageError, match=says):
        disturber([Disturbance(1, "ahead", what, 1.0, 1.0, "ego")])


def test_every_trial_has_it_and_what_is_drawn_besides_is_what_it_was():
    alone, both = disturber((), brake=1.0).draw(7, 100), disturber((STOP,), brake=1.0).draw(7, 100)
    assert set(both) == {*alone, STOP}
    assert list(both) == sorted(both, key=lambda one: one.step)
    assert STOP not in disturber((STOP,), brake=1.0).draw(7, 19)


def test_what_is_fixed_is_no_part_of_the_likelihood():
    alone, both = disturber((), brake=1.0), disturber((STOP,), brake=1.0)
    drawn = alone.draw(7, 60)
    assert math.isclose(both.log_likelihood([*drawn, STOP], 60), alone.log_likelihood(drawn, 60))
    nothing = disturber((STOP,))
    result = TrialResult(TrialSpec(0, 1, {}, {}, 60, disturbances=(STOP,)), "survived", steps=60)
    assert nothing.log_likelihood_of(result) is None


def test_where_it_is_fixed_whether_it_is_drawn_as_well_makes_no_difference():
    """With a rate of one a step, it is drawn in every one; the fixed one is there instead of the drawn."""
    fixed = Disturbance(3, "ahead", "brake", 9.0, 9.0, "ego")
    always = disturber((fixed,), brake=10.0)
    drawn = always.draw(1, 5)
    assert [one.how_strong == 9.0 for one in drawn] == [False, False, True, False, False]
    without = [one for one in disturber((), brake=10.0).draw(1, 5) if one.step != 3]
    model = always.models["brake"]
    expected = sum(model.log_likelihood(one) for one in without)
    assert math.isclose(always.log_likelihood(drawn, 5), expected)


def test_a_branch_keeps_what_is_fixed_after_it_and_what_has_begun_is_not_reported_again():
    draws = disturber([STOP], brake=0.5)
    for number in range(20):
        assert STOP in draws.draw_another(3, number, 10, 5, 40)
        assert STOP not in draws.draw_another(3, number, 20, 5, 40)
        assert all(one.step > 10 for one in draws.draw_another(3, number, 10, 5, 40))


def test_a_strength_may_be_a_signal_and_is_at_most_its_upper_bound():
    words = ["brake=0.1", "brake@20=ahead:signal:0:6:points=3:kind=constant:3", "stop@20=ahead:6:8"]
    brake, stop = parse_fixed(words, ("ego",))
    assert (brake, stop) == (Disturbance(20, "ahead", "brake", 6.0, 3.0, "ego"), STOP)
    assert signals_of_fixed(words, ("ego",)) == {"brake@20": (brake, "signal:0:6:points=3:kind=constant", words[1])}
    took_place = replace(brake, how_strong=4.0).following(InputSignal((1.0, 5.0, 2.0), "constant", 3.0), 0.5)
    assert (took_place.strengths, took_place.how_strong) == ((1, 1, 4, 4, 2, 2), 4.0)
    assert [took_place.strength_in(step) for step in (0, 5, 9)] == [1, 2, 2]
    assert took_place.words.endswith("brakes with up to 4 m/s² for 3 s")
    with pytest.raises(UsageError, match="another signal is already called brake@20"):
        signals_of_fixed([f"{agent}.{words[1]}" for agent in "ab"], ("a", "b"))
    with pytest.raises(UsageError, match="below 0"):
        parse_fixed(["brake@20=ahead:signal:-1:6:3"], ("ego",))
