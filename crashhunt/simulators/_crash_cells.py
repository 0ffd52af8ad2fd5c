"""Coarse descriptions of the state after a crash, for environments that do not name the types of their crashes.

A cell is the set of true flags and short texts of the last info, and the last observation at a low resolution. The idea
is that of Go-Explore (Ecoffet et al. 2021), whose cells are downscaled observations: few enough that crashes of one
fault share some, and enough that another fault has another one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.text import encodable
from crashhunt.simulators._gymnasium import OpaqueSpace

if TYPE_CHECKING:
    from collections.abc import Mapping

    import gymnasium
    from numpy.typing import NDArray

__all__ = ["coarse_cell"]

_SEGMENTS = 4  # of the observation, each with one mean: more would make nearly every crash the first of its cell
_LEVELS = 3  # of each mean: 81 cells at most
_UNBOUNDED = 3.0  # range of a number without bounds, on both sides of 0; a value beyond it has the last level
_HUGE = 1e6  # beyond it, a bound is none: some environments state the greatest float
_MAX_TEXT_CHARACTERS, _MAX_WORDS = 20, 8  # of the info


def coarse_cell(observation: NDArray[np.generic], space: gymnasium.Space[object], info: Mapping[str, object]) -> str:
    """Return a coarse description of the last step, equal for similar ones.

    Args:
        observation: the last one, any shape.
        space: space of observations. Values are relative to its bounds, if it has any.
        info: info of the last step. Flags that are true and short texts count; numbers do not.
    """
    words = []
    for key, value in info.items():
        if isinstance(value, bool | np.bool_) and value:
            words.append(str(key))
        elif isinstance(value, str) and 0 < len(value) <= _MAX_TEXT_CHARACTERS:
            words.append(f"{key}={value}")
    levels = "".join(map(str, _levels(observation, space)))
    return encodable(" ".join([*sorted(words)[:_MAX_WORDS], *([levels] if levels else [])]))


def _levels(observation: NDArray[np.generic], space: gymnasium.Space[object]) -> list[int]:
    if isinstance(space, OpaqueSpace) or observation.dtype.kind not in "biuf" or not observation.size:
        return []
    values = observation.astype(np.float64).ravel()
    low, high = np.full(values.shape, -_UNBOUNDED), np.full(values.shape, _UNBOUNDED)
    for bounds, name in ((low, "low"), (high, "high")):
        given = np.asarray(getattr(space, name, np.nan), dtype=np.float64).ravel()
        if given.shape == values.shape:
            known = np.abs(given) < _HUGE
            bounds[known] = given[known]
    width = np.where(high > low, high - low, 1.0)
    with np.errstate(invalid="ignore", over="ignore"):
        relative = (values - low) / width
    shares = np.clip(np.nan_to_num(relative, nan=0.5), 0.0, 1.0)
    means = [float(part.mean()) for part in np.array_split(shares, min(_SEGMENTS, len(shares)))]
    return [min(int(mean * _LEVELS), _LEVELS - 1) for mean in means]
