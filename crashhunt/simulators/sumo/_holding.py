"""Others on SUMO that are kept from something, to see what hangs on it: braking, changing lanes, being there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import libsumo
from libsumo import _libsumo as sumo

if TYPE_CHECKING:
    from crashhunt.simulators._protocol import Disturbing

__all__ = ["held_back"]

_HEEDING_NOBODY = 0  # speed mode: what is commanded is driven
_NOT_AT_ALL = 0  # lane change mode


def held_back(vehicle: str, what: str) -> Disturbing | None:
    """Keep a vehicle from something, from the next step on; None where it is not there.

    Args:
        vehicle: its name.
        what: one of `HELD`.
    """
    if vehicle not in sumo.vehicle_getIDList():
        return None
    if what == "gone":
        libsumo.vehicle.remove(vehicle)
        return _Gone()
    return _KeepsSpeed(vehicle) if what == "keep_speed" else _KeepsLane(vehicle)


class _Gone:
    """It is gone, and does not come back."""

    how_strong = 1.0

    def keep(self) -> None:
        """Stay away."""

    def end(self) -> None:
        """Stay away."""


class _KeepsSpeed:
    """Drives on at its speed, whoever is in its way."""

    def __init__(self, vehicle: str) -> None:
        self.how_strong = float(sumo.vehicle_getSpeed(vehicle))
        self._vehicle = vehicle
        self._before = sumo.vehicle_getSpeedMode(vehicle)
        sumo.vehicle_setSpeedMode(vehicle, _HEEDING_NOBODY)
        sumo.vehicle_setSpeed(vehicle, self.how_strong)

    def keep(self) -> None:
        """Go on; SUMO holds what has been commanded."""

    def end(self) -> None:
        """Drive by itself again."""
        if self._vehicle in sumo.vehicle_getIDList():
            sumo.vehicle_setSpeedMode(self._vehicle, self._before)
            sumo.vehicle_setSpeed(self._vehicle, -1.0)


class _KeepsLane:
    """Does not leave its lane."""

    how_strong = 1.0

    def __init__(self, vehicle: str) -> None:
        self._vehicle = vehicle
        self._before = sumo.vehicle_getLaneChangeMode(vehicle)
        sumo.vehicle_setLaneChangeMode(vehicle, _NOT_AT_ALL)

    def keep(self) -> None:
        """Go on; SUMO holds what has been commanded."""

    def end(self) -> None:
        """Change lanes by itself again."""
        if self._vehicle in sumo.vehicle_getIDList():
            sumo.vehicle_setLaneChangeMode(self._vehicle, self._before)
