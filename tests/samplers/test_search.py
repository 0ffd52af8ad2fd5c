"""Samplers that learn find what is rare, whatever the arguments are, and never pretend that their trials are random."""

from __future__ import annotations

import importlib.util
import re
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import examples
from hypothesis import HealthCheck, example, given, settings, strategies as st
from spaces import are_inside, ask, spaces, spec_of
from threadpoolctl import threadpool_info, threadpool_limits

from crashhunt.base.extras import install_command
from crashhunt.errors import UsageError
from crashhunt.samplers import (
    CmaEsSampler,
    CrossEntropySampler,
    GuidedSampler,
    HuntFacts,
    MutationSampler,
    RandomSampler,
)
from crashhunt.space import Choice, Range
from crashhunt.trial import Collision, Outcome, TrialResult

KINDS = [CrossEntropySampler, GuidedSampler, MutationSampler]
KINDS += [CmaEsSampler] if importlib.util.find_spec("cmaes") else []
UNIT = {("ego", f"x{index}"): Range(0.0, 1.0) for index in range(4)}
LAG = 4


def hunt(sampler, danger_of, trials, *, keep_going=False, seed=1):
    """Ask and tell as a hunt does; returns proposals and results, up to the first crash or to the end."""
    asked, results = [], []
    for number in range(trials):
        if number >= LAG:
            sampler.tell(results[number - LAG])
        asked.append(ask(sampler, number, seed))
        danger = danger_of(asked[-1])
        outcome = Outcome.INVALID if danger is None else Outcome.COLLISION if danger >= 1 else Outcome.SURVIVED
        results.append(TrialResult(spec_of(number, asked[-1]), outcome, danger=danger))
        if outcome is Outcome.COLLISION and not keep_going:
            break
    return asked, results


def values(proposal):
    return np.array(list(proposal.arguments.values()))


def corner(proposal):
    """A crash in one of 40,000 random trials, in a corner that danger leads to."""
    return 1.0 if (x := values(proposal)).max() < 1 / 14 else 1.0 - float(np.linalg.norm(x)) / 2.1


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_rare_is_found_where_danger_leads_to_it(kind):
    asked, results = hunt(kind(UNIT, hunt=HuntFacts(1)), corner, 900)
    assert results[-1].outcome is Outcome.COLLISION
    assert asked[-1].origin not in ("", "random")


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=examples(12), suppress_health_check=[HealthCheck.too_slow])
@given(space=spaces, seed=st.integers(0, 2**40), luck=st.integers(0, 2**20))
def test_whatever_the_arguments_proposals_are_inside(kind, space, seed, luck):
    dangers = np.random.default_rng(luck)

    def danger_of(proposal):
        drawn = dangers.random()
        return None if drawn < 0.1 else 1.0 if drawn > 0.95 else round(drawn, 1)

    asked, results = hunt(kind(space, hunt=HuntFacts(seed)), danger_of, 60, keep_going=True)
    assert all(are_inside(proposal, space) for proposal in asked)
    varies = any(known.quantile(0.0) != known.quantile(1.0) for known in space.values())
    assert {proposal.origin for proposal in asked} == ({"random", "start"} if not varies else {*origins(asked)})
    for number, proposal in enumerate(asked):
        assert proposal.parent is None or proposal.parent <= number - LAG
        if proposal.seed is not None:
            parent = results[proposal.parent].spec
            assert proposal.seed == parent.seed
            assert (results[number].spec.arguments, results[number].spec.scenario_arguments) != (
                parent.arguments,
                parent.scenario_arguments,
            )


def origins(asked):
    return {proposal.origin for proposal in asked}


@pytest.mark.parametrize("kind", KINDS)
def test_every_fifth_trial_is_the_random_one_of_that_number(kind):
    asked, _ = hunt(kind(UNIT, hunt=HuntFacts(3)), corner, 100, keep_going=True)
    plain = RandomSampler(UNIT)
    for number, proposal in enumerate(asked):
        assert (proposal.origin == "random") == (number % 5 == 0)
        if number % 5 == 0:
            assert proposal.arguments == ask(plain, number).arguments


def test_the_even_search_leaves_no_part_of_an_argument_out():
    sampler = GuidedSampler(UNIT, hunt=HuntFacts(3))
    asked = [ask(sampler, number) for number in range(125)]  # is told nothing
    even = np.array([values(proposal) for proposal in asked if proposal.origin == "halton"])
    assert len(even) == 100
    for drawn in even.T:  # the third of which has base 5
        assert np.histogram(drawn, bins=5, range=(0.0, 1.0))[0].min() >= 15


@pytest.mark.parametrize("make", [MutationSampler, CrossEntropySampler])
@pytest.mark.parametrize("crashes", [False, True])
@settings(deadline=None, max_examples=examples(3))
@given(scale=st.floats(0.05, 0.9), power=st.sampled_from([0.2, 0.45, 3.0]), seed=st.integers(0, 2**20))
@example(scale=0.45, power=1.0, seed=5)
def test_only_the_order_of_danger_counts_for_the_strategies_alone(make, crashes, scale, power, seed):
    """Any strictly rising function of danger gives the same proposals, before and after crashes."""

    space = {("ego", "x"): Range(0.0, 1.0), ("ego", "y"): Range(0.0, 1.0)}

    def hunted(seen_as):
        sampler = make(space, hunt=HuntFacts(seed))
        for number in range(130):
            proposal = ask(sampler, number, seed)
            yield proposal
            x, y = proposal.arguments.values()
            danger = max(0.9 - abs(x - 0.3) - 0.5 * abs(y - 0.4), 0.8 - abs(x - 0.9) - abs(y - 0.8), 0.05)
            danger += 1e-6 * number  # no two are equal
            crashed = crashes and danger > 0.85
            outcome = Outcome.COLLISION if crashed else Outcome.SURVIVED
            sampler.tell(TrialResult(spec_of(number, proposal), outcome, danger=1.0 if crashed else seen_as(danger)))

    asked = [*hunted(lambda danger: danger)]
    assert [*hunted(lambda danger: scale * danger**power)] == asked
    assert len({one.origin for one in asked}) > 1
    # The order does count.
    assert any(one != other for one, other in zip(hunted(lambda danger: 1.0 - danger), asked, strict=True))


def test_danger_that_leads_nowhere_has_a_try_and_then_next_to_nothing():
    asked, _ = hunt(GuidedSampler(UNIT), lambda proposal: 0.9 - float(np.linalg.norm(values(proposal) - 0.5)) / 2, 500)
    unguided = [proposal.origin in ("halton", "random") for proposal in asked]
    assert sum(unguided[:200]) < 160  # it does try
    assert sum(unguided[200:]) > 0.8 * 300


def test_a_hunt_that_continues_looks_for_other_crashes():
    def two(proposal):
        x = values(proposal)
        near = min(np.linalg.norm(x - 0.2), np.linalg.norm(x - 0.8))
        return 1.0 if near < 0.08 else 0.95 - float(near) / 2

    asked, results = hunt(GuidedSampler(UNIT), two, 300, keep_going=True)
    found = [values(one).mean() for one, result in zip(asked, results, strict=True) if result.danger == 1.0]
    assert min(found) < 0.5 < max(found)
    assert len(found) < 75


def test_only_what_the_hunt_is_after_is_a_crash():
    """A collision where nobody hunts for one says nothing; one that somebody does is the most there is."""
    off_road = HuntFacts(1, (Outcome.OFF_ROAD,))
    for crash_on, learns in ((HuntFacts(1), True), (off_road, False)):
        sampler = CrossEntropySampler(UNIT, hunt=crash_on)
        for number in range(60):
            result = TrialResult(spec_of(number, ask(sampler, number)), Outcome.COLLISION, danger=1.0)
            sampler.tell(result)
        assert (ask(sampler, 61).origin == "cross-entropy") is learns


def test_a_hunt_without_the_package_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "cmaes", None)
    with pytest.raises(UsageError, match=re.escape(f"needs the package cmaes; {install_command('search')}")):
        CmaEsSampler(UNIT)


@pytest.mark.parametrize("kind", KINDS)
def test_words_and_whole_numbers_are_found_too(kind):
    space = {("", f"c{index}"): Choice(tuple("abcde")) for index in range(4)} | {("", "n"): Range(1, 10, integer=True)}

    def danger_of(proposal):
        right = sum(proposal.arguments["", f"c{index}"] == "bdac"[index] for index in range(4))
        return 1.0 if right == 4 and proposal.arguments["", "n"] > 4 else 0.15 * right

    _, results = hunt(kind(space), danger_of, 3000)
    assert results[-1].danger == 1.0


def test_linear_algebra_of_a_strategy_has_one_thread_and_later_as_many_as_before():
    seen = []

    def threads():
        return [library["num_threads"] for library in threadpool_info()]

    class Watched(GuidedSampler):
        def _make(self, space):
            return SimpleNamespace(
                propose=lambda *_: seen.append(threads()), tell=lambda _trial: seen.append(threads())
            )

    with threadpool_limits(2):  # of one that tests have
        before = threads()
        sampler = Watched({("ego", "x"): Range(0.0, 1.0)})
        proposal = ask(sampler, 1)
        sampler.tell(TrialResult(spec_of(1, proposal), Outcome.SURVIVED, danger=0.5))
        assert seen == [[1] * len(before)] * 2
        assert threads() == before != seen[0]


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_learning_takes_at_most_a_millisecond_after_100_000_trials(kind):
    space = {("ego", f"x{index}"): Range(0.0, 1.0) for index in range(10)}
    sampler, dangers = kind(space), np.random.default_rng(1)
    proposal = ask(sampler, 1)
    told = [TrialResult(spec_of(0, ask(RandomSampler(space), n)), Outcome.SURVIVED, danger=0.0) for n in range(500)]
    for number in range(100_000):
        result = told[number % 500]
        spec = replace(result.spec, number=number, origin=("cross-entropy", "halton", "mutation", "cma-es")[number % 4])
        sampler.tell(replace(result, spec=spec, danger=float(dangers.random()) * 0.99))
    began = time.process_time()
    for number in range(100_000, 101_000):
        proposal = ask(sampler, number)
        sampler.tell(TrialResult(spec_of(number, proposal), Outcome.SURVIVED, danger=float(dangers.random()) * 0.99))
    assert time.process_time() - began < 1.0


@pytest.mark.nightly
def test_learning_takes_no_longer_after_many_crashes_of_other_kinds():
    """Each of them has strategies begin anew."""
    space = {("ego", f"x{index}"): Range(0.0, 1.0) for index in range(10)}
    sampler, luck, spent = GuidedSampler(space), np.random.default_rng(1), [0.0, 0.0, 0.0]
    for number in range(3000):
        began = time.process_time()
        spec = spec_of(number, ask(sampler, number))
        spent[number // 1000] += time.process_time() - began
        hit = Collision("ego", "collider", "ego", lane=f"road{luck.integers(1000)}e_0") if luck.random() < 0.3 else None
        outcome = Outcome.COLLISION if hit else Outcome.SURVIVED
        result = TrialResult(spec, outcome, danger=float(luck.random()) * 0.99, collision=hit)
        began = time.process_time()
        sampler.tell(result)
        spent[number // 1000] += time.process_time() - began
    assert spent[2] < 3 * spent[0]
