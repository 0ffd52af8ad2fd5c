"""What an agent omitted, in words."""

from __future__ import annotations

import pytest

from crashhunt.crashes import Omission, Reference, ReferenceRun
from crashhunt.report._judgement_words import about_reference


def said(faculty="longitudinal", endings=("none", "none", "none"), changed=(), **more):
    named = {
        "faculty": faculty, "kind": "vehicle", "actor": "left.3", "step": 41, "instead": "sped up", "speed_mps": 20.0,
        "actor_speed_mps": 15.5, "gap_m": 12.25, "safe": 19.0, "visible_step": 12,
    }  # fmt: skip
    runs = [ReferenceRun(faculty=faculty, step=41 - n, ending=end, changed=changed) for n, end in enumerate(endings)]
    return about_reference(
        Reference(omission=Omission(**named | more), runs=tuple(runs)), lambda step: f"step {step}", "ego"
    )


@pytest.mark.parametrize(
    ("more", "cause"),
    [
        (
            {},
            (
                "ego did not brake for left.3 (12.2 m ahead, 20.0 m/s where 19.0 m/s are safe), which it first "
                "observed step 12, and sped up"
            ),
        ),
        (
            {"instead": "braked too little", "visible_step": 0},
            (
                "ego braked too little for left.3 (12.2 m ahead, 20.0 m/s where 19.0 m/s are safe), which it "
                "first observed at the start"
            ),
        ),
        (
            {"kind": "red light", "actor": "", "visible_step": None, "instead": "kept its speed", "kept_s": 3.44},
            (
                "ego did not stop for a red light (12.2 m ahead, 20.0 m/s where 19.0 m/s are safe), and kept its speed "
                "for the last 3.4 s"
            ),
        ),
        (
            {"speed_mps": 18.9, "visible_step": None},
            (
                "ego did not brake for left.3 (12.2 m ahead, 19.0 m/s are safe, and it was about to drive faster), and "
                "sped up"
            ),
        ),
        (
            {"faculty": "lateral", "kind": "behind right", "instead": "changed lanes", "visible_step": 50},
            (
                "ego changed to the right lane although left.3 was 12.2 m behind it (15.5 m/s against 20.0 m/s of ego; "
                "the safe gap is 19.0 m), which it did not observe yet"
            ),
        ),
        (
            {"faculty": "lateral", "kind": "no lane left", "actor": "", "instead": "changed lanes"},
            "ego changed to the left, where it has no lane",
        ),
    ],
)
def test_the_first_sentence_is_the_cause(more, cause):
    assert said(**more)[0] == f"Cause: {cause}."


@pytest.mark.parametrize(
    ("more", "end"),
    [
        ({"last_speed_mps": 31.04}, "), and sped up to 31.0 m/s."),
        ({"last_speed_mps": 20.0}, ")."),  # it is not faster than at the beginning
        ({}, "), and sped up."),  # of an earlier version, which has not recorded the last speed
        (
            {"instead": "kept its speed", "kept_s": 1.0, "last_speed_mps": 40.0},
            "and kept its speed for the last 1.0 s.",
        ),
        ({"instead": "kept its speed", "kept_s": 0.9}, ")."),
        (
            {"instead": "kept its speed"},
            ").",
        ),  # of an earlier version: whether it did so before the last 2 s is unknown
    ],
)
def test_what_it_did_instead_is_reported_with_its_time_or_not_at_all(more, end):
    assert said(visible_step=None, **more)[0].endswith(end)


def test_only_clear_runs_count_and_other_changes_are_reported():
    (_, runs) = said(endings=("none", "unclear", "none"), changed=("ego does not change lanes",))
    assert "on, all 2 runs end without a crash." in runs
    assert runs.endswith("In addition, ego does not change lanes in these runs.")
    assert about_reference(Reference(), str, "ego") == []
