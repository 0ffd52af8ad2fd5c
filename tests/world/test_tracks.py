"""Who was where when: at which instants it is looked at, what is put in between, and who counts as near."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from crashhunt.world import Actor, Frame, Roster
from crashhunt.world._tracks import sampled, spacing_s, tracks, ways

EGO, OTHER, FAR = Actor("ego", "car", 4.0, 2.0, 1.5), Actor("other", "truck", 10.0, 2.5, 4.0), Actor("far", "car", 4, 2)


def frame(rows, roster=None, **more):
    """Each row is ((x, y, heading), …) of the fronts."""
    places = np.array([[value for x, y, _ in row for value in (x, y)] for row in rows], float)
    headings = np.array([[heading for *_, heading in row] for row in rows], float)
    roster = roster or Roster((EGO, OTHER, FAR)[: headings.shape[1]])
    return Frame(roster, np.hstack((places, headings, np.zeros_like(headings))), **more)


@pytest.mark.parametrize(
    ("step_s", "spacing"), [(0.04, 0.32), (0.1, 0.3), (0.2, 0.2), (0.3, 0.3), (0.5, 0.25), (1.0, 0.25), (1.2, 0.3)]
)
def test_samples_are_some_tenths_of_a_second_apart(step_s, spacing):
    assert spacing_s(step_s) == pytest.approx(spacing)
    rows = [((float(step), 0.0, 0.0),) for step in range(40)]
    track, _, _ = ways([frame(rows)], "ego", 100.0, step_s)
    assert np.diff(track.time) == pytest.approx(spacing)
    assert (track.time[0], track.time[-1]) == (0.0, pytest.approx(39 * step_s, abs=spacing))
    assert track.x == pytest.approx(track.time / step_s - 2.0)


@pytest.mark.parametrize("step_s", [0.1, 0.5])
def test_it_does_not_matter_in_which_parts_they_come(step_s):
    whole = frame([((float(step) ** 2, -1.0, 0.1 * step), (8.0 * step, step, 3 * step)) for step in range(23)])
    heights = np.arange(92, dtype=float).reshape(23, 4)
    spines = tuple({1: ((8.0 * step, step, 0.0), (8.0 * step - 10, step, step))} if 7 < step < 9 else {}
                   for step in range(23))  # fmt: skip
    for one in (whole._replace(heights=heights), whole._replace(spines=spines)):
        parts = []
        for a, b in pairwise([0, 1, 5, 6, 20, 23]):
            high = heights[a:b] if one.heights is not None else None
            bent = one.spines[a:b] if one.spines is not None and any(one.spines[a:b]) else None
            parts.append(one._replace(columns=one.columns[a:b], heights=high, spines=bent))
        parts[2] = parts[2]._replace(roster=Roster(one.roster.actors))  # another one, of the same
        (at_once, others, _), (in_parts, others_in_parts, _) = (
            ways(each, "ego", 1e4, step_s) for each in ([one], parts)
        )
        assert np.array(in_parts) == pytest.approx(np.array(at_once))
        assert len(others.sample) >= len(at_once.time)
        columns = slice(0, 9 if one.heights is not None else 8)  # how tall they are says nothing on a flat map
        assert np.array(others_in_parts)[columns] == pytest.approx(np.array(others)[columns])


def test_between_two_scenes_it_turns_the_short_way_round_and_goes_straight():
    track, _, _ = ways([frame([((0.0, 0.0, 3.0),), ((8.0, 4.0, -3.0),)])], "ego", 100.0, 1.0)
    assert track.time == pytest.approx([0.0, 0.25, 0.5, 0.75, 1.0])
    turned = 3.0 + (math.tau - 6.0) * np.array((0, 0.25, 0.5, 0.75, 1))
    assert track.heading == pytest.approx(turned)
    assert track.x + 2 * np.cos(turned) == pytest.approx([0, 2, 4, 6, 8])  # its front, which is 2 m before its centre
    assert track.y + 2 * np.sin(turned) == pytest.approx([0, 1, 2, 3, 4])


def test_who_comes_and_who_goes_does_not_keep_the_others_from_being_put_in_between():
    """In a town, somebody comes into sight or leaves it in nearly every step of 1 s."""
    first = frame([((0.0, 0, 0), (20.0, 0, 0))])
    second = frame([((90.0, 0, 0), (8.0, 0, 0), (24.0, 0, 0))], Roster((FAR, EGO, OTHER)))
    third = frame([((16.0, 0, 0), (50.0, 0, 0))], Roster((EGO, FAR)))
    track, others, names = ways([first, second, third], "ego", 100.0, 1.0)
    assert track.time == pytest.approx(np.arange(9) / 4)
    assert track.x == pytest.approx(2.0 * np.arange(9) - 2)
    seen = {name: sorted((others.sample[row], others.x[row]) for row in np.flatnonzero(others.who == number))
            for number, name in enumerate(names)}  # fmt: skip
    assert seen["other"] == [(sample, 15.0 + sample) for sample in range(5)]
    assert seen["far"] == [(4 + sample, 88.0 - 10 * sample) for sample in range(5)]


def test_nothing_is_put_in_between_where_the_agent_was_away():
    """As when SUMO takes it out of a jam; the scenes in which it is not are none of its own."""
    here, away = frame([((0.0, 0, 0), (20.0, 0, 0))]), frame([((20.0, 0, 0),)], Roster((OTHER,)))
    track, others, _ = ways([here, away, here, here], "ego", 100.0, 1.0)
    assert track.time == pytest.approx([0.0, 2.0, 2.25, 2.5, 2.75, 3.0])
    assert sorted(others.sample) == list(range(6))


def test_who_was_away_while_the_agent_stayed_is_not_put_in_between():
    here, away = frame([((0.0, 0, 0), (20.0, 0, 0))]), frame([((0.0, 0, 0),)])
    _, others, _ = ways([here, away, here], "ego", 100.0, 1.0)
    assert others.sample.tolist() == [0, 8]
    _, others, _ = ways([away], "ego", 100.0, 1.0)
    assert others.sample.tolist() == []


def test_parts_of_one_in_a_bend_are_put_in_between_one_by_one():
    """Where it was straight before, it is cut into as many: each grows out of the whole."""
    spine = ((20.0, 0.0, 0.0), (15.0, 0.0, 0.0), (10.0, 0.0, 0.0))
    later = tuple((x + 4, y, z) for x, y, z in spine)
    bent = frame([((0.0, 0, 0), (16.0, 0, 0)), ((0.0, 0, 0), (20.0, 0, 0)), ((0.0, 0, 0), (24.0, 0, 0))],
                 spines=({}, {1: spine}, {1: later}))  # fmt: skip
    _, others, _ = ways([bent], "ego", 100.0, 0.5)
    rows = sorted(zip(others.sample, others.x, others.half_length, strict=True))
    assert rows == [
        (0, 11.0, 5.0), (1, 11.75, 3.75), (1, 14.25, 3.75), (2, 12.5, 2.5), (2, 17.5, 2.5),
        (3, 14.5, 2.5), (3, 19.5, 2.5), (4, 16.5, 2.5), (4, 21.5, 2.5),
    ]  # fmt: skip
    short = list(sampled([bent], 0.1))
    assert [len(part.spines) for part, _ in short] == [1]


def test_of_everybody_it_is_the_centre_and_half_the_size():
    rows = [((10.0, 0.0, 0.0), (30.0, 5.0, math.pi / 2)), ((11.0, 0.0, 0.0), (30.0, 6.0, math.pi / 2))]
    track, others, names = tracks([(frame(rows), np.array([0.0, 0.3]))], "ego", 100.0)
    assert names == ["ego", "other"]
    assert (track.time.tolist(), track.x.tolist(), track.y.tolist()) == ([0.0, 0.3], [8.0, 9.0], [0.0, 0.0])
    assert (track.half_length.tolist(), track.half_width.tolist(), track.height.tolist()) == (
        [2, 2],
        [1, 1],
        [1.5, 1.5],
    )
    assert (others.sample.tolist(), others.who.tolist()) == ([0, 1], [1, 1])
    assert others.x == pytest.approx([30.0, 30.0])
    assert others.y == pytest.approx([0.0, 1.0])
    assert (others.half_length.tolist(), others.half_width.tolist()) == ([5, 5], [1.25, 1.25])
    assert tracks([(frame(rows), np.array([0.0, 0.3]))], "nobody", 100.0) is None


def test_heights_are_those_of_the_one_that_is_meant():
    rows = [((0.0, 0.0, 0.0), (20.0, 0.0, 0.0))] * 2
    heights = np.array([[1.0, 2.0, 0.0, 0.0], [3.0, 5.0, 0.0, 0.0]])
    track, others, _ = tracks([(frame(rows, heights=heights), np.array([0.0, 0.3]))], "ego", 100.0)
    assert (track.z.tolist(), others.z.tolist(), others.height.tolist()) == ([1, 3], [2, 5], [4, 4])


def test_only_who_is_near_is_there_and_numbers_of_samples_continue():
    near = frame([((0.0, 0, 0), (99.0, 0, 0), (0.0, 170.0, 0))])
    gone = frame([((5.0, 0, 0),)], Roster((OTHER,)))
    again = frame([((40.0, 0, 0), (0.0, 0, 0)), ((41.0, 0, 0), (0.0, 0, 0))], Roster((FAR, EGO)))
    parts = [(near, np.array([0.0])), (gone, np.array([0.3])), (again, np.array([0.6, 0.9]))]
    track, others, names = tracks(parts, "ego", 100.0)
    assert track.time.tolist() == [0.0, 0.6, 0.9]
    assert [(sample, names[who]) for sample, who in zip(others.sample, others.who, strict=True)] == [
        (0, "other"), (1, "far"), (2, "far"),
    ]  # fmt: skip
    # Within 100 m, whatever part of it that is: the length of both counts.
    for x, there in ((113.9, True), (114.1, False)):
        _, others, _ = tracks([(frame([((0.0, 0, 0), (x, 0, 0))]), np.array([0.0]))], "ego", 100.0)
        assert bool(len(others.sample)) == there, x


def test_each_part_of_a_bent_one_counts_and_of_the_agent_the_first():
    spine = ((0.0, 0.0, 0.0), (-5.0, 0.0, 0.0), (-10.0, -2.0, 0.0))
    bent = frame([((0.0, 0, 0), (30.0, 0, 0))], spines=({0: spine, 1: tuple((x + 30, y, z) for x, y, z in spine)},))
    track, others, _ = tracks([(bent, np.array([0.0]))], "ego", 100.0)
    assert len(track.time) == 1
    assert track.half_length[0] <= 5.0
    assert len(others.sample) >= 2
    assert set(others.sample.tolist()) == {0}
    assert set(others.half_width.tolist()) == {1.25}
    assert track.half_width.tolist() == [1.0]
    near = tracks([(bent, np.array([0.0]))], "ego", 1.0)[1]
    assert len(near.sample) < len(others.sample)
