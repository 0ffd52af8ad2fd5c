"""How near to a crash a trial came."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base.plain import finite
from crashhunt.base.tolerance import known_values

if TYPE_CHECKING:
    from crashhunt.base.plain import Plain

__all__ = ["ClosestApproach", "ClosestData"]


class ClosestData(TypedDict, total=False):
    """The plain data of a `ClosestApproach`; an earlier version may have written less."""

    time_to_collision_s: float | None
    gap_m: float | None
    required_deceleration: float | None


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

    def to_json(self) -> ClosestData:
        """Return plain numbers; JSON has no infinity, so an approach that never happened is null."""
        return {
            "time_to_collision_s": finite(self.time_to_collision_s),
            "gap_m": finite(self.gap_m),
            "required_deceleration": finite(self.required_deceleration),
        }

    @classmethod
    def from_json(cls, data: Plain) -> ClosestApproach:
        """Rebuild what `to_json` returned; what a later version has added is left out."""
        return cls(**known_values(cls, data, null=math.inf))
