"""Scenes and their columns."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import scene

from crashhunt.world import PERSON, Actor, Contact, Roster, Scene, is_person, joined_frame

SIZES = {"bus": (12.0, 2.5)}
SPINE = ((3.0, 4.0, 1.0), (-3.0, 4.0, 1.0), (-9.0, 4.0, 1.0))


def two(**more):
    return scene(("ego", 1, 2, 0.5, 10), ("bus", 3, 4, -1.5, 20), sizes=SIZES, **more)


def test_a_roster_knows_places_and_sizes():
    roster = two().roster
    assert roster.index == {"ego": 0, "bus": 1}
    assert len(roster) == 2
    assert roster.half_sizes.tolist() == [[2.5, 1.0], [6.0, 1.25]]
    assert roster.reaches == [math.hypot(5, 1), math.hypot(12, 1.25)]
    assert roster.touch_distance == 2 * math.hypot(12, 1.25)
    empty = Roster(())
    assert empty.touch_distance == 0
    assert empty.half_sizes.shape == (0, 2)


def test_data_has_a_row_for_each_actor():
    assert two().data.tolist() == [[1, 2, 0.5, 10], [3, 4, -1.5, 20]]
    centers = two().centers
    assert centers[0] == pytest.approx((1 - 2.5 * math.cos(0.5), 2 - 2.5 * math.sin(0.5)))
    assert centers[1] == pytest.approx((3 - 6 * math.cos(1.5), 4 + 6 * math.sin(1.5)))


def test_a_frame_gives_the_scene_back():
    whole = two(heights=(5.0, 1.0), grades=(0.1, -0.2), spines={1: SPINE}, time_s=7.0)
    frame = whole.frame
    assert frame.columns.tolist() == [[1, 2, 3, 4, 0.5, -1.5, 10, 20]]
    assert frame.heights.tolist() == [[5, 1, 0.1, -0.2]]
    again = frame.scene(0)
    assert (again.points, again.headings, again.speeds) == ([(1, 2), (3, 4)], [0.5, -1.5], [10, 20])
    assert (again.heights, again.grades, again.spines) == ([5, 1], [0.1, -0.2], {1: SPINE})
    assert again.roster is whole.roster
    flat = two().frame
    assert (flat.heights, flat.spines) == (None, None)
    assert (flat.scene(0).heights, flat.scene(0).grades, flat.scene(0).spines) == ([], [], {})


def test_scenes_of_one_roster_are_joined():
    high, bent, flat = two(heights=(5.0, 1.0), grades=(0.1, -0.2)), two(spines={1: SPINE}), two()
    roster = flat.roster
    columns = np.arange(24.0).reshape(3, 8)
    frame = joined_frame(roster, columns, [high, None, flat])
    assert frame.heights.tolist() == [[5, 1, 0.1, -0.2], [0, 0, 0, 0], [0, 0, 0, 0]]
    assert frame.spines is None
    frame = joined_frame(roster, columns, [None, bent, flat])
    assert frame.heights is None
    assert frame.spines == ({}, {1: SPINE}, {})
    assert frame.scene(1).spines == {1: SPINE}
    assert frame.scene(1).points == [(8, 9), (10, 11)]
    assert frame.scene(2).speeds == [22, 23]
    assert joined_frame(roster, columns, [None, None, None])[2:] == (None, None, None)  # no core either


def test_neighbors_are_found_once_and_are_all_the_others():
    view = scene(("a", 0, 0, 0, 1), ("b", 3, 4, 0, 1), ("c", -1, 0, 0, 1))
    assert view.neighbors(0) == [(1.0, 2), (25.0, 1)]
    assert view.neighbors(1) == [(25.0, 0), (32.0, 2)]
    assert view.neighbors(1) is view.neighbors(1)
    assert view.neighbors(2) == [(1.0, 0), (32.0, 1)]


def test_who_is_a_person_is_in_the_id():
    assert is_person(f"{PERSON}0")
    assert not is_person("person")
    assert not is_person("0 person ")
    assert Scene(0.0, Roster((Actor("a", "x", 1, 1),)), [(0, 0)], [0], [0]).swept is False


def test_what_a_scene_is_given_it_has():
    contact = Contact("a", "b", "kind", "lane", 1.0, 2.0)
    view = Scene(3.5, two().roster, [(1, 2), (3, 4)], [0, 0], [5, 6], (contact,), ("ego",), ("l", "m"), swept=True)
    assert (view.time_s, view.contacts, view.off_road, view.lanes, view.swept) == (
        3.5, (contact,), ("ego",), ("l", "m"), True,
    )  # fmt: skip
    assert (view.events, view.agent_lanes, view.previous) == ((), {}, None)
    assert view.frame.scene(0).time_s == 0
    assert Actor("a", "x", 1.0, 2.0).height == 0


def test_a_scene_keeps_the_one_before_it_alive_and_none_before_that():
    first, second, third = two(), two(), two()
    first.follow(None)
    second.follow(first)
    assert second.previous is first
    third.follow(second)
    third.follow(third)
    assert third.previous is second
    assert second.previous is None
    third.follow(None)
    assert third.previous is None
