"""SUMO's vehicles do not see the part of a freely driven vehicle that is in another lane, whatever SUMO's options."""

from __future__ import annotations

from pathlib import Path

import libsumo
import pytest

NET = Path(__file__).parents[2] / "scenarios" / "motorway" / "motorway.net.xml"
OPTIONS = ("--step-length", "0.1", "--no-step-log", "true", "--no-warnings", "true", "--collision.action", "none")


def places_of_other(lane, offset_m, speed_mps, *options):
    """Where a wide vehicle of SUMO drives in each step while ego is moved, beside the middle of lane 0.

    The other vehicle begins in the given lane: 60 m behind in lane 1, or beside ego with a lane change to lane 1.
    """
    start = libsumo.load if libsumo.isLoaded() else lambda words: libsumo.start(["sumo", *words])
    start(["-n", str(NET), *OPTIONS, *options])
    libsumo.route.add("ahead", [name for name in libsumo.edge.getIDList() if not name.startswith(":")][:1])
    libsumo.vehicletype.copy("DEFAULT_VEHTYPE", "wide")
    libsumo.vehicletype.setWidth("wide", 2.5)
    place = "40" if lane == 1 else "100"
    libsumo.vehicle.add("ego", "ahead", departLane="0", departPos="100", departSpeed="20")
    libsumo.vehicle.add("other", "ahead", "wide", departLane=str(lane), departPos=place, departSpeed="20")
    libsumo.simulationStep()
    x, y = libsumo.vehicle.getPosition("ego")
    libsumo.vehicle.setSpeed("other", 20)
    if lane != 1:
        libsumo.vehicle.changeLane("other", 1, 20)
    places = []
    for _ in range(150):
        x += speed_mps * 0.1
        libsumo.vehicle.moveToXY("ego", "", -1, x, y + offset_m, 90, 6)
        libsumo.vehicle.setSpeed("ego", speed_mps)
        libsumo.simulationStep()
        places.append(libsumo.vehicle.getPosition("other"))
    assert libsumo.vehicle.getLaneIndex("ego") == 0
    assert libsumo.vehicle.getLaneIndex("other") == 1
    return places


@pytest.mark.parametrize("options", [(), ("--lanechange.duration", "3"), ("--lateral-resolution", "0.8")])
@pytest.mark.parametrize(("lane", "speed_mps"), [(1, 15), (2, 20)], ids=["from behind", "by changing lanes"])
def test_a_vehicle_of_sumo_drives_alike_whether_ego_is_partly_in_its_lane_or_not(lane, speed_mps, options):
    # The lanes are 4 m wide and ego is 1.8 m wide: 1.95 m beside the middle, 0.85 m of it is in lane 1.
    assert places_of_other(lane, 1.95, speed_mps, *options) == places_of_other(lane, 0.0, speed_mps, *options)
