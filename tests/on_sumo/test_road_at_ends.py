"""What an agent sees of the road at the end of its route, off the road, on one lane and with few rows."""

from __future__ import annotations

import numpy as np
import pytest

libsumo = pytest.importorskip("libsumo")

from crashhunt.scenario import argument_values  # noqa: E402

PARTS = ("lanes", "route", "route_state", "signals", "right_of_way", "stop_line", "speed_limit")


@pytest.fixture
def start(sumo_runs):
    def begin(name, parts=PARTS, only=None):
        simulator = sumo_runs.open(name, observation=parts)
        shown, _ = simulator.reset(seed=2, options={"arguments": argument_values(simulator._scenario), "only": only})
        return simulator, shown

    return begin


def parts_of(simulator, shown):
    found = simulator.restore_observation("ego", shown["ego"])
    assert all(np.isfinite(array).all() for array in found.values())
    return found


def test_the_route_ends_where_the_last_edge_ends_and_shows_nothing_behind(start):
    simulator, shown = start("intersection", only=())
    left = []
    while simulator.agents:
        found = parts_of(simulator, shown)
        left.append(found["route_state"][0])
        present = found["route"][:, 0].astype(bool)
        x, y = found["route"][present][-1, 1:3]
        if left[-1] < 90.0:
            assert np.hypot(x - found["route_state"][3], y - found["route_state"][4]) <= 2.0
            assert not present[int(left[-1] / 2.0) + 6 :].any()
            assert not found["right_of_way"].any()
            assert not found["stop_line"].any()
        shown, *_ = simulator.step({"ego": simulator.actions["ego"].encode((20.0, 0))})
    assert left[-1] < 3.0
    assert np.all(np.diff(left) <= 1e-9)


def test_a_vehicle_off_every_lane_sees_its_last_lane_and_nothing_fails(start):
    simulator, shown = start("intersection")
    before = parts_of(simulator, shown)
    libsumo.vehicle.moveToXY("ego", "", -1, -120.0, -40.0, 90.0, 2)
    for _ in range(3):
        shown, *_ = simulator.step({"ego": simulator.actions["ego"].encode((5.0, 0))})
        found = parts_of(simulator, shown)
    assert found["lanes"][0, :, 0].any()
    assert found["speed_limit"] == before["speed_limit"]


def test_shapes_follow_the_settings_down_to_one_row(start):
    words = ("lanes:lanes=1:points=2:spacing=7.5:behind=0", "route:points=2:spacing=0.1", "right_of_way:rows=1")
    simulator, shown = start("merge", words)
    found = parts_of(simulator, shown)
    assert {name: array.shape for name, array in found.items()} == {
        "lanes": (1, 2, 6), "route": (2, 6), "right_of_way": (1, 8),
    }  # fmt: skip
    (one, two), (first, second) = found["lanes"][0, :, 1:3], found["route"][:, 1:3]
    assert np.hypot(*(two - one)) == pytest.approx(7.5, abs=0.05)
    assert np.hypot(*(second - first)) == pytest.approx(0.1, abs=0.01)
