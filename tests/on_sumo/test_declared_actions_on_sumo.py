"""Tests of the forms of actions on SUMO against closed forms, and against SUMO's own driver."""

from __future__ import annotations

import libsumo
import pytest

from crashhunt.scenario import argument_values, load_scenario, with_action
from crashhunt.sumo import SumoSimulator


@pytest.fixture
def start(tmp_path):
    """Return a function that begins an episode in a form of actions, and returns a function that takes a step."""
    made = []

    def begin(form, scenario="loop", seed=3):
        chosen = with_action(load_scenario(scenario), "ego", form)
        simulator = SumoSimulator(chosen, tmp_path)
        made.append(simulator)
        simulator.reset(seed=seed, options={"arguments": argument_values(chosen)})

        def step(action):
            simulator.step({"ego": simulator.actions["ego"].encode(action)})
            return simulator

        return step

    yield begin
    for simulator in made:
        simulator.close()


@pytest.mark.parametrize("acceleration", [-1.0, 1.0])
def test_speed_after_constant_acceleration_follows_the_closed_form(start, acceleration):
    step = start("acceleration")
    speed, step_s = libsumo.vehicle.getSpeed("ego"), libsumo.simulation.getDeltaT()
    for _ in range(12):
        step((acceleration, 0))
    assert libsumo.vehicle.getSpeed("ego") == pytest.approx(speed + 12 * acceleration * step_s, abs=1e-9)


@pytest.mark.parametrize(("asked", "limit"), [(10.0, "getAccel"), (-10.0, "getDecel")])
def test_acceleration_beyond_the_vehicle_type_is_cut_at_its_limit(start, asked, limit):
    step = start("acceleration")
    speed, most = libsumo.vehicle.getSpeed("ego"), getattr(libsumo.vehicle, limit)("ego")
    step((asked, 0))
    change = (libsumo.vehicle.getSpeed("ego") - speed) / libsumo.simulation.getDeltaT()
    assert abs(change) == pytest.approx(most, abs=1e-6)


def test_braking_ends_at_a_standstill_and_not_backwards(start):
    step = start("acceleration")
    for _ in range(80):
        step((-10.0, 0))
    assert libsumo.vehicle.getSpeed("ego") == 0.0
    assert step((-1.0, 0)).full_braking("ego").action == (-10.0, 0)


def test_lateral_speed_moves_the_vehicle_gradually_into_the_next_lane_and_off_the_road(start):
    step = start("speed_and_lateral", "motorway")
    (_, y), lane = libsumo.vehicle.getPosition("ego"), libsumo.vehicle.getLaneIndex("ego")
    lanes, steps = [], 0
    while True:
        simulator = step((20.0, 1.0))
        if not simulator.agents:
            break
        steps += 1
        lanes.append(libsumo.vehicle.getLaneIndex("ego"))
        assert libsumo.vehicle.getPosition("ego")[1] == pytest.approx(y + 0.1 * steps, abs=1e-6)
    assert simulator.scene().off_road == ("ego",)
    assert [*dict.fromkeys(lanes)] == [*range(lane, 3)]  # the lanes are 4 m wide, and the outer line ends the road
    assert abs(steps - (2 + 4 * (2 - lane)) / 0.1) <= 1


def test_vehicle_that_sumo_drives_does_as_sumo_alone_does(start):
    def course(form, action):
        step = start(form)
        if form == "speed_and_lane":  # SUMO alone: nothing is commanded
            libsumo.vehicle.setSpeedMode("ego", 31)
            libsumo.vehicle.setLaneChangeMode("ego", 0b011001010101)
            step = _silent_step
        found = []
        for _ in range(150):
            step(action)
            found.append((libsumo.vehicle.getPosition("ego"), libsumo.vehicle.getSpeed("ego")))
        return found

    assert course("sumo", None) == course("speed_and_lane", None)


def _silent_step(_action):
    libsumo.simulationStep()


def test_override_holds_for_one_step_and_sumo_drives_again_afterwards(start):
    step = start("sumo")
    for _ in range(20):
        step((5.0, 0))
    slow = libsumo.vehicle.getSpeed("ego")
    for _ in range(60):
        step(None)
    assert slow < 13.0
    assert libsumo.vehicle.getSpeed("ego") > slow + 1.0
    assert libsumo.vehicle.getSpeedMode("ego") == 31
    step((-1.0, 1))
    assert libsumo.vehicle.getLaneChangeMode("ego") == 0
    step(None)
    assert libsumo.vehicle.getLaneChangeMode("ego") == 0b011001010101
