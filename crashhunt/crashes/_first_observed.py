"""From when on an agent observed the other actor of a collision: found in the recorded observations."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.recording import Recording
    from crashhunt.world import Scene

_TOLERANCE_M = 0.02  # of single precision, some hundred metres away
_REQUIRED_COLUMNS = ("presence", "x", "y")
_ACTORS_PART = "actors"


def visible_from(recording: Recording, agent: str, other: str) -> int | None:
    """Return the first step after which an agent's observation contained an actor; None if never or unknown.

    The step is known if the observation is a table with one row per actor and positions as in `Kinematics`: x ahead and
    y to the right, in m. The step is also known if the observation has the part ``actors``, with positions on the map.
    If a row matches no actor, for example because of noise or delays, the step is unknown.
    """
    channel = next((one for one in recording.prologue.agents if one.id == agent), None)
    if channel is None:
        return None
    on_map = next((part for part in channel.observation_parts if part.name == _ACTORS_PART), None)
    names = list(channel.observation_names) if on_map is None else ["presence", *on_map.columns[1:]]
    if not all(name in names for name in _REQUIRED_COLUMNS):
        return None
    columns = [names.index(name) for name in _REQUIRED_COLUMNS]
    before: Scene | None = None
    first = None
    for step in recording.all_steps:
        shown = step.observations.get(agent)
        if shown is not None and on_map is not None:
            shown = channel.part(_ACTORS_PART, shown)
            shown = shown[-1] if shown is not None and shown.ndim > 2 else shown  # of a history, the present
        if shown is not None and shown.ndim == 2 and before is not None and agent in before.roster.index:
            seen = _actors_in_observation(shown[:, columns].astype(float), before, agent, on_map=on_map is not None)
            if seen is None:
                return None
            if first is None and other in seen:
                first = step.step - 1
        before = step.scene
    return first


def _actors_in_observation(rows: NDArray[Any], scene: Scene, agent: str, *, on_map: bool) -> set[str] | None:
    """Return the actors in the rows of an observation; None if a row matches no actor.

    Args:
        rows: presence, x and y of each row. With `Kinematics`, row 0 is the agent itself.
        scene: scene that the observation shows.
        agent: identifier of the agent.
        on_map: whether positions are those on the map, and not relative to the agent.
    """
    row = scene.roster.index[agent]
    places = scene.centers.copy()
    if not on_map:
        offset, rows = places - places[row], rows[1:]
        c, s = math.cos(scene.headings[row]), math.sin(scene.headings[row])
        places = np.stack((offset[:, 0] * c + offset[:, 1] * s, offset[:, 0] * s - offset[:, 1] * c), axis=1)
    places[row] = math.inf  # it does not see itself
    found = set()
    for _, x, y in rows[rows[:, 0] > 0]:
        away = np.hypot(*(places - (x, y)).T)
        nearest = int(np.argmin(away))
        if not away[nearest] <= _TOLERANCE_M:
            return None
        found.add(scene.roster.actors[nearest].id)
    return found
