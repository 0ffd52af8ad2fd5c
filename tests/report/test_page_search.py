"""What the page tells of a search follows from its trials."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import examples

from crashhunt.base import layout
from crashhunt.crashes import list_bundles
from crashhunt.ledger import Ledger
from crashhunt.report import _page
from crashhunt.report._argument_importance import importance_of
from crashhunt.report._page import lineage_of, report_data
from crashhunt.results import HuntResults, find_crashes
from crashhunt.trial import Outcome, TrialResult, TrialSpec


def made(number, parent):
    return TrialResult(TrialSpec(number, 1, {}, {}, max_steps=1, parent=parent), Outcome.SURVIVED)


def drawn(count, danger_of, seed=1):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        values = {"a": rng.random(), "b": int(rng.integers(3)), "c": "xyz"[rng.integers(3)], "d": 1.0}
        yield values, danger_of(values, rng)


def test_what_danger_follows_is_important_and_what_it_does_not_is_not():
    def danger_of(values, rng):
        return abs(values["a"] - 0.5) + (values["c"] == "y") * 0.5 + 0.1 * rng.random()

    found = {one["name"]: one for one in importance_of(list(drawn(600, danger_of)))}
    assert list(found) == ["c", "a", "b"]  # d has one value
    assert found["c"]["share"] > 0.5
    assert 0.1 < found["a"]["share"] < 0.5  # danger falls, then rises
    assert found["b"]["share"] < 0.02
    for one in found.values():
        assert 0.0 <= one["low"] <= one["share"] <= one["high"] <= 1.0


def test_an_interval_has_its_argument_in_it_nine_times_of_ten():
    """And is narrower the more trials there are."""

    def danger_of(values, rng):
        return values["a"] + rng.standard_normal()

    truth = importance_of(list(drawn(4000, danger_of, 99)))[0]["share"]
    inside, widths = 0, []
    for seed in range(examples(40)):
        one = next(one for one in importance_of(list(drawn(200, danger_of, seed))) if one["name"] == "a")
        inside += one["low"] <= truth <= one["high"]
        widths.append(one["high"] - one["low"])
    assert inside >= 0.75 * examples(40)
    one = next(one for one in importance_of(list(drawn(2000, danger_of))) if one["name"] == "a")
    assert one["high"] - one["low"] < np.mean(widths) / 2


def test_few_trials_or_no_differences_say_nothing():
    assert importance_of(list(drawn(39, lambda _, rng: rng.random()))) == []
    assert all(one["share"] == 0.0 for one in importance_of(list(drawn(60, lambda *_: 0.5))))


def test_a_lineage_leads_from_parent_to_parent_and_ends_where_a_trial_is_missing():
    trials = {number: made(number, parent).to_json() for number, parent in ((9, 5), (5, 2), (2, None), (4, 3), (6, 6))}
    for number, line in ((9, [5, 2]), (2, []), (4, []), (6, []), (7, [])):
        assert [one[0] for one in lineage_of(number, trials.get)] == line


@pytest.mark.parametrize("trials", [100, 200, 401, 1000])
def test_of_many_trials_those_that_are_drawn_are_of_all_origins(tmp_path, monkeypatch, trials):
    """Every fifth trial of a guided hunt is a plain random one: a page with every fifth or tenth had no others."""
    monkeypatch.setattr(_page, "_MAX_PLOTTED_TRIALS", 40)
    ledger = Ledger(tmp_path / layout.LEDGER, writable=True)
    with ledger.together():
        for number in range(trials):
            origin = "random" if number % 5 == 0 else "model"
            spec = TrialSpec(number, 1, {"ego": {}}, {}, max_steps=1, origin=origin)
            ledger.record(TrialResult(spec, Outcome.SURVIVED, danger=0.5), snapshot="")
    ledger.close()
    drawn = _page._trials(tmp_path, SimpleNamespace(crash_on=("collision",)))["trials"]
    assert 36 <= len(drawn) <= 44
    assert 4 <= [trial["origin"] for trial in drawn].count("random") <= 12
    assert max(after["number"] - before["number"] for before, after in pairwise(drawn)) < 3 * trials / 40


@pytest.mark.nightly
def test_the_page_knows_from_which_trials_a_crash_was_made(shell):
    (shell.folder / "toy").mkdir()
    toy = 'schema = 1\nsimulator = "toy"\n[agents.ego]\nagent = "crashhunt.agents:KeepLaneWithSpeed"\n'
    (shell.folder / "toy" / "scenario.toml").write_text(toy)
    words = ("--scenario", "toy", "--arg", "speed=10:18.5", "--sampler", "mutation", "--seed", "3")
    shell.crashhunt("run", "hunt", "1", "100", "50", *words)
    (crash,) = list_bundles(shell.folder / "hunt")
    data = report_data(
        shell.folder / "hunt", [crash], found=find_crashes(shell.folder / "hunt", 1), near_misses=0, name="hunt"
    )
    (line,) = data["lineages"].values()
    rows = {row["number"]: row for row in HuntResults(shell.folder / "hunt").rows()}
    above = HuntResults(shell.folder / "hunt").trial(crash.result.spec.number).spec
    assert above.origin == "mutation"
    assert line
    for number, origin, danger in line:
        assert number == above.parent
        above = HuntResults(shell.folder / "hunt").trial(number).spec
        assert (origin, danger) == (rows[number]["origin"], rows[number]["danger"])
    assert above.parent is None
    assert {trial["origin"] for trial in data["trials"]} == {"random", "mutation", "start"}
