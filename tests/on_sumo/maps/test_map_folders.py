"""What the folder of a scenario says, apart from what SUMO's programs make of a map."""

from __future__ import annotations

import shutil
import string
import tomllib
import types
import xml.etree.ElementTree as ET
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from hypothesis import example, given, strategies as st

from crashhunt.errors import ScenarioError
from crashhunt.scenario import scenario_from_dict, shipped_folder
from crashhunt.sumo.maps import MapSource, read_network
from crashhunt.sumo.maps._convert import ConvertOptions, convert
from crashhunt.sumo.maps._folder import agent_module, arguments_of, next_commands, readme, scenario_toml, workflow
from crashhunt.sumo.maps._picture import drawable
from crashhunt.sumo.maps._road_network import Edge, NetworkLane, RoadNetwork
from crashhunt.sumo.maps._tools import Tools
from crashhunt.sumo.maps._traffic import Demand, Route, _ego_routes, route_file


def lane(allowed=None, disallowed=(), length=100.0, at_m=0.0):
    allowed = None if allowed is None else frozenset(allowed)
    return NetworkLane(
        length_m=length, speed_mps=10.0, allowed=allowed, disallowed=frozenset(disallowed),
        shape=((0.0, at_m), (length, at_m)),
    )  # fmt: skip


def network(**lanes):
    return RoadNetwork(edges={name: Edge(name, "", tuple(found)) for name, found in lanes.items()})


def route(name, *edges, weight=1, length=400.0):
    return Route(id=name, edges=edges, weight=weight, length_m=length, free_s=length / 10.0)


def demand(*routes, per_hour=600.0, walks=()):
    return Demand(routes=routes, vehicles_per_hour=per_hour, walks=walks, ego_routes=tuple(one.id for one in routes))


# The network.


NET = """<net lefthand="true">
<edge id=":j_0" function="internal"><lane id=":j_0_0" length="3" speed="5" shape="0,0 1,1"/></edge>
<edge id=":j_c0" function="crossing"><lane id=":j_c0_0" allow="pedestrian" length="4" speed="1" shape="0,0 1,1"/></edge>
<edge id="a" name="Low Road"><lane id="a_0" allow="pedestrian" length="50" speed="1" shape="0,0,3 50,0,3"/>
<lane id="a_1" disallow="pedestrian truck" length="50" speed="14" shape="0,3 50,3"/></edge>
<edge id="r"><lane id="r_0" allow="rail" length="9" speed="14" shape="0,3 50,3"/></edge>
<edge id="n"><lane id="n_0" disallow="all" length="9" speed="14" shape="0,3 50,3"/></edge>
<junction id="j" type="traffic_light" shape="0,0 1,0 1,1"/><junction id="e" type="dead_end"/>
<junction id=":j_1" type="internal"/></net>"""


def test_permissions_and_junctions_of_a_network(tmp_path):
    (tmp_path / "n.net.xml").write_text(NET)
    found = read_network(tmp_path / "n.net.xml")
    assert set(found.edges) == {"a", "r", "n"}
    assert [edge.id for edge in found.drivable()] == ["a"]
    assert found.edges["a"].name == "Low Road"
    assert [one.speed_mps for one in found.edges["a"].open_lanes("passenger")] == [14.0]
    assert found.edges["a"].admits("pedestrian")
    assert not found.edges["a"].admits("truck")
    assert found.edges["r"].admits("rail")
    assert found.junctions == Counter(traffic_light=1)
    assert (found.crossings, found.left_hand, len(found.areas)) == (1, True, 1)


@pytest.mark.parametrize("text", ["", "<net>", '<net><edge id="a"><lane length="x"/></edge></net>'])
def test_damaged_network_is_refused(tmp_path, text):
    (tmp_path / "n.net.xml").write_text(text)
    with pytest.raises(ScenarioError, match="not a valid network"):
        read_network(tmp_path / "n.net.xml")


# The traffic.


def test_damaged_network_is_named_as_the_user_gave_it(tmp_path):
    path = tmp_path / "town.net.xml"
    path.write_text('<!DOCTYPE net [<!ENTITY a "&b;">]><net><edge id="&a;"/></net>')
    (tmp_path / "work").mkdir()
    with pytest.raises(ScenarioError, match="not a valid network") as caught:
        convert(MapSource(kind="net", path=path), ConvertOptions(), Tools(tmp_path, "1"), tmp_path / "work")
    assert caught.value.where == str(path)


@pytest.fixture
def tools(tmp_path):
    """Programs, of which one ends by a signal and one succeeds."""
    (tmp_path / "bin").mkdir()
    for name, line in (("killed", "kill -9 $$"), ("fine", "true")):
        program = tmp_path / "bin" / name
        program.write_text(f"#!/bin/sh\n{line}\n")
        program.chmod(0o755)
    return Tools(tmp_path, "1")


def test_program_that_was_killed_is_named_with_its_signal(tools, tmp_path):
    with pytest.raises(ScenarioError, match="killed was killed by signal 9") as caught:
        tools.run("killed", [], tmp_path)
    assert "memory" in caught.value.fix


def test_full_disk_under_a_program_is_reported(tools, tmp_path, monkeypatch):
    assert tools.run("fine", [], tmp_path).code == 0
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=4096))
    with pytest.raises(ScenarioError, match="fine has no space left for temporary files") as caught:
        tools.run("fine", [], tmp_path)
    assert "TMPDIR" in caught.value.fix


def test_agent_begins_at_different_places_first():
    routes = [route("a", "x", "y", weight=9), route("b", "x", "z", weight=8), route("c", "w", weight=1)]
    assert _ego_routes(routes) == ("a", "c", "b")


def test_routes_of_at_least_250_m_are_long_enough_for_an_agent():
    routes = [route(f"r{number}", f"s{number}", length=260.0 + number, weight=1 + number % 3) for number in range(20)]
    routes += [route(f"k{number}", f"t{number}", length=240.0, weight=99) for number in range(5)]
    chosen = _ego_routes(routes)
    assert len(chosen) == 12
    assert {name[0] for name in chosen} == {"r"}
    weights = {one.id: one.weight for one in routes}
    assert [weights[name] for name in chosen] == sorted(
        (one.weight for one in routes if one.id[0] == "r"), reverse=True
    )[:12]


def filled(text, **values):
    names = string.Template(text).get_identifiers()
    given = {"imperfection": 0.5, "speed_spread": 0.1, "ego_route": "a", **values}
    return ET.fromstring(string.Template(text).substitute({name: given.get(name, 10) for name in names}))


def test_types_of_a_flow_are_those_that_may_use_its_route():
    roads = network(
        free=[lane()], cars=[lane(("passenger",))], no_trucks=[lane(disallowed=("truck",))],
        no_bicycles=[lane(disallowed=("bicycle",))],
    )  # fmt: skip
    routes = [route(name, "free", name) for name in roads.edges]
    text = route_file(demand(*routes), roads, bicycles=True)
    types = {flow.get("id"): flow.get("type") for flow in filled(text).iter("flow")}
    assert types == {
        "free": "cars-trucks-cyclists", "cars": "cars", "no_trucks": "cars-cyclists", "no_bicycles": "cars-trucks",
    }  # fmt: skip
    assert "cyclist" not in route_file(demand(*routes), roads, bicycles=False)


def test_odd_names_of_roads_survive_the_template():
    odd = 'a"<&>$b${x}'
    text = route_file(demand(route("r", odd)), network(**{odd: [lane()]}), bicycles=False)
    assert next(filled(text).iter("route")).get("edges") == odd


# The texts.


@example(title="delete \x7f and \x85", agent="")
@given(title=st.text(max_size=80), agent=st.sampled_from(["", "mine:Driver"]))
def test_scenario_of_any_title_is_valid(title, agent):
    arguments = arguments_of(demand(route("a", "x"), route("b", "y")), (0.2, 1.5), bicycles=True)
    text = scenario_toml(title, arguments, warmup_s=30.0, speed_limit_mps=13.9, agent=agent)
    found = scenario_from_dict(tomllib.loads(text), where="t", folder=shipped_folder())
    assert found.title == title.encode("utf-8", "replace").decode()
    assert found.agents["ego"].agent == (agent or "crashhunt.agents:CarFollowing")
    assert found.arguments["demand"].option == "scale"
    assert bool(found.agents["ego"].arguments) is not bool(agent)
    for name, argument in found.scenario_arguments().items():
        if argument.distribution is not None:
            assert argument.distribution.contains(argument.default), name


def driver(**arguments):
    module = types.ModuleType("agent")
    exec(agent_module(13.9), vars(module))
    made = module.Driver(**arguments)
    made.reset(1)
    return made


def observation(speed, *others):
    rows = np.zeros((8, 7), np.float32)
    rows[0] = (1, 0, 0, speed, 0, 1, 0)
    for number, other in enumerate(others):
        rows[number + 1] = other
    return rows


def test_starting_agent_drives_on_a_free_road_and_brakes_behind_a_vehicle():
    agent = driver(speed=14.0)
    assert agent.act(observation(10.0)) == (pytest.approx(10.2), 0)
    assert agent.act(observation(14.0)) == (14.0, 0)
    assert agent.act(observation(10.0, (1, 9.0, 0, -10.0, 0, 1, 0)))[0] == pytest.approx(10.0 - 0.6)
    for harmless in ((1, -9.0, 0, 0, 0, 1, 0), (1, 9.0, 3.5, -10.0, 0, 1, 0), (1, 9.0, 0, -20.0, 0, -1, 0)):
        assert agent.act(observation(10.0, harmless))[0] == pytest.approx(10.2)


@given(
    st.floats(0, 40, width=32),
    st.lists(st.tuples(*[st.floats(-100, 100, width=32)] * 4), max_size=7),
    st.floats(0.5, 2.5),
)
def test_starting_agent_never_leaves_its_action_space(speed, others, headway_s):
    rows = [(1, ahead, right, closing, 0, cosine / 100, 0) for ahead, right, closing, cosine in others]
    target, change = driver(headway_s=headway_s).act(observation(speed, *rows))
    assert change == 0
    assert 0 <= target <= max(13.9, speed)


@given(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1).filter(lambda text: "/" not in text))
def test_workflow_of_any_folder_is_yaml_that_names_it(folder):
    text = workflow(folder, 900)
    found = yaml.safe_load(text)
    assert found["env"]["PYTHONPATH"] == folder
    hunt, corpus = (found["jobs"][name]["steps"] for name in ("hunt", "corpus"))
    assert hunt[-1]["uses"].startswith("crashhunt/crashhunt/.github/actions/hunt@v")
    assert corpus[-1]["uses"].startswith("crashhunt/crashhunt/.github/actions/corpus@v")
    assert hunt[-1]["with"]["max-steps"] == "900"
    assert corpus[-1]["with"]["corpus"] == ("crashes" if folder == "." else f"{folder}/crashes")


def test_inputs_of_the_workflow_exist():
    root = shipped_folder().parent
    found = yaml.safe_load(workflow("maps/town", 900))
    for name, job in found["jobs"].items():
        action = yaml.safe_load((root / ".github" / "actions" / name / "action.yml").read_text())
        assert job["steps"][-1]["with"].keys() <= action["inputs"].keys()


def test_readme_has_the_commands_and_the_licence_of_openstreetmap():
    given = {"demand": demand(route("a", "x")), "steps": 900, "run_s": 600, "workflow_file": ""}
    text = readme("town", ["map: town.osm"], from_osm=True, **given)
    assert "OpenStreetMap contributors" in text
    assert all(command in text for command in next_commands("", 900))
    assert "OpenStreetMap" not in readme("town", ["map: town.xodr"], from_osm=False, **given)


def test_commands_for_a_folder_with_odd_characters_are_quoted():
    assert next_commands("my town's", 900)[0] == "cd 'my town'\"'\"'s'"


# The picture.


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Straße", "Strasse"),
        ("Łódź", "Lodz"),
        ("Øst", "Ost"),
        ("A 9", "A 9"),
        ("東京 a", " a"),
        ("東京都 a", ""),
        ("", ""),
    ],
)
def test_names_are_drawn_in_letters_that_the_font_has(text, shown):
    pytest.importorskip("PIL")
    assert drawable(text) == shown
