"""Descriptions of the state after a crash, for environments that do not report the types of their crashes.

A cell is the set of true flags and short texts of the last ``info``. Unlike the cells of Go-Explore (Ecoffet and
others, 2021), a cell does not contain the last observation. With coarse levels of the observation, guided hunts found
fewer planted faults on seven of nine problems, because one fault ended in several cells
(`scripts/studies/run search --faults`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.text import encodable

if TYPE_CHECKING:
    from collections.abc import Mapping

_MAX_TEXT_CHARACTERS, _MAX_WORDS = 20, 8  # of the info


def crash_cell(info: Mapping[str, object]) -> str:
    """Return a description of the last step, equal for similar steps.

    Args:
        info: the dictionary ``info`` of the last step. True flags and short texts are used; numbers are not.
    """
    words = []
    for key, value in info.items():
        if isinstance(value, bool | np.bool_) and value:
            words.append(str(key))
        elif isinstance(value, str) and 0 < len(value) <= _MAX_TEXT_CHARACTERS:
            words.append(f"{key}={value}")
    return encodable(" ".join(sorted(words)[:_MAX_WORDS]))
