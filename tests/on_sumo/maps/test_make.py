"""How a folder of a scenario comes about and its traffic is calibrated, with made-up programs in place of SUMO's."""

from __future__ import annotations

import gzip
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.errors import HuntDirectoryError, ScenarioError, UsageError
from crashhunt.scenario import load_scenario, shipped_folder
from crashhunt.sumo.maps import MapOptions, MapSource, _make, _traffic, describe_place, make_scenario, read_network
from crashhunt.sumo.maps._convert import NET, Converted, ConvertOptions, _command_arguments, convert
from crashhunt.sumo.maps._make import PlainTrial
from crashhunt.sumo.maps._tools import ToolResult, Tools
from crashhunt.sumo.maps._traffic import RUN_S, Demand, PlainRun, Route, calibrate, run_plain_traffic

MAP = shipped_folder() / "intersection" / "intersection.net.xml"
GRID = MapSource(kind="grid", shape=(2, 2))
ROUTES = tuple(
    Route(id=f"r{number}", edges=(f"from-{begin}", f"to-{end}"), weight=weight, length_m=length, free_s=free_s)
    for number, (begin, end, weight, length, free_s) in enumerate(
        [("north", "south", 3, 200.0, 20.0), ("east", "west", 1, 300.0, 60.0)]
    )
)
DEMAND = Demand(routes=ROUTES, vehicles_per_hour=900.0, walks=(("from-north", "to-east"),), ego_routes=("r0", "r1"))
RUN = PlainRun(
    demand=1.0, wanted=100, entered=99, arrived=80, running=19, halting=2, teleports=0, collisions=1,
    mean_speed_mps=11.5, persons=7, edge_vehicles={"from-north": 60.0, "from-east": 30.0, "to-west": 0.0, "gone": 9.0},
    probe_delays_s={"r0": 0.5, "r1": 2.25},
)  # fmt: skip


@pytest.fixture
def made_up(monkeypatch):
    """Programs that find a network, a demand and a traffic that flows."""
    asked = SimpleNamespace(said=[], demand=DEMAND, notes=("a note of the map",), error=None)
    network = read_network(MAP)

    def convert(source, options, tools, work):
        asked.converted = options
        shutil.copyfile(MAP, work / NET)
        return Converted(network, asked.notes)

    def find(network, tools, work, *, net, people):
        asked.people = people
        if asked.error is not None:
            raise asked.error
        return asked.demand

    def calibrated(demand, network, tools, work, values, *, net, scales, probes_at_s, bicycles):
        asked.values, asked.scales, asked.probes_at_s, asked.bicycles = values, scales, probes_at_s, bicycles
        return demand, replace(RUN, demand=scales[0]), replace(RUN, demand=scales[1])

    for name, made in (("convert", convert), ("find_demand", find), ("calibrate", calibrated)):
        monkeypatch.setattr(_make, name, made)
    monkeypatch.setattr(_make, "find_tools", lambda: Tools(Path("/nowhere"), "1.28.0"))
    return asked


def test_a_folder_has_everything_and_its_scenario_can_be_loaded(made_up, tmp_path):
    pytest.importorskip("PIL")
    tried = []

    def try_out(folder, steps):
        tried.append((sorted(path.name for path in folder.iterdir()), steps))
        return PlainTrial(outcome="collision", steps=42, wall_s=1.25)

    place = tmp_path / "new" / "place"
    options = MapOptions(people=True, bicycles=True, left_hand=True, demand=(0.2, 1.5), workflow="github")
    made = make_scenario(GRID, options, place, try_out=try_out, tell=made_up.said.append)
    assert {path.name for path in place.iterdir()} == {
        "map.net.xml", "traffic.rou.xml", "scenario.toml", "agent.py", "README.md", "map.png", ".github",
    }  # fmt: skip
    assert [*place.parent.iterdir()] == [place]
    assert made_up.converted == ConvertOptions(people=True, bicycles=True, left_hand=True)
    assert (made_up.people, made_up.bicycles, made_up.scales) == (True, True, (1.0, 1.5))
    assert made_up.probes_at_s == 1.2 * (3 * 20 + 60) / 4  # the usual trip fills the roads
    assert made_up.values["ego_route"] == "r0"
    assert made_up.said == [
        "making the network", "drawing trips", f"simulating {RUN_S} s of the plain traffic", "running one trial",
    ]  # fmt: skip
    # Twice the time of the longest route.
    assert tried == [(["map.net.xml", "map.png", "scenario.toml", "traffic.rou.xml"], 1200)]
    assert (place / "map.net.xml").read_bytes() == MAP.read_bytes()
    scenario = load_scenario(place)
    assert {"demand", "ego_route", "cyclists_per_100_cars"} <= scenario.arguments.keys()
    data = made.to_json()
    assert (data["dir"], data["roads"], data["routes"], data["ego_routes"]) == (str(place), 8, 2, 2)
    assert (data["vehicles_per_hour"], data["max_steps"], data["notes"]) == (900.0, 1200, ["a note of the map"])
    assert data["trial"] == {"outcome": "collision", "steps": 42, "wall_s": 1.25}
    assert [run["demand"] for run in data["plain"]] == [1.0, 1.5]
    assert data["plain"][0]["entered"] == 99
    assert data["next"] == made.commands
    lanes_km = sum(lane.length_m for edge in read_network(MAP).drivable() for lane in edge.lanes) / 1000
    assert data["lanes_km"] == pytest.approx(lanes_km, abs=0.001)
    assert data["junctions"] == sum(read_network(MAP).junctions.values())
    text = "\n".join(describe_place(made))
    assert "from-north 360/h; from-east 180/h" in text  # within 600 s
    assert "gone" not in text
    assert "traffic: 2 routes, 900 vehicles/h at demand 1, 1 flows of persons" in text
    assert "agent: 2 routes; it enters within 2.2 s at demand 1.5" in text
    assert "one trial of crashhunt.agents:CarFollowing: collision after 42 steps (1.2 s" in text
    assert text.endswith("note: a note of the map")
    assert "1200" in next((place / ".github").rglob("*.yml")).read_text()
    # The roads of the driver that is there to be changed: 500 m in 80 s.
    assert "6.2" in (place / "agent.py").read_text()
    with pytest.raises(HuntDirectoryError, match="exists and is not empty"):
        make_scenario(GRID, options, place)


def test_the_picture_is_of_the_busy_traffic_in_vehicles_per_hour(made_up, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(_make, "draw_map", lambda *words, **more: drawn.append((words, more)))
    make_scenario(GRID, MapOptions(), tmp_path / "place")
    (((network, vehicles, file), more),) = drawn
    assert len(network.edges) == 8
    assert vehicles == RUN.edge_vehicles
    assert file.name == "map.png"
    assert more["hours"] == RUN_S / 3600
    assert more["title"].endswith(": traffic at demand 1.5")
    assert more["busiest"] == [("from-north", 360.0), ("from-east", 180.0)]
    monkeypatch.setattr(_make, "draw_map", lambda *words, **more: __import__("no_such_package"))
    with pytest.raises(ScenarioError, match="needs Pillow"):
        make_scenario(GRID, MapOptions(), tmp_path / "other")


@pytest.mark.parametrize(
    ("outcome", "words"), [("hang", "--timeout"), ("agent_error", "the agent mine:Driver failed"), ("survived", "")]
)
def test_a_trial_that_ends_by_a_fault_is_a_note(made_up, tmp_path, outcome, words):
    made_up.demand = replace(DEMAND, walks=())
    options = MapOptions(people=True, picture=False, agent="mine:Driver", demand=(2.0, 3.0))
    trial = PlainTrial(outcome=outcome, steps=1, wall_s=1.0)
    made = make_scenario(GRID, options, tmp_path / "place", try_out=lambda *_: trial)
    notes = [note for note in made.notes if note.startswith("warning:")]
    assert notes[0] == "warning: no persons walk: the map has no connected ways for pedestrians"
    assert len(notes) == 1 + bool(words)
    assert words in notes[-1]
    assert made_up.scales == (2.0, 3.0)
    assert not (tmp_path / "place" / "map.png").exists()
    assert load_scenario(tmp_path / "place").agents["ego"].agent == "mine:Driver"
    assert "flows of persons" not in "".join(describe_place(made))


def test_where_it_fails_nothing_is_left_and_the_map_is_named(made_up, tmp_path):
    made_up.error = ScenarioError("no routes", fix="choose another")
    with pytest.raises(ScenarioError, match="no routes") as caught:
        make_scenario(GRID, MapOptions(), tmp_path / "place")
    assert caught.value.where == GRID.title
    assert [*tmp_path.iterdir()] == []
    (tmp_path / "place").mkdir()
    made_up.error = None
    make_scenario(GRID, MapOptions(picture=False), tmp_path / "place")  # an empty folder may be there
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to("nowhere")
    for name in ("file", "link"):
        with pytest.raises(HuntDirectoryError, match="is not a folder"):
            make_scenario(GRID, MapOptions(), tmp_path / name)
    with pytest.raises(UsageError, match="--bbox cannot be used with --grid"):
        make_scenario(GRID, MapOptions(bbox=(1, 2, 3, 4)), tmp_path / "other")
    with pytest.raises(UsageError, match="--lefthand cannot be used with --net"):
        make_scenario(MapSource(kind="net", path=MAP), MapOptions(left_hand=True), tmp_path / "other")


# The traffic.


def flowing(**more):
    return replace(RUN, **more)


def test_traffic_is_thinned_until_it_flows_and_routes_without_room_are_excluded(monkeypatch):
    runs = []

    def run(demand, *_, scale, step_s=0.1, **__):
        runs.append((round(demand.vehicles_per_hour, 3), scale, step_s))
        jams = demand.vehicles_per_hour > 400
        return flowing(demand=scale, teleports=50 * jams, probe_delays_s={"r0": 10.0, "r1": 10.1})

    monkeypatch.setattr(_traffic, "run_plain_traffic", run)
    common = {"net": "n", "scales": (1.0, 2.0), "probes_at_s": 30.0, "bicycles": False}
    demand, plain, busy = calibrate(DEMAND, None, None, None, {}, **common)
    thinner = [900 / 1.6, 900 / 1.6**2]
    assert runs == [
        (900.0, 2.0, 0.1), (round(thinner[0], 3), 2.0, runs[1][2]), (round(thinner[1], 3), 2.0, runs[1][2]),
        (round(thinner[1], 3), 2.0, 0.1), (round(thinner[1], 3), 1.0, 0.1),
    ]  # fmt: skip
    assert runs[1][2] > 0.1  # to look whether it jams, rough steps do
    assert (demand.vehicles_per_hour, demand.ego_routes) == (pytest.approx(thinner[1]), ("r0",))
    assert (plain.demand, busy.demand) == (1.0, 2.0)
    monkeypatch.setattr(_traffic, "run_plain_traffic", lambda *_, **__: flowing(entered=0))
    with pytest.raises(ScenarioError, match=r"jams even with 172 vehicles/h: no vehicle enters"):
        calibrate(DEMAND, None, None, None, {}, **common)
    monkeypatch.setattr(_traffic, "run_plain_traffic", lambda *_, **__: flowing(probe_delays_s={"r1": 11.0}))
    with pytest.raises(ScenarioError, match="can enter within 10 s") as caught:
        calibrate(DEMAND, None, None, None, {}, **common)
    assert caught.value.fix.endswith("which is 2")


WRITTEN = {
    "statistics.xml": '<s><vehicles inserted="52" waiting="6" running="20"/><teleports total="3"/>'
    '<safety collisions="2"/><persons loaded="4"/></s>',
    "summary.xml": '<s><step halting="9"/><step halting="5"/></s>',
    "edges.xml": '<m><interval><edge id="a" entered="3" departed="2"/><edge id="b"/></interval></m>',
    "trips.out.xml": '<t><tripinfo id="probe.r0" depart="30" departDelay="1.5" arrival="50"/>'
    '<tripinfo id="probe.r1" depart="-1"/><tripinfo id="x" arrival="60" routeLength="100" duration="10"/>'
    '<tripinfo id="y" arrival="60" routeLength="90" duration="3"/><tripinfo id="z" arrival="-1" duration="9"/></t>',
}  # fmt: skip


def test_what_sumo_wrote_of_the_traffic_is_counted_without_the_probes(tmp_path):
    words = []

    def run(program, given, folder):
        words.extend((program, *given))
        for name, text in WRITTEN.items():
            (folder / name).write_text(text)
        return ToolResult(0, "")

    values = {"imperfection": 0.5, "speed_spread": 0.1, "trucks_per_100_cars": 10, "demand": 1.0,
              "persons_per_path": 3}  # fmt: skip
    found = run_plain_traffic(
        DEMAND, read_network(MAP), SimpleNamespace(run=run), tmp_path, values, net="n", scale=3.0, probes_at_s=30.0,
        bicycles=False,
    )  # fmt: skip
    assert found == PlainRun(
        demand=3.0, wanted=52 + 6 - 2, entered=51, arrived=2, running=20, halting=5, teleports=3, collisions=2,
        mean_speed_mps=20.0, persons=4, edge_vehicles={"a": 5.0, "b": 0.0}, probe_delays_s={"r0": 1.5},
    )  # fmt: skip
    assert words[0] == "sumo"
    assert words[words.index("--end") + 1] == str(RUN_S)
    probes = [path.read_text() for path in tmp_path.iterdir() if '<vehicle id="probe.r0"' in path.read_text()]
    assert 'route="r1" depart="30"' in probes[0]
    with pytest.raises(ScenarioError, match="cannot load the scenario of this map: it is odd"):
        run_plain_traffic(
            DEMAND, read_network(MAP), SimpleNamespace(run=lambda *_: ToolResult(1, "Warning: x\nError: it is odd\n")),
            tmp_path, values, net="n", scale=1.0, probes_at_s=30.0, bicycles=False,
        )  # fmt: skip


# The network.


def test_a_network_is_taken_as_it_is_also_if_it_is_packed(tmp_path):
    def run(*_):
        raise AssertionError("no program is needed")

    tools = SimpleNamespace(run=run, home=tmp_path)
    for name, content in (("n.net.xml", MAP.read_bytes()), ("n.net.xml.gz", gzip.compress(MAP.read_bytes()))):
        (tmp_path / name).write_bytes(content)
        (work := tmp_path / f"work-{name}").mkdir()
        found = convert(MapSource(kind="net", path=tmp_path / name), ConvertOptions(), tools, work)
        assert (work / NET).read_bytes() == MAP.read_bytes()
        assert found.network.edges == read_network(MAP).edges
        assert found.notes == ()


def test_errors_of_netconvert_are_ignored_once_and_counted(tmp_path):
    calls = []

    def run(program, words, folder):
        calls.append((program, words))
        if "--ignore-errors" not in words:
            return ToolResult(1, "Error: edge 'a' is odd\nError: so is 'b'\n")
        (folder / NET).write_text(MAP.read_text())
        return ToolResult(0, "")

    (tmp_path / "t.osm").write_text("<osm/>")
    (tmp_path / "work").mkdir()
    source = MapSource(kind="osm", path=tmp_path / "t.osm")
    found = convert(source, ConvertOptions(), SimpleNamespace(run=run, home=tmp_path), tmp_path / "work")
    assert [program for program, _ in calls] == ["netconvert"] * 2
    (note,) = found.notes
    assert "the map has 2 errors" in note
    assert note.endswith("the first is: edge 'a' is odd")
    assert "generated on" not in (tmp_path / "work" / NET).read_text()


@pytest.mark.parametrize(
    ("kind", "options", "has", "lacks"),
    [
        ("grid", {"left_hand": True}, ["--grid.x-number 2 --grid.y-number 3", "--lefthand"], ["keep-edges"]),
        ("spider", {}, ["--spider.arm-number 2 --spider.circle-number 3"], ["--grid", "--lefthand"]),
        ("osm", {"bbox": (1.5, 2, 3, 4)}, ["in-geo-boundary 1.5,2,3,4", "--osm-files", "by-vclass passenger "],
         ["bicycle", "sidewalk"]),
        ("osm", {"people": True}, ["by-vclass passenger,pedestrian", "--osm.sidewalks", "--crossings.guess"],
         ["bike"]),
        ("osm", {"bicycles": True}, ["by-vclass passenger,bicycle", "--osm.bike-access", "--bikelanes.guess"],
         ["sidewalk"]),
        ("net", {}, ["--sumo-net-file", "--no-turnarounds.except-deadend"], ["components"]),
        ("opendrive", {}, ["--opendrive-files", "components 1"], ["--osm"]),
    ],
)  # fmt: skip
def test_options_become_words_of_the_program(kind, options, has, lacks, tmp_path):
    path = None if kind in ("grid", "spider") else tmp_path / "m.xml"
    source = MapSource(kind=kind, shape=(2, 3), path=path)
    words = " ".join(_command_arguments(source, ConvertOptions(**options), Tools(tmp_path, "1"))) + " "
    assert [word for word in has if word not in words] == []
    assert [word for word in lacks if word in words] == []
