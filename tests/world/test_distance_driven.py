"""The distance and time that agents drive, from scenes of known motion."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

from crashhunt.world import Actor, DrivenMeter, Frame, Roster

SPEEDS = st.lists(st.floats(-60, 60), min_size=1, max_size=30)


def frames(speeds, *, cuts=(), names=("other", "ego")):
    """Scenes of several actors, ego last, split into frames before some scenes."""
    roster = Roster(tuple(Actor(name, "car", 5.0, 2.0) for name in names))
    columns = np.zeros((len(speeds), 4 * len(names)))
    columns[:, 3 * len(names) + len(names) - 1] = speeds
    edges = [0, *sorted(cuts), len(speeds)]
    return [Frame(roster, columns[a:b]) for a, b in pairwise(edges) if b > a]


def measured(*parts, step_s=0.1, agents=("ego",)):
    meter = DrivenMeter(agents, step_s)
    for part in parts:
        meter.add(part)
    return meter.driven_m, meter.driven_s


def test_reversing_counts_as_driving():
    assert measured(frames([-2, -2, -2])) == (0.4, 0.2)


def test_agent_in_no_scene_has_no_distance():
    assert measured(frames([1, 1]), agents=("third",)) == (None, None)


def test_a_speed_that_is_no_number_gives_no_distance_but_a_time():
    assert measured(frames([1, np.nan, 1])) == (None, 0.2)


def test_absence_is_not_driven():
    """After 1 m in one step the agent is absent for two scenes, and then drives 2 m in one step."""
    gone = frames([9, 9], names=("other",))
    assert measured(frames([10, 10]), gone, frames([20, 20])) == (3.0, 0.2)
    assert measured([*frames([10, 10]), *gone, *frames([20, 20])]) == (3.0, 0.2)


def test_distances_of_several_agents_add_up():
    assert measured(frames([10, 10]), agents=("other", "ego")) == (1.0, 0.2)


@given(SPEEDS, st.data())
def test_grouping_of_scenes_changes_no_bit(speeds, data):
    cuts = data.draw(st.sets(st.integers(1, max(1, len(speeds) - 1))))
    cuts = [cut for cut in cuts if cut < len(speeds)]
    pieces = frames(speeds, cuts=cuts)
    meters = [DrivenMeter(("ego",), 0.1) for _ in range(3)]
    meters[0].add(frames(speeds))
    meters[1].add(pieces)
    for piece in pieces:
        meters[2].add([piece])
    assert len({meter._speeds for meter in meters}) == 1
    means = [(abs(before) + abs(after)) / 2 for before, after in pairwise(speeds)]
    assert meters[0].driven_m == pytest.approx(sum(means) * 0.1, abs=1e-3)


def test_distance_and_time_are_rounded_to_millimetres_and_milliseconds():
    assert measured(frames([1.23456, 1.23456]), step_s=0.12345) == (0.152, 0.123)
