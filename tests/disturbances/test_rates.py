"""How often what happens: the words, the draws, and how likely they are."""

from __future__ import annotations

import dataclasses
import itertools
import math
import zlib
from collections import Counter

import numpy as np
import pytest
from conftest import examples
from hypothesis import given, settings, strategies as st

from crashhunt.base.plugins import locate, registered
from crashhunt.disturbances import (
    Choices,
    DisturbanceSampler,
    Drawn,
    ModelApart,
    brake,
    disturber_of,
    parse_rates,
)
from crashhunt.errors import PluginError, UsageError
from crashhunt.testing import DisturbanceContract
from crashhunt.trial import KINDS, Disturbance, TrialResult

DT = 0.1
names = st.sampled_from(["brake", "cut_in", "a.b:C", "module:Class.part"])
rates = st.dictionaries(names, st.floats(0, 1e3), max_size=4)


class TestBuiltIn(DisturbanceContract):
    @pytest.fixture(params=sorted(registered("disturbances")))
    def make(self, request):
        return locate("disturbances", request.param)


def test_every_kind_has_a_model_of_its_name():
    assert {name: locate("disturbances", name)().what for name in registered("disturbances")} == {k: k for k in KINDS}


@given(rates)
def test_words_and_rates_say_the_same(given_rates):
    words = [f"{name}={rate!r}" for name, rate in given_rates.items()]
    found = parse_rates(words)
    assert found == {name: rate for name, rate in given_rates.items() if rate > 0}
    assert list(found) == sorted(found)
    assert parse_rates([f"{name}={rate!r}" for name, rate in found.items()]) == found


@given(st.text(max_size=20))
def test_any_word_is_a_rate_or_refused(word):
    try:
        found = parse_rates([word])
    except UsageError as error:
        assert error.fix
    else:
        assert all(0 < rate < math.inf for rate in found.values())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["brake"], "'brake' has no rate"),
        (["=1"], "'=1' has no rate"),
        (["brake=much"], "'much' is not a rate"),
        (["brake=-0.1"], "'-0.1' is not a rate"),
        (["brake=nan"], "'nan' is not a rate"),
        (["brake=inf"], "'inf' is not a rate"),
        (["brake=1", "brake=1"], "gives 'brake' twice"),
        (["none", "brake=1"], "none cannot be combined with other"),
    ],
)
def test_what_is_no_rate_is_refused(words, says):
    with pytest.raises(UsageError, match=says):
        parse_rates(words)


def test_none_is_nothing():
    assert parse_rates(["none"]) == parse_rates([]) == parse_rates(["brake=0"]) == {}


def make(known=("brake", "stop"), **found):
    return disturber_of(found, agents=("ego",), step_length_s=DT, known=known, simulator="the toy")


def other_brake():
    return brake()


def fails():
    raise OSError("no such table")


@pytest.mark.parametrize(
    ("found", "says"),
    [
        ({"brake": 10.1}, "brake=10.1: the rate exceeds one disturbance per step of 0.1 s"),
        ({"braek": 1}, "no disturbance 'braek'"),
        ({"cut_in": 1}, "the toy does not support the disturbance 'cut_in'"),
        ({"brake": 1, "test_rates:other_brake": 1}, "both inject disturbances of the kind 'brake'"),
        ({"test_rates:DT": 1}, "cannot be called"),
        ({"test_rates:fails": 1}, "cannot be created: OSError: no such table"),
        ({"os:getcwd": 1}, "not a disturbance model"),
    ],
)
def test_what_cannot_be_meant_is_refused(found, says):
    with pytest.raises((UsageError, PluginError), match=says) as caught:
        make(**found)
    assert caught.value.fix


def test_the_agents_own_eyes_can_err_on_every_simulator():
    assert make(known=(), late_observation=1, late_action=1, noisy_observation=1).models.keys() == {
        "late_observation", "late_action", "noisy_observation",
    }  # fmt: skip


@given(st.integers(0, 2**31 - 1), st.integers(1, 400), st.integers(0, 400))
def test_a_longer_trial_begins_with_the_same_disturbances(seed, steps, more):
    disturber = make(brake=0.5, stop=0.3)
    short, long = disturber.draw(seed, steps), disturber.draw(seed, steps + more)
    assert short == tuple(one for one in long if one.step <= steps)
    assert list(long) == sorted(long, key=lambda one: one.step)
    assert all(one.step >= 1 and one.agent == "ego" and not one.vehicle for one in long)


def test_another_model_or_agent_shifts_no_draw():
    alone = make(brake=0.5).draw(7, 500)
    assert alone
    both = make(brake=0.5, stop=0.5).draw(7, 500)
    assert tuple(one for one in both if one.what == "brake") == alone
    two = disturber_of({"brake": 0.5}, agents=("ego", "second"), step_length_s=DT).draw(7, 500)
    assert tuple(one for one in two if one.agent == "ego") == alone
    assert len(two) > len(alone)


def test_models_and_agents_are_drawn_independently_of_each_other():
    drawn = disturber_of({"brake": 0.5, "stop": 0.5}, agents=("ego", "second"), step_length_s=DT).draw(7, 500)
    begins = [
        tuple(one.step for one in drawn if (one.what, one.agent) == pair)
        for pair in (("brake", "ego"), ("stop", "ego"), ("brake", "second"), ("stop", "second"))
    ]
    assert len(set(begins)) == 4


def test_they_begin_as_often_as_the_rate_states():
    disturber = make(brake=0.4)
    count = sum(len(disturber.draw(seed, 1000)) for seed in range(100))  # 4000 expected of 100,000 steps
    assert abs(count - 4000) < 6 * math.sqrt(100_000 * 0.04 * 0.96)


@given(st.integers(0, 1000), st.integers(0, 60))
def test_the_likelihood_is_the_product_of_what_was_drawn(seed, steps):
    disturber = make(brake=1.0, stop=0.5)
    drawn = disturber.draw(seed, 60)
    expected = 0.0
    for model, rate in ((disturber.models["brake"], 1.0), (disturber.models["stop"], 0.5)):
        at = {one.step: one for one in drawn if one.what == model.what}
        for step in range(1, steps + 1):
            if step in at:
                one = at[step]
                likely = model.log_likelihood(Drawn(one.who, one.how_strong, one.how_long))
                expected += math.log(rate * DT) + likely
            else:
                expected += math.log(1 - rate * DT)
    assert math.isclose(disturber.log_likelihood(drawn, steps), expected, abs_tol=1e-9)


def test_the_probabilities_of_all_that_can_happen_add_up():
    """Of two steps and a model with two possibilities: nothing, or one of two, in each."""
    model = Choices("brake", {"ahead": 1.0}, {2.0: 3.0, 4.0: 1.0}, {1.0: 1.0})
    disturber = DisturbanceSampler({"brake": model}, {"brake": 3.0}, ("ego",), DT)
    possible = [None, 2.0, 4.0]
    total = 0.0
    for first in possible:
        for second in possible:
            begun = [(1, first), (2, second)]
            given_them = [Disturbance(at, "ahead", "brake", how, 1.0, "ego") for at, how in begun if how is not None]
            total += math.exp(disturber.log_likelihood(given_them, 2))
    assert math.isclose(total, 1.0)


def test_what_the_models_never_draw_is_impossible():
    disturber = make(brake=1.0)
    odd = Disturbance(1, "ahead", "brake", 3.5, 1.0, "ego")
    assert disturber.log_likelihood([odd], 5) == -math.inf
    assert disturber.log_likelihood([Disturbance(1, "ahead", "stop", 3.0, 8.0, "ego")], 5) == -math.inf
    always = DisturbanceSampler({"brake": brake()}, {"brake": 10.0}, ("ego",), DT)
    assert always.log_likelihood([], 1) == -math.inf
    assert math.isfinite(always.log_likelihood(always.draw(1, 5), 5))


def test_what_was_drawn_while_no_one_was_there_makes_a_trial_no_less_likely():
    disturber = make(brake=1.0)
    drawn = Disturbance(3, "ahead", "brake", 4.0, 2.0, "ego")
    spec = _spec(disturbances=(Disturbance(2, "ahead", "brake", 6.0, 1.0, "ego"), drawn))
    result = TrialResult(spec, "survived", steps=10, disturbances=(drawn.took_place("leader", 3.5),))
    assert disturber.log_likelihood_of(result) == disturber.log_likelihood([drawn], 10)


def _spec(**more):
    from crashhunt.trial import TrialSpec

    return TrialSpec(0, 1, {}, {}, 20, **more)


def test_a_model_that_draws_nonsense_is_named():
    class Odd:
        what = "brake"

        def draw(self, rng):
            return Drawn("above", float(rng.random()), 1.0)

        def log_likelihood(self, drawn):
            return 0.0

    with pytest.raises(PluginError, match="'odd' returned"):
        DisturbanceSampler({"odd": Odd()}, {"odd": 5.0}, ("ego",), DT).draw(1, 100)


@pytest.mark.parametrize(
    ("what", "who", "strong"),
    [
        ("brake", "ahead", -3.0),
        ("brake", "itself", 3.0),
        ("late_action", "ahead", 0.5),
        ("noisy_observation", "itself", 2),
    ],
)
def test_a_model_draws_only_what_its_kind_may_be(what, who, strong):
    model = Choices(what, {who: 1.0}, {strong: 1.0}, {1.0: 1.0})
    with pytest.raises(PluginError, match=f"'odd' returned .*who='{who}'"):
        DisturbanceSampler({"odd": model}, {"odd": 5.0}, ("ego",), DT).draw(1, 100)
    own = Choices("lean", {who: 1.0}, {strong: 1.0}, {1.0: 1.0})  # a kind of a simulator's of somebody's own
    assert DisturbanceSampler({"own": own}, {"own": 5.0}, ("ego",), DT).draw(1, 100)


class Evenly:
    """A random generator that returns every combination of evenly spread numbers once."""

    def __init__(self, *counts):
        self._numbers = itertools.chain(*itertools.product(*([(k + 0.5) / n for k in range(n)] for n in counts)))

    def random(self):
        return next(self._numbers)


weights = st.dictionaries(st.integers(1, 9).map(float), st.integers(1, 4), min_size=1, max_size=4)
built_in = st.sampled_from(sorted(registered("disturbances"))).map(lambda name: locate("disturbances", name)())
models = built_in | st.builds(Choices, st.just("brake"), st.just({"ahead": 3, "behind": 1}), weights, weights)


@settings(max_examples=examples(60))
@given(models)
def test_a_draw_is_as_likely_as_the_share_of_all_random_numbers_that_give_it(model):
    totals = [round(sum(part.values())) for part in (model.who, model.how_strong, model.how_long)]
    rng, count = Evenly(*totals), math.prod(totals)
    shares = {drawn: times / count for drawn, times in Counter(model.draw(rng) for _ in range(count)).items()}
    assert dict(model.possibilities()) == pytest.approx(shares)
    assert {drawn: math.exp(model.log_likelihood(drawn)) for drawn in shares} == pytest.approx(shares)
    assert shares.keys() == {Drawn(*part) for part in itertools.product(model.who, model.how_strong, model.how_long)}


def test_built_in_models_draw_as_in_version_1():
    """A seed gives the same disturbances in every version, so that hunts resume and their rates compare."""
    drawn = {}
    for name in sorted(registered("disturbances")):
        model, rng = locate("disturbances", name)(), np.random.default_rng(1)
        drawn[name] = zlib.crc32(repr([dataclasses.astuple(model.draw(rng)) for _ in range(200)]).encode())
    assert drawn == {
        "brake": 4089475030,
        "cut_in": 273597808,
        "dawdle": 3479028362,
        "ignore_priority": 3077076100,
        "late_action": 892198863,
        "late_merge": 530080000,
        "late_observation": 892198863,
        "noisy_observation": 852994988,
        "speed": 3348799866,
        "step_out": 2833426313,
        "stop": 3029222793,
        "unseen": 1188916016,
    }


def test_the_strongest_that_a_model_may_draw_comes_first_and_is_as_likely_as_any():
    rates = {"brake": 0.1, "cut_in": 0.1, "late_merge": 0.1}
    draws = disturber_of(rates, agents=("ego",), step_length_s=DT)
    for number in range(20):
        found = draws.draw_strongest(3, number, 10, 5)
        assert [each[0].what for each in found] == sorted(rates)
        assert [each[0].how_strong for each in found] == [6.0, 4.0, 5.0]  # of the last, the least is the worst
        assert found[0][0].how_long >= found[0][1].how_long or found[0][1].how_strong < 6.0
        assert {one.who for one in found[1]} == {"left", "right", "left ahead", "right ahead"}
        for each in found:
            (step,) = {one.step for one in each}
            assert 10 < step <= 15
            assert all(math.isfinite(draws.log_likelihood([one], 60)) for one in each)
        assert found == draws.draw_strongest(3, number, 10, 5) != draws.draw_strongest(4, number, 10, 5)


class Gone:
    """A model that cannot draw."""

    what = "brake"

    def draw(self, rng):
        return 1 / 0

    def log_likelihood(self, drawn):
        return 0.0


def test_foreign_model_draws_in_its_own_process_as_it_would_here():
    own, apart = brake(), ModelApart("brake", timeout_s=60)
    one, other = np.random.default_rng(5), np.random.default_rng(5)
    drawn = own.draw(one)
    assert apart.draw(other) == drawn
    assert other.bit_generator.state == one.bit_generator.state
    assert apart.log_likelihood(drawn) == own.log_likelihood(drawn)
    assert apart.log_likelihood(Drawn("ahead", 1e9, 1.0)) == -math.inf
    assert apart.what == own.what
    apart.close()
    ModelApart("brake", timeout_s=60).close()  # which has not started
    gone = ModelApart(f"{__name__}:Gone", timeout_s=60)
    sampler = DisturbanceSampler(models={"gone": gone}, rates={"gone": 1.0}, agents=("ego",), step_length_s=1.0)
    with pytest.raises(PluginError) as caught:
        sampler.draw(1, 10)
    assert caught.value.message.endswith(":Gone' cannot be drawn: ZeroDivisionError: division by zero")
    assert caught.value.message.count("cannot be drawn") == 1
    gone.close()
