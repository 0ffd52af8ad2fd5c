"""The law of the first onset in closed form, and the onsets that are proposed for copies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
from conftest import examples
from hypothesis import given, settings, strategies as st

from crashhunt.disturbances import DisturbanceSampler, Drawn, FirstOnsets, brake, cut_in, first_forcing, late_action
from crashhunt.trial import Forcing

LAST = 60
MODELS = {"late_action": late_action, "brake": brake, "cut_in": cut_in}


def sampler(**chances):
    return DisturbanceSampler({name: MODELS[name]() for name in chances}, chances, ("ego",), 1.0)


def run(onsets, has_target=lambda _: True, last=LAST):
    return [onset for step in range(last) for onset in onsets.after(step, has_target)]


def is_even(one):
    return one.step % 2 == 0 and one.who in ("ahead", "left")


chances = st.fixed_dictionaries({name: st.floats(1e-7, 0.2) for name in MODELS})
ratios = st.dictionaries(st.sampled_from(["brake=2.0", "brake=6.0", "cut_in=0.0", "late_action=1.0"]),
                         st.floats(0.1, 9))  # fmt: skip


@settings(max_examples=examples(30))
@given(chances, ratios, st.integers(0, 2**31), st.floats(0.1, 1.0))
def test_one_onset_lies_in_each_interval_of_the_proposed_probability(some, given_ratios, seed, part):
    start = first_forcing(sampler(**some), LAST)
    onsets = FirstOnsets(sampler(**some), Forcing(start.spacing * part, given_ratios), seed, LAST)
    found = run(onsets, is_even)
    assert onsets.survival + math.fsum(onsets.masses.values()) == pytest.approx(1.0)
    proposed = math.fsum(mass * given_ratios.get(cell, 1.0) for cell, mass in onsets.masses.items())
    assert abs(len(found) * start.spacing * part - proposed) <= start.spacing * part * (1 + 1e-9)
    for onset in found:
        assert onset.weight == start.spacing * part / given_ratios.get(onset.cell, 1.0)


def test_survival_is_the_product_over_effective_draws():
    onsets = FirstOnsets(sampler(brake=0.1, cut_in=0.2), Forcing(0.5), 1, LAST)
    run(onsets, is_even)
    left = cut_in().who["left"] / sum(cut_in().who.values())
    assert onsets.survival == pytest.approx((0.9 * (1 - 0.2 * left)) ** (LAST // 2))
    assert math.fsum(m for cell, m in onsets.masses.items() if cell.startswith("brake")) > 0


@pytest.mark.parametrize(("name", "in_step"), [("late_action", 0.95 * 0.97), ("brake", 0.97), ("cut_in", 1.0)])
def test_second_onsets_follow_the_law_from_the_next_model_in_the_step_of_the_first(name, in_step):
    some = sampler(late_action=0.1, brake=0.05, cut_in=0.03)
    start = first_forcing(some, LAST)
    assert {cell.partition("=")[0] for cell in start.second} == set(MODELS)  # of all first onsets
    forcing = Forcing(0.02, second=start.second, second_spacing=0.1)
    first = next(one for one in run(FirstOnsets(some, forcing, 3, LAST)) if one.cell.startswith(name))
    assert [(one.what, one.step) for one in first.alone] == [(name, first.step)]
    assert first.alone[0] in first.planned
    law = FirstOnsets(some, forcing, 3, LAST).following(first)
    forked = first.step - (2 if name == "late_action" else 1)
    found = [one for step in range(forked, LAST) for one in law.after(step, lambda _: True)]
    assert law.survival == pytest.approx(in_step * (0.9 * 0.95 * 0.97) ** (LAST - first.step))
    assert law.survival + math.fsum(law.masses.values()) == pytest.approx(1.0)
    assert all(one.weight == 0.1 and one.step >= first.step for one in found)
    assert abs(len(found) * 0.1 - (1 - law.survival)) <= 0.1
    assert found[0].planned != first.planned


def test_one_copy_of_a_root_is_a_pilot_of_second_onsets_unless_there_are_none():
    some = sampler(late_action=0.1, brake=0.05)

    def with_seconds(forcing, seed):
        onsets = FirstOnsets(some, forcing, seed, LAST)
        return [one.number for one in run(onsets) if onsets.following(one) is not None]

    assert [with_seconds(Forcing(0.02, second_spacing=0.1), seed) for seed in (3, 9)] == [[3], [1]]
    assert with_seconds(Forcing(0.02), 3) == []


def test_agent_kinds_begin_two_steps_after_the_fork_and_others_one():
    some = sampler(late_action=0.1, brake=0.1)
    onsets = FirstOnsets(some, Forcing(0.02), 3, LAST)
    by_step = {step: onsets.after(step, lambda _: True) for step in range(LAST)}
    first = [(step, onset) for step, found in by_step.items() for onset in found]
    assert {onset.cell.partition("=")[0]: onset.step - step for step, onset in first} == {"late_action": 2, "brake": 1}
    assert min(onset.step for _, onset in first) >= 2
    assert all(onset.planned[0].step == onset.step for _, onset in first)
    assert max(one.step for _, onset in first for one in onset.planned) <= LAST


def test_no_earlier_model_begins_effectively_in_the_step_of_the_onset():
    some = sampler(late_action=0.2, brake=0.2, cut_in=0.2)
    seen = set()
    for seed in range(examples(60)):
        for onset in run(FirstOnsets(some, Forcing(0.05), seed, 20), is_even, 20):
            together = {one.what for one in onset.planned if one.step == onset.step}
            name = onset.cell.partition("=")[0]
            seen.add((name, frozenset(together)))
            others = [one for one in onset.planned if one.step == onset.step and one.what != name]
            if name == "cut_in":  # the last in the order: a brake in this step would have been the first onset
                assert not any(is_even(one) for one in others)
                assert "late_action" not in together
            if name == "brake":
                assert "late_action" not in together
    assert ("brake", frozenset({"brake", "cut_in"})) in seen
    assert ("late_action", frozenset({"late_action", "brake"})) in seen


@dataclass(frozen=True)
class Unlisted:
    """A model that cannot list what it draws."""

    what: str = "brake"

    def draw(self, rng):
        return Drawn("ahead", float(rng.integers(1, 9)), 1.0)

    def log_likelihood(self, drawn):
        return -math.log(8)


def test_every_draw_counts_of_a_model_that_cannot_list_them():
    some = DisturbanceSampler({"mine": Unlisted()}, {"mine": 0.1}, ("ego",), 1.0)
    onsets = FirstOnsets(some, Forcing(0.1), 1, LAST)
    found = run(onsets, lambda _: False)
    assert onsets.survival == pytest.approx(0.9 ** (LAST - 1))
    assert {onset.cell for onset in found} == {"mine"}
    assert all(onset.planned[0].how_strong >= 1 for onset in found)


def test_same_root_has_the_same_onsets():
    some = sampler(brake=0.05, cut_in=0.05)
    first, second = (run(FirstOnsets(some, Forcing(0.1, {"brake=4.0": 3.0}), 9, LAST), is_even) for _ in range(2))
    assert first == second
    assert run(FirstOnsets(some, Forcing(0.1), 10, LAST), is_even) != first
