"""What is read back of an OpenSCENARIO file is what was recorded; its roads are the lanes."""

from __future__ import annotations

import math
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from handing import AGENTS, LANES, crash, middles, read_back, readers, recorded_paths

from crashhunt.formats import write_openscenario
from crashhunt.world import Lane


def ways_of(root):
    """The vertices of each trajectory, as (time, x, y, heading)."""
    return {
        way.get("name"): [
            (float(vertex.get("time")), *(float(vertex.find("Position/WorldPosition").get(key)) for key in "xyh"))
            for vertex in way.iter("Vertex")
        ]
        for way in root.iter("Trajectory")
    }


def see_that_they_are_as_recorded(ways, names, paths):
    """Every way has its vertices at its times; who was seen once has none."""
    left = {actor: iter(found) for actor, found in names.items()}
    seen = 0
    for path in paths:
        name = next(left[path.actor.id])
        if len(path.states) < 2:
            assert name not in ways
            continue
        seen += 1
        assert [vertex[0] for vertex in ways[name]] == [step * 0.1 for step in middles(path)]
        assert [tuple(vertex[1:3]) for vertex in ways[name]] == list(middles(path).values())
        for (*_, heading), state in zip(ways[name], path.states, strict=True):
            assert math.remainder(heading - state.heading, math.tau) == pytest.approx(0, abs=1e-9)
    assert len(ways) == seen


@pytest.mark.parametrize("seed", [1, 3])
def test_everybody_follows_the_recorded_way(tmp_path, seed):
    bundle = crash(tmp_path, seed=seed)
    names = write_openscenario(bundle, tmp_path / "one.xosc", with_agents=True)
    root = ET.parse(tmp_path / "one.xosc").getroot()
    paths = recorded_paths(bundle)
    see_that_they_are_as_recorded(ways_of(root), names, (*paths.agents, *paths.others))
    entities = [entity.get("name") for entity in root.iter("ScenarioObject")]
    assert sorted(entities) == sorted(name for found in names.values() for name in found)
    assert len(set(entities)) == len(entities)
    assert not any(set(name) & set(' $/<"') for name in entities)
    assert {found.get("entityRef") for found in root.iter() if found.get("entityRef")} == set(entities)
    assert root.find("RoadNetwork/LogicFile").get("filepath") == "one.xodr"
    box = root.find(".//Vehicle/BoundingBox/Dimensions")
    assert (box.get("length"), box.get("width")) == ("4.5", "1.8")
    # Where the rear axle is not at the point of reference, esmini shifts the outline ahead by so much.
    assert {float(axle.get("positionX")) for axle in root.iter("RearAxle")} == {0.0}
    assert {float(center.get("x")) for center in root.iter("Center")} == {0.0}


def test_who_comes_later_is_not_there_before_and_leaves_when_it_was_last_seen(tmp_path):
    bundle = crash(tmp_path, seed=1)
    names = write_openscenario(bundle, tmp_path / "one.xosc")
    root = ET.parse(tmp_path / "one.xosc").getroot()
    paths = recorded_paths(bundle).others
    assert any(path.first for path in paths)
    left = {actor: iter(found) for actor, found in names.items()}
    placed = {private.get("entityRef") for private in root.iter("Private")}
    absent = {found.get("entityRef") for found in root.findall("Storyboard/Init/Actions/GlobalAction/EntityAction")}
    at = {
        event.get("name"): float(event.find(".//SimulationTimeCondition").get("value")) for event in root.iter("Event")
    }
    for path in paths:
        name = next(left[path.actor.id])
        assert (name in placed, name in absent) == (path.first == 0, path.first > 0)
        assert at.get(f"{name} comes") == (pytest.approx((path.first - 0.5) * 0.1) if path.first else None)
        assert at.get(f"{name} leaves") == (pytest.approx((path.last + 0.5) * 0.1) if path.last < 16 else None)
    assert not set(ways_of(root)) & {names[agent][0] for agent in AGENTS}, "whoever runs it drives the agents"
    assert {names[agent][0] for agent in AGENTS} <= placed


def test_each_lane_is_a_road_along_its_centre_line(tmp_path):
    lanes = [*LANES, Lane("on_0", 3.5, ((60.0, 20.0), (80.0, 25.0)))]
    write_openscenario(crash(tmp_path, lanes=lanes), tmp_path / "one.xosc")
    roads = ET.parse(tmp_path / "one.xodr").getroot().findall("road")
    shapes = [np.array(lane.shape) for lane in lanes if lane.id != "point_0"]
    assert len(roads) == len(shapes)
    for road, shape in zip(roads, shapes, strict=True):
        pieces = [{key: float(value) for key, value in piece.items()} for piece in road.iter("geometry")]
        ends = [
            (
                piece["x"] + piece["length"] * math.cos(piece["hdg"]),
                piece["y"] + piece["length"] * math.sin(piece["hdg"]),
            )
            for piece in pieces
        ]
        points = np.array([(pieces[0]["x"], pieces[0]["y"]), *ends])
        assert points == pytest.approx(shape[np.append(True, np.any(np.diff(shape, axis=0), axis=1))], abs=1e-9)
        assert sum(piece["length"] for piece in pieces) == pytest.approx(float(road.get("length")))
    assert [float(road.find(".//width").get("a")) for road in roads] == pytest.approx([3.0, 3.5, 3.5, 3.0, 3.5])
    links = {road.get("id"): {end.tag: end.get("elementId") for end in road.find("link")} for road in roads}
    assert links == {"1": {}, "2": {"successor": "5"}, "3": {}, "4": {}, "5": {"predecessor": "2"}}
    lanes_of = {road.get("id"): [(end.tag, end.get("id")) for end in road.find(".//lane/link")] for road in roads}
    assert lanes_of == {number: [(tag, "-1") for tag in ends] for number, ends in links.items()}


def test_an_actor_begins_where_and_as_fast_as_it_was_first_seen(tmp_path):
    bundle = crash(tmp_path, seed=1)
    names = write_openscenario(bundle, tmp_path / "one.xosc")
    root = ET.parse(tmp_path / "one.xosc").getroot()
    recorded = recorded_paths(bundle)
    starts = {private.get("entityRef"): private for private in root.iter("Private")}
    comes = {event.get("name"): event for event in root.iter("Event")}
    left = {actor: iter(found) for actor, found in names.items()}
    for path in (*recorded.agents, *recorded.others):
        name, first = next(left[path.actor.id], None), path.states[0]
        if name is None:  # an agent that is seen again: another program drives it by then
            continue
        moves = starts.get(name, comes.get(f"{name} moves"))
        if path.first == 0:
            place = starts[name].find(".//TeleportAction/Position/WorldPosition")
            assert math.remainder(float(place.get("h")) - first.heading, math.tau) == pytest.approx(0)
        else:
            assert name not in starts
            place = comes[f"{name} comes"].find(".//AddEntityAction/Position/WorldPosition")
        assert (float(place.get("x")), float(place.get("y"))) == next(iter(middles(path).values()))
        # Where a trajectory gives the speeds, none is set.
        assert (moves is None) == (path.first > 0 and len(path.states) > 1)
        if moves is not None:
            assert float(moves.find(".//AbsoluteTargetSpeed").get("value")) == pytest.approx(first.speed)
    assert [child.tag for child in root][:4] == [
        "FileHeader",
        "ParameterDeclarations",
        "CatalogLocations",
        "RoadNetwork",
    ]


@readers
def test_scenariogeneration_reads_what_was_recorded(tmp_path):
    bundle = crash(tmp_path)
    names = write_openscenario(bundle, tmp_path / "one.xosc", with_agents=True)
    found = read_back("openscenario", tmp_path / "one.xosc")
    paths = recorded_paths(bundle)
    see_that_they_are_as_recorded(found["ways"], names, (*paths.agents, *paths.others))
    assert not found["against"]
    assert sorted(found["entities"]) == sorted(name for some in names.values() for name in some)
