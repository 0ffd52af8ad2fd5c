"""Who was where when: at which instants it is looked at, what is put in between, and who counts as near."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from crashhunt.world import Actor, Frame, Roster
from crashhunt.world._tracks import sampled, spacing_s, tracks

EGO, OTHER, FAR = Actor("ego", "car", 4.0, 2.0, 1.5), Actor("other", "truck", 10.0, 2.5, 4.0), Actor("far", "car", 4, 2)


def frame(rows, roster=None, **more):
    """Each row is ((x, y, heading), …) of the fronts."""
    places = np.array([[value for x, y, _ in row for value in (x, y)] for row in rows], float)
    headings = np.array([[heading for *_, heading in row] for row in rows], float)
    roster = roster or Roster((EGO, OTHER, FAR)[: headings.shape[1]])
    return Frame(roster, np.hstack((places, headings, np.zeros_like(headings))), **more)


def places_of(parts):
    return np.concatenate([part.columns[:, 0] for part, _ in parts])


def times_of(parts):
    return np.concatenate([times for _, times in parts])


@pytest.mark.parametrize(
    ("step_s", "spacing"), [(0.04, 0.32), (0.1, 0.3), (0.2, 0.2), (0.3, 0.3), (0.5, 0.25), (1.0, 0.25), (1.2, 0.3)]
)
def test_samples_are_some_tenths_of_a_second_apart(step_s, spacing):
    assert spacing_s(step_s) == pytest.approx(spacing)
    rows = [((float(step), 0.0, 0.0),) for step in range(40)]
    parts = list(sampled([frame(rows)], step_s))
    times = times_of(parts)
    assert np.diff(times) == pytest.approx(spacing)
    assert (times[0], times[-1]) == (0.0, pytest.approx(39 * step_s, abs=spacing))
    assert places_of(parts) == pytest.approx(times / step_s)


@pytest.mark.parametrize("step_s", [0.1, 0.5])
def test_it_does_not_matter_in_which_parts_they_come(step_s):
    whole = frame([((float(step) ** 2, -1.0, 0.1 * step),) for step in range(23)])
    heights = np.arange(46, dtype=float).reshape(23, 2)
    whole = whole._replace(heights=heights)
    cuts = [0, 1, 5, 6, 20, 23]
    parts = [whole._replace(columns=whole.columns[a:b], heights=heights[a:b]) for a, b in pairwise(cuts)]
    at_once, in_parts = list(sampled([whole], step_s)), list(sampled(parts, step_s))
    assert times_of(in_parts) == pytest.approx(times_of(at_once))
    for name in ("columns", "heights"):
        found, expected = (np.concatenate([getattr(part, name) for part, _ in each]) for each in (in_parts, at_once))
        assert found == pytest.approx(expected), name


def test_between_two_scenes_it_turns_the_short_way_round_and_goes_straight():
    ((part, times),) = sampled([frame([((0.0, 0.0, 3.0),), ((8.0, 4.0, -3.0),)])], 1.0)
    assert times == pytest.approx([0.0, 0.25, 0.5, 0.75, 1.0])
    assert part.columns[:, 0] == pytest.approx([0, 2, 4, 6, 8])
    assert part.columns[:, 1] == pytest.approx([0, 1, 2, 3, 4])
    turned = math.tau - 6.0
    assert part.columns[:, 2] == pytest.approx([3.0 + turned * share for share in (0, 0.25, 0.5, 0.75, 1)])


def test_nothing_is_put_in_between_where_others_are_there_or_vehicles_are_bent():
    first, second = frame([((0.0, 0, 0),)]), frame([((9.0, 0, 0), (50.0, 0, 0))])
    assert times_of(list(sampled([first, second, second], 1.0)))[:2] == pytest.approx([0.0, 1.0])
    bent = frame([((float(step), 0, 0),) for step in range(3)], spines=({}, {0: ((0.0, 0, 0), (-4.0, 0, 0))}, {}))
    parts = list(sampled([bent], 1.0))
    assert times_of(parts) == pytest.approx([0.0, 1.0, 2.0])
    assert [sorted(spine) for part, _ in parts for spine in part.spines] == [[], [0], []]
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


def test_heights_are_those_of_whoever_is_meant():
    rows = [((0.0, 0.0, 0.0), (20.0, 0.0, 0.0))] * 2
    heights = np.array([[1.0, 2.0, 0.0, 0.0], [3.0, 5.0, 0.0, 0.0]])
    track, others, _ = tracks([(frame(rows, heights=heights), np.array([0.0, 0.3]))], "ego", 100.0)
    assert (track.z.tolist(), others.z.tolist(), others.height.tolist()) == ([1, 3], [2, 5], [4, 4])


def test_only_who_is_near_is_there_and_numbers_of_samples_go_on():
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
