"""What each sampler proposes in one and the same hunt is what it was; the files are in tests/golden/samplers.

Crashes of two kinds, trials that could not be set up, and dangers of two peaks: every strategy has its turn.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from golden import compare_golden_json, need_versions
from spaces import ask, spec_of

from crashhunt.errors import CrashhuntError, PluginError, UsageError
from crashhunt.samplers import HuntFacts, NamedSampler, Proposal
from crashhunt.space import Choice, Constant, Range
from crashhunt.trial import Collision, Failure, Outcome, TrialResult

SPACE = {
    ("ego", "x"): Range(0.0, 1.0), ("ego", "y"): Range(1.0, 100.0, log=True), ("", "n"): Range(1, 9, integer=True),
    ("", "w"): Choice(("a", "b", "c")), ("", "fixed"): Constant(3),
}  # fmt: skip
PLAIN = {"random", "halton", "sobol", "grid", "sweep"}
LEARN = {"guided", "mutation", "cross-entropy"} | ({"cma-es"} if importlib.util.find_spec("cmaes") else set())
ENDS = {"boundary"}  # when its map is complete
TRIALS, SHOWN = 240, 12


def result_of(number, proposal):
    """How a trial ends: near (0.3, 30) it is dangerous and at last crashes, and a little less near (0.8, 3)."""
    spec = spec_of(number, proposal)
    x, y = spec.arguments["ego"]["x"], spec.arguments["ego"]["y"]
    n, w = spec.scenario_arguments["n"], spec.scenario_arguments["w"]
    first = 0.97 - 0.5 * abs(x - 0.3) - 0.2 * abs(np.log10(y) - 1.5) - 0.01 * abs(n - 6)
    second = 0.9 - 0.6 * abs(x - 0.8) - 0.3 * abs(np.log10(y) - 0.5)
    danger = round(max(first, second) - 0.02 * (w != "b"), 4)
    if number % 41 == 7:
        return TrialResult(spec, Outcome.INVALID)
    if danger > 0.93:
        lane = "main_1" if n < 6 else "side_0"
        hit = Collision("ego", "collider", "ego", "other", ("overlap",), "collision", x, y, lane)
        return TrialResult(spec, Outcome.COLLISION, steps=5, collision=hit, danger=1.0)
    if number % 97 == 50:
        return TrialResult(spec, Outcome.HANG, steps=5, failure=Failure("timeout", "too long", "", "ego"))
    return TrialResult(spec, Outcome.SURVIVED, steps=9, danger=max(danger, 0.0))


def hunted(name, space, lag):
    sampler = NamedSampler(name, space, points=4, hunt=HuntFacts(5, (Outcome.COLLISION,)))
    results, rows = [], []
    for number in range(TRIALS):
        if sampler.learns and number >= lag:
            sampler.tell(results[number - lag])
        proposal = ask(sampler, number, seed=5)
        results.append(result_of(number, proposal))
        values = [proposal.arguments[key] for key in sorted(SPACE) if key[1] != "fixed"]
        values = [float(f"{value:.6g}") if isinstance(value, float) else value for value in values]
        rows.append([number, proposal.origin, proposal.parent, proposal.seed, *values])
    return sampler, results, rows


@pytest.mark.parametrize("name", sorted(PLAIN | LEARN))
def test_what_a_sampler_proposes_is_what_it_was(name):
    file = f"samplers/{name}.json"
    versions = need_versions(file, "numpy", "scipy")
    space = SPACE
    if name == "sweep":
        space = {key: known if key[1] == "x" else Constant(known.quantile(0.3)) for key, known in SPACE.items()}
    found = {}
    for lag in (1, 6) if name in LEARN else (1,):
        sampler, results, rows = hunted(name, space, lag)
        crashed = [one.spec.number for one in results if one.outcome is Outcome.COLLISION]
        origins = {origin: sum(row[1] == origin for row in rows) for origin in sorted({row[1] for row in rows})}
        shown = rows[:3] + rows[SHOWN - 1 :: SHOWN]
        total = [round(sum(float(row[place]) for row in rows), 2) for place in (4, 6, 7)]
        found[f"told {lag} later"] = {"crashed": crashed, "origins": origins, "sums": total, "proposals": shown}
    facts = {"learns": sampler.learns, "independent": sampler.independent, "plain origin": sampler.plain_origin}
    compare_golden_json(file, {"versions": versions, "facts": facts, "hunts": found})


class Scripted:
    """A sampler of somebody's that answers what a test says."""

    learns, independent = False, False
    answer: object = None

    def __init__(self, space, *, points):
        self.told = []
        Scripted.last = self

    def ask(self, number, rng):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def tell(self, result):
        if isinstance(self.answer, Exception):
            raise self.answer
        self.told.append(result)


ONE = {("ego", "x"): Range(0.0, 1.0)}


@pytest.fixture
def scripted(monkeypatch):
    monkeypatch.setattr("crashhunt.samplers._by_name.locate", lambda kind, name: Scripted)
    monkeypatch.setattr(Scripted, "answer", None)
    return Scripted


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (5, "int, not arguments"),
        ({}, "no value for ego.x"),
        ({("ego", "x"): 1.0, ("", "y"): 2}, "a value for y"),
        ({("ego", "x"): None}, "ego.x = None, not a plain bool, int, float or str"),
        ({("ego", "x"): float("nan")}, "ego.x = nan, not a finite number"),
        (Proposal({("ego", "x"): 1.0}, seed=-1), "the seed -1, not one from 0 to 2147483647"),
        (Proposal({("ego", "x"): 1.0}, seed=2**31), "the seed 2147483648, not one"),
        (Proposal({("ego", "x"): 1.0}, seed=True), "the seed True, not one"),
        (Proposal({("ego", "x"): 1.0}, parent=-1), "the parent -1, not the number of a trial"),
        (Proposal({("ego", "x"): 1.0}, parent=1.0), "the parent 1.0, not the number"),
        (Proposal({("ego", "x"): 1.0}, origin=3), "the origin 3, not a word"),
        (ValueError("no idea"), "fails when it is asked for trial 7"),
    ],
)
def test_an_answer_that_is_none_is_one_line(scripted, answer, says):
    scripted.answer = answer
    with pytest.raises(PluginError) as refused:
        NamedSampler("theirs", ONE, points=3).ask(7, np.random.default_rng(1))
    assert says in str(refused.value)
    assert "theirs" in str(refused.value)


def test_answers_that_are_fine_are_passed_on(scripted):
    sampler = NamedSampler("theirs", ONE, points=3)
    rng = np.random.default_rng(1)
    scripted.answer = {("ego", "x"): 0.5}
    assert sampler.ask(0, rng) == Proposal({("ego", "x"): 0.5})
    for answer in (
        Proposal({("ego", "x"): True}, seed=0, parent=0, origin="climb"),
        Proposal({("ego", "x"): "w"}, seed=2**31 - 1),
    ):
        scripted.answer = answer
        assert sampler.ask(0, rng) is answer
    spec = spec_of(9, scripted.answer)
    sampler.tell(TrialResult(spec, Outcome.SURVIVED))
    assert [one.spec.number for one in scripted.last.told] == [9]
    scripted.answer = ValueError("no idea")
    with pytest.raises(PluginError, match="fails on the result of trial 9"):
        sampler.tell(TrialResult(spec, Outcome.SURVIVED))
    scripted.answer = UsageError("its own")
    for call in (lambda: sampler.ask(1, rng), lambda: sampler.tell(TrialResult(spec, Outcome.SURVIVED))):
        with pytest.raises(CrashhuntError, match="its own"):
            call()


def test_a_sampler_that_contradicts_itself_is_refused(scripted, monkeypatch):
    monkeypatch.setattr(Scripted, "learns", True)
    assert NamedSampler("theirs", ONE, points=3).learns
    assert not NamedSampler("theirs", ONE, points=3).independent
    monkeypatch.setattr(Scripted, "independent", True)
    with pytest.raises(PluginError, match="declares both learns and independent"):
        NamedSampler("theirs", ONE, points=3)
    monkeypatch.setattr(Scripted, "learns", False)
    assert NamedSampler("theirs", ONE, points=3).independent
    monkeypatch.delattr(Scripted, "tell")
    with pytest.raises(PluginError, match="has no 'tell'"):
        NamedSampler("theirs", ONE, points=3)


def test_a_grid_and_a_sweep_refuse_what_they_cannot_do():
    for name in ("grid", "sweep"):
        with pytest.raises(UsageError, match="points is 0"):
            NamedSampler(name, ONE, points=0)
    rng = np.random.default_rng(1)
    assert len({NamedSampler("grid", ONE, points=1).ask(number, rng).arguments["ego", "x"] for number in range(3)}) == 1
    with pytest.raises(UsageError, match=r"varying argument, not: nothing"):
        NamedSampler("sweep", {("ego", "x"): Constant(1)}, points=3)
    with pytest.raises(UsageError, match=r"varying argument, not: n, w, ego\.x, ego\.y"):
        NamedSampler("sweep", SPACE, points=3)


def test_golden_files_are_those_of_all_samplers_that_come_with_crashhunt():
    from importlib.metadata import entry_points

    ours = {point.name for point in entry_points(group="crashhunt.samplers") if point.value.startswith("crashhunt.")}
    assert ours == PLAIN | LEARN | ENDS | {"cma-es"}
    folder = Path(__file__).parents[1] / "golden" / "samplers"
    assert {path.stem for path in folder.glob("*.json")} >= ours - ENDS
