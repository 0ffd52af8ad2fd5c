"""Samplers of Optuna by their names: what they propose follows from what they were told, whatever the arguments are."""

from __future__ import annotations

import importlib
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings, strategies as st
from spaces import are_inside, ask, spaces, spec_of

from crashhunt.base.extras import install_command
from crashhunt.errors import CrashhuntError, PluginError, UsageError
from crashhunt.samplers import HuntFacts, NamedSampler, RandomSampler, varies_only_asked
from crashhunt.samplers._optuna import OptunaMaker, optuna_maker
from crashhunt.space import Choice, Constant, Range
from crashhunt.trial import Outcome, TrialResult

optuna = pytest.importorskip("optuna")
KINDS = ["optuna:tpe", "optuna:cma-es", "optuna:NSGAIISampler", "optuna:qmc"]
KINDS += [pytest.param(kind, marks=pytest.mark.nightly) for kind in ("optuna:random", "optuna:NSGA-III")]
UNIT = {("ego", f"x{index}"): Range(0.0, 1.0) for index in range(3)} | {("", "mode"): Choice(("a", "b", "c"))}
ALL_KINDS = {
    ("ego", "a"): Range(1e-3, 1e3, log=True),
    ("ego", "b"): Range(1, 1000, log=True, integer=True),
    ("ego", "c"): Range(0.0, 20.0, step=5.0),
    ("", "d"): Range(-3, 3, integer=True),
    ("", "e"): Choice((True, False)),
    ("", "f"): Choice(("only",)),
    ("", "g"): Choice((1, True, "1")),
    ("", "h"): Constant(3),
    ("", "i"): Range(2.0, 2.0),
}
ONE = {("", "x"): Range(0.0, 1.0)}
WORDS = {("", name): Choice(("a", "b")) for name in "xy"}


def made(name, space=UNIT, seed=1):
    return NamedSampler(name, space, points=3, hunt=HuntFacts(seed))


def talk(name, space, danger_of, trials, *, lag=4, seed=1):
    """Ask and tell as a hunt does; returns what was asked and the result."""
    sampler, asked, results = made(name, space, seed), [], []
    for number in range(trials):
        if number >= lag:
            sampler.tell(results[number - lag])
        asked.append(ask(sampler, number, seed))
        danger = danger_of(asked[-1])
        outcome = Outcome.INVALID if danger is None else Outcome.COLLISION if danger >= 1 else Outcome.SURVIVED
        results.append(TrialResult(spec_of(number, asked[-1]), outcome, danger=danger))
    return asked, results


def near(proposal):
    """Danger leads to a corner where the word is b."""
    x = np.array([proposal.arguments["ego", f"x{index}"] for index in range(3)])
    return 0.9 - 0.5 * float(np.linalg.norm(x - 0.2)) - 0.05 * (proposal.arguments["", "mode"] != "b")


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=2, suppress_health_check=[HealthCheck.too_slow])
@given(space=spaces, seed=st.integers(0, 2**70), luck=st.integers(0, 2**20))
@example(space=ALL_KINDS, seed=2**65, luck=1)
@example(space=ONE, seed=0, luck=2)
@example(space=WORDS, seed=0, luck=3)
@example(space={}, seed=0, luck=4)
def test_whatever_the_arguments_proposals_are_inside(kind, space, seed, luck):
    dangers = np.random.default_rng(luck)

    def danger_of(proposal):
        drawn = dangers.random()
        return None if drawn < 0.1 else 1.0 if drawn > 0.95 else round(drawn, 1)

    asked, _ = talk(kind, space, danger_of, 20, seed=seed)
    assert all(are_inside(proposal, space) for proposal in asked)
    plain, sampler = RandomSampler(space), made(kind, space)
    assert sampler.plain_origin == "random"
    for number, proposal in enumerate(asked):
        assert (proposal.origin == "random") == (number % 5 == 0)
        if number % 5 == 0:
            assert proposal.arguments == ask(plain, number, seed).arguments


@pytest.mark.parametrize(
    ("kind", "trials"),
    [("optuna:tpe", 71), ("optuna:cma-es", 71), pytest.param("optuna:nsgaii", 161, marks=pytest.mark.nightly)],
)
def test_danger_leads_it_and_one_that_is_made_again_continues_exactly(kind, trials):
    """Later than the contract looks: CMA-ES and NSGA-II have generations, of which the study keeps the state."""
    asked, results = talk(kind, UNIT, near, trials)
    guided = [result.danger for one, result in zip(asked, results, strict=True) if one.origin == "optuna"]
    assert np.mean(guided[-trials // 4 :]) > np.mean(guided[: trials // 4]) + 0.1
    # A child may be like its parent, and nobody else like anybody.
    children = [one for one in asked[50:] if kind == "optuna:nsgaii" and one.origin == "optuna"]
    others = {str(one.arguments) for one in asked if not any(one is child for child in children)}
    assert len(others) == trials - len(children)
    assert len(others | {str(one.arguments) for one in children}) > 0.8 * trials
    again, some = made(kind), trials - 8
    for result in results[:some]:
        again.tell(result)
    assert asked[some + 3].origin == "optuna"
    assert ask(again, some + 3) == ask(again, some + 3) == asked[some + 3]
    for number in range(some, some + 4):  # what was told between was told before the proposals of these
        again.tell(results[number])
        assert ask(again, number + 4) == asked[number + 4]


def test_a_sequence_has_all_words():
    words = Choice(("a", "b", "c"))
    sampler = made("optuna:qmc", {("", "mode"): words, ("", "x"): Range(0.0, 1.0)})
    asked = [ask(sampler, number) for number in range(40)]
    assert {one.arguments["", "mode"] for one in asked if one.origin == "optuna"} == {*words.options}


def test_a_sequence_is_even_whatever_was_asked_before():
    space = {("", "x"): Range(0.0, 1.0)}
    asked = {n: ask(made("optuna:qmc", space), n).arguments["", "x"] for n in (64, 3)}
    drawn = {number: ask(sampler, number) for sampler in [made("optuna:qmc", space)] for number in range(128)}
    assert all(drawn[number].arguments["", "x"] == value for number, value in asked.items())
    values = sorted(one.arguments["", "x"] for one in drawn.values() if one.origin == "optuna")
    gaps = [later - earlier for earlier, later in pairwise([0.0, *values, 1.0])]
    assert 0 < min(gaps) < max(gaps) < 4 / 128
    assert ask(made("optuna:qmc", space, seed=2), 3) != drawn[3]


@pytest.mark.parametrize("name", ["optuna:TPESampler", "optuna:tpe", "optuna:TPE", "optuna:tpesampler"])
def test_names_may_be_written_short(name):
    assert optuna_maker(name) == OptunaMaker("TPESampler")
    assert not varies_only_asked(name)


def test_what_optuna_states_is_not_shown_and_its_own_settings_stay(capfd, recwarn):
    level = optuna.logging.get_verbosity()
    talk("optuna:cma-es", UNIT, near, 12)
    assert capfd.readouterr() == ("", "")
    assert not recwarn.list
    assert optuna.logging.get_verbosity() == level


@pytest.mark.parametrize(
    ("name", "kind", "says"),
    [
        ("optuna:TPSampler", PluginError, "Optuna has no sampler 'TPSampler'; did you mean 'TPESampler'"),
        ("optuna:", PluginError, "Optuna has no sampler ''; give one of CmaEsSampler"),
        ("optuna:grid", UsageError, "'optuna:grid' cannot be used for hunts; --sampler grid"),
        ("optuna:BruteForceSampler", UsageError, "cannot be used for hunts; --sampler grid"),
        ("optuna:PartialFixed", UsageError, "cannot be used for hunts; --arg NAME=VALUE"),
    ],
)
def test_a_name_that_is_none_is_one_line(name, kind, says):
    with pytest.raises(CrashhuntError) as caught:
        varies_only_asked(name)
    assert isinstance(caught.value, kind)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("package", "name", "fix"),
    [
        ("optuna.storages", "optuna:tpe", f"needs the package optuna; {install_command('search')}"),
        ("cmaes", "optuna:CmaEsSampler", f"needs the package cmaes; {install_command('search')}"),
        ("torch", "optuna:gp", f"needs the package torch; {install_command('torch')}"),
    ],
)
def test_without_a_package_it_is_refused(monkeypatch, package, name, fix):
    importlib.import_module("optuna.samplers")
    monkeypatch.delitem(sys.modules, "crashhunt.samplers._optuna")  # as in a process that has not imported it
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UsageError) as caught:
        varies_only_asked(name)
    assert fix in str(caught.value)
