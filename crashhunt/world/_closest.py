"""How near to a crash a trial came."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.tolerance import known_values

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["ClosestApproach"]


@dataclass(frozen=True, slots=True)
class ClosestApproach:
    """How near to a crash a trial came, each over all steps, controlled vehicles and other actors.

    Args:
        time_to_collision_s: the least, at constant velocities; infinite where no course ever crossed.
        gap_m: the least distance to the outline of any other actor, the nearest gap; 0 where they touched.
        required_deceleration: the greatest needed to avoid a collision, in m/s².
    """

    time_to_collision_s: float = math.inf
    gap_m: float = math.inf
    required_deceleration: float = 0.0

    def to_json(self) -> dict[str, float | None]:
        """Return plain numbers; JSON has no infinity, so an approach that never happened is null."""
        values = {name: getattr(self, name) for name in self.__slots__}  # asdict takes ten times as long
        return {name: value if math.isfinite(value) else None for name, value in values.items()}

    @classmethod
    def from_json(cls, data: Mapping[str, float | None]) -> ClosestApproach:
        """Rebuild what `to_json` returned; what a later version has added is left out."""
        return cls(**{name: math.inf if value is None else value for name, value in known_values(cls, data).items()})
