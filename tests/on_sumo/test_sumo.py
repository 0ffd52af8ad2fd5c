"""SUMO for real, through the command line: bring your own, lane changes, broken files; and the observation's layout."""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from dataclasses import replace

import libsumo
import numpy as np
import pytest

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.oracles import OffRoad
from crashhunt.recording import read_log
from crashhunt.scenario import load_scenario, shipped_folder
from crashhunt.sumo import SumoSimulator


@pytest.fixture
def town(shell):
    shutil.copy(shipped_folder() / "loop" / "loop.net.xml", shell.folder / "net.net.xml")
    (shell.folder / "r.rou.xml").write_text(
        '<routes><route id="way" edges="south east north west"/>'
        '<flow id="odd.name#1" route="way" begin="3" end="60" number="5" departSpeed="max"/></routes>'
    )
    (shell.folder / "det.add.xml").write_text(
        '<additional><inductionLoop id="d" lane="south_0" pos="50" period="10" file="detector.xml"/></additional>'
    )
    (shell.folder / "town.sumocfg").write_text(
        '<configuration><input><net-file value="net.net.xml"/><route-files value="r.rou.xml"/>'
        '<additional-files value="det.add.xml"/></input><output><tripinfo-output value="trips.xml"/></output>'
        '<time><step-length value="0.2"/></time></configuration>'
    )
    return shell


EGOS = {"odd.name#1.2": ("--ego", "odd.name#1.2"), "ego": ("--ego", "edges=-south,-north")}


@pytest.mark.parametrize(
    ("agent", "ego"),  # by day, the tests below name vehicles
    [pytest.param(agent, ego, marks=[pytest.mark.nightly] * (ego != EGOS["ego"])) for agent, ego in EGOS.items()],
    ids=["named", "added"],
)
def test_a_network_that_no_one_wrote_for_us(town, agent, ego):
    before = sorted(path.name for path in town.folder.iterdir())
    words = ("run", "h", "2", "3", "100", "--scenario", "town.sumocfg", *ego, "--arg", "speed=5:9", "--keep-going")
    done = town.crashhunt(*words, "--keep-trials", "--json")
    assert done.json["trials_run"] == 3
    assert "invalid" not in done.json["outcomes"]
    params = json.loads((town.folder / "h" / "trials" / "000000" / "params.json").read_text())
    assert list(params["spec"]["arguments"]) == [agent]
    # What SUMO writes beside its input files must not end up beside the user's.
    assert sorted(path.name for path in town.folder.iterdir() if path.name != "__pycache__") == sorted([*before, "h"])


def test_who_takes_the_place_of_another_drives_on_from_there(town, tmp_path):
    """The same traffic as with the other, whose way goes on, one step later, where it was."""
    scenes = {}
    for ego in ("odd.name#1.2", "any"):
        scenario = load_scenario(town.folder / "town.sumocfg", ego=ego)
        (agent,) = scenario.agents
        with closing(SumoSimulator(scenario, tmp_path)) as simulator:
            simulator.reset(seed=4, options={"arguments": {"scale": 1.0, "vehicle": "odd.name#1.2"}})
            scenes[ego] = scene = simulator.scene()
            row = scene.roster.index[agent]
            assert libsumo.vehicle.getRoute(agent) == ("south", "east", "north", "west")
            if ego == "any":
                assert "odd.name#1.2" not in libsumo.vehicle.getIDList()
                was = scenes["odd.name#1.2"]
                before = was.roster.index["odd.name#1.2"]
                assert scene.time_s == pytest.approx(was.time_s + scenario.step_length_s)
                assert scene.points[row] == pytest.approx(was.points[before], abs=3.0)
                assert scene.speeds[row] == pytest.approx(was.speeds[before], abs=1.0)


def entered(town, tmp_path, vehicle, **changed):
    """The agent in the place of somebody, or in that of each of two; where it is, and its route."""
    scenario = load_scenario(town.folder / "town.sumocfg", ego="any")
    (setup,) = scenario.agents.values()
    with closing(SumoSimulator(replace(scenario, **{"agents": {"ego": setup}, **changed}), tmp_path)) as simulator:
        simulator.reset(seed=4, options={"arguments": {"scale": 1.0, "vehicle": vehicle}})
        return libsumo.vehicle.getRoadID("ego"), libsumo.vehicle.getRoute("ego")


def test_who_departs_further_on_is_replaced_there(town, tmp_path):
    (town.folder / "r.rou.xml").write_text(
        '<routes><route id="way" edges="south east north west"/>'
        '<vehicle id="first" route="way" depart="0"/>'
        '<vehicle id="here" route="way" depart="3" departEdge="2" departPos="20"/>'
        '<vehicle id="late" route="way" depart="9"/></routes>'
    )
    assert entered(town, tmp_path, "here") == ("north", ("north", "west"))


def test_a_vehicle_that_never_enters_is_invalid(town):
    words = ("run", "h", "1", "1", "100", "--scenario", "town.sumocfg", "--ego", "odd.name#1.7", "--json")
    done = town.crashhunt(*words, expect=3)  # the flow has five
    assert done.json["stopped_because"] == "no_valid_trial"
    assert "'odd.name#1.7' was not on the road" in done.err
    scenario = load_scenario(town.folder / "town.sumocfg", ego="odd.name#1.7")
    waited_s = scenario.agents["odd.name#1.7"].depart_s + scenario.insertion_timeout_s
    assert done.json["steps_total"] == round(waited_s / 0.2)  # none of which is the trial's own


@pytest.mark.parametrize("only", [None, []])
def test_what_is_simulated_before_the_first_step_is_counted(town, tmp_path, only):
    scenario = load_scenario(town.folder / "town.sumocfg", ego="odd.name#1.3")
    asked = {"options": {"arguments": {"scale": 1.0}, **({} if only is None else {"only": only})}}
    with closing(SumoSimulator(replace(scenario, warmup_s=11.0), tmp_path)) as simulator:
        for _ in range(2):  # it begins at 0 s each time
            simulator.reset(seed=4, **asked)
            assert simulator.setup_steps == round(simulator.scene().time_s / 0.2) > 11 / 0.2
        simulator.step({agent: simulator.actions[agent].encode((8.0, 0)) for agent in simulator.agents})
        assert simulator.setup_steps == round(simulator.scene().time_s / 0.2) - 1
        (town.folder / "r.rou.xml").write_text("<routes")
    with closing(SumoSimulator(scenario, tmp_path)) as simulator:
        with pytest.raises(InvalidEpisodeError):
            simulator.reset(seed=4, **asked)
        assert simulator.setup_steps == 0


@pytest.mark.parametrize("damage", ["</net", pytest.param("<net><edge", marks=pytest.mark.nightly)])
def test_a_malformed_network_is_no_crash(town, damage):
    (town.folder / "net.net.xml").write_text(damage)
    done = town.crashhunt("run", "h", "1", "1", "100", "--scenario", "town.sumocfg", "--json", expect=3)
    assert set(done.json["outcomes"]) == {"invalid"}
    assert done.json["crashes"] == []


@pytest.mark.parametrize(("form", "action", "leaves"), [("", (8.0, 1), True), ("meta", 0, False)])
def test_second_change_to_the_left_leaves_two_lanes_and_is_ignored_in_the_discrete_form(
    sumo_runs, form, action, leaves
):
    simulator, _ = sumo_runs.begin("loop", 4, {"vehicles": 10}, action=form)
    steps = 0
    while not (left := OffRoad().check(simulator.scene(), ("ego",))) and steps < 60:
        seen, *_ = simulator.step({"ego": simulator.actions["ego"].encode(action)})
        steps += 1
    assert (steps < 4, [(found.outcome, found.collision.role) for found in left]) == (
        leaves,
        [("off_road", "alone")] * leaves,
    )
    assert seen["ego"][0, 2] == 0.0  # y: in the leftmost lane


@pytest.mark.nightly
def test_two_agents_have_channels_and_arguments_of_their_own(shell):
    words = ("run", "h", "1", "12", "400", "--scenario", "loop-two-agents", "--seed", "2", "--json")
    crowded = ("--set", "vehicles=45")  # so that one of the first trials crashes
    (crash,) = shell.crashhunt(*words, "--arg", "overtaker.blind_spot_m=8:10", *crowded).json["crashes"]
    assert set(crash["arguments"]) == {"keeper", "overtaker"}
    assert 8 <= crash["arguments"]["overtaker"]["blind_spot_m"] <= 10
    recording = read_log(shell.folder / crash["path"] / "log.mcap")
    assert recording.agents == ("keeper", "overtaker")
    assert recording.actions("keeper").shape == recording.actions("overtaker").shape == (crash["step"], 2)
    assert shell.crashhunt("replay", "h", "--json").json["verdict"] == "reproduced"
    assert shell.crashhunt("replay", "h", "--from-log", "--json").json["verdict"] == "reproduced"
    done = shell.crashhunt(
        "run", "x", "1", "1", "10", "--scenario", "loop-two-agents", "--agent", "keep-lane", expect=2
    )
    assert "keeper=keep-lane" in done.err


def test_ego_sees_its_own_speed_which_changes_within_the_limits_of_its_type(sumo_runs):
    simulator, seen = sumo_runs.begin("loop", 2)
    speeds = []
    while not (scene := simulator.scene()).contacts:
        speeds.append(scene.speeds[scene.roster.index["ego"]])
        assert seen["ego"][0, 3] == pytest.approx(speeds[-1])
        seen, *_ = simulator.step({"ego": simulator.actions["ego"].encode((25.0, 0))})
    assert len(speeds) > 40
    assert np.all(np.abs(np.diff(speeds)) <= 0.1 * 9.0 + 1e-6)  # physical limits hold: speed mode 6
