"""How dangerous a trial was, as one number."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crashhunt.world._closest import ClosestApproach

__all__ = ["danger_of"]

_HORIZON_S = 10.0


def danger_of(closest: ClosestApproach) -> float:
    """Return how near to a crash a trial came, from 0 (nothing near) to 1 (touched)."""
    # For now of the closest approach, which ranks poorly where others drive in bends; paths that were really driven
    # are to take its place.
    if closest.gap_m <= 0.0:
        return 1.0
    return max(0.0, 1.0 - max(closest.time_to_collision_s, 0.001) / _HORIZON_S)
