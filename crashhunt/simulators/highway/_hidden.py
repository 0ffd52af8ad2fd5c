"""A vehicle that an agent does not see for a while, where highway-env itself makes the observation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from highway_env.road.road import Road

__all__ = ["Hidden"]


class Hidden:
    """Takes one vehicle off the road for as long as an agent looks, from the next observation on.

    Args:
        road: of the episode.
        seeing: what makes the agent's observations, of whatever kind: all of them look at the vehicles of the road.
        vehicle: whom it does not see.
    """

    how_strong = 1.0

    def __init__(self, road: Road, seeing: Any, vehicle: Any) -> None:
        self._road = road
        self._seeing = seeing
        self._vehicle = vehicle
        self._look = seeing.observe
        seeing.observe = self._observe

    def keep(self) -> None:
        """It stays out of sight."""

    def end(self) -> None:
        """Show it again."""
        self._vehicle = None

    def _observe(self) -> Any:
        everybody = self._road.vehicles
        if self._vehicle is None:
            return self._look()
        self._road.vehicles = [vehicle for vehicle in everybody if vehicle is not self._vehicle]
        try:
            return self._look()
        finally:
            self._road.vehicles = everybody
