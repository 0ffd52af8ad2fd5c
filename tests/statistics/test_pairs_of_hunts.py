"""Which hunts can be compared trial by trial: those in which the same number is the same traffic."""

from __future__ import annotations

from contextlib import closing
from types import SimpleNamespace

import pytest

from crashhunt.errors import HuntDirectoryError
from crashhunt.ledger import Ledger
from crashhunt.plans import HuntSettings, RunSettings, write_settings
from crashhunt.statistics import PairedHunts, PairWatch, _hunt_pairs
from crashhunt.statistics._comparison import why_unpaired
from crashhunt.statistics._hunt_pairs import GateCase
from crashhunt.trial import KILLED, Constant, Failure, Outcome, Range, TrialResult, TrialSpec

HUNT = {
    "rare": False, "seeds": 0, "trials": 100, "scenario_digest": "a", "disturb": (),
    "scenario_arguments": {"cars": Range(1, 9, integer=True)},
}  # fmt: skip


@pytest.mark.parametrize(
    ("one", "other", "reason"),
    [
        ({}, {}, ""),
        ({}, {"trials": 50}, ""),
        ({"seeds": 10}, {"seeds": 10}, ""),
        ({"seeds": 10, "trials": 10}, {"seeds": 10}, ""),
        ({"seeds": 10, "trials": 9}, {"seeds": 10}, "they have fewer trials than the 10 traffics"),
        ({"seeds": 10}, {"seeds": 10, "trials": 9}, "they have fewer trials than the 10 traffics"),
        ({"seeds": 10}, {}, "they have 10 traffics and one per trial (--seeds)"),
        ({"rare": True}, {"rare": True}, "they are in rare mode"),
        ({"rare": True}, {}, "one is in rare mode"),
        ({"scenario_digest": "b"}, {}, "they are of two scenarios"),
        ({"disturb": ("brake=0.1", "stop=0.1")}, {}, "they have the disturbances brake=0.1, stop=0.1 and no disturb"),
        ({"scenario_arguments": {}}, {}, "they do not try the same values of cars,"),
        ({"scenario_arguments": {"cars": Constant(3)}}, {}, "they do not try the same values of cars,"),
    ],
    ids=str,
)
def test_hunts_are_paired_if_the_same_number_is_the_same_traffic(one, other, reason):
    found = why_unpaired(SimpleNamespace(**HUNT | one), SimpleNamespace(**HUNT | other))
    assert found.startswith(reason)
    assert bool(found) == bool(reason)


def hunt(path, killed=(), **more):
    """A hunt of four trials, without running it, whose processes were killed in some of them."""
    path.mkdir()
    usual = {"scenario": "toy", "scenario_digest": "a", "trials": 4, "max_steps": 9, "seed": 4, "run": RunSettings()}
    settings = HuntSettings(**usual | more)
    write_settings(path / "hunt.toml", settings, ["crashhunt"])
    with closing(Ledger(path / "ledger.sqlite", writable=True)) as ledger:
        record(ledger, range(4), killed)
    return path


def record(ledger, numbers, killed=()):
    for number in numbers:
        failure = Failure(KILLED, "killed from outside 3 times") if number in killed else None
        outcome = Outcome.INVALID if failure else Outcome.SURVIVED
        ledger.record(TrialResult(TrialSpec(number, number, {}, {}, 9), outcome, failure=failure), snapshot="")


def test_trials_that_were_killed_in_an_earlier_run_count_only_after_the_hunts_had_the_chance_to_repeat_them(tmp_path):
    base, head = hunt(tmp_path / "base"), hunt(tmp_path / "head", killed={1})
    pairs, watch = PairedHunts("toy", base, head, 4), PairWatch(0.0)
    pairs.take(watch)
    assert (pairs.counts.pairs, pairs.is_complete) == (1, False)
    pairs.take(watch, has_ended=True)
    assert (pairs.counts.pairs, pairs.is_complete) == (3, True)
    assert [side.killed for side in pairs.counts.sides] == [0, 1]
    assert watch.test.difference().low < 0 < watch.test.difference().high
    again, watch = PairedHunts("toy", base, head, 4), PairWatch(0.0)
    again.take(watch)
    with closing(Ledger(head / "ledger.sqlite", writable=True)) as ledger:
        ledger.replace([1])
        record(ledger, [1])
    again.take(watch)
    assert (again.counts.pairs, again.counts.sides[1].killed, again.is_complete) == (4, 0, True)
    with closing(Ledger(head / "ledger.sqlite", writable=True)) as ledger:
        ledger.replace([1])
        record(ledger, [1], killed={1})
    last = PairedHunts("toy", base, head, 4)
    last._killed_after = 0.0  # as if the trial was killed in this run
    last.take(PairWatch(0.0))
    assert last.counts.sides[1].killed == 1


def test_crash_types_are_counted_in_the_pairs_only(tmp_path, monkeypatch):
    base, head = hunt(tmp_path / "base"), hunt(tmp_path / "head")
    pairs = PairedHunts("toy", base, head, 4)
    pairs._crashed = ([0, 1], [1, 2, 3])
    types = {base: {0: "A", 1: "B", 3: "C"}, head: {1: "B", 2: "D"}}
    monkeypatch.setattr(_hunt_pairs, "crash_types", types.get)
    assert pairs.crash_types() == {"A": (1, 0), "B": (1, 1), "D": (0, 1)}


def test_hunts_with_different_traffic_are_refused_and_base_is_named_first(tmp_path):
    base, head = hunt(tmp_path / "base", disturb=("brake=0.1",)), hunt(tmp_path / "head", disturb=("stop=0.2",))
    with pytest.raises(
        HuntDirectoryError, match=r"they have the disturbances brake=0\.1 and the disturbances stop=0\.2"
    ) as refused:
        PairedHunts("toy", base, head, 4).take(PairWatch(0.0))
    assert refused.value.where == "toy"


@pytest.mark.parametrize(("held_out", "pairs", "trained_on"), [({0, 1, 2, 3}, 4, 0), ({1, 3}, 2, 2), (set(), 0, 4)])
def test_traffic_of_the_training_does_not_count(tmp_path, monkeypatch, held_out, pairs, trained_on):
    traffics = SimpleNamespace(is_empty=not held_out, has=lambda seed: seed in held_out)
    monkeypatch.setattr(_hunt_pairs, "held_out_traffics", lambda settings, folders: traffics)
    found = PairedHunts("toy", hunt(tmp_path / "base"), hunt(tmp_path / "head"), 4)
    found.take(PairWatch(0.0), has_ended=True)
    assert (found.counts.pairs, found.trained_on, found.is_complete) == (pairs, trained_on, True)


@pytest.mark.parametrize("expected", ["still", "fixed"])
@pytest.mark.parametrize(("got", "crashes"), [("still", 1), ("changed", 1), ("fixed", 0), ("cannot_run", 0)])
def test_case_has_come_back_if_it_was_fixed_and_crashes(expected, got, crashes):
    assert GateCase("a", expected, got, "now").has_come_back is (expected == "fixed" and bool(crashes))
