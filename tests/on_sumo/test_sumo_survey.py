"""What follows from simulated plain traffic: candidates, warnings, refusals."""

from __future__ import annotations

import shutil

import pytest

from crashhunt.base.errors import NoValidTrialError, ScenarioError
from crashhunt.scenario import load_scenario, shipped_folder
from crashhunt.sumo._ego_choice import _departure_of, _departures, refine

TRIPS = "".join(f'<trip id="t{at}" depart="{at}" from="south" to="east"/>' for at in range(0, 1000, 50))


@pytest.fixture
def town(tmp_path):
    """Returns the scenario of a configuration with a demand, as its files describe it."""

    def load(demand=TRIPS, ego="any", **times):
        shutil.copy(shipped_folder() / "loop" / "loop.net.xml", tmp_path / "net.net.xml")
        (tmp_path / "r.rou.xml").write_text(f"<routes>{demand}</routes>")
        path = tmp_path / "town.sumocfg"
        options = "".join(f'<{name.replace("_", "-")} value="{value}"/>' for name, value in times.items())
        path.write_text(f'<configuration><n v="net.net.xml"/><r v="r.rou.xml"/>{options}</configuration>')
        return load_scenario(path, ego=ego)

    return load


def run(entries, **more):
    """One run of the plain traffic: entries are vehicle and time, and where it is no car its class."""
    said = [(vehicle, time_s, *(rest or ("passenger",)), False)[:4] for vehicle, time_s, *rest in entries]
    return {"begin_s": 0.0, "end_s": 700.0, "steps": 700, "entries": said, "gridlock": None, "cut_short": False, **more}


def candidates(scenario):
    argument = scenario.arguments["vehicle"]
    return argument.range.split("|") if argument.range else [argument.default]


def test_candidates_are_the_vehicles_that_enter_in_every_run(town):
    first = run([("t0", 1.0), ("t200", 201.0), ("t250", 260.0), ("t300", 301.0), ("t400", 401.0)])
    second = run([("t0", 1.0), ("t250", 270.0), ("t200", 203.0), ("t400", 402.0), ("late", 700.0)])
    scenario = refine(town(), [first, second])
    assert candidates(scenario) == ["t200", "t250", "t400"]
    assert scenario.agents["ego"].depart_s == 402.0  # the latest of both runs
    assert scenario.notes[1:] == town().notes[1:]
    assert scenario.notes[0] == "each trial replaces one random vehicle (3 candidates, entering at 203-402 s)"
    assert refine(town(ego=""), [first]).notes[0].startswith("no --ego given: each trial replaces")


@pytest.mark.parametrize("vehicle_class", ["rail_urban", "tram", "ship", "bicycle", "scooter", "aircraft"])
def test_vehicles_that_an_agent_cannot_drive_are_no_candidates(town, vehicle_class):
    cars = [(f"t{at}", float(at)) for at in range(200, 400, 50)]
    scenario = refine(town(), [run([*cars, ("odd", 250.0, vehicle_class), ("taxi", 300.0, "taxi")])])
    assert candidates(scenario) == ["t250", "t300", "taxi", "t350"]


def test_parked_vehicles_are_no_candidates(town):
    parked = run([(f"t{at}", float(at)) for at in range(200, 400, 50)])
    parked["entries"].append(("parked", 210.0, "passenger", True))
    assert "parked" not in candidates(refine(town(), [parked]))


@pytest.mark.parametrize(
    ("classes", "says"),
    [
        (("rail", "tram"), "only rail vehicles enter in 700 s of simulation (vehicle classes: rail, tram)"),
        (("bicycle", "rail"), "no vehicle that an agent can drive enters"),
    ],
)
def test_traffic_without_road_vehicles_is_refused(town, classes, says):
    with pytest.raises(ScenarioError) as caught:
        refine(town(), [run([(name, 1.0, name) for name in classes])])
    assert says in caught.value.message
    assert "--ego VEHICLE" in caught.value.fix
    assert caught.value.exit_code == 2
    assert caught.value.where.endswith("town.sumocfg")


def test_traffic_that_never_enters_leaves_no_valid_trial(town):
    with pytest.raises(NoValidTrialError, match=r"no vehicle enters in 700 s of simulation \(700 steps from 0 s\)"):
        refine(town(), [run([], end_s=9.0, steps=9), run([])])
    assert NoValidTrialError.exit_code == 3
    parked = run([])
    parked["entries"] = [("x", 1.0, "passenger", True)]
    with pytest.raises(ScenarioError, match="only parked vehicles enter"):
        refine(town(), [parked])


@pytest.mark.parametrize("entries", [[], [("train", 5.0, "rail")]])
def test_a_run_that_was_cut_short_refuses_nothing(town, entries):
    scenario = town(end=900)  # of which a note says that it is not heeded
    assert len(scenario.notes) > 1
    found = refine(scenario, [run(entries, cut_short=True, steps=500_000), run(entries, steps=700)])
    assert found.arguments == scenario.arguments
    assert "no vehicle that an agent can drive enters before step 500000" in found.notes[1]
    assert (found.notes[0], *found.notes[2:]) == scenario.notes


def test_a_demand_of_0_at_one_end_is_no_reason_to_refuse(town):
    assert candidates(refine(town(), [run([]), run([("a", 1.0), ("b", 2.0), ("c", 3.0)])])) == ["a", "b", "c"]


def test_of_gridlocked_traffic_those_are_candidates_that_enter_before(town):
    jam = {"since_s": 150.0, "standing": 60, "vehicles": 62}
    entries = [(f"v{at}", float(at)) for at in range(0, 300, 10)]
    scenario = refine(town(), [run(entries, gridlock=jam), run(entries)])
    later = {"since_s": 250.0, "standing": 70, "vehicles": 70}
    assert refine(town(), [run(entries, gridlock=later), run(entries, gridlock=jam)]).arguments == scenario.arguments
    (note,) = [note for note in scenario.notes if note.startswith("warning")]
    assert "gridlocked from 150 s on: 60 of 62 vehicles stand still, in 1 of 2 runs" in note
    assert candidates(scenario)[0] == "v30"
    assert candidates(scenario)[-1] == "v80"  # while the gridlock builds up, entering is a matter of luck
    soon = {"since_s": 70.0, "standing": 7, "vehicles": 7}
    assert candidates(refine(town(), [run(entries, gridlock=soon)])) == ["v20", "v30", "v40", "v50", "v60"]
    at_once = {"since_s": 0.0, "standing": 7, "vehicles": 7}
    assert len(candidates(refine(town(), [run(entries, gridlock=at_once)]))) > 3


def test_a_route_without_vehicles_is_driven_as_before(town):
    scenario = town('<route id="way" edges="south east"/>')
    assert refine(scenario, [run([])]) == scenario
    # Vehicles that the files do not name, such as cars of persons, are candidates too.
    found = refine(scenario, [run([("p_0", 201.0), ("q_0", 202.0), ("r_0", 203.0)])])
    assert candidates(found) == ["p_0", "q_0", "r_0"]
    assert found.agents["ego"].route == ""


def test_the_only_vehicle_of_the_files_stays_the_controlled_one_if_it_enters(town):
    scenario = town('<trip id="t" depart="5" from="south" to="east"/>')
    assert refine(scenario, [run([("t", 6.0), ("other", 7.0)])]).agents == scenario.agents
    assert list(refine(scenario, [run([("x", 6.0), ("y", 7.0)])]).agents) == ["ego"]


@pytest.mark.parametrize(
    ("rate", "interval_s"),
    [
        ('vehsPerHour="360"', 10.0), ('perHour="720"', 5.0), ('probability="0.25"', 4.0), ('number="4"', 15.0),
        ('period="7"', 7.0), ('period="exp(0.125)"', 8.0),
    ],
)  # fmt: skip
def test_vehicles_of_a_flow_depart_as_often_as_it_is_written(tmp_path, rate, interval_s):
    file = tmp_path / "r.rou.xml"
    file.write_text(f'<routes><flow id="a.b" begin="20" end="80" {rate}/><vehicle id="alone" depart="5"/></routes>')
    found = {found.vehicle: found.depart_s for found in _departures([file])}
    assert found.pop("alone") == 5
    assert found == pytest.approx({f"a.b.{place}": 20 + place * interval_s for place in range(int(60 / interval_s))})
    assert _departure_of("a.b.2", [file]) == pytest.approx(20 + 2 * interval_s)
    assert _departure_of("alone", [file]) == 5
    assert _departure_of("a.b", [file]) == _departure_of("gone.1", [file]) == 0.0
