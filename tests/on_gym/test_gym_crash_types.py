"""Cells of crashes: equal for similar crashes, from the last info alone."""

from __future__ import annotations

import numpy as np

from crashhunt.gym._end_state import crash_cell


def test_true_flags_and_short_texts_of_the_info_count_and_numbers_do_not():
    info = {"side": "left", "fell": True, "hit": np.True_, "late": False, "x": 3.2, "n": 1, "log": "a" * 21, "no": ""}
    assert crash_cell(info) == "fell hit side=left"
    assert crash_cell(info | {"x": 4.0, "log": "b" * 21}) == crash_cell(info)
    assert crash_cell({f"k{n}": True for n in range(20)}).count("k") == 8
    assert crash_cell({"log": "a" * 20}) == f"log={'a' * 20}"
    assert crash_cell({}) == ""
