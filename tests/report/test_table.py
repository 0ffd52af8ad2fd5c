"""The layout of tables: a heading of several rows, and columns that fit into a terminal."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.base.text import aligned
from crashhunt.crashes import find_bundle
from crashhunt.errors import UsageError
from crashhunt.recording._reading import AgentChannel, ObservedPart, Prologue, StepRecord
from crashhunt.recording.records._agent_records import array_difference
from crashhunt.report._step_table import NEAREST, check_fields, format_table, stacked, steps_table

FROZEN = Path(__file__).parents[1] / "e2e" / "frozen" / "version-1" / "hunt"


def test_words_of_a_heading_stand_at_its_bottom():
    assert stacked(["step", "target_speed", "braking needed m/s²"]) == [
        ["", "", "braking"],
        ["", "target_", "needed"],
        ["step", "speed", "m/s²"],
    ]


def test_columns_are_one_space_apart_only_if_the_line_is_too_wide_otherwise():
    rows = [["step", "speed"], ["1", "15.0", "<- here"]]
    assert aligned(rows, width=11) == ["step  speed", "   1   15.0  <- here"]
    assert aligned(rows, width=10) == ["step speed", "   1  15.0 <- here"]
    assert aligned(rows) == aligned(rows, width=11)


# The steps of a recording as a table.


@pytest.fixture(scope="module")
def rear_end():
    """ego drives into the back of a slower leader in step 52."""
    return find_bundle(FROZEN, "").recording()


def test_fields_of_a_step_are_those_of_scene_nearest_partner_action_and_observation(rear_end):
    fields = ["speed", "x", "reward", *NEAREST, "gap_to_other_m", "closing_speed", "action", "observation[1, x]"]
    rows = steps_table(rear_end, fields, "ego", "leader")
    assert [row["step"] for row in rows] == list(range(53))
    expected = {
        "step": 46, "time_s": 4.6, "speed": 14.451, "x": 56.841, "reward": 1.445, "time_to_collision_s": 0.5116,
        "gap_m": 3.967, "required_deceleration": 7.578, "gap_to_other_m": 3.967, "closing_speed": 7.754,
        "target_speed": 14.451, "lane_change": 0.0, "observation[1,x]": 9.742,
    }  # fmt: skip
    assert rows[46] == pytest.approx(expected, abs=0.001)
    assert list(rows[46]) == list(expected)
    # Before the first step there is no action, and nothing closes in yet.
    assert [rows[0][name] for name in ("target_speed", "observation[1,x]", "time_to_collision_s")] == [None] * 3
    assert format_table(rows)[1].split()[:3] == ["0", "0", "6.69734"]
    assert "-" in format_table(rows)[1]
    assert format_table([]) == []
    assert list(steps_table(rear_end, ["y"], "ego")[3]) == ["step", "time_s", "y"]


def test_partner_has_no_values_if_it_is_not_given(rear_end):
    assert steps_table(rear_end, ["gap_to_other_m"], "ego")[46]["gap_to_other_m"] is None


def test_unknown_field_is_refused_with_the_known_ones(rear_end):
    with pytest.raises(UsageError) as caught:
        check_fields(rear_end, ["sped"], "ego")
    assert "'sped'" in caught.value.message
    known = ("speed", "gap_to_other_m", "target_speed", "observation[0,presence]")
    assert all(name in caught.value.fix for name in known)
    assert check_fields(rear_end, ["action", "x"], "ego") == ["target_speed", "lane_change", "x"]


def test_names_that_a_divergence_contains_are_fields():
    parts = (ObservedPart("ego", (2,), ("x", "speed")), ObservedPart("lidar2d", (3,)), ObservedPart("actors", (2, 2)))
    planner = AgentChannel("ego", "<f8", (9,), "<f8", (64, 5), observation_parts=parts)
    pedals = AgentChannel("ego", "<f8", (2, 2, 3), "<f8", (2,), ("throttle", "brake"))
    named = []
    for channel in (planner, pedals):
        was = StepRecord(4)
        for kind in ("observation", "action"):
            shape = getattr(channel, f"{kind}_shape")
            values = getattr(was, f"{kind}s")["ego"] = np.arange(1.0, 1 + np.prod(shape)).reshape(shape)
            for place in np.ndindex(*shape):
                now = values.copy()
                now[place] = 0.0
                found = array_difference(4, channel, kind, values, now)
                recording = SimpleNamespace(prologue=Prologue((channel,), 0.1), all_steps=[was])
                (row,) = steps_table(recording, [found.field], "ego")
                assert list(row.values())[2:] == [values[place]]
                named.append(found.field)
    assert {"observation[ego, speed]", "observation[lidar2d, 2]", "observation[actors, 1, 0]"} <= {*named}
    assert {"action[0, 4]", "action[63, 0]", "action[throttle]", "observation[1, 0, 2]"} <= {*named}


def test_the_values_of_a_trajectory_have_names():
    channel = AgentChannel("ego", "<f8", (1,), "<f8", (64, 5))
    step = StepRecord(4, actions={"ego": np.arange(320.0).reshape(64, 5)})
    recording = SimpleNamespace(prologue=Prologue((channel,), 0.1), all_steps=[step])
    (row,) = steps_table(recording, ["action[0, speed]", "action[63,x]", "action[1,4]", "action[5]"], "ego")
    assert [*row.values()][2:] == [4.0, 316.0, 9.0, 5.0]
    with pytest.raises(UsageError, match=r"there is no field 'action\[0,v\]'; .*, action, action\[0,time\], "):
        check_fields(recording, ["action[0,v]"], "ego")


@pytest.mark.parametrize(("shape", "said"), [((64, 5), "to (317.0, 318.0) at 320.0 m/s in 316.0 s"),
                                             ((13,), "1, 2, 3, 4, … (13 numbers)"), ((2,), None)])  # fmt: skip
def test_wide_action_is_one_column(shape, said):
    channel = AgentChannel("ego", "<f8", (1,), "<f8", shape)
    step = StepRecord(4, actions={"ego": np.arange(1.0, 1 + np.prod(shape)).reshape(shape)})
    recording = SimpleNamespace(prologue=Prologue((channel,), 0.1), all_steps=[step])
    (row,) = steps_table(recording, ["action"], "ego")
    assert list(row.items())[2:] == ([("action", said)] if said else [("action[0]", 1.0), ("action[1]", 2.0)])
