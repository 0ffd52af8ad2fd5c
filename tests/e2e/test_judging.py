"""Until when a collision could have been avoided: what `judge` says against running every step."""

from __future__ import annotations

from dataclasses import replace

import pytest
from test_preventability import MODELS

from crashhunt.analysis import judge
from crashhunt.analysis._avoidability import AvoidanceSearch
from crashhunt.analysis._causes import _Search
from crashhunt.crashes import find_bundle, judgement_of
from crashhunt.errors import UsageError
from crashhunt.replays import ReplayOptions, prepare
from crashhunt.trial import Outcome


def hunted(toy):
    """One error of the agent, for `made_once`, which another value of its argument avoids."""
    words = ("--scenario", "toy", "--agent", "faulty:Raises", "--arg", "at=2|30", "--seed", "1", "--no-snapshot")
    toy.crashhunt("run", "h", "1", "9", "9", *words)


def test_what_a_failure_hangs_on_is_run_and_reported(toy, made_once):
    made_once(hunted, toy)
    (judged,) = toy.crashhunt("judge", "h", "--why", "5", "--parallel", "1", "--json").json["judged"]
    assert (judged["runs"], judged["verdict"], judged["avoidable"]) == (0, "unknown", None)
    assert judged["preventable_by"] == dict.fromkeys(MODELS)  # no model of a driver has an answer
    factors = {(factor["kind"], factor["name"]): factor for factor in judged["why"]["factors"]}
    at = factors["argument", "ego.at"]
    assert (at["needed"], [run["given"] for run in at["runs"]]) == (True, [30])
    assert factors["seed", "seed"]["needed"] is False
    said = toy.crashhunt("show", "h").out
    assert "- other values of ego.at (it was 2): no crash." in said
    assert "the seed (" in said.partition("No difference in any run: ")[2]
    assert "only its causes can be analysed" in toy.crashhunt("judge", "h", "--why", "0", expect=2).err
    assert toy.crashhunt("judge", "h", "--all", "--json").json == {"judged": []}  # it has been judged


def test_another_failure_is_not_the_same(toy, made_once):
    made_once(hunted, toy)
    bundle = find_bundle(toy.folder / "h")
    search = _Search(prepare(bundle, ReplayOptions()))
    result = bundle.result
    assert search._is_same(replace(result, steps=5))
    assert not search._is_same(replace(result, failure=replace(result.failure, kind="KeyError")))
    assert not search._is_same(replace(result, outcome=Outcome.PROCESS_DIED))
    with pytest.raises(UsageError, match="is a hang, so every run"):
        judge(replace(bundle, result=replace(result, outcome=Outcome.HANG)), why=9)
    with pytest.raises(UsageError, match="is a near miss"):
        judge(replace(bundle, result=replace(result, outcome=Outcome.SURVIVED, failure=None)), why=9)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("scenario", "words"),
    [
        ("loop", ("--arg", "speed=20:25", "--seed", "1")),
        ("intersection", ("--seed", "2")),
        ("highway", ("--seed", "1")),
    ],
)
def test_the_last_step_is_the_one_that_running_every_step_finds(shell, monkeypatch, scenario, words):
    shell.crashhunt("run", "h", "2", "200", "400", "--scenario", scenario, *words)
    bundle = find_bundle(shell.folder / "h")
    found = judge(bundle, ReplayOptions(), runs=30, parallel=2)
    first = max(0, bundle.result.steps - 20)

    def every_step(self):
        self._try("brake", 30, bundle.result.steps - 1, first)

    monkeypatch.setattr(AvoidanceSearch, "all", every_step)
    monkeypatch.setattr(AvoidanceSearch, "_find", lambda *_: None)
    monkeypatch.setattr(
        AvoidanceSearch,
        "_run_later_steps",
        lambda self, tries, first: self._run_after_steps(tries, range(first, self._end)),
    )
    every = judge(bundle, ReplayOptions(), runs=30, parallel=2)
    assert set(every.attempts[0].endings) == set(range(first, bundle.result.steps))
    assert (
        every.attempts[0].endings | found.attempts[0].endings == found.attempts[0].endings | every.attempts[0].endings
    )
    if found.attempts[0].last_step is None or found.attempts[0].last_step >= first:
        assert every.attempts[0].last_step == found.attempts[0].last_step
    assert judgement_of(bundle) is None


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("scenario", "words"),
    [("loop", ("--arg", "speed=20:25", "--seed", "1")), ("highway", ("--seed", "1"))],
)
def test_what_it_hangs_on_does_not_depend_on_how_many_run_at_a_time(shell, scenario, words):
    shell.crashhunt("run", "h", "2", "200", "400", "--scenario", scenario, *words)
    bundle = find_bundle(shell.folder / "h")
    one, three = (judge(bundle, ReplayOptions(), runs=1, why=60, parallel=parallel).why for parallel in (1, 3))
    assert one == three
    assert one is not None
    assert one.runs == 60
    others = [factor for factor in one.factors if factor.kind == "other"]
    assert others
    assert sum(factor.clear for factor in others) > 0.9 * sum(len(factor.runs) for factor in others)
    partner = next(factor for factor in others if factor.name == bundle.result.collision.other)
    assert partner.what != "there" or partner.same == 0
