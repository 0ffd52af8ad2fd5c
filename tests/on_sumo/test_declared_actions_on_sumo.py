"""Tests of the forms of actions on SUMO against closed forms, and against SUMO's own driver."""

from __future__ import annotations

import re
from pathlib import Path

import libsumo
import pytest

import crashhunt.guide
from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.episode import overruled_agent
from crashhunt.scenario import ACTIONS, load_scenario, with_action
from crashhunt.trial import Overruled


@pytest.fixture
def start(sumo_runs):
    """Return a function that begins an episode in a form of actions, and returns a function that takes a step."""

    def begin(form, scenario="loop", seed=3, **values):
        few = {"vehicles": 12} if scenario == "loop" else {}
        simulator, _ = sumo_runs.begin(with_action(load_scenario(scenario), "ego", form), seed, few | values)

        def step(action):
            simulator.step({"ego": simulator.actions["ego"].encode(action)})
            return simulator

        step.simulator = simulator
        return step

    return begin


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


@pytest.mark.parametrize("form", ["speed_and_lane", "acceleration"])
def test_lane_change_with_a_duration_is_a_drift_over_this_time(start, form):
    step = start(f"{form}:lane_change_duration_s=4", "motorway")
    for vehicle in {*libsumo.vehicle.getIDList()} - {"ego"}:
        libsumo.vehicle.remove(vehicle)
    libsumo.vehicle.moveTo("ego", f"{libsumo.vehicle.getRoadID('ego')}_0", 100.0)
    value = {"speed_and_lane": libsumo.vehicle.getSpeed("ego"), "acceleration": 0.0}[form]
    y = libsumo.vehicle.getPosition("ego")[1]
    for number in range(1, 60):
        simulator = step((value, 1 if number in (1, 7, 20) else 0))  # the lane change under way ignores the others
        assert libsumo.vehicle.getPosition("ego")[1] == pytest.approx(y + min(number, 40) * 0.1, abs=1e-6)
        if number != 20:  # the middle is on the line, up to rounding
            assert libsumo.vehicle.getLaneIndex("ego") == (number > 20)
        assert simulator._driving.aside("ego")[1] == pytest.approx(-1.0 if number <= 40 else 0.0, abs=1e-9)
    step((value, -1))
    for _ in range(39):
        step((value, 0))
    assert libsumo.vehicle.getPosition("ego")[1] == pytest.approx(y, abs=1e-6)
    assert simulator.agents == ["ego"]
    assert step((value, -1)).scene().off_road == ("ego",)


def test_lane_change_that_a_junction_interrupts_ends_in_the_middle_of_a_lane(start):
    step = start("speed_and_lane:lane_change_duration_s=20", "intersection")
    for vehicle in {*libsumo.vehicle.getIDList()} - {"ego"}:
        libsumo.vehicle.remove(vehicle)
    lane = libsumo.vehicle.getLaneIndex("ego")
    change, asides = 1 if lane == 0 else -1, []
    libsumo.vehicle.moveTo("ego", libsumo.vehicle.getLaneID("ego"), 150.0)
    while (edge := libsumo.vehicle.getRoadID("ego")) != libsumo.vehicle.getRoute("ego")[-1] or len(asides) < 150:
        asides.append(step((13.0, change if len(asides) == 20 else 0))._driving.aside("ego")[0])
        if edge.startswith(":"):
            assert asides[-1] == pytest.approx(asides[-2], abs=1e-9)
    assert max(map(abs, asides)) > 0.1
    assert asides[-1] == pytest.approx(0.0, abs=1e-9)


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


PAGE = Path(crashhunt.guide.__file__).parent / "reference" / "actions.md"
HOWS = {
    "brake": {}, "left": {"manoeuvre": "left"}, "keep_lane": {"keeps": "lane"}, "keep_speed": {"keeps": "speed"},
    "reference": {"reference": "both"},
}  # fmt: skip


def refused_on_page(how):
    """The forms for which the table of the page says that an agent cannot be overruled in this way."""
    rows = PAGE.read_text(encoding="utf-8").splitlines()
    (row,) = [row for row in rows if row.startswith("| `whatif --overrule") and re.search(rf"\b{how}\b", row)]
    cell = row.split("|")[2]
    free = {name for name, form in ACTIONS.items() if form.moves_freely and "move freely" in cell}
    return free | set(re.findall(r"`(\w+)`", cell))


class FullBraking:
    """Answers with full braking in any form."""

    def __init__(self, simulator):
        self.simulator = simulator

    def reset(self, seed):
        pass

    def act(self, observation):
        braking = self.simulator.full_braking("ego")
        return braking.choose() if braking.choose else braking.action


@pytest.mark.parametrize("form", ACTIONS)
def test_an_override_works_in_every_form_that_the_page_does_not_exclude(start, form):
    step = start(form, "intersection", priority_demand=200, minor_demand=100)
    refused = {}
    for how, chosen in HOWS.items():
        overruled = Overruled("ego", 1, **chosen)
        try:
            driver = overruled_agent(FullBraking(step.simulator), step.simulator, overruled)
        except InvalidEpisodeError as error:
            refused[how] = str(error)
            continue
        driver.reset(0)
        for _ in range(3):  # the last two are overruled
            step(driver.act(None))
    assert {how for how in HOWS if form in refused_on_page(how)} == set(refused)
    assert not [said for said in refused.values() if "ego" not in said or "\n" in said]
