"""Coarse cells of crashes: few, and different for states that differ much."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from gymnasium.spaces import Box

from crashhunt.simulators._crash_cells import coarse_cell

UNIT = Box(0.0, 1.0, (4,), np.float64)


def cell(values, space=UNIT, **info):
    return coarse_cell(np.array(values), space, info)


def test_a_cell_has_one_of_three_levels_for_each_of_four_numbers():
    assert cell([0.0, 0.32, 0.34, 1.0]) == "0012"
    assert cell([0.65, 0.67, -5.0, 7.0]) == "1202"
    every = {cell(values) for values in itertools.product((0.1, 0.5, 0.9), repeat=4)}
    assert len(every) == 81


def test_a_long_observation_has_four_means():
    space = Box(0.0, 1.0, (8, 2), np.float64)
    assert coarse_cell(np.repeat([0.1, 0.5, 0.9, 0.2], 4).reshape(8, 2), space, {}) == "0120"


def test_levels_are_relative_to_the_bounds_that_are_there():
    assert cell([95.0, 5.0], Box(0.0, 100.0, (2,), np.float64)) == "20"
    free = Box(np.array([-np.inf, -3.4e38, 0.0]), np.array([np.inf, 3.4e38, np.inf]), dtype=np.float64)
    assert cell([-1.1, 1.1, 1.6], free) == "021"
    assert cell([np.inf, np.nan, -np.inf], free) == "210"


def test_true_flags_and_short_texts_of_the_info_count_and_numbers_do_not():
    info = {"side": "left", "fell": True, "hit": np.True_, "late": False, "x": 3.2, "n": 1, "log": "a" * 21, "no": ""}
    assert cell([0.1] * 4, **info) == "fell hit side=left 0000"
    assert cell([0.1] * 4, **info | {"x": 4.0, "log": "b" * 21}) == cell([0.1] * 4, **info)
    assert cell([0.1] * 4, **{f"k{n}": True for n in range(20)}).count("k") == 8


@pytest.mark.parametrize("values", [[], ["a", "b"]])
def test_an_observation_without_numbers_has_a_cell_of_the_info_alone(values):
    assert coarse_cell(np.array(values), UNIT, {"fell": True}) == "fell"
