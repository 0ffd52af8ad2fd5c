"""From when on an agent was shown the other one of a collision: looked up in what it was shown."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.recording import Recording
    from crashhunt.world import Scene

__all__ = ["visible_from"]

_TOLERANCE_M = 0.02  # of single precision, some hundred metres away
_COLUMNS = ("presence", "x", "y")


def visible_from(recording: Recording, agent: str, other: str) -> int | None:
    """Return the first step after which an agent was shown somebody; None where it never was, or nobody knows.

    That is known where what it is shown is a table with a row an actor, and the places in it are those of the scene:
    x ahead of it and y to its right, in m, as `Kinematics` shows them. Where a row is of nobody, as with noise or
    delays, nothing is known.

    Args:
        recording: of the episode.
        agent: who is shown something.
        other: whom.
    """
    names = next((list(one.observation_names) for one in recording.prologue.agents if one.id == agent), [])
    if not all(name in names for name in _COLUMNS):
        return None
    columns = [names.index(name) for name in _COLUMNS]
    before: Scene | None = None
    first = None
    for step in recording.all_steps:
        shown = step.observations.get(agent)
        if shown is not None and shown.ndim == 2 and before is not None and agent in before.roster.index:
            seen = _shown(shown[:, columns].astype(float), before, agent)
            if seen is None:
                return None
            if first is None and other in seen:
                first = step.step - 1
        before = step.scene
    return first


def _shown(rows: NDArray[Any], scene: Scene, agent: str) -> set[str] | None:
    """Who is in the rows of others; None where one of them is nobody's."""
    row = scene.roster.index[agent]
    offset = scene.centers - scene.centers[row]
    c, s = math.cos(scene.headings[row]), math.sin(scene.headings[row])
    places = np.stack((offset[:, 0] * c + offset[:, 1] * s, offset[:, 0] * s - offset[:, 1] * c), axis=1)
    places[row] = math.inf  # it does not see itself
    found = set()
    for _, x, y in rows[1:][rows[1:, 0] > 0]:
        away = np.hypot(*(places - (x, y)).T)
        nearest = int(np.argmin(away))
        if not away[nearest] <= _TOLERANCE_M:
            return None
        found.add(scene.roster.actors[nearest].id)
    return found
