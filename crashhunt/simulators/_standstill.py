"""A counter of who has stood still for how long; whose standing counts is for each simulator to say."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from crashhunt.world import LIMITS

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Standstill"]


class Standstill:
    """Counts the steps in which vehicles stand still, one episode after another.

    Args:
        step_length_s: of the simulation.
        limits: ``not_moving``: how long is too long, in s, where it is not the default.
    """

    SPEED: ClassVar[float] = 0.1
    """Whoever is slower than this stands still, in m/s."""

    def __init__(self, step_length_s: float, limits: Mapping[str, float]) -> None:
        self._limit_s = limits.get("not_moving", LIMITS["not_moving"][0])
        self._steps = max(1, round(self._limit_s / step_length_s))
        self._stood: dict[str, int] = {}

    def begin(self) -> None:
        """Forget the last episode."""
        self._stood.clear()

    @property
    def counted(self) -> tuple[dict[str, int], int]:
        """For the core: for how many steps who has stood still, and how many are too many."""
        return self._stood, self._steps

    def move(self, vehicle: str) -> None:
        """Say that a vehicle moves, or that its standing does not count."""
        self._stood.pop(vehicle, None)

    def look(self, vehicle: str, speed: float) -> float:
        """Count a step; return how long is too long, in s, in the one step in which it has become so, else 0."""
        if abs(speed) >= self.SPEED:
            if self._stood:
                self.move(vehicle)
            return 0.0
        stood = self._stood[vehicle] = self._stood.get(vehicle, 0) + 1
        return self._limit_s if stood == self._steps else 0.0
