"""How agents that think in speeds and lanes say so in discrete meta-actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gymnasium import Space

__all__ = ["meta_actions", "wanted_meta_action"]

_ALL = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
_FASTER, _SLOWER = 0.5, -0.75  # m/s²


def meta_actions(space: Space[Any] | None) -> Mapping[str, int] | None:
    """Return the numbers of the meta-actions; None where actions are (target speed, lane change).

    What a space does not have, such as a lane change where only the speed is controlled, is IDLE.

    Args:
        space: of the vehicle; the meanings of its numbers are its ``meanings``, or those of highway-env where there
            are five.

    Raises:
        ValueError: its actions are neither.
    """
    count = getattr(space, "n", None)
    if count is None:
        if space is not None and not hasattr(space, "spaces"):
            raise ValueError(f"drives by (target speed, lane change) or meta-actions, not by {space}")
        return None
    meanings = getattr(space, "meanings", _ALL if count == len(_ALL) else ())
    numbers = {name: number for number, name in enumerate(meanings)}
    if "IDLE" not in numbers:
        raise ValueError(f"drives by (target speed, lane change) or meta-actions, not by {space}")
    return {name: numbers.get(name, numbers["IDLE"]) for name in _ALL}


def wanted_meta_action(acceleration: float, change: int = 0) -> str:
    """Return the name of the meta-action nearest to an acceleration, in m/s², and a lane change (1 is to the left)."""
    if change:
        return "LANE_LEFT" if change > 0 else "LANE_RIGHT"
    return "FASTER" if acceleration > _FASTER else "SLOWER" if acceleration < _SLOWER else "IDLE"
