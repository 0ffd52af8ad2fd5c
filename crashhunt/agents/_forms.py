"""How agents that think in speeds and lanes say so in discrete meta-actions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.faculties import offers
from crashhunt.simulators import HasMeanings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gymnasium import Space

__all__ = ["meta_actions", "wanted_meta_action"]

_ALL = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
_FASTER, _SLOWER = 0.5, -0.75  # m/s²


def meta_actions(space: Space[object] | None) -> Mapping[str, int] | None:
    """Return the numbers of the meta-actions; None where actions are (target speed, lane change).

    What a space does not have, such as a lane change where only the speed is controlled, is IDLE.

    Args:
        space: of the vehicle; the meanings of its numbers are its ``meanings``, or those of highway-env where there
            are five.

    Raises:
        ValueError: its actions are neither.
    """
    if space is None:
        return None
    from gymnasium.spaces import Dict, Discrete, Tuple

    if isinstance(space, Tuple | Dict):
        return None
    meanings: Sequence[str] = ()
    if isinstance(space, Discrete):
        meanings = space.meanings if offers(space, HasMeanings) else _ALL if space.n == len(_ALL) else ()
    numbers = {name: number for number, name in enumerate(meanings)}
    if "IDLE" not in numbers:
        raise ValueError(f"drives by (target speed, lane change) or meta-actions, not by {space}")
    return {name: numbers.get(name, numbers["IDLE"]) for name in _ALL}


def wanted_meta_action(acceleration: float, change: int = 0) -> str:
    """Return the name of the meta-action nearest to an acceleration, in m/s², and a lane change (1 is to the left)."""
    if change:
        return "LANE_LEFT" if change > 0 else "LANE_RIGHT"
    return "FASTER" if acceleration > _FASTER else "SLOWER" if acceleration < _SLOWER else "IDLE"
