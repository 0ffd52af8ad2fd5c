"""Controlled vehicles, flows, times and options of SUMO's configurations, one function at a time."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario import AgentSetup, ObservationSetup, Scenario, shipped_folder
from crashhunt.sumo import SumoSetup, _ego_choice, _scenario_check, _sumocfg
from crashhunt.sumo._ego_choice import Departure, choose_ego, draw_among, number, seconds
from crashhunt.sumo._options import FIXED_OPTIONS
from crashhunt.sumo._sumocfg import changes, load_sumocfg, read_config, split_names

HERE = Path("town.sumocfg")


def departures(*given, off_road=False):
    return [Departure(vehicle, float(time_s), off_road) for vehicle, time_s in given]


@pytest.mark.parametrize(("text", "time_s"), [("90", 90.0), ("1:30", 90.0), ("0:01:30.5", 90.5), ("1:0:0:0", 216000.0)])
def test_time_of_sumo_is_in_seconds_or_with_colons(text, time_s):
    assert seconds(text, HERE) == time_s
    assert number("2.5", "scale", HERE) == 2.5
    for function, words in ((seconds, ("soon",)), (number, ("many", "scale"))):
        with pytest.raises(ScenarioError, match=words[0]) as caught:
            function(*words, HERE)
        assert caught.value.where == "town.sumocfg"


def test_vehicle_is_drawn_from_those_amid_traffic():
    def drawn(*given, **more):
        return draw_among(departures(*given), **more)

    every = [(f"t{at}", at) for at in range(0, 1000, 50)]
    found = drawn(*every)
    # After 200 s, for 300 s.
    argument = found.arguments["vehicle"]
    assert argument.range == "t200|t250|t300|t350|t400|t450|t500"
    assert (argument.default, found.agent, found.setup) == (
        "t200",
        "ego",
        AgentSetup(replaces="vehicle", depart_s=500.0),
    )
    assert found.note.startswith("each trial replaces one random vehicle (7 candidates, entering at 200-500 s")
    assert drawn(*every, why="no ego: ", verb="depart").note.startswith("no ego: each trial")
    # Where all depart within less, after a third of that.
    assert drawn(*((f"t{at}", at) for at in range(0, 100, 10))).arguments["vehicle"].range.startswith("t30|t40|")
    sparse = [("a", 0), ("b", 10), ("c", 320), ("d", 600)]
    assert drawn(*sparse).agent == "c"
    assert drawn(*sparse, few=3).arguments["vehicle"].range == "a|b|c|d"
    assert drawn(*sparse, ("e", 610), few=2).arguments["vehicle"].range == "a|b|c|d|e"
    assert drawn(("a", 0), ("c", 320), ("d", 330), ("e", 900), few=2).arguments["vehicle"].range == "c|d"
    assert drawn(("x", 320), ("x", 320), few=3).agent == "x"
    only = drawn(("a", 7))
    assert (only.agent, only.setup, only.arguments) == ("a", AgentSetup(existing=True, depart_s=7.0), {})
    assert "'a'" in only.note
    assert " to " not in only.note
    assert "320" not in drawn(*sparse).note
    assert "from 200 to 500 s" in drawn(*sparse).note
    kept = drawn(("a", 7), keep_agent="mine")
    assert (kept.agent, kept.arguments["vehicle"].range, kept.arguments["vehicle"].default) == ("mine", "", "a")
    assert drawn(("a|b", 7), keep_agent="mine").agent == "a|b"
    assert drawn(*every, keep_agent="mine").agent == "mine"
    assert drawn(*every, keep_agent="t0").agent == "ego"
    assert drawn(*every, ("ego", 990)).agent == "crashhunt.ego"


def test_vehicles_of_all_times_are_drawn_where_that_gives_more_of_them():
    def drawn(*given, **more):
        return draw_among(departures(*given), **more)

    unnamed = [("a|b", 0), ("c", 320), ("d", 330), ("e|f", 900)]  # names with a bar cannot be drawn
    found = drawn(*unnamed, few=3)
    assert (found.arguments["vehicle"].range, found.setup.depart_s) == ("c|d", 330.0)
    assert "entering at 320-330 s" in found.note
    assert drawn(*unnamed, ("g", 950), few=3).setup.depart_s == 950.0
    assert drawn(("a", 0), ("x|y", 320), ("d", 600)).agent == "a"  # one is enough
    assert drawn(("a", 0), ("x|y", 320), ("d", 600), few=2).arguments["vehicle"].range == "a|d"


def test_of_many_vehicles_some_are_drawn_evenly():
    found = draw_among(departures(*((f"v{number}", 200 + number / 10) for number in range(1000))))
    names = found.arguments["vehicle"].range.split("|")
    assert len(names) == 200
    places = [int(name[1:]) for name in names]
    assert places == sorted(places)
    assert {after - before for before, after in pairwise(places)} == {3, 4}


FILE = """<routes><vType id="train" vClass="rail"/><vType id="car"/><route id="way" edges="a b"/>
<vehicle id="v" depart="5" type="car"/><trip id="t" depart="0:00:07"/><vehicle id="late" depart="triggered"/>
<vehicle id="ice" depart="1" type="train"/><flow depart="3"/>
<flow id="f" begin="100" end="130" period="10"/><flow id="n" begin="0" end="50" number="2"/>
<flow id="odd" begin="9" end="20" period="soon"/><flow id="zero" begin="4" end="20" vehsPerHour="0"/>
<flow id="long" begin="0" period="100" type="train"/></routes>"""


@pytest.fixture
def files(tmp_path):
    (tmp_path / "r.rou.xml").write_text(FILE)
    return [tmp_path / "r.rou.xml"]


def test_vehicles_of_files_have_their_departures(files):
    found = {one.vehicle: (one.depart_s, one.off_road) for one in _ego_choice._departures(files)}
    trains = {f"long.{place}": (100.0 * place, True) for place in range(10)}
    assert found == {
        "v": (5.0, False), "t": (7.0, False), "ice": (1.0, True), "f.0": (100.0, False), "f.1": (110.0, False),
        "f.2": (120.0, False), "n.0": (0.0, False), "n.1": (25.0, False), "odd.0": (9.0, False),
        "zero.0": (4.0, False), **trains,
    }  # fmt: skip
    (files[0].parent / "more.xml").write_text('<routes><vehicle id="m" depart="8"/></routes>')
    (files[0].parent / "speeds.txt").write_text("no XML")
    nested = '<include href="more.xml"/><variableSpeedSign id="s" lanes="a_0" file="speeds.txt"/></routes>'
    files[0].write_text(FILE.replace("</routes>", nested))
    assert {one.vehicle for one in _ego_choice._departures(files)} == {*found, "m"}
    for vehicle, depart_s in (("f.2", 120.0), ("v", 5.0), ("t", 7.0), ("odd.3", 0.0), ("zero.1", 0.0), ("x", 0.0)):
        assert _ego_choice._departure_of(vehicle, files) == depart_s


def test_controlled_vehicle_is_what_ego_names(files):
    def chosen(ego, begin=0.0):
        return choose_ego(ego, files, begin, HERE)

    assert chosen("route=way").setup == AgentSetup(route="way")
    assert chosen("edges=a,,b").setup == AgentSetup(edges=("a", "b"))
    for ego in ("f.1", "vehicle=f.1"):
        assert (chosen(ego).agent, chosen(ego).setup) == ("f.1", AgentSetup(existing=True, depart_s=110.0))
    assert {chosen(ego).agent for ego in ("route=way", "edges=a", "any", "")} == {"ego"}
    assert all(chosen(ego).arguments == {} for ego in ("route=way", "edges=a", "f.1"))
    assert chosen("").note == f"{_ego_choice.NOT_GIVEN}{chosen('any').note}"
    assert set(chosen("any", 100.0).arguments["vehicle"].range.split("|")) <= {"f.0", "f.1", "f.2"}
    with pytest.raises(ScenarioError, match="'color=red'") as caught:
        chosen("color=red")
    assert caught.value.where == "town.sumocfg"
    none = choose_ego("", files, 1e6, HERE)  # nobody departs any more
    assert (none.agent, none.setup, none.arguments) == ("ego", AgentSetup(route="way"), {})
    with pytest.raises(ScenarioError) as caught:
        choose_ego("", [], 0.0, HERE)
    assert caught.value.where == "town.sumocfg"
    files[0].write_text('<routes><vehicle id="a" depart="5"/>')
    with pytest.raises(ScenarioError, match="not valid XML") as caught:
        chosen("any")
    assert caught.value.where == str(files[0])


def surveyed(*entries, **more):
    said = [(vehicle, float(time_s), "passenger", False) for vehicle, time_s in entries]
    return {"begin_s": 0.0, "end_s": 700.0, "steps": 700, "entries": said, "gridlock": None, "cut_short": False, **more}


def bare(**more):
    given = {"simulator": "sumo", "notes": ("each trial",), "file": "town.sumocfg", "step_length_s": 0.5,
             "agents": {"ego": AgentSetup(replaces="vehicle")}}  # fmt: skip
    return Scenario(**given | more)


def test_traffic_has_warnings_with_their_times():
    def warned(*runs, **more):
        return _ego_choice._warnings(bare(**more), runs, departures(("a", runs[0]["entries"][0][1])))

    assert warned(surveyed(("a", 300))) == []
    (wait,) = warned(surveyed(("a", 301), begin_s=0.5))
    assert "step 601 (301 s)" in wait
    assert wait.endswith("Fix: set begin to 300 in town.sumocfg")
    assert warned(surveyed(("a", 310), begin_s=10.0)) == []
    jam = {"since_s": 50.0, "standing": 7, "vehicles": 9}
    later = jam | {"since_s": 60.0, "standing": 5}
    (stuck,) = warned(surveyed(("a", 1), gridlock=later), surveyed(("a", 1)), surveyed(("a", 1), gridlock=jam))
    assert "from 50 s on: 7 of 9 vehicles stand still, in 2 of 3 runs" in stuck
    (over,) = warned(surveyed(("a", 1), out_of_time=True), surveyed(("a", 1), end_s=80.0))
    assert "ended at 80 s" in over


def test_resumed_hunt_keeps_its_candidates():
    kept = _ego_choice.refine(bare(), [surveyed(*((f"t{at}", at) for at in range(200, 400, 50)))])
    found = _ego_choice.restore(bare(arguments={"scale": 1}, notes=(f"{_ego_choice.NOT_GIVEN}x", "second")), kept)
    assert found.agents == {"ego": AgentSetup(replaces="vehicle", depart_s=kept.agents["ego"].depart_s)}
    assert found.arguments == {"scale": 1, "vehicle": kept.arguments["vehicle"]}
    count = kept.arguments["vehicle"].range.count("|") + 1
    assert found.notes[0].startswith(_ego_choice.NOT_GIVEN)
    assert f" {count} candidates" in found.notes[0]
    assert found.notes[1:] == ("second",)
    ego = kept.agents["ego"]
    for other in (
        replace(kept, agents={"ego": ego, "b": ego}), replace(kept, agents={"ego": replace(ego, replaces="who")}),
        replace(kept, arguments={}),
    ):  # fmt: skip
        assert _ego_choice.restore(bare(), other) is None


# Configurations.


@pytest.fixture
def write(tmp_path):
    """Writes a configuration with the network and routes of the loop."""
    shutil.copy(shipped_folder() / "loop" / "loop.net.xml", tmp_path / "n.xml")
    (tmp_path / "r.xml").write_text('<routes><route id="way" edges="south east"/><trip id="t" depart="1"/></routes>')

    def write(text="", *, net="n.xml", routes="r.xml"):
        path = tmp_path / "town.sumocfg"
        path.write_text(f'<configuration><n v="{net}"/><input><r value="{routes}"/></input>{text}</configuration>')
        return path

    return write


def test_options_of_a_configuration_have_one_name_and_value(write, monkeypatch):
    monkeypatch.setenv("HOME", "/me")
    monkeypatch.setenv("OURS", "x")
    monkeypatch.delenv("THEIRS", raising=False)
    options, notes = read_config(write('<a v="~/a,~/${OURS}"/><b value=""/><scale> 2 </scale><e v="${THEIRS}9"/>'))
    assert options == {
        "net-file": "n.xml", "route-files": "r.xml", "additional-files": "/me/a,/me/x", "scale": "2", "end": "9",
    }  # fmt: skip
    assert any("${OURS}" in note and "'x'" in note for note in notes)
    assert any("${THEIRS}" in note and note.endswith("is not set") for note in notes)
    assert split_names(" a b , ,c") == ["a b", "c"]
    with pytest.raises(ScenarioError, match="twice"):
        read_config(write('<begin v="1"/><b v="2"/>'))
    with pytest.raises(ScenarioError) as caught:
        read_config(HERE)
    assert caught.value.where == str(HERE)


def test_options_that_a_trial_changes_are_listed_with_the_reason():
    assert changes({name: FIXED_OPTIONS[name] for name in _sumocfg._REASONS}) == []
    found = changes({
        "seed": "7", "threads": "4", "load-state": "s.xml", "end": "900", "tripinfo-output": "t.xml",
        "collision.action": "remove", "collision.mingap-factor": "0.0", "random": "true", "scale": "2",
    })  # fmt: skip
    assert [one.split(" (", 1)[0] for one in found] == [
        "seed 7", "threads 4", "load-state s.xml", "end 900", "collision.action remove", "random true",
        "tripinfo-output",
    ]  # fmt: skip
    assert f"it is {FIXED_OPTIONS['threads']}: " in found[1]
    assert changes({"end": "-1"}) == []
    assert _sumocfg.is_left_out("load-state.offset")
    assert _sumocfg.is_left_out("tripinfo-output")
    assert not _sumocfg.is_left_out("scale")


def test_configuration_becomes_a_scenario(write, tmp_path):
    text = '<begin v="0:01:00"/><step-length v="0.2504"/><scale v="1.5"/><lateral-resolution v="0.8"/>'
    found = load_sumocfg(write(text), ego="route=way")
    sumo = found.table(SumoSetup)
    assert (sumo.net, sumo.routes, sumo.additional, sumo.literal) == ("n.xml", ("r.xml",), (), None)
    assert sumo.options == {"begin": 60.0, "time-to-teleport": "300", "lateral-resolution": "0.8"}
    assert (found.step_length_s, found.warmup_s, found.insertion_timeout_s) == (0.25, 0.0, 300.0)
    assert (found.name, found.file, found.folder) == ("town", "town.sumocfg", tmp_path)
    assert (found.arguments["scale"].default, found.arguments["scale"].option) == (1.5, "scale")
    assert found.observation == ObservationSetup()
    assert found.agents == {"ego": AgentSetup(route="way")}
    plain = load_sumocfg(write())
    assert (plain.step_length_s, plain.arguments["scale"].default, len(plain.notes)) == (1.0, 1.0, 1)
    noted = load_sumocfg(write('<seed v="7"/>'))
    assert "seed 7" in noted.notes[1]
    (tmp_path / "r.xml").write_text('<routes><route id="${x}" edges="a"/></routes>')
    assert load_sumocfg(write(), ego="route=way").table(SumoSetup).literal is True


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('<begin v="10"/><end v="5"/>', "end = 5 .*begin = 10"), ('<step-length v="0"/>', "step-length = '0'"),
        ('<step-length v="inf"/>', "step-length = 'inf'"), ('<a v="no.xml"/>', "no.xml"),
        ('<some-file v="x"/>', "some-file = 'x'"), ('<step-length v="0.0001"/>', "not a time step"),
        ('<a v="${NOWHERE_AT_ALL}/r.xml"/>', "NOWHERE_AT_ALL} is not set"), ('<scale v="x"/>', "'x'"),
        ("<input>", "not valid XML"), ('<weight-files v="w.xml"/>', "weight-files"),
    ],
)  # fmt: skip
def test_configuration_with_a_mistake_names_the_option(write, text, says):
    with pytest.raises(ScenarioError, match=says) as caught:
        load_sumocfg(write(text))
    assert caught.value.where.endswith("town.sumocfg")


def test_network_of_a_configuration_is_one_file(write, tmp_path):
    with pytest.raises(ScenarioError):
        load_sumocfg(write(net="n.xml,n.xml"))
    with pytest.raises(ScenarioError, match="net-file"):
        load_sumocfg(write(net=""))
    (tmp_path / "sub").mkdir()
    shutil.copy(tmp_path / "r.xml", tmp_path / "sub/r.xml")
    assert load_sumocfg(write(routes="sub/r.xml,r.xml")).table(SumoSetup).routes == ("sub/r.xml", "r.xml")
    below = tmp_path / "sub/town.sumocfg"
    below.write_text('<configuration><n v="../n.xml"/><r v="../r.xml"/></configuration>')
    found = load_sumocfg(below)
    assert (found.folder, found.file) == (tmp_path, "sub/town.sumocfg")
    (tmp_path / "r.xml").write_text(f'<routes><include href="{tmp_path}/sub/r.xml"/></routes>')
    found = load_sumocfg(write(), ego="route=way")
    assert found.folder == tmp_path
    begin_and_end = write('<begin v="5"/><end v="5"/>')
    assert load_sumocfg(begin_and_end, ego="route=way").table(SumoSetup).options["begin"] == 5.0
    text = write('<end v="-1"/><begin v="5"/>')
    assert load_sumocfg(text, ego="route=way").table(SumoSetup).options["begin"] == 5.0


def test_names_are_found_in_the_files(tmp_path):
    texts = [b'<routes><flow id="f"/><vehicle id="v"/><person id="p"/><trip id="t&quot;1"/></routes>']
    assert _scenario_check._ids(b"vehicle|trip", texts) == ["v", 't"1']
    for name in ("v", "f.0", "p_0", 't"1'):
        _scenario_check._check_vehicle(name, texts, "--ego", "here")
    for name, says in (("f", "'f'"), ("w", "'w'")):
        with pytest.raises(ScenarioError, match=says) as caught:
            _scenario_check._check_vehicle(name, texts, "--ego", "here")
        assert caught.value.where == "here"
    with pytest.raises(ScenarioError) as caught:
        _scenario_check._check_vehicle("f", texts, "--ego", "here")
    assert "f.0" in caught.value.fix
    with pytest.raises(ScenarioError, match=r"--ego: .*edge 'b'") as caught:
        _scenario_check._check_name("--ego", "edge", "b", [b'<edge id="a"/><edge id=":x"/>'], "here")
    assert "a" in caught.value.fix
    assert ":x" not in caught.value.fix
    _scenario_check._check_name("--ego", "edge", "a", [b'<edge id="a"/>'], "here")
