"""Vehicles that SUMO drives at the same time, each alone on a road of its own, with commanded accelerations."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Self

import libsumo
import numpy as np
from libsumo import _libsumo as sumo  # without the Python wrappers of the getters, which double their cost

if TYPE_CHECKING:
    from types import TracebackType

    from numpy.typing import NDArray

    Values = NDArray[np.float64]

_TYPE = "car"
_BETWEEN_ROADS_M, _ROAD_M = 20.0, 20_000.0
_MAX_SPEED_MPS, _MAX_RATE_MPS2 = 100.0, 50.0
_DRIVES_AS_COMMANDED = 0  # speed mode: no checks
_STAYS_IN_LANE = 0  # lane change mode


class Fleet:
    """Vehicles in SUMO, each alone on a straight road.

    Use a fleet as a context, and only one at a time, because libsumo has one simulation. The vehicles begin with their
    ``speeds``, in m/s.
    """

    def __init__(self, speeds: Values, *, length_m: float, step_s: float) -> None:
        self._step_s = step_s
        self._names = [str(number) for number in range(len(speeds))]
        with tempfile.TemporaryDirectory(prefix="crashhunt-fleet-") as folder:
            net = Path(folder) / "road.net.xml"
            net.write_text(_network(len(speeds)), encoding="utf-8")
            options = [
                *("--net-file", str(net), "--step-length", str(step_s), "--threads", "1", "--seed", "1"),
                *("--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true"),
                *("--collision.action", "none", "--time-to-teleport", "-1"),
            ]
            if libsumo.isLoaded():
                libsumo.load(options)
            else:
                libsumo.start(["sumo", *options])
        libsumo.vehicletype.copy("DEFAULT_VEHTYPE", _TYPE)
        for set_value, value in (
            (libsumo.vehicletype.setLength, length_m),
            (libsumo.vehicletype.setMaxSpeed, _MAX_SPEED_MPS),
            (libsumo.vehicletype.setAccel, _MAX_RATE_MPS2),
            (libsumo.vehicletype.setDecel, _MAX_RATE_MPS2),
            (libsumo.vehicletype.setEmergencyDecel, _MAX_RATE_MPS2),
        ):
            set_value(_TYPE, value)
        for number, (name, speed) in enumerate(zip(self._names, speeds.tolist(), strict=True)):
            libsumo.route.add(name, [_road(number)])
            libsumo.vehicle.add(name, name, _TYPE, depart="now", departPos="100", departSpeed=repr(speed))
            libsumo.vehicle.setSpeedMode(name, _DRIVES_AS_COMMANDED)
            libsumo.vehicle.setLaneChangeMode(name, _STAYS_IN_LANE)
            libsumo.vehicle.setSpeed(name, speed)
        libsumo.simulationStep()
        for name, speed in zip(self._names, speeds.tolist(), strict=True):
            libsumo.vehicle.setPreviousSpeed(name, speed)
        self.speeds = self._commanded = speeds
        self._driven = self._distances()

    def __enter__(self) -> Self:
        """Return the fleet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End the simulation."""
        libsumo.close()

    def drive(self, accelerations: Values) -> Values:
        """Simulate one step with accelerations in m/s²; return the way that each vehicle has driven in it, in m."""
        wanted = np.maximum(self.speeds + accelerations * self._step_s, 0.0)
        for place in np.flatnonzero(wanted != self._commanded).tolist():  # SUMO keeps the last command
            sumo.vehicle_setSpeed(self._names[place], float(wanted[place]))
        self._commanded = wanted
        libsumo.simulationStep()
        self.speeds = np.array([sumo.vehicle_getSpeed(name) for name in self._names])
        before, self._driven = self._driven, self._distances()
        moved: Values = self._driven - before
        return moved

    def _distances(self) -> Values:
        return np.array([sumo.vehicle_getDistance(name) for name in self._names])


def _network(count: int) -> str:
    """Return a network with some straight roads of one lane each, which do not meet."""
    parts = []
    for number in range(count):
        name, y = _road(number), number * _BETWEEN_ROADS_M
        parts.append(
            f'<edge id="{name}" from="{name}.a" to="{name}.b" priority="1"><lane id="{name}_0" index="0" '
            f'speed="{_MAX_SPEED_MPS}" length="{_ROAD_M}" shape="0,{y} {_ROAD_M},{y}"/></edge>'
        )
        for end, x, lanes in (("a", 0.0, ""), ("b", _ROAD_M, f"{name}_0")):
            parts.append(
                f'<junction id="{name}.{end}" type="dead_end" x="{x}" y="{y}" incLanes="{lanes}" intLanes="" '
                f'shape="{x},{y - 1} {x},{y + 1}"/>'
            )
    bounds = f"0,0,{_ROAD_M},{count * _BETWEEN_ROADS_M}"
    edges, junctions = parts[::3], [part for place, part in enumerate(parts) if place % 3]
    return (
        f'<net version="1.20"><location netOffset="0,0" convBoundary="{bounds}" origBoundary="{bounds}" '
        f'projParameter="!"/>{"".join(edges + junctions)}</net>'
    )


def _road(number: int) -> str:
    return f"road{number}"
