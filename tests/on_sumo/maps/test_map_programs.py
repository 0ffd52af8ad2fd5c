"""Maps through SUMO's own programs. They need eclipse-sumo, whose wheel has 148 MB: pip install 'crashhunt[maps]'."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET

import pytest

from crashhunt.errors import ScenarioError
from crashhunt.scenario import load_scenario, shipped_folder
from crashhunt.sumo.maps import MapOptions, MapSource, _tools, cached_scenario, describe_place, make_scenario
from crashhunt.sumo.maps._convert import NET, ConvertOptions, convert
from crashhunt.sumo.maps._tools import Tools, find_tools, first_error
from crashhunt.sumo.maps._traffic import find_demand

pytest.importorskip("sumo", reason="needs eclipse-sumo: pip install 'crashhunt[maps]'")

OSM = """<?xml version="1.0"?><osm version="0.6">
<node id="1" lat="48.1" lon="11.5" version="1"/><node id="2" lat="48.101" lon="11.501" version="1"/>
<node id="3" lat="48.102" lon="11.503" version="1"/><node id="4" lat="48.103" lon="11.499" version="1"/>
<way id="10" version="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/>{tags}</way>
<way id="11" version="1"><nd ref="2"/><nd ref="4"/>{tags}</way></osm>"""
ROAD = '<tag k="highway" v="residential"/><tag k="name" v="Hauptstraße"/>'


def osm(folder, tags=ROAD, name="town.osm"):
    path = folder / name
    path.write_text(OSM.format(tags=tags), encoding="utf-8")
    return MapSource(kind="osm", path=path)


def converted(source, folder, **options):
    work = folder / "work"
    work.mkdir()
    return convert(source, ConvertOptions(**options), find_tools(), work), work


def test_map_becomes_a_network_without_traces_of_this_machine(tmp_path):
    made, work = converted(osm(tmp_path), tmp_path)
    assert len(made.network.drivable()) == 6
    assert {edge.name for edge in made.network.drivable()} == {"Hauptstraße"}
    text = (work / NET).read_text(encoding="utf-8")
    assert "generated on" not in text
    assert str(tmp_path) not in text
    assert made.notes == ()


def test_bbox_without_roads_is_refused_with_the_extent_of_the_map(tmp_path):
    for bbox, fix in (
        ((0.0, 0.0, 1.0, 1.0), "choose a --bbox with streets; the map spans 11.499,48.1,11.503,48.103"),
        ((48.1, 11.4, 48.2, 11.6), "give --bbox=11.4,48.1,11.6,48.2, since the order is west,south,east,north"),
    ):
        with pytest.raises(ScenarioError, match="the map has no road in this --bbox") as refused:
            converted(osm(tmp_path), tmp_path, bbox=bbox)
        assert refused.value.fix.startswith(fix)
        shutil.rmtree(tmp_path / "work")


@pytest.mark.parametrize("name", ["a,b $x 'y'.osm", "ä ö.osm", "-o.osm"])
def test_names_of_maps_with_odd_characters_do_not_matter(tmp_path, name):
    made, _ = converted(osm(tmp_path, name=name), tmp_path)
    assert len(made.network.drivable()) == 6


def test_bbox_keeps_the_roads_inside(tmp_path):
    made, _ = converted(osm(tmp_path), tmp_path, bbox=(11.4985, 48.0995, 11.5005, 48.1005))
    assert {edge.id for edge in made.network.drivable()} == {"10#0", "-10#0"}


def test_people_get_sidewalks_and_left_hand_traffic_its_side(tmp_path):
    made, _ = converted(MapSource(kind="grid", shape=(2, 2)), tmp_path, people=True, left_hand=True)
    assert made.network.left_hand
    assert all(edge.admits("pedestrian") for edge in made.network.drivable())
    assert made.network.crossings > 0


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        ('<tag k="railway" v="rail"/>', "rails only"),
        ('<tag k="highway" v="footway"/>', "pedestrians and bicycles"),
        ('<tag k="building" v="yes"/>', "no road"),
        ('<tag k="type" v="lanelet"/>', "Lanelet2"),
    ],
)
def test_map_without_a_road_for_cars_is_refused_with_what_it_has(tmp_path, tags, words):
    with pytest.raises(ScenarioError, match=words) as caught:
        converted(osm(tmp_path, tags), tmp_path)
    assert caught.value.where.endswith("town.osm")
    assert caught.value.fix


def test_first_error_of_netconvert_is_quoted(tmp_path):
    source = osm(tmp_path)
    source.path.write_text(source.path.read_text()[:-30])
    with pytest.raises(ScenarioError, match=r"netconvert cannot read the map: .+") as caught:
        converted(source, tmp_path)
    assert caught.value.fix == "download or export the map again: it is incomplete, or not valid XML"


def xodr(folder, rule=""):
    path = folder / "road.xodr"
    path.write_text(
        f'<OpenDRIVE><header revMajor="1" revMinor="4"/><road name="" length="300" id="1" junction="-1" {rule}>'
        '<planView><geometry s="0" x="0" y="0" hdg="0" length="300"><line/></geometry></planView><lanes><laneSection '
        's="0">'
        '<left><lane id="1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left>'
        '<center><lane id="0" type="none" level="false"/></center>'
        '<right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>'
        "</right>"
        "</laneSection></lanes></road></OpenDRIVE>"
    )
    return MapSource(kind="opendrive", path=path)


@pytest.mark.parametrize("length", ["-300", "many", "nan"])
@pytest.mark.parametrize("element", ["road", "geometry"])
def test_length_that_opendrive_forbids_is_refused(tmp_path, element, length):
    source = xodr(tmp_path)
    head, tail = source.path.read_text().split(f"<{element} ")
    source.path.write_text(f"{head}<{element} {tail.replace('300', length, 1)}")
    with pytest.raises(ScenarioError, match=f"a <{element}> has the length '{length}'") as caught:
        converted(source, tmp_path)
    assert caught.value.where == str(source.path)


def test_road_of_rule_lht_keeps_to_the_left(tmp_path):
    made, _ = converted(xodr(tmp_path, 'rule="LHT"'), tmp_path)
    assert made.network.left_hand
    assert "LHT" in made.notes[0]


def test_one_straight_road_has_a_route_in_each_direction(tmp_path):
    made, work = converted(xodr(tmp_path), tmp_path)
    assert not made.network.left_hand
    found = find_demand(made.network, find_tools(), work, net=NET, people=False)
    assert sorted(len(route.edges) for route in found.routes) == [1, 1]
    assert 0 < found.vehicles_per_hour <= 1600
    assert len(found.ego_routes) == 2


def test_pbf_is_the_same_map(tmp_path):
    osmium = pytest.importorskip("osmium")
    plain = osm(tmp_path)
    with osmium.SimpleWriter(str(tmp_path / "town.osm.pbf")) as writer:
        for one in osmium.FileProcessor(str(plain.path)):
            writer.add(one)
    made, _ = converted(MapSource(kind="osm", path=tmp_path / "town.osm.pbf"), tmp_path)
    assert len(made.network.drivable()) == 6
    (tmp_path / "bad.osm.pbf").write_bytes((tmp_path / "town.osm.pbf").read_bytes()[:-20])
    (tmp_path / "again").mkdir()
    with pytest.raises(ScenarioError, match="osmium cannot read"):
        converted(MapSource(kind="osm", path=tmp_path / "bad.osm.pbf"), tmp_path / "again")


def test_network_is_taken_as_it_is(tmp_path):
    shipped = shipped_folder() / "intersection" / "intersection.net.xml"
    _, work = converted(MapSource(kind="net", path=shipped), tmp_path)
    assert (work / NET).read_bytes() == shipped.read_bytes()


def test_programs_that_are_newer_than_the_simulator_are_refused(monkeypatch):
    versions = {"eclipse-sumo": "99.1.0", "libsumo": "1.28.0"}
    monkeypatch.setattr(_tools.metadata, "version", versions.__getitem__)
    find_tools.cache_clear()
    with pytest.raises(ScenarioError, match=r"eclipse-sumo 99\.1\.0 is newer than libsumo 1\.28\.0") as caught:
        find_tools()
    assert caught.value.fix == "pip install 'eclipse-sumo==1.28.0'"
    versions["eclipse-sumo"] = "1.28.7"  # the same file formats
    assert find_tools().version == "1.28.7"
    find_tools.cache_clear()


def test_program_sees_sumo_home_and_this_process_does_not(tmp_path, monkeypatch):
    monkeypatch.delenv("SUMO_HOME", raising=False)
    done = find_tools().run("netconvert", ["--help"], tmp_path)
    assert done.code == 0
    assert "SUMO_HOME" not in os.environ


def test_program_that_is_missing_is_one_line(tmp_path):
    with pytest.raises(ScenarioError, match="cannot be started"):
        Tools(tmp_path, "1").run("netconvert", [], tmp_path)


def test_first_error_is_found_between_warnings():
    assert first_error("Warning: a\nError: b\nError: c\n") == "b"
    assert first_error("Warning: a\n") == ""


@pytest.mark.nightly
def test_whole_scenario_is_made_tried_and_loaded(tmp_path):
    stopped = []
    made = make_scenario(
        MapSource(kind="grid", shape=(2, 2)), MapOptions(people=True, bicycles=True, workflow="github"),
        tmp_path / "a b" / "place",
    )  # fmt: skip
    assert made.plain.entered > 10
    assert not made.plain.jam
    assert made.busy.persons > 0
    folder = tmp_path / "a b" / "place"
    names = {file.name for file in folder.iterdir()}
    assert names == {
        "map.net.xml", "traffic.rou.xml", "scenario.toml", "agent.py", "README.md", "map.png", ".github",
    }  # fmt: skip
    assert [*folder.parent.iterdir()] == [folder], "something was left"
    scenario = load_scenario(folder)
    assert {"demand", "imperfection", "speed_spread", "trucks_per_100_cars", "cyclists_per_100_cars"} < set(
        scenario.arguments
    )
    assert all(len(line) < 200 for line in describe_place(made))
    with pytest.raises(Exception, match="not empty"):
        make_scenario(MapSource(kind="grid", shape=(2, 2)), MapOptions(), folder, try_out=stopped.append)
    assert not stopped


@pytest.mark.nightly
def test_same_map_gives_the_same_files(tmp_path):
    for name in ("one", "two"):
        make_scenario(osm(tmp_path), MapOptions(picture=False), tmp_path / name)
    for name in ("map.net.xml", "traffic.rou.xml", "scenario.toml"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name


@pytest.mark.nightly
def test_traffic_that_always_jams_is_refused_and_nothing_is_left(tmp_path):
    made, work = converted(MapSource(kind="grid", shape=(2, 2)), tmp_path)
    del made
    tree = ET.parse(work / NET)
    for phase in tree.iter("phase"):
        phase.set("state", "r" * len(phase.get("state")))
    assert any(True for _ in tree.iter("phase"))
    tree.write(tmp_path / "red.net.xml")
    with pytest.raises(ScenarioError, match="jams") as caught:
        make_scenario(MapSource(kind="net", path=tmp_path / "red.net.xml"), MapOptions(), tmp_path / "place")
    assert "traffic lights" in caught.value.fix
    assert not (tmp_path / "place").exists()


@pytest.mark.nightly
def test_scenario_of_a_map_is_kept_by_content_and_mended(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    source = osm(tmp_path)
    folder = cached_scenario(source.path)
    before = (folder / "scenario.toml").read_bytes()
    stamp = (folder / "map.net.xml").stat().st_mtime_ns
    assert cached_scenario(source.path) == folder
    assert (folder / "map.net.xml").stat().st_mtime_ns == stamp, "made again"
    (folder / "scenario.toml").write_text("broken")
    assert cached_scenario(source.path) == folder
    assert (folder / "scenario.toml").read_bytes() == before
    source.path.write_text(source.path.read_text().replace("48.103", "48.104"))
    assert cached_scenario(source.path) != folder
    scenario = load_scenario(source.path)
    assert scenario.name == "town"
    assert scenario.arguments["demand"].option == "scale"
    with pytest.raises(ScenarioError, match="--ego"):
        load_scenario(source.path, ego="any")


@pytest.mark.nightly
def test_two_processes_that_name_the_same_new_map_agree(tmp_path):
    source = osm(tmp_path)
    code = (
        "import pathlib, sys; from crashhunt.sumo.maps import cached_scenario as c; print(c(pathlib.Path(sys.argv[1])))"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    both = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(source.path)], env=environment, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    said = [process.communicate(timeout=300)[0] for process in both]
    assert said[0] == said[1]
    assert [process.returncode for process in both] == [0, 0]
    assert len([*(tmp_path / "cache" / "crashhunt" / "maps").iterdir()]) == 1


def test_cache_that_others_may_write_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    place = tmp_path / "cache" / "crashhunt" / "maps"
    place.mkdir(parents=True)
    place.chmod(0o777)
    with pytest.raises(Exception, match="can be written by other users") as caught:
        cached_scenario(osm(tmp_path).path)
    assert "XDG_CACHE_HOME" in caught.value.fix
