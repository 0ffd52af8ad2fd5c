"""A counter of the steps in which vehicles stand still; each simulator decides which vehicles it counts."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from crashhunt.world import LIMITS

if TYPE_CHECKING:
    from collections.abc import Mapping


class Standstill:
    """Counts the steps in which vehicles stand still, one episode after another.

    Args:
        step_length_s: Step length of the simulation, in s.
        limits: The scenario's event limits. ``not_moving`` is the longest allowed standstill in s.
    """

    SPEED: ClassVar[float] = 0.1
    """A vehicle slower than this stands still, in m/s."""

    def __init__(self, step_length_s: float, limits: Mapping[str, float]) -> None:
        self._limit_s = limits.get("not_moving", LIMITS["not_moving"][0])
        self._steps = max(1, round(self._limit_s / step_length_s))
        self._stood: dict[str, int] = {}

    def begin(self) -> None:
        """Reset the counters for a new episode."""
        self._stood.clear()

    @property
    def counted(self) -> tuple[dict[str, int], int]:
        """The number of steps that each vehicle has stood still, and the limit in steps; used by the compiled core."""
        return self._stood, self._steps

    def move(self, vehicle: str) -> None:
        """Reset the count of a vehicle that moves, or whose standstill does not count."""
        self._stood.pop(vehicle, None)

    def look(self, vehicle: str, speed: float) -> float:
        """Count a step in which a vehicle stands still; reset its count if it moves.

        Returns the limit in s in the step in which the standstill reaches the limit, and 0 in all other steps.
        """
        if abs(speed) >= self.SPEED:
            if self._stood:
                self.move(vehicle)
            return 0.0
        stood = self._stood[vehicle] = self._stood.get(vehicle, 0) + 1
        return self._limit_s if stood == self._steps else 0.0
