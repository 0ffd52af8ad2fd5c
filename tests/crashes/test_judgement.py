"""What re-runs of a collision have shown, summed up: by hand, without running anything."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import pytest

from crashhunt.crashes import INTERRUPTED, Attempt, Factor, Judgement, LeftOut, Why, judgement_of, with_judgement

BRAKE = Attempt("brake", 10, {3: "avoided", 4: "avoided", 5: "hit", 6: "hit", 7: "other", 8: "hit", 9: "hit"}, 6.5)
LEFT = Attempt("left", 10, {0: "avoided", 9: "hit"})
HOPELESS = Attempt("right", 10, {0: "hit", 7: "other"})


@dataclass(frozen=True)
class Bundle:
    added: dict = field(default_factory=dict)
    result: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(steps=10))


def test_the_last_step_is_the_last_that_was_run_and_avoided_it():
    assert (BRAKE.last_step, BRAKE.too_late_step, BRAKE.all_later_run) == (4, 5, True)
    assert (LEFT.last_step, LEFT.too_late_step, LEFT.all_later_run) == (0, None, False)
    assert (HOPELESS.last_step, HOPELESS.too_late_step, HOPELESS.all_later_run) == (None, 0, False)
    assert Attempt("brake", 2, {0: "hit", 1: "other"}).all_later_run
    assert Attempt("brake", 2, {0: "hit", 1: "unclear"}).all_later_run is False
    assert Attempt("brake", 10, {4: "avoided", 5: "unclear", 6: "hit"}).too_late_step is None
    assert Attempt("brake", 10, {}).too_late_step is None


def test_what_helps_longest_is_the_best_and_braking_where_nothing_helps_longer():
    found = Judgement((BRAKE, LEFT, HOPELESS))
    assert (found.avoidable, found.best, found.runs) == (True, BRAKE, 7 + 2 + 2)
    assert Judgement((LEFT, BRAKE)).best is BRAKE
    assert Judgement((LEFT, replace(LEFT, manoeuvre="right"))).best is LEFT
    assert Judgement((HOPELESS,)).best is None


@pytest.mark.parametrize(
    ("attempts", "why_not", "avoidable"),
    [
        ((HOPELESS, HOPELESS), "", False),
        ((HOPELESS,), "it was interrupted", None),
        ((), "", None),
        ((Attempt("brake", 10, {7: "hit"}),), "", None),  # nobody knows what would have come of the first step
        ((Attempt("brake", 10, {0: "hit", 5: "unclear"}),), "", None),
        ((HOPELESS, Attempt("left", 10, {0: "unclear"})), "", None),
        ((LEFT,), "it was interrupted", True),
    ],
)
def test_that_nothing_helps_is_said_only_where_all_was_run(attempts, why_not, avoidable):
    assert Judgement(attempts, why_not).avoidable is avoidable


def test_it_is_kept_in_a_bundle_next_to_what_others_have_added():
    judgement = Judgement((BRAKE, HOPELESS), "it was interrupted")
    bundle = with_judgement(Bundle({"others": 1}), judgement)
    assert bundle.added["others"] == 1
    data = json.loads(json.dumps(bundle.added["judged"]))
    assert (data["avoidable"], data["manoeuvre"], data["last_step"], data["runs"]) == (True, "brake", 4, 9)
    assert data["why_not"] == "it was interrupted"
    first, second = data["attempts"]
    assert list(first["endings"]) == ["3", "4", "5", "6", "7", "8", "9"]
    assert (first["last_step"], first["too_late_step"], first["all_later_run"]) == (4, 5, True)
    assert (first["deceleration"], second["deceleration"]) == (6.5, None)
    assert judgement_of(Bundle({"judged": data})) == judgement
    whole = replace(judgement, visible_step=3, why=Why((Factor("agent", "ego", "sped up", 2),), 30))
    (kept,) = with_judgement(Bundle(), whole).added.values()
    assert judgement_of(Bundle({"judged": json.loads(json.dumps(kept))})) == whole
    none = with_judgement(Bundle(), Judgement((HOPELESS,))).added["judged"]
    assert (none["manoeuvre"], none["last_step"], none["avoidable"]) == ("", None, False)


@pytest.mark.parametrize("damage", [
    None, [], {}, {"attempts": 3}, {"attempts": [{"manoeuvre": "brake"}]},
    {"attempts": [{"manoeuvre": 3, "endings": {}, "deceleration": None}]},
    {"attempts": [{"manoeuvre": "brake", "endings": {"x": "hit"}, "deceleration": None}]},
    {"attempts": [{"manoeuvre": "brake", "endings": {}, "deceleration": "hard"}]},
])  # fmt: skip
def test_what_cannot_be_read_is_no_judgement(damage):
    assert judgement_of(Bundle({"judged": damage} if damage is not None else {})) is None


def test_search_is_interrupted_if_any_part_of_it_is_and_runs_of_all_factors_count():
    runs = tuple(LeftOut(seed, "none") for seed in range(3))
    why = Why((Factor("seed", "seed", "drawn", runs=runs), Factor("argument", "speed", "drawn", runs=runs[:1])))
    assert why.runs == 4
    assert not Judgement(why=why).is_interrupted
    assert Judgement(why=replace(why, why_not=INTERRUPTED)).is_interrupted
    assert Judgement(why_not=INTERRUPTED).is_interrupted
