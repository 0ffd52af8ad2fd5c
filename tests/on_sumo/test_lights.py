"""Lights and routes that a replay reads for the picture of a crash: TraCI's own answers in a foreign town."""

from __future__ import annotations

from pathlib import Path

import pytest

libsumo = pytest.importorskip("libsumo")
sumolib = pytest.importorskip("sumolib")


NET = Path(__file__).parent / "nets" / "grid-lights.net.xml.gz"
SCENARIO = """schema = 1
simulator = "sumo"
step_length_s = 0.5
[sumo]
net = "grid-lights.net.xml.gz"
routes = ["r.rou.xml"]
[agents.ego]
route = "ego"
"""
COLOURS = {"G": "g", "g": "g", "y": "y", "r": "r"}
EDGES = ("A0A1", "A0A1.80.00", "A1B1", "A1B1.80.00", "B1C1", "B1C1.80.00", "C1C2")
STEPS = 120


def simulator_in(sumo_runs):
    net = sumolib.net.readNet(str(NET))
    edges = [one for one in EDGES if net.hasEdge(one)]
    others = "".join(
        f'<vehicle id="v{number}" depart="{2 * number}" departLane="best">'
        f'<route edges="{" ".join(edges[1:])}"/></vehicle>'
        for number in range(8)
    )
    routes = f'<routes><route id="ego" edges="{" ".join(edges)}"/>{others}</routes>'
    return sumo_runs.open(sumo_runs.write(NET, routes, {"scenario.toml": SCENARIO})), net


def drive(sumo_runs, look):
    """Drive ahead; return the last scene, after a look at each step."""
    simulator, net = simulator_in(sumo_runs)
    simulator.reset(seed=1)
    for _ in range(STEPS):
        if not simulator.agents:
            break
        look(simulator, net)
        simulator.step({"ego": simulator.actions["ego"].encode((10.0, 0))})
    return simulator.scene().data.tolist()


def test_lights_are_those_of_the_simulator_and_reading_them_changes_nothing(sumo_runs):
    seen, lit = set(), set()

    def look(simulator, net):
        found = simulator.lights()
        expected = {}
        for light in libsumo.trafficlight.getIDList():
            state = libsumo.trafficlight.getRedYellowGreenState(light)
            for place, links in enumerate(libsumo.trafficlight.getControlledLinks(light)):
                for lane, *_ in links:
                    if not lane.startswith(":"):
                        expected.setdefault(lane, set()).add(COLOURS[state[place]])
        assert {lane: set(colours) for lane, colours in found.signals.items()} == expected
        seen.update("".join(found.signals.values()))
        for vehicle, (brake, indicator) in found.vehicles.items():
            signals = libsumo.vehicle.getSignals(vehicle)
            assert (brake, indicator) == (bool(signals & 8), bool(signals & 2) - bool(signals & 1))
            lit.add((brake, indicator))
        x, y = libsumo.vehicle.getPosition("ego")
        route = found.routes["ego"]
        assert ((route[0][0] - x) ** 2 + (route[0][1] - y) ** 2) ** 0.5 < 10.0
        ahead = libsumo.vehicle.getRoute("ego")[libsumo.vehicle.getRouteIndex("ego") :]
        shapes = [net.getEdge(one).getShape() for one in ahead]
        for point in route:  # on one of these roads, or on the junction at its end
            assert min(sumolib.geomhelper.distancePointToPolygon(point, shape) for shape in shapes) < 20.0
        if nearest := libsumo.vehicle.getNextTLS("ego"):
            (signal, *_) = found.parts["ego"]["signals"]
            assert signal["distance"] == pytest.approx(nearest[0][2], abs=0.1)
            assert "gyr"[int(signal["state"])] == COLOURS[nearest[0][3]]

    assert drive(sumo_runs, look) == drive(sumo_runs, lambda *_: None)
    assert seen == {"g", "y", "r"}
    assert len(lit) > 2
