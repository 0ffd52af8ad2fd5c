"""What tables and pages tell of a trial, and the plain data that they take it from."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace

from crashhunt.results import FACTS, TrialRow
from crashhunt.results._trial_table import BRANCHES, DISTURBANCES, ORIGINS, STRESS
from crashhunt.trial import (
    EVENTS,
    Branch,
    Branches,
    Collision,
    Disturbance,
    Escape,
    Failure,
    Outcome,
    Stress,
    TrialResult,
    TrialSpec,
)
from crashhunt.world import ClosestApproach, Event

SPEC = TrialSpec(3, 7, {"ego": {"speed": 11.5}}, {"gap_m": 4}, max_steps=100, parent=1, origin="climb")
# Every value is another one, so that none stands in another's place unnoticed.
RESULT = TrialResult(
    SPEC,
    Outcome.COLLISION,
    steps=9,
    sim_time_s=0.9,
    digest="ab",
    closest=ClosestApproach(0.25, 0.5, 6.5),
    collision=Collision("ego", "victim", "car", "ego", ("overlap",), "junction", 1.5, 2.5, "a_0", 12.5, 13.5, 0.875),
    failure=Failure("KeyError", "'x'", "Trace", "other", -9, "out"),
    wall_s=2.25,
    setup_s=1.75,
    worker=99,
    kept=True,
    escape=Escape(4, 5, 7.5, "by braking"),
    event=Event("teleport", "ego", "car was moved", ("car",), "b_0", 3.5, 4.5, 14.5, "slow", ("a > 1 is false",)),
    events={"teleport": 2},
    danger=0.875,
)


def test_plain_data_has_every_value_of_a_result():
    """A field that is added, and not written or not read, shows here, as long as it is given above."""
    assert TrialResult.from_json(json.loads(json.dumps(RESULT.to_json()))) == RESULT
    for part in (RESULT.collision, RESULT.failure, RESULT.escape, RESULT.event, RESULT.closest):
        names = [item.name for item in dataclasses.fields(part)]
        left_out = {name for name in ("party", "place", "why_not", "cell", "changed") if not getattr(part, name, None)}
        assert list(part.to_json()) == [name for name in names if name not in left_out]


def test_a_row_has_every_column():
    columns = (*FACTS, "parent", "origin", "ego.speed", "scenario.gap_m", "ego.other")
    row = TrialRow(RESULT.to_json()).cells(columns)
    assert row == {
        "number": 3, "seed": 7, "outcome": "collision", "steps": 9, "sim_time_s": 0.9, "danger": 0.875,
        "time_to_collision_s": 0.25,
        "gap_m": 0.5, "required_deceleration": 6.5, "wall_s": 2.25, "digest": "ab",
        **dict.fromkeys(EVENTS, 0), "teleport": 2,
        "parent": 1, "origin": "climb", "ego.speed": 11.5, "scenario.gap_m": 4, "ego.other": None,
    }  # fmt: skip
    assert tuple(row) == columns


def test_where_no_one_looked_for_events_a_row_does_not_say_that_there_were_none():
    unseen = dataclasses.replace(RESULT, events=None, closest=ClosestApproach())
    row = TrialRow(unseen.to_json())
    assert set(row.cells([str(kind) for kind in EVENTS]).values()) == {None}
    assert (row.number, row.outcome, row.danger, row.time_to_collision_s) == (3, Outcome.COLLISION, 0.875, None)
    assert (row.arguments, row.scenario_arguments) == ({"ego": {"speed": 11.5}}, {"gap_m": 4})


def test_a_row_of_an_earlier_version_has_what_that_wrote():
    row = TrialRow({"spec": {"number": 3, "seed": 7, "max_steps": 9}, "outcome": "survived", "steps": 9})
    assert (row.danger, row.time_to_collision_s, row.arguments, row.scenario_arguments) == (None, None, {}, {})
    assert row.cells(("seed", "gap_m", "wall_s", "digest")) == {
        "seed": 7,
        "gap_m": None,
        "wall_s": None,
        "digest": None,
    }


def test_margin_that_is_not_fully_asked_is_empty_and_what_was_asked_stands_next_to_it():
    half = Stress(None, moments=9, moments_asked=1, margin_upper_bound=0.25)
    branches = Branches(asked=12, unanswered=1)
    row = TrialRow(replace(RESULT, stress=half, branches=branches).to_json()).cells((*STRESS, *BRANCHES))
    assert row == {
        "stress_margin": None, "stress_asked": "asked 1 of 9", "stress_margin_upper_bound": 0.25,
        "branches": 12, "branch_crashes": 0, "branches_asked": "asked 12 of 13",
    }  # fmt: skip
    whole = replace(RESULT, stress=Stress(0.5, moments=9, moments_asked=9))
    assert TrialRow(whole.to_json()).cells(STRESS) == {
        "stress_margin": 0.5, "stress_asked": "asked 9 of 9", "stress_margin_upper_bound": None,
    }  # fmt: skip
    before = whole.to_json()
    del before["stress"]["moments"], before["stress"]["moments_asked"]  # which earlier versions did not write
    assert TrialRow(before).cells(STRESS) == {
        "stress_margin": 0.5, "stress_asked": None, "stress_margin_upper_bound": None,
    }  # fmt: skip


def test_columns_of_a_table_keep_their_order():
    assert FACTS[:11] == (
        "number", "seed", "outcome", "steps", "sim_time_s", "danger", "time_to_collision_s", "gap_m",
        "required_deceleration", "wall_s", "digest",
    )  # fmt: skip
    assert FACTS[11:] == tuple(map(str, EVENTS))
    assert (*DISTURBANCES, *STRESS, *BRANCHES, *ORIGINS) == (
        "disturbances", "log_likelihood", "stress_margin", "stress_asked", "stress_margin_upper_bound", "branches",
        "branch_crashes", "branches_asked", "parent", "origin",
    )  # fmt: skip


def test_row_of_a_trial_with_disturbances_counts_them():
    erring = (Disturbance(2, "ahead", "brake", 4.0, 2.0, "ego"),) * 2
    row = TrialRow(replace(RESULT, disturbances=erring, log_likelihood=-3.5).to_json())
    assert row.cells(DISTURBANCES) == {"disturbances": 2, "log_likelihood": -3.5}
    crashes = (Branch((), 1, "collision", 5, -2.0),) * 3
    assert (
        TrialRow(replace(RESULT, branches=Branches(crashes=crashes)).to_json()).cells(BRANCHES)["branch_crashes"] == 3
    )
    early = TrialRow({"spec": {"number": 3, "seed": 7}, "outcome": "survived", "steps": 9, "branches": {"asked": 4}})
    assert early.cells((*DISTURBANCES, *BRANCHES[:2])) == {
        "disturbances": 0, "log_likelihood": None, "branches": 4, "branch_crashes": 0,
    }  # fmt: skip
    assert early.origin == ""
    assert TrialRow(RESULT.to_json()).origin == "climb"


def test_row_knows_whether_all_forks_of_its_trial_have_a_result():
    def fully(stress, branches):
        return TrialRow(replace(RESULT, stress=stress, branches=branches).to_json()).is_fully_asked

    half, whole = Stress(None, moments=9, moments_asked=1), Stress(0.5)
    some, every = Branches(asked=1, unanswered=1), Branches(asked=2)
    assert fully(None, None) is fully(whole, every) is True
    assert [fully(*one) for one in ((half, None), (None, some), (half, every), (whole, some))] == [False] * 4
    assert TrialRow(replace(RESULT, stress=half).to_json()).stress_margin is None
    assert TrialRow(replace(RESULT, stress=whole).to_json()).stress_margin == 0.5
    assert TrialRow(RESULT.to_json()).stress_margin is None
